"""Measure the simulation of lidars in the worlds of a Newton model.

    python -m benchmarks.newton

A VLP-16 in each of 64 worlds scans a quadruped's surroundings, with 12 obstacles and a ground that
all worlds share. All bodies move before each scan. A single `NewtonScanner` is compared with a
separate scanner for each world, with a scanner that sees all worlds, and with Newton's own ray
casting. Times are the CPU time of one thread. The table lists the minimum over the rounds, because
other programs may use the cores.
"""

from __future__ import annotations

import sys
from functools import partial
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
import psutil

from lidarpool import NewtonScanner, load_sensor

from .harness import argument_parser, print_row, run_rounds, time_call, write_results

SPACING_M = 12.0  # between worlds that see each other


def build(worlds: int, spacing_m: float) -> Any:
    """Return a Newton model whose worlds each contain a quadruped and obstacles."""
    import newton

    world = newton.ModelBuilder()
    trunk = world.add_body(xform=_at(0, 0, 0.4), label="trunk")
    world.add_shape_box(trunk, hx=0.3, hy=0.12, hz=0.08)
    world.add_site(trunk, xform=_at(0, 0, 0.2), label="lidar")
    for x, y in ((-0.25, -0.15), (-0.25, 0.15), (0.25, -0.15), (0.25, 0.15)):
        for height in (0.3, 0.1):
            leg = world.add_body(xform=_at(x, y, height))
            world.add_shape_capsule(leg, radius=0.03, half_height=0.1)
    rng = np.random.default_rng(0)
    for number, (x, y) in enumerate(rng.uniform(-5, 5, (12, 2)).tolist()):
        body = world.add_body(xform=_at(x, y, 0.5))
        if number % 3 == 0:
            world.add_shape_box(body, hx=0.3, hy=0.4, hz=0.5)
        elif number % 3 == 1:
            world.add_shape_cylinder(body, radius=0.3, half_height=0.5)
        else:
            world.add_shape_sphere(body, radius=0.3)
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    builder.replicate(world, worlds, spacing=(spacing_m, spacing_m, 0))
    return builder.finalize(device="cpu")


def _at(x: float, y: float, z: float) -> Any:
    import warp

    return warp.transform((x, y, z), warp.quat_identity())


class NewtonRays:
    """Newton's own ray casting from the sites of a model."""

    def __init__(self, model: Any, directions: Any) -> None:
        import warp

        self.model = model
        is_site = [label == "lidar" for label in model.shape_label]
        bodies = model.shape_body.numpy()[is_site]
        origins = model.body_q.numpy()[bodies, :3] + [0, 0, 0.2]
        rays = len(directions)
        count = rays * len(bodies)
        self.given = {
            "ray_origins": warp.array(np.repeat(origins, rays, axis=0), dtype=warp.vec3),
            "ray_directions": warp.array(
                np.tile(directions, (len(bodies), 1)).astype(np.float32), dtype=warp.vec3
            ),
            "ray_worlds": warp.array(
                np.repeat(model.shape_world.numpy()[is_site], rays), dtype=warp.int32
            ),
            "out_dist": warp.zeros(count, dtype=float),
        }

    def cast(self, state: Any) -> None:
        """Cast the rays of all lidars."""
        import newton

        self.model.bvh_refit_shapes(state)
        newton.intersect_ray(self.model, **self.given)


class Created(NamedTuple):
    """One or more scanners, and the cost of creating them."""

    scanners: list[NewtonScanner]
    seconds: float  # CPU time
    mebibytes: float


def create(model: Any, choices: list[dict[str, Any]]) -> Created:
    """Create a scanner for each selection of lidars."""
    sensor = load_sensor("velodyne/vlp16")
    process = psutil.Process()
    before = process.memory_info().rss

    def make() -> list[NewtonScanner]:
        return [
            NewtonScanner(model, sensor, columns=["range"], threads=1, **choice)
            for choice in choices
        ]

    seconds, scanners = time_call(make)
    return Created(scanners, seconds, (process.memory_info().rss - before) / 2**20)


def measure(worlds: int, repeat: int) -> dict[str, Any]:
    """Measure a scan of all worlds."""
    import warp

    warp.config.quiet = True
    models = build(worlds, 0), build(worlds, SPACING_M)
    states = models[0].state(), models[1].state()
    create(models[0], [{"body": 0}]).scanners[0].ranges(states[0])  # compiles the loops
    bodies = [k for k, label in enumerate(models[0].body_label) if label == "trunk"]
    created = {
        "one scanner": create(models[0], [{"site": "lidar"}]),
        "separate scanners": create(models[0], [{"body": body} for body in bodies]),
        "all worlds visible": create(models[1], [{"site": "lidar", "worlds": "all"}]),
    }
    (single,) = created["one scanner"].scanners
    firings = single.ranges(states[0]).shape[1]
    directions = load_sensor("velodyne/vlp16").directions(np.arange(firings)).reshape(-1, 3)
    rays = NewtonRays(models[0], directions)
    rng = np.random.default_rng(1)

    def cpu_s(name: str, _: int) -> float:
        state = states[name == "all worlds visible"]
        poses = state.body_q.numpy()
        poses[:, :2] += rng.uniform(-0.001, 0.001, (len(poses), 2))
        if name == "Newton's rays":
            return time_call(lambda: rays.cast(state))[0]
        if name == "one scanner, sweep":
            return time_call(lambda: single.sweep(state))[0]
        return time_call(lambda: [item.ranges(state) for item in created[name].scanners])[0]

    names = [*created, "one scanner, sweep", "Newton's rays"]
    return {
        "worlds": worlds,
        "rays": worlds * len(directions),
        "seconds": run_rounds({name: partial(cpu_s, name) for name in names}, repeat),
        "building_s": {name: item.seconds for name, item in created.items()},
        "memory_mib": {name: item.mebibytes for name, item in created.items()},
    }


def main(arguments: list[str] | None = None) -> int:
    """Print the table, and return 2 if Newton is not installed."""
    parser = argument_parser(__doc__, repeat=5, quick=True)
    options = parser.parse_args(arguments)
    if find_spec("newton") is None:
        print(
            "Nothing was measured, because Newton is not installed (pip install newton).",
            file=sys.stderr,
        )
        return 2
    result = measure(2 if options.quick else 64, 1 if options.quick else options.repeat)
    print(f"{result['worlds']} worlds, {result['rays']:,} rays\n")
    print_row("", "scan (ms)", "per world (ms)", "creation (ms)", "memory (MiB)")
    print("|---|--:|--:|--:|--:|")
    for name, seconds in result["seconds"].items():
        scan_ms = 1e3 * min(seconds)
        built = result["building_s"].get(name)
        print_row(
            name,
            f"{scan_ms:.0f}",
            f"{scan_ms / result['worlds']:.1f}",
            "–" if built is None else f"{1e3 * built:.0f}",
            "–" if built is None else f"{result['memory_mib'][name]:.0f}",
        )
    write_results(options.json, result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
