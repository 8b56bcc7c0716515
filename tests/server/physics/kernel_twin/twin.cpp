// The solver's kernels on a CPU: run(kernel, blocks, space, argument, backwards).
constexpr unsigned FIBERS = 128;
#include "cuda_on_cpu.h"

#include "solver_source.h"

using Given = Space;
#include "blocks_on_cpu.h"

#include "kernel_names.h"

// 0, or 1 for an unknown kernel, 2 where threads of a block part ways at a barrier.
extern "C" int run(
    const char* name, uint32 blocks, const Space* space, uint32 argument, int backwards) {
    for (const Named& named : KERNELS)
        if (strcmp(named.name, name) == 0)
            return run_blocks(named.kernel, space, blocks, argument, backwards) ? 0 : 2;
    return 1;
}
