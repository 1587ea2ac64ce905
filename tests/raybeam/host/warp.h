// A warp on the CPU: 32 lanes, each with a stack, that run until all of them are at a vote or have
// ended. A vote that names a lane which does not come aborts: on a device it would not return.
#pragma once
#include <ucontext.h>
#include <cstdio>
#include <cstdlib>
#include <functional>
#include <memory>

enum { LANES = 32 };
enum Vote { NONE, BALLOT, MATCH_ANY };

struct Lane {
    ucontext_t context;
    std::unique_ptr<char[]> stack{new char[1 << 16]};
    bool ended;
    Vote vote;
    unsigned mask, result;
    unsigned long long value;
};

struct Warp {
    ucontext_t scheduler;
    Lane lanes[LANES];
    int current;
    std::function<void()> thread;
};

static Warp& warp()
{
    static thread_local Warp of_this_thread;
    return of_this_thread;
}

static void run_lane()
{
    Warp& w = warp();
    w.thread();
    w.lanes[w.current].ended = true;
}  // and on to the scheduler

static unsigned vote(Vote kind, unsigned mask, unsigned long long value)
{
    Warp& w = warp();
    Lane& lane = w.lanes[w.current];
    lane.vote = kind;
    lane.mask = mask;
    lane.value = value;
    swapcontext(&lane.context, &w.scheduler);
    return lane.result;
}

// Count the votes of the lanes of a mask; all lanes are at a vote or have ended.
static void count_votes(Warp& w, Lane& lane, int number)
{
    lane.result = 0;
    bool valid = lane.mask >> number & 1;
    for (int other = 0; other < LANES; ++other) {
        if (!(lane.mask >> other & 1)) continue;
        const Lane& voter = w.lanes[other];
        valid = valid && voter.vote == lane.vote && voter.mask == lane.mask;
        const bool agrees = lane.vote == BALLOT ? voter.value != 0 : voter.value == lane.value;
        lane.result |= (unsigned)agrees << other;
    }
    if (valid) return;
    std::fprintf(stderr, "lane %d votes with mask %08x, and a lane of it does not\n", number, lane.mask);
    std::abort();
}

// Run the threads threadIdx.x to threadIdx.x + 31.
static void run_warp(std::function<void()> thread)
{
    Warp& w = warp();
    const unsigned first = threadIdx.x;
    w.thread = std::move(thread);
    for (Lane& lane : w.lanes) {
        getcontext(&lane.context);
        lane.context.uc_stack.ss_sp = lane.stack.get();
        lane.context.uc_stack.ss_size = 1 << 16;
        lane.context.uc_link = &w.scheduler;
        lane.ended = false;
        makecontext(&lane.context, run_lane, 0);
    }
    for (bool voting = true; voting;) {
        voting = false;
        for (w.current = 0; w.current < LANES; ++w.current) {
            Lane& lane = w.lanes[w.current];
            lane.vote = NONE;
            if (lane.ended) continue;
            threadIdx.x = first + w.current;
            swapcontext(&w.scheduler, &lane.context);
            voting = voting || !lane.ended;
        }
        for (int number = 0; number < LANES; ++number)
            if (w.lanes[number].vote != NONE) count_votes(w, w.lanes[number], number);
    }
    threadIdx.x = first;
}

static inline unsigned __ballot_sync(unsigned mask, bool value) { return vote(BALLOT, mask, value); }
static inline unsigned __match_any_sync(unsigned mask, unsigned long long value)
{
    return vote(MATCH_ANY, mask, value);
}
static inline int __ffs(int number) { return __builtin_ffs(number); }
static inline int __popc(unsigned number) { return __builtin_popcount(number); }
