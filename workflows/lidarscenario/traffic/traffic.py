"""Traffic from simulations, in which vehicles and persons become actors.

This module reads floating car data (FCD) of SUMO. `osi_traffic` reads traces of ASAM OSI.
"""

from __future__ import annotations

import gzip
import math
import re
import zlib
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import partial
from io import BufferedIOBase
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, Protocol
from xml.parsers import expat

import numpy as np

from lidarsim.errors import LidarError, message_of, prefix_errors
from lidarsim.io.allowance import Allowance
from lidarsim.io.input_files import input_size, open_input
from lidarsim.io.time_units import SECONDS, TimeUnit, are_plausible, seconds_of
from lidarsim.io.xmlfile import PIECE_BYTES, parse_pieces, refuse_entity
from lidarsim.motion.rotations import quaternions_of, rotations_of
from lidarsim.motion.trajectory import Track
from lidarsim.motion.trajectory_files import Seconds
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.actors import Actor
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.schema.declared import Several, Text, TextOrTexts, Triple, about
from lidarsim.words import format_yaml_list, matches_pattern, name_hint, plural, printable

from ..sections import DeformingSection, Section
from .actor_motion import TimeUnitEntry, TrajectorySection
from .ground import SupportSurfaces, follow_surfaces

HOST = "host"  # alias for the ID of the host vehicle in an OSI trace

MAX_ACTORS = 10_000

_MOVING = ("vehicle", "person", "container")

_ROW = ("x", "y", "angle", "z", "slope")

# Attributes that are defined in the documentation of SUMO's --fcd-output, but not used here.
_UNUSED = frozenset((
    "acceleration", "accelerationLat", "arrivalDelay", "blockTime", "boardingTime", "delay",
    "distance", "edge", "entryTime", "eventTime", "lane", "leaderGap", "leaderID", "leaderSpeed",
    "odometer", "pos", "posLat", "queue", "segment", "signals", "speed", "speedFactor", "speedLat",
    "stopDelay", "tag", "timeLoss", "vehicle", "waiting",
))  # fmt: skip

_ROW_BYTES = 8 * (1 + len(_ROW))  # memory of a time and its row

# Bytes that are counted for each element of a compressed file, because parsing a short element
# takes as long as reading this many bytes.
_ELEMENT_BYTES = 100

_TRAVELER_BYTES = 1000  # memory of a vehicle or person without its rows

_KNOWN = _UNUSED.union(_ROW, ("id", "type"))


class VehicleSection(DeformingSection):
    """Shape of the vehicles and persons of certain types in SUMO or OSI."""

    types: Annotated[
        TextOrTexts,
        about(
            "SUMO types, or OSI types such as heavy_truck; may contain * and ?; the first matching "
            "entry applies",
            min_length=1,
        ),
    ] = ("*",)
    name: Annotated[
        Text | None,
        about("name of the objects, followed by the ID in parentheses (default: the type)"),
    ] = None


class TrafficSection(Section):
    """Vehicles and persons from a traffic simulation.

    Each vehicle or person is an actor while it is in the simulation.
    """

    file: Annotated[
        Text,
        about(
            "output of `sumo --fcd-output` (.xml, .xml.gz), or OSI trace with ground truth (.osi, "
            ".osi.gz, .mcap)"
        ),
    ]
    vehicles: Annotated[
        Several[VehicleSection],
        about(
            "shapes of vehicles and persons, by type (default: boxes with the dimensions in an OSI "
            "trace)"
        ),
    ] = ()
    host: Annotated[bool, about("whether the host vehicle is also an actor (OSI traces only)")] = (
        True
    )
    ignore: Annotated[
        TextOrTexts,
        about("names of attributes in the file to ignore; may contain * and ?", "battery*"),
    ] = ()
    time_unit: TimeUnitEntry = None
    offset_s: Annotated[Seconds, about("offset in seconds that is added to all times")] = 0.0
    translation: Annotated[
        Triple, about("translation in meters that is added to all positions")
    ] = (0, 0, 0)
    surfaces: Annotated[
        TextOrTexts | None,
        about(
            "names of objects on which the vehicles and persons are placed; may contain * and ? "
            "(default: heights from the file)",
            min_length=1,
        ),
    ] = None
    interpolation: Annotated[
        Literal["linear", "smooth"], about("interpolation of poses between time steps")
    ] = "linear"

    def find_entry(self, vehicle_type: str) -> VehicleSection | None:
        """Return the first entry that matches a vehicle type, or None if there is none."""
        for entry in self.vehicles:
            if any(matches_pattern(vehicle_type, pattern) for pattern in entry.types):
                return entry
        return None


