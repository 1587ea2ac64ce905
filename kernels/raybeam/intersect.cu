// Closest hits of rays with triangles, by traversal of a four-wide bounding volume hierarchy.
//
// NVRTC compiles this file. It provides no standard headers, so no header is included. The tests
// compile the same text for the CPU. There is one thread per ray, in blocks of 128 threads and a grid
// of one dimension. The following macros are defined on the command line:
//   STACK   maximum number of pending nodes in a traversal.
//   NESTED  1 for a scene with instances, 0 for a plain scene, which is a mesh without a transform.
//   MASKED  1 if parts of triangles are transparent, otherwise 0.
// Scenes without instances or masks do not pay for these features.
//
// Threads are independent except for counting. There is no shared memory and there are no barriers.
// Only `count_row` uses warp votes and atomics, so it does not matter which threads run together.
// Offsets into tables have 64 bits. An int is sufficient for everything else: there are fewer than 2^28
// triangles, so rows shifted by LEAF_BITS fit, and the largest code of a leaf differs from DONE. The
// number of rays in a chunk is far below 2^31 (cuda_backend.py). Tables of float4 are separate
// allocations, which the device aligns to 256 bytes.
//
// CuPy adds -ftz=true, which flushes subnormal floats to zero. The error bands below allow for that
// (_FLOOR in cuda_tables.py). Nodes never come close to it, because a box is at least as wide as its
// padding.
//
// All lengths are local, with coordinates within [-1, 1] (see mesh.py). The scene and each mesh have
// separate local coordinates (see instances.py). cuda_tables.py computes the following tables, which
// contain all meshes one after the other:
//   nodes      8 float4 per node, which is one cache line of 128 bytes: lower x, y, z of the four
//              children, upper x, y, z, the codes of the children as integer bits, and padding. A code
//              >= 0 is the index of a node. A negative code ~(first << 3 | count - 1) is a leaf with
//              these triangles. An empty slot has an inverted box.
//   triangles  3 float4 per triangle, in leaf order: first vertex and error band of b, edge to the
//              second vertex and error band of c, edge to the third vertex and error band of t.
//   corners    9 doubles per triangle, in the same order.
//   faces      the caller's index of each triangle.
//   uvs, masks, opacity  as in `MaskTables` (opacity.py).
//   frame      10 doubles: center (3), scale, lower corner (3) and upper corner (3) of the scene's box.
//   top        like nodes, for the tree over the instances. A leaf contains the index of an instance.
//   instances  20 doubles per instance: matrix from the scene to the mesh, row by row (12), lower corner
//              (3) and upper corner (3) of the mesh's box, first node of the mesh, index of the mesh.
//
// Each triangle is tested in two steps. `may_hit` is the test of Moeller and Trumbore (1997) in float,
// with bands as wide as the possible rounding errors, so it never loses a hit and rejects nearly all
// other triangles. `decide` is the watertight test of triangle.py in double with the same operations.
// Compiled without fused multiply-add (-fmad=false), its results have the same bits as NumPy's. The
// float part uses explicit fma.
//
// Comparisons are written so that a comparison with NaN is false, and false means no hit.

typedef long long Count;

// Number of blocks of 128 threads per multiprocessor: seven for plain scenes, five with masks or from
// sm_100 on, and four with instances. For bodies, it is four, three with instances, and two with
// instances and masks. With more blocks, nvcc 13.0 and 13.5 spill registers. On an H100, seven blocks are
// 2 to 5 % faster than five.
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ < 1000
#define PLAIN_BLOCKS 7
#else
#define PLAIN_BLOCKS 5
#endif
#define BLOCKS (NESTED ? 4 : MASKED ? 5 : PLAIN_BLOCKS)
#define KERNEL extern "C" __global__ void __launch_bounds__(128, BLOCKS)

// Counts operations if the tests run the kernels on the CPU. On a device, it does nothing.
#ifndef SEEN
#define SEEN(what)
#endif

#define LEAF_BITS 3
#define DONE ((int)0x80000000)
#define TINY 8.673617379884035e-19  // 2^-60: replaces zero components of directions
#define SLACK 9.5367431640625e-07f  // 2^-20: margin of limits in float, exceeds their rounding errors
#define MAX_DIAGONAL 4.0            // more than the diagonal of a box (see mesh.py)
#define RECORD 20                   // doubles per instance
#define MISSED 1e30f                // distance of a box that the ray does not intersect
#define TIMES_PER_BOX 32            // number of times that the box of a moving body covers
#define UNIT_SLACK 1e-14            // as in rays.py

struct Scene {
    const float4* nodes;
    const float4* triangles;
    const double* corners;
    const int* faces;
    const float* uvs;
    const unsigned char* masks;
    const Count* opacity;
    const double* frame;
    const float4* top;
    const double* instances;
};

// Local origin and unit direction.
struct Ray {
    double ox, oy, oz, dx, dy, dz;
};

// Result of `decide`: weights of the vertices times det, and the distance.
struct Exact {
    double a, b, c, det, t;
};

// ---- rays ----

