// Blocks of threads on a CPU, one after the other. Before it is included, Given is what kernels take.
#pragma once

#include "cuda_on_cpu.h"

typedef unsigned int uint32;
using Kernel = void (*)(const Given*, uint32);

static Kernel running;
static const Given* given;
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
        running = [](const Given*, uint32) {};
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

// False where threads of a block part ways at a barrier.
static bool run_blocks(
    Kernel kernel, const Given* from, uint32 blocks, uint32 argument, bool backwards) {
    static bool begun = false;
    if (!begun) begin_fibers();
    begun = true;
    running = kernel;
    given = from;
    with = argument;
    gridDim.x = blocks;
    for (uint32 turn = 0; turn < blocks; ++turn) {
        blockIdx.x = backwards ? blocks - 1 - turn : turn;
        if (!run_block(backwards)) return false;
    }
    return true;
}