class TrafficPassage(Protocol):
    """Uninterrupted period during which a vehicle or person is in a simulation."""

    @property
    def name(self) -> str:
        """Identifier of the vehicle or person in the simulation."""

    @property
    def kind(self) -> str:
        """Type of the vehicle or person in the simulation."""

    def entry(self, section: TrafficSection) -> VehicleSection | None:
        """Return the entry that defines the shape of the vehicle or person.

        Return None for a platform without dimensions in an OSI trace. Raise LidarError if no entry
        matches a vehicle in SUMO.
        """

    def track(
        self, section: TrafficSection, mesh: SceneMesh | None, origin: Floats, start_s: float
    ) -> Track:
        """Return the trajectory of a mesh's origin in local coordinates.

        If `section.surfaces` is set, the heights are relative to these surfaces.
        """


class TravelerFilter(NamedTuple):
    """Selection of vehicles and persons that are read from a simulation.

    Attributes
    ----------
    only
        ID of the only vehicle or person to read, or None to read all.
    without
        ID of a vehicle or person to skip, or None.
    """

    only: str | None = None
    without: str | None = None

    def matches(self, *identities: str) -> bool:
        """Return whether the vehicle or person with the given identifiers is read."""
        if self.only is not None:
            return self.only in identities
        return self.without not in identities


class TrafficContent(NamedTuple):
    """Vehicles, persons and objects in a traffic file between two times."""

    passages: Sequence[TrafficPassage]  # ordered by start
    counted: str  # number of vehicles and persons until the last time, as text
    left_out: Set[str] = frozenset()  # IDs of the vehicles and persons that the filter excluded
    notes: Sequence[str] = ()  # notes on skipped objects


@dataclass(frozen=True, eq=False)
class SumoPassage:
    """A vehicle or person during a series of consecutive SUMO time steps that contain it."""

    name: str
    kind: str
    times_s: array[float] = field(default_factory=lambda: array("d"))
    rows: array[float] = field(default_factory=lambda: array("d"))  # values of `_ROW` at each time

    def entry(self, section: TrafficSection) -> VehicleSection:
        """Return the first entry that matches the type.

        Raise LidarError if no entry matches.
        """
        matching = section.find_entry(self.kind)
        if matching is not None:
            return matching
        raise LidarError(
            f"{section.file} has vehicles of type {self.kind!r}, but no entry of "
            "`traffic.vehicles` matches this type. Add one, such as "
            f"`{{types: {self.kind!r}, box: [4.5, 1.8, 1.5]}}`."
        )

    def track(
        self, section: TrafficSection, mesh: SceneMesh | None, origin: Floats, start_s: float
    ) -> Track:
        """Return the trajectory of a mesh's origin in local coordinates.

        If `section.surfaces` is set, the heights are relative to these surfaces.
        """
        assert mesh is not None, "every vehicle in SUMO has an entry with a shape"
        times = np.array(self.times_s) + section.offset_s
        x, y, angle, z, slope = np.array(self.rows).reshape(-1, len(_ROW)).T
        fronts = np.column_stack([x, y, z]) + section.translation
        if section.surfaces:
            fronts[:, 2] = section.translation[2]
            slope = 0 * slope
        # Angles are clockwise from north. Slopes are positive uphill.
        rotations = rotations_of(np.column_stack([90.0 - angle, -slope, np.zeros(len(x))]))
        # Positions in SUMO refer to the center of the front bumper.
        positions = fronts - rotations[:, :, 0] * mesh.vertices[:, 0].max() - origin
        smooth = section.interpolation == "smooth"
        return Track(times, positions, quaternions_of(rotations), smooth, start_s, beyond="absent")


class TrafficClock:
    """Clock that converts consecutive times of a traffic file to seconds."""

    def __init__(self, time_unit: TimeUnit | None) -> None:
        self._time_unit = time_unit
        self._times: list[float] = []  # the first and the most recent time

    def seconds(self, time: float) -> float:
        """Convert the next time to seconds.

        Raise ValueError if the times are implausible in seconds (see `seconds_of`).
        """
        if self._time_unit is not None:
            return time / SECONDS[self._time_unit]
        if self._times and not are_plausible(self._times[0], time):
            seconds_of(np.array([*self._times, time]), None)
        self._times[1 if self._times else 0 :] = [time]
        return time