__device__ __forceinline__ void place_origin(const Scene& scene, const double* origin, Ray& ray)
{
    const double* f = scene.frame;
    ray.ox = (origin[0] - f[0]) * f[3];
    ray.oy = (origin[1] - f[1]) * f[3];
    ray.oz = (origin[2] - f[2]) * f[3];
}

// Rays from memory: origins in meters, (3, origin_count), which all rays share if origin_count is 1, and
// directions, (3, count).
struct TableRays {
    const double* origins;
    Count origin_count;
    const double* directions;
    Count count;

    __device__ __forceinline__ Ray load(const Scene& scene, int i) const
    {
        const int at = origin_count == 1 ? 0 : i;
        const double origin[3] = {
            origins[at], origins[origin_count + at], origins[2 * origin_count + at]};
        Ray ray;
        place_origin(scene, origin, ray);
        ray.dx = directions[i];
        ray.dy = directions[count + i];
        ray.dz = directions[2 * count + i];
        return ray;
    }
};

// Rays of a pattern with `rows` rows, transformed by their poses. Ray i is row (first + i) modulo rows.
// The first pose has `left` rays, and each later pose has `each` rays.
struct PatternRays {
    const double* positions;   // 3 per pose
    const double* rotations;   // 9 per pose, row by row; not read if `turned` is 0
    const double* directions;  // all x, then all y, then all z
    const double* origins;     // the same; not read if `shifted` is 0
    Count rows, first;
    int left, each;
    int turned, shifted;
    // Motion of the lidar while the rays of a pose are fired; not read if `moving` is 0.
    const double* delays;  // of each ray of a pose, in seconds
    const double* rates;   // 6 per pose: meters per second, radians per second
    int moving;

    __device__ __forceinline__ static void turn(
        const double* r, double x, double y, double z, double& a, double& b, double& c)
    {
        a = (x * r[0] + y * r[1]) + z * r[2];
        b = (x * r[3] + y * r[4]) + z * r[5];
        c = (x * r[6] + y * r[7]) + z * r[8];
    }

    // Rotate a vector by the angular velocity w during a delay: v + delay * cross(w, v).
    __device__ __forceinline__ static void drift(
        const double* w, double delay, double& x, double& y, double& z)
    {
        const double a = x + delay * (w[1] * z - w[2] * y);
        const double b = y + delay * (w[2] * x - w[0] * z);
        const double c = z + delay * (w[0] * y - w[1] * x);
        x = a;
        y = b;
        z = c;
    }

    // Compute the origin of a ray in meters and its direction.
    __device__ __forceinline__ void make(int i, double* at, double* to) const
    {
        Count row = first + i;
        // The rays of a chunk fit into an int, and so does the remainder after one repetition.
        if (row >= rows) row -= rows;
        if (row >= rows) row = (unsigned)row % (unsigned)rows;
        const int ray = i;
        const unsigned pose = ray < left ? 0u : 1u + (unsigned)(ray - left) / (unsigned)each;
        const double* r = rotations + 9 * (Count)pose;
        const double x = directions[row], y = directions[rows + row];
        const double z = directions[2 * rows + row];
        to[0] = x;
        to[1] = y;
        to[2] = z;
        if (turned) turn(r, x, y, z, to[0], to[1], to[2]);
        const double* rate = rates + 6 * (Count)pose;
        double delay = 0.0;
        if (moving) {
            delay = delays[pose == 0 ? each - left + ray : (ray - left) % each];
            drift(rate + 3, delay, to[0], to[1], to[2]);
        }
        for (int axis = 0; axis < 3; ++axis) at[axis] = positions[3 * (Count)pose + axis];
        if (shifted) {
            double u = origins[row], v = origins[rows + row], w = origins[2 * rows + row];
            if (turned) {
                const double a = u, b = v, c = w;
                turn(r, a, b, c, u, v, w);
            }
            if (moving) drift(rate + 3, delay, u, v, w);
            at[0] = u + at[0];
            at[1] = v + at[1];
            at[2] = w + at[2];
        }
        if (moving)
            for (int axis = 0; axis < 3; ++axis) at[axis] = at[axis] + delay * rate[axis];
    }
};

// Rays in the frame of a moving body at the firing time of the ray. Row `row` of `poses` contains the
// position of the body and the rotation matrix from the body frame. A row index takes fewer registers
// than a pointer.
struct BodyRays {
    const double* rays;  // 6 rows of `count`: origins in meters and directions
    Count count;
    const double* poses;  // 12 per row
    int row;

    __device__ __forceinline__ static void take(
        const double* r, double x, double y, double z, double& a, double& b, double& c)
    {
        a = (x * r[0] + y * r[3]) + z * r[6];
        b = (x * r[1] + y * r[4]) + z * r[7];
        c = (x * r[2] + y * r[5]) + z * r[8];
    }

