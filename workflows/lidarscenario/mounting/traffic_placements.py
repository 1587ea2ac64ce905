"""Targets at the positions of the actors in a scenario, relative to the platform."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import NamedTuple

import numpy as np

from lidarsim.errors import LidarError, prefix_errors
from lidarsim.motion.trajectory import full_poses, presence_ns
from lidarsim.numerics.arrays import Floats
from lidarsim.numerics.vectors import matmul, matvec
from lidarsim.scene.actors import Actor

from ..mount_sections import TargetSection, TrafficTargets, VehicleFile
from ..prepare import PreparedScenario, prepare
from ..scenario import Scenario
from .placements import Placements, Target

_ALL = "actor"  # name of the only class if no classes are given


class _PlatformPath(NamedTuple):
    """Sampled poses of the platform."""

    times_ns: Floats  # (n,)
    positions: Floats  # (n, 3)
    rotations: Floats  # (n, 3, 3)


def traffic_placements(vehicle: VehicleFile, section: TrafficTargets) -> Placements:
    """Return targets at the sampled positions of a scenario's actors.

    The ground below the vehicle is z = 0, so only horizontal positions and headings are used. The
    shapes are those of the actors.

    Raises
    ------
    LidarError
        If the scenario has no trajectory, or if no actor comes close enough.
    """
    field = f"{vehicle.source}: traffic.scenario"
    with prefix_errors(field):
        scenario = Scenario.load(vehicle.files.path(section.scenario))
    if scenario.trajectory is None:
        raise LidarError(
            f"{field}: {scenario.source} has no trajectory, which `traffic` requires. Set "
            "`trajectory`, or use `region` instead."
        )
    with prefix_errors(field):
        prepared = prepare(scenario, plans=False)
    platform = _platform_path(prepared, section)
    classes = dict(section.classes) or {_ALL: ("*",)}
    actors: list[Actor] = []
    kinds: list[int] = []
    samples: list[Floats] = []
    for actor in prepared.scene.actors:
        kind = _class_of(actor.name, [*classes.values()])
        if kind is None or actor.trajectory is prepared.survey.path:
            continue
        rows = _samples_nearby(actor, platform, section.max_distance_m)
        if len(rows):
            actors.append(actor)
            kinds.append(kind)
            samples.append(rows)
    if not actors:
        raise LidarError(
            f"No actor of {scenario.source} that matches `traffic.classes` comes within "
            f"{section.max_distance_m:g} m of the platform. Increase `max_distance_m`, or check "
            "the names of the actors."
        )
    default = TargetSection()
    table = np.concatenate(samples)
    return Placements(
        tuple(
            Target(name, default.points, default.reflectance, default.weight) for name in classes
        ),
        tuple(actor.mesh for actor in actors),
        np.array(kinds),
        np.repeat(np.arange(len(actors)), [len(rows) for rows in samples]),
        np.column_stack([table[:, :2], np.zeros(len(table))]),
        table[:, 2],
    )


def _platform_path(prepared: PreparedScenario, section: TrafficTargets) -> _PlatformPath:
    path = prepared.survey.path
    times = np.arange(0.0, max(path.duration_ns, 1.0), section.interval_s * 1e9)
    return _PlatformPath(times, *full_poses(path, 0, times))


def _class_of(name: str, patterns: Sequence[Sequence[str]]) -> int | None:
    """Return the index of the first class whose patterns match a name, or None."""
    for index, several in enumerate(patterns):
        if any(fnmatchcase(name, pattern) for pattern in several):
            return index
    return None


def _samples_nearby(actor: Actor, platform: _PlatformPath, max_distance_m: float) -> Floats:
    """Return x, y and heading of an actor in the platform frame while it is close.

    The result has shape (k, 3), in meters and degrees.
    """
    first, last = presence_ns(actor.trajectory)
    present = np.flatnonzero((platform.times_ns >= first) & (platform.times_ns <= last))
    if not len(present):
        return np.zeros((0, 3))
    positions, rotations = full_poses(actor.trajectory, 0, platform.times_ns[present])
    to_platform = platform.rotations[present].swapaxes(1, 2)
    relative = matvec(to_platform, positions - platform.positions[present])
    forward = matmul(to_platform, rotations)[..., 0]
    headings = np.degrees(np.arctan2(forward[:, 1], forward[:, 0]))
    near = np.hypot(relative[:, 0], relative[:, 1]) <= max_distance_m
    return np.column_stack([relative[:, :2], headings])[near].round(6)
