// A stable radix sort with 8 bits per pass, of splats by depth and of pairs by tile. Only the device
// knows the length of the list. Block b sorts the b-th part of the list. Equal keys keep their order,
// so the result does not depend on the order in which blocks run.
#pragma once

#include "frame.h"
#include "scan.h"

// Inputs and outputs of a pass. The argument of a launch is the pass, + 16 for pairs by tile.
struct Pass {
    const uint32 *keys, *values;
    uint32 *keys_out, *values_out;
    uint32 length, first, last, shift;
};

__device__ __forceinline__ Pass pass_of(const Frame& frame, uint32 argument) {
    const bool by_tile = argument & 16u;
    const uint32 number = argument & 15u, from = number & 1u;
    Pass pass;
    pass.keys = by_tile ? frame.tiles[from] : frame.depths[from];
    pass.values = by_tile ? frame.members[from] : frame.order[from];
    pass.keys_out = by_tile ? frame.tiles[from ^ 1u] : frame.depths[from ^ 1u];
    pass.values_out = by_tile ? frame.members[from ^ 1u] : frame.order[from ^ 1u];
    pass.length = frame.counters[by_tile ? PAIRS : SEEN];
    pass.shift = 8 * number;
    const uint32 chunks = (pass.length + THREADS - 1) / THREADS;
    const uint32 each = (chunks + frame.sort_blocks - 1) / frame.sort_blocks * THREADS;
    pass.first = min(blockIdx.x * each, pass.length);
    pass.last = min(pass.first + each, pass.length);
    return pass;
}

// Lanes of the warp with the same digit as this one. Lanes without a key have a separate digit.
__device__ __forceinline__ uint32 same_digit(const Pass& pass, uint32 index, uint32& digit) {
    digit = index < pass.last ? pass.keys[index] >> pass.shift & (DIGITS - 1) : DIGITS;
    return __match_any_sync(ALL_LANES, digit);
}

// Counts digits by block; the last block replaces counts with prefix sums over the blocks.
extern "C" __global__ void __launch_bounds__(THREADS) count_digits(
    const Frame* given, uint32 argument) {
    __shared__ uint32 counts[DIGITS];
    const Frame& frame = *given;
    const Pass pass = pass_of(frame, argument);
    const uint32 lane = threadIdx.x % WARP;
    counts[threadIdx.x] = 0;
    __syncthreads();
    for (uint32 first = pass.first; first < pass.last; first += THREADS) {
        uint32 digit;
        const uint32 same = same_digit(pass, first + threadIdx.x, digit);
        if (digit < DIGITS && bits_before(same, lane) == 0) atomicAdd(&counts[digit], __popc(same));
    }
    __syncthreads();
    frame.digit_counts[blockIdx.x * DIGITS + threadIdx.x] = counts[threadIdx.x];
    if (!is_last_block(frame.counters + TICKET)) return;
    uint32 sum = 0;
    for (uint32 block = 0; block < gridDim.x; ++block) {
        uint32* count = frame.digit_counts + block * DIGITS + threadIdx.x;
        const uint32 here = __ldcg(count);
        *count = sum;
        sum += here;
    }
    uint32 total;
    frame.digit_starts[threadIdx.x] = sum_before(sum, total);
}

// Scatters keys and values to the positions computed by count_digits.
extern "C" __global__ void __launch_bounds__(THREADS) scatter_digits(
    const Frame* given, uint32 argument) {
    __shared__ uint32 next[DIGITS], starts[WARPS][DIGITS];
    const Frame& frame = *given;
    const Pass pass = pass_of(frame, argument);
    const uint32 lane = threadIdx.x % WARP, warp = threadIdx.x / WARP;
    next[threadIdx.x] = frame.digit_starts[threadIdx.x] +
                        frame.digit_counts[blockIdx.x * DIGITS + threadIdx.x];
    for (uint32 first = pass.first; first < pass.last; first += THREADS) {
        for (uint32 w = 0; w < WARPS; ++w) starts[w][threadIdx.x] = 0;
        __syncthreads();
        const uint32 index = first + threadIdx.x;
        uint32 digit;
        const uint32 same = same_digit(pass, index, digit);
        const uint32 rank = bits_before(same, lane);
        if (digit < DIGITS && rank == 0) starts[warp][digit] = __popc(same);
        __syncthreads();
        uint32 at = next[threadIdx.x];
        for (uint32 w = 0; w < WARPS; ++w) {
            const uint32 count = starts[w][threadIdx.x];
            starts[w][threadIdx.x] = at;
            at += count;
        }
        next[threadIdx.x] = at;
        __syncthreads();
        if (digit < DIGITS) {
            const uint32 to = starts[warp][digit] + rank;
            pass.keys_out[to] = pass.keys[index];
            pass.values_out[to] = pass.values[index];
        }
        __syncthreads();
    }
}
