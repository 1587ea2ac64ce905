"""Convert the legs of a HELIOS++ survey to a trajectory.

The platform moves from leg to leg, is stationary at each leg, or follows a trajectory file.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.errors import LidarError, prefix_errors
from lidarsim.io.time_units import seconds_of
from lidarsim.motion.rotations import quaternions_of
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.transform import rotation_about

from .files import Assets, read_file, read_flag, read_number, read_vector, round_values

_SPEED = 70.0  # default speed in m/s
_BETWEEN_S = 0.001  # time in which the platform turns on the spot or moves to the next leg
_AFTER_S = 1.0  # duration of the trajectory after the last leg
_FACING_Y_DEG = 90.0  # yaw of platforms that do not turn
TRAJECTORY_FILE = "trajectory.tum"
_X, _Y, _Z = np.eye(3)


@dataclass
class Leg:
    """A leg of a survey, with its start position and settings."""

    number: int
    position: Floats  # (3,) start in meters
    scanner: dict[str, str]  # settings
    platform: dict[str, str]  # settings
    longest_s: float  # maximum duration; infinite without a limit

    @property
    def is_active(self) -> bool:
        """Whether the scanner is active during the leg."""
        return read_flag(self.scanner, "active", True)


@dataclass
class LegSegment:
    """The part of a trajectory that belongs to one leg."""

    leg: int  # number
    active: bool
    start_s: float
    seconds: float


@dataclass
class HeliosTrajectory:
    """The poses of a platform, and the segment for each leg.

    The columns of `rows` are time in seconds, x, y, z, and either the yaw in degrees or a
    quaternion x, y, z, w.
    """

    rows: Floats
    segments: list[LegSegment]

    def section_and_files(self) -> tuple[dict[str, Any] | str, dict[str, str]]:
        """Return a scenario's `trajectory` section, and the content of the files it refers to."""
        if self.rows.shape[1] == 5:
            names = ("time_s", "position", "yaw_deg")
            rows = ((r[0], r[1:4], r[4]) for r in self.rows)
            points = [dict(zip(names, map(round_values, row), strict=True)) for row in rows]
            return {"points": points}, {}
        text = io.StringIO()
        np.savetxt(text, self.rows, "%.9g")
        return TRAJECTORY_FILE, {TRAJECTORY_FILE: text.getvalue()}


def read_legs(
    survey: Element, assets: Assets, home: Any, height: Callable[[float, float], float]
) -> list[Leg]:
    """Read the legs of a survey.

    `height` returns the height of the ground at x and y, in meters.
    """
    legs = []
    for index, element in enumerate(survey.findall("leg")):
        with prefix_errors(f"leg {index}"):
            platform = assets.read_settings(element.find("platformSettings"), home)
            scanner = assets.read_settings(element.find("scannerSettings"), home)
            position = read_vector(platform)
            if read_flag(platform, "onGround", False) and "trajectory" not in platform:
                position[2] = height(position[0], position[1])
            longest = read_number(
                element, "maxDuration_s", read_number(scanner, "maxDuration_s", -1)
            )
        legs.append(Leg(index, position, scanner, platform, longest if longest > 0 else np.inf))
    if not legs:
        raise LidarError("its <survey> has no <leg>.")
    return legs


def moving_trajectory(legs: Sequence[Leg]) -> HeliosTrajectory:
    """Return a trajectory that goes straight from leg to leg, at the speed of each leg.

    The platform turns on the spot between legs.
    """
    rows = []
    segments = []
    clock = 0.0
    position = legs[0].position
    yaw = _FACING_Y_DEG
    for leg, next_leg in pairwise(legs):
        displacement = next_leg.position - position
        length = float(np.linalg.norm(displacement))
        if not length:
            continue
        speed = read_number(leg.platform, "movePerSec_m", _SPEED)
        if speed <= 0:
            raise LidarError(f"leg {leg.number}: movePerSec_m is {speed:g}; it must be above 0.")
        seconds = min(length / speed, leg.longest_s)
        if displacement[:2].any():
            yaw = float(np.degrees(np.arctan2(displacement[1], displacement[0])))
        target = position + displacement * (seconds * speed / length)
        rows += [[clock, *position, yaw], [clock + seconds, *target, yaw]]
        segments.append(LegSegment(leg.number, leg.is_active, clock, seconds))
        clock = clock + seconds + _BETWEEN_S
        position = target
    if not rows:
        raise LidarError("its platform moves, but all legs have the same position.")
    rows.append([clock + _AFTER_S, *position, yaw])
    return HeliosTrajectory(np.array(rows), segments)


def stationary_trajectory(legs: Sequence[Leg], heads: dict[int, float]) -> HeliosTrajectory:
    """Return a trajectory that stops at each leg until the scanner head has finished rotating.

    `heads` maps leg numbers to the time in seconds for which the head rotates, which is 0 if it
    does not rotate.
    """
    rows = []
    segments = []
    clock = 0.0
    for leg in legs:
        if not leg.is_active:
            continue
        seconds = min(heads[leg.number] or np.inf, leg.longest_s)
        if seconds == np.inf:
            raise LidarError(
                f"leg {leg.number}: neither the platform nor the head moves, so the leg has no "
                "end. Set maxDuration_s."
            )
        pose = [*leg.position, _FACING_Y_DEG]
        rows += [[clock, *pose], [clock + seconds, *pose]]
        segments.append(LegSegment(leg.number, True, clock, seconds))
        clock += seconds + _BETWEEN_S
    if not rows:
        raise LidarError("no leg has an active scanner.")
    rows.append([clock + _AFTER_S, *rows[-1][1:]])
    return HeliosTrajectory(np.array(rows), segments)


