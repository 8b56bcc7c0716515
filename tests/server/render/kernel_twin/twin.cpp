// The serving kernels on a CPU: run(kernel, blocks, frame, argument, backwards).
#include "cuda_on_cpu.h"

#include "serving.cu"

using Kernel = void (*)(const Frame*, uint32);
struct Named { const char* name; Kernel kernel; };
static const Named KERNELS[] = {
    {"find_seen", find_seen}, {"project_seen", project_seen}, {"count_digits", count_digits},
    {"scatter_digits", scatter_digits}, {"count_pairs", count_pairs}, {"make_pairs", make_pairs},
    {"find_ranges", find_ranges}, {"blend", blend}};

static Kernel running;
static const Frame* given;
static uint32 with;

static void live() {
    for (;;) {
        running(given, with);
        wait_as(ENDED);
    }
}

static void begin_fibers() {
    static ucontext_t contexts[FIBERS], back;
    char* stacks = static_cast<char*>(malloc(FIBERS * STACK));
    for (unsigned k = 0; k < FIBERS; ++k) {
        getcontext(&contexts[k]);
        contexts[k].uc_stack.ss_sp = stacks + k * STACK;
        contexts[k].uc_stack.ss_size = STACK;
        makecontext(&contexts[k], live, 0);
    }
    static unsigned k;
    for (k = 0; k < FIBERS; ++k) {
        // A first visit that ends at once, so that all later ones go by longjmp alone.
        running = [](const Frame*, uint32) {};
        threadIdx.x = k;
        if (_setjmp(scheduler) == 0) swapcontext(&back, &contexts[k]);
    }
}

// Lets those go on for which all others have come; false where nobody can go on.
static bool release() {
    unsigned for_block = 0, ended = 0;
    bool any = false;
    for (unsigned warp = 0; warp < FIBERS; warp += LANES) {
        unsigned waiting = 0;
        for (unsigned k = warp; k < warp + LANES; ++k) {
            waiting += states[k] == WAITS_FOR_WARP;
            for_block += states[k] == WAITS_FOR_BLOCK;
            ended += states[k] == ENDED;
        }
        if (waiting == LANES) {
            for (unsigned k = warp; k < warp + LANES; ++k) states[k] = RUNS;
            any = true;
        }
    }
    if (for_block == FIBERS) {
        for (State& state : states) state = RUNS;
        any = true;
    }
    return any || ended == FIBERS;
}

static bool all_ended() {
    for (State state : states)
        if (state != ENDED) return false;
    return true;
}

static bool run_block(bool backwards) {
    for (State& state : states) state = RUNS;
    while (!all_ended()) {
        // Static: what longjmp comes back to must not be lost.
        static unsigned turn, next;
        for (turn = 0; turn < FIBERS; ++turn) {
            next = backwards ? FIBERS - 1 - turn : turn;
            if (states[next] != RUNS) continue;
            threadIdx.x = next;
            if (_setjmp(scheduler) == 0) _longjmp(places[next], 1);
        }
        if (!release()) return false;
    }
    return true;
}

// 0, or 1 for an unknown kernel, 2 where threads of a block part ways at a barrier.
extern "C" int run(
    const char* name, uint32 blocks, const Frame* frame, uint32 argument, int backwards) {
    static bool begun = false;
    if (!begun) begin_fibers();
    begun = true;
    running = nullptr;
    for (const Named& named : KERNELS)
        if (strcmp(named.name, name) == 0) running = named.kernel;
    if (!running) return 1;
    given = frame;
    with = argument;
    gridDim.x = blocks;
    for (uint32 turn = 0; turn < blocks; ++turn) {
        blockIdx.x = backwards ? blocks - 1 - turn : turn;
        if (!run_block(backwards)) return 2;
    }
    return 0;
}

extern "C" void sizes(uint32* out) {
    const size_t all[] = {sizeof(Object), sizeof(Placement), sizeof(Camera), sizeof(Frame)};
    for (unsigned k = 0; k < 4; ++k) out[k] = uint32(all[k]);
}

extern "C" float exponential(float x) { return exp_negative(x); }
extern "C" float logarithm(float x) { return log_of(x); }
