"""Which triangle a ray hits: Embree proposes in float32, compiled code decides in float64.

Local coordinates are centred on the scene and scaled by a power of two, see `Frame` of mesh.py.

A filter function, which Embree calls for each triangle that it finds in float32, notes the closest
and another that float32 cannot tell from it (`propose`); both then pass the watertight test of
triangle.py. Embree receives a distance that is a little farther than the closest, so it goes on to
propose such triangles. A ray with more candidates, or a ray that passes at an edge, is cast again
by itself, and the test is applied to every triangle that is proposed, and at an edge to all
triangles nearby (`decide`). Of equally close triangles the lowest wins. So a ray's result does not
depend on the rays that share its packet, nor on the processor's instructions, and has the bits of
the other backends. At an instance, the test transforms the ray to the mesh's coordinates in
float64 itself, as instances.py describes.

The test follows after all rays of a group: a filter that read the corners of each candidate waited
for memory, a third of the time in a terrain of two million triangles. At open borders, some rays
within rounding error of a rim are lost. Larger triangles in Embree's copy would need shared edges,
found in as much time as building the tree; each grown by itself, they would have gaps for grazing
rays.

Parameters of the functions below, whose memory embree_memory.py describes:

scratch, numbers, floats
    Address of the `SCRATCH` memory of a thread, and pointers to that memory as int64 and float64.
lane
    Number of a ray in its group of `LANES` rays.
mesh, instances
    Addresses of the `MESH` and `INSTANCE` records; `instances` is 0 for a single mesh without a
    transform.
key
    A triangle of an instance: row of the mesh's corners plus `KEYS_PER_INSTANCE` times the
    instance.
table
    Pointer to the corners of a mesh, float64 (triangles, 3, 3), local to the mesh.
hit
    `PlaneHit`: areas a, b, c of a triangle as a ray sees the triangle, their sum, and the distance.
reach
    Local distance at which a ray ends.

A rough distance is a distance in float32 as Embree computes it, from the start that Embree sees.
The shear of a ray is what the test of triangle.py needs of the ray: the longest axis of its
direction, its origin with that axis last, and the factors of the shear.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import llvmlite.binding
import numpy as np
from numba import types

from . import embree_memory as memory
from .compiled import callback, inlined, stage
from .embree_library import find_library
from .embree_memory import (
    KEYS_PER_INSTANCE,
    LANES,
    byte_offset,
    field_index,
    float32s,
    float64s,
    int32s,
    int64s,
    uint8s,
)
from .mesh import NEAR
from .triangle_loops import PlaneHit, areas, same_sign, shear

llvmlite.binding.load_library_permanently(str(find_library()))  # compiled code names its functions

_MESH = field_index("mesh")
_INSTANCES = field_index("instances")
_MASKED = field_index("masked")
_T_MIN = field_index("t_min")
_T_MAX = field_index("t_max")
_LANE = field_index("lane")
_SCENE = field_index("scene")
_NEARBY = field_index("nearby")
_ARGUMENTS = field_index("arguments")
_ARGUMENTS_AT = byte_offset("arguments")
_SINGLE_AT = byte_offset("single")
_PACKET = field_index("packet")
_QUERY_AT = byte_offset("query")
_QUERY_CONTEXT_AT = byte_offset("query_context")
_OX, _OY, _OZ, _DX, _DY, _DZ = map(field_index, ("ox", "oy", "oz", "dx", "dy", "dz"))
_ENTRY, _AXIS, _U, _V, _W = map(field_index, ("entry", "axis", "u", "v", "w"))
_SX, _SY, _SZ, _INSIDE, _LENGTH = map(field_index, ("sx", "sy", "sz", "inside", "length"))
_ROUGH = field_index("rough")
_FIRST = field_index("first_candidate")
_SECOND = field_index("second_candidate")
_ROUGH_32 = field_index("rough_32")
_FIRST_32 = field_index("first_32")
_SECOND_32 = field_index("second_32")
_FIRST_INSTANCE_32 = field_index("first_instance_32")
_SECOND_INSTANCE_32 = field_index("second_instance_32")
_MATRIX = field_index("matrix")
_T = field_index("t")
_KEY = field_index("key")
_SURE = field_index("sure")
_CORNERS = field_index("corners")

# RTCRayQueryFlags
COHERENT = 1 << 16
CALL_FILTER = 1 << 1

# Local units. Ten times the error of a float32 distance, unless the ray grazes: so much farther
# Embree goes on to look for triangles.
MARGIN = 2.0**-19
MAX_DISTANCE = 8.0  # more than the diagonal of any scene

_GRAZES = 2.0**-10  # sine of the smallest angle to a triangle that `decide` allows for
_RIM = 2.0**-20  # share of a triangle's height: far more than rounding in float64
_MAX_AXIS_SUM = 1 + 2.0**-20  # sum of a direction's components, so near to an axis

_intersect_1 = types.ExternalFunction(
    "rtcIntersect1", types.void(types.intp, types.intp, types.intp)
)
_point_query = types.ExternalFunction(
    "rtcPointQuery", types.boolean(types.intp, types.intp, types.intp, types.intp, types.intp)
)


@stage
def enter_instance(m, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Transform a ray from the scene's to the mesh's local coordinates, as `Scene.enter`.

    `m` points to the (3, 4) matrix of the instance, by rows. Returns origin, unit direction, and
    the length of the direction before it was made a unit vector.
    """
    x = (m[0] * dx + m[1] * dy) + m[2] * dz
    y = (m[4] * dx + m[5] * dy) + m[6] * dz
    z = (m[8] * dx + m[9] * dy) + m[10] * dz
    length = np.sqrt((x * x + y * y) + z * z)
    u = ((m[0] * ox + m[1] * oy) + m[2] * oz) + m[3]
    v = ((m[4] * ox + m[5] * oy) + m[6] * oz) + m[7]
    w = ((m[8] * ox + m[9] * oy) + m[10] * oz) + m[11]
    return u, v, w, x / length, y / length, z / length, length


