// Visible Gaussians of each camera, and their splats as a compact list. Splats of a camera keep the
// order of objects and Gaussians, which breaks depth ties.
#pragma once

#include "project.h"
#include "scan.h"

// The object of a piece.
__device__ __forceinline__ const Object& object_of(const Frame& frame, uint32 piece) {
    uint32 low = 0, high = frame.object_count;
    while (high - low > 1) {
        const uint32 middle = (low + high) / 2;
        if (frame.objects[middle].first_piece <= piece) low = middle;
        else high = middle;
    }
    return frame.objects[low];
}

// Marks and counts the Gaussians of a piece that each camera sees. One block per piece.
extern "C" __global__ void __launch_bounds__(THREADS) find_seen(const Frame* given, uint32) {
    __shared__ uint32 seen[MAX_CAMERAS];
    const Frame& frame = *given;
    for (uint32 tile = blockIdx.x * THREADS + threadIdx.x; tile < frame.tile_count;
         tile += gridDim.x * THREADS)
        frame.tile_ranges[tile] = make_uint2(0, 0);
    if (blockIdx.x < frame.pieces) {
        const Object& object = object_of(frame, blockIdx.x);
        const uint32 piece = blockIdx.x - object.first_piece;
        const uint32 entry = object.first_entry + piece * object.cameras;
        if (threadIdx.x < MAX_CAMERAS) seen[threadIdx.x] = 0;
        __syncthreads();
        for (uint32 part = 0; part < PARTS; ++part) {
            const uint32 index = piece * PIECE + part * THREADS + threadIdx.x;
            const bool there = index < object.count;
            Gaussian g;
            if (there) g = gaussian_of(object, index);
            for (uint32 c = 0; c < object.cameras; ++c) {
                Splat splat;
                const bool hit = there && project(
                    frame, frame.cameras[object.first_camera + c],
                    frame.placements[object.first_placement + c], g, object.covars, splat);
                const uint32 mask = __ballot_sync(ALL_LANES, hit);
                if (threadIdx.x % WARP == 0) {
                    frame.seen_masks[(entry + c) * WORDS + part * WARPS + threadIdx.x / WARP] = mask;
                    atomicAdd(&seen[c], __popc(mask));
                }
            }
        }
        __syncthreads();
        if (threadIdx.x < object.cameras) frame.entry_starts[entry + threadIdx.x] = seen[threadIdx.x];
    }
    if (!is_last_block(frame.counters + TICKET)) return;
    const uint32 total = sums_of_list(frame.entry_starts, frame.entries);
    if (threadIdx.x == 0) {
        frame.counters[SEEN_WANTED] = total;
        frame.counters[SEEN] = min(total, frame.seen_capacity);
    }
}

__device__ __forceinline__ void store(
    const Frame& frame, const Object& object, const Camera& camera, const Splat& splat,
    const float* rgb, uint32 slot) {
    const uint32 ids = object.instance | uint32(object.semantic) << 16;
    float4* out = frame.splats + 3ull * slot;
    out[0] = make_float4(splat.x, splat.y, 0.5f * splat.conic[0], splat.conic[1]);
    out[1] = make_float4(0.5f * splat.conic[2], splat.opacity, splat.limit, splat.depth);
    out[2] = make_float4(rgb[0], rgb[1], rgb[2], __uint_as_float(ids));
    frame.boxes[slot] = make_uint2(
        splat.first_tile,
        (splat.tiles_x - 1) | (splat.tiles_y - 1) << 10 | (camera.tiles_x - 1) << 20);
    frame.depths[0][slot] = __float_as_uint(splat.depth);
    frame.order[0][slot] = slot;
}

// Writes the splats of the Gaussians marked by find_seen. One block per piece.
extern "C" __global__ void __launch_bounds__(THREADS) project_seen(const Frame* given, uint32) {
    __shared__ uint32 before[WORDS];
    const Frame& frame = *given;
    const Object& object = object_of(frame, blockIdx.x);
    const uint32 piece = blockIdx.x - object.first_piece;
    const uint32 lane = threadIdx.x % WARP, warp = threadIdx.x / WARP;
    for (uint32 c = 0; c < object.cameras; ++c) {
        const uint32 entry = object.first_entry + piece * object.cameras + c;
        const uint32 start = frame.entry_starts[entry];
        if (frame.entry_starts[entry + 1] == start) continue;
        const uint32* masks = frame.seen_masks + entry * WORDS;
        if (warp == 0) {
            const uint32 count = __popc(masks[lane]);
            uint32 inclusive = count;
            for (uint32 step = 1; step < WARP; step *= 2) {
                const uint32 other = __shfl_up_sync(ALL_LANES, inclusive, step);
                if (lane >= step) inclusive += other;
            }
            before[lane] = inclusive - count;
        }
        __syncthreads();
        const Camera& camera = frame.cameras[object.first_camera + c];
        const Placement& at = frame.placements[object.first_placement + c];
        for (uint32 part = 0; part < PARTS; ++part) {
            const uint32 word = part * WARPS + warp, mask = masks[word];
            const uint32 slot = start + before[word] + bits_before(mask, lane);
            if (!(mask >> lane & 1u) || slot >= frame.seen_capacity) continue;
            const uint32 index = piece * PIECE + part * THREADS + threadIdx.x;
            const Gaussian g = gaussian_of(object, index);
            Splat splat;
            project(frame, camera, at, g, object.covars, splat);
            float rgb[3];
            colour_of(object, at, g.mean, index, rgb);
            store(frame, object, camera, splat, rgb, slot);
        }
        __syncthreads();
    }
}
