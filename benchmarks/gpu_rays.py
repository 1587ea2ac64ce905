"""Sections of the GPU benchmark that measure kernel rates, using only raybeam."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from raybeam import Instance, Mesh, Opacity, Pattern, PoseMotion, RayCaster
from raybeam.scan import HitGroups, Scan, check_scan

from .gpu_clock import Session, Split, milliseconds, wall_milliseconds
from .gpu_scenes import Float, beam_directions, city, revolution, track, tree, tree_transforms
from .gpu_scenes import Mesh as Faces

Rows = Iterator[tuple[str, dict[str, Any]]]
MIDDLE = np.array([10.0, 10.0, 2.0])  # a crossing of the city
STAGES = ("rays", "cast", "pack", "to_device", "to_host")


def name_of(triangles: int) -> str:
    return f"city {triangles:.0e}".replace("e+0", "e")


def rates(
    session: Session, caster: RayCaster, scan: Scan, stages: Sequence[str] = STAGES
) -> dict[str, Any]:
    """Measure how long a scan takes to make rays, cast, pack hits, and copy them to the host."""
    engine: Any = caster.engine
    parts = list(scan.chunks(engine.chunk))
    rays_of_parts = [engine._make_rays(scan, start, stop) for start, stop in parts]
    tables = [(rays[:3], rays[3:]) for rays in rays_of_parts]
    limits = (scan.t_min, scan.t_max)

    def rays() -> None:
        for start, stop in parts:
            engine._make_rays(scan, start, stop)

    def cast() -> list[Any]:
        return [engine._cast(table, table[1].shape[1], limits) for table in tables]

    hit_parts = cast()
    hits = sum(int((triangle >= 0).sum()) for _, triangle, _ in hit_parts)

    def pack() -> None:
        groups = HitGroups(scan.groups, 1)
        for (start, _), hit in zip(parts, hit_parts, strict=True):
            chunk = engine._count_chunk_hits(start, None, hit, groups, engine._no_external_hits)
            engine._pack(chunk, groups, 1.0, engine._no_counters)

    calls: dict[str, tuple[Any, Callable[[], object]]] = {
        "rays": (milliseconds, rays),
        "cast": (milliseconds, cast),
        "pack": (milliseconds, pack),
        "to_device": (wall_milliseconds, lambda: caster.scan_on_device(scan, len)),
        "to_host": (wall_milliseconds, lambda: engine.scan(scan)),
    }
    times = {name: clock(session, call) for name, (clock, call) in calls.items() if name in stages}
    per_ms = {name: len(scan) / took["ms"] / 1e6 for name, took in times.items()}
    return {"rays": len(scan), "hits": hits / len(scan), "grays_s": per_ms, "ms": times}


def revolutions(session: Session, directions: Float) -> Scan:
    """Make a scan of the same rays from successive poses 10 cm apart."""
    poses = MIDDLE + 0.1 * np.arange(session.sizes.poses)[:, None] * [1, 0, 0]
    window = (0, len(directions) * len(poses))
    return check_scan(Pattern(directions), poses, window=window, rays_per_pose=len(directions))


def build_caster(mesh: Faces) -> tuple[RayCaster, dict[str, Any]]:
    """Build a CUDA caster, and return it with measurements of the build."""
    start = time.perf_counter()
    caster = RayCaster(*mesh, backend="cuda")
    took = time.perf_counter() - start  # type: ignore[attr-defined]
    tables = caster.engine._meshes
    size = sum(table.nbytes for table in tables) / caster.face_count
    return caster, {"triangles": caster.face_count, "seconds": took, "bytes_a_triangle": size}


def scattered(session: Session, rays: int) -> Scan:
    """Make a scan of random directions from random origins in the center of the city."""
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(rays, 3))
    origins = rng.uniform([-40, -40, 0], [40, 40, 20], (rays, 3))
    poses = np.broadcast_to(MIDDLE * [1, 1, 0], (session.sizes.poses, 3))
    window = (0, rays * len(poses))
    return check_scan(Pattern(directions, origins), poses, window=window, rays_per_pose=rays)


def other_scans(session: Session, directions: Float) -> dict[str, Scan]:
    """Return the scans for which only casting is timed, keyed by the kind of rays."""
    shuffled = np.random.default_rng(0).permutation(directions)
    return {
        "shuffled": revolutions(session, shuffled),
        "scattered": scattered(session, len(directions)),
        "one revolution": check_scan(Pattern(directions), MIDDLE),
    }


def kernels(session: Session) -> Rows:
    """Yield ray rates in cities, in sensor order, in random order and for random rays."""
    directions = revolution(session.sizes.rays)
    scans = other_scans(session, directions)
    for count in (session.sizes.smallest, *session.sizes.cities):
        name = name_of(count)
        caster, row = build_caster(city(count))
        yield f"{name}, build", row
        yield f"{name}, coherent", rates(session, caster, revolutions(session, directions))
        for kind, scan in scans.items():
            yield f"{name}, {kind}", rates(session, caster, scan, ["cast"])


def moving(session: Session) -> Rows:
    """Yield ray rates with one pose per revolution, one pose per firing, and motion."""
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

    caster.scan_on_device(scan, use)
    took = split.milliseconds()["rays"]
    yield "rays of the hits", {"ms": took, "grays_s": len(scan) / took / 1e6}


def forest(trees: int, leaves: int, masked: bool) -> list[Instance]:
    """Make instances of a tree on the ground.

    With masks, half of each leaf is transparent.
    """
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
    """Yield ray rates for a forest of instances and for a single tree, with and without masks."""
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


def large(session: Session) -> Rows:
    """Cast more rays than a 32-bit integer can count, then cast in a large city."""
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
    hits_per_revolution = int(caster.scan(Pattern(directions), MIDDLE).hit_counts.sum())
    last = []
    start = time.perf_counter()
    hits, _ = caster.scan_on_device(scan, lambda hits: last.append(hits.ray[-1:]))
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
    for kind, scan in other_scans(session, directions).items():
        yield f"{name}, {kind}", rates(session, caster, scan, ["cast"])