@inlined
def scene_ray(floats, lane):  # type: ignore[no-untyped-def]
    """Return the origin and the direction of a ray of the group, local to the scene: 6 numbers."""
    x = floats[_OX + lane]
    y = floats[_OY + lane]
    z = floats[_OZ + lane]
    return x, y, z, floats[_DX + lane], floats[_DY + lane], floats[_DZ + lane]


@inlined
def store_shear(numbers, floats, lane, ray):  # type: ignore[no-untyped-def]
    """Write the shear of a ray, given as origin and direction in 6 numbers, to a lane."""
    axis, u, v, w, sx, sy, sz = shear(*ray)
    numbers[_AXIS + lane] = axis
    floats[_U + lane] = u
    floats[_V + lane] = v
    floats[_W + lane] = w
    floats[_SX + lane] = sx
    floats[_SY + lane] = sy
    floats[_SZ + lane] = sz


@stage
def shear_all(scratch):  # type: ignore[no-untyped-def]
    """Write the shear of all rays of a group to the scratch memory."""
    numbers = int64s(scratch)
    floats = float64s(scratch)
    for lane in range(LANES):
        store_shear(numbers, floats, lane, scene_ray(floats, lane))


@inlined
def _transform(floats, matrix_row, vector):  # type: ignore[no-untyped-def]
    """Return the product of a row of a matrix of `matrix` and a vector, without the shift.

    `matrix_row` is the index of the row's first number.
    """
    x, y, z = vector
    k = matrix_row
    return (floats[k] * x + floats[k + LANES] * y) + floats[k + 2 * LANES] * z


