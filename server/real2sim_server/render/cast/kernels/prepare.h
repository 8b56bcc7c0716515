// Whitening of each Gaussian, and the range of angles at which rays may hit it.
#pragma once

#include "beams.h"

constexpr float SLACK = 2e-4f;           // margin of angles against rounding [rad]
constexpr float NEARLY_INSIDE = 0.05f;   // see tangents
constexpr float POLE = 1.5f;             // elevation beyond which azimuths are undefined [rad]
constexpr float BEYOND = 4.0f;
constexpr float NO_SEAM = 3.5f;
constexpr double LEAST = 1e-24;

struct Angles {
    float left, right, low, high;  // [rad]
    float gain;                    // upper bound of its angular speed relative to the sensor [rad/s]
    float distance;
};

__device__ __forceinline__ const Body& body_of(const Sweep& sweep, uint32 gaussian) {
    uint32 low = 0, high = sweep.body_count;
    while (high - low > 1) {
        const uint32 middle = (low + high) / 2;
        if (sweep.bodies[middle].first <= gaussian) low = middle;
        else high = middle;
    }
    return sweep.bodies[low];
}

__device__ __forceinline__ float dot3(const float* a, const float* b) {
    return fmaf(a[0], b[0], fmaf(a[1], b[1], a[2] * b[2]));
}

__device__ __forceinline__ float dot5(const float* a, const float* b) {
    float sum = a[0] * b[0];
    for (uint32 k = 1; k < 5; ++k) sum = fmaf(a[k], b[k], sum);
    return sum;
}

// Scan time of a point; side is 1 for the first half of the sweep, 2 for the second, 0 for both.
__device__ __forceinline__ uint32 instant_of(
    const Sweep& sweep, const Body& body, const float* mean, uint32 side) {
    const int count = int(sweep.slot_count);
    const int low = side != 2 ? 0 : count - count / 2;
    const int high = side != 1 ? count - 1 : count / 2 - 1;
    int slot = (low + high) / 2;
    if (!(body.speed > 0.0f || body.turn > 0.0f)) return uint32(slot);
    if (side == 1) slot = 0;
    if (side == 2) slot = count - 1;
    for (uint32 round = 0; round < 2; ++round) {
        const float* f = sweep.frames + 12ull * (size_t(body.motion) * sweep.slot_count + uint32(slot));
        const float azimuth = atan2f(dot3(f + 4, mean) + f[7], dot3(f, mean) + f[3]);
        int bin = int((azimuth + PI) * (float(AZIMUTH_BINS) / (2.0f * PI)));
        bin = bin < 0 ? 0 : bin >= AZIMUTH_BINS ? AZIMUTH_BINS - 1 : bin;
        slot = sweep.slot_of[bin];
        if (side == 1 && slot > high) slot = 0;
        if (side == 2 && slot < low) slot = count - 1;
    }
    return uint32(slot);
}

// Rows of a square root of the covariance in the sweep frame.
__device__ __forceinline__ void factors_of(const Body& body, uint32 i, float rows[3][5]) {
    double root[9];
    if (body.covars) {
        const float* c = body.covars + 9ull * i;
        const double xx = c[0], xy = c[1], xz = c[2], yy = c[4], yz = c[5], zz = c[8];
        const double a = sqrt(xx > 1e-12 ? xx : 1e-12), b = xy / a, e = xz / a;
        double d = yy - b * b;
        d = sqrt(d > 1e-12 ? d : 1e-12);
        const double g = (yz - b * e) / d;
        double h = zz - e * e - g * g;
        h = sqrt(h > 1e-12 ? h : 1e-12);
        const double lower[9] = {a, 0, 0, b, d, 0, e, g, h};
        for (uint32 k = 0; k < 9; ++k) root[k] = lower[k];
    } else {
        const float* q = body.quats + 4ull * i;
        const double w = q[0], x = q[1], y = q[2], z = q[3];
        const double n = 2.0 / (w * w + x * x + y * y + z * z);
        const double turn[9] = {
            1 - n * (y * y + z * z), n * (x * y - w * z),     n * (x * z + w * y),
            n * (x * y + w * z),     1 - n * (x * x + z * z), n * (y * z - w * x),
            n * (x * z - w * y),     n * (y * z + w * x),     1 - n * (x * x + y * y)};
        for (uint32 k = 0; k < 9; ++k) root[k] = turn[k] * body.scales[3ull * i + k % 3];
    }
    for (uint32 row = 0; row < 3; ++row)
        for (uint32 k = 0; k < 3; ++k) {
            const double* own = body.linear + 3 * row;
            rows[row][k] = float(own[0] * root[k] + own[1] * root[3 + k] + own[2] * root[6 + k]);
        }
}

