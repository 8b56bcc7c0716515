// All that the solver's kernels work on. launcher.py lays the same out as NumPy types; the sizes
// below hold both to it. A kernel takes nothing but a Space and a number.
#pragma once

typedef Four<real> Real4;

constexpr uint32 THREADS = 128;       // of every block of threads
constexpr uint32 WARP = 32;
constexpr uint32 WARPS = THREADS / WARP;
constexpr uint32 ALL_LANES = 0xffffffffu;
constexpr uint32 DIGITS = 256;        // of a pass of the radix sort
static_assert(DIGITS == 2 * THREADS, "each thread has two digits");
constexpr uint32 PIECE = 1024;        // of a list that is summed up
constexpr int BLOCK = 4;              // nodes along the edge of a block
constexpr int SIDE = 8;               // and of its tile, which begins a node below the block
constexpr uint32 NODES = BLOCK * BLOCK * BLOCK;
constexpr uint32 TILE = SIDE * SIDE * SIDE;
constexpr uint32 AROUND = 27;         // blocks and fields around one, itself among them
constexpr uint32 MIDDLE = 13;
constexpr int BODY_BITS = 12, COORDINATE_BITS = 17;
constexpr int COORDINATE_LIMIT = 1 << (COORDINATE_BITS - 1);
constexpr uint32 TOTALS = 8;          // of a contact, see model.TOTALS
constexpr uint32 COLUMNS = 16;        // of a row of sums, see particle.py; the last is REACH
constexpr uint32 REACH = 15;

// Why no more is done until the host has seen to it.
constexpr uint32 DIVERGED = 1, TOO_FAR = 2, OVERFLOW = 4;

// Numbers of a particle, each an array as long as all particles.
constexpr uint32 XI = 0, VELOCITY = 3, GRADIENT = 6, ELASTIC_F = 15, STRESS = 24, ENERGY = 30,
                 HISTORY = 31, MASS = 32, VOLUME = 33, TOTAL_F = 34;

// Uploaded before each run of substeps; rows of all colliders follow, for each substep if they move.
struct Step {
    double dt;
    uint32 moving, unused;
};

// Where the device stands. Copied to the host with what is measured.
struct Held {
    uint32 current;     // which of the two sets of particles holds them
    uint32 stop_after;  // substeps after which a particle had left its tile; 0 for none
    uint32 fault;
    uint32 done;        // substeps
    uint32 blocks, fields, groups, contacts, pairs, thins;
    uint32 unused[6];
};
static_assert(sizeof(Held) == 64, "Held differs from launcher.py");

struct Space {
    unsigned char* sets[2];  // keys [pitch], materials and origins, then the numbers above
    uint64* keys[2];
    uint32* order[2];
    uint32* digit_counts;    // [sort_blocks + 1, DIGITS], sums of all blocks at the end
    uint32* counts;          // of the list that is summed up
    uint32* sums;            // of its pieces
    // Layout: P blocks with particles of one body each, M fields, see layout.py.
    uint64* block_key;       // [P]
    uint64* field_key;       // [M]
    uint32* block_start;     // [P + 1]
    uint32* block_fields;    // [P, 27]
    uint32* block_near;      // [P] whether contact asks for its moments
    int* field_blocks;       // [M, 27] or -1
    uint32* field_near;      // [M]
    uint32* group_start;     // [G + 1]
    uint32* contact_start;   // [M + 1]
    uint32* contact_collider;
    uint32* contact_field;
    uint32* pair_start;      // [M + 1] of each field with those after it in its group
    uint32* pair_field;
    uint32* thin_start;      // [P + 1]
    uint32* thin_collider;
    uint32* thin_block;
    Real4* tiles;            // [P, TILE] momentum and mass
    Real4* moments;          // [P, TILE] first moment of volume, and volume
    Real4* velocity;         // [M, NODES] and mass
    Real4* offset;           // [M, NODES]
    double* by_collider;     // [contacts, NODES, TOTALS]
    double* by_pair;         // [pairs, NODES, 2 TOTALS]
    double* by_thin;         // [thins, THREADS, TOTALS]
    double* touched;         // [contacts + pairs + thins, 2 TOTALS], the same summed up
    double* rows;            // [P, COLUMNS]
    const real* table;       // [K, MATERIAL_ROW]
    const double* friction;  // [B]
    const double* heights;
    const Step* step;
    Held* held;
    double* measured;        // [B, COLUMNS]
    double* collider_totals; // [B, C, TOTALS]
    double* body_totals;     // [B, B, TOTALS]
    double dx, gravity[3];
    uint32 particles, pitch, plastic, bodies, colliders, sort_blocks;
    uint32 block_capacity, field_capacity, contact_capacity, pair_capacity, thin_capacity;
    uint32 unused;
};
static_assert(sizeof(Step) == 16 && sizeof(Space) == 416, "Space differs from launcher.py");