@stage
def _enter_and_shear_all(scratch):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Write the shear of all rays of a group, each in the mesh of the instance in `matrix`.

    The operations are those of `enter_instance`.
    """
    numbers = int64s(scratch)
    floats = float64s(scratch)
    for lane in range(LANES):
        ox, oy, oz, dx, dy, dz = scene_ray(floats, lane)
        row = _MATRIX + lane
        x = _transform(floats, row, (dx, dy, dz))
        y = _transform(floats, row + 4 * LANES, (dx, dy, dz))
        z = _transform(floats, row + 8 * LANES, (dx, dy, dz))
        length = np.sqrt((x * x + y * y) + z * z)
        u = _transform(floats, row, (ox, oy, oz)) + floats[row + 3 * LANES]
        v = _transform(floats, row + 4 * LANES, (ox, oy, oz)) + floats[row + 7 * LANES]
        w = _transform(floats, row + 8 * LANES, (ox, oy, oz)) + floats[row + 11 * LANES]
        floats[_LENGTH + lane] = length
        store_shear(numbers, floats, lane, (u, v, w, x / length, y / length, z / length))


@stage
def _enter_mesh(mesh, instances, numbers, floats, lane, key):  # type: ignore[no-untyped-def]
    """Return the address of the `MESH` of a key, and write the shear of the ray in that mesh.

    Without instances the lane has the shear already, as for the instance `inside` of the lane.
    """
    if instances == 0:
        return mesh
    number = key // KEYS_PER_INSTANCE
    address = instances + memory.INSTANCE_BYTES * number
    if numbers[_INSIDE + lane] != number:
        ox, oy, oz, dx, dy, dz, length = enter_instance(float64s(address), *scene_ray(floats, lane))
        store_shear(numbers, floats, lane, (ox, oy, oz, dx, dy, dz))
        floats[_LENGTH + lane] = length
        numbers[_INSIDE + lane] = number
    return int64s(address)[memory.MESH_FIELD]


@inlined
def corners_of(table, triangle, axis):  # type: ignore[no-untyped-def]
    """Return the three corners of a triangle, each as three coordinates of which `axis` is last.

    `triangle` is the row in `table`.
    """
    x = axis + 1 if axis < 2 else 0
    y = x + 1 if x < 2 else 0
    k = 9 * triangle
    return (
        (table[k + x], table[k + y], table[k + axis]),
        (table[k + 3 + x], table[k + 3 + y], table[k + 3 + axis]),
        (table[k + 6 + x], table[k + 6 + y], table[k + 6 + axis]),
    )


@inlined
def _load_shear(floats, lane):  # type: ignore[no-untyped-def]
    """Return the shear that `store_shear` wrote, without the axis: 6 numbers."""
    u = floats[_U + lane]
    v = floats[_V + lane]
    w = floats[_W + lane]
    return u, v, w, floats[_SX + lane], floats[_SY + lane], floats[_SZ + lane]


@inlined
def _is_clearly_inside(hit):  # type: ignore[no-untyped-def]
    """Return whether a `PlaneHit` is inside its triangle, away from shared edges and corners."""
    a, b, c, det, _ = hit
    rim = _RIM * det * det
    return (a * det > rim) & (b * det > rim) & (c * det > rim)


@stage
def _is_opaque(mesh, triangle, hit):  # type: ignore[no-untyped-def]
    """Return whether the mask of a mesh stops a ray in a triangle, as `Masks.opaque`.

    `mesh` points to a `MESH`, `triangle` is the row in its corners.
    """
    uv = float32s(mesh[1])
    mask = uint8s(mesh[2])
    height = mesh[3]
    width = mesh[4]
    k = 6 * triangle
    p = hit.a / hit.det
    q = hit.b / hit.det
    r = hit.c / hit.det
    u = (p * np.float64(uv[k]) + q * np.float64(uv[k + 2])) + r * np.float64(uv[k + 4])
    v = (p * np.float64(uv[k + 1]) + q * np.float64(uv[k + 3])) + r * np.float64(uv[k + 5])
    column = min(np.int64((u - np.floor(u)) * width), width - 1)
    row = min(np.int64((v - np.floor(v)) * height), height - 1)
    return mask[row * width + column] != 0


@stage
def _intersect(mesh, instances, numbers, floats, lane, key):  # type: ignore[no-untyped-def]
    """Return the `PlaneHit` of a ray and the triangle of a key, and a pointer to its `MESH`.

    The distance is local to the scene.
    """
    record = int64s(_enter_mesh(mesh, instances, numbers, floats, lane, key))
    triangle = key & (KEYS_PER_INSTANCE - 1)
    corners = corners_of(float64s(record[0]), triangle, numbers[_AXIS + lane])
    hit = areas(corners, _load_shear(floats, lane))
    if instances != 0:
        t = hit.t / floats[_LENGTH + lane]
        hit = PlaneHit(hit.a, hit.b, hit.c, hit.det, t)
    return hit, record


@stage
def _is_transparent(mesh, instances, numbers, floats, lane, key):  # type: ignore[no-untyped-def]
    """Return whether a mask lets a ray through the triangle of a key.

    If it does so at the rim of the triangle, the ray becomes unsure: in float64 it may hit the
    neighbour, which Embree need not propose, where the neighbour's mask is opaque.
    """
    hit, record = _intersect(mesh, instances, numbers, floats, lane, key)
    if record[3] == 0:
        return False
    if hit.det != 0 and _is_opaque(record, key & (KEYS_PER_INSTANCE - 1), hit):
        return False
    if not _is_clearly_inside(hit):
        numbers[_SURE + lane] = 0
    return True


@cache
def opaque_proposer(count: int, packet_number: int = 0, *, nested: bool = False) -> Any:
    """Return a filter function like `propose`, for a scene without masks.

    With a constant number of rays `count` of a packet, and all numbers at constant distances from a
    single address, the loop becomes a few vector instructions. `packet_number` counts the packets
    of a group from 0; a filter for single rays has the lane from the scratch memory. `nested` says
    that the scene has instances.
    """
    packet = field_index("single") if count == 1 else _PACKET + 22 * count * packet_number
    first_lane = packet_number * count

    @callback(types.void(types.CPointer(types.int64)))
    def propose(arguments):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
        """Keep the closest triangle and a second in the fields of the scratch memory in 32 bits."""
        valid = int32s(arguments[0])
        scratch = arguments[2]
        hits = int32s(arguments[4])
        lane = int64s(scratch)[_LANE] if count == 1 else first_lane
        singles = float32s(scratch)
        integers = int32s(scratch)
        for k in range(count):
            reach_index = packet + 8 * count + k
            ray_lane = lane + k
            is_asked = valid[k] != 0
            rough = singles[reach_index]
            nearest = singles[_ROUGH_32 + ray_lane]
            first = integers[_FIRST_32 + ray_lane]
            known_second = integers[_SECOND_32 + ray_lane]
            triangle = hits[5 * count + k]
            if nested:
                first_instance = integers[_FIRST_INSTANCE_32 + ray_lane]
                second_instance = integers[_SECOND_INSTANCE_32 + ray_lane]
                instance = hits[7 * count + k]
            closer = is_asked & (rough < nearest)
            clearly = is_asked & (rough < nearest - np.float32(MARGIN))
            new_second = triangle if known_second == -1 else np.int32(-2)  # a third is too many
            singles[reach_index] = rough + np.float32(MARGIN) if closer else rough
            singles[_ROUGH_32 + ray_lane] = rough if closer else nearest
            integers[_FIRST_32 + ray_lane] = triangle if clearly else first
            integers[_SECOND_32 + ray_lane] = (
                np.int32(-1) if clearly else (new_second if is_asked else known_second)
            )
            if nested:
                integers[_FIRST_INSTANCE_32 + ray_lane] = instance if clearly else first_instance
                integers[_SECOND_INSTANCE_32 + ray_lane] = instance if is_asked else second_instance
            valid[k] = np.int32(-1) if closer else np.int32(0)

    return propose


@inlined
def _key(hits, count, k, instances):  # type: ignore[no-untyped-def]
    """Return the key of the triangle of ray k, from `hits`: an RTCHitN of `count` rays."""
    key = np.int64(hits[5 * count + k])
    return key + KEYS_PER_INSTANCE * hits[7 * count + k] if instances != 0 else key


@callback(types.void(types.CPointer(types.int64)))
def propose(arguments):  # type: ignore[no-untyped-def]
    """Keep the closest triangle, and a second within the error of float32: a filter function.

    `arguments` is an RTCFilterFunctionNArguments: addresses of mask, user data, context, rays and
    hits, and the number of rays. Embree asks about a single triangle, for some rays of the packet.
    Where a mask lets a ray through, Embree goes on.
    """
    valid = int32s(arguments[0])
    scratch = arguments[2]
    rays = float32s(arguments[3])
    hits = int32s(arguments[4])
    count = arguments[5] & 0xFFFFFFFF
    numbers = int64s(scratch)
    floats = float64s(scratch)
    mesh = numbers[_MESH]
    instances = numbers[_INSTANCES]
    masked = numbers[_MASKED]
    for k in range(count):
        if valid[k] == 0:
            continue
        lane = numbers[_LANE] + k
        key = _key(hits, count, k, instances)
        if masked and _is_transparent(mesh, instances, numbers, floats, lane, key):
            valid[k] = 0
            continue
        rough = np.float64(rays[8 * count + k])
        nearest = floats[_ROUGH + lane]
        if rough < nearest - MARGIN:
            numbers[_FIRST + lane] = key
            numbers[_SECOND + lane] = -1
        else:  # a third is too many
            numbers[_SECOND + lane] = key if numbers[_SECOND + lane] == -1 else -2
        if rough < nearest:
            floats[_ROUGH + lane] = rough
            rays[8 * count + k] = np.float32(rough + MARGIN)
        else:
            valid[k] = 0


@stage
def _consider(scratch, lane, key):  # type: ignore[no-untyped-def]
    """Test the triangle of a key in float64, and write the hit to `t` and `key` if closest so far.

    Returns whether the ray clearly passes inside the triangle.
    """
    numbers = int64s(scratch)
    floats = float64s(scratch)
    mesh = numbers[_MESH]
    instances = numbers[_INSTANCES]
    hit, _ = _intersect(mesh, instances, numbers, floats, lane, key)
    t = hit.t
    nearest = floats[_T + lane]
    if (
        hit.det != 0
        and same_sign(hit.a, hit.b, hit.c)
        and floats[_T_MIN] <= t <= floats[_T_MAX]
        and (t < nearest or (t == nearest and key < numbers[_KEY + lane]))
        and not (numbers[_MASKED] and _is_transparent(mesh, instances, numbers, floats, lane, key))
    ):
        floats[_T + lane] = t
        numbers[_KEY + lane] = key
    return _is_clearly_inside(hit)


@callback(types.boolean(types.CPointer(types.int64)))
def nearby(arguments):  # type: ignore[no-untyped-def]
    """Test the triangle that a point query found; takes an RTCPointQueryFunctionArguments."""
    scratch = arguments[1]
    instance = int32s(arguments[3])[32]  # of the RTCPointQueryContext
    numbers = int64s(scratch)
    key = arguments[2] & (KEYS_PER_INSTANCE - 1)
    if numbers[_INSTANCES] != 0:
        key += KEYS_PER_INSTANCE * instance
    _consider(scratch, numbers[_LANE], key)
    return False  # the distance of interest stays


@inlined
def _distance_error(ray, normal):  # type: ignore[no-untyped-def]
    """Return the error of Embree's distance at a triangle, local: larger where the ray grazes.

    `ray` is an RTCRay, `normal` the normal of the triangle, of any length.
    """
    x = normal[0]
    y = normal[1]
    z = normal[2]
    dx = ray[4]
    dy = ray[5]
    dz = ray[6]
    steep = abs(x * dx + y * dy + z * dz)
    full = np.sqrt((x * x + y * y + z * z) * (dx * dx + dy * dy + dz * dz))
    return 2 * MARGIN * (max(full / steep, 1.0) if steep > _GRAZES * full else 1 / _GRAZES)


@inlined
def _consider_nearby(scratch, lane, distance, radius):  # type: ignore[no-untyped-def]
    """Test all triangles near the point at a distance along a ray, and keep the closest hit.

    `distance` from the ray's origin, and the radius around the point, are local.
    """
    numbers = int64s(scratch)
    query = float32s(scratch + _QUERY_AT)
    ox, oy, oz, dx, dy, dz = scene_ray(float64s(scratch), lane)
    query[0] = np.float32(ox + distance * dx)
    query[1] = np.float32(oy + distance * dy)
    query[2] = np.float32(oz + distance * dz)
    query[4] = np.float32(radius)
    query_address = scratch + _QUERY_AT
    context_address = scratch + _QUERY_CONTEXT_AT
    _point_query(numbers[_SCENE], query_address, context_address, numbers[_NEARBY], scratch)


@callback(types.void(types.CPointer(types.int64)))
def decide(arguments):  # type: ignore[no-untyped-def]
    """Accept a closer triangle by the test in float64: a filter function for single rays.

    At an edge, Embree may propose any of the triangles that share the edge, or a triangle that is
    beside the ray in float64. Then all triangles near that point are tested.
    """
    valid = int32s(arguments[0])
    scratch = arguments[2]
    ray = float32s(arguments[3])
    hit = int32s(arguments[4])
    normal = float32s(arguments[4])
    numbers = int64s(scratch)
    floats = float64s(scratch)
    lane = numbers[_LANE]
    entry = floats[_ENTRY + numbers[_LANE]]
    nearest = floats[_T + lane]
    clear = _consider(scratch, lane, _key(hit, 1, 0, numbers[_INSTANCES]))
    error = _distance_error(ray, normal)
    if not clear:
        _consider_nearby(scratch, lane, entry + ray[8], error)
    if floats[_T + lane] < nearest:
        ray[8] = np.float32(floats[_T + lane] - entry + error)
    else:
        valid[0] = 0


@inlined
def _is_sure(floats, lane, t_min, hit):  # type: ignore[no-untyped-def]
    """Return whether a ray clearly hits a triangle, within the error of the rough distance."""
    error = abs(hit.t - floats[_ENTRY + lane] - floats[_ROUGH + lane])
    return _is_clearly_inside(hit) & (hit.t >= t_min) & (error <= 1.5 * MARGIN)


@inlined
def verify(mesh, instances, numbers, floats, lane):  # type: ignore[no-untyped-def]
    """Test the candidates of a ray in float64, and write the closer hit to `t`, `key` and `sure`.

    `sure` is 0 for a ray that must be cast again by `cast_until_sure`; it may be 0 before.
    """
    t = np.inf
    key = np.int64(-1)
    sure = numbers[_SURE + lane] != 0
    t_min = floats[_T_MIN]
    first = numbers[_FIRST + lane]
    second = numbers[_SECOND + lane]
    if first >= 0:
        hit, _ = _intersect(mesh, instances, numbers, floats, lane, first)
        t = hit.t
        key = first
        sure = sure and _is_sure(floats, lane, t_min, hit)
        if second >= 0:
            hit, _ = _intersect(mesh, instances, numbers, floats, lane, second)
            sure = sure and _is_sure(floats, lane, t_min, hit)
            if hit.t < t or (hit.t == t and second < first):
                t = hit.t
                key = second
    floats[_T + lane] = t
    numbers[_KEY + lane] = key
    numbers[_SURE + lane] = np.int64(sure and second != -2)


@inlined
def _copy_corners(table, numbers, floats, candidate_field):  # type: ignore[no-untyped-def]
    """Copy the corners of each ray's candidate to `corners`, with the axis of the ray last.

    `candidate_field` is the index of `first_candidate` or `second_candidate`; without a candidate,
    triangle 0 is copied.

    Scattered reads come first, which the processor overlaps, then vector instructions.
    """
    axis = numbers[_AXIS]
    differ = np.int64(0)
    for lane in range(LANES):
        differ |= numbers[_AXIS + lane] ^ axis
    if differ:
        for lane in range(LANES):
            (a, b, c), (d, e, f), (g, h, i) = corners_of(
                table, max(numbers[candidate_field + lane], 0), numbers[_AXIS + lane]
            )
            for k, number in enumerate((a, b, c, d, e, f, g, h, i)):
                floats[_CORNERS + LANES * k + lane] = number
    else:
        x = axis + 1 if axis < 2 else 0
        y = x + 1 if x < 2 else 0
        for lane in range(LANES):
            base = 9 * max(numbers[candidate_field + lane], 0)
            for k in range(3):
                target = _CORNERS + 3 * LANES * k + lane
                floats[target] = table[base + 3 * k + x]
                floats[target + LANES] = table[base + 3 * k + y]
                floats[target + 2 * LANES] = table[base + 3 * k + axis]


@stage
def _copy_matrices(scratch, instances, candidate_field):  # type: ignore[no-untyped-def]
    """Copy the matrix of the instance of each ray's candidate to `matrix`.

    Without a candidate, the matrix of instance 0 is copied.
    """
    numbers = int64s(scratch)
    floats = float64s(scratch)
    for lane in range(LANES):
        number = max(numbers[candidate_field + lane], 0) // KEYS_PER_INSTANCE
        matrix = float64s(instances + memory.INSTANCE_BYTES * number)
        for k in range(12):
            floats[_MATRIX + LANES * k + lane] = matrix[k]


@stage
def _copy_corners_in_meshes(scratch, instances, candidate_field):  # type: ignore[no-untyped-def]
    """Copy corners as `_copy_corners`, from the mesh of each candidate's instance."""
    numbers = int64s(scratch)
    floats = float64s(scratch)
    for lane in range(LANES):
        key = max(numbers[candidate_field + lane], 0)
        record = int64s(instances + memory.INSTANCE_BYTES * (key // KEYS_PER_INSTANCE))
        table = float64s(int64s(record[memory.MESH_FIELD])[0])
        triangle = key & (KEYS_PER_INSTANCE - 1)
        (a, b, c), (d, e, f), (g, h, i) = corners_of(table, triangle, numbers[_AXIS + lane])
        for k, number in enumerate((a, b, c, d, e, f, g, h, i)):
            floats[_CORNERS + LANES * k + lane] = number


@inlined
def _enter_candidates(scratch, instances, candidate_field):  # type: ignore[no-untyped-def]
    """Write the shear of all rays, and corners, in the meshes of the candidates of the rays."""
    _copy_matrices(scratch, instances, candidate_field)
    _enter_and_shear_all(scratch)
    _copy_corners_in_meshes(scratch, instances, candidate_field)


@inlined
def _plane_hit(floats, lane):  # type: ignore[no-untyped-def]
    """Return the `PlaneHit` of a ray and the triangle whose corners were copied for the lane.

    The distance is local to the scene.
    """
    k = _CORNERS + lane
    p = floats[k], floats[k + LANES], floats[k + 2 * LANES]
    q = floats[k + 3 * LANES], floats[k + 4 * LANES], floats[k + 5 * LANES]
    r = floats[k + 6 * LANES], floats[k + 7 * LANES], floats[k + 8 * LANES]
    hit = areas((p, q, r), _load_shear(floats, lane))
    return PlaneHit(hit.a, hit.b, hit.c, hit.det, hit.t / floats[_LENGTH + lane])


@stage
def _verify_first(scratch, t_min):  # type: ignore[no-untyped-def]
    """Test the first candidates of a group, whose corners are copied: write `t`, `key`, `sure`."""
    numbers = int64s(scratch)
    floats = float64s(scratch)
    for lane in range(LANES):
        hit = _plane_hit(floats, lane)
        first = numbers[_FIRST + lane]
        sure = _is_sure(floats, lane, t_min, hit)
        floats[_T + lane] = hit.t if first >= 0 else np.inf
        numbers[_KEY + lane] = first
        numbers[_SURE + lane] = np.int64((first < 0) | (sure & (numbers[_SECOND + lane] != -2)))


@stage
def _verify_second(scratch, t_min):  # type: ignore[no-untyped-def]
    """Test the second candidates of a group, and replace farther hits; corners are copied."""
    numbers = int64s(scratch)
    floats = float64s(scratch)
    for lane in range(LANES):
        hit = _plane_hit(floats, lane)
        t = hit.t
        sure = _is_sure(floats, lane, t_min, hit)
        nearest = floats[_T + lane]
        second = numbers[_SECOND + lane]
        key = numbers[_KEY + lane]
        nearer = (second >= 0) & ((t < nearest) | ((t == nearest) & (second < key)))
        floats[_T + lane] = t if nearer else nearest
        numbers[_KEY + lane] = second if nearer else key
        numbers[_SURE + lane] &= np.int64((second < 0) | sure)


@stage
def _widen_candidates(scratch, nested):  # type: ignore[no-untyped-def]
    """Write the candidates that are in 32 bits as keys; return the number of second candidates."""
    numbers = int64s(scratch)
    floats = float64s(scratch)
    singles = float32s(scratch)
    integers = int32s(scratch)
    second_count = np.int64(0)
    for lane in range(LANES):
        floats[_ROUGH + lane] = singles[_ROUGH_32 + lane]
        numbers[_FIRST + lane] = integers[_FIRST_32 + lane]
        numbers[_SECOND + lane] = integers[_SECOND_32 + lane]
        second_count += np.int64(integers[_SECOND_32 + lane] >= 0)
    if nested:
        for lane in range(LANES):
            first = numbers[_FIRST + lane]
            second = numbers[_SECOND + lane]
            first_key = first + KEYS_PER_INSTANCE * integers[_FIRST_INSTANCE_32 + lane]
            second_key = second + KEYS_PER_INSTANCE * integers[_SECOND_INSTANCE_32 + lane]
            numbers[_FIRST + lane] = first_key if first >= 0 else first
            numbers[_SECOND + lane] = second_key if second >= 0 else second
            numbers[_INSIDE + lane] = -1  # the shear will be that of a candidate's mesh
    return second_count


@stage
def verify_all(scratch, mesh, instances, t_min):  # type: ignore[no-untyped-def]
    """Test the candidates of all rays of a group as `verify`, without masks.

    Numbers that all rays share are arguments: a load would keep loops from becoming vector
    instructions.
    """
    numbers = int64s(scratch)
    floats = float64s(scratch)
    second_count = _widen_candidates(scratch, instances != 0)
    if instances != 0:
        _enter_candidates(scratch, instances, _FIRST)
    else:
        shear_all(scratch)
        _copy_corners(float64s(int64s(mesh)[0]), numbers, floats, _FIRST)
    _verify_first(scratch, t_min)
    if second_count == 0:
        return
    if instances != 0:
        _enter_candidates(scratch, instances, _SECOND)
    else:
        _copy_corners(float64s(int64s(mesh)[0]), numbers, floats, _SECOND)
    _verify_second(scratch, t_min)


@inlined
def embree_origin(o, d, entry):  # type: ignore[no-untyped-def]
    """Return a coordinate of the start that Embree sees, at most `NEAR` from the scene's centre.

    `o` and `d` are a coordinate of the origin and of the direction, local; the start is at the
    distance `entry` along the ray.
    """
    return np.float32(min(max(o + entry * d, -NEAR), NEAR))


@stage
def cast_single(scene, scratch, lane, reach, aside, up):  # type: ignore[no-untyped-def]
    """Cast a single ray of a group, whose start for Embree is shifted.

    The shifts `aside` and `up`, local units, are along the two axes that follow the axis of a ray
    along an axis; 0 for all other rays.
    """
    numbers = int64s(scratch)
    floats = float64s(scratch)
    ray = float32s(scratch + _SINGLE_AT)
    integers = int32s(scratch + _SINGLE_AT)
    entry = floats[_ENTRY + lane]
    ox, oy, oz, dx, dy, dz = scene_ray(floats, lane)
    ray[0] = embree_origin(ox, dx, entry)
    ray[1] = embree_origin(oy, dy, entry)
    ray[2] = embree_origin(oz, dz, entry)
    ray[3] = np.float32(max(floats[_T_MIN] - entry - MARGIN, 0.0))
    ray[4] = np.float32(dx)
    ray[5] = np.float32(dy)
    ray[6] = np.float32(dz)
    ray[7] = np.float32(0)
    ray[8] = np.float32(min(reach - entry + MARGIN, MAX_DISTANCE))
    axis = 0 if abs(ray[4]) > 0.5 else (1 if abs(ray[5]) > 0.5 else 2)
    ray[(axis + 1) % 3] += np.float32(aside)
    ray[(axis + 2) % 3] += np.float32(up)
    integers[9] = -1
    integers[10] = 0
    integers[11] = 0
    integers[18] = -1
    integers[19] = -1
    integers[20] = -1
    numbers[_LANE] = lane
    _intersect_1(scene, scratch + _SINGLE_AT, scratch + _ARGUMENTS_AT)
    numbers[_LANE] = 0


@stage
def cast_until_sure(scene, scratch, lane, reach):  # type: ignore[no-untyped-def]
    """Cast a ray again, with the filter `decide`; write the hit to `t` and `key`.

    The caller has written the filter to the arguments, for rays whose candidates are not sure.

    Embree misses triangles that touch a ray along an axis with the upper side of their box (0 * inf
    in its test of boxes). So eight more rays around a ray along an axis are cast, too.
    """
    numbers = int64s(scratch)
    floats = float64s(scratch)
    flags = int32s(scratch + _ARGUMENTS_AT)
    floats[_T + lane] = np.inf
    numbers[_KEY + lane] = -1
    flags[0] = CALL_FILTER
    aside = 0.0
    up = 0.0
    for k in range(9 if is_along_axis(floats, lane) else 1):
        cast_single(scene, scratch, lane, reach, aside, up)
        small_shift = MARGIN if k & 1 else -MARGIN
        smaller_shift = 0.4 * (MARGIN if k & 2 else -MARGIN)
        aside, up = (small_shift, smaller_shift) if k & 4 else (smaller_shift, small_shift)
    flags[0] = CALL_FILTER | COHERENT


@inlined
def is_along_axis(floats, lane):  # type: ignore[no-untyped-def]
    """Return whether a ray runs along a coordinate axis, within 2^-20."""
    x = floats[_DX + lane]
    y = floats[_DY + lane]
    z = floats[_DZ + lane]
    return (abs(x) + abs(y)) + abs(z) < _MAX_AXIS_SUM
