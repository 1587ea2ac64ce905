"""Targets at the positions of the actors in a scenario, relative to the platform."""

from __future__ import annotations

from fnmatch import fnmatchcase

import numpy as np

from lidarsim.errors import LidarError, prefix_errors
from lidarsim.motion.trajectory import full_poses, presence_ns
from lidarsim.numerics.arrays import Floats
from lidarsim.numerics.vectors import matmul, matvec
from lidarsim.scene.actors import Actor

from ..scenario.mount_sections import TargetSection, TrafficTargets, VehicleFile
from ..scenario.prepare import prepare
from ..scenario.scenario import Scenario
from .placements import Placements, Target

_ALL = "actor"  # name of the only class if no classes are given


def traffic_placements(vehicle: VehicleFile, section: TrafficTargets) -> Placements:
    """Return targets at the sampled positions of a scenario's actors.

    The ground below the platform is z = 0 in the vehicle frame, so only horizontal positions and
    headings are used. The shapes are those of the actors.

    Raises
    ------
    LidarError
        If the scenario has no trajectory, or if no actor comes close enough.
    """
    scenario = Scenario.load(vehicle.files.path(section.scenario))
    if scenario.trajectory is None:
        raise LidarError(
            f"{scenario.source} has no trajectory, which `traffic` requires. Set `trajectory`, or "
            "use `region` instead."
        )
    with prefix_errors(vehicle.source):
        prepared = prepare(scenario, plans=False)
    path = prepared.survey.path
    platform = [actor for actor in prepared.scene.actors if actor.trajectory is path]
    others = [actor for actor in prepared.scene.actors if actor.trajectory is not path]
    step_ns = section.interval_s * 1e9
    times = np.arange(0.0, max(path.duration_ns, 1.0), step_ns)
    origins, rotations = full_poses(path, 0, times)
    classes = dict(section.classes) or {_ALL: ("*",)}
    names = [*classes]
    rows = []
    for index, actor in enumerate(others):
        kind = next(
            (k for k, name in enumerate(names) if _matches(actor.name, classes[name])), None
        )
        if kind is not None:
            rows += _sampled(actor, index, kind, times, (origins, rotations), section)
    if not rows:
        raise LidarError(
            f"No actor of {scenario.source} comes within {section.max_distance_m:g} m of the "
            "platform, or none matches `traffic.classes`. The scenario has "
            f"{len(others)} actors besides {len(platform)} on the platform."
        )
    table = np.array(rows)
    used, mesh = np.unique(table[:, 0].astype(int), return_inverse=True)
    kinds = {int(row[0]): int(row[1]) for row in rows}
    default = TargetSection()
    targets = [Target(name, default.points, default.reflectance, default.weight) for name in names]
    return Placements(
        tuple(targets),
        tuple(others[index].mesh for index in used.tolist()),
        np.array([kinds[index] for index in used.tolist()]),
        mesh,
        np.column_stack([table[:, 2:4], np.zeros(len(table))]),
        table[:, 4],
    )


def _matches(name: str, patterns: tuple[str, ...]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def _sampled(
    actor: Actor,
    index: int,
    kind: int,
    times: Floats,
    platform: tuple[Floats, Floats],
    section: TrafficTargets,
) -> list[tuple[float, ...]]:
    """Return index, class, x, y and heading of an actor at the times at which it is close."""
    first, last = presence_ns(actor.trajectory)
    present = (times >= first) & (times <= last)
    positions, rotations = full_poses(actor.trajectory, 0, times[present])
    origins, axes = (values[present] for values in platform)
    rows: list[tuple[float, ...]] = []
    for position, rotation, origin, frame in zip(positions, rotations, origins, axes, strict=True):
        relative = matvec(frame.T, position - origin)
        if np.hypot(relative[0], relative[1]) <= section.max_distance_m:
            forward = matmul(frame.T, rotation)[:, 0]
            heading = float(np.degrees(np.arctan2(forward[1], forward[0])))
            rows.append((index, kind, *relative[:2].round(6).tolist(), round(heading, 6)))
    return rows
