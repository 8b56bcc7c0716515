// From the cloud frame to the image plane: EWA splatting (Zwicker et al. 2001) as in gsplat 1.5.3
// and _reference.py.
#pragma once

#include "arithmetic.h"
#include "frame.h"

constexpr float ALPHA_MIN = 1.0f / 255.0f;

struct Gaussian {
    float mean[3];
    float shape[9];  // columns: axes times standard deviations; or rows of the covariance
    float opacity;
};

// A Gaussian on the image plane.
struct Splat {
    float x, y;             // centre [px]
    float conic[3];         // inverse covariance: xx, xy, yy [px^-2]
    float opacity;
    float limit;            // exponent beyond which the splat is skipped
    float depth;            // [m]
    uint32 first_tile;      // index within the frame
    uint32 tiles_x, tiles_y;
};

__device__ __forceinline__ Gaussian gaussian_of(const Object& object, uint32 index) {
    Gaussian g;
    for (uint32 k = 0; k < 3; ++k) g.mean[k] = object.means[3ull * index + k];
    g.opacity = object.opacities[index];
    if (object.covars) {
        const float* covar = object.covars + 9ull * index;
        for (uint32 row = 0; row < 3; ++row)
            for (uint32 k = 0; k < 3; ++k)
                g.shape[3 * row + k] = 0.5f * (covar[3 * row + k] + covar[3 * k + row]);
        return g;
    }
    const float* quat = object.quats + 4ull * index;
    float w = quat[0], x = quat[1], y = quat[2], z = quat[3];
    const float length = fmaxf(sqrtf(w * w + x * x + y * y + z * z), 1e-12f);
    w /= length;
    x /= length;
    y /= length;
    z /= length;
    const float sx = object.scales[3ull * index], sy = object.scales[3ull * index + 1],
                sz = object.scales[3ull * index + 2];
    g.shape[0] = (1 - 2 * (y * y + z * z)) * sx;
    g.shape[1] = 2 * (x * y - w * z) * sy;
    g.shape[2] = 2 * (x * z + w * y) * sz;
    g.shape[3] = 2 * (x * y + w * z) * sx;
    g.shape[4] = (1 - 2 * (x * x + z * z)) * sy;
    g.shape[5] = 2 * (y * z - w * x) * sz;
    g.shape[6] = 2 * (x * z - w * y) * sx;
    g.shape[7] = 2 * (y * z + w * x) * sy;
    g.shape[8] = (1 - 2 * (x * x + y * y)) * sz;
    return g;
}

__device__ __forceinline__ float dot3(const float* a, const float* b) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

// Vector from the camera to the Gaussian, in the unscaled cloud frame.
__device__ __forceinline__ void offset_from_eye(const Placement& at, const float* mean, float* out) {
    for (uint32 k = 0; k < 3; ++k) out[k] = (mean[k] - at.eye[k]) - at.eye_rest[k];
}

// Covariance on the image before blur [px^2]: xx, xy, yy, and its determinant.
__device__ __forceinline__ void flatten(
    const Gaussian& g, bool is_covariance, const float* u, const float* v, float* flat) {
    float a[3], b[3];
    if (is_covariance) {
        for (uint32 k = 0; k < 3; ++k) {
            a[k] = dot3(g.shape + 3 * k, u);
            b[k] = dot3(g.shape + 3 * k, v);
        }
        flat[0] = dot3(u, a);
        flat[1] = dot3(v, a);
        flat[2] = dot3(v, b);
        flat[3] = fmaxf(flat[0] * flat[2] - flat[1] * flat[1], 0.0f);
        return;
    }
    for (uint32 k = 0; k < 3; ++k) {
        a[k] = u[0] * g.shape[k] + u[1] * g.shape[3 + k] + u[2] * g.shape[6 + k];
        b[k] = v[0] * g.shape[k] + v[1] * g.shape[3 + k] + v[2] * g.shape[6 + k];
    }
    flat[0] = dot3(a, a);
    flat[1] = dot3(a, b);
    flat[2] = dot3(b, b);
    const float p = a[1] * b[2] - a[2] * b[1], q = a[2] * b[0] - a[0] * b[2],
                r = a[0] * b[1] - a[1] * b[0];
    flat[3] = p * p + q * q + r * r;
}

// Tiles along one axis that [centre - extent, centre + extent] touches; `count` may be 0.
__device__ __forceinline__ void touched_tiles(
    float centre, float extent, uint32 size, uint32 tiles, uint32& first, uint32& count) {
    count = 0;
    if (!(centre + extent >= 0.0f && centre - extent <= float(size))) return;
    const float last = float(tiles - 1);
    first = uint32(fminf(fmaxf(floorf((centre - extent) / float(TILE)), 0.0f), last));
    count = uint32(fminf(fmaxf(floorf((centre + extent) / float(TILE)), 0.0f), last)) - first + 1;
}