    // Compute a ray and return the length of its direction, as `cast_pairs` in body_rays.py does.
    __device__ __forceinline__ double make(const Scene& scene, int i, Ray& ray) const
    {
        const double* pose = poses + 12 * (Count)row;
        double at[3];
        const double x = rays[i] - pose[0], y = rays[count + i] - pose[1];
        const double z = rays[2 * count + i] - pose[2];
        take(pose + 3, x, y, z, at[0], at[1], at[2]);
        place_origin(scene, at, ray);
        double u, v, w;
        take(pose + 3, rays[3 * count + i], rays[4 * count + i], rays[5 * count + i], u, v, w);
        const double squared = (u * u + v * v) + w * w;
        if (fabs(squared - 1.0) > UNIT_SLACK) {
            const double most = fmax(fabs(u), fmax(fabs(v), fabs(w)));
            u = u / most;
            v = v / most;
            w = w / most;
            const double rest = sqrt((u * u + v * v) + w * w);
            u = u / rest;
            v = v / rest;
            w = w / rest;
        }
        ray.dx = u;
        ray.dy = v;
        ray.dz = w;
        return sqrt(squared);
    }

    __device__ __forceinline__ Ray load(const Scene& scene, int i) const
    {
        Ray out;
        make(scene, i, out);
        return out;
    }
};

// Transform a ray from scene to mesh coordinates with the operations of
// `LocalScene.to_mesh_coordinates`. Return the length of its direction before normalization.
__device__ __forceinline__ double enter_mesh(const Scene& scene, int instance, Ray& ray)
{
    if (!NESTED) return 1.0;
    const double* m = scene.instances + RECORD * (Count)instance;
    const double x = (m[0] * ray.dx + m[1] * ray.dy) + m[2] * ray.dz;
    const double y = (m[4] * ray.dx + m[5] * ray.dy) + m[6] * ray.dz;
    const double z = (m[8] * ray.dx + m[9] * ray.dy) + m[10] * ray.dz;
    const double length = sqrt((x * x + y * y) + z * z);
    const double u = ((m[0] * ray.ox + m[1] * ray.oy) + m[2] * ray.oz) + m[3];
    const double v = ((m[4] * ray.ox + m[5] * ray.oy) + m[6] * ray.oz) + m[7];
    const double w = ((m[8] * ray.ox + m[9] * ray.oy) + m[10] * ray.oz) + m[11];
    ray.ox = u;
    ray.oy = v;
    ray.oz = w;
    ray.dx = x / length;
    ray.dy = y / length;
    ray.dz = z / length;
    return length;
}

// ---- the exact test ----

__device__ __forceinline__ double pick(int axis, double x, double y, double z)
{
    return axis == 0 ? x : (axis == 1 ? y : z);
}

__device__ __forceinline__ int next_axis(int axis) { return axis == 2 ? 0 : axis + 1; }

__device__ __forceinline__ bool decide(const Scene& scene, const Ray& ray, int place, Exact& out)
{
    SEEN(DECISION);
    const double ax = fabs(ray.dx), ay = fabs(ray.dy), az = fabs(ray.dz);
    const int kz = ax >= ay ? (ax >= az ? 0 : 2) : (ay >= az ? 1 : 2);
    const int kx = next_axis(kz), ky = next_axis(kx);
    const double along = pick(kz, ray.dx, ray.dy, ray.dz);
    const double sx = pick(kx, ray.dx, ray.dy, ray.dz) / along;
    const double sy = pick(ky, ray.dx, ray.dy, ray.dz) / along;
    const double sz = 1.0 / along;
    const double ox = pick(kx, ray.ox, ray.oy, ray.oz);
    const double oy = pick(ky, ray.ox, ray.oy, ray.oz);
    const double oz = pick(kz, ray.ox, ray.oy, ray.oz);
    const double* p = scene.corners + 9 * (Count)place;
    const double z0 = p[kz] - oz, z1 = p[3 + kz] - oz, z2 = p[6 + kz] - oz;
    const double x0 = (p[kx] - ox) - sx * z0, y0 = (p[ky] - oy) - sy * z0;
    const double x1 = (p[3 + kx] - ox) - sx * z1, y1 = (p[3 + ky] - oy) - sy * z1;
    const double x2 = (p[6 + kx] - ox) - sx * z2, y2 = (p[6 + ky] - oy) - sy * z2;
    out.a = x2 * y1 - y2 * x1;
    out.b = x0 * y2 - y0 * x2;
    out.c = x1 * y0 - y1 * x0;
    out.det = (out.a + out.b) + out.c;
    out.t = (((out.a * z0 + out.b * z1) + out.c * z2) / out.det) * sz;
    const bool above = out.a >= 0 && out.b >= 0 && out.c >= 0;
    const bool below = out.a <= 0 && out.b <= 0 && out.c <= 0;
    return (above || below) && out.det != 0;
}

// Return whether the mesh is opaque where a ray hits a triangle, as `MaskTables.is_opaque` does.
__device__ __forceinline__ bool opaque(const Scene& scene, int mesh, int place, const Exact& hit)
{
    const Count* record = scene.opacity + 4 * (Count)mesh;
    const int height = (int)record[2], width = (int)record[3];
    if (height == 0) return true;
    const float* uv = scene.uvs + 6 * (place + record[0]);
    const double p = hit.a / hit.det, q = hit.b / hit.det, r = hit.c / hit.det;
    const double u = (p * uv[0] + q * uv[2]) + r * uv[4];
    const double v = (p * uv[1] + q * uv[3]) + r * uv[5];
    const int across = (int)((u - floor(u)) * width), down = (int)((v - floor(v)) * height);
    const int column = across < width ? across : width - 1;
    const int row = down < height ? down : height - 1;
    return scene.masks[record[1] + row * (Count)width + column];
}

