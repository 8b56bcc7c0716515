// Prefix sums over a block, and over a list by the last block to finish.
#pragma once

#include "arithmetic.h"

// Exclusive prefix sum over the threads of a block; `total` is the sum over all threads.
__device__ __forceinline__ uint32 sum_before(uint32 value, uint32& total) {
    __shared__ uint32 of_warps[WARPS];
    const uint32 lane = threadIdx.x % WARP, warp = threadIdx.x / WARP;
    uint32 inclusive = value;
    for (uint32 step = 1; step < WARP; step *= 2) {
        const uint32 other = __shfl_up_sync(ALL_LANES, inclusive, step);
        if (lane >= step) inclusive = saturating_sum(inclusive, other);
    }
    const uint32 before_in_warp = __shfl_up_sync(ALL_LANES, inclusive, 1);
    if (lane == WARP - 1) of_warps[warp] = inclusive;
    __syncthreads();
    uint32 before = lane > 0 ? before_in_warp : 0;
    total = 0;
    for (uint32 w = 0; w < WARPS; ++w) {
        if (w < warp) before = saturating_sum(before, of_warps[w]);
        total = saturating_sum(total, of_warps[w]);
    }
    __syncthreads();
    return before;
}

// Whether all other blocks of the launch are done; their output can then be read with __ldcg.
__device__ __forceinline__ bool is_last_block(uint32* ticket) {
    __shared__ bool last;
    __threadfence();
    __syncthreads();
    if (threadIdx.x == 0) last = atomicAdd(ticket, 1u) == gridDim.x - 1;
    __syncthreads();
    if (!last) return false;
    __threadfence();
    if (threadIdx.x == 0) *ticket = 0;
    return true;
}

// Replaces counts [length] with exclusive prefix sums; counts[length] receives the total.
__device__ __forceinline__ uint32 sums_of_list(uint32* counts, uint32 length) {
    const uint32 each = (length + THREADS - 1) / THREADS;
    const uint32 first = min(threadIdx.x * each, length), last = min(first + each, length);
    uint32 sum = 0;
    for (uint32 i = first; i < last; ++i) sum = saturating_sum(sum, __ldcg(counts + i));
    uint32 total;
    uint32 before = sum_before(sum, total);
    for (uint32 i = first; i < last; ++i) {
        const uint32 count = __ldcg(counts + i);
        counts[i] = before;
        before = saturating_sum(before, count);
    }
    if (threadIdx.x == 0) counts[length] = total;
    return total;
}