# Matches times with optional days, hours, minutes and seconds, which SUMO writes if it is run with
# --human-readable-time.
_READABLE_TIME = re.compile(r"(-?)(?:(\d+):)?(\d+):(\d\d):(\d\d(?:\.\d*)?)")


def _readable_seconds(text: str) -> float | None:
    """Convert a time such as 1:02:30:00.50 to seconds, where the number of days is optional.

    Return None if the text has a different format.
    """
    match = _READABLE_TIME.fullmatch(text.strip())
    if match is None:
        return None
    sign, days, hours, minutes, seconds = match.groups()
    whole_s = ((int(days or 0) * 24 + int(hours)) * 60 + int(minutes)) * 60
    return (whole_s + float(seconds)) * (-1.0 if sign else 1.0)


class _PassageCollector:
    """Collector that combines elements of floating car data into passages.

    Of the rows before the first time, only the last is kept.
    """

    def __init__(
        self,
        section: TrafficSection,
        first_s: float,
        travelers: TravelerFilter,
        allowance: Allowance,
    ) -> None:
        self.passages: list[SumoPassage] = []
        self.left_out: set[str] = set()  # IDs that the filter excludes
        # {(tag, ID): (last time step, passage)}
        self.travelers: dict[tuple[str, str], tuple[int, SumoPassage]] = {}
        self.step = -1
        self.time_s = -math.inf
        self._first_s = first_s
        self._time_unit = section.time_unit
        self._clock = TrafficClock(section.time_unit)
        self._ignore = section.ignore
        self._filter = travelers
        self._allowance = allowance
        self._known_attributes = set(_KNOWN)
        self._vehicle_xy: tuple[str, str] | None = None  # of the last vehicle in the time step

    def collect(self, elements: Iterable[tuple[str, Mapping[str, str]]], last_s: float) -> None:
        """Collect the passages up to a time, including the first time step after it.

        `elements` yields the tag and the attributes of each element. Raise ValueError if they are
        invalid.
        """
        for tag, attributes in elements:
            if tag == "timestep":
                previous_s = self.time_s
                self.begin_step(attributes["time"])
                if previous_s > last_s:
                    break
            elif tag in _MOVING and self.step >= 0:
                self.add_row(tag, attributes)
        if self.step < 0:
            raise ValueError("it has no time steps")

    def begin_step(self, text: str) -> None:
        """Begin a time step.

        Raise ValueError if its time is not after the time of the previous time step.
        """
        time_s = _readable_seconds(text)
        if time_s is not None and self._time_unit is not None:
            raise ValueError(
                "its times are hours, minutes and seconds, so `time_unit` cannot be set"
            )
        if time_s is None:
            time_s = self._clock.seconds(_parse_number("a timestep", "time", text))
        if not self.time_s < time_s < math.inf:
            raise ValueError(f"the time {time_s} is not after the previous time")
        self.time_s = time_s
        self.step += 1
        self._vehicle_xy = None

    def add_row(self, tag: str, attributes: Mapping[str, str]) -> None:
        """Add the data of a vehicle or person in the current time step.

        Raise ValueError or KeyError if the row is invalid.
        """
        if not attributes.keys() <= self._known_attributes:
            unknown = attributes.keys() - self._known_attributes
            _check_ignored(tag, unknown, self._ignore)
            self._known_attributes |= unknown
        xy = attributes["x"], attributes["y"]
        if tag == "vehicle":
            self._vehicle_xy = xy
        elif xy == self._vehicle_xy:  # SUMO writes the passengers of a vehicle after the vehicle
            return
        if not self._filter.matches(attributes["id"]):
            if attributes["id"] not in self.left_out:
                self._allowance.reserve(_TRAVELER_BYTES)
            self.left_out.add(attributes["id"])
            return
        passage = self._passage(tag, attributes)
        if self.time_s <= self._first_s:  # the previous rows are not needed
            del passage.times_s[:], passage.rows[:]
        else:
            self._allowance.reserve(_ROW_BYTES)
        identity = attributes["id"]
        named = f"{tag} {identity!r}"
        row = [_parse_number(named, key, attributes[key]) for key in _ROW[:3]]
        row += [_parse_number(named, key, attributes.get(key) or "0") for key in _ROW[3:]]
        if not all(map(math.isfinite, row)):
            raise ValueError(f"{named} has no finite position at {self.time_s:g} s")
        passage.times_s.append(self.time_s)
        passage.rows.extend(row)

    def _passage(self, tag: str, attributes: Mapping[str, str]) -> SumoPassage:
        """Return the passage that an element continues, or start a new passage."""
        traveler = tag, attributes["id"]
        last_step, passage = self.travelers.get(traveler, (-2, None))
        # SUMO omits vehicles while they are teleported.
        if passage is None or last_step < self.step - 1:
            self._allowance.reserve(_TRAVELER_BYTES + len(attributes["id"]))
            passage = SumoPassage(attributes["id"], attributes.get("type") or tag)
            self.passages.append(passage)
        self.travelers[traveler] = self.step, passage
        return passage