// ---- traversal ----

// The ray in float, starting where it enters the box of the scene or of an instance's mesh.
struct Walk {
    float ox, oy, oz, dx, dy, dz;  // start and direction
    float ix, iy, iz;              // 1 / direction
    float sx, sy, sz;              // start / direction
    unsigned nx, ny, nz;           // float4 of a node that contains the closer planes
    double entry;                  // distance of the start from the origin
    float from, to;                // minimum and maximum distance of a hit from the start
};

// Return a distance from the start of the traversal in float, never less than the exact distance.
__device__ __forceinline__ float limit(double t, double entry)
{
    const double left = (t - entry) * (1.0 + SLACK) + SLACK;
    return (float)(left < MAX_DIAGONAL ? left : MAX_DIAGONAL);
}

// Clip [entry, leave] to the part of the ray between two planes.
__device__ __forceinline__ void clip(
    double low, double high, double o, double d, double& entry, double& leave)
{
    const double along = fabs(d) < TINY ? (d < 0 ? -TINY : TINY) : d;
    const double one = (low - o) / along, two = (high - o) / along;
    entry = fmax(entry, fmin(one, two));
    leave = fmin(leave, fmax(one, two));
}

// Return a coordinate of the start of the traversal. It is clipped, because double cannot represent it
// accurately if the ray is too far away.
__device__ __forceinline__ float start(double o, double d, double entry)
{
    return (float)fmin(fmax(o + entry * d, -2.0), 2.0);
}

__device__ __forceinline__ float reciprocal(float d)
{
    return 1.0f / (fabsf(d) < (float)TINY ? (d < 0.0f ? -(float)TINY : (float)TINY) : d);
}

// Prepare the traversal. Return false if the ray misses the box, which has 6 doubles.
__device__ __forceinline__ bool begin(
    const double* low, const Ray& ray, double t_min, double t_max, Walk& w)
{
    const double* high = low + 3;
    double entry = 0.0;
    const bool inside = ray.ox >= low[0] && ray.ox <= high[0] && ray.oy >= low[1] &&
                        ray.oy <= high[1] && ray.oz >= low[2] && ray.oz <= high[2];
    if (!inside) {
        double leave = t_max;
        clip(low[0], high[0], ray.ox, ray.dx, entry, leave);
        clip(low[1], high[1], ray.oy, ray.dy, entry, leave);
        clip(low[2], high[2], ray.oz, ray.dz, entry, leave);
        if (!(entry <= leave + SLACK)) return false;
    }
    w.entry = entry;
    w.ox = start(ray.ox, ray.dx, entry);
    w.oy = start(ray.oy, ray.dy, entry);
    w.oz = start(ray.oz, ray.dz, entry);
    w.dx = (float)ray.dx;
    w.dy = (float)ray.dy;
    w.dz = (float)ray.dz;
    w.ix = reciprocal(w.dx);
    w.iy = reciprocal(w.dy);
    w.iz = reciprocal(w.dz);
    w.sx = w.ox * w.ix;
    w.sy = w.oy * w.iy;
    w.sz = w.oz * w.iz;
    w.nx = w.ix < 0.0f ? 3u : 0u;
    w.ny = w.iy < 0.0f ? 4u : 1u;
    w.nz = w.iz < 0.0f ? 5u : 2u;
    w.from = (float)fmax((t_min - entry) * (1.0 - SLACK) - SLACK, -MAX_DIAGONAL);
    w.to = limit(t_max, entry);
    return true;
}

// Return the distance at which the ray enters the box of a child. `met` is set to whether the ray
// intersects the box before the distance `to`.
__device__ __forceinline__ float enter(
    const Walk& w, float nx, float ny, float nz, float fx, float fy, float fz, bool& met)
{
    const float near = fmaxf(fmaxf(fmaf(nx, w.ix, -w.sx), fmaf(ny, w.iy, -w.sy)),
                             fmaxf(fmaf(nz, w.iz, -w.sz), 0.0f));
    const float far = fminf(fminf(fmaf(fx, w.ix, -w.sx), fmaf(fy, w.iy, -w.sy)),
                            fminf(fmaf(fz, w.iz, -w.sz), w.to));
    met = near <= far;
    return near;
}

// Swap two children if the second one is closer.
__device__ __forceinline__ void order(float& t0, int& c0, float& t1, int& c1)
{
    const bool swap = t1 < t0;
    const float t = swap ? t0 : t1;
    const int c = swap ? c0 : c1;
    t0 = swap ? t1 : t0;
    c0 = swap ? c1 : c0;
    t1 = t;
    c1 = c;
}

// A pending node and the distance at which the ray enters it.
struct alignas(8) Waiting {
    int node;
    float t;
};

// The top of the stack is a separate variable. As a member next to the array, it would be in local
// memory, and every push would wait for it.
__device__ __forceinline__ void push(Waiting* stack, int& top, int node, float t)
{
    if (t < MISSED) {
        const Waiting entry = {node, t};
        stack[top++] = entry;
    }
}

