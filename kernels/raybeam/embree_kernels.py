"""Compiled loops around Embree: rays are made, cast in packets, and decided in float64.

Embree proposes, float64 decides. A filter function, which Embree calls for each triangle that it
finds in float32, notes the closest and another that float32 cannot tell from it (`propose`); both
then pass the watertight test of triangle.py. Embree is told of a distance that is a little farther
than the closest, so it goes on to propose such triangles. A ray of which that says too little, or
that passes at an edge, is cast again by itself, and the test is applied to every triangle that is
proposed, and at an edge to all that are near (`decide`). Of equally close triangles the lowest
wins. So a ray's result does not depend on the rays that share its packet, nor on the processor's
instructions, and has the bits of the other backends. At an instance, the test takes the ray to the
mesh's coordinates in float64 itself, as instances.py says.

The test follows after all rays of a packet: a filter that read the corners of each candidate waited
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
from numba import cfunc, njit, types
from numba.extending import intrinsic

from .compiled import OPTIONS
from .embree_library import find
from .mesh import NEAR

llvmlite.binding.load_library_permanently(str(find()))  # compiled code names its functions

# The scratch memory of a thread, in units of 8 bytes from an address that is a multiple of 64.
# Embree's query context comes first, since Embree hands its address to the filter.
LANES = 16  # most rays of a packet
SIZE = 808
# `_MESH`: address of a plain scene's mesh; `_INSTANCES`: of the records of instances, 0 for none;
# `_MASKED`: whether any mesh has an opacity.
_MESH, _INSTANCES, _MASKED, _T_MIN, _T_MAX, _LANE = 8, 9, 10, 11, 12, 13
_OX, _OY, _OZ, _DX, _DY, _DZ = 16, 32, 48, 64, 80, 96
_ENTRY = 112  # distance of the start that Embree sees from the origin
# Closest triangle that the ray hits, by key: row of the mesh's corners, and `_NUMBER` times the
# instance's number. Of equally close ones that of the lowest key.
_T, _KEY = 128, 144
# Of `decide`: addresses of the RTCScene and of `nearby`; RTCPointQuery, and its context: zeros.
_SCENE, _NEARBY, _QUERY, _CONTEXT = 14, 15, 160, 164
_ARGUMENTS = 192  # RTCIntersectArguments
_VALID = 200  # int32 [16]
_SINGLE = 208  # RTCRayHit
_PACKET = 224  # RTCRayHit4, 8 or 16
_AXIS, _U, _V, _W, _SX, _SY, _SZ = 448, 464, 480, 496, 512, 528, 544  # see `_shear`
# What `propose` has found: the least distance in float32, its triangle, and another that is as
# near; -1 for none, -2 for several.
_ROUGH, _FIRST, _OTHER = 560, 576, 592
# Instance whose coordinates `_AXIS` to `_SZ` are in, -1: none yet; length of the ray's direction.
_INSIDE, _LENGTH = 608, 624
# The same as `_ROUGH`, `_FIRST` and `_OTHER` in 32 bits, for plain scenes; and 9 numbers of the
# corners of a triangle for each ray.
_ROUGH_32, _FIRST_32, _OTHER_32, _TRIANGLE = 640, 648, 656, 664

# Of a mesh, in the same units: addresses of its corners, and of the uv and the mask of its opacity;
# the mask's height, 0 if the mesh is opaque, and width.
MESH_RECORD = 5
# Of an instance: matrix (12), address of the mesh's record, the mesh's first place in `index`.
RECORD = 14
_MESH_OF, _FIRST_PLACE = 12, 13
_NUMBER = np.int64(1) << 32

_COHERENT, _CALL_FILTER = 1 << 16, 1 << 1  # RTCRayQueryFlags

# Local units. Ten times the error of a float32 distance, unless the ray grazes: so much farther
# Embree goes on to look for triangles.
_MARGIN = 2.0**-19
_TINY = 2.0**-60  # replaces a direction component of zero, to avoid 0 * inf
_FAR = 8.0  # more than the diagonal of any scene

_GRAZES = 2.0**-10  # sine of the least angle to a triangle that `decide` allows for
_RIM = 2.0**-20  # share of a triangle's height: far more than what float64 rounds
_STRAIGHT = 1 + 2.0**-20  # sum of a direction's components, so near to an axis

_inline = njit(forceinline=True, error_model="numpy")
_seldom = njit(error_model="numpy")  # called so seldom that a copy at each call is not worth it


def _pointer(kind: Any) -> Any:
    """Make a function of compiled code that takes an address for a pointer to numbers."""

    @intrinsic
    def at(context: Any, address: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

        return types.CPointer(kind)(types.int64), generate

    return at


_int32s, _int64s = _pointer(types.int32), _pointer(types.int64)
_float32s, _float64s = _pointer(types.float32), _pointer(types.float64)
_uint8s = _pointer(types.uint8)

_intersect_1 = types.ExternalFunction(
    "rtcIntersect1", types.void(types.intp, types.intp, types.intp)
)
_intersect_4, _intersect_8, _intersect_16 = (
    types.ExternalFunction(
        f"rtcIntersect{width}", types.void(types.intp, types.intp, types.intp, types.intp)
    )
    for width in (4, 8, 16)
)

_point_query = types.ExternalFunction(
    "rtcPointQuery", types.boolean(types.intp, types.intp, types.intp, types.intp, types.intp)
)


@_inline
def _shear(ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Longest axis of a ray, origin with that axis last, and shear, as in triangle.py."""
    ax, ay, az = abs(dx), abs(dy), abs(dz)
    first = ax >= ay and ax >= az
    second = not first and ay >= az
    along = dx if first else (dy if second else dz)
    p = dy if first else (dz if second else dx)
    q = dz if first else (dx if second else dy)
    u = oy if first else (oz if second else ox)
    v = oz if first else (ox if second else oy)
    w = ox if first else (oy if second else oz)
    return 0 if first else (1 if second else 2), u, v, w, p / along, q / along, 1.0 / along