def _parse_number(element: str, key: str, text: str) -> float:
    """Return the value of an attribute as a number.

    Raise ValueError if the value is not a number.
    """
    try:
        return float(text)
    except ValueError:
        raise ValueError(
            f"{key} of {element} must be a number, but is {printable(text)!r}"
        ) from None


def read_fcd(
    path: Path,
    section: TrafficSection,
    first_s: float,
    last_s: float,
    travelers: TravelerFilter = TravelerFilter(),  # noqa: B008 - immutable
) -> TrafficContent:
    """Read the vehicles and persons between two times from SUMO's floating car data.

    The rows include the last time step before and the first time step after this interval. The file
    can have any length, because other rows are discarded while the file is read. An `Allowance`
    that depends on the size of the file limits the memory for the remaining rows.

    Parameters
    ----------
    path
        Path of the file.
    section
        Section `traffic` of the scenario.
    first_s, last_s
        First and last time in seconds, relative to the clock of the file.
    travelers
        Vehicles and persons to read.

    Raises
    ------
    LidarError
        If the file cannot be read, is not floating car data, has unknown attributes, or
        decompresses to far more than its size.
    """
    try:
        allowance = Allowance(input_size(path), "Simulate a shorter time, or fewer vehicles")
        collector = _PassageCollector(section, first_s, travelers, allowance)
        with prefix_errors(path):
            collector.collect(_iter_elements(path), last_s)
    except (OSError, EOFError, zlib.error, ValueError, KeyError, expat.ExpatError) as error:
        raise LidarError(
            f"{path} cannot be read as floating car data of `sumo --fcd-output`: "
            f"{message_of(error)}"
        ) from error
    present = [
        passage
        for passage in collector.passages
        if len(passage.times_s) > 1 and passage.times_s[-1] >= first_s
    ]
    count = len(collector.travelers)
    return TrafficContent(present, plural(count, "vehicle") + " and persons", collector.left_out)


def _check_ignored(tag: str, names: Set[str], ignore: Sequence[str]) -> None:
    """Raise ValueError if an attribute name matches none of the patterns in `ignore`."""
    for name in sorted(names):
        if not any(matches_pattern(name, pattern) for pattern in ignore):
            raise ValueError(
                f"its {tag} has the attribute {printable(name)!r}, which SUMO does not define. To "
                f"ignore it, set `ignore: {format_yaml_list([name])}`"
            )


def _iter_elements(path: Path) -> Iterator[tuple[str, Mapping[str, str]]]:
    """Read an XML file in chunks, and yield the tag and attributes of each element.

    Raise LidarError if a .gz file decompresses to far more than its size.
    """
    elements: list[tuple[str, Mapping[str, str]]] = []
    parser = expat.ParserCreate()
    parser.EntityDeclHandler = refuse_entity
    parser.StartElementHandler = lambda tag, attributes: elements.append((tag, attributes))
    is_packed = path.suffix.lower() == ".gz"
    allowance = Allowance(input_size(path), "Decompress it with gunzip first", in_parts=True)
    with open_input(path) as file:
        content: BufferedIOBase = gzip.GzipFile(fileobj=file) if is_packed else file
        for _ in parse_pieces(parser, iter(partial(content.read, PIECE_BYTES), b"")):
            if is_packed:
                allowance.reserve(PIECE_BYTES + _ELEMENT_BYTES * len(elements))
            yield from elements
            elements.clear()


