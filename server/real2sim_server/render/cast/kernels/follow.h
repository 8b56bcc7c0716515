// Tracing rays through the Gaussians of their tile, from near to far.
#pragma once

#include "beams.h"

struct Echo {
    float last, power, ranges, shown;
};

struct Ray {
    float origin[3], direction[3];
};

// A ray of the sensor relative to a moving body.
__device__ __forceinline__ void place(
    const Sweep& sweep, uint32 motion, int slot, const float* direction, Ray& ray) {
    const float* f = sweep.origins + 12ull * (size_t(motion) * sweep.slot_count + uint32(slot));
    for (uint32 k = 0; k < 3; ++k) {
        const float* row = f + 4 * k;
        ray.origin[k] = row[3];
        ray.direction[k] = fmaf(row[0], direction[0], fmaf(row[1], direction[1], row[2] * direction[2]));
    }
}

__device__ __forceinline__ void whitened(const float* w, const float* v, float* out) {
    out[0] = w[0] * v[0];
    out[1] = fmaf(w[1], v[0], w[2] * v[1]);
    out[2] = fmaf(w[3], v[0], fmaf(w[4], v[1], w[5] * v[2]));
}

// Fraction of the light that a Gaussian absorbs, and its range; 0 without a hit.
__device__ __forceinline__ float meet(const Sweep& sweep, const Ray& ray, const Met& met, float& tau) {
    float off[3], start[3], along[3];
    for (uint32 k = 0; k < 3; ++k) off[k] = ray.origin[k] - met.mean[k];
    whitened(met.whitening, off, start);
    whitened(met.whitening, ray.direction, along);
    const float square = fmaf(along[0], along[0], fmaf(along[1], along[1], along[2] * along[2]));
    // |start x along|^2 / |along|^2 stays precise where |start|^2 - (start along)^2 / |along|^2
    // cancels.
    const float x = start[1] * along[2] - start[2] * along[1];
    const float y = start[2] * along[0] - start[0] * along[2];
    const float z = start[0] * along[1] - start[1] * along[0];
    const float exponent = 0.5f * fmaf(x, x, fmaf(y, y, z * z)) / square + met.level;
    tau = -fmaf(start[0], along[0], fmaf(start[1], along[1], start[2] * along[2])) / square;
    if (!(exponent <= LOG_255 && tau >= sweep.near_range && tau <= sweep.far_range)) return 0.0f;
    return fminf(expf(-exponent), ALPHA_MAX);
}

// Records an echo as first, strongest and last return if it is strong enough.
__device__ __forceinline__ void close_echo(const Echo& echo, float* found) {
    if (!(echo.power >= ECHO_MIN)) return;
    const float values[3] = {echo.ranges / echo.power, echo.power, echo.shown / echo.power};
    const bool is_first = found[1] <= 0.0f, is_strongest = echo.power > found[4];
    for (uint32 k = 0; k < 3; ++k) {
        if (is_first) found[k] = values[k];
        if (is_strongest) found[3 + k] = values[k];
        found[6 + k] = values[k];
    }
}

__device__ __forceinline__ void grow_echo(
    float tau, float power, float reflectivity, float pulse, Echo& echo, float* found) {
    if (echo.power > 0.0f && fabsf(tau - echo.last) > pulse) {
        close_echo(echo, found);
        echo.power = echo.ranges = echo.shown = 0.0f;
    }
    echo.last = tau;
    echo.power += power;
    echo.ranges = fmaf(power, tau, echo.ranges);
    echo.shown = fmaf(power, reflectivity, echo.shown);
}

// One thread per ray; a warp traces half of a tile.
extern "C" __global__ void __launch_bounds__(THREADS) follow(const Sweep* given, uint32) {
    const Sweep& sweep = *given;
    const uint32 tile = blockIdx.x * TILES_OF_BLOCK + threadIdx.x / TILE_RAYS;
    if (tile >= sweep.tiles) return;
    const uint32 r = threadIdx.x % TILE_RAYS, group = tile * GROUP + r / GROUP;
    const int index = sweep.rays[tile * TILE_RAYS + r], slot = sweep.slots[tile * TILE_RAYS + r];
    const float low = sweep.lows[group], high = sweep.highs[group];
    float direction[3], sums[3] = {0.0f, 0.0f, 0.0f}, found[9] = {0.0f};
    for (uint32 k = 0; k < 3; ++k)
        direction[k] = sweep.directions[(size_t(group) * 3 + k) * GROUP + r % GROUP];
    float light = 1.0f, median = 0.0f;
    int owner = -1, member = -1;
    uint32 motion = 0xffffffffu;
    Echo echo = {0.0f, 0.0f, 0.0f, 0.0f};
    Ray ray;
    bool goes_on = index >= 0;
    const int64 stop = sweep.starts[tile + 1];
    for (int64 position = sweep.starts[tile]; position < stop; ++position) {
        if (position % 8 == 0 && !__ballot_sync(ALL_LANES, goes_on)) break;
        const Met& met = sweep.met[sweep.lists[position]];
        if (!goes_on || high < met.low || low > met.high) continue;
        const uint32 own = sweep.bodies[met.body].motion;
        if (own != motion) place(sweep, motion = own, slot, direction, ray);
        float tau;
        const float weight = light * meet(sweep, ray, met, tau);
        if (!(weight > 0.0f)) continue;
        const float after = light - weight;
        sums[0] = fmaf(weight, tau, sums[0]);
        sums[1] = fmaf(weight, met.reflectivity, sums[1]);
        sums[2] = fmaf(weight, met.loss, sums[2]);
        if (light > HALF_LIGHT && after <= HALF_LIGHT)
            median = tau, owner = int(met.body), member = int(met.member);
        if (sweep.returns)
            grow_echo(tau, weight * light, met.reflectivity, sweep.pulse, echo, found);
        light = after;
        goes_on = light > LIGHT_MIN;
    }
    if (index < 0) return;
    const float stopped = 1.0f - light, share = stopped > 0.0f ? 1.0f / stopped : 0.0f;
    float* out = sweep.values + 5ull * uint32(index);
    out[0] = median, out[1] = sums[0] * share, out[2] = stopped;
    out[3] = sums[1] * share, out[4] = sums[2] * share;
    sweep.owners[2ull * uint32(index)] = owner;
    sweep.owners[2ull * uint32(index) + 1] = member;
    if (!sweep.returns) return;
    if (echo.power > 0.0f) close_echo(echo, found);
    for (uint32 k = 0; k < 9; ++k) sweep.returns[9ull * uint32(index) + k] = found[k];
}
