// Front-to-back blending of all images in one launch, composited over the sky, and their final
// pixel values.
#pragma once

#include "arithmetic.h"
#include "frame.h"
#include "project.h"

constexpr float ALPHA_MAX = 0.999f;
constexpr float TRANSMITTANCE_MIN = 1e-4f;
constexpr uint32 WARP_LINES = WARP / TILE;  // rows of pixels per warp

struct Pixel {
    float rgb[3];
    float transmittance;
    float weighted_depth;
    float median;
    uint32 ids;  // instance in the low, semantic in the high 16 bits
};

__device__ __forceinline__ const Camera& camera_of(const Frame& frame, uint32 tile) {
    uint32 low = 0, high = frame.camera_count;
    while (high - low > 1) {
        const uint32 middle = (low + high) / 2;
        if (frame.cameras[middle].first_tile <= tile) low = middle;
        else high = middle;
    }
    return frame.cameras[low];
}

// Bilinear colour of the cube map along a world direction; faces and axes as in scene/sky.py.
__device__ __forceinline__ void sky_colour(const Camera& camera, float x, float y, float z, float* rgb) {
    const float ax = fabsf(x), ay = fabsf(y), az = fabsf(z);
    const bool on_x = ax >= ay && ax >= az, on_y = !on_x && ay >= az;
    const float major = on_x ? ax : on_y ? ay : az;
    const uint32 face = on_x ? (x > 0 ? 0 : 1) : on_y ? (y > 0 ? 2 : 3) : (z > 0 ? 4 : 5);
    const float u = (on_x ? (x > 0 ? -y : y) : on_y ? (y > 0 ? x : -x) : -y) / major;
    const float v = (on_x || on_y ? -z : (z > 0 ? x : -x)) / major;
    const float side = float(camera.sky_resolution), last = side - 1.0f;
    const float column = fminf(fmaxf((u + 1.0f) / 2.0f * side - 0.5f, 0.0f), last);
    const float row = fminf(fmaxf((v + 1.0f) / 2.0f * side - 0.5f, 0.0f), last);
    const uint32 c0 = uint32(column), r0 = uint32(row), end = camera.sky_resolution - 1;
    const uint32 c1 = min(c0 + 1, end), r1 = min(r0 + 1, end);
    const float fc = column - float(c0), fr = row - float(r0);
    const float* faces = camera.sky + 3ull * face * camera.sky_resolution * camera.sky_resolution;
    for (uint32 k = 0; k < 3; ++k) {
        const float* upper = faces + 3ull * r0 * camera.sky_resolution + k;
        const float* lower = faces + 3ull * r1 * camera.sky_resolution + k;
        const float top = upper[3 * c0] * (1 - fc) + upper[3 * c1] * fc;
        const float bottom = lower[3 * c0] * (1 - fc) + lower[3 * c1] * fc;
        rgb[k] = top * (1 - fr) + bottom * fr;
    }
}

// Composites the pixel over sky or background and writes the requested images.
__device__ __forceinline__ void write_pixel(
    const Frame& frame, const Camera& camera, const Pixel& pixel, uint32 x, uint32 y) {
    const size_t at = camera.first_pixel + size_t(y) * camera.width + x;
    const float alpha = 1.0f - pixel.transmittance;
    float behind[3] = {camera.background[0], camera.background[1], camera.background[2]};
    if (camera.sky && (frame.rgb || frame.bytes)) {
        const float px = float(x) + 0.5f, py = float(y) + 0.5f;
        const float* d = camera.directions;
        sky_colour(
            camera, px * d[0] + py * d[1] + d[2], px * d[3] + py * d[4] + d[5],
            px * d[6] + py * d[7] + d[8], behind);
    }
    for (uint32 k = 0; k < 3; ++k) {
        const float value = pixel.rgb[k] + pixel.transmittance * behind[k];
        if (frame.rgb) frame.rgb[3 * at + k] = value;
        if (frame.bytes)
            frame.bytes[3 * at + k] = uint8(fminf(fmaxf(value, 0.0f), 1.0f) * 255.0f + 0.5f);
    }
    const float depth = alpha > 0.0f ? pixel.weighted_depth / alpha : 0.0f;
    if (frame.alpha) frame.alpha[at] = alpha;
    if (frame.depth) frame.depth[at] = depth;
    if (frame.solid) frame.solid[at] = alpha >= 0.5f ? depth : 0.0f;
    if (frame.median) frame.median[at] = pixel.median;
    if (frame.instance) frame.instance[at] = uint16(pixel.ids);
    if (frame.semantic)
        frame.semantic[at] = uint8(pixel.transmittance <= 0.5f ? pixel.ids >> 16 : camera.behind);
}

