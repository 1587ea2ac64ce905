"""Traffic of SUMO: its floating car data (FCD) as actors that appear and leave."""

from __future__ import annotations

import gzip
import math
import zlib
from array import array
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Literal
from xml.parsers import expat

import numpy as np

from ..base.declared import Several, Text, TextOrTexts, Triple, told
from ..base.errors import LidarpoolError
from ..base.xmlfile import refuse_entity
from ..scene.actors import Actor
from ..scene.mesh import Mesh
from ..sensor import Track
from ..sensor.calibrations import said
from ..sensor.trajectory import quaternions_of, rotations_of
from ..sensor.trajectory_files import Seconds
from .sections import Section, ShapeSection
from .standing import Standing, following

ACTORS_MOST = 10_000
_PIECE = 1 << 20  # bytes of a file that are read at a time
_MOVING = ("vehicle", "person", "container")
_ROW = ("x", "y", "angle", "z", "slope")


class VehicleSection(ShapeSection):
    """What vehicles and persons of some types look like."""

    types: Annotated[
        TextOrTexts,
        told("types of SUMO, with * and ?; of several entries the first that fits", min_length=1),
    ] = ("*",)
    name: Annotated[
        Text | None, told("of its objects, before the identity in brackets; by default the type")
    ] = None


class TrafficSection(Section):
    """Vehicles and persons that SUMO has moved; each is an actor while it is in the simulation."""

    file: Annotated[Text, told("what sumo --fcd-output writes, .xml or .xml.gz")]
    vehicles: Annotated[
        Several[VehicleSection],
        told("shapes of vehicles and persons, by type", min_length=1),
    ]
    offset_s: Annotated[Seconds, told("added to all times")] = 0.0
    translation: Annotated[Triple, told("added to all positions, metres")] = (0, 0, 0)
    surfaces: Annotated[
        TextOrTexts | None,
        told(
            "names of objects to stand on, with * and ?; by default heights are the file's",
            min_length=1,
        ),
    ] = None
    interpolation: Annotated[Literal["linear", "smooth"], told("of poses between time steps")] = (
        "linear"
    )

    def shape_of(self, kind: str) -> VehicleSection:
        """Return the entry of a type; LidarpoolError if there is none."""
        for entry in self.vehicles:
            if any(fnmatchcase(kind, one) for one in entry.types):
                return entry
        raise LidarpoolError(
            f"{self.file} has vehicles of type {kind!r}, but no entry of traffic.vehicles fits: "
            f"add one, such as {{types: {kind!r}, box: [4.5, 1.8, 1.5]}}."
        )


@dataclass(frozen=True, eq=False)
class Passage:
    """A vehicle or person that is there without a break."""

    name: str
    kind: str
    times_s: array[float] = field(default_factory=lambda: array("d"))
    rows: array[float] = field(default_factory=lambda: array("d"))  # `_ROW` at each time


def read_fcd(path: Path, first_s: float, last_s: float) -> tuple[list[Passage], int]:
    """Read what is there between two times, with the time steps before and after.

    The file may be of any length: only these rows are kept.

    Returns
    -------
    Passages in the order in which they begin, and how many vehicles and persons came by.

    Raises
    ------
    LidarpoolError
        If it cannot be read, or is no floating car data.
    """
    reader = _Reader(first_s, last_s)
    try:
        with (gzip.open if path.suffix.lower() == ".gz" else open)(path, "rb") as file:
            while not reader.done and (piece := file.read(_PIECE)):
                reader.parser.Parse(piece)
        if not reader.done:
            reader.parser.Parse(b"", True)
        if reader.step < 0:
            raise ValueError("it has no time steps")
    except (OSError, EOFError, zlib.error, ValueError, KeyError, expat.ExpatError) as error:
        raise LidarpoolError(
            f"{path} is not usable as floating car data, which sumo --fcd-output writes: "
            f"{said(error)}"
        ) from error
    there = [one for one in reader.passages if len(one.times_s) > 1 and one.times_s[-1] >= first_s]
    return there, len(reader.open)


