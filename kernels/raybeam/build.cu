// Builds the tables of intersect.cu on the device: a binary tree by parallel locally-ordered
// clustering (Meister and Bittner, 2018) below and a sweep on the host above the last clusters,
// made four-wide from the root down.
//
// Step by step the arithmetic and the choices among equals are those of ploc.py, tree.py and
// layout.py, so the tables have the same bits as those built on the CPU (compiled with
// -fmad=false). Nothing depends on the order in which threads run: there are no atomics here,
// and places are handed out by prefix sums between the kernels. cuda_build.py drives them.
//
// Between the blocks of a launch nothing passes: a kernel reads what earlier launches wrote, and
// no two of its threads write to one place or read what another writes. (merge() and
// join_children() read and write `boxes`, but nodes of earlier rounds and of this one;
// place_children() reads a parent's place and writes its children's, of an earlier round.) The
// stream puts launches in order, so neither fences nor barriers are needed. Nodes are numbered
// below 2^29 and leaves' codes below 2^31; offsets are 64 bits wide.
//
// Compiled by NVRTC, which has no standard headers, so there are none here; the tests compile the
// same text for the CPU. One thread an item, blocks of 128 threads, a grid of one dimension.
// Defined on the command line: RADIUS (neighbours looked at on either side), LEAF_SIZE (most
// triangles of a leaf), PAD, UNIT and FLOOR (of tree.py and layout.py).
//
//   order      int a triangle: its row in the mesh, by position along the Z-order curve.
//   boxes      2 float4 a node of the binary tree: low x, y, z and cost; high x, y, z and, as
//              integer bits, count << 1 | leaf. Nodes 0 to n - 1 are the triangles in Z-order,
//              n to 2 n - 2 inner ones, the last is the root.
//   children   int2 an inner node, from node n on.
//   ids        int a cluster: the node that it is.
//   sums       Count a cluster: inclusive prefix sums of what vote() writes.

typedef long long Count;
typedef unsigned long long Code;

#define KERNEL extern "C" __global__ void __launch_bounds__(128)
#define WIDTH 4
#define LEAF_BITS 3
#define GRID_BITS 21
#define FIRST ((Count)1 << 32)  // in vote(): this cluster takes in its partner; else 1: it stays
#define INFINITE __int_as_float(0x7f800000)

struct Box {
    float4 low, high;
};

__device__ __forceinline__ Count thread_number()
{
    return blockIdx.x * (Count)blockDim.x + threadIdx.x;
}

__device__ __forceinline__ Box load_box(const float4* boxes, int node)
{
    const Box box = {boxes[2 * (Count)node], boxes[2 * (Count)node + 1]};
    return box;
}

__device__ __forceinline__ float half_area(float x, float y, float z)
{
    return x * y + y * z + z * x;
}

__device__ __forceinline__ float area(const Box& box)
{
    return half_area(
        box.high.x - box.low.x, box.high.y - box.low.y, box.high.z - box.low.z);
}

__device__ __forceinline__ Box join(const Box& a, const Box& b)
{
    const Box box = {
        {fminf(a.low.x, b.low.x), fminf(a.low.y, b.low.y), fminf(a.low.z, b.low.z), 0.0f},
        {fmaxf(a.high.x, b.high.x), fmaxf(a.high.y, b.high.y), fmaxf(a.high.z, b.high.z), 0.0f}};
    return box;
}

__device__ __forceinline__ int info(const Box& box) { return __float_as_int(box.high.w); }
__device__ __forceinline__ bool is_leaf(const Box& box) { return info(box) & 1; }
__device__ __forceinline__ int count_of(const Box& box) { return info(box) >> 1; }

__device__ __forceinline__ float low_of(const double* p, int axis)
{
    return (float)(fmin(fmin(p[axis], p[3 + axis]), p[6 + axis]) - PAD);
}

__device__ __forceinline__ float high_of(const double* p, int axis)
{
    return (float)(fmax(fmax(p[axis], p[3 + axis]), p[6 + axis]) + PAD);
}