// Inverse of the lower triangle L with L L^T = rows rows^T, by rows.
__device__ __forceinline__ void whiten(const float rows[3][5], float* out) {
    double s[6] = {0, 0, 0, 0, 0, 0};
    for (uint32 k = 0; k < 5; ++k) {
        const double a = rows[0][k], b = rows[1][k], c = rows[2][k];
        s[0] += a * a, s[1] += a * b, s[2] += b * b, s[3] += a * c, s[4] += b * c, s[5] += c * c;
    }
    const double a = sqrt(s[0] > LEAST ? s[0] : LEAST), b = s[1] / a, c = s[3] / a;
    double d = s[2] - b * b;
    d = sqrt(d > LEAST ? d : LEAST);
    const double e = (s[4] - b * c) / d;
    double f = s[5] - c * c - e * e;
    f = sqrt(f > LEAST ? f : LEAST);
    out[0] = float(1 / a);
    out[1] = float(-b / (a * d));
    out[2] = float(1 / d);
    out[3] = float((b * e - c * d) / (a * d * f));
    out[4] = float(-e / (d * f));
    out[5] = float(1 / f);
}

// Angles of the two tangents from the origin to an ellipse at a squared distance; returns whether
// the origin is inside it or too close.
__device__ __forceinline__ bool tangents(
    float square, float along, float mixed, float across, float& first, float& last) {
    float least = square * NEARLY_INSIDE, clear = square - along;
    const bool inside = clear <= least;
    clear = fmaxf(clear, least);
    const float root = sqrtf(fmaxf(fmaf(mixed, mixed, across * clear), 0.0f));
    first = atanf((-mixed - root) / clear);
    last = atanf((root - mixed) / clear);
    return inside;
}