// Projects the Gaussian for `camera`; returns false if it is not visible.
__device__ __forceinline__ bool project(
    const Frame& frame, const Camera& camera, const Placement& at, const Gaussian& g,
    bool is_covariance, Splat& out) {
    const double* row = at.depth_row;
    const double depth =
        ((row[0] * double(g.mean[0]) + row[1] * double(g.mean[1])) + row[2] * double(g.mean[2])) +
        row[3];
    const float z = float(depth);
    if (!(z >= frame.near_plane && z <= frame.far_plane && g.opacity >= ALPHA_MIN)) return false;
    float offset[3];
    offset_from_eye(at, g.mean, offset);
    const float tx = dot3(at.linear, offset) / z, ty = dot3(at.linear + 3, offset) / z;
    const float hx = fminf(fmaxf(tx, camera.lowest[0]), camera.highest[0]);
    const float hy = fminf(fmaxf(ty, camera.lowest[1]), camera.highest[1]);
    const float fx = camera.focal[0] / z, fy = camera.focal[1] / z;
    float u[3], v[3];
    for (uint32 k = 0; k < 3; ++k) {
        u[k] = fx * (at.linear[k] - hx * at.linear[6 + k]);
        v[k] = fy * (at.linear[3 + k] - hy * at.linear[6 + k]);
    }
    float flat[4];
    flatten(g, is_covariance, u, v, flat);
    const float eps = frame.eps2d;
    const float xx = flat[0] + eps, yy = flat[2] + eps;
    const float determinant = flat[3] + eps * (flat[0] + flat[2]) + eps * eps;
    if (!(determinant > 0.0f)) return false;
    out.opacity = g.opacity;
    if (frame.antialiased) out.opacity *= sqrtf(fmaxf(flat[3] / determinant, 1e-30f));
    if (!(out.opacity >= ALPHA_MIN)) return false;
    out.limit = log_of(fmaxf(out.opacity / ALPHA_MIN, 1.0f));
    const float reach = sqrtf(2.0f * out.limit);
    const float ex = reach * sqrtf(xx), ey = reach * sqrtf(yy);
    if (!(ceilf(ex) > frame.radius_clip || ceilf(ey) > frame.radius_clip)) return false;
    out.x = camera.focal[0] * tx + camera.centre[0];
    out.y = camera.focal[1] * ty + camera.centre[1];
    uint32 column = 0, line = 0;
    touched_tiles(out.x, ex, camera.width, camera.tiles_x, column, out.tiles_x);
    touched_tiles(out.y, ey, camera.height, camera.tiles_y, line, out.tiles_y);
    if (out.tiles_x == 0 || out.tiles_y == 0) return false;
    out.first_tile = camera.first_tile + line * camera.tiles_x + column;
    out.conic[0] = yy / determinant;
    out.conic[1] = -flat[1] / determinant;
    out.conic[2] = xx / determinant;
    out.depth = z;
    return true;
}

// Colour in the viewing direction: spherical harmonics, plus the time-dependent part of the
// constant term.
__device__ __forceinline__ void colour_of(
    const Object& object, const Placement& at, const float* mean, uint32 index, float* rgb) {
    float d[3];
    offset_from_eye(at, mean, d);
    for (uint32 k = 0; k < 3; ++k) d[k] *= object.scale[k];
    const float length = fmaxf(sqrtf(dot3(d, d)), 1e-12f);
    const float x = d[0] / length, y = d[1] / length, z = d[2] / length;
    const float xx = x * x, yy = y * y, zz = z * z;
    const float basis[16] = {
        0.2820947917738781f, -0.48860251190292f * y, 0.48860251190292f * z, -0.48860251190292f * x,
        1.092548430592079f * x * y, -1.092548430592079f * y * z,
        0.9461746957575601f * zz - 0.3153915652525201f, -1.092548430592079f * x * z,
        0.5462742152960395f * (xx - yy), -0.5900435899266435f * y * (3 * xx - yy),
        2.890611442640554f * x * y * z, -0.4570457994644658f * y * (5 * zz - 1),
        0.3731763325901154f * z * (5 * zz - 3), -0.4570457994644658f * x * (5 * zz - 1),
        1.445305721320277f * z * (xx - yy), -0.5900435899266435f * x * (xx - 3 * yy)};
    const float* sh = object.sh + 3ull * object.functions * index;
    float sum[3] = {sh[0], sh[1], sh[2]};
    if (object.colour) {
        const float* colour = object.colour + 3ull * object.tone_count * index;
        for (uint32 f = 0; f < object.tone_count; ++f)
            for (uint32 c = 0; c < 3; ++c) sum[c] += colour[3 * f + c] * object.tones[f];
    }
    for (uint32 c = 0; c < 3; ++c) sum[c] *= basis[0];
#pragma unroll
    for (uint32 k = 1; k < 16; ++k)
        if (k < object.functions)
            for (uint32 c = 0; c < 3; ++c) sum[c] += basis[k] * sh[3 * k + c];
    for (uint32 c = 0; c < 3; ++c) rgb[c] = fmaxf(sum[c] + 0.5f, 0.0f);
}
