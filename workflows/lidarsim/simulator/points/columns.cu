// Columns of kept hits on a CUDA device, with the bits of `BatchPoints` (batch_points.py).
//
// One thread a hit. CuPy compiles it without fused multiply-adds; the tests compile it for the CPU.
// `wanted` has a bit for each column, in the order in which device.py lists them; what is not wanted
// is neither read nor written, but for channel and object, which every part has.

typedef long long Count;

#define KERNEL extern "C" __global__ void
#define WANTED(column) (wanted >> column & 1)

enum { X, Y, Z, CHANNEL, OBJECT, RAY, TIME, RANGE, INTENSITY, REFLECTANCE, CLASS, TRIANGLE };

// Cosine of the angle between a ray and a normal, which `turn` takes to the scene's axes, if it is
// not 0.
__device__ __forceinline__ double cosine(
    const float* normal, const double* turn, const double* direction, Count count)
{
    double x = normal[0], y = normal[1], z = normal[2];
    if (turn) {
        const double a = (turn[0] * x + turn[1] * y) + turn[2] * z;
        const double b = (turn[3] * x + turn[4] * y) + turn[5] * z;
        const double c = (turn[6] * x + turn[7] * y) + turn[8] * z;
        const double length = sqrt((a * a + b * b) + c * c);
        x = a / length;
        y = b / length;
        z = c / length;
    }
    return fabs((x * direction[0] + y * direction[count]) + z * direction[2 * count]);
}

// Hits: see `DeviceHits`; origins and directions are (3, count).
// Rays: `firsts` of the scans, start of each firing after `start_ns` and delay of each beam, ns.
// Surfaces: of each instance its first triangle, its object or -1 to look that up in `owners`, and
// the row of its first normal, or -1 where NumPy makes the energies; normals (faces, 3); a matrix
// for the normals of each instance.
KERNEL columns(
    const unsigned int* __restrict__ ray, const double* __restrict__ distance,
    const int* __restrict__ triangle, const int* __restrict__ instance,
    const double* __restrict__ origins, const double* __restrict__ directions, Count count,
    int wanted, double precision,
    const Count* __restrict__ firsts, int scans, const double* __restrict__ begins,
    const double* __restrict__ delays, int channels, Count start_ns,
    const Count* __restrict__ bodies, const int* __restrict__ owners,
    const float* __restrict__ normals, const double* __restrict__ turns,
    const double* __restrict__ reflectance, const unsigned char* __restrict__ retro,
    double retro_gain, double reference, double nearest,
    const unsigned short* __restrict__ classes,
    int* __restrict__ x, int* __restrict__ y, int* __restrict__ z,
    unsigned short* __restrict__ channel, int* __restrict__ object,
    unsigned int* __restrict__ ray_of_scan, Count* __restrict__ time, float* __restrict__ range,
    float* __restrict__ intensity, float* __restrict__ share_back,
    unsigned short* __restrict__ semantic, int* __restrict__ triangle_of_scene)
{
    const Count k = blockIdx.x * (Count)blockDim.x + threadIdx.x;
    if (k >= count) return;
    const double meters = distance[k];
    int* const cells[] = {x, y, z};
    for (int axis = 0; axis < 3 && WANTED(X); ++axis) {
        const double end = directions[axis * count + k] * meters + origins[axis * count + k];
        cells[axis][k] = (int)rint(end / precision);
    }
    const unsigned int number = ray[k], beam = number % channels;
    channel[k] = (unsigned short)beam;
    if (WANTED(RAY)) {
        int scan = 0;
        for (int high = scans; high - scan > 1;) {
            const int middle = (scan + high) / 2;
            if (firsts[middle] <= number)
                scan = middle;
            else
                high = middle;
        }
        ray_of_scan[k] = (unsigned int)(number - firsts[scan]);
    }
    if (WANTED(TIME)) time[k] = start_ns + (Count)rint(begins[number / channels] + delays[beam]);
    if (WANTED(RANGE)) range[k] = (float)meters;

    const Count* body = bodies + 3 * (Count)instance[k];
    const Count face = triangle[k];
    const int owner = body[1] < 0 ? owners[face] : (int)body[1];
    object[k] = owner;
    if (WANTED(TRIANGLE)) triangle_of_scene[k] = (int)(body[0] + face);
    if (WANTED(CLASS)) semantic[k] = classes[owner];
    if (body[2] >= 0 && (WANTED(INTENSITY) || WANTED(REFLECTANCE))) {
        const double* turn = body[1] < 0 ? 0 : turns + 9 * (Count)instance[k];
        const double along = cosine(normals + 3 * (body[2] + face), turn, directions + k, count);
        const double scattered = reflectance[owner] * (retro[owner] ? retro_gain : along);
        const double share = reference / fmax(meters, nearest);
        const double lost = share * share;
        if (WANTED(INTENSITY)) intensity[k] = (float)(scattered * lost);
        if (WANTED(REFLECTANCE)) share_back[k] = (float)(scattered * lost / lost);
    }
}