def read_trajectory(survey: Element, legs: Sequence[Leg], assets: Assets) -> HeliosTrajectory:
    """Read the trajectory file of an interpolated platform, and return a segment for each leg."""
    files = {leg.platform.get("trajectory", "") for leg in legs}
    if len(files) != 1 or "" in files:
        raise LidarError("all legs of an interpolated platform must name the same trajectory.")
    path = assets.find_file(files.pop())
    settings: dict[str, str] = {}
    for leg in reversed(legs):
        settings |= leg.platform
    columns = _columns(read_file(path).decode("utf-8", "replace"), settings)
    try:
        columns["t"] = seconds_of(columns["t"], None, advice="HELIOS++ expects seconds")
    except ValueError as error:
        raise LidarError(f"{path} cannot be used as a trajectory: {error}.") from error
    times, first = np.unique(columns["t"], return_index=True)
    if len(times) < 2:
        raise LidarError(f"{path} is not a trajectory, because all its rows have the same time.")
    columns = {name: column[first] for name, column in columns.items()}
    rotations = np.broadcast_to(np.eye(3), (len(times), 3, 3))
    if settings.get("interpolationDomain") != "position" and "yaw" in columns:
        scale = 1.0 if read_flag(settings, "toRadians", True) else 180 / np.pi
        angles = scale * np.stack([columns[name] for name in ("roll", "pitch", "yaw")], axis=1)
        kind = survey.get("rotationSpec", "ARINC 705")
        rotations = np.array([_platform_rotation(kind, *row) for row in angles.tolist()])
    segments = [_segment_between(leg, times[0], times[-1]) for leg in legs]
    positions = [columns[axis] for axis in "xyz"]
    quaternions = quaternions_of(rotations @ rotation_about(_Z, _FACING_Y_DEG))
    rows = np.column_stack([times - times[0], *positions, quaternions])
    return HeliosTrajectory(np.vstack([rows, rows[-1] + [_AFTER_S, *7 * [0]]]), segments)


def _segment_between(leg: Leg, first_s: float, last_s: float) -> LegSegment:
    """Return the part of a trajectory between two times that belongs to a leg."""
    start = max(read_number(leg.platform, "tStart", first_s), first_s)
    stop = min(read_number(leg.platform, "tEnd", last_s), last_s, start + leg.longest_s)
    if stop <= start:
        raise LidarError(
            f"leg {leg.number}: tStart and tEnd are outside the time range of the trajectory."
        )
    return LegSegment(leg.number, leg.is_active, float(start - first_s), float(stop - start))


def _platform_rotation(kind: str, roll: float, pitch: float, yaw: float) -> Floats:
    """Return a platform's rotation for angles in degrees, as HELIOS++ interprets them."""
    if kind == "CANONICAL":
        return rotation_about(_X, roll) @ rotation_about(_Y, pitch) @ rotation_about(_Z, yaw)
    if kind == "ARINC 705":
        return rotation_about(-_Z, yaw) @ rotation_about(_Y, roll) @ rotation_about(_X, pitch)
    raise LidarError(f"rotationSpec is {kind!r}; it must be 'ARINC 705' or 'CANONICAL'.")


def _columns(text: str, settings: dict[str, str]) -> dict[str, Floats]:
    """Return the columns of a trajectory file by name.

    The names come from column indices in the settings, from the header, or from the default order.
    """
    default_names = ["t", "roll", "pitch", "yaw", "x", "y", "z"]
    lines = [line for line in text.splitlines() if line.strip() and line.strip()[0] != "#"]
    separator = settings.get("trajectory_seperator", ",")
    try:
        rows = np.array([[float(word) for word in line.split(separator)] for line in lines])
    except ValueError as error:
        raise LidarError(f"its trajectory has invalid rows: {error}.") from error
    if rows.ndim != 2 or not np.isfinite(rows).all():
        raise LidarError("its trajectory is not a table of finite numbers.")
    width = rows.shape[1]
    header = re.search(r"^#\s*HEADER:(.*)$", text, re.MULTILINE)
    if any(f"{name}Index" in settings for name in default_names):
        index_names = {
            int(read_number(settings, f"{name}Index", i)): name
            for i, name in enumerate(default_names)
        }
        names = [index_names.get(index, "") for index in range(width)]
    elif header is not None:
        names = [word.strip(" \"'") for word in header[1].split(",")]
    else:
        names = ["t", "x", "y", "z"] if width == 4 else default_names
    description = f"its trajectory has {width} columns, named {', '.join(names)}"
    if len(names) != width or not {"t", "x", "y", "z"} <= {*names}:
        raise LidarError(f"{description}. It must have t, x, y and z.")
    used = [name for name in names if name]  # column indices may skip columns
    unknown = [name for name in used if name not in default_names]
    if unknown or len(set(used)) < len(used):
        fault = "A name occurs twice."
        if unknown:
            fault = f"Unknown names: {', '.join(map(repr, unknown))}."
        raise LidarError(
            f"{description}. {fault} Select the columns by index with settings such as tIndex "
            "and xIndex in platformSettings."
        )
    angles = {"roll", "pitch", "yaw"}.intersection(used)
    if angles and len(angles) < 3:
        raise LidarError(
            f"{description}. It must have all of roll, pitch and yaw, or none of them."
        )
    return {name: column for name, column in zip(names, rows.T, strict=True) if name}