// ---- the order along the curve ----

// Twice the middle of each triangle's box: three rows of `count`.
KERNEL find_middles(const double* __restrict__ corners, Count count, double* __restrict__ middles)
{
    const Count i = thread_number();
    if (i >= count) return;
    const double* p = corners + 9 * i;
    for (int axis = 0; axis < 3; ++axis)
        middles[axis * count + i] = (double)low_of(p, axis) + (double)high_of(p, axis);
}

// Two zero bits after each of the 21 lowest bits.
__device__ __forceinline__ Code spread(Code bits)
{
    bits = (bits | bits << 32) & 0x1F00000000FFFFull;
    bits = (bits | bits << 16) & 0x1F0000FF0000FFull;
    bits = (bits | bits << 8) & 0x100F00F00F00F00Full;
    bits = (bits | bits << 4) & 0x10C30C30C30C30C3ull;
    return (bits | bits << 2) & 0x1249249249249249ull;
}

KERNEL encode(
    const double* __restrict__ middles, Count count, double x, double y, double z, double factor,
    Code* __restrict__ codes)
{
    const Count i = thread_number();
    if (i >= count) return;
    const Code a = (Code)((middles[i] - x) * factor);
    const Code b = (Code)((middles[count + i] - y) * factor);
    const Code c = (Code)((middles[2 * count + i] - z) * factor);
    codes[i] = spread(a) << 2 | spread(b) << 1 | spread(c);
}

// Every triangle a cluster of its own.
KERNEL start_clusters(
    const double* __restrict__ corners, const int* __restrict__ order, Count count,
    float4* __restrict__ boxes, int* __restrict__ ids)
{
    const Count i = thread_number();
    if (i >= count) return;
    const double* p = corners + 9 * (Count)order[i];
    Box box = {{low_of(p, 0), low_of(p, 1), low_of(p, 2), 0.0f},
               {high_of(p, 0), high_of(p, 1), high_of(p, 2), __int_as_float(1 << 1 | 1)}};
    box.low.w = area(box);
    boxes[2 * i] = box.low;
    boxes[2 * i + 1] = box.high;
    ids[i] = (int)i;
}

// ---- a round of clustering ----

// The neighbour with which each cluster has the least common box. Where all are equally good it
// is the other one of the pairs (0, 1), (2, 3), ..., so that partners find each other.
KERNEL find_partners(
    const float4* __restrict__ boxes, const int* __restrict__ ids, int count,
    int* __restrict__ partners)
{
    const int i = (int)thread_number();
    if (i >= count) return;
    const Box box = load_box(boxes, ids[i]);
    int best = (i ^ 1) < count ? i ^ 1 : i;
    float least = best != i ? area(join(box, load_box(boxes, ids[best]))) : INFINITE;
    for (int step = 1; step <= RADIUS; ++step) {
        for (int side = 0; side < 2; ++side) {
            const int j = side ? i - step : i + step;
            if (j < 0 || j >= count) continue;
            const float size = area(join(box, load_box(boxes, ids[j])));
            if (size < least) {
                least = size;
                best = j;
            }
        }
    }
    partners[i] = best;
}

// FIRST + 1 for the first of two that are each other's partner, 0 for the second, else 1.
KERNEL vote(const int* __restrict__ partners, int count, Count* __restrict__ votes)
{
    const int i = (int)thread_number();
    if (i >= count) return;
    const int j = partners[i];
    const bool mutual = partners[j] == i && j != i;
    votes[i] = mutual ? (i < j ? FIRST + 1 : 0) : 1;
}

// Make the node of two clusters: one leaf where that costs no more than going on to both, by the
// surface area heuristic, a triangle test taken to cost as much as a box test.
__device__ __forceinline__ Box make_node(const Box& left, const Box& right)
{
    Box box = join(left, right);
    const int count = count_of(left) + count_of(right);
    const float size = area(box);
    const double whole = (double)size * count;
    const float split = size + left.low.w + right.low.w;
    const bool leaf = count <= LEAF_SIZE && whole <= (double)split;
    box.low.w = leaf ? (float)whole : split;
    box.high.w = __int_as_float(count << 1 | (leaf ? 1 : 0));
    return box;
}