__device__ __forceinline__ int pop(const Waiting* stack, int& top, int bottom, float to)
{
    while (top > bottom) {
        const Waiting entry = stack[--top];
        if (entry.t <= to) return entry.node;
    }
    return DONE;
}

// Test the children of a node. Return the closest child that the ray intersects, and push the others.
// Entries of the stack below `bottom` belong to another traversal.
__device__ __forceinline__ int descend(
    const float4* nodes, int node, const Walk& w, Waiting* stack, int& top, int bottom)
{
    SEEN(NODE);
    // 32 bits are sufficient for fewer than 2^28 nodes, and a 64-bit addition takes two instructions.
    const unsigned line = 8u * (unsigned)node;
    const float4 nx = nodes[line + w.nx], ny = nodes[line + w.ny], nz = nodes[line + w.nz];
    const float4 fx = nodes[line + 3u - w.nx], fy = nodes[line + 5u - w.ny];
    const float4 fz = nodes[line + 7u - w.nz];
    const float4 codes = nodes[line + 6u];
    bool met0, met1, met2, met3;
    float t0 = enter(w, nx.x, ny.x, nz.x, fx.x, fy.x, fz.x, met0);
    float t1 = enter(w, nx.y, ny.y, nz.y, fx.y, fy.y, fz.y, met1);
    float t2 = enter(w, nx.z, ny.z, nz.z, fx.z, fy.z, fz.z, met2);
    float t3 = enter(w, nx.w, ny.w, nz.w, fx.w, fy.w, fz.w, met3);
    int c0 = __float_as_int(codes.x), c1 = __float_as_int(codes.y);
    int c2 = __float_as_int(codes.z), c3 = __float_as_int(codes.w);
    // Usually, all rays of a warp intersect at most one child, and sorting is not necessary.
    if ((met0 & met1) | (met2 & met3) | ((met0 | met1) & (met2 | met3))) {
        t0 = met0 ? t0 : MISSED;
        t1 = met1 ? t1 : MISSED;
        t2 = met2 ? t2 : MISSED;
        t3 = met3 ? t3 : MISSED;
        order(t0, c0, t1, c1);
        order(t2, c2, t3, c3);
        order(t0, c0, t2, c2);
        order(t1, c1, t3, c3);
        order(t1, c1, t2, c2);
        push(stack, top, c3, t3);
        push(stack, top, c2, t2);
        push(stack, top, c1, t1);
        return c0;
    }
    if (met0 || met1 || met2 || met3) return met0 ? c0 : (met1 ? c1 : (met2 ? c2 : c3));
    return pop(stack, top, bottom, w.to);
}

// Result of the float test for a triangle that the ray may hit: bounds of the distance from the start of
// the traversal, and whether the ray definitely hits the triangle within the limits.
struct Guess {
    float near, far;
    bool sure;
};

// The test of Moeller and Trumbore in float. It returns false only if the ray definitely misses the
// triangle or hits it outside [from, to].
__device__ __forceinline__ bool may_hit(const float4* record, const Walk& w, Guess& guess)
{
    SEEN(TRIANGLE);
    const float4 v = record[0], e = record[1], g = record[2];
    const float px = fmaf(w.dy, g.z, -(w.dz * g.y));
    const float py = fmaf(w.dz, g.x, -(w.dx * g.z));
    const float pz = fmaf(w.dx, g.y, -(w.dy * g.x));
    const float det = fmaf(e.x, px, fmaf(e.y, py, e.z * pz));
    const float size = fabsf(det);
    const float sign = det < 0.0f ? -1.0f : 1.0f;
    const float tx = w.ox - v.x, ty = w.oy - v.y, tz = w.oz - v.z;
    const float b = sign * fmaf(tx, px, fmaf(ty, py, tz * pz));
    const float qx = fmaf(ty, e.z, -(tz * e.y));
    const float qy = fmaf(tz, e.x, -(tx * e.z));
    const float qz = fmaf(tx, e.y, -(ty * e.x));
    const float c = sign * fmaf(w.dx, qx, fmaf(w.dy, qy, w.dz * qz));
    const float t = sign * fmaf(g.x, qx, fmaf(g.y, qy, g.z * qz));
    const bool may = b >= -v.w && c >= -e.w && b + c <= size + (v.w + e.w) &&
                     t >= fmaf(w.from, size, -g.w) && t <= fmaf(w.to, size, g.w);
    if (!may) return false;
    // If the ray is inside by more than the bands, det is far from zero and its sign is correct.
    guess.sure = b >= v.w && c >= e.w && b + c <= size - (v.w + e.w);
    const float scale = 1.0f / size;
    guess.near = guess.sure ? (t - g.w) * scale * (1.0f - SLACK) - SLACK : w.from;
    guess.far = guess.sure ? (t + g.w) * scale * (1.0f + SLACK) + SLACK : w.to;
    guess.sure = guess.sure && guess.near >= w.from + 16.0f * SLACK;
    return true;
}

