"""Legs of HELIOS++ as a trajectory: from leg to leg, standing at each, or from a file."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.base.arrays import Floats
from lidarsim.base.errors import LidarError, prefixed
from lidarsim.scene.transform import rotation_about as about
from lidarsim.sensor.trajectory import quaternions_of

from .files import Assets, clean, flag, number, read, vector

_SPEED = 70.0  # metres a second, where nothing is said
_BETWEEN_S = 0.001  # of legs, in which the carrier turns on the spot or goes to its next one
_AFTER_S = 1.0  # that the trajectory lasts longer than the last leg
_FACING_Y_DEG = 90.0  # platforms that do not turn
WAY_FILE = "trajectory.tum"
_X, _Y, _Z = np.eye(3)


@dataclass
class Leg:
    """A leg: its number, where it begins, and its settings."""

    number: int
    place: Floats
    scanner: dict[str, str]
    platform: dict[str, str]
    longest_s: float  # infinite where there is no limit

    @property
    def active(self) -> bool:
        """Whether it scans."""
        return flag(self.scanner, "active", True)


@dataclass
class Stretch:
    """Part of the trajectory of a leg."""

    leg: int
    active: bool
    start_s: float
    seconds: float


@dataclass
class HeliosTrajectory:
    """Poses of a carrier, and the stretches of its legs.

    `rows` hold seconds, x, y, z and yaw in degrees, or quaternions x, y, z, w in its place.
    """

    rows: Floats
    stretches: list[Stretch]

    def written(self) -> tuple[dict[str, Any] | str, dict[str, str]]:
        """Return the section `trajectory`, and the files that it names."""
        if self.rows.shape[1] == 5:
            names = ("time_s", "position", "yaw_deg")
            rows = ((r[0], r[1:4], r[4]) for r in self.rows)
            points = [dict(zip(names, map(clean, row), strict=True)) for row in rows]
            return {"points": points}, {}
        text = io.StringIO()
        np.savetxt(text, self.rows, "%.9g")
        return WAY_FILE, {WAY_FILE: text.getvalue()}


def read_legs(
    survey: Element, assets: Assets, home: Any, height: Callable[[float, float], float]
) -> list[Leg]:
    """Read the legs of a survey; `height` tells where the ground is."""
    legs = []
    for index, element in enumerate(survey.findall("leg")):
        with prefixed(f"leg {index}"):
            platform = assets.settings(element.find("platformSettings"), home)
            scanner = assets.settings(element.find("scannerSettings"), home)
            place = vector(platform)
            if flag(platform, "onGround", False) and "trajectory" not in platform:
                place[2] = height(place[0], place[1])
            longest = number(element, "maxDuration_s", number(scanner, "maxDuration_s", -1))
        legs.append(Leg(index, place, scanner, platform, longest if longest > 0 else np.inf))
    if not legs:
        raise LidarError("its <survey> has no <leg>.")
    return legs


def flown(legs: Sequence[Leg]) -> HeliosTrajectory:
    """Go straight from each leg to the next, each at its speed, and turn on the spot."""
    rows = []
    stretches = []
    clock = 0.0
    here = legs[0].place
    yaw = _FACING_Y_DEG
    for leg, after in pairwise(legs):
        way = after.place - here
        length = float(np.linalg.norm(way))
        if not length:
            continue
        speed = number(leg.platform, "movePerSec_m", _SPEED)
        if speed <= 0:
            raise LidarError(f"leg {leg.number}: movePerSec_m is {speed:g}; it never ends.")
        seconds = min(length / speed, leg.longest_s)
        if way[:2].any():
            yaw = float(np.degrees(np.arctan2(way[1], way[0])))
        there = here + way * (seconds * speed / length)
        rows += [[clock, *here, yaw], [clock + seconds, *there, yaw]]
        stretches.append(Stretch(leg.number, leg.active, clock, seconds))
        clock = clock + seconds + _BETWEEN_S
        here = there
    if not rows:
        raise LidarError("its platform moves, and no two legs are at different places.")
    rows.append([clock + _AFTER_S, *here, yaw])
    return HeliosTrajectory(np.array(rows), stretches)


def stood(legs: Sequence[Leg], heads: dict[int, float]) -> HeliosTrajectory:
    """Stand at each leg until its head has turned: {number of a leg: seconds}."""
    rows = []
    stretches = []
    clock = 0.0
    for leg in legs:
        if not leg.active:
            continue
        seconds = min(heads[leg.number] or np.inf, leg.longest_s)
        if seconds == np.inf:
            raise LidarError(
                f"leg {leg.number}: nothing moves, neither platform nor head, and there is no "
                "maxDuration_s; it never ends."
            )
        pose = [*leg.place, _FACING_Y_DEG]
        rows += [[clock, *pose], [clock + seconds, *pose]]
        stretches.append(Stretch(leg.number, True, clock, seconds))
        clock += seconds + _BETWEEN_S
    if not rows:
        raise LidarError("no leg scans anything.")
    rows.append([clock + _AFTER_S, *rows[-1][1:]])
    return HeliosTrajectory(np.array(rows), stretches)


def read_way(survey: Element, legs: Sequence[Leg], assets: Assets) -> HeliosTrajectory:
    """Read the file of an interpolated platform; each leg is a stretch of it."""
    files = {leg.platform.get("trajectory", "") for leg in legs}
    if len(files) != 1 or "" in files:
        raise LidarError("an interpolated platform needs one trajectory, the same in all legs.")
    path = assets.file(files.pop())
    settings: dict[str, str] = {}
    for leg in reversed(legs):
        settings |= leg.platform
    columns = _columns(read(path).decode("utf-8", "replace"), settings)
    times, first = np.unique(columns["t"], return_index=True)
    if len(times) < 2:
        raise LidarError(f"{path} is no trajectory: all its rows have one time.")
    columns = {name: column[first] for name, column in columns.items()}
    turns = np.broadcast_to(np.eye(3), (len(times), 3, 3))
    if settings.get("interpolationDomain") != "position" and "yaw" in columns:
        scale = 1.0 if flag(settings, "toRadians", True) else 180 / np.pi
        angles = scale * np.stack([columns[name] for name in ("roll", "pitch", "yaw")], axis=1)
        kind = survey.get("rotationSpec", "ARINC 705")
        turns = np.array([_turned(kind, *row) for row in angles.tolist()])
    stretches = []
    for leg in legs:
        begin = max(number(leg.platform, "tStart", times[0]), times[0])
        end = min(number(leg.platform, "tEnd", times[-1]), times[-1], begin + leg.longest_s)
        if end <= begin:
            raise LidarError(f"leg {leg.number}: tStart and tEnd lie outside the trajectory.")
        start_s = float(begin - times[0])
        stretches.append(Stretch(leg.number, leg.active, start_s, float(end - begin)))
    places = [columns[axis] for axis in "xyz"]
    quaternions = quaternions_of(turns @ about(_Z, _FACING_Y_DEG))
    rows = np.column_stack([times - times[0], *places, quaternions])
    return HeliosTrajectory(np.vstack([rows, rows[-1] + [_AFTER_S, *7 * [0]]]), stretches)


def _turned(kind: str, roll: float, pitch: float, yaw: float) -> Floats:
    """Rotation (3, 3) of a platform, degrees, as HELIOS++ takes a file's angles."""
    if kind == "CANONICAL":
        return about(_X, roll) @ about(_Y, pitch) @ about(_Z, yaw)
    if kind == "ARINC 705":
        return about(-_Z, yaw) @ about(_Y, roll) @ about(_X, pitch)
    raise LidarError(f"rotationSpec is {kind!r}; there are ARINC 705 and CANONICAL.")


