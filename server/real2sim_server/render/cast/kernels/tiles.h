// Tiles of rays that may hit each Gaussian, and the lists of the tiles.
#pragma once

#include "prepare.h"

// Calls a function for every tile of a footprint, and returns the number of tiles.
template <class Meet>
__device__ __forceinline__ int64 visit(const Sweep& sweep, int64 footprint, Meet meet) {
    const int64 last_band = footprint >> 8 & 255;
    const int first = int(footprint >> 16 & 8191), last = int(footprint >> 29 & 8191);
    const int side = int(footprint >> 42);
    int64 met = 0;
    for (int64 band = footprint & 255; band <= last_band; ++band) {
        const int* first_tiles = sweep.first_tiles + band * AZIMUTH_BINS;
        int64 stop = sweep.band_starts[band + 1];
        int begin = first, end = last < AZIMUTH_BINS ? last : AZIMUTH_BINS - 1;
        for (uint32 part = 0; part < 2 && end >= 0; ++part) {
            // Beyond +-pi, skip tiles that the first part has already visited.
            if (part == 1 && first > 0 && first_tiles[first] < stop) stop = first_tiles[first];
            for (int64 tile = first_tiles[begin]; tile < stop && sweep.tile_lows[tile] <= end; ++tile)
                if ((side == 0 || sweep.sides[tile] == side) && sweep.tile_highs[tile] >= begin)
                    meet(tile, met++);
            begin = 0, end = last - AZIMUTH_BINS;
        }
    }
    return met;
}

// One thread per Gaussian: its one or two records, and the number of tiles of each.
extern "C" __global__ void __launch_bounds__(THREADS, 2) prepare(const Sweep* given, uint32) {
    const Sweep& sweep = *given;
    const uint32 g = blockIdx.x * THREADS + threadIdx.x;
    if (g >= sweep.gaussians) return;
    const Body& body = body_of(sweep, g);
    const uint32 i = g - body.first;
    Met met;
    Angles angles;
    for (uint32 k = 0; k < 3; ++k) {
        const double* own = body.linear + 3 * k;
        const float* at = body.means + 3ull * i;
        met.mean[k] = float(own[0] * at[0] + own[1] * at[1] + own[2] * at[2] + body.offset[k]);
    }
    met.body = uint32(&body - sweep.bodies), met.member = i;
    met.reflectivity = body.attributes ? body.attributes[2ull * i] : 0.5f;
    met.loss = body.attributes ? body.attributes[2ull * i + 1] : 0.0f;
    const bool seamless = sweep.seam >= NO_SEAM || (body.speed == 0.0f && body.turn == 0.0f);
    for (uint32 k = 0; k < 2; ++k) sweep.counts[2ull * g + k] = 0;
    bool parted = false;
    for (uint32 side = 0; side < 3; ++side) {
        const size_t slot = 2ull * g + (side == 2);
        const bool seen = prepare_one(sweep, body, i, met.mean, side, met, angles);
        if (side == 0) parted = seen && !seamless && near_seam(sweep, angles);
        if (seen && (side > 0 || !parted)) {
            const int64 footprint = footprint_of(sweep, angles, side);
            sweep.met[slot] = met;
            sweep.footprints[slot] = footprint;
            sweep.depths[slot] = angles.distance;
            if (footprint >= 0) sweep.counts[slot] = visit(sweep, footprint, [](int64, int64) {});
        }
        if (!parted) break;
    }
}

// One thread per record: a pair for each of its tiles. Counts are prefix sums by now.
extern "C" __global__ void __launch_bounds__(THREADS) list_tiles(const Sweep* given, uint32) {
    const Sweep& sweep = *given;
    const size_t slot = size_t(blockIdx.x) * THREADS + threadIdx.x;
    if (slot >= 2ull * sweep.gaussians) return;
    const int64 begin = slot ? sweep.counts[slot - 1] : 0;
    if (sweep.counts[slot] == begin) return;
    const int64 depth = __float_as_int(sweep.depths[slot]);
    visit(sweep, sweep.footprints[slot], [&](int64 tile, int64 k) {
        sweep.keys[begin + k] = tile << 32 | depth;
        sweep.members[begin + k] = int(slot);
    });
}