// Make the round's nodes, from `next` on, and list the clusters that are left.
KERNEL merge(
    const int* __restrict__ partners, const Count* __restrict__ sums,
    const int* __restrict__ ids, int count, int next, int triangles, float4* __restrict__ boxes,
    int2* __restrict__ children, int* __restrict__ left_over)
{
    const int i = (int)thread_number();
    if (i >= count) return;
    const Count before = i ? sums[i - 1] : 0, vote = sums[i] - before;
    if (vote == 0) return;
    int node = ids[i];
    if (vote != 1) {
        const int other = ids[partners[i]];
        const Box box = make_node(load_box(boxes, node), load_box(boxes, other));
        const int2 pair = {node, other};
        node = next + (int)(before >> 32);
        boxes[2 * (Count)node] = box.low;
        boxes[2 * (Count)node + 1] = box.high;
        children[node - triangles] = pair;
    }
    left_over[(int)(before & (FIRST - 1))] = node;
}

// Make nodes `from` to `from + count - 1` from their children, which are there already.
KERNEL join_children(
    const int2* __restrict__ children, int from, int count, int triangles,
    float4* __restrict__ boxes)
{
    const int i = (int)thread_number();
    if (i >= count) return;
    const int2 pair = children[from - triangles + i];
    const Box box = make_node(load_box(boxes, pair.x), load_box(boxes, pair.y));
    boxes[2 * (Count)(from + i)] = box.low;
    boxes[2 * (Count)(from + i) + 1] = box.high;
}

// Where the triangles under nodes `from` to `from + count - 1` begin when all are listed from
// left to right; their parents' places are known.
KERNEL place_children(
    const float4* __restrict__ boxes, const int2* __restrict__ children, int from, int count,
    int triangles, int* __restrict__ places)
{
    const int i = (int)thread_number();
    if (i >= count) return;
    const int2 pair = children[from - triangles + i];
    const int place = places[from + i];
    places[pair.x] = place;
    places[pair.y] = place + count_of(load_box(boxes, pair.x));
}

// ---- the wide tree, level by level ----

// Choose up to four binary nodes below each root of a level: the largest is opened first. Also
// counts those that are nodes of the next level, and adds to `waits`, the nodes that wait on the
// way to here, those that wait here.
KERNEL open_level(
    const float4* __restrict__ boxes, const int2* __restrict__ children,
    const int* __restrict__ roots, int count, int triangles, int4* __restrict__ slots,
    int* __restrict__ inner, int* __restrict__ waits)
{
    const int i = (int)thread_number();
    if (i >= count) return;
    int slot[WIDTH] = {roots[i], -1, -1, -1};
    float size[WIDTH] = {-1.0f, -1.0f, -1.0f, -1.0f};
    const Box root = load_box(boxes, slot[0]);
    if (!is_leaf(root)) size[0] = area(root);
    int used = 1;
    for (int free = 1; free < WIDTH; ++free) {
        int widest = 0;
        for (int k = 1; k < WIDTH; ++k)
            if (size[k] > size[widest]) widest = k;
        if (!(size[widest] > 0.0f)) break;
        const int2 pair = children[slot[widest] - triangles];
        const Box left = load_box(boxes, pair.x), right = load_box(boxes, pair.y);
        slot[widest] = pair.x;
        size[widest] = is_leaf(left) ? -1.0f : area(left);
        slot[free] = pair.y;
        size[free] = is_leaf(right) ? -1.0f : area(right);
        used = free + 1;
    }
    int nodes = 0;
    for (int k = 0; k < WIDTH; ++k) nodes += size[k] > 0.0f;
    const int4 chosen = {slot[0], slot[1], slot[2], slot[3]};
    slots[i] = chosen;
    inner[i] = nodes;
    waits[i] += used - 1;
}

