// As much of CUDA as our kernels use, so that their source runs on a CPU, thread by thread. Before it
// is included, FIBERS says how many threads a block has.
//
// The threads of a block are fibers of one thread of the machine. A fiber runs until it waits for
// its warp or its block; when all those are waiting, they go on. Kernels in which a thread waits for
// one that has ended, or that ends while others wait, are refused: that is undefined on a GPU.
#pragma once

#include <cmath>
#include <csetjmp>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <ucontext.h>

#define __global__
#define __device__
#define __shared__ static
#define __forceinline__ inline
#define __launch_bounds__(...)

struct alignas(16) float4 { float x, y, z, w; };
struct alignas(8) uint2 { unsigned x, y; };
struct Index { unsigned x; };
static Index threadIdx, blockIdx, gridDim;

static inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }
static inline uint2 make_uint2(unsigned x, unsigned y) { return {x, y}; }
static inline unsigned min(unsigned a, unsigned b) { return a < b ? a : b; }
template <class To, class From> static inline To same_bits(From from) {
    To to;
    static_assert(sizeof to == sizeof from, "");
    memcpy(&to, &from, sizeof to);
    return to;
}
static inline int __float_as_int(float x) { return same_bits<int>(x); }
static inline unsigned __float_as_uint(float x) { return same_bits<unsigned>(x); }
static inline float __int_as_float(int x) { return same_bits<float>(x); }
static inline float __uint_as_float(unsigned x) { return same_bits<float>(x); }
static inline int __popc(unsigned x) { return __builtin_popcount(x); }
static inline int __ffs(unsigned x) { return __builtin_ffs(int(x)); }
static inline void __threadfence() {}
template <class T> static inline T __ldcg(const T* at) { return *at; }
static inline unsigned atomicAdd(unsigned* at, unsigned value) {
    const unsigned old = *at;
    *at = old + value;
    return old;
}

static inline unsigned atomicOr(unsigned* at, unsigned value) {
    const unsigned old = *at;
    *at = old | value;
    return old;
}

constexpr unsigned LANES = 32;
constexpr size_t STACK = 1 << 16;
enum State { RUNS, WAITS_FOR_WARP, WAITS_FOR_BLOCK, ENDED };
static State states[FIBERS];
static unsigned exchanged[FIBERS];
static jmp_buf places[FIBERS], scheduler;

static void wait_as(State state) {
    const unsigned self = threadIdx.x;
    states[self] = state;
    if (_setjmp(places[self]) == 0) _longjmp(scheduler, 1);
}
static void __syncthreads() { wait_as(WAITS_FOR_BLOCK); }
static void __syncwarp() { wait_as(WAITS_FOR_WARP); }
static bool __syncthreads_and(bool value) {
    const unsigned self = threadIdx.x;
    exchanged[self] = value;
    wait_as(WAITS_FOR_BLOCK);
    bool all = true;
    for (unsigned k = 0; k < FIBERS; ++k) all = all && exchanged[k];
    wait_as(WAITS_FOR_BLOCK);
    return all;
}
// What each lane of the warp gives; until the second wait nobody gives anything else.
template <class Read> static unsigned with_warp(unsigned value, Read read) {
    exchanged[threadIdx.x] = value;
    wait_as(WAITS_FOR_WARP);
    const unsigned result = read(exchanged + threadIdx.x / LANES * LANES);
    wait_as(WAITS_FOR_WARP);
    return result;
}
static unsigned __ballot_sync(unsigned, bool value) {
    return with_warp(value, [](const unsigned* lanes) {
        unsigned mask = 0;
        for (unsigned k = 0; k < LANES; ++k) mask |= (lanes[k] ? 1u : 0u) << k;
        return mask;
    });
}
static unsigned __match_any_sync(unsigned, unsigned value) {
    return with_warp(value, [value](const unsigned* lanes) {
        unsigned mask = 0;
        for (unsigned k = 0; k < LANES; ++k) mask |= (lanes[k] == value ? 1u : 0u) << k;
        return mask;
    });
}
static unsigned __shfl_up_sync(unsigned, unsigned value, unsigned step) {
    const unsigned lane = threadIdx.x % LANES;
    return with_warp(value, [=](const unsigned* lanes) {
        return lane < step ? value : lanes[lane - step];
    });
}
