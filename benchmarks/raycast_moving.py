"""What poses cost: `python -m benchmarks.raycast_moving`.

Four things are timed in turns, for lidars of several numbers of beams, each with the same rays
and one thread:

- bare: directions rotated in float32 by BLAS, into an array made before, and Open3D's cast_rays;
- still: `RayCaster.scan` from one pose with a rotation, of whose hits every fifth is kept;
- moving: the same with a pose for each firing;
- late: the same with beams that are fired one after the other, from where the lidar is then.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from raybeam import Motion, Pattern, RayCaster, available_backends

from .gpu_scenes import city

Float = NDArray[np.float64]

BEAMS = (16, 64, 128)
_KEEP_EVERY = 5
_CLOCKS = {"wall": time.perf_counter, "cpu": time.process_time}
_LIMITS = {"no limits": {}, "0.5 to 100 m": {"t_min": 0.5, "t_max": 100.0}}


def beam_directions(beams: int, rays: int) -> Float:
    """Make unit directions (n, 3), firing by firing, from 15 degrees below level to 45 above."""
    azimuth = np.linspace(0, 2 * np.pi, max(1, rays // beams), endpoint=False)[:, None]
    elevation = np.radians(np.linspace(-15, 45, beams))
    flat = np.cos(elevation)
    x, y = np.cos(azimuth) * flat, np.sin(azimuth) * flat
    return np.stack([x, y, np.broadcast_to(np.sin(elevation), x.shape)], axis=-1).reshape(-1, 3)


def track(firings: int) -> tuple[Float, Float]:
    """Positions (k, 3) and rotations (k, 3, 3) of a head that moves by 1 m and turns by 5 degrees.

    It is tilted by 2 degrees, so that no rotation is about an axis.
    """
    part = np.linspace(-0.5, 0.5, firings)
    yaw, tilt = np.radians(5) * part, np.radians(2)
    rotations = np.zeros((firings, 3, 3))
    rotations[:, 0, 0] = rotations[:, 1, 1] = np.cos(yaw)
    rotations[:, 1, 0] = np.sin(yaw)
    rotations[:, 0, 1] = -rotations[:, 1, 0]
    rotations[:, 2, 2] = 1
    c, s = np.cos(tilt), np.sin(tilt)
    positions = np.column_stack([10 + part, 10 + 0.3 * part, np.full(firings, 20.0)])
    return positions, rotations @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def _bare(vertices: Float, faces: Any, directions: Float) -> Callable[[Float, Float], Any]:
    """Cast as one would with Open3D, for one pose; the fastest way to make its rays."""
    import open3d

    scene, tensor = open3d.t.geometry.RaycastingScene(nthreads=1), open3d.core.Tensor
    scene.add_triangles(tensor(vertices.astype(np.float32)), tensor(faces.astype(np.uint32)))
    single = directions.astype(np.float32)
    rows = np.empty((len(directions), 6), np.float32)

    def cast(position: Float, rotation: Float) -> Any:
        rows[:, :3] = position
        np.matmul(single, rotation.T.astype(np.float32), out=rows[:, 3:])
        return scene.cast_rays(tensor.from_numpy(rows), nthreads=1)

    return cast


def measure(
    triangles: int, rays: int, rounds: int, clock: Callable[[], float]
) -> list[dict[str, Any]]:
    """Time all numbers of beams, with and without limits of distance."""
    vertices, faces = city(triangles)
    caster = RayCaster(vertices, faces, "embree", threads=1)
    return [
        _measured(
            caster, _bare(vertices, faces, directions), directions, beams, kind, rounds, clock
        )
        for beams in BEAMS
        for directions in [beam_directions(beams, rays)]
        for kind in _LIMITS
    ]


def _measured(
    caster: RayCaster,
    bare: Callable[[Float, Float], Any],
    directions: Float,
    beams: int,
    kind: str,
    rounds: int,
    clock: Callable[[], float],
) -> dict[str, Any]:
    pattern, (positions, rotations) = Pattern(directions), track(len(directions) // beams)
    middle = len(positions) // 2
    one, more = (positions[middle], rotations[middle]), {"keep_every": _KEEP_EVERY, **_LIMITS[kind]}
    speeds = np.gradient(positions, 1e-4, axis=0)
    motion = Motion(np.linspace(0, 5e-5, beams), speeds, np.full_like(speeds, 0.3))
    calls: dict[str, Callable[[], Any]] = {
        "bare": lambda: bare(*one),
        "still": lambda: caster.scan(pattern, *one, **more),
        "moving": lambda: caster.scan(pattern, positions, rotations, rays_per_pose=beams, **more),
        "late": lambda: caster.scan(
            pattern, positions, rotations, rays_per_pose=beams, motion=motion, **more
        ),
    }
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(rounds + 1):
        names = list(calls)[turn % 4 :] + list(calls)[: turn % 4]
        for name in names:
            start = clock()
            calls[name]()
            if turn:  # the first round warms up
                seconds[name].append(clock() - start)
    share = int(calls["still"]().hits.sum()) / len(directions)
    return {
        "triangles": caster.face_count,
        "rays": len(directions),
        "beams": beams,
        "limits": kind,
        "hit_share": share,
        "seconds": seconds,
        "still_to_bare": _ratio(seconds, "still", "bare"),
        "moving_to_still": _ratio(seconds, "moving", "still"),
        "late_to_still": _ratio(seconds, "late", "still"),
    }


def _ratio(seconds: dict[str, list[float]], one: str, other: str) -> float:
    """Median over the rounds."""
    return float(np.median(np.maximum(seconds[one], 1e-9) / np.maximum(seconds[other], 1e-9)))


def show(row: dict[str, Any]) -> None:
    """Print one line."""
    ms = {name: 1e3 * float(np.median(values)) for name, values in row["seconds"].items()}
    print(
        f"{row['beams']:>4} beams, {row['rays']:,} rays, {row['triangles']:,} triangles, "
        f"{row['limits']}, hits {100 * row['hit_share']:.0f} %: bare {ms['bare']:.2f} ms; "
        f"still {row['still_to_bare']:.3f} x bare; moving {row['moving_to_still']:.3f} x still; "
        f"late {row['late_to_still']:.3f} x still"
    )


def main(arguments: list[str] | None = None) -> int:
    """Run from the command line; 2 where Embree is not there."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="toy sizes, two rounds")
    parser.add_argument("--rounds", type=int, default=21)
    parser.add_argument("--clock", choices=_CLOCKS, default="wall")
    chosen = parser.parse_args(arguments)
    if reason := available_backends()["embree"]:
        print(f"Nothing was measured: {reason}", file=sys.stderr)
        return 2
    sizes = (2_000, 2_000, 2) if chosen.quick else (100_000, 115_200, chosen.rounds)
    for row in measure(*sizes, _CLOCKS[chosen.clock]):
        show(row)
    return 0


if __name__ == "__main__":
    sys.exit(main())
