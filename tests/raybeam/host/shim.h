// What a .cu file without headers needs to compile as C++ for the CPU.
#pragma once
#include <cmath>
#include <cstring>
#include <utility>

#define __global__
#define __device__
#define __forceinline__ inline
#define __launch_bounds__(...)
#define __restrict__ __restrict

struct float4 {
    float x, y, z, w;
};
struct int2 {
    int x, y;
};
struct int4 {
    int x, y, z, w;
};
struct Dim {
    unsigned x, y, z;
};
static thread_local Dim blockIdx, blockDim, threadIdx;

template <class To, class From>
static inline To bits(From from)
{
    To to;
    static_assert(sizeof to == sizeof from, "same size");
    std::memcpy(&to, &from, sizeof to);
    return to;
}
static inline int __float_as_int(float f) { return bits<int>(f); }
static inline float __int_as_float(int i) { return bits<float>(i); }

template <class Number>
static inline void atomicAdd(Number* sum, Number more) { *sum += more; }

using std::fabs;
using std::floor;
using std::fmax;
using std::fmin;
using std::rint;
using std::sqrt;