// The closest hit so far: distance in scene coordinates, row in the tables (-1 for no hit), and instance.
//
// The exact test costs as much as several nodes, and the rays of a warp reach their triangles at
// different times. Therefore, candidates are kept until all rays of the warp have finished or have no
// room left for more. A definite hit shortens the traversal immediately.
struct Closest {
    double t;
    int place, instance;
    int one, two;              // pending triangles, or -1
    float near_one, near_two;  // lower bounds of their distances

    __device__ __forceinline__ Closest(double t_max) : t(t_max), place(-1), instance(0), one(-1), two(-1) {}

    // Add a triangle. Return false if there is no room for another one.
    __device__ __forceinline__ bool offer(int at, const Guess& guess, Walk& w)
    {
        // If there are masks, the triangle may be transparent at the hit.
        if (guess.sure && !MASKED) w.to = fminf(w.to, guess.far);
        if (one >= 0 && near_one > w.to) one = -1;
        if (two >= 0 && near_two > w.to) two = -1;
        if (one < 0) {
            one = at;
            near_one = guess.near;
        } else {
            two = at;
            near_two = guess.near;
        }
        return one < 0 || two < 0;
    }

    // Test the pending triangles of an instance in double.
    template <class Rays>
    __device__ __forceinline__ void settle(
        const Scene& scene, const Rays& rays, int i, int inside, double t_min, Walk& w)
    {
#pragma unroll 1  // one copy of the test
        for (int turn = 0; turn < 2; ++turn) {
            const int at = turn == 0 ? one : two;
            if (at < 0 || (turn == 0 ? near_one : near_two) > w.to) continue;
            Exact hit;
            // The ray is loaded again, because keeping it in double during the traversal takes
            // too many registers.
            Ray ray = rays.load(scene, i);
            const double length = enter_mesh(scene, inside, ray);
            if (!decide(scene, ray, at, hit)) continue;
            hit.t = hit.t / length;
            if (!(hit.t >= t_min)) continue;
            bool tie = hit.t == t;
            if (tie && place >= 0)
                tie = NESTED && inside != instance ? inside < instance
                                                   : scene.faces[at] < scene.faces[place];
            const int mesh = NESTED ? (int)scene.instances[RECORD * (Count)inside + 19] : 0;
            if ((hit.t < t || tie) && (!MASKED || opaque(scene, mesh, at, hit))) {
                t = hit.t;
                place = at;
                instance = inside;
                w.to = fminf(w.to, limit(t * length, w.entry));
            }
        }
        one = two = -1;
    }
};

// Find the closest hit on an instance. Nodes and triangles have separate loops (Aila and Laine, 2009), so
// that the rays of a warp do the same work at the same time.
template <class Rays>
__device__ __forceinline__ void visit(
    const Scene& scene, const Rays& rays, int i, int inside, double t_min, Waiting* stack,
    int bottom, Closest& best)
{
    const double* record = scene.instances + RECORD * (Count)inside;
    Ray ray = rays.load(scene, i);
    const double length = enter_mesh(scene, inside, ray);
    Walk w;
    if (!begin(NESTED ? record + 12 : scene.frame + 4, ray, t_min * length, best.t * length, w))
        return;
    int top = bottom, node = NESTED ? (int)record[18] : 0;
    do {
        bool room = true;
        while (node != DONE && room) {
            while (node >= 0) node = descend(scene.nodes, node, w, stack, top, bottom);
            while (node < 0 && node != DONE && room) {
                const int leaf = ~node, place = leaf >> LEAF_BITS;
                Guess guess;
                if (may_hit(scene.triangles + 3 * (Count)place, w, guess))
                    room = best.offer(place, guess, w);
                // The remaining triangles of the leaf have a larger first index and a smaller count.
                const bool more = leaf & ((1 << LEAF_BITS) - 1);
                node = more ? ~(leaf + (1 << LEAF_BITS) - 1) : pop(stack, top, bottom, w.to);
            }
        }
        best.settle(scene, rays, i, inside, t_min, w);
    } while (node != DONE);
}

// Return the next instance that the ray may hit, from close to far, or DONE if there are no more.
//
// The ray is prepared again, because keeping it while an instance is visited takes twice as many
// registers.
template <class Rays>
__device__ __forceinline__ int next_instance(
    const Scene& scene, const Rays& rays, int i, double t_min, double t_max,
    Waiting* stack, int& top)
{
    Walk w;
    if (!begin(scene.frame + 4, rays.load(scene, i), t_min, t_max, w)) return DONE;
    int node = pop(stack, top, 0, w.to);
    while (node >= 0) node = descend(scene.top, node, w, stack, top, 0);
    return node == DONE ? DONE : ~node >> LEAF_BITS;
}

template <class Rays>
__device__ __forceinline__ void walk(
    const Scene& scene, const Rays& rays, int i, double t_min, Closest& best)
{
    Waiting stack[STACK];
    if (!NESTED) {
        visit(scene, rays, i, 0, t_min, stack, 0, best);
        return;
    }
    const Waiting root = {0, 0.0f};
    stack[0] = root;
    int top = 1, instance;
    while ((instance = next_instance(scene, rays, i, t_min, best.t, stack, top)) != DONE)
        visit(scene, rays, i, instance, t_min, stack, top, best);
}

// ---- kernels: scene, rays in, hits out ----