// Writes the ray data of a Gaussian; returns false if no ray may hit it.
__device__ __forceinline__ bool prepare_one(
    const Sweep& sweep, const Body& body, uint32 i, const float* mean, uint32 side, Met& met,
    Angles& angles) {
    const uint32 slot = instant_of(sweep, body, mean, side);
    const float* f = sweep.frames + 12ull * (size_t(body.motion) * sweep.slot_count + slot);
    const float x = dot3(f, mean) + f[3], y = dot3(f + 4, mean) + f[7], z = dot3(f + 8, mean) + f[11];
    const float flat = fmaxf(fmaf(x, x, y * y), 1e-12f), square = fmaf(z, z, flat);
    const float along = sqrtf(flat), distance = sqrtf(square);
    const float cosine = x / along, sine = y / along, rise = z / distance, level = along / distance;
    float radial[3], across[3], upward[3], rows[3][5];
    for (uint32 k = 0; k < 3; ++k) {
        radial[k] = f[k] * cosine + f[4 + k] * sine;
        across[k] = f[4 + k] * cosine - f[k] * sine;
        upward[k] = f[8 + k] * level - radial[k] * rise;
    }
    factors_of(body, i, rows);
    for (uint32 k = 0; k < 3; ++k) {
        rows[k][3] = across[k] * distance * sweep.wide;
        rows[k][4] = upward[k] * distance * sweep.high;
    }
    whiten(rows, met.whitening);
    const float opacity = body.opacities[i];
    met.level = -logf(fmaxf(opacity, 1e-12f));
    const float reach = sqrtf(2.0f * fmaxf(LOG_255 - met.level, 0.0f));
    float out[5], beside[5], up[5], deep[5], tall[5];
    for (uint32 k = 0; k < 5; ++k) {
        const float column[3] = {rows[0][k], rows[1][k], rows[2][k]};
        out[k] = dot3(radial, column) * reach;
        beside[k] = dot3(across, column) * reach;
        up[k] = dot3(f + 8, column) * reach;
        deep[k] = (out[k] * along + up[k] * z) / distance;
        tall[k] = (up[k] * along - out[k] * z) / distance;
    }
    const float extent = sqrtf(dot5(out, out) + dot5(beside, beside) + dot5(up, up));
    angles.distance = distance;
    angles.gain = body.speed / fmaxf(distance - extent, 0.1f) + body.turn;
    if (!(opacity >= ALPHA_MIN && distance - extent <= sweep.far_range
          && distance + extent >= sweep.near_range))
        return false;
    float left, right, down, above;
    bool anywhere = tangents(flat, dot5(out, out), dot5(out, beside), dot5(beside, beside), left, right);
    anywhere |= tangents(square, dot5(deep, deep), dot5(deep, tall), dot5(tall, tall), down, above);
    const float side_reach = fmaxf(fabsf(left), fabsf(right));
    const float widened = angles.gain * fmaf(side_reach, sweep.period, sweep.spread) + SLACK;
    left -= widened, right += widened;
    const float azimuth = atan2f(y, x), elevation = atan2f(z, along);
    // tan e = tan(tilt) cos(azimuth): a horizontal edge approaches the horizon on both sides.
    const float half = fmaxf(fabsf(left), fabsf(right)), sunk = fmaxf(1.0f - 0.5f * half * half, 0.0f);
    const float bottom = elevation + down, top = elevation + above;
    angles.low = fminf(bottom, bottom * sunk) - widened;
    angles.high = fmaxf(top, top * sunk) + widened;
    anywhere |= angles.low < -POLE || angles.high > POLE;
    angles.left = anywhere ? -BEYOND : azimuth + left;
    angles.right = anywhere ? BEYOND : azimuth + right;
    if (anywhere) angles.low = -BEYOND, angles.high = BEYOND;
    met.low = angles.low, met.high = angles.high;
    return true;
}

// Whether rays may hit a Gaussian both at the start and at the end of the sweep.
__device__ __forceinline__ bool near_seam(const Sweep& sweep, const Angles& angles) {
    const float middle = 0.5f * (angles.left + angles.right);
    const float half = 0.5f * (angles.right - angles.left) + angles.gain * sweep.duration;
    const float away = fabsf(sweep.seam - middle);
    return half < PI && fminf(away, fabsf(2.0f * PI - away)) <= half;
}

__device__ __forceinline__ int elevation_bin(float angle) {
    const int bin = int((angle + 0.5f * PI) * (float(ELEVATION_BINS) / PI) + 1.0f) - 1;
    return bin < 0 ? 0 : bin >= ELEVATION_BINS ? ELEVATION_BINS - 1 : bin;
}

// Bands (8 bits each), azimuth bins (13 bits each) and side, or -1 if no ray passes.
__device__ __forceinline__ int64 footprint_of(const Sweep& sweep, const Angles& angles, uint32 side) {
    const int low = elevation_bin(angles.low), high = elevation_bin(angles.high);
    if (sweep.rows_until[high] <= sweep.rows_before[low]) return -1;
    const int64 band = sweep.first_bands[low], last_band = sweep.last_bands[high];
    if (band > last_band) return -1;
    int64 first = 0, last = AZIMUTH_BINS - 1;
    float left = angles.left, right = angles.right;
    if (right - left < 2.0f * PI) {
        const float turn = left < -PI ? 2.0f * PI : left >= PI ? -2.0f * PI : 0.0f;
        left += turn, right += turn;
        first = int64((left + PI) * (float(AZIMUTH_BINS) / (2.0f * PI)));
        first = first < 0 ? 0 : first >= AZIMUTH_BINS ? AZIMUTH_BINS - 1 : first;
        last = int64((right + PI) * (float(AZIMUTH_BINS) / (2.0f * PI)));
        last = last < first ? first : last >= first + AZIMUTH_BINS ? first + AZIMUTH_BINS - 1 : last;
    }
    return band | last_band << 8 | first << 16 | last << 29 | int64(side) << 42;
}