def platform_track(
    entry: TrajectorySection,
    section: TrafficSection,
    content: TrafficContent,
    load_mesh: Callable[[VehicleSection], SceneMesh],
    support: SupportSurfaces,
) -> Track:
    """Return the local trajectory of the vehicle in traffic that carries the sensors.

    The platform frame is the frame of the mesh of the vehicle.

    Parameters
    ----------
    entry
        Section `trajectory` of the scenario, which names the vehicle.
    section, load_mesh, support
        As for `build_traffic_actors`.
    content
        Traffic with the passages of that vehicle only.

    Raises
    ------
    LidarError
        If the vehicle is not in the simulation or has no shape, or if it is in the simulation
        several times and `entry` does not select one of them.
    """
    tracks: list[Track] = []
    for passage in content.passages:
        shape = passage.entry(section)
        mesh = None if shape is None else load_mesh(shape)
        tracks += _passage_tracks(passage, section, mesh, support, 0.0)
    if not tracks:
        known = sorted(content.left_out)
        hint = name_hint(entry.vehicle or "", known) if known else ""
        if entry.vehicle == HOST:
            hint = (
                " If the trace does not state its host vehicle, set `trajectory.vehicle` to an "
                f"identity.{hint}"
            )
        raise LidarError(
            f"`trajectory.vehicle` is {entry.vehicle!r}, but {section.file} does not contain this "
            f"vehicle in at least two time steps.{hint}"
        )
    start_s = entry.start_s
    if start_s is not None:
        covering = [t for t in tracks if t.times_s[0] <= start_s <= t.times_s[-1]]
        tracks = covering or tracks
    if len(tracks) > 1:
        spans = ", ".join(f"{t.times_s[0]:g} to {t.times_s[-1]:g}" for t in tracks[:4])
        raise LidarError(
            f"Vehicle {entry.vehicle!r} is in the traffic from {spans} s. Set "
            "`trajectory.start_s` and `trajectory.duration_s` within one of these periods."
        )
    return replace(tracks[0], start_s=start_s, duration_s=entry.duration_s, beyond="refuse")


def _passage_tracks(
    passage: TrafficPassage,
    section: TrafficSection,
    mesh: SceneMesh | None,
    support: SupportSurfaces,
    start_s: float,
) -> Sequence[Track]:
    """Return the local trajectories of a passage.

    If the passage leaves `section.surfaces`, there is one trajectory for each part on the surfaces.
    """
    track = passage.track(section, mesh, support.origin, start_s)
    if section.surfaces:
        return follow_surfaces(track, support.select(section.surfaces))
    return [track]


def build_traffic_actors(
    section: TrafficSection,
    passages: Sequence[TrafficPassage],
    load_mesh: Callable[[VehicleSection], SceneMesh],
    support: SupportSurfaces,
    start_s: float,
) -> list[tuple[Actor, VehicleSection]]:
    """Create actors from passages, in local coordinates.

    Parameters
    ----------
    section
        Section `traffic` of the scenario.
    passages
        Passages of the vehicles and persons.
    load_mesh
        Function that returns the mesh of an entry.
    support
        Surfaces of the scene. If `section.surfaces` is set, vehicles are not in the scene while
        they are not on these surfaces.
    start_s
        Start of the survey in seconds.

    Returns
    -------
    list of (Actor, VehicleSection)
        Actors with the entries that define their shapes.

    Raises
    ------
    LidarError
        If no entry matches a type, or if there are too many actors.
    """
    actors: list[tuple[Actor, VehicleSection]] = []
    for passage in passages:
        entry = passage.entry(section)
        assert entry is not None, "objects without a shape are skipped when the file is read"
        mesh = load_mesh(entry)
        tracks = _passage_tracks(passage, section, mesh, support, start_s)
        named = replace(mesh, name=f"{entry.name or passage.kind} ({passage.name})")
        # Different animation offsets keep the actors of an entry from walking in step.
        fraction = zlib.crc32(passage.name.encode()) / 2**32
        offset_s = 0.0 if entry.animation is None else entry.animation.offset_s
        offset_s += 0.0 if mesh.animation is None else fraction * mesh.animation.duration_s
        actors += [(Actor(named, piece, offset_s), entry) for piece in tracks]
        if len(actors) > MAX_ACTORS:
            raise LidarError(
                f"{section.file} has more than {MAX_ACTORS:,} vehicles and persons during the "
                "survey. Shorten the survey, or simulate a part of the network."
            )
    return actors
