"""Which triangle a ray hits: Embree proposes in float32, compiled code decides in float64.

A filter function, which Embree calls for each triangle that it finds in float32, notes the closest
and another that float32 cannot tell from it (`propose`); both then pass the watertight test of
triangle.py. Embree is told of a distance that is a little farther than the closest, so it goes on
to propose such triangles. A ray of which that says too little, or that passes at an edge, is cast
again by itself, and the test is applied to every triangle that is proposed, and at an edge to all
that are near (`decide`). Of equally close triangles the lowest wins. So a ray's result does not
depend on the rays that share its packet, nor on the processor's instructions, and has the bits of
the other backends. At an instance, the test takes the ray to the mesh's coordinates in float64
itself, as instances.py says.

The test follows after all rays of a group: a filter that read the corners of each candidate waited
for memory, a third of the time in a terrain of two million triangles. At open borders, some rays
within rounding error of a rim are lost. Larger triangles in Embree's copy would need shared edges,
found in as much time as building the tree; each grown by itself, they would have gaps for grazing
rays.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import llvmlite.binding
import numpy as np
from numba import types

from . import embree_memory as memory
from .compiled import callback, inlined, stage
from .embree_library import find
from .embree_memory import LANES, NUMBER, at, float32s, float64s, int32s, int64s, offset, uint8s
from .mesh import NEAR
from .triangle_loops import areas, shear, within

llvmlite.binding.load_library_permanently(str(find()))  # compiled code names its functions

_MESH = at("mesh")
_INSTANCES = at("instances")
_MASKED = at("masked")
_T_MIN = at("t_min")
_T_MAX = at("t_max")
_LANE = at("lane")
_SCENE = at("scene")
_NEARBY = at("nearby")
_ARGUMENTS = at("arguments")
_ARGUMENTS_AT = offset("arguments")
_SINGLE_AT = offset("single")
_PACKET = at("packet")
_QUERY_AT = offset("query")
_QUERY_CONTEXT_AT = offset("query_context")
_OX, _OY, _OZ, _DX, _DY, _DZ = map(at, ("ox", "oy", "oz", "dx", "dy", "dz"))
_ENTRY, _AXIS, _U, _V, _W = map(at, ("entry", "axis", "u", "v", "w"))
_SX, _SY, _SZ, _INSIDE, _LENGTH = map(at, ("sx", "sy", "sz", "inside", "length"))
_ROUGH = at("rough")
_ONE = at("one")
_OTHER = at("other")
_ROUGH_32 = at("rough_32")
_ONE_32 = at("one_32")
_OTHER_32 = at("other_32")
_T = at("t")
_KEY = at("key")
_SURE = at("sure")
_CORNERS = at("corners")

# RTCRayQueryFlags
COHERENT = 1 << 16
CALL_FILTER = 1 << 1

# Local units. Ten times the error of a float32 distance, unless the ray grazes: so much farther
# Embree goes on to look for triangles.
MARGIN = 2.0**-19
FAR = 8.0  # more than the diagonal of any scene

_GRAZES = 2.0**-10  # sine of the least angle to a triangle that `decide` allows for
_RIM = 2.0**-20  # share of a triangle's height: far more than what float64 rounds
_STRAIGHT = 1 + 2.0**-20  # sum of a direction's components, so near to an axis

_intersect_1 = types.ExternalFunction(
    "rtcIntersect1", types.void(types.intp, types.intp, types.intp)
)
_point_query = types.ExternalFunction(
    "rtcPointQuery", types.boolean(types.intp, types.intp, types.intp, types.intp, types.intp)
)


@stage
def entered(m, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Take a ray to an instance's coordinates, as `Scene.enter`; also returns its length."""
    x = (m[0] * dx + m[1] * dy) + m[2] * dz
    y = (m[4] * dx + m[5] * dy) + m[6] * dz
    z = (m[8] * dx + m[9] * dy) + m[10] * dz
    length = np.sqrt((x * x + y * y) + z * z)
    u = ((m[0] * ox + m[1] * oy) + m[2] * oz) + m[3]
    v = ((m[4] * ox + m[5] * oy) + m[6] * oz) + m[7]
    w = ((m[8] * ox + m[9] * oy) + m[10] * oz) + m[11]
    return u, v, w, x / length, y / length, z / length, length


