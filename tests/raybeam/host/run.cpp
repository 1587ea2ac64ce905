// Runs the kernels of intersect.cu thread by thread. INTERSECT_CU is the path to it, in quotes.
#include "shim.h"
#include INTERSECT_CU

template <class Kernel>
static void launch(Count count, Kernel kernel)
{
    blockDim.x = 128;
    for (Count i = 0; i < (count + 127) / 128 * 128; ++i) {
        blockIdx.x = (unsigned)(i / 128);
        threadIdx.x = (unsigned)(i % 128);
        kernel();
    }
}

struct Tables {
    const float4* nodes;
    const float4* triangles;
    const double* corners;
    const int* faces;
    const double* frame;
};

extern "C" void run_cast_table(
    const Tables* s, const double* origins, int stride, const double* directions, Count count,
    double t_min, double t_max, double* distance, int* place)
{
    launch(count, [=] {
        cast_table(s->nodes, s->triangles, s->corners, s->faces, s->frame, origins, stride,
                   directions, count, t_min, t_max, distance, place);
    });
}

extern "C" void run_cast_pattern(
    const Tables* s, const double* pose, int turned, const double* directions, Count count,
    double t_min, double t_max, double* distance, int* place)
{
    launch(count, [=] {
        cast_pattern(s->nodes, s->triangles, s->corners, s->faces, s->frame, pose, turned,
                     directions, count, t_min, t_max, distance, place);
    });
}

extern "C" void run_weigh_table(
    const Tables* s, const double* origins, int stride, const double* directions,
    const Count* ray, const int* place, Count count, double* u, double* v)
{
    launch(count, [=] {
        weigh_table(s->corners, s->frame, origins, stride, directions, ray, place, count, u, v);
    });
}
