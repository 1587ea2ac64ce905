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

from .gpu_clock import Here, Split, milliseconds, wall_milliseconds
from .gpu_scenes import Float, beam_directions, city, revolution, six_objects, track
from .gpu_scenes import Mesh as Faces
from .instances import places, tree

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
    """Name of a city."""
    return f"city {triangles:.0e}".replace("e+0", "e")


def rates(here: Here, caster: RayCaster, scan: Scan) -> dict[str, Any]:
    """Time a scan: the cast alone, closing up, and all until hits are on the host."""
    engine: Any = caster.engine
    parts = list(engine._chunks(scan))
    found = [engine._cast("cast_pattern", n, rays) for _, n, rays in parts]
    hits = sum(int((place >= 0).sum()) for _, place, _ in found)

    def cast() -> None:
        for _, n, rays in parts:
            engine._cast("cast_pattern", n, rays)

    def pack() -> None:
        groups = Groups(scan.groups, 1)
        for (start, _, _), hit in zip(parts, found, strict=True):
            engine._pack(hit, start, groups, 1.0, engine._no_counters, engine._no_other_hits)

    times = {
        "cast": milliseconds(here, cast),
        "pack": milliseconds(here, pack),
        "to_device": wall_milliseconds(here, lambda: caster.visit(scan, len)),
        "to_host": wall_milliseconds(here, lambda: engine.scan(scan)),
    }
    per_ms = {name: len(scan) / took["ms"] / 1e6 for name, took in times.items()}
    return {"rays": len(scan), "hits": hits / len(scan), "grays_s": per_ms, "ms": times}


def revolutions(here: Here, directions: Float) -> Scan:
    """Make a scan of the same rays from one pose after the other, 10 cm apart."""
    poses = MIDDLE + 0.1 * np.arange(here.sizes.poses)[:, None] * [1, 0, 0]
    window = (0, len(directions) * len(poses))
    return check_scan(Pattern(directions), poses, window=window, rays_per_pose=len(directions))


def built(mesh: Faces) -> tuple[RayCaster, dict[str, Any]]:
    """Make a caster: NumPy checks the mesh and makes the tree."""
    start = time.perf_counter()
    caster = RayCaster(*mesh, backend="cuda")
    took = time.perf_counter() - start  # type: ignore[attr-defined]
    tables = caster.engine._meshes
    size = sum(table.nbytes for table in tables) / caster.face_count
    return caster, {"triangles": caster.face_count, "seconds": took, "bytes_a_triangle": size}


def kernels(here: Here) -> Rows:
    """Rates of rays in cities, in order and shuffled, and of brute force."""
    directions = revolution(here.sizes.rays)
    shuffled = np.random.default_rng(0).permutation(directions)
    for count in here.sizes.cities:
        name = name_of(count)
        caster, row = built(city(count))
        yield f"{name}, build", row
        yield f"{name}, coherent", rates(here, caster, revolutions(here, directions))
        yield f"{name}, shuffled", rates(here, caster, revolutions(here, shuffled))
        yield (
            f"{name}, one revolution",
            rates(here, caster, check_scan(Pattern(directions), MIDDLE)),
        )
        yield f"{name}, brute force", brute_force(here, caster, shuffled)
    engine: Any = caster.engine
    for kernel in ("cast_pattern", "pack", "make_rays"):
        made = engine._module.get_function(kernel)
        yield kernel, {"registers": made.num_regs, "local_bytes": made.local_size_bytes}


