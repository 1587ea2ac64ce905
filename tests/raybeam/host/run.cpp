// Runs the kernels of intersect.cu thread by thread, with their own arguments.
// INTERSECT_CU is the path to it, in quotes.
#include "shim.h"
#include INTERSECT_CU

template <class... Parameters, class... Arguments>
static void launch(unsigned blocks, void (*kernel)(Parameters...), Arguments... arguments)
{
    blockDim.x = 128;
    for (blockIdx.x = 0; blockIdx.x < blocks; ++blockIdx.x)
        for (threadIdx.x = 0; threadIdx.x < blockDim.x; ++threadIdx.x) kernel(arguments...);
}

extern "C" void run_cast_table(
    unsigned blocks, const float4* nodes, const float4* triangles, const double* corners,
    const int* faces, const double* frame, const double* origins, int stride,
    const double* directions, Count count, double t_min, double t_max, double* distance,
    int* place)
{
    launch(blocks, cast_table, nodes, triangles, corners, faces, frame, origins, stride,
           directions, count, t_min, t_max, distance, place);
}

extern "C" void run_cast_pattern(
    unsigned blocks, const float4* nodes, const float4* triangles, const double* corners,
    const int* faces, const double* frame, const double* pose, int turned,
    const double* directions, Count count, double t_min, double t_max, double* distance,
    int* place)
{
    launch(blocks, cast_pattern, nodes, triangles, corners, faces, frame, pose, turned,
           directions, count, t_min, t_max, distance, place);
}

extern "C" void run_weigh_table(
    unsigned blocks, const double* corners, const double* frame, const double* origins,
    int stride, const double* directions, const Count* ray, const int* place, Count count,
    double* u, double* v)
{
    launch(blocks, weigh_table, corners, frame, origins, stride, directions, ray, place, count,
           u, v);
}
