"""Legs of HELIOS++ as a trajectory: from leg to leg, standing at each, or from a file."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from ...base.errors import LidarpoolError
from ...sensor.trajectory import quaternions_of
from .files import Assets, Float, about, clean, flag, number, read

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
    place: Float
    speed: float
    settings: dict[str, str]
    active: bool
    most_s: float | None
    platform: dict[str, str]


@dataclass
class Stretch:
    """Part of the trajectory of a leg."""

    leg: int
    active: bool
    start_s: float
    seconds: float


@dataclass
class Way:
    """Poses of a carrier, and the stretches of its legs.

    `rows` hold seconds, x, y, z and yaw in degrees, or quaternions x, y, z, w in its place.
    """

    rows: Float
    stretches: list[Stretch]

    def move(self, by: Float) -> None:
        """Move all of it, in the axes of the world."""
        self.rows[:, 1:4] += by

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


@dataclass
class Legs:
    """The legs of a survey."""

    all: list[Leg]
    moves: bool = False
    way: Way | None = None  # where it is from a file

    @property
    def active(self) -> list[Leg]:
        """Those that scan; where a platform moves, the last leg is only where it ends."""
        legs = self.all[:-1] if self.moves and self.way is None else self.all
        return [leg for leg in legs if leg.active]

    @classmethod
    def of(
        cls, survey: Element, assets: Assets, home: Any, height: Callable[[float, float], float]
    ) -> Legs:
        """Read them; `height` tells where the ground is."""
        legs = []
        for index, element in enumerate(survey.findall("leg")):
            try:
                platform = assets.settings(element.find("platformSettings"), home)
                scanner = assets.settings(element.find("scannerSettings"), home)
                place = np.array([number(platform, axis, 0.0) for axis in "xyz"])
                if flag(platform, "onGround", False) and "trajectory" not in platform:
                    place[2] = height(place[0], place[1])
                most = number(element, "maxDuration_s", number(scanner, "maxDuration_s", -1))
                speed = number(platform, "movePerSec_m", _SPEED)
            except LidarpoolError as error:
                raise LidarpoolError(f"leg {index}: {error}") from error
            active = flag(scanner, "active", True)
            most_s = most if most > 0 else None
            legs.append(Leg(index, place, speed, scanner, active, most_s, platform))
        if not legs:
            raise LidarpoolError("its <survey> has no <leg>.")
        return cls(legs)


def flown(legs: Legs) -> Way:
    """Go straight from each leg to the next, each at its speed, and turn on the spot."""
    rows, stretches, clock, here, yaw = [], [], 0.0, legs.all[0].place, _FACING_Y_DEG
    for leg, after in zip(legs.all, legs.all[1:], strict=False):
        way = after.place - here
        length = float(np.linalg.norm(way))
        if not length:
            continue
        if leg.speed <= 0:
            raise LidarpoolError(f"leg {leg.number}: movePerSec_m is {leg.speed:g}; it never ends.")
        seconds = min(length / leg.speed, leg.most_s or np.inf)
        if way[:2].any():
            yaw = float(np.degrees(np.arctan2(way[1], way[0])))
        there = here + way * (seconds * leg.speed / length)
        rows += [[clock, *here, yaw], [clock + seconds, *there, yaw]]
        stretches.append(Stretch(leg.number, leg.active, clock, seconds))
        clock, here = clock + seconds + _BETWEEN_S, there
    if not rows:
        raise LidarpoolError("its platform moves, and no two legs are at different places.")
    rows.append([clock + _AFTER_S, *here, yaw])
    return Way(np.array(rows), stretches)


def stood(legs: Legs, heads: dict[int, float]) -> Way:
    """Stand at each leg until its head has turned: {number of a leg: seconds}."""
    rows, stretches, clock = [], [], 0.0
    for leg in legs.all:
        turning = heads.get(leg.number) or np.inf
        seconds = min(turning, leg.most_s or np.inf)
        if leg.active and seconds == np.inf:
            raise LidarpoolError(
                f"leg {leg.number}: nothing moves, neither platform nor head, and there is no "
                "maxDuration_s; it never ends."
            )
        if not leg.active:
            continue
        pose = [*leg.place, _FACING_Y_DEG]
        rows += [[clock, *pose], [clock + seconds, *pose]]
        stretches.append(Stretch(leg.number, leg.active, clock, seconds))
        clock += seconds + _BETWEEN_S
    if not rows:
        raise LidarpoolError("no leg scans anything.")
    rows.append([clock + _AFTER_S, *rows[-1][1:]])
    return Way(np.array(rows), stretches)


def read_way(survey: Element, legs: Legs, assets: Assets) -> Way:
    """Read the file of an interpolated platform; each leg is a stretch of it."""
    files = {leg.platform.get("trajectory", "") for leg in legs.all}
    if len(files) != 1 or "" in files:
        raise LidarpoolError("an interpolated platform needs one trajectory, the same in all legs.")
    path = assets.file(files.pop())
    settings: dict[str, str] = {}
    for leg in reversed(legs.all):
        settings |= leg.platform
    table, names = _table(read(path).decode("utf-8", "replace"), settings)
    if "t" not in names or len(table) < 2:
        raise LidarpoolError(f"{path} is no trajectory: it has no column t, or one row.")
    table = table[np.unique(table[:, names.index("t")], return_index=True)[1]]
    times = table[:, names.index("t")]
    places = np.stack([table[:, names.index(axis)] for axis in "xyz"], axis=1)
    turns = np.broadcast_to(np.eye(3), (len(table), 3, 3))
    if settings.get("interpolationDomain") != "position" and "yaw" in names:
        scale = 1.0 if flag(settings, "toRadians", True) else 180 / np.pi
        angles = scale * np.stack([table[:, names.index(n)] for n in ("roll", "pitch", "yaw")], 1)
        kind = survey.get("rotationSpec", "ARINC 705")
        turns = np.array([_turned(kind, *row) for row in angles.tolist()])
    start = times[0]
    stretches = []
    for leg in legs.all:
        begin = max(number(leg.platform, "tStart", start), start)
        end = min(
            number(leg.platform, "tEnd", times[-1]), times[-1], begin + (leg.most_s or np.inf)
        )
        if end <= begin:
            raise LidarpoolError(f"leg {leg.number}: tStart and tEnd lie outside the trajectory.")
        stretches.append(Stretch(leg.number, leg.active, float(begin - start), float(end - begin)))
    quaternions = quaternions_of(turns @ about(_Z, _FACING_Y_DEG))
    rows = np.column_stack([times - start, places, quaternions])
    after = rows[-1] + np.array([_AFTER_S, *7 * [0]])
    return Way(np.vstack([rows, after]), stretches)


def _turned(kind: str, roll: float, pitch: float, yaw: float) -> Float:
    """Rotation (3, 3) of a platform, degrees, as HELIOS++ takes a file's angles."""
    if kind == "CANONICAL":
        return about(_X, roll) @ about(_Y, pitch) @ about(_Z, yaw)
    if kind == "ARINC 705":
        return about(-_Z, yaw) @ about(_Y, roll) @ about(_X, pitch)
    raise LidarpoolError(f"rotationSpec is {kind!r}; there are ARINC 705 and CANONICAL.")