// Whether a splat may touch the pixels of a warp, whose centres extend from (x_low, y_low) by TILE - 1
// to the right and by WARP_LINES - 1 down. Conservative because of rounding.
__device__ __forceinline__ bool may_touch(float4 a, float4 b, float x_low, float y_low) {
    const float product = 4.0f * a.z * b.x;
    const float determinant = product - a.w * a.w - 1e-6f * product;  // lower bound of that of the conic
    const float dx = fmaxf(fmaxf(x_low - a.x, a.x - (x_low + float(TILE - 1))), 0.0f);
    const float dy = fmaxf(fmaxf(y_low - a.y, a.y - (y_low + float(WARP_LINES - 1))), 0.0f);
    const float reach = 4.0f * b.z;
    return !(dx * dx * determinant > reach * b.x || dy * dy * determinant > reach * a.z);
}

// Blends a splat into a pixel; returns false if the pixel is finished.
__device__ __forceinline__ bool add_splat(
    float4 a, float4 b, const float4& c, float px, float py, Pixel& pixel) {
    const float dx = px - a.x, dy = py - a.y;
    const float sigma = fmaf(dx, fmaf(a.z, dx, a.w * dy), b.x * dy * dy);
    if (sigma < 0.0f || sigma > b.z) return true;
    const float alpha = fminf(b.y * exp_negative(sigma), ALPHA_MAX);
    if (alpha < ALPHA_MIN) return true;
    const float after = pixel.transmittance * (1.0f - alpha);
    if (after <= TRANSMITTANCE_MIN) return false;
    const float weight = alpha * pixel.transmittance;
    pixel.rgb[0] = fmaf(weight, c.x, pixel.rgb[0]);
    pixel.rgb[1] = fmaf(weight, c.y, pixel.rgb[1]);
    pixel.rgb[2] = fmaf(weight, c.z, pixel.rgb[2]);
    pixel.weighted_depth = fmaf(weight, b.w, pixel.weighted_depth);
    if (pixel.transmittance > 0.5f && after <= 0.5f) {
        pixel.median = b.w;
        pixel.ids = __float_as_uint(c.w);
    }
    pixel.transmittance = after;
    return true;
}

// One block per tile of any camera, one thread per pixel.
extern "C" __global__ void __launch_bounds__(THREADS) blend(const Frame* given, uint32) {
    __shared__ float4 first[THREADS], second[THREADS], third[THREADS];
    const Frame& frame = *given;
    if (blockIdx.x == 0 && threadIdx.x < COUNTERS)
        frame.report[threadIdx.x] = frame.counters[threadIdx.x];
    const Camera& camera = camera_of(frame, blockIdx.x);
    const uint32 tile = blockIdx.x - camera.first_tile;
    const uint32 x = tile % camera.tiles_x * TILE + threadIdx.x % TILE;
    const uint32 y = tile / camera.tiles_x * TILE + threadIdx.x / TILE;
    const bool inside = x < camera.width && y < camera.height;
    const float px = float(x) + 0.5f, py = float(y) + 0.5f;
    const uint32 lane = threadIdx.x % WARP;
    const float x_low = float(x - threadIdx.x % TILE) + 0.5f;
    const float y_low = float(y - threadIdx.x / TILE % WARP_LINES) + 0.5f;
    const uint32* members = frame.members[frame.tile_passes & 1u];
    const uint2 range = frame.tile_ranges[blockIdx.x];
    Pixel pixel = {{0.0f, 0.0f, 0.0f}, 1.0f, 0.0f, 0.0f, 0};
    bool done = !inside;
    for (uint32 start = range.x; start < range.y; start += THREADS) {
        if (__syncthreads_and(done)) break;
        const uint32 index = start + threadIdx.x;
        if (index < range.y) {
            const float4* splat = frame.splats + 3ull * members[index];
            first[threadIdx.x] = splat[0];
            second[threadIdx.x] = splat[1];
            third[threadIdx.x] = splat[2];
        }
        __syncthreads();
        const uint32 count = min(THREADS, range.y - start);
        for (uint32 group = 0; group < count; group += WARP) {
            if (!__ballot_sync(ALL_LANES, !done)) break;
            const uint32 mine = group + lane;
            const bool near = mine < count && may_touch(first[mine], second[mine], x_low, y_low);
            // Each lane has tested one splat for the whole warp.
            for (uint32 left = __ballot_sync(ALL_LANES, near); left && !done; left &= left - 1) {
                const uint32 j = group + __ffs(left) - 1;
                done = !add_splat(first[j], second[j], third[j], px, py, pixel);
            }
        }
    }
    if (inside) write_pixel(frame, camera, pixel, x, y);
}
