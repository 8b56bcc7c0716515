// The kernels of cast() on a CPU: run(kernel, blocks, sweep, argument, backwards).
constexpr unsigned FIBERS = 256;
#include "cuda_on_cpu.h"

#include "cast.cu"

using Given = Sweep;
#include "blocks_on_cpu.h"

struct Named { const char* name; Kernel kernel; };
static const Named KERNELS[] = {{"prepare", prepare}, {"list_tiles", list_tiles}, {"follow", follow}};

// 0, or 1 for an unknown kernel, 2 where threads of a block part ways at a barrier.
extern "C" int run(
    const char* name, uint32 blocks, const Sweep* sweep, uint32 argument, int backwards) {
    for (const Named& named : KERNELS)
        if (strcmp(named.name, name) == 0)
            return run_blocks(named.kernel, sweep, blocks, argument, backwards) ? 0 : 2;
    return 1;
}

extern "C" void sizes(uint32* out) {
    const size_t all[] = {sizeof(Met), sizeof(Body), sizeof(Sweep)};
    for (unsigned k = 0; k < 3; ++k) out[k] = uint32(all[k]);
}
