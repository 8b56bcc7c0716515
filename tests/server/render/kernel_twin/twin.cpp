// The serving kernels on a CPU: run(kernel, blocks, frame, argument, backwards).
constexpr unsigned FIBERS = 256;
#include "cuda_on_cpu.h"

#include "serving.cu"

using Given = Frame;
#include "blocks_on_cpu.h"

struct Named { const char* name; Kernel kernel; };
static const Named KERNELS[] = {
    {"find_seen", find_seen}, {"project_seen", project_seen}, {"count_digits", count_digits},
    {"scatter_digits", scatter_digits}, {"count_pairs", count_pairs}, {"make_pairs", make_pairs},
    {"find_ranges", find_ranges}, {"blend", blend}};

// 0, or 1 for an unknown kernel, 2 where threads of a block part ways at a barrier.
extern "C" int run(
    const char* name, uint32 blocks, const Frame* frame, uint32 argument, int backwards) {
    for (const Named& named : KERNELS)
        if (strcmp(named.name, name) == 0)
            return run_blocks(named.kernel, frame, blocks, argument, backwards) ? 0 : 2;
    return 1;
}

extern "C" void sizes(uint32* out) {
    const size_t all[] = {sizeof(Object), sizeof(Placement), sizeof(Camera), sizeof(Frame)};
    for (unsigned k = 0; k < 4; ++k) out[k] = uint32(all[k]);
}

extern "C" float exponential(float x) { return exp_negative(x); }
extern "C" float logarithm(float x) { return log_of(x); }
