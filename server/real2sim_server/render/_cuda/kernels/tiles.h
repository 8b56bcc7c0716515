// The list of each tile. Each splat has a pair for each tile that it touches. Pairs are created in
// depth order, then stably sorted by tile, so each tile's list is ordered near to far.
#pragma once

#include "frame.h"
#include "scan.h"

// Tiles that a box of Frame::boxes covers.
__device__ __forceinline__ uint32 tiles_of(uint2 box) {
    return ((box.y & 1023u) + 1) * ((box.y >> 10 & 1023u) + 1);
}

// Counts the tiles of each piece of sorted splats. One block per piece of the splat capacity.
extern "C" __global__ void __launch_bounds__(THREADS) count_pairs(const Frame* given, uint32) {
    const Frame& frame = *given;
    uint32 sum = 0;
    for (uint32 part = 0; part < PARTS; ++part) {
        const uint32 index = blockIdx.x * PIECE + part * THREADS + threadIdx.x;
        if (index < frame.counters[SEEN]) sum += tiles_of(frame.boxes[frame.order[0][index]]);
    }
    uint32 total;
    sum_before(sum, total);
    if (threadIdx.x == 0) frame.pair_starts[blockIdx.x] = total;
    if (!is_last_block(frame.counters + TICKET)) return;
    const uint32 all = sums_of_list(frame.pair_starts, gridDim.x);
    if (threadIdx.x == 0) {
        frame.counters[PAIRS_WANTED] = all;
        frame.counters[PAIRS] = min(all, frame.pair_capacity);
    }
}

// Writes the pairs, evenly distributed over threads even if one splat touches many tiles.
extern "C" __global__ void __launch_bounds__(THREADS) make_pairs(const Frame* given, uint32) {
    __shared__ uint32 starts[PIECE];
    const Frame& frame = *given;
    const uint32 seen = frame.counters[SEEN], first = blockIdx.x * PIECE;
    if (first >= seen) return;
    uint32 counts[PARTS], sum = 0;
    for (uint32 part = 0; part < PARTS; ++part) {
        const uint32 index = first + threadIdx.x * PARTS + part;
        counts[part] = index < seen ? tiles_of(frame.boxes[frame.order[0][index]]) : 0;
        sum += counts[part];
    }
    uint32 total;
    uint32 before = sum_before(sum, total);
    for (uint32 part = 0; part < PARTS; ++part) {
        starts[threadIdx.x * PARTS + part] = before;
        before += counts[part];
    }
    __syncthreads();
    const uint32 base = frame.pair_starts[blockIdx.x];
    for (uint32 pair = threadIdx.x; pair < total; pair += THREADS) {
        if (pair >= frame.pair_capacity - min(base, frame.pair_capacity)) break;
        uint32 low = 0, high = min(PIECE, seen - first);
        while (high - low > 1) {
            const uint32 middle = (low + high) / 2;
            if (starts[middle] <= pair) low = middle;
            else high = middle;
        }
        const uint32 slot = frame.order[0][first + low], local = pair - starts[low];
        const uint2 box = frame.boxes[slot];
        const uint32 width = (box.y & 1023u) + 1, stride = (box.y >> 20) + 1;
        frame.tiles[0][base + pair] = box.x + local / width * stride + local % width;
        frame.members[0][base + pair] = slot;
    }
}

// Finds the start and end of each tile's list.
extern "C" __global__ void __launch_bounds__(THREADS) find_ranges(const Frame* given, uint32) {
    const Frame& frame = *given;
    const uint32 pairs = frame.counters[PAIRS];
    const uint32* tiles = frame.tiles[frame.tile_passes & 1u];
    for (uint32 i = blockIdx.x * THREADS + threadIdx.x; i < pairs; i += gridDim.x * THREADS) {
        const uint32 tile = tiles[i];
        if (i == 0 || tiles[i - 1] != tile) frame.tile_ranges[tile].x = i;
        if (i + 1 == pairs || tiles[i + 1] != tile) frame.tile_ranges[tile].y = i + 1;
    }
}
