// Inputs and outputs of a frame. launcher.py has the same layout as NumPy types; the size assertions
// below keep both consistent. The only arguments of a kernel are a Frame and a number.
#pragma once

typedef unsigned char uint8;
typedef unsigned short uint16;
typedef unsigned int uint32;

constexpr uint32 THREADS = 256;        // per block
constexpr uint32 WARP = 32;
constexpr uint32 WARPS = THREADS / WARP;
constexpr uint32 ALL_LANES = 0xffffffffu;
constexpr uint32 PARTS = 4;            // Gaussians or splats per thread
constexpr uint32 PIECE = THREADS * PARTS;
constexpr uint32 WORDS = PIECE / WARP; // masks of a piece, one bit per Gaussian
constexpr uint32 DIGITS = 256;         // of a radix sort pass
constexpr uint32 TILE = 16;            // [px]
constexpr uint32 MAX_CAMERAS = 64;     // per frame

// A cloud with a pose, drawn by cameras [first_camera, first_camera + cameras) of the frame.
struct Object {
    const float* means;      // [N, 3]
    const float* quats;      // [N, 4] wxyz
    const float* scales;     // [N, 3]
    const float* opacities;  // [N]
    const float* sh;         // [N, functions, 3]
    const float* covars;     // [N, 3, 3], replaces quats and scales; or null
    const float* colour;     // [N, tones, 3] coefficients of the time-dependent colour, or null
    const float* tones;      // [tones] basis functions at the time of the frame
    uint32 count;            // N
    uint32 functions;        // 1, 4, 9 or 16
    uint32 tone_count;
    uint32 first_piece;      // index over all objects; PIECE Gaussians each
    uint32 first_entry;      // one entry per piece and camera
    uint32 first_placement;  // one placement per camera
    uint32 first_camera;
    uint32 cameras;
    float scale[3];
    uint16 instance;
    uint16 semantic;
};
static_assert(sizeof(Object) == 112, "Object differs from launcher.py");

// Pose of an object relative to a camera. Positions are relative to the camera, so single precision
// suffices at any distance from the world origin.
struct Placement {
    double depth_row[4];   // depth = row . (mean, 1), with the order and precision of the reference
    float linear[9];       // cloud to camera, scale included
    float eye[3];          // camera centre in the unscaled cloud frame ...
    float eye_rest[3];     // ... and its remainder beyond float32
    float unused;
};
static_assert(sizeof(Placement) == 96, "Placement differs from launcher.py");

struct Camera {
    const float* sky;      // [6, R, R, 3]; null if the background is used
    float focal[2];        // [px]
    float centre[2];       // [px]
    float lowest[2];       // bounds of x / z and y / z in the Jacobian
    float highest[2];
    float directions[9];   // (x, y, 1) [px] to a world direction
    float background[3];
    uint32 sky_resolution; // R
    uint32 width, height;  // [px]
    uint32 tiles_x, tiles_y;
    uint32 first_tile;     // over all cameras
    uint32 first_pixel;
    uint32 behind;         // class of pixels whose transmittance stays above 0.5
};
static_assert(sizeof(Camera) == 120, "Camera differs from launcher.py");

enum Counter { SEEN, PAIRS, SEEN_WANTED, PAIRS_WANTED, TICKET, COUNTERS = 16 };

struct Frame {
    const Object* objects;
    const Placement* placements;
    const Camera* cameras;
    uint32* seen_masks;     // [entries, WORDS] one bit per Gaussian
    uint32* entry_starts;   // [entries + 1] first splat of each pair of piece and camera
    float4* splats;         // [seen, 3], see Splat in project.h
    uint2* boxes;           // [seen] tiles that each splat touches
    uint32* depths[2];      // [seen] keys of the sort by depth
    uint32* order[2];       // [seen] its values: splats
    uint32* tiles[2];       // [pairs] keys of the sort by tile
    uint32* members[2];     // [pairs] its values: splats
    uint32* pair_starts;    // [seen / PIECE + 1] first pair of each piece of sorted splats
    uint32* digit_counts;   // [sort_blocks, DIGITS]
    uint32* digit_starts;   // [DIGITS]
    uint2* tile_ranges;     // [tiles] half-open range of each tile's members
    uint32* counters;       // [COUNTERS]
    uint32* report;         // [COUNTERS] copy of the counters for the host
    float* rgb;             // [pixels, 3] this and the following images are null if not requested
    float* alpha;           // [pixels]
    float* depth;           // [pixels] expected depth [m]
    float* median;          // [pixels] depth at which transmittance falls to 0.5 [m]
    float* solid;           // [pixels] expected depth, 0 where alpha is below 0.5 [m]
    uint16* instance;       // [pixels]
    uint8* semantic;        // [pixels]
    uint8* bytes;           // [pixels, 3] rgb as 0 to 255
    uint32 object_count, camera_count;
    uint32 pieces, entries;
    uint32 tile_count;
    uint32 seen_capacity, pair_capacity;
    uint32 sort_blocks;
    uint32 tile_passes;     // 8-bit passes of the sort by tile
    uint32 antialiased;
    float near_plane, far_plane;
    float eps2d;
    float radius_clip;
};
static_assert(sizeof(Frame) == 29 * 8 + 14 * 4, "Frame differs from launcher.py");