def _table(text: str, settings: dict[str, str]) -> tuple[Float, list[str]]:
    """Numbers of a trajectory, and what its columns are: by indices, its header, or as usual."""
    usual = ["t", "roll", "pitch", "yaw", "x", "y", "z"]
    lines = [line for line in text.splitlines() if line.strip() and line.strip()[0] != "#"]
    separator = settings.get("trajectory_seperator", ",")
    try:
        rows = np.array([[float(word) for word in line.split(separator)] for line in lines])
    except ValueError as error:
        raise LidarpoolError(f"its trajectory has rows that are not alike: {error}.") from error
    if rows.ndim != 2 or not np.isfinite(rows).all():
        raise LidarpoolError("its trajectory is not a table of numbers.")
    names = [""] * rows.shape[1]
    header = re.search(r"^#\s*HEADER:(.*)$", text, re.MULTILINE)
    if any(f"{name}Index" in settings for name in usual):
        for index, name in enumerate(usual):
            at = int(number(settings, f"{name}Index", index))
            if 0 <= at < len(names):
                names[at] = name
    elif header is not None:
        names = [word.strip(" \"'") for word in header[1].split(",")]
    elif len(names) == 4:
        names = ["t", "x", "y", "z"]
    else:
        names = usual
    if len(names) != rows.shape[1] or not {"t", "x", "y", "z"} <= {*names}:
        raise LidarpoolError(
            f"its trajectory has {rows.shape[1]} columns, named {', '.join(names)}; it needs t, x, "
            "y and z."
        )
    return rows, names