// Cast rays from memory and write the closest hits: local distance, row of the tables, and instance. The
// instance is only written for scenes with instances. For a ray that misses, only the row -1 is written.
KERNEL cast_table(
    const float4* __restrict__ nodes, const float4* __restrict__ triangles,
    const double* __restrict__ corners, const int* __restrict__ faces,
    const float* __restrict__ uvs, const unsigned char* __restrict__ masks,
    const Count* __restrict__ opacity,
    const double* __restrict__ frame, const float4* __restrict__ top,
    const double* __restrict__ instances,
    const double* __restrict__ origins, Count origin_count,
    const double* __restrict__ directions, Count count, double t_min, double t_max,
    double* __restrict__ distance, int* __restrict__ place, int* __restrict__ instance)
{
    const int i = (int)(blockIdx.x * blockDim.x + threadIdx.x);
    if (i >= count) return;
    const Scene scene = {nodes, triangles, corners, faces, uvs,
                         masks, opacity,   frame,   top,   instances};
    const TableRays rays = {origins, origin_count, directions, count};
    Closest best(t_max);
    walk(scene, rays, i, t_min, best);
    place[i] = best.place;
    if (best.place >= 0) distance[i] = best.t;
    if (NESTED && best.place >= 0) instance[i] = best.instance;
}

#undef BLOCKS
#define BLOCKS (NESTED ? (MASKED ? 2 : 3) : 4)

// Cast rays at moving bodies that have the shape of the scene, and record closer hits, as `cast_pairs` in
// body_rays.py does. Ray i is fired at the time index t = when[i] - first_time. If 0 <= t < times, the
// pose of body k at this time is row t * body_count + k of `poses`, with 12 doubles per row. It starts
// with NaN while the body is absent. Each of the `boxes` encloses a body during TIMES_PER_BOX times and
// consists of a lower and an upper corner. The arrays `nearest_...` are read and written.
KERNEL cast_bodies(
    const float4* __restrict__ nodes, const float4* __restrict__ triangles,
    const double* __restrict__ corners, const int* __restrict__ faces,
    const float* __restrict__ uvs, const unsigned char* __restrict__ masks,
    const Count* __restrict__ opacity,
    const double* __restrict__ frame, const float4* __restrict__ top,
    const double* __restrict__ instances,
    const double* __restrict__ rays, const int* __restrict__ when, Count count,
    const Count* __restrict__ bodies, int body_count,
    const double* __restrict__ poses, const double* __restrict__ boxes,
    int first_time, int times, double t_min, double t_max,
    double* __restrict__ nearest_meters, Count* __restrict__ nearest_body,
    int* __restrict__ nearest_instance, int* __restrict__ nearest_triangle)
{
    const int i = (int)(blockIdx.x * blockDim.x + threadIdx.x);
    if (i >= count) return;
    const int time = when[i] - first_time;
    if (time < 0 || time >= times) return;
    const Scene scene = {nodes, triangles, corners, faces, uvs,
                         masks, opacity,   frame,   top,   instances};
#pragma unroll 1
    for (int k = 0; k < body_count; ++k) {
        const double* low = boxes + 6 * ((Count)(time / TIMES_PER_BOX) * body_count + k);
        double enters = 0.0, leaves = nearest_meters[i] * (1.0 + SLACK);
        for (int axis = 0; axis < 3; ++axis) {
            const double o = rays[axis * count + i], d = rays[(3 + axis) * count + i];
            clip(low[axis], low[3 + axis], o, d, enters, leaves);
        }
        // The row fits into an int, because CHUNK_POSES in moving.py limits the number of poses.
        const int row = time * body_count + k;
        const double absent = poses[12 * (Count)row];
        if (!(enters <= leaves) || absent != absent) continue;
        const BodyRays own = {rays, count, poses, row};
        Ray ray;
        const double reach = nearest_meters[i] * frame[3] * (1.0 + SLACK);
        Closest best(fmin(t_max, reach * own.make(scene, i, ray)));
        walk(scene, own, i, t_min, best);
        if (best.place < 0) continue;
        const double meters = best.t / frame[3] / own.make(scene, i, ray);
        const bool first = meters == nearest_meters[i] && bodies[k] < nearest_body[i];
        if (!(meters < nearest_meters[i] || first)) continue;
        nearest_meters[i] = meters;
        nearest_body[i] = bodies[k];
        nearest_instance[i] = NESTED ? best.instance : 0;
        nearest_triangle[i] = faces[best.place];
    }
}

#undef BLOCKS
#define BLOCKS (NESTED ? 4 : MASKED ? 5 : PLAIN_BLOCKS)

