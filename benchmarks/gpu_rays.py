"""Sections of the device's benchmark that need raybeam alone: kernels, and what they return."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from raybeam import (
    Instance,
    Mesh,
    Opacity,
    Pattern,
    PoseMotion,
    RayCaster,
    Scan,
    check_scan,
    pattern_rays,
)
from raybeam.scan import Groups

from .gpu_clock import Session, Split, milliseconds, wall_milliseconds
from .gpu_scenes import Float, beam_directions, city, revolution, six_objects, track
from .gpu_scenes import Mesh as Faces
from .instances import tree, tree_transforms

Rows = Iterator[tuple[str, dict[str, Any]]]
MIDDLE = np.array([10.0, 10.0, 2.0])  # a crossing of the city
_BLOCK = 128

# Moeller and Trumbore in float against all triangles, without a tree: what needs no thought.
_BRUTE_FORCE = """
#define KERNEL extern "C" __global__ void
KERNEL brute_force(
    const float4* triangles, int triangle_count, float ox, float oy, float oz,
    const double* directions, int count, float* distance)
{
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= count) return;
    const float dx = directions[3 * i], dy = directions[3 * i + 1], dz = directions[3 * i + 2];
    float best = 1e30f;
    for (int k = 0; k < triangle_count; ++k) {
        const float4 v = triangles[3 * k], e = triangles[3 * k + 1], g = triangles[3 * k + 2];
        const float px = dy * g.z - dz * g.y, py = dz * g.x - dx * g.z, pz = dx * g.y - dy * g.x;
        const float inverse = 1.0f / (e.x * px + e.y * py + e.z * pz);
        const float tx = ox - v.x, ty = oy - v.y, tz = oz - v.z;
        const float b = (tx * px + ty * py + tz * pz) * inverse;
        const float qx = ty * e.z - tz * e.y, qy = tz * e.x - tx * e.z, qz = tx * e.y - ty * e.x;
        const float c = (dx * qx + dy * qy + dz * qz) * inverse;
        const float t = (g.x * qx + g.y * qy + g.z * qz) * inverse;
        if (b >= 0.0f && c >= 0.0f && b + c <= 1.0f && t >= 0.0f && t < best) best = t;
    }
    distance[i] = best;
}
"""


def name_of(triangles: int) -> str:
    """Return the name of a city in the results."""
    return f"city {triangles:.0e}".replace("e+0", "e")


def rates(session: Session, caster: RayCaster, scan: Scan) -> dict[str, Any]:
    """Time a scan: rays, the cast alone, packing of hits, and copies of hits to the host."""
    engine: Any = caster.engine
    parts = list(scan.chunks(engine.chunk))
    tables = [engine._make_rays(scan, start, stop) for start, stop in parts]
    limits = (scan.t_min, scan.t_max)

    def rays() -> None:
        for start, stop in parts:
            engine._make_rays(scan, start, stop)

    def cast() -> list[Any]:
        return [engine._cast(table, table[1].shape[1], limits) for table in tables]

    hit_parts = cast()
    hits = sum(int((triangle >= 0).sum()) for _, triangle, _ in hit_parts)

    def pack() -> None:
        groups = Groups(scan.groups, 1)
        for (start, _), hit in zip(parts, hit_parts, strict=True):
            engine._pack(hit, start, groups, 1.0, engine._no_counters, engine._no_other_hits)

    times = {
        "rays": milliseconds(session, rays),
        "cast": milliseconds(session, cast),
        "pack": milliseconds(session, pack),
        "to_device": wall_milliseconds(session, lambda: caster.visit(scan, len)),
        "to_host": wall_milliseconds(session, lambda: engine.scan(scan)),
    }
    per_ms = {name: len(scan) / took["ms"] / 1e6 for name, took in times.items()}
    return {"rays": len(scan), "hits": hits / len(scan), "grays_s": per_ms, "ms": times}


def revolutions(session: Session, directions: Float) -> Scan:
    """Make a scan of the same rays from successive poses, 10 cm apart."""
    poses = MIDDLE + 0.1 * np.arange(session.sizes.poses)[:, None] * [1, 0, 0]
    window = (0, len(directions) * len(poses))
    return check_scan(Pattern(directions), poses, window=window, rays_per_pose=len(directions))


def build_caster(mesh: Faces) -> tuple[RayCaster, dict[str, Any]]:
    """Build a CUDA caster; return the caster and figures of its build."""
    start = time.perf_counter()
    caster = RayCaster(*mesh, backend="cuda")
    took = time.perf_counter() - start  # type: ignore[attr-defined]
    tables = caster.engine._meshes
    size = sum(table.nbytes for table in tables) / caster.face_count
    return caster, {"triangles": caster.face_count, "seconds": took, "bytes_a_triangle": size}


def kernels(session: Session) -> Rows:
    """Yield rates of rays in cities, coherent and shuffled, and of brute force."""
    directions = revolution(session.sizes.rays)
    shuffled = np.random.default_rng(0).permutation(directions)
    for count in session.sizes.cities:
        name = name_of(count)
        caster, row = build_caster(city(count))
        yield f"{name}, build", row
        yield f"{name}, coherent", rates(session, caster, revolutions(session, directions))
        yield f"{name}, shuffled", rates(session, caster, revolutions(session, shuffled))
        yield (
            f"{name}, one revolution",
            rates(session, caster, check_scan(Pattern(directions), MIDDLE)),
        )
        yield f"{name}, brute force", brute_force(session, caster, shuffled)
    engine: Any = caster.engine
    for kernel in ("cast_table", "pack", "make_rays"):
        function = engine._module.get_function(kernel)
        yield kernel, {"registers": function.num_regs, "local_bytes": function.local_size_bytes}


def brute_force(session: Session, caster: RayCaster, directions: Float) -> dict[str, float]:
    """Time a subset of the rays against all triangles, without a tree."""
    cupy = session.cupy
    engine = caster.engine
    triangles = engine._meshes[1]  # type: ignore[attr-defined]
    n = int(np.clip(4e10 / caster.face_count, 1024, len(directions)))
    part = cupy.asarray(np.ascontiguousarray(directions[:n]))
    kernel = cupy.RawModule(code=_BRUTE_FORCE, options=()).get_function("brute_force")
    origin = [np.float32(x) for x in engine._scene.frame.to_local(MIDDLE[None])[0]]
    distances = cupy.empty(len(part), np.float32)
    arguments = (
        triangles,
        np.int32(caster.face_count),
        *origin,
        part,
        np.int32(len(part)),
        distances,
    )
    took = milliseconds(session, lambda: kernel((-(-len(part) // _BLOCK),), (_BLOCK,), arguments))
    return {"rays": len(part), "mrays_s": len(part) / took["ms"] / 1e3, **took}


def moving(session: Session) -> Rows:
    """Yield rates with a pose per firing and with motion, beside a pose per revolution."""
    caster = RayCaster(*city(session.sizes.cities[-1]), backend="cuda")
    beams = 128
    directions = beam_directions(beams, session.sizes.rays * session.sizes.poses)
    pattern = Pattern(directions)
    positions, rotations = track(len(directions) // beams)
    positions[:, 2] = MIDDLE[2]
    speeds = np.gradient(positions, 1e-4, axis=0)
    motion = PoseMotion(np.linspace(0, 5e-5, beams), speeds, np.full_like(speeds, 0.3))
    middle = len(positions) // 2
    scans = {
        "still": check_scan(pattern, positions[middle], rotations[middle]),
        "a pose for each firing": check_scan(pattern, positions, rotations, rays_per_pose=beams),
        "with motion": check_scan(
            pattern, positions, rotations, rays_per_pose=beams, motion=motion
        ),
    }
    for name, scan in scans.items():
        yield name, rates(session, caster, scan)
    split = Split(session.cupy)

    def use(hits: Any) -> None:
        with split.timed("rays"):
            hits.rays()

    caster.visit(scan, use)
    took = split.milliseconds()["rays"]
    yield "rays of the hits", {"ms": took, "grays_s": len(scan) / took / 1e6}


def forest(trees: int, leaves: int, masked: bool) -> list[Instance]:
    """Make instances of a tree on a ground; half of each masked leaf is transparent."""
    vertices, faces = tree(leaves)
    opacity = None
    if masked:
        mask = np.add.outer(np.arange(64), np.arange(64)) // 8 % 2 == 0
        opacity = Opacity(mask, np.tile(np.float32([[0, 0], [1, 0], [0, 1]]), (leaves, 1, 1)))
    tree_mesh = Mesh(vertices, faces, opacity)
    reach = 8 * np.sqrt(trees) + 50
    ground = reach * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    floor = Instance(Mesh(ground, [[0, 1, 2], [0, 2, 3]]), np.eye(4))
    return [floor, *(Instance(tree_mesh, matrix) for matrix in tree_transforms(trees))]


def instances(session: Session) -> Rows:
    """Yield rates in a forest of instances, and at a single tree, opaque and masked."""
    scan = revolutions(session, revolution(session.sizes.rays))
    for masked in (False, True):
        start = time.perf_counter()
        caster = RayCaster.from_instances(forest(*session.sizes.forest, masked), backend="cuda")
        took = {"build_s": time.perf_counter() - start, "triangles": caster.face_count}
        yield "forest, masked" if masked else "forest", {**took, **rates(session, caster, scan)}
        [_, tree_instance] = forest(1, session.sizes.forest[1], masked)
        alone = RayCaster.from_instances([Instance(tree_instance.mesh)], backend="cuda")
        scan_near_tree = check_scan(Pattern(revolution(session.sizes.rays)), [0, 0, 6])
        yield "one tree, masked" if masked else "one tree", rates(session, alone, scan_near_tree)


def bits(session: Session) -> Rows:
    """Count sample rays that differ from NumPy's results in any bit; 0 expected."""
    crown = np.array([0.3, 0.2, 6.0])  # of a tree
    step = max(1, session.sizes.rays // session.sizes.sample)
    sample = revolution(session.sizes.rays)[::step]
    plain = city(session.sizes.cities[-1])
    scenes = {
        "six objects": ([Instance(Mesh(*six_objects()))], np.array([0, 0, 2.0])),
        name_of(session.sizes.cities[-1]): ([Instance(Mesh(*plain))], MIDDLE),
        "forest": (forest(25, 2000, False), crown),
        "forest, masked": (forest(25, 2000, True), crown),
    }
    for name, (scene, origin) in scenes.items():
        casters = [RayCaster.from_instances(scene, backend) for backend in ("cuda", "numpy")]
        yield name, _count_differences(casters, sample, origin)


def _count_differences(casters: list[RayCaster], sample: Float, origin: Float) -> dict[str, int]:
    device_hits, host_hits = (caster.cast(origin, sample) for caster in casters)
    counts = {"rays": len(sample), "hits": int(host_hits.hit.sum())}
    for name in ("distance", "triangle", "u", "v", "instance"):
        differs = getattr(device_hits, name) != getattr(host_hits, name)
        counts[f"different {name}"] = int(differs.sum())
    rotation, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    pattern = Pattern(sample, 0.01 * sample)
    still = check_scan(pattern, origin, rotation)
    moving = _moving_scan(pattern, origin, rotation)
    for name, scan in {"scan": still, "moving scan": moving}.items():
        device_scan, host_scan = (caster.engine.scan(scan) for caster in casters)
        counts[f"different {name}"] = _count_different_hits(device_scan, host_scan)
    counts["different tally"] = int((device_scan.tally != host_scan.tally).sum())  # type: ignore[operator]
    expected = pattern_rays(pattern, host_scan.ray, moving.poses)
    counts["different rays"] = _count_different_rays(casters[0], moving, expected)
    return counts


def _moving_scan(pattern: Pattern, origin: Float, rotation: Float) -> Scan:
    """Make a scan with a pose for each ray, 1 mm apart, and motion within poses."""
    positions = origin + 1e-3 * np.arange(len(pattern))[:, None]
    rotations = np.broadcast_to(rotation, (len(positions), 3, 3))
    rates = np.full_like(positions, 0.3)
    motion = PoseMotion(np.zeros(1) + 2e-5, rates, rates)
    return check_scan(pattern, positions, rotations, rays_per_pose=1, motion=motion, tally=True)


def _count_different_hits(device_scan: Any, host_scan: Any) -> int:
    """Count hits that differ in distance or triangle; 1 if the rays that hit differ."""
    if not np.array_equal(device_scan.ray, host_scan.ray):
        return 1
    differs = device_scan.distance != host_scan.distance
    differs |= device_scan.triangle != host_scan.triangle
    return int(np.sum(differs))


def _count_different_rays(caster: RayCaster, scan: Scan, expected: tuple[Float, Float]) -> int:
    """Count coordinates of the device's rays of hits that differ from expected rays."""
    parts: list[tuple[Float, Float]] = []
    caster.visit(scan, lambda hits: parts.append(tuple(a.get() for a in hits.rays())))
    return int(
        sum(
            (rays != np.concatenate(arrays, axis=1).T).sum()
            for arrays, rays in zip(zip(*parts, strict=True), expected, strict=True)
        )
    )


def leaks(session: Session) -> Rows:
    """Count rays from inside a closed mesh that escape at its edges and corners."""
    vertices, faces = six_objects()
    faces = faces[: len(faces) // 6]
    vertices = vertices[: faces.max() + 1] + 5e5
    caster = RayCaster(vertices, faces, backend="cuda")
    inside = np.array([-20, -20, 1.5]) + 5e5
    rng = np.random.default_rng(2)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    escaped = cast_count = 0
    while cast_count < session.sizes.leaks:
        count = min(1 << 20, session.sizes.leaks - cast_count)
        edge_vertices = vertices[edges[rng.integers(len(edges), size=count)]]
        part = np.clip(rng.uniform(-0.5, 1.5, (count, 1)), 0, 1)  # half of them at corners
        origins = inside + 0.1 * rng.uniform(-1, 1, (count, 3))
        directions = edge_vertices[:, 0] * (1 - part) + edge_vertices[:, 1] * part - origins
        escaped += count - int(caster.cast(origins, directions).hit.sum())
        cast_count += count
    yield "edges and corners", {"rays": cast_count, "escaped": escaped}


def large(session: Session) -> Rows:
    """Cast more rays than a 32-bit integer counts, then cast in a large city."""
    directions = revolution(session.sizes.rays)
    caster = RayCaster(*city(session.sizes.cities[0]), backend="cuda")
    revolution_count = -(-session.sizes.rays_beyond_int // len(directions))
    poses = np.broadcast_to(MIDDLE, (revolution_count, 3))
    window = (0, revolution_count * len(directions))
    keep_every = 1009
    scan = check_scan(
        Pattern(directions),
        poses,
        window=window,
        rays_per_pose=len(directions),
        keep_every=keep_every,
    )
    hits_per_revolution = int(caster.scan(Pattern(directions), MIDDLE).hits.sum())
    last = []
    start = time.perf_counter()
    hits, _ = caster.visit(scan, lambda hits: last.append(hits.ray[-1:]))
    took = time.perf_counter() - start
    yield (
        "many rays",
        {
            "rays": len(scan),
            "grays_s": len(scan) / took / 1e9,
            "wrong hits": abs(int(hits.sum()) - revolution_count * hits_per_revolution),
            "last ray": int(last[-1].get()[0]),
        },
    )
    name = name_of(session.sizes.large)
    caster, row = build_caster(city(session.sizes.large))
    yield f"{name}, build", row
    yield f"{name}, coherent", rates(session, caster, revolutions(session, directions))
