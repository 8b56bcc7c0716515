// Inputs of the kernels of cast(); cast/cuda.py has the same structures as NumPy types.
#pragma once

typedef unsigned int uint32;
typedef unsigned long long uint64;
typedef long long int64;

constexpr uint32 THREADS = 256;
constexpr uint32 TILE_RAYS = 64;
constexpr uint32 GROUP = 8;  // rays of a group, at one elevation
constexpr uint32 TILES_OF_BLOCK = THREADS / TILE_RAYS;
constexpr int AZIMUTH_BINS = 4096, ELEVATION_BINS = 4096;
constexpr uint32 ALL_LANES = 0xffffffffu;
constexpr float PI = 3.14159265358979f;
constexpr float ALPHA_MIN = 1.0f / 255.0f, ALPHA_MAX = 0.999f;
constexpr float LOG_255 = 5.54126355f;
constexpr float LIGHT_MIN = 1e-3f, HALF_LIGHT = 0.5f, ECHO_MIN = 0.05f;

// A Gaussian in the form used by rays: exponent = |W (x - mean)|^2 / 2 + level.
struct alignas(16) Met {
    float whitening[6];  // lower triangle, by rows
    float mean[3];       // sweep frame [m]
    float level;         // -ln(opacity)
    float low, high;     // range of elevations at which rays may hit it [rad]
    float reflectivity, loss;
    uint32 body, member;
};

struct Body {
    const float *means, *quats, *scales, *opacities;
    const float* covars;      // null if shapes are quaternions and scales
    const float* attributes;  // null if unknown
    double linear[9], offset[3];
    uint32 first, count, motion, unused;
    float speed, turn;
};

struct Sweep {
    const Body* bodies;
    const float* frames;   // [motions, slots, 12], sweep frame to sensor frame
    const float* origins;  // the inverses
    const int* rays;       // [tiles, 64], padded with -1
    const float* directions;  // [tiles, 8, 3, 8]
    const int* slots;         // [tiles, 64]
    const float *lows, *highs;  // [tiles, 8]
    const int* sides;           // [tiles]
    const int64* band_starts;
    const int *tile_lows, *tile_highs, *first_tiles, *first_bands, *last_bands;
    const int *rows_before, *rows_until, *slot_of;
    Met* met;          // two per Gaussian
    int64* footprints;  // two per Gaussian; -1 if no ray passes
    float* depths;
    int64* counts;      // tiles of each record; prefix sums when pairs are listed
    int64* keys;        // tile and depth of each pair
    int* members;       // record of each pair
    const int* lists;   // records of each tile, near to far
    const int64* starts;
    float* values;    // [rays, 5]
    int* owners;      // [rays, 2]
    float* returns;   // [rays, 9], or null
    uint32 body_count, gaussians, slot_count, tiles;
    float near_range, far_range, pulse;
    float wide, high, spread, period, duration, seam;
};
