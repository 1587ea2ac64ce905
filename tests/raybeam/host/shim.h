// What a .cu file without headers needs to compile as C++ for the CPU.
#pragma once
#include <cmath>
#include <cstring>

#define __global__
#define __device__
#define __forceinline__ inline
#define __launch_bounds__(...)
#define __restrict__ __restrict

struct float4 {
    float x, y, z, w;
};
struct Dim {
    unsigned x, y, z;
};
static thread_local Dim blockIdx, blockDim, threadIdx;

static inline int __float_as_int(float f)
{
    int i;
    std::memcpy(&i, &f, sizeof i);
    return i;
}

using std::fabs;
using std::fmax;
using std::fmin;