def brute_force(here: Here, caster: RayCaster, directions: Float) -> dict[str, float]:
    """Rate of every ray against every triangle, on so many rays that it takes a moment."""
    cupy = here.cupy
    engine = caster.engine
    triangles = engine._meshes[1]  # type: ignore[attr-defined]
    n = int(np.clip(4e10 / caster.face_count, 1024, len(directions)))
    part = cupy.asarray(np.ascontiguousarray(directions[:n]))
    kernel = cupy.RawModule(code=_BRUTE_FORCE, options=()).get_function("brute_force")
    at = [np.float32(x) for x in engine._scene.frame.to_local(MIDDLE[None])[0]]
    out = cupy.empty(len(part), np.float32)
    given = (triangles, np.int32(caster.face_count), *at, part, np.int32(len(part)), out)
    took = milliseconds(here, lambda: kernel((-(-len(part) // _BLOCK),), (_BLOCK,), given))
    return {"rays": len(part), "mrays_s": len(part) / took["ms"] / 1e3, **took}


def moving(here: Here) -> Rows:
    """Compare a pose for each firing, and motion within each, with a pose for each revolution."""
    caster = RayCaster(*city(here.sizes.cities[-1]), backend="cuda")
    beams = 128
    directions = beam_directions(beams, here.sizes.rays * here.sizes.poses)
    pattern, (positions, rotations) = Pattern(directions), track(len(directions) // beams)
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
        yield name, rates(here, caster, scan)
    split = Split(here.cupy)

    def use(hits: Any) -> None:
        with split.timed("rays"):
            hits.rays()

    caster.visit(scan, use)
    took = split.milliseconds()["rays"]
    yield "rays of the hits", {"ms": took, "grays_s": len(scan) / took / 1e6}


def forest(trees: int, leaves: int, masked: bool) -> list[Instance]:
    """Make trees of a mesh, on a ground; half of each masked leaf is transparent."""
    vertices, faces = tree(leaves)
    opacity = None
    if masked:
        mask = np.add.outer(np.arange(64), np.arange(64)) // 8 % 2 == 0
        opacity = Opacity(mask, np.tile(np.float32([[0, 0], [1, 0], [0, 1]]), (leaves, 1, 1)))
    one = Mesh(vertices, faces, opacity)
    reach = 8 * np.sqrt(trees) + 50
    ground = reach * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    floor = Instance(Mesh(ground, [[0, 1, 2], [0, 2, 3]]), np.eye(4))
    return [floor, *(Instance(one, matrix) for matrix in places(trees))]


def instances(here: Here) -> Rows:
    """Cast in a forest of instances, opaque and masked; and in one tree of it, as a plain mesh."""
    scan = revolutions(here, revolution(here.sizes.rays))
    for masked in (False, True):
        start = time.perf_counter()
        caster = RayCaster.from_instances(forest(*here.sizes.forest, masked), backend="cuda")
        took = {"build_s": time.perf_counter() - start, "triangles": caster.face_count}
        yield "forest, masked" if masked else "forest", {**took, **rates(here, caster, scan)}
        [_, one] = forest(1, here.sizes.forest[1], masked)
        alone = RayCaster.from_instances([Instance(one.mesh)], backend="cuda")
        near = check_scan(Pattern(revolution(here.sizes.rays)), [0, 0, 6])
        yield "one tree, masked" if masked else "one tree", rates(here, alone, near)


def bits(here: Here) -> Rows:
    """Count rays of samples that differ from NumPy's in any bit; 0 expected."""
    crown = np.array([0.3, 0.2, 6.0])  # of a tree
    step = max(1, here.sizes.rays // here.sizes.sample)
    sample = revolution(here.sizes.rays)[::step]
    plain = city(here.sizes.cities[-1])
    scenes = {
        "six objects": ([Instance(Mesh(*six_objects()))], np.array([0, 0, 2.0])),
        name_of(here.sizes.cities[-1]): ([Instance(Mesh(*plain))], MIDDLE),
        "forest": (forest(25, 2000, False), crown),
        "forest, masked": (forest(25, 2000, True), crown),
    }
    for name, (scene, origin) in scenes.items():
        casters = [RayCaster.from_instances(scene, backend) for backend in ("cuda", "numpy")]
        yield name, _different(casters, sample, origin)


def _different(casters: list[RayCaster], sample: Float, origin: Float) -> dict[str, int]:
    mine, other = (caster.cast(origin, sample) for caster in casters)
    out = {"rays": len(sample), "hits": int(other.hit.sum())}
    for name in ("distance", "triangle", "u", "v", "instance"):
        out[f"different {name}"] = int((getattr(mine, name) != getattr(other, name)).sum())
    turn, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    spots = origin + 1e-3 * np.arange(len(sample))[:, None]
    turns = np.broadcast_to(turn, (len(spots), 3, 3))
    rates = np.full_like(spots, 0.3)
    motion = PoseMotion(np.zeros(1) + 2e-5, rates, rates)
    pattern = Pattern(sample, 0.01 * sample)
    moving = check_scan(pattern, spots, turns, rays_per_pose=1, motion=motion, tally=True)
    for name, scan in {"scan": check_scan(pattern, origin, turn), "moving scan": moving}.items():
        got, want = (caster.engine.scan(scan) for caster in casters)
        same = np.array_equal(got.ray, want.ray)
        wrong = (got.distance != want.distance) | (got.triangle != want.triangle) if same else [1]
        out[f"different {name}"] = int(np.sum(wrong))
    out["different tally"] = int((got.tally != want.tally).sum())  # type: ignore[operator]
    made: list[tuple[Float, Float]] = []
    casters[0].visit(moving, lambda hits: made.append(tuple(a.get() for a in hits.rays())))
    at, to = pattern_rays(pattern, want.ray, moving.poses)
    out["different rays"] = int(sum(
        (rays != np.concatenate(parts, axis=1).T).sum()
        for parts, rays in zip(zip(*made, strict=True), (at, to), strict=True)
    ))  # fmt: skip
    return out


def leaks(here: Here) -> Rows:
    """Count rays from inside a closed object, at its edges and corners, that hit nothing."""
    vertices, faces = six_objects()
    faces = faces[: len(faces) // 6]
    vertices = vertices[: faces.max() + 1] + 5e5
    caster = RayCaster(vertices, faces, backend="cuda")
    inside = np.array([-20, -20, 1.5]) + 5e5
    rng = np.random.default_rng(2)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    escaped = done = 0
    while done < here.sizes.leaks:
        count = min(1 << 20, here.sizes.leaks - done)
        ends = vertices[edges[rng.integers(len(edges), size=count)]]
        part = np.clip(rng.uniform(-0.5, 1.5, (count, 1)), 0, 1)  # half of them at corners
        origins = inside + 0.1 * rng.uniform(-1, 1, (count, 3))
        directions = ends[:, 0] * (1 - part) + ends[:, 1] * part - origins
        escaped += count - int(caster.cast(origins, directions).hit.sum())
        done += count
    yield "edges and corners", {"rays": done, "escaped": escaped}


def large(here: Here) -> Rows:
    """Cast more rays than an int counts, then in a large city."""
    directions = revolution(here.sizes.rays)
    caster = RayCaster(*city(here.sizes.cities[0]), backend="cuda")
    times = -(-here.sizes.many // len(directions))
    poses = np.broadcast_to(MIDDLE, (times, 3))
    window = (0, times * len(directions))
    kept = 1009
    scan = check_scan(
        Pattern(directions), poses, window=window, rays_per_pose=len(directions), keep_every=kept
    )
    once = int(caster.scan(Pattern(directions), MIDDLE).hits.sum())
    last = []
    start = time.perf_counter()
    hits, _ = caster.visit(scan, lambda found: last.append(found.ray[-1:]))
    took = time.perf_counter() - start
    yield (
        "many rays",
        {
            "rays": len(scan),
            "grays_s": len(scan) / took / 1e9,
            "wrong hits": abs(int(hits.sum()) - times * once),
            "last ray": int(last[-1].get()[0]),
        },
    )
    name = name_of(here.sizes.large)
    caster, row = built(city(here.sizes.large))
    yield f"{name}, build", row
    yield f"{name}, coherent", rates(here, caster, revolutions(here, directions))