class _Reader:
    """Handles the elements of a file."""

    def __init__(self, first_s: float, last_s: float) -> None:
        self.passages: list[Passage] = []
        self.open: dict[tuple[str, str], tuple[int, Passage]] = {}  # {who: last step, passage}
        self.step, self.done = -1, False
        self._first, self._last, self._time = first_s, last_s, -math.inf
        self._vehicle: tuple[str, str] | None = None  # place of the last one of the time step
        self.parser = expat.ParserCreate()
        self.parser.EntityDeclHandler = refuse_entity
        self.parser.StartElementHandler = self._begin

    def _begin(self, tag: str, at: Mapping[str, str]) -> None:
        if tag == "timestep":
            time = float(at["time"])
            if not self._time < time < math.inf:
                raise ValueError(f"the time {time} does not come after the one before")
            # The first time step after the last time is needed as well.
            self.done = self.done or self._time > self._last
            self.step, self._time, self._vehicle = self.step + 1, time, None
        elif tag in _MOVING and self.step >= 0 and not self.done:
            place = at["x"], at["y"]
            if tag == "vehicle":
                self._vehicle = place
            elif place == self._vehicle:  # SUMO writes who rides in a vehicle after it
                return
            self._add(tag, at)

    def _add(self, tag: str, at: Mapping[str, str]) -> None:
        who = tag, at["id"]
        step, passage = self.open.get(who, (-2, None))
        if passage is None or step < self.step - 1:  # SUMO takes vehicles out while it moves them
            passage = Passage(at["id"], at.get("type") or tag)
            self.passages.append(passage)
        self.open[who] = self.step, passage
        if self._time <= self._first:  # of those before the first time the last is needed
            del passage.times_s[:], passage.rows[:]
        row = [float(at[key]) for key in _ROW[:3]] + [float(at.get(key) or 0) for key in _ROW[3:]]
        if not all(map(math.isfinite, row)):
            raise ValueError(f"{tag} {at['id']!r} has no finite position at {self._time:g} s")
        passage.times_s.append(self._time)
        passage.rows.extend(row)


def actors_of(
    section: TrafficSection,
    passages: list[Passage],
    shape_of: Callable[[VehicleSection], Mesh],
    standing: Standing,
    start_s: float,
) -> list[tuple[Actor, VehicleSection]]:
    """Make actors of passages, in a scene's local coordinates, each with its entry.

    Parameters
    ----------
    shape_of
        Returns the mesh of an entry of `section.vehicles`.
    standing
        What they stand on, if `section.surfaces` are given; where there is nothing, they are not
        in the scene.
    start_s
        Start of the survey.

    Raises
    ------
    LidarpoolError
        If a type has no shape, or there are too many.
    """
    actors: list[tuple[Actor, VehicleSection]] = []
    follows = section.surfaces and standing.only(section.surfaces)
    for one in passages:
        entry = section.shape_of(one.kind)
        mesh = shape_of(entry)
        times = np.array(one.times_s) + section.offset_s
        x, y, angle, z, slope = np.array(one.rows).reshape(-1, len(_ROW)).T
        fronts = np.column_stack([x, y, z]) + section.translation
        if follows:
            fronts[:, 2], slope = section.translation[2], 0 * slope
        # Angles are clockwise from north, and slopes positive uphill.
        turns = rotations_of(np.column_stack([90.0 - angle, -slope, np.zeros(len(x))]))
        # SUMO places the middle of the front bumper.
        places = fronts - turns[:, :, 0] * mesh.vertices[:, 0].max() - standing.origin
        smooth = section.interpolation == "smooth"
        way = Track(times, places, quaternions_of(turns), smooth, start_s, beyond="absent")
        ways = following(way, follows) if follows else [way]
        named = replace(mesh, name=f"{entry.name or one.kind} ({one.name})")
        actors += [(Actor(named, way), entry) for way in ways]
        if len(actors) > ACTORS_MOST:
            raise LidarpoolError(
                f"{section.file} has more than {ACTORS_MOST:,} vehicles and persons during the "
                "survey: make the survey shorter, or simulate a part of the network."
            )
    return actors
