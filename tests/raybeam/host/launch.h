// Runs a kernel on the CPU: threads one after another, or, where the kernel has votes, in warps whose
// lanes wait for each other. `arguments` points to each argument's value.
#pragma once
#include "shim.h"
#include "warp.h"

// CuPy compiles with -ftz=true: numbers in float that are not normal count as zero. The processor
// can only be told so for double as well, which the tests' numbers do not notice.
#ifdef __SSE2__
#include <xmmintrin.h>
struct Flushing {
    const unsigned before = _mm_getcsr();
    Flushing() { _mm_setcsr(before | 0x8040); }
    ~Flushing() { _mm_setcsr(before); }
};
#else
struct Flushing {
    ~Flushing() {}
};
#endif

template <class... Parameters, std::size_t... I>
static void launch(
    unsigned blocks, void (*kernel)(Parameters...), void** arguments, bool warps,
    std::index_sequence<I...>)
{
    const Flushing flushing;
    const auto thread = [&] { kernel(*static_cast<Parameters*>(arguments[I])...); };
    blockDim.x = 128;
    for (blockIdx.x = 0; blockIdx.x < blocks; ++blockIdx.x)
        for (threadIdx.x = 0; threadIdx.x < blockDim.x;) {
            if (warps) {
                run_warp(thread);
                threadIdx.x += LANES;
            } else {
                thread();
                ++threadIdx.x;
            }
        }
}

template <class... Parameters>
static void launch(unsigned blocks, void (*kernel)(Parameters...), void** arguments, bool warps)
{
    launch(blocks, kernel, arguments, warps, std::index_sequence_for<Parameters...>());
}

// A kernel, and whether it has votes.
#define RUN(kernel, warps)                                            \
    extern "C" int parameters_##kernel()                              \
    {                                                                 \
        return count_parameters(kernel);                              \
    }                                                                 \
    extern "C" void run_##kernel(unsigned blocks, void** arguments)   \
    {                                                                 \
        launch(blocks, kernel, arguments, warps);                     \
    }

template <class... Parameters>
static int count_parameters(void (*)(Parameters...))
{
    return sizeof...(Parameters);
}