// Particles of one set; number `c` of particle p is at(c, p).
struct Particles {
    unsigned char* memory;
    uint32 pitch;
    __device__ __forceinline__ uint64& key(uint32 p) const {
        return reinterpret_cast<uint64*>(memory)[p];
    }
    __device__ __forceinline__ uint32& material(uint32 p) const {
        return reinterpret_cast<uint32*>(memory + 8ull * pitch)[p];
    }
    __device__ __forceinline__ uint32& origin(uint32 p) const {
        return reinterpret_cast<uint32*>(memory + 12ull * pitch)[p];
    }
    __device__ __forceinline__ real& at(uint32 c, uint32 p) const {
        return reinterpret_cast<real*>(memory + 16ull * pitch)[uint64(c) * pitch + p];
    }
    template <int N> __device__ __forceinline__ Numbers<real, N> several(uint32 c, uint32 p) const {
        Numbers<real, N> values;
        for (int n = 0; n < N; ++n) values[n] = at(c + n, p);
        return values;
    }
    template <int N>
    __device__ __forceinline__ void put(uint32 c, uint32 p, const Numbers<real, N>& values) const {
        for (int n = 0; n < N; ++n) at(c + n, p) = values[n];
    }
};

__device__ __forceinline__ Particles particles_of(const Space& space) {
    return {space.sets[space.held->current], space.pitch};
}

__device__ __forceinline__ uint32 body_of(uint64 key) {
    return uint32(key) & ((1u << BODY_BITS) - 1);
}

// Coordinate of a block or field along an axis, in blocks.
__device__ __forceinline__ int coordinate(uint64 key, int axis) {
    const int shift = BODY_BITS + (2 - axis) * COORDINATE_BITS;
    return int(key >> shift & ((1u << COORDINATE_BITS) - 1)) - COORDINATE_LIMIT;
}

// What the key of the block at offset number o has more than that in the middle.
__device__ __forceinline__ uint64 key_step(uint32 o) {
    const uint64 i = uint64(o / 9) - 1, j = uint64(o / 3 % 3) - 1, k = uint64(o % 3) - 1;
    return (((((i << COORDINATE_BITS) + j) << COORDINATE_BITS) + k)) << BODY_BITS;
}

// Row of a collider in a substep.
__device__ __forceinline__ const double* collider_row(
    const Space& space, uint32 collider, uint32 step) {
    const double* rows = reinterpret_cast<const double*>(space.step + 1);
    const uint32 before = space.step->moving ? step * space.colliders : 0;
    return rows + uint64(before + collider) * COLLIDER_ROW;
}

// Whether there is no more to do in a substep, and for what is done between them, at all.
constexpr uint32 AFTER_ANY = 0xffffffffu;
__device__ __forceinline__ bool is_halted(const Space& space, uint32 step) {
    const Held& held = *space.held;
    return held.fault != 0 || (held.stop_after != 0 && held.stop_after <= step);
}

__device__ __forceinline__ uint32 thread_number() { return blockIdx.x * THREADS + threadIdx.x; }