__device__ __forceinline__ int slot_of(const int4& slots, int k)
{
    return k == 0 ? slots.x : (k == 1 ? slots.y : (k == 2 ? slots.z : slots.w));
}

// List the roots of the next level; `ends` are the inclusive sums of `inner`.
KERNEL next_level(
    const float4* __restrict__ boxes, const int4* __restrict__ slots,
    const int* __restrict__ inner, const int* __restrict__ ends, const int* __restrict__ waits,
    int count, int* __restrict__ next_roots, int* __restrict__ next_waits)
{
    const int i = (int)thread_number();
    if (i >= count) return;
    int at = ends[i] - inner[i];
    for (int k = 0; k < WIDTH; ++k) {
        const int node = slot_of(slots[i], k);
        if (node < 0 || is_leaf(load_box(boxes, node))) continue;
        next_roots[at] = node;
        next_waits[at] = waits[i];
        ++at;
    }
}

// Write a level's nodes as intersect.cu reads them, the first of them at `nodes`; the first node
// of the next level has the number `next`.
KERNEL write_nodes(
    const float4* __restrict__ boxes, const int* __restrict__ places,
    const int4* __restrict__ slots, const int* __restrict__ inner, const int* __restrict__ ends,
    int count, int next, float* __restrict__ nodes)
{
    const int i = (int)thread_number();
    if (i >= count) return;
    float* line = nodes + 8 * WIDTH * (Count)i;
    int child = next + ends[i] - inner[i];
    for (int k = 0; k < WIDTH; ++k) {
        const int node = slot_of(slots[i], k);
        Box box = {{INFINITE, INFINITE, INFINITE, 0.0f}, {-INFINITE, -INFINITE, -INFINITE, 0.0f}};
        int code = 0;
        if (node >= 0) {
            box = load_box(boxes, node);
            code = is_leaf(box) ? ~(places[node] << LEAF_BITS | (count_of(box) - 1)) : child++;
        }
        line[k] = box.low.x;
        line[WIDTH + k] = box.low.y;
        line[2 * WIDTH + k] = box.low.z;
        line[3 * WIDTH + k] = box.high.x;
        line[4 * WIDTH + k] = box.high.y;
        line[5 * WIDTH + k] = box.high.z;
        line[6 * WIDTH + k] = __int_as_float(code);
        line[7 * WIDTH + k] = 0.0f;
    }
}

// ---- the triangles in the order of the leaves ----

__device__ __forceinline__ double length(double x, double y, double z)
{
    return sqrt((x * x + y * y) + z * z);
}

// Corners, records (see layout.py) and numbers of the triangles.
KERNEL write_triangles(
    const double* __restrict__ corners, const int* __restrict__ index,
    const int* __restrict__ order, const int* __restrict__ places, Count count,
    double* __restrict__ placed_corners, float4* __restrict__ records, int* __restrict__ faces)
{
    const Count i = thread_number();
    if (i >= count) return;
    const int triangle = order[i];
    const Count place = places[i];
    const double* p = corners + 9 * (Count)triangle;
    double* out = placed_corners + 9 * place;
    for (int k = 0; k < 9; ++k) out[k] = p[k];
    faces[place] = index[triangle];
    const double ex = p[3] - p[0], ey = p[4] - p[1], ez = p[5] - p[2];
    const double gx = p[6] - p[0], gy = p[7] - p[1], gz = p[8] - p[2];
    const double e = length(ex, ey, ez), g = length(gx, gy, gz);
    const float4 corner = {
        (float)p[0], (float)p[1], (float)p[2], (float)(UNIT * g * (48 + 24 * e) + FLOOR)};
    const float4 edge = {
        (float)ex, (float)ey, (float)ez, (float)(UNIT * e * (56 + 24 * g) + FLOOR)};
    const float4 other = {(float)gx, (float)gy, (float)gz, (float)(UNIT * e * g * 144 + FLOOR)};
    records[3 * place] = corner;
    records[3 * place + 1] = edge;
    records[3 * place + 2] = other;
}