@_seldom
def _entered(m, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Take a ray to an instance's coordinates, as `Scene.enter`; also returns its length."""
    x = (m[0] * dx + m[1] * dy) + m[2] * dz
    y = (m[4] * dx + m[5] * dy) + m[6] * dz
    z = (m[8] * dx + m[9] * dy) + m[10] * dz
    length = np.sqrt((x * x + y * y) + z * z)
    u = ((m[0] * ox + m[1] * oy) + m[2] * oz) + m[3]
    v = ((m[4] * ox + m[5] * oy) + m[6] * oz) + m[7]
    w = ((m[8] * ox + m[9] * oy) + m[10] * oz) + m[11]
    return u, v, w, x / length, y / length, z / length, length


@_inline
def _given(floats, lane):  # type: ignore[no-untyped-def]
    """Origin and direction of a ray, local to the scene."""
    x, y, z = floats[_OX + lane], floats[_OY + lane], floats[_OZ + lane]
    return x, y, z, floats[_DX + lane], floats[_DY + lane], floats[_DZ + lane]


@_inline
def _keep_sheared(numbers, floats, lane, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    axis, u, v, w, sx, sy, sz = _shear(ox, oy, oz, dx, dy, dz)
    numbers[_AXIS + lane] = axis
    floats[_U + lane], floats[_V + lane], floats[_W + lane] = u, v, w
    floats[_SX + lane], floats[_SY + lane], floats[_SZ + lane] = sx, sy, sz


@_seldom
def _mesh_of(mesh, instances, numbers, floats, lane, key):  # type: ignore[no-untyped-def]
    """Address of the record of a key's mesh; the ray is taken to the mesh's coordinates."""
    if instances == 0:
        return mesh
    number = key // _NUMBER
    address = instances + 8 * RECORD * number
    if numbers[_INSIDE + lane] != number:
        matrix, ray = _float64s(address), _given(floats, lane)
        ox, oy, oz, dx, dy, dz, length = _entered(matrix, *ray)
        _keep_sheared(numbers, floats, lane, ox, oy, oz, dx, dy, dz)
        floats[_LENGTH + lane], numbers[_INSIDE + lane] = length, number
    return _int64s(address)[_MESH_OF]


@_inline
def _corners(table, place, axis):  # type: ignore[no-untyped-def]
    """Corners of a triangle, each with the axis last."""
    x = axis + 1 if axis < 2 else 0
    y = x + 1 if x < 2 else 0
    k = 9 * place
    return (
        (table[k + x], table[k + y], table[k + axis]),
        (table[k + 3 + x], table[k + 3 + y], table[k + 3 + axis]),
        (table[k + 6 + x], table[k + 6 + y], table[k + 6 + axis]),
    )


@_inline
def _areas(corners, ray):  # type: ignore[no-untyped-def]
    """Signed areas, their sum, and the distance, as in triangle.py."""
    u, v, w, sx, sy, sz = ray
    (px, py, pz), (qx, qy, qz), (rx, ry, rz) = corners
    z0, z1, z2 = pz - w, qz - w, rz - w
    x0, y0 = (px - u) - sx * z0, (py - v) - sy * z0
    x1, y1 = (qx - u) - sx * z1, (qy - v) - sy * z1
    x2, y2 = (rx - u) - sx * z2, (ry - v) - sy * z2
    a = x2 * y1 - y2 * x1
    b = x0 * y2 - y0 * x2
    c = x1 * y0 - y1 * x0
    det = (a + b) + c
    return a, b, c, det, (((a * z0 + b * z1) + c * z2) / det) * sz


@_inline
def _lane(floats, lane):  # type: ignore[no-untyped-def]
    return (
        floats[_U + lane],
        floats[_V + lane],
        floats[_W + lane],
        floats[_SX + lane],
        floats[_SY + lane],
        floats[_SZ + lane],
    )


@_inline
def _inside(a, b, c):  # type: ignore[no-untyped-def]
    return ((a >= 0) & (b >= 0) & (c >= 0)) | ((a <= 0) & (b <= 0) & (c <= 0))


@_inline
def _clearly(a, b, c, det):  # type: ignore[no-untyped-def]
    """Whether a ray passes inside, and not at an edge or a corner, which others may share."""
    rim = _RIM * det * det
    return (a * det > rim) & (b * det > rim) & (c * det > rim)


@_seldom
def _stopped(mesh, place, a, b, c, det):  # type: ignore[no-untyped-def]
    """Whether the mask of a mesh stops a ray in a triangle, as `Masks.opaque`."""
    uv, mask, height, width = _float32s(mesh[1]), _uint8s(mesh[2]), mesh[3], mesh[4]
    k = 6 * place
    p, q, r = a / det, b / det, c / det
    u = (p * np.float64(uv[k]) + q * np.float64(uv[k + 2])) + r * np.float64(uv[k + 4])
    v = (p * np.float64(uv[k + 1]) + q * np.float64(uv[k + 3])) + r * np.float64(uv[k + 5])
    column = min(np.int64((u - np.floor(u)) * width), width - 1)
    row = min(np.int64((v - np.floor(v)) * height), height - 1)
    return mask[row * width + column] != 0


@_seldom
def _tested(mesh, instances, numbers, floats, lane, key):  # type: ignore[no-untyped-def]
    """Areas of a triangle, their sum, the distance, as in triangle.py, and the mesh's record."""
    record = _int64s(_mesh_of(mesh, instances, numbers, floats, lane, key))
    place = key & (_NUMBER - 1)
    corners = _corners(_float64s(record[0]), place, numbers[_AXIS + lane])
    a, b, c, det, t = _areas(corners, _lane(floats, lane))
    if instances != 0:
        t = t / floats[_LENGTH + lane]
    return a, b, c, det, t, record


@_seldom
def _transparent(mesh, instances, numbers, floats, lane, key):  # type: ignore[no-untyped-def]
    """Whether a mask lets a ray through a triangle."""
    a, b, c, det, _, record = _tested(mesh, instances, numbers, floats, lane, key)
    if record[3] == 0:
        return False
    return det == 0 or not _stopped(record, key & (_NUMBER - 1), a, b, c, det)


@cache
def plain_proposer(count: int) -> Any:
    """As `propose`, for packets of `count` rays in a scene without instances and masks.

    With a constant number of rays, and all numbers at constant distances from one address, the
    loop becomes a few vector instructions.
    """
    packet = _SINGLE if count == 1 else _PACKET

    @cfunc(types.void(types.CPointer(types.int64)), **OPTIONS)
    def propose(arguments):  # type: ignore[no-untyped-def]
        valid, scratch, hits = _int32s(arguments[0]), arguments[2], _int32s(arguments[4])
        lane = _int64s(scratch)[_LANE] if count == 1 else 0
        singles, integers = _float32s(scratch), _int32s(scratch)
        for k in range(count):
            far, at = 2 * packet + 8 * count + k, lane + k
            asked, rough, nearest = valid[k] != 0, singles[far], singles[2 * _ROUGH_32 + at]
            first, other = integers[2 * _FIRST_32 + at], integers[2 * _OTHER_32 + at]
            place = hits[5 * count + k]
            closer = asked & (rough < nearest)
            clearly = asked & (rough < nearest - np.float32(_MARGIN))
            second = place if other == -1 else np.int32(-2)  # a third is too many
            singles[far] = rough + np.float32(_MARGIN) if closer else rough
            singles[2 * _ROUGH_32 + at] = rough if closer else nearest
            integers[2 * _FIRST_32 + at] = place if clearly else first
            integers[2 * _OTHER_32 + at] = np.int32(-1) if clearly else (second if asked else other)
            valid[k] = np.int32(-1) if closer else np.int32(0)

    return propose


@_inline
def _key(hits, count, k, instances):  # type: ignore[no-untyped-def]
    """Key of the triangle that Embree asks about, from its RTCHitN."""
    key = np.int64(hits[5 * count + k])
    return key + _NUMBER * hits[7 * count + k] if instances != 0 else key


@cfunc(types.void(types.CPointer(types.int64)), **OPTIONS)
def propose(arguments):  # type: ignore[no-untyped-def]
    """Filter function: keep the closest triangle, and another that float32 cannot tell from it.

    `arguments` is an RTCFilterFunctionNArguments: addresses of mask, user data, context, rays and
    hits, and the number of rays. Embree asks about one triangle at a time, for some rays. Where a
    mask lets a ray through, Embree goes on.
    """
    valid, scratch = _int32s(arguments[0]), arguments[2]
    rays, hits = _float32s(arguments[3]), _int32s(arguments[4])
    count = arguments[5] & 0xFFFFFFFF
    numbers, floats = _int64s(scratch), _float64s(scratch)
    mesh, instances, masked = numbers[_MESH], numbers[_INSTANCES], numbers[_MASKED]
    for k in range(count):
        if valid[k] == 0:
            continue
        lane, key = numbers[_LANE] + k, _key(hits, count, k, instances)
        if masked and _transparent(mesh, instances, numbers, floats, lane, key):
            valid[k] = 0
            continue
        rough, nearest = np.float64(rays[8 * count + k]), floats[_ROUGH + lane]
        if rough < nearest - _MARGIN:
            numbers[_FIRST + lane], numbers[_OTHER + lane] = key, -1
        else:  # a third is too many
            numbers[_OTHER + lane] = key if numbers[_OTHER + lane] == -1 else -2
        if rough < nearest:
            floats[_ROUGH + lane] = rough
            rays[8 * count + k] = np.float32(rough + _MARGIN)
        else:
            valid[k] = 0


@_seldom
def _consider(scratch, lane, key):  # type: ignore[no-untyped-def]
    """Keep a triangle if it is the closest hit so far; whether the ray clearly passes inside."""
    numbers, floats = _int64s(scratch), _float64s(scratch)
    mesh, instances = numbers[_MESH], numbers[_INSTANCES]
    a, b, c, det, t, _ = _tested(mesh, instances, numbers, floats, lane, key)
    nearest = floats[_T + lane]
    if (
        det != 0
        and _inside(a, b, c)
        and floats[_T_MIN] <= t <= floats[_T_MAX]
        and (t < nearest or (t == nearest and key < numbers[_KEY + lane]))
        and not (numbers[_MASKED] and _transparent(mesh, instances, numbers, floats, lane, key))
    ):
        floats[_T + lane], numbers[_KEY + lane] = t, key
    return _clearly(a, b, c, det)


@cfunc(types.boolean(types.CPointer(types.int64)), **OPTIONS)
def nearby(arguments):  # type: ignore[no-untyped-def]
    """Consider a triangle near a point; `arguments` is an RTCPointQueryFunctionArguments."""
    scratch, instance = arguments[1], _int32s(arguments[3])[32]
    numbers, key = _int64s(scratch), arguments[2] & (_NUMBER - 1)
    if numbers[_INSTANCES] != 0:
        key += _NUMBER * instance
    _consider(scratch, numbers[_LANE], key)
    return False  # the distance of interest stays


@cfunc(types.void(types.CPointer(types.int64)), **OPTIONS)
def decide(arguments):  # type: ignore[no-untyped-def]
    """Filter function for single rays: accept what is closer in float64.

    At an edge, Embree may propose any one of the triangles that share it, or one that float64 has
    beside the ray. Then all triangles that are near that point are considered.
    """
    valid, scratch = _int32s(arguments[0]), arguments[2]
    ray, hit, normal = _float32s(arguments[3]), _int32s(arguments[4]), _float32s(arguments[4])
    numbers, floats = _int64s(scratch), _float64s(scratch)
    lane, entry = numbers[_LANE], floats[_ENTRY + numbers[_LANE]]
    nearest = floats[_T + lane]
    clear = _consider(scratch, lane, _key(hit, 1, 0, numbers[_INSTANCES]))
    # Float32 is so far off along the ray: more where it grazes.
    x, y, z, dx, dy, dz = normal[0], normal[1], normal[2], ray[4], ray[5], ray[6]
    steep = abs(x * dx + y * dy + z * dz)
    full = np.sqrt((x * x + y * y + z * z) * (dx * dx + dy * dy + dz * dz))
    off = 2 * _MARGIN * (max(full / steep, 1.0) if steep > _GRAZES * full else 1 / _GRAZES)
    if not clear:
        query, along = _float32s(scratch + 8 * _QUERY), entry + ray[8]
        for axis in range(lane, lane + 3 * LANES, LANES):
            query[axis // LANES] = np.float32(floats[_OX + axis] + along * floats[_DX + axis])
        query[4] = np.float32(off)
        where, context = scratch + 8 * _QUERY, scratch + 8 * _CONTEXT
        _point_query(numbers[_SCENE], where, context, numbers[_NEARBY], scratch)
    if floats[_T + lane] < nearest:
        ray[8] = np.float32(floats[_T + lane] - entry + off)
    else:
        valid[0] = 0


@_inline
def _verify(mesh, instances, numbers, floats, lane, key):  # type: ignore[no-untyped-def]
    """Distance at which a ray hits a triangle, and whether that is as float32 has it."""
    a, b, c, det, t, _ = _tested(mesh, instances, numbers, floats, lane, key)
    off = abs(t - floats[_ENTRY + lane] - floats[_ROUGH + lane])
    sure = _clearly(a, b, c, det) and t >= floats[_T_MIN] and off <= 1.5 * _MARGIN
    return t, sure


@_inline
def _copy(table, numbers, floats, lane, place):  # type: ignore[no-untyped-def]
    """Copy a triangle's corners to the scratch memory, for `_verify_plain`."""
    (a, b, c), (d, e, f), (g, h, i) = _corners(table, place, numbers[_AXIS + lane])
    for k, number in enumerate((a, b, c, d, e, f, g, h, i)):
        floats[_TRIANGLE + LANES * k + lane] = number


@_inline
def _verify_plain(table, numbers, floats, lanes):  # type: ignore[no-untyped-def]
    """Write to `_T` and `_KEY` what `_verify` says of the first triangle of each ray.

    Reads from far apart come first, which the processor overlaps, then vector instructions.
    """
    for lane in range(lanes):
        _copy(table, numbers, floats, lane, max(numbers[_FIRST + lane], 0))
    for lane in range(lanes):
        at = _TRIANGLE + lane
        p = floats[at], floats[at + LANES], floats[at + 2 * LANES]
        q = floats[at + 3 * LANES], floats[at + 4 * LANES], floats[at + 5 * LANES]
        r = floats[at + 6 * LANES], floats[at + 7 * LANES], floats[at + 8 * LANES]
        a, b, c, det, t = _areas((p, q, r), _lane(floats, lane))
        off = abs(t - floats[_ENTRY + lane] - floats[_ROUGH + lane])
        sure = _clearly(a, b, c, det) & (t >= floats[_T_MIN]) & (off <= 1.5 * _MARGIN)
        floats[_T + lane], numbers[_KEY + lane] = t, np.int64(sure)


@_inline
def _turned(matrix, at, x, y, z):  # type: ignore[no-untyped-def]
    return (
        (x * matrix[at] + y * matrix[at + 1]) + z * matrix[at + 2],
        (x * matrix[at + 3] + y * matrix[at + 4]) + z * matrix[at + 5],
        (x * matrix[at + 6] + y * matrix[at + 7]) + z * matrix[at + 8],
    )


@_inline
def _drifted(rate, at, delay, x, y, z):  # type: ignore[no-untyped-def]
    a, b, c = rate[at], rate[at + 1], rate[at + 2]
    return x + delay * (b * z - c * y), y + delay * (c * x - a * z), z + delay * (a * y - b * x)


@_inline
def _opened(numbers, frame):  # type: ignore[no-untyped-def]
    """Pointers to the arrays of `Source`, and what else a ray is made of."""
    return (
        _float64s(numbers[0]),
        _float64s(numbers[1]),
        _float64s(numbers[2]),
        _float64s(numbers[3]),
        _float64s(numbers[4]),
        _float64s(numbers[5]),
        _float64s(numbers[6]),
        numbers[7],
        numbers[1] != 0,
        numbers[3] != 0,
        numbers[4] != 0,
        (frame[0], frame[1], frame[2]),
        frame[3],
    )


@_inline
def _ray(source, row, pose, within):  # type: ignore[no-untyped-def]
    """Local origin and direction of a ray, with the operations of `Pattern.rays`."""
    (
        directions, origins, positions, rotations, delays, velocities, rates,
        rows, shifted, turns, moves, centre, scale,
    ) = source  # fmt: skip
    dx, dy, dz = directions[row], directions[rows + row], directions[2 * rows + row]
    delay = 0.0
    if turns:
        dx, dy, dz = _turned(rotations, 9 * pose, dx, dy, dz)
    if moves:
        delay = delays[within]
        dx, dy, dz = _drifted(rates, 3 * pose, delay, dx, dy, dz)
    ox, oy, oz = positions[3 * pose], positions[3 * pose + 1], positions[3 * pose + 2]
    if shifted:
        x, y, z = origins[row], origins[rows + row], origins[2 * rows + row]
        if turns:
            x, y, z = _turned(rotations, 9 * pose, x, y, z)
        if moves:
            x, y, z = _drifted(rates, 3 * pose, delay, x, y, z)
        ox, oy, oz = x + ox, y + oy, z + oz
    if moves:
        ox = ox + delay * velocities[3 * pose]
        oy = oy + delay * velocities[3 * pose + 1]
        oz = oz + delay * velocities[3 * pose + 2]
    ox, oy, oz = (ox - centre[0]) * scale, (oy - centre[1]) * scale, (oz - centre[2]) * scale
    return ox, oy, oz, dx, dy, dz


@_inline
def _turned_by(turn, x, y, z):  # type: ignore[no-untyped-def]
    (a, b, c), (d, e, f), (g, h, i) = turn
    return (x * a + y * b) + z * c, (x * d + y * e) + z * f, (x * g + y * h) + z * i


@_inline
def _one_pose(addresses, frame):  # type: ignore[no-untyped-def]
    """Rotation and local position of the first pose; the identity without rotations."""
    p, turn = _float64s(addresses[2]), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    if addresses[3] != 0:
        m = _float64s(addresses[3])
        turn = ((m[0], m[1], m[2]), (m[3], m[4], m[5]), (m[6], m[7], m[8]))
    scale = frame[3]
    at = (p[0] - frame[0]) * scale, (p[1] - frame[1]) * scale, (p[2] - frame[2]) * scale
    return turn, at


@_inline
def _clip(low, high, o, d, entry):  # type: ignore[no-untyped-def]
    along = d
    if abs(d) < _TINY:
        along = -_TINY if d < 0 else _TINY
    return max(entry, min((low - o) / along, (high - o) / along))


@_inline
def _entry(frame, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Distance at which a ray from far away comes near the scene's box; 0 from near."""
    entry = 0.0
    if max(max(abs(ox), abs(oy)), abs(oz)) > NEAR:
        entry = _clip(frame[4], frame[7], ox, dx, entry)
        entry = _clip(frame[5], frame[8], oy, dy, entry)
        entry = _clip(frame[6], frame[9], oz, dz, entry)
    return entry


@_inline
def _begun(o, d, entry):  # type: ignore[no-untyped-def]
    """Start of a ray for Embree; near the scene, if float64 cannot place it."""
    return np.float32(min(max(o + entry * d, -NEAR), NEAR))


@_inline
def _next(row, pose, within, step, rows, each):  # type: ignore[no-untyped-def]
    """Row, pose and number within the pose of the ray that is `step` rays farther on."""
    row += step
    if row >= rows:
        row = row - rows if row < 2 * rows else row % rows
    within += step
    if within >= each:
        if within < 2 * each:
            within, pose = within - each, pose + 1
        else:
            pose += within // each
            within %= each
    return row, pose, within


@_inline
def _prepare(scene, scratch, mesh, instances, masked, filters, t_min, t_max):  # type: ignore[no-untyped-def]
    """Write to the scratch memory what all rays share."""
    numbers, floats = _int64s(scratch), _float64s(scratch)
    numbers[0] = -1  # no instance
    numbers[_MESH], numbers[_INSTANCES], numbers[_MASKED] = mesh, instances, masked
    floats[_T_MIN], floats[_T_MAX] = t_min, t_max
    numbers[_SCENE], numbers[_NEARBY] = scene, filters[3]
    numbers[_ARGUMENTS] = np.int64(-1) << 32  # flags are set later; all features
    numbers[_ARGUMENTS + 1] = scratch
    numbers[_ARGUMENTS + 2] = filters[0]
    numbers[_ARGUMENTS + 3] = numbers[_ARGUMENTS + 4] = 0


@_inline
def _shear_all(numbers, floats, lanes):  # type: ignore[no-untyped-def]
    for lane in range(lanes):
        _keep_sheared(numbers, floats, lane, *_given(floats, lane))


@_seldom
def _single(scene, scratch, lane, reach, aside=0.0, up=0.0):  # type: ignore[no-untyped-def]
    """Cast one ray of a packet by itself; or what Embree sees of one along an axis, moved."""
    numbers, floats = _int64s(scratch), _float64s(scratch)
    ray, entry = _float32s(scratch + 8 * _SINGLE), floats[_ENTRY + lane]
    ray[0] = _begun(floats[_OX + lane], floats[_DX + lane], entry)
    ray[1] = _begun(floats[_OY + lane], floats[_DY + lane], entry)
    ray[2] = _begun(floats[_OZ + lane], floats[_DZ + lane], entry)
    ray[3] = np.float32(max(floats[_T_MIN] - entry - _MARGIN, 0.0))
    ray[4], ray[5] = np.float32(floats[_DX + lane]), np.float32(floats[_DY + lane])
    ray[6], ray[7] = np.float32(floats[_DZ + lane]), np.float32(0)
    ray[8] = np.float32(min(reach - entry + _MARGIN, _FAR))
    axis = 0 if abs(ray[4]) > 0.5 else (1 if abs(ray[5]) > 0.5 else 2)
    ray[(axis + 1) % 3] += np.float32(aside)
    ray[(axis + 2) % 3] += np.float32(up)
    whole = _int32s(scratch + 8 * _SINGLE)
    whole[9], whole[10], whole[11], whole[18], whole[19], whole[20] = -1, 0, 0, -1, -1, -1
    numbers[_LANE] = lane
    _intersect_1(scene, scratch + 8 * _SINGLE, scratch + 8 * _ARGUMENTS)
    numbers[_LANE] = 0


@_seldom
def _decided(scene, scratch, lane, reach):  # type: ignore[no-untyped-def]
    """Distance and triangle of a ray of which `propose` could not be sure.

    Embree does not see what touches a ray along an axis with the upper side of its box (0 * inf in
    its test of boxes). So it is shown eight such rays around it, too.
    """
    numbers, floats = _int64s(scratch), _float64s(scratch)
    flags = _int32s(scratch + 8 * _ARGUMENTS)
    floats[_T + lane], numbers[_KEY + lane] = np.inf, -1
    flags[0] = _CALL_FILTER
    _single(scene, scratch, lane, reach)
    if _along(floats, lane):
        for k in range(8):
            one = _MARGIN if k & 1 else -_MARGIN
            other = 0.4 * (_MARGIN if k & 2 else -_MARGIN)
            aside, up = (one, other) if k & 4 else (other, one)
            _single(scene, scratch, lane, reach, aside, up)
    flags[0] = _CALL_FILTER | _COHERENT
    return floats[_T + lane], numbers[_KEY + lane]


@_inline
def _along(floats, lane):  # type: ignore[no-untyped-def]
    """Whether a ray is along an axis."""
    _, _, _, x, y, z = _given(floats, lane)
    return (abs(x) + abs(y)) + abs(z) < _STRAIGHT


@_inline
def _apart(floats, lanes, coherence):  # type: ignore[no-untyped-def]
    """Whether some rays of a packet differ too much from the first."""
    x, y, z = floats[_DX], floats[_DY], floats[_DZ]
    for lane in (lanes // 4, lanes // 2, lanes - 1):
        if x * floats[_DX + lane] + y * floats[_DY + lane] + z * floats[_DZ + lane] < coherence:
            return True
    return False


@njit(
    "(i8, i8, i8, i8, b1, i8[::1], i8[::1], f8[::1], b1, b1, i8, i8, i8, i8, i8, i8, "
    "f8, f8, f8, f8[::1], i4[::1], i4[::1])",
    nogil=True,
    **OPTIONS,
)
def trace(  # type: ignore[no-untyped-def]
    scene, scratch, mesh, instances, masked, filters, addresses, frame, near, still,
    first, start, stop, each, step, width, coherence, t_min, t_max, distance, place, instance,
):  # fmt: skip
    """Cast rays `start` to `stop`; write local distances, inf for a miss, places and instances.

    Parameters
    ----------
    scene, scratch, mesh, instances
        Addresses: of the RTCScene, of `SIZE` numbers of scratch memory, of the record of a plain
        scene's mesh, and of the records of instances (0 in a plain scene).
    masked
        Whether any mesh has an opacity.
    filters
        int64 (4,): addresses of the filters for packets, for single rays, of `decide` and `nearby`.
    addresses
        int64 (8,): of arrays (float64, contiguous), 0 for those that there are not: directions
        and origins of the pattern (3, rows), positions (k, 3), rotations (k, 3, 3), delays
        (each,), velocities (k, 3), rates (k, 3); and the number of the pattern's rows.
    frame
        float64 (10,): centre, scale, low and high corner of the scene's box, as in layout.py.
    near, still
        Whether all rays start near the scene's box, and all at the position of one pose.
    first, each
        Row of the pattern that ray 0 has; rays of a pose.
    step, width
        Rays of a packet are so far apart, and so many.
    coherence
        A packet in which the cosine between two rays is less is cast ray by ray.
    t_min, t_max
        Local.
    distance, place, instance
        float64, int32 and int32 (stop - start,), written; the last only if there are instances.
    """
    numbers, floats = _int64s(scratch), _float64s(scratch)
    rays, whole = _float32s(scratch + 8 * _PACKET), _int32s(scratch + 8 * _PACKET)
    valid = _int32s(scratch + 8 * _VALID)
    flags = _int32s(scratch + 8 * _ARGUMENTS)
    _prepare(scene, scratch, mesh, instances, masked, filters, t_min, t_max)
    flags[0] = _CALL_FILTER | _COHERENT
    numbers[_LANE] = 0
    for lane in range(width):
        floats[_ENTRY + lane] = 0.0
    for k in range(width):
        rays[7 * width + k] = np.float32(0)
        whole[9 * width + k] = -1
        whole[10 * width + k] = whole[11 * width + k] = 0
        whole[18 * width + k] = whole[19 * width + k] = whole[20 * width + k] = -1
    rough, plain = _float32s(scratch + 8 * _ROUGH_32), instances == 0 and not masked
    firsts, others = _int32s(scratch + 8 * _FIRST_32), _int32s(scratch + 8 * _OTHER_32)
    table = _float64s(_int64s(mesh)[0])
    source, rows, span = _opened(addresses, frame), addresses[7], step * width
    directions, turns = _float64s(addresses[0]), addresses[3] != 0
    turn, (ox, oy, oz) = _one_pose(addresses, frame)
    for block in range(start, stop, span):
        row_0, pose_0, within_0 = (first + block) % rows, block // each, block % each
        for beam in range(min(step, stop - block)):
            ray = block + beam
            lanes = width if block + span <= stop else (stop - ray + step - 1) // step
            row, pose, within = row_0, pose_0, within_0
            if still:
                for lane in range(lanes):
                    floats[_U + lane], floats[_V + lane] = directions[row], directions[rows + row]
                    floats[_W + lane] = directions[2 * rows + row]
                    row += step
                    if row >= rows:
                        row %= rows
                for lane in range(lanes):
                    x, y, z = floats[_U + lane], floats[_V + lane], floats[_W + lane]
                    if turns:
                        x, y, z = _turned_by(turn, x, y, z)
                    floats[_OX + lane], floats[_OY + lane], floats[_OZ + lane] = ox, oy, oz
                    floats[_DX + lane], floats[_DY + lane], floats[_DZ + lane] = x, y, z
            else:
                for lane in range(lanes):
                    ox, oy, oz, dx, dy, dz = _ray(source, row, pose, within)
                    floats[_OX + lane], floats[_OY + lane], floats[_OZ + lane] = ox, oy, oz
                    floats[_DX + lane], floats[_DY + lane], floats[_DZ + lane] = dx, dy, dz
                    row, pose, within = _next(row, pose, within, step, rows, each)
            if not near:
                for lane in range(lanes):
                    floats[_ENTRY + lane] = _entry(frame, *_given(floats, lane))
            for lane in range(lanes):
                floats[_ROUGH + lane], numbers[_INSIDE + lane] = np.inf, -1
                numbers[_FIRST + lane] = numbers[_OTHER + lane] = -1
            for lane in range(width):
                rough[lane] = np.float32(np.inf)
                firsts[lane] = others[lane] = np.int32(-1)
            if masked and instances == 0:  # `propose` looks at masks
                _shear_all(numbers, floats, lanes)
            if width == 1 or lanes == 1 or _apart(floats, lanes, coherence):
                flags[0], numbers[_ARGUMENTS + 2] = _CALL_FILTER, filters[1]
                for lane in range(lanes):
                    _single(scene, scratch, lane, t_max)
                flags[0], numbers[_ARGUMENTS + 2] = _CALL_FILTER | _COHERENT, filters[0]
            else:
                for lane in range(lanes):
                    entry = floats[_ENTRY + lane]
                    rays[lane] = _begun(floats[_OX + lane], floats[_DX + lane], entry)
                    rays[width + lane] = _begun(floats[_OY + lane], floats[_DY + lane], entry)
                    rays[2 * width + lane] = _begun(floats[_OZ + lane], floats[_DZ + lane], entry)
                    rays[3 * width + lane] = np.float32(max(t_min - entry - _MARGIN, 0.0))
                    rays[4 * width + lane] = np.float32(floats[_DX + lane])
                    rays[5 * width + lane] = np.float32(floats[_DY + lane])
                    rays[6 * width + lane] = np.float32(floats[_DZ + lane])
                    rays[8 * width + lane] = np.float32(min(t_max - entry + _MARGIN, _FAR))
                for lane in range(width):
                    valid[lane] = -1 if lane < lanes else 0
                if width == 16:
                    _intersect_16(
                        scratch + 8 * _VALID, scene, scratch + 8 * _PACKET, scratch + 8 * _ARGUMENTS
                    )
                elif width == 8:
                    _intersect_8(
                        scratch + 8 * _VALID, scene, scratch + 8 * _PACKET, scratch + 8 * _ARGUMENTS
                    )
                else:
                    _intersect_4(
                        scratch + 8 * _VALID, scene, scratch + 8 * _PACKET, scratch + 8 * _ARGUMENTS
                    )
            straight = 0
            for lane in range(lanes):
                straight += _along(floats, lane)
            if plain:
                found = straight
                for lane in range(lanes):
                    floats[_ROUGH + lane] = rough[lane]
                    numbers[_FIRST + lane], numbers[_OTHER + lane] = firsts[lane], others[lane]
                    found += firsts[lane] >= 0
                if found:
                    _shear_all(numbers, floats, lanes)
                    _verify_plain(table, numbers, floats, lanes)
            at = ray - start
            for lane in range(lanes):
                one, other = numbers[_FIRST + lane], numbers[_OTHER + lane]
                t, sure = np.inf, True
                if one >= 0:
                    if plain:
                        t, sure = floats[_T + lane], numbers[_KEY + lane] == 1
                    else:
                        t, sure = _verify(mesh, instances, numbers, floats, lane, one)
                    if other >= 0:
                        t_2, sure_2 = _verify(mesh, instances, numbers, floats, lane, other)
                        sure = sure and sure_2
                        if t_2 < t or (t_2 == t and other < one):
                            t, one = t_2, other
                    if other == -2:
                        sure = False
                if not sure or (straight and _along(floats, lane)):
                    numbers[_ARGUMENTS + 2] = filters[2]
                    t, one = _decided(scene, scratch, lane, t_max)
                    numbers[_ARGUMENTS + 2] = filters[0]
                if t > t_max:
                    t, one = np.inf, np.int64(-1)
                if instances != 0 and one >= 0:
                    number = one // _NUMBER
                    record = _int64s(instances + 8 * RECORD * number)
                    one, instance[at] = (one & (_NUMBER - 1)) + record[_FIRST_PLACE], number
                distance[at], place[at] = t, one
                at += step
            row_0, pose_0, within_0 = _next(row_0, pose_0, within_0, 1, rows, each)


@njit(
    "i8(f8[::1], i4[::1], i4[::1], i4[::1], i8, f8, i8[::1], i8, i8, i8[::1], i8[::1], "
    "u4[::1], f8[::1], i4[::1], i4[::1])",
    nogil=True,
    **OPTIONS,
)
def gather(  # type: ignore[no-untyped-def]
    distance, place, instance, index, start, metre, groups, group, every, hits, tally,
    ray, metres, triangle, kept_instance,
):  # fmt: skip
    """Count the hits of rays from `start` on, and select those to keep; returns their number.

    Parameters
    ----------
    distance, place, instance
        Of all rays, as `trace` writes them; no instances in a plain scene.
    index
        The caller's triangle of each place.
    metre
        Metres in one local unit.
    groups, every
        As in `Scan`.
    group
        That of ray `start`.
    hits
        int64 (g,): of each group; those of these rays are added.
    tally
        int64 (places,), added to; or empty.
    ray, metres, triangle, kept_instance
        Of the kept hits, written; the last only if there are instances.
    """
    kept, seen = 0, hits[group]
    after = groups[group + 1] if group + 1 < len(groups) else np.int64(2) ** 62
    left = (every - seen % every) % every  # hits until the next kept one
    for k in range(len(place)):
        while start + k >= after:
            hits[group] = seen
            group += 1
            seen, left = hits[group], 0
            after = groups[group + 1] if group + 1 < len(groups) else np.int64(2) ** 62
        if place[k] < 0:
            continue
        seen += 1
        if len(tally):
            tally[place[k]] += 1
        if left:
            left -= 1
            continue
        left = every - 1
        ray[kept], metres[kept] = start + k, distance[k] * metre
        triangle[kept] = index[place[k]]
        if len(instance):
            kept_instance[kept] = instance[k]
        kept += 1
    hits[group] = seen
    return kept


@njit("(i8, i8, f8[:, ::1], f8[:, ::1], i4[::1], i4[::1], f8[::1], f8[::1])", nogil=True, **OPTIONS)
def weigh(mesh, instances, origins, directions, place, instance, u, v):  # type: ignore[no-untyped-def]
    """Write weights of the second and third corner for hits of rays (m, 3), local to the scene.

    `mesh`, `instances` and the hits' `place` and `instance` are as for `trace`.
    """
    for k in range(len(place)):
        o, to = origins[k if len(origins) > 1 else 0], directions[k]
        ox, oy, oz, dx, dy, dz = o[0], o[1], o[2], to[0], to[1], to[2]
        at, mesh_at = np.int64(place[k]), mesh
        if instances != 0:
            address = instances + 8 * RECORD * np.int64(instance[k])
            record = _int64s(address)
            mesh_at, at = record[_MESH_OF], at - record[_FIRST_PLACE]
            ox, oy, oz, dx, dy, dz, _ = _entered(_float64s(address), ox, oy, oz, dx, dy, dz)
        axis, p, q, r, sx, sy, sz = _shear(ox, oy, oz, dx, dy, dz)
        triangle = _corners(_float64s(_int64s(mesh_at)[0]), at, axis)
        a, b, c, det, _ = _areas(triangle, (p, q, r, sx, sy, sz))
        sign = -1.0 if det < 0 else 1.0  # outside by float32's rounding: at the edge
        a, b, c = max(sign * a, 0.0), max(sign * b, 0.0), max(sign * c, 0.0)
        total = (a + b) + c
        u[k], v[k] = b / total, c / total


# Whether this process compiled the loops; otherwise it loaded what an earlier one had kept.
COMPILED = bool(trace.stats.cache_misses)
