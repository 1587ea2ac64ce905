"""Compare lidars in MuJoCo worlds with MuJoCo's own ray casting.

    python -m benchmarks.mujoco

A VLP-16 and an OS1-64 scan rooms with 20, 100 and 400 moving bodies. Then the lidars of 256
quadrupeds on a terrain scan with 16 x 360 rays each, in a single call. All bodies move before each
scan. Times are the CPU time of one thread. The table lists the minimum over the rounds, because
other programs may use the cores, and the median ratio of MuJoCo's time to this time.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np

from lidarpool import MujocoScanner, Sensor, load_sensor
from lidarsim.numerics.arrays import Floats

from .harness import argument_parser, median_ratio, print_row, run_rounds, time_call, write_results

MAX_M = 120.0  # range of MuJoCo's rays
_GROUPS = np.array([1, 1, 1, 0, 0, 0], np.uint8)
_ROUND_SHAPES = ("box", "cylinder", "capsule", "sphere")


class World(NamedTuple):
    """MuJoCo model with the sites of its lidars."""

    name: str
    model: Any
    data: Any
    sites: list[str]


def room(bodies: int) -> str:
    """Return the MJCF of a floor, a robot, and bodies with four kinds of shapes."""
    rng = np.random.default_rng(0)
    positions = rng.uniform(-20, 20, (bodies, 2))
    angles = rng.uniform(0, 360, bodies)
    free = "".join(
        f'<body pos="{x:.3f} {y:.3f} 0.5" euler="0 0 {angle:.0f}"><freejoint/>'
        f'<geom type="{_ROUND_SHAPES[k % 4]}" size=".3 .4 .5"/></body>'
        for k, ((x, y), angle) in enumerate(zip(positions, angles, strict=True))
    )
    robot = (
        '<body pos="0 0 1"><freejoint/><geom type="box" size=".1 .1 .1"/>'
        '<site name="lidar" pos="0 0 .5"/></body>'
    )
    floor = '<geom type="plane" size="0 0 .1"/>'
    return f"<mujoco><worldbody>{floor}{robot}{free}</worldbody></mujoco>"


def herd(robots: int, cells: int) -> str:
    """Return the MJCF of quadrupeds on a terrain of 2 * cells² triangles.

    Each quadruped has a lidar.
    """
    side = int(np.ceil(np.sqrt(robots)))
    leg = (
        '<body pos="{x} {y} 0"><joint axis="0 1 0"/>'
        '<geom type="capsule" size=".03" fromto="0 0 0 0 0 -.2"/>'
        '<body pos="0 0 -.2"><joint axis="0 1 0"/>'
        '<geom type="capsule" size=".025" fromto="0 0 0 0 0 -.2"/></body></body>'
    )
    legs = "".join(leg.format(x=x, y=y) for x in (-0.25, 0.25) for y in (-0.15, 0.15))
    bodies = "".join(
        f'<body pos="{2 * (k % side) - side} {2 * (k // side) - side} 1.6"><freejoint/>'
        f'<geom type="box" size=".3 .12 .08"/><site name="lidar{k}" pos="0 0 .2"/>{legs}</body>'
        for k in range(robots)
    )
    field = f'<hfield name="hills" nrow="{cells + 1}" ncol="{cells + 1}" size="40 40 1 1"/>'
    return (
        f'<mujoco><asset>{field}</asset><worldbody><geom type="hfield" hfield="hills"/>{bodies}'
        "</worldbody></mujoco>"
    )


def build(name: str, xml: str, sites: list[str]) -> World:
    """Compile a model and fill its height fields with waves."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(xml)
    for field in range(model.nhfield):
        rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
        row, column = np.mgrid[:rows, :columns] / 20
        heights = 0.5 + 0.25 * (np.sin(row) + np.sin(1.3 * column))
        model.hfield_data[: rows * columns] = heights.ravel()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return World(name, model, data, sites)