def _columns(text: str, settings: dict[str, str]) -> dict[str, Floats]:
    """Columns of a trajectory by name: by indices, its header, or as usual."""
    usual = ["t", "roll", "pitch", "yaw", "x", "y", "z"]
    lines = [line for line in text.splitlines() if line.strip() and line.strip()[0] != "#"]
    separator = settings.get("trajectory_seperator", ",")
    try:
        rows = np.array([[float(word) for word in line.split(separator)] for line in lines])
    except ValueError as error:
        raise LidarError(f"its trajectory has rows that are not alike: {error}.") from error
    if rows.ndim != 2 or not np.isfinite(rows).all():
        raise LidarError("its trajectory is not a table of numbers.")
    width = rows.shape[1]
    header = re.search(r"^#\s*HEADER:(.*)$", text, re.MULTILINE)
    if any(f"{name}Index" in settings for name in usual):
        places = {int(number(settings, f"{name}Index", i)): name for i, name in enumerate(usual)}
        names = [places.get(at, "") for at in range(width)]
    elif header is not None:
        names = [word.strip(" \"'") for word in header[1].split(",")]
    else:
        names = ["t", "x", "y", "z"] if width == 4 else usual
    listed = f"its trajectory has {width} columns, named {', '.join(names)}"
    if len(names) != width or not {"t", "x", "y", "z"} <= {*names}:
        raise LidarError(f"{listed}; it needs t, x, y and z.")
    used = [name for name in names if name]  # indices leave out the others
    unknown = [name for name in used if name not in usual]
    if unknown or len(set(used)) < len(used):
        fault = f"{unknown[0]!r} is not known" if unknown else "a name is there twice"
        raise LidarError(
            f"{listed}, and {fault}: name those to read by their indices, such as tIndex and "
            "xIndex, in platformSettings."
        )
    angles = {"roll", "pitch", "yaw"}.intersection(used)
    if angles and len(angles) < 3:
        raise LidarError(f"{listed}; it needs roll, pitch and yaw, or none of them.")
    return {name: column for name, column in zip(names, rows.T, strict=True) if name}