// Write the barycentric weights of the second and third vertex for the hits of listed rays in the
// results of `cast_table`.
KERNEL weigh_table(
    const double* __restrict__ corners, const double* __restrict__ frame,
    const double* __restrict__ instances,
    const double* __restrict__ origins, Count origin_count,
    const double* __restrict__ directions, Count ray_count,
    const unsigned int* __restrict__ ray, const int* __restrict__ place,
    const int* __restrict__ instance, Count count, double* __restrict__ u, double* __restrict__ v)
{
    const Count k = blockIdx.x * (Count)blockDim.x + threadIdx.x;
    if (k >= count) return;
    const Scene scene = {0, 0, corners, 0, 0, 0, 0, frame, 0, instances};
    const TableRays rays = {origins, origin_count, directions, ray_count};
    Ray at = rays.load(scene, ray[k]);
    enter_mesh(scene, NESTED ? instance[ray[k]] : 0, at);
    Exact hit;
    decide(scene, at, place[ray[k]], hit);
    u[k] = hit.b / hit.det;
    v[k] = hit.c / hit.det;
}

// ---- output of hits ----

// Replace hits by external hits that are closer, at most one per ray. Local distances are divided by
// `scale` for the comparison. The place of a replaced hit becomes -2 - k for external hit k.
KERNEL replace(
    const unsigned int* __restrict__ ray, const double* __restrict__ meters, Count count,
    Count start, double scale, const double* __restrict__ distance, int* __restrict__ place)
{
    const Count k = blockIdx.x * (Count)blockDim.x + threadIdx.x;
    if (k >= count) return;
    const Count i = (Count)ray[k] - start;
    if (place[i] < 0 || meters[k] < distance[i] / scale) place[i] = -2 - (int)k;
}

// Add 1 to a row of a tally for each thread with `counts`. All threads of a warp must call this function.
// Neighboring rays often hit the same triangle, so the threads of a warp that count the same row add only
// once.
__device__ __forceinline__ void count_row(unsigned long long* tally, Count row, bool counts)
{
    const unsigned counting = __ballot_sync(~0u, counts);
    if (!counts) return;
    const unsigned same = __match_any_sync(counting, (unsigned long long)row);
    if (threadIdx.x % 32 == (unsigned)__ffs((int)same) - 1)
        atomicAdd(tally + row, (unsigned long long)__popc(same));
}

// Compact the hits to store, in ray order: index of the ray, starting at `start`, distance in meters, the
// caller's triangle, and instance. The arguments `other_...` describe the external hits of `replace`.
//
// `ends` contains the inclusive cumulative sums of hits. In each group of rays, every n-th hit is stored,
// where n is `every`. `groups` has three rows of `group_count`: the first ray of each group, the index of
// its first hit to store among all hits, and the position of this hit in the output. It is not read if
// `every` is 1. `counters` contains two numbers per instance, first and step. Hits on its triangle t are
// counted in row first + step * t of `tally`, including hits that are not stored. It is not read if
// `counting` is 0.
KERNEL pack(
    const int* __restrict__ faces, const double* __restrict__ distance,
    const int* __restrict__ place, const int* __restrict__ instance,
    const int* __restrict__ ends, Count count, double scale, Count start,
    const double* __restrict__ other_meters, const int* __restrict__ other_triangle,
    int other_instance,
    const int* __restrict__ groups, int group_count, int every,
    const Count* __restrict__ counters, int counting, unsigned long long* __restrict__ tally,
    unsigned int* __restrict__ ray, double* __restrict__ meters, int* __restrict__ triangle,
    int* __restrict__ which)
{
    const Count i = blockIdx.x * (Count)blockDim.x + threadIdx.x;
    const bool hit = i < count && place[i] != -1;
    int face = 0, in = 0;
    if (hit) {
        const int row = place[i];
        face = row < 0 ? other_triangle[-2 - row] : faces[row];
        in = row < 0 ? other_instance : NESTED ? instance[i] : 0;
    }
    if (counting) count_row(tally, counters[2 * in] + counters[2 * in + 1] * face, hit);
    if (!hit) return;
    int k = ends[i] - 1;
    if (every > 1) {
        int group = 0;
        for (int high = group_count; high - group > 1;) {
            const int middle = (group + high) / 2;
            if (groups[middle] <= i)
                group = middle;
            else
                high = middle;
        }
        k -= groups[group_count + group];
        if (k < 0 || k % every != 0) return;
        k = groups[2 * group_count + group] + k / every;
    }
    ray[k] = (unsigned int)(start + i);
    meters[k] = place[i] < 0 ? other_meters[-2 - place[i]] : distance[i] / scale;
    triangle[k] = face;
    which[k] = in;
}

// Compute the rays of a pattern as a table with 6 rows of `count`: origins in meters and directions. They
// are bit-identical to the result of `pattern_rays`.
KERNEL make_rays(
    const double* __restrict__ positions, const double* __restrict__ rotations,
    const double* __restrict__ directions, const double* __restrict__ origins,
    Count rows, Count first, int left, int each, int turned, int shifted,
    const double* __restrict__ delays, const double* __restrict__ rates, int moving,
    Count count, double* __restrict__ table)
{
    const int i = (int)(blockIdx.x * blockDim.x + threadIdx.x);
    if (i >= count) return;
    const PatternRays rays = {positions, rotations, directions, origins, rows,
                              first,     left,      each,       turned,  shifted,
                              delays,    rates,     moving};
    double at[3], to[3];
    rays.make(i, at, to);
    for (int axis = 0; axis < 3; ++axis) {
        table[axis * count + i] = at[axis];
        table[(3 + axis) * count + i] = to[axis];
    }
}
