"""Moving objects of a recording as actors of a scenario: meshes, trajectories and classes."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lidarscenes.writers.scene_file import write_scene
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_mesh import SceneMesh

from .labels import class_of
from .object_surfels import RecordedObject

FOLDER = "actors"
UNKNOWN = "Moving object"
_DECIMALS = 4
_STANDING_STEP_S = 1e-3  # time between two poses of an actor that never moves


@dataclass(frozen=True, eq=False)
class RecordedActor:
    """Moving object of a recording.

    Attributes
    ----------
    name
        Name of the actor, such as "Car 1".
    class_number
        Number of its class, or None if it is unknown.
    mesh
        Surfels in the axes of the actor. x points forward, and the origin is the center of the
        underside. If the recording has intensities, reflectances are stored as colors.
    times_s
        Times of the poses in seconds since the first timestamp. float64 array of shape (k,).
    positions
        Positions of the origin in the scene frame in meters. float64 array of shape (k, 3).
    yaw_deg
        Angles from the x axis of the scene to the x axis of the actor in degrees. float64 array of
        shape (k,).
    size
        Length, width and height of its box in meters. float64 array of shape (3,).
    sweeps
        Number of sweeps in which the object was observed.
    """

    name: str
    class_number: int | None
    mesh: SceneMesh
    times_s: Floats
    positions: Floats
    yaw_deg: Floats
    size: Floats
    sweeps: int

    @property
    def file_stem(self) -> str:
        """Name of its files without a suffix, such as "car-1"."""
        return re.sub(r"[^a-z0-9]+", "-", self.name.lower()).strip("-")

    def write(self, folder: Path) -> list[str]:
        """Write the mesh and the trajectory to the folder, and return the names of the files."""
        names = [f"{self.file_stem}.glb", f"{self.file_stem}.csv"]
        write_scene(folder / names[0], Scene.from_meshes([self.mesh]))
        rows = np.column_stack([self.times_s, self.positions, self.yaw_deg])
        lines = ["time_s,x,y,z,yaw_deg"]
        lines += [",".join(f"{value:.{_DECIMALS}f}" for value in row) for row in rows.tolist()]
        (folder / names[1]).write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")
        return names

    def section(self) -> dict[str, Any]:
        """Return the entry of the actor in a scenario."""
        section: dict[str, Any] = {
            "name": self.name,
            "file": f"{FOLDER}/{self.file_stem}.glb",
            "trajectory": {"file": f"{FOLDER}/{self.file_stem}.csv", "beyond": "absent"},
        }
        if self.class_number is not None:
            section["class"] = self.class_number
        return section

    def figures(self) -> dict[str, Any]:
        """Return statistics of the actor for the report."""
        steps = np.linalg.norm(np.diff(self.positions, axis=0), axis=1)
        return {
            "name": self.name,
            "class": self.class_number,
            "size_m": self.size.round(3).tolist(),
            "surfels": len(self.mesh.faces) // 2,
            "sweeps": self.sweeps,
            "from_s": float(self.times_s[0]),
            "to_s": float(self.times_s[-1]),
            "length_m": float(steps.sum()),
        }


def actors_of(
    objects: Sequence[RecordedObject],
    meshes: Sequence[SceneMesh],
    names: Mapping[int, str],
    span_s: tuple[float, float],
    sweep_s: float,
) -> list[RecordedActor]:
    """Convert moving objects to actors.

    Parameters
    ----------
    objects, meshes
        The objects, and their meshes with colors.
    names
        Names of the classes of the recording, by number.
    span_s
        First and last time of the recording in seconds. Objects that are stationary at an end of
        their track are present from the first or until the last time.
    sweep_s
        Typical time between sweeps in seconds. An object is present half of it before and after its
        observations.
    """
    kinds = [
        one.track.kind.replace("_", " ") or names.get(class_of(one.label), "") or UNKNOWN
        for one in objects
    ]
    numbers = _class_numbers(kinds, [class_of(one.label) for one in objects], names)
    counts: Counter[str] = Counter()
    actors = []
    for one, kind, number, mesh in zip(objects, kinds, numbers, meshes, strict=True):
        counts[kind] += 1
        name = f"{kind} {counts[kind]}"
        times_s = _pose_times(one, span_s, sweep_s)
        positions, yaw = one.track.poses(times_s)
        actors.append(
            RecordedActor(
                name,
                number,
                replace(mesh, name=name, materials=None),
                times_s,
                positions,
                np.degrees(yaw),
                one.track.size,
                one.sweeps,
            )
        )
    return actors


def class_names(actors: Sequence[RecordedActor]) -> dict[int, str]:
    """Return the names of the classes of actors, by number."""
    return {
        actor.class_number: re.sub(r" \d+$", "", actor.name)
        for actor in actors
        if actor.class_number is not None
    }


def _pose_times(one: RecordedObject, span_s: tuple[float, float], sweep_s: float) -> Floats:
    """Return the times of the poses in the trajectory of an actor."""
    track = one.track
    first_s, last_s = track.times_s[[0, -1]]
    before_s = min(span_s[0], first_s - _STANDING_STEP_S)
    after_s = max(span_s[1], last_s + _STANDING_STEP_S)
    start_s = before_s if track.stands_before else first_s - sweep_s / 2
    stop_s = after_s if track.stands_after else last_s + sweep_s / 2
    return np.array([start_s, *track.times_s, stop_s])


def _class_numbers(
    kinds: Sequence[str], labels: Sequence[int], names: Mapping[int, str]
) -> list[int | None]:
    """Return the class of each object, or None if it is unknown.

    The class of the points precedes the class with the name of the box. Types of boxes without a
    class are numbered after the classes.
    """
    known = {_spelled_alike(name): number for number, name in names.items()}
    following = max([0, *names, *labels]) + 1
    numbers: list[int | None] = []
    for kind, label in zip(kinds, labels, strict=True):
        if label:
            numbers.append(label)
        elif kind == UNKNOWN:
            numbers.append(None)
        else:
            if _spelled_alike(kind) not in known:
                known[_spelled_alike(kind)] = following
                following += 1
            numbers.append(known[_spelled_alike(kind)])
    return numbers


def _spelled_alike(name: str) -> str:
    """Normalize a name so that names are equal if they differ only in case or underscores."""
    return name.casefold().replace("_", " ")