def cast_by_mujoco(world: World, directions: Floats) -> None:
    """Cast rays (sites, n, 3), given in world coordinates, with MuJoCo."""
    import mujoco

    model, data = world.model, world.data
    count = directions.shape[1]
    geom = np.zeros(count, np.int32)
    distance = np.zeros(count)
    for name, rays in zip(world.sites, directions, strict=True):
        number = model.site(name).id
        mujoco.mj_multiRay(
            model, data, data.site_xpos[number].copy(), rays.ravel(), _GROUPS, True,
            model.site_bodyid[number], geom, distance, None, count, MAX_M,
        )  # fmt: skip


def measure(world: World, sensor: Sensor, repeat: int) -> dict[str, Any]:
    """Measure MuJoCo's ray casting, `ranges`, `sweep` and `step` in a world."""
    rng = np.random.default_rng(1)
    data = world.data
    is_single = len(world.sites) == 1
    site = world.sites[0] if is_single else world.sites
    scanner = MujocoScanner(world.model, sensor, site=site, columns=["range"], threads=1)

    def move() -> None:
        data.xpos[1:] += rng.uniform(-0.01, 0.01, (world.model.nbody - 1, 3))

    def ranges() -> None:
        move()
        scanner.ranges(data)

    def sweep() -> None:
        move()
        scanner.sweep(data)

    def step() -> None:
        clouds: list[Any] = []
        while not clouds:
            data.time += 0.01
            move()
            clouds = scanner.step(data)

    directions = sensor.directions(np.arange(scanner.ranges(data).shape[-2])).reshape(-1, 3)
    # In the frame of the world, since sites only move: NumPy's threads would slow the rounds.
    numbers = [world.model.site(name).id for name in world.sites]
    turned = [directions @ data.site_xmat[number].reshape(3, 3).T for number in numbers]
    in_world = np.array(turned)
    calls: dict[str, Callable[[], None]] = {
        "mj_multiRay": lambda: cast_by_mujoco(world, in_world),
        "ranges": ranges,
    }
    if is_single:
        calls |= {"sweep": sweep, "step": step}
        step()

    def cpu_s(name: str, _: int) -> float:
        seconds, _result = time_call(calls[name])
        return seconds

    seconds = run_rounds({name: partial(cpu_s, name) for name in calls}, repeat)
    return {
        "world": world.name,
        "rays": len(directions) * len(world.sites),
        "seconds": seconds,
    }


def show(row: dict[str, Any]) -> None:
    """Print a table row."""
    seconds = row["seconds"]
    mujoco_s = seconds["mj_multiRay"]
    cells = [f"{1e3 * min(mujoco_s):.1f}"]
    for name in ("ranges", "sweep", "step"):
        own = seconds.get(name)
        cells.append(f"{1e3 * min(own):.1f} ({median_ratio(mujoco_s, own):.1f})" if own else "–")
    print_row(row["world"], f"{row['rays']:,}", *cells)


def main(arguments: list[str] | None = None) -> int:
    """Print the table, and return 2 if MuJoCo is not installed."""
    parser = argument_parser(__doc__, repeat=21, quick=True)
    options = parser.parse_args(arguments)
    if find_spec("mujoco") is None:
        print(
            "Nothing was measured, because MuJoCo is not installed (pip install mujoco).",
            file=sys.stderr,
        )
        return 2
    repeat = 1 if options.quick else options.repeat
    robots, cells = (4, 16) if options.quick else (256, 257)
    print_row("world", "rays", "mj_multiRay (ms)", "ranges (speedup)", "sweep", "step")
    print("|---|--:|--:|--:|--:|--:|")
    rows = []
    for bodies in (5,) if options.quick else (20, 100, 400):
        for model in ("velodyne/vlp16", "ouster/os1-64"):
            world = build(f"{bodies}, {model}", room(bodies), ["lidar"])
            rows.append(measure(world, load_sensor(model), repeat))
            show(rows[-1])
    sensor = Sensor.grid(360, 16, step_deg=360, max_range_m=30)
    sites = [f"lidar{k}" for k in range(robots)]
    world = build(f"{robots} quadrupeds", herd(robots, cells), sites)
    rows.append(measure(world, sensor, 1))
    show(rows[-1])
    write_results(options.json, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