@inlined
def given(floats, lane):  # type: ignore[no-untyped-def]
    """Origin and direction of a ray, local to the scene."""
    x = floats[_OX + lane]
    y = floats[_OY + lane]
    z = floats[_OZ + lane]
    return x, y, z, floats[_DX + lane], floats[_DY + lane], floats[_DZ + lane]


@inlined
def keep_sheared(numbers, floats, lane, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Note what `shear` says of a ray."""
    axis, u, v, w, sx, sy, sz = shear(ox, oy, oz, dx, dy, dz)
    numbers[_AXIS + lane] = axis
    floats[_U + lane] = u
    floats[_V + lane] = v
    floats[_W + lane] = w
    floats[_SX + lane] = sx
    floats[_SY + lane] = sy
    floats[_SZ + lane] = sz


@stage
def shear_all(scratch):  # type: ignore[no-untyped-def]
    """Note what `shear` says of all rays of a group."""
    numbers = int64s(scratch)
    floats = float64s(scratch)
    for lane in range(LANES):
        keep_sheared(numbers, floats, lane, *given(floats, lane))


@stage
def _mesh_of(mesh, instances, numbers, floats, lane, key):  # type: ignore[no-untyped-def]
    """Address of the record of a key's mesh; the ray is taken to the mesh's coordinates."""
    if instances == 0:
        return mesh
    number = key // NUMBER
    address = instances + memory.RECORD * number
    if numbers[_INSIDE + lane] != number:
        ox, oy, oz, dx, dy, dz, length = entered(float64s(address), *given(floats, lane))
        keep_sheared(numbers, floats, lane, ox, oy, oz, dx, dy, dz)
        floats[_LENGTH + lane] = length
        numbers[_INSIDE + lane] = number
    return int64s(address)[memory.MESH_OF]


@inlined
def corners_of(table, place, axis):  # type: ignore[no-untyped-def]
    """Corners of a triangle, each with the axis last."""
    x = axis + 1 if axis < 2 else 0
    y = x + 1 if x < 2 else 0
    k = 9 * place
    return (
        (table[k + x], table[k + y], table[k + axis]),
        (table[k + 3 + x], table[k + 3 + y], table[k + 3 + axis]),
        (table[k + 6 + x], table[k + 6 + y], table[k + 6 + axis]),
    )


@inlined
def _sheared(floats, lane):  # type: ignore[no-untyped-def]
    u = floats[_U + lane]
    v = floats[_V + lane]
    w = floats[_W + lane]
    return u, v, w, floats[_SX + lane], floats[_SY + lane], floats[_SZ + lane]


@inlined
def _clearly(a, b, c, det):  # type: ignore[no-untyped-def]
    """Whether a ray passes inside, and not at an edge or a corner, which others may share."""
    rim = _RIM * det * det
    return (a * det > rim) & (b * det > rim) & (c * det > rim)


@stage
def _stopped(mesh, place, a, b, c, det):  # type: ignore[no-untyped-def]
    """Whether the mask of a mesh stops a ray in a triangle, as `Masks.opaque`."""
    uv = float32s(mesh[1])
    mask = uint8s(mesh[2])
    height = mesh[3]
    width = mesh[4]
    k = 6 * place
    p = a / det
    q = b / det
    r = c / det
    u = (p * np.float64(uv[k]) + q * np.float64(uv[k + 2])) + r * np.float64(uv[k + 4])
    v = (p * np.float64(uv[k + 1]) + q * np.float64(uv[k + 3])) + r * np.float64(uv[k + 5])
    column = min(np.int64((u - np.floor(u)) * width), width - 1)
    row = min(np.int64((v - np.floor(v)) * height), height - 1)
    return mask[row * width + column] != 0


@stage
def _tested(mesh, instances, numbers, floats, lane, key):  # type: ignore[no-untyped-def]
    """Areas of a triangle, their sum, the distance, as in triangle.py, and the mesh's record."""
    record = int64s(_mesh_of(mesh, instances, numbers, floats, lane, key))
    place = key & (NUMBER - 1)
    corners = corners_of(float64s(record[0]), place, numbers[_AXIS + lane])
    a, b, c, det, t = areas(corners, _sheared(floats, lane))
    if instances != 0:
        t = t / floats[_LENGTH + lane]
    return a, b, c, det, t, record


@stage
def _transparent(mesh, instances, numbers, floats, lane, key):  # type: ignore[no-untyped-def]
    """Whether a mask lets a ray through a triangle."""
    a, b, c, det, _, record = _tested(mesh, instances, numbers, floats, lane, key)
    if record[3] == 0:
        return False
    return det == 0 or not _stopped(record, key & (NUMBER - 1), a, b, c, det)


@cache
def plain_proposer(count: int, part: int = 0) -> Any:
    """As `propose`, in a scene without instances and masks, for one size of packets.

    With a constant number of rays, and all numbers at constant distances from one address, the
    loop becomes a few vector instructions. `part` is the number of the packet in its group.
    """
    packet = at("single") if count == 1 else _PACKET + 22 * count * part
    begin = part * count

    @callback(types.void(types.CPointer(types.int64)))
    def propose(arguments):  # type: ignore[no-untyped-def]
        valid = int32s(arguments[0])
        scratch = arguments[2]
        hits = int32s(arguments[4])
        lane = int64s(scratch)[_LANE] if count == 1 else begin
        singles = float32s(scratch)
        integers = int32s(scratch)
        for k in range(count):
            far = packet + 8 * count + k
            own = lane + k
            asked = valid[k] != 0
            rough = singles[far]
            nearest = singles[_ROUGH_32 + own]
            one = integers[_ONE_32 + own]
            other = integers[_OTHER_32 + own]
            place = hits[5 * count + k]
            closer = asked & (rough < nearest)
            clearly = asked & (rough < nearest - np.float32(MARGIN))
            second = place if other == -1 else np.int32(-2)  # a third is too many
            singles[far] = rough + np.float32(MARGIN) if closer else rough
            singles[_ROUGH_32 + own] = rough if closer else nearest
            integers[_ONE_32 + own] = place if clearly else one
            integers[_OTHER_32 + own] = np.int32(-1) if clearly else (second if asked else other)
            valid[k] = np.int32(-1) if closer else np.int32(0)

    return propose


@inlined
def _key(hits, count, k, instances):  # type: ignore[no-untyped-def]
    """Key of the triangle that Embree asks about, from its RTCHitN."""
    key = np.int64(hits[5 * count + k])
    return key + NUMBER * hits[7 * count + k] if instances != 0 else key


@callback(types.void(types.CPointer(types.int64)))
def propose(arguments):  # type: ignore[no-untyped-def]
    """Filter function: keep the closest triangle, and another that float32 cannot tell from it.

    `arguments` is an RTCFilterFunctionNArguments: addresses of mask, user data, context, rays and
    hits, and the number of rays. Embree asks about one triangle at a time, for some rays. Where a
    mask lets a ray through, Embree goes on.
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
        if masked and _transparent(mesh, instances, numbers, floats, lane, key):
            valid[k] = 0
            continue
        rough = np.float64(rays[8 * count + k])
        nearest = floats[_ROUGH + lane]
        if rough < nearest - MARGIN:
            numbers[_ONE + lane] = key
            numbers[_OTHER + lane] = -1
        else:  # a third is too many
            numbers[_OTHER + lane] = key if numbers[_OTHER + lane] == -1 else -2
        if rough < nearest:
            floats[_ROUGH + lane] = rough
            rays[8 * count + k] = np.float32(rough + MARGIN)
        else:
            valid[k] = 0


@stage
def _consider(scratch, lane, key):  # type: ignore[no-untyped-def]
    """Keep a triangle if it is the closest hit so far; whether the ray clearly passes inside."""
    numbers = int64s(scratch)
    floats = float64s(scratch)
    mesh = numbers[_MESH]
    instances = numbers[_INSTANCES]
    a, b, c, det, t, _ = _tested(mesh, instances, numbers, floats, lane, key)
    nearest = floats[_T + lane]
    if (
        det != 0
        and within(a, b, c)
        and floats[_T_MIN] <= t <= floats[_T_MAX]
        and (t < nearest or (t == nearest and key < numbers[_KEY + lane]))
        and not (numbers[_MASKED] and _transparent(mesh, instances, numbers, floats, lane, key))
    ):
        floats[_T + lane] = t
        numbers[_KEY + lane] = key
    return _clearly(a, b, c, det)


@callback(types.boolean(types.CPointer(types.int64)))
def nearby(arguments):  # type: ignore[no-untyped-def]
    """Consider a triangle near a point; `arguments` is an RTCPointQueryFunctionArguments."""
    scratch = arguments[1]
    instance = int32s(arguments[3])[32]
    numbers = int64s(scratch)
    key = arguments[2] & (NUMBER - 1)
    if numbers[_INSTANCES] != 0:
        key += NUMBER * instance
    _consider(scratch, numbers[_LANE], key)
    return False  # the distance of interest stays


@callback(types.void(types.CPointer(types.int64)))
def decide(arguments):  # type: ignore[no-untyped-def]
    """Filter function for single rays: accept what is closer in float64.

    At an edge, Embree may propose any one of the triangles that share it, or one that float64 has
    beside the ray. Then all triangles that are near that point are considered.
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
    # Float32 is so far off along the ray: more where it grazes.
    x = normal[0]
    y = normal[1]
    z = normal[2]
    dx = ray[4]
    dy = ray[5]
    dz = ray[6]
    steep = abs(x * dx + y * dy + z * dz)
    full = np.sqrt((x * x + y * y + z * z) * (dx * dx + dy * dy + dz * dz))
    off = 2 * MARGIN * (max(full / steep, 1.0) if steep > _GRAZES * full else 1 / _GRAZES)
    if not clear:
        query = float32s(scratch + _QUERY_AT)
        along = entry + ray[8]
        ox, oy, oz, dx, dy, dz = given(floats, lane)
        query[0] = np.float32(ox + along * dx)
        query[1] = np.float32(oy + along * dy)
        query[2] = np.float32(oz + along * dz)
        query[4] = np.float32(off)
        where = scratch + _QUERY_AT
        context = scratch + _QUERY_CONTEXT_AT
        _point_query(numbers[_SCENE], where, context, numbers[_NEARBY], scratch)
    if floats[_T + lane] < nearest:
        ray[8] = np.float32(floats[_T + lane] - entry + off)
    else:
        valid[0] = 0


@inlined
def _sure(floats, lane, t_min, a, b, c, det, t):  # type: ignore[no-untyped-def]
    """Whether a ray hits a triangle as float32 has it."""
    off = abs(t - floats[_ENTRY + lane] - floats[_ROUGH + lane])
    return _clearly(a, b, c, det) & (t >= t_min) & (off <= 1.5 * MARGIN)


@inlined
def verify(mesh, instances, numbers, floats, lane):  # type: ignore[no-untyped-def]
    """Write to `t`, `key` and `sure` what the test says of a ray's candidates."""
    t = np.inf
    key = np.int64(-1)
    sure = True
    t_min = floats[_T_MIN]
    one = numbers[_ONE + lane]
    other = numbers[_OTHER + lane]
    if one >= 0:
        a, b, c, det, t, _ = _tested(mesh, instances, numbers, floats, lane, one)
        key = one
        sure = _sure(floats, lane, t_min, a, b, c, det, t)
        if other >= 0:
            a, b, c, det, t_2, _ = _tested(mesh, instances, numbers, floats, lane, other)
            sure = sure and _sure(floats, lane, t_min, a, b, c, det, t_2)
            if t_2 < t or (t_2 == t and other < one):
                t = t_2
                key = other
    floats[_T + lane] = t
    numbers[_KEY + lane] = key
    numbers[_SURE + lane] = np.int64(sure and other != -2)


@inlined
def _copy(table, numbers, floats, candidate):  # type: ignore[no-untyped-def]
    """Copy the corners of the candidates of a group, each with the ray's axis last.

    Reads from far apart come first, which the processor overlaps, then vector instructions.
    """
    axis = numbers[_AXIS]
    differ = np.int64(0)
    for lane in range(LANES):
        differ |= numbers[_AXIS + lane] ^ axis
    if differ:
        for lane in range(LANES):
            (a, b, c), (d, e, f), (g, h, i) = corners_of(
                table, max(numbers[candidate + lane], 0), numbers[_AXIS + lane]
            )
            for k, number in enumerate((a, b, c, d, e, f, g, h, i)):
                floats[_CORNERS + LANES * k + lane] = number
    else:
        x = axis + 1 if axis < 2 else 0
        y = x + 1 if x < 2 else 0
        for lane in range(LANES):
            place = 9 * max(numbers[candidate + lane], 0)
            for k in range(3):
                to = _CORNERS + 3 * LANES * k + lane
                floats[to] = table[place + 3 * k + x]
                floats[to + LANES] = table[place + 3 * k + y]
                floats[to + 2 * LANES] = table[place + 3 * k + axis]


@inlined
def _areas_of(floats, lane):  # type: ignore[no-untyped-def]
    """As `areas`, of the triangle that `_copy` copied for a ray."""
    k = _CORNERS + lane
    p = floats[k], floats[k + LANES], floats[k + 2 * LANES]
    q = floats[k + 3 * LANES], floats[k + 4 * LANES], floats[k + 5 * LANES]
    r = floats[k + 6 * LANES], floats[k + 7 * LANES], floats[k + 8 * LANES]
    return areas((p, q, r), _sheared(floats, lane))


@stage
def _verify_first(scratch, t_min):  # type: ignore[no-untyped-def]
    """Test the first candidates of a group, whose corners have been copied."""
    numbers = int64s(scratch)
    floats = float64s(scratch)
    for lane in range(LANES):
        a, b, c, det, t = _areas_of(floats, lane)
        one = numbers[_ONE + lane]
        sure = _sure(floats, lane, t_min, a, b, c, det, t)
        floats[_T + lane] = t if one >= 0 else np.inf
        numbers[_KEY + lane] = one
        numbers[_SURE + lane] = np.int64((one < 0) | (sure & (numbers[_OTHER + lane] != -2)))


@stage
def _verify_second(scratch, t_min):  # type: ignore[no-untyped-def]
    """Test the second candidates of a group, whose corners have been copied."""
    numbers = int64s(scratch)
    floats = float64s(scratch)
    for lane in range(LANES):
        a, b, c, det, t = _areas_of(floats, lane)
        sure = _sure(floats, lane, t_min, a, b, c, det, t)
        nearest = floats[_T + lane]
        other = numbers[_OTHER + lane]
        key = numbers[_KEY + lane]
        nearer = (other >= 0) & ((t < nearest) | ((t == nearest) & (other < key)))
        floats[_T + lane] = t if nearer else nearest
        numbers[_KEY + lane] = other if nearer else key
        numbers[_SURE + lane] &= np.int64((other < 0) | sure)


@stage
def verify_all(table, scratch, t_min):  # type: ignore[no-untyped-def]
    """As `verify`, of all rays of a group in a plain scene without masks.

    Numbers that are the same for all rays are arguments: a load of one would keep loops from
    becoming vector instructions.
    """
    numbers = int64s(scratch)
    floats = float64s(scratch)
    singles = float32s(scratch)
    integers = int32s(scratch)
    second = np.int64(0)
    for lane in range(LANES):
        floats[_ROUGH + lane] = singles[_ROUGH_32 + lane]
        numbers[_ONE + lane] = integers[_ONE_32 + lane]
        numbers[_OTHER + lane] = integers[_OTHER_32 + lane]
        second += np.int64(integers[_OTHER_32 + lane] >= 0)
    shear_all(scratch)
    _copy(table, numbers, floats, _ONE)
    _verify_first(scratch, t_min)
    if second:
        _copy(table, numbers, floats, _OTHER)
        _verify_second(scratch, t_min)


@inlined
def begun(o, d, entry):  # type: ignore[no-untyped-def]
    """Start of a ray for Embree; near the scene, if float64 cannot place it."""
    return np.float32(min(max(o + entry * d, -NEAR), NEAR))


@stage
def single(scene, scratch, lane, reach, aside, up):  # type: ignore[no-untyped-def]
    """Cast one ray of a group by itself; Embree sees one along an axis moved, aside and up."""
    numbers = int64s(scratch)
    floats = float64s(scratch)
    ray = float32s(scratch + _SINGLE_AT)
    whole = int32s(scratch + _SINGLE_AT)
    entry = floats[_ENTRY + lane]
    ox, oy, oz, dx, dy, dz = given(floats, lane)
    ray[0] = begun(ox, dx, entry)
    ray[1] = begun(oy, dy, entry)
    ray[2] = begun(oz, dz, entry)
    ray[3] = np.float32(max(floats[_T_MIN] - entry - MARGIN, 0.0))
    ray[4] = np.float32(dx)
    ray[5] = np.float32(dy)
    ray[6] = np.float32(dz)
    ray[7] = np.float32(0)
    ray[8] = np.float32(min(reach - entry + MARGIN, FAR))
    axis = 0 if abs(ray[4]) > 0.5 else (1 if abs(ray[5]) > 0.5 else 2)
    ray[(axis + 1) % 3] += np.float32(aside)
    ray[(axis + 2) % 3] += np.float32(up)
    whole[9] = -1
    whole[10] = 0
    whole[11] = 0
    whole[18] = -1
    whole[19] = -1
    whole[20] = -1
    numbers[_LANE] = lane
    _intersect_1(scene, scratch + _SINGLE_AT, scratch + _ARGUMENTS_AT)
    numbers[_LANE] = 0


@stage
def decided(scene, scratch, lane, reach):  # type: ignore[no-untyped-def]
    """Write to `t` and `key` what a ray hits of which `propose` could not be sure.

    Embree does not see what touches a ray along an axis with the upper side of its box (0 * inf in
    its test of boxes). So it is shown eight such rays around it, too.
    """
    numbers = int64s(scratch)
    floats = float64s(scratch)
    flags = int32s(scratch + _ARGUMENTS_AT)
    floats[_T + lane] = np.inf
    numbers[_KEY + lane] = -1
    flags[0] = CALL_FILTER
    aside = 0.0
    up = 0.0
    for k in range(9 if along(floats, lane) else 1):
        single(scene, scratch, lane, reach, aside, up)
        one = MARGIN if k & 1 else -MARGIN
        other = 0.4 * (MARGIN if k & 2 else -MARGIN)
        aside, up = (one, other) if k & 4 else (other, one)
    flags[0] = CALL_FILTER | COHERENT


@inlined
def along(floats, lane):  # type: ignore[no-untyped-def]
    """Whether a ray is along an axis."""
    x = floats[_DX + lane]
    y = floats[_DY + lane]
    z = floats[_DZ + lane]
    return (abs(x) + abs(y)) + abs(z) < _STRAIGHT
