"""Traffic of other programs: floating car data of SUMO, and vehicles as actors."""

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

from lidarsim.errors import LidarError, message_of, prefixed
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

from .actor_motion import TimeUnitEntry, TrajectorySection
from .ground import StandingSurfaces, follow_surfaces
from .sections import DeformingSection, Section

HOST = "host"  # identity of the host vehicle of OSI, beside its number

MAX_ACTORS = 10_000

_MOVING = ("vehicle", "person", "container")

_ROW = ("x", "y", "angle", "z", "slope")

# Attributes that SUMO's documentation of --fcd-output defines, and that are not used here.
_UNUSED = frozenset((
    "acceleration", "accelerationLat", "arrivalDelay", "blockTime", "boardingTime", "delay",
    "distance", "edge", "entryTime", "eventTime", "lane", "leaderGap", "leaderID", "leaderSpeed",
    "odometer", "pos", "posLat", "queue", "segment", "signals", "speed", "speedFactor", "speedLat",
    "stopDelay", "tag", "timeLoss", "vehicle", "waiting",
))  # fmt: skip

_ROW_BYTES = 8 * (1 + len(_ROW))  # bytes of a time and its row

_ELEMENT_BYTES = 100  # bytes of an element of a packed file: a short element takes as long as these

_TRAVELLER_BYTES = 1000  # bytes of a vehicle or person without its rows

_KNOWN = _UNUSED.union(_ROW, ("id", "type"))


class VehicleSection(DeformingSection):
    """Shapes of vehicles and persons, by type in SUMO or OSI."""

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
    """Vehicles and persons of a traffic simulation.

    They are actors while they are in the simulation.
    """

    file: Annotated[
        Text,
        about(
            "output of `sumo --fcd-output` (.xml, .xml.gz), or OSI trace with ground truth (.osi, "
            ".mcap)"
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

    def entry_of(self, vehicle_type: str) -> VehicleSection | None:
        """Return the first entry that fits a type of vehicles, or None."""
        for entry in self.vehicles:
            if any(matches_pattern(vehicle_type, pattern) for pattern in entry.types):
                return entry
        return None


class TrafficPassage(Protocol):
    """A vehicle or person while it is in a simulation without a break."""

    @property
    def name(self) -> str:
        """Identity in the simulation."""

    @property
    def kind(self) -> str:
        """Type in the simulation."""

    def entry(self, section: TrafficSection) -> VehicleSection | None:
        """Return the entry with the shape.

        None for a carrier of OSI without dimensions; LidarError if a vehicle of SUMO has none.
        """

    def track(
        self, section: TrafficSection, mesh: SceneMesh | None, origin: Floats, start_s: float
    ) -> Track:
        """Return the local trajectory of a mesh, above `section.surfaces` if there are any."""


class TravellerChoice(NamedTuple):
    """The vehicles and persons of a simulation that are read.

    Attributes
    ----------
    only
        Identity of the only one; None for all.
    without
        Identity of one that is left out.
    """

    only: str | None = None
    without: str | None = None

    def has(self, *identities: str) -> bool:
        """Return whether one with these identities is read."""
        if self.only is not None:
            return self.only in identities
        return self.without not in identities


class TrafficContent(NamedTuple):
    """Vehicles, persons and objects of a file of traffic between two times."""

    passages: Sequence[TrafficPassage]  # passages in the order of their starts
    counted: str  # number of vehicles and persons until the end, in words
    left_out: Set[str] = frozenset()  # identities of those that were not to be read
    notes: Sequence[str] = ()  # notes on what is left out


@dataclass(frozen=True, eq=False)
class Passage:
    """Consecutive time steps of a vehicle or person."""

    name: str
    kind: str
    times_s: array[float] = field(default_factory=lambda: array("d"))
    rows: array[float] = field(default_factory=lambda: array("d"))  # `_ROW` at each time

    def entry(self, section: TrafficSection) -> VehicleSection:
        """Return the first entry that fits the type.

        Raises LidarError if no entry fits.
        """
        matching = section.entry_of(self.kind)
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
        """Return the local trajectory of a mesh, above `section.surfaces` if there are any."""
        assert mesh is not None, "each has an entry"
        times = np.array(self.times_s) + section.offset_s
        x, y, angle, z, slope = np.array(self.rows).reshape(-1, len(_ROW)).T
        fronts = np.column_stack([x, y, z]) + section.translation
        if section.surfaces:
            fronts[:, 2] = section.translation[2]
            slope = 0 * slope
        # Angles are clockwise from north, and slopes positive uphill.
        rotations = rotations_of(np.column_stack([90.0 - angle, -slope, np.zeros(len(x))]))
        # SUMO's position is the middle of the front bumper.
        positions = fronts - rotations[:, :, 0] * mesh.vertices[:, 0].max() - origin
        smooth = section.interpolation == "smooth"
        return Track(times, positions, quaternions_of(rotations), smooth, start_s, beyond="absent")


class TrafficClock:
    """Converts the times of a file of traffic to seconds, one after the other.

    Raises ValueError for times that must have another unit (`seconds_of`).
    """

    def __init__(self, time_unit: TimeUnit | None) -> None:
        self._time_unit = time_unit
        self._times: list[float] = []  # the first time, and the last one

    def seconds(self, time: float) -> float:
        """Return the next time in seconds."""
        if self._time_unit is not None:
            return time / SECONDS[self._time_unit]
        if self._times and not are_plausible(self._times[0], time):
            seconds_of(np.array([*self._times, time]), None)
        self._times[1 if self._times else 0 :] = [time]
        return time


# Days, hours, minutes and seconds, which SUMO writes with --human-readable-time.
_READABLE_TIME = re.compile(r"(-?)(?:(\d+):)?(\d+):(\d\d):(\d\d(?:\.\d*)?)")


def _readable_seconds(text: str) -> float | None:
    """Return the seconds of a time such as 1:02:30:00.50, with days or without.

    Returns None for other texts.
    """
    match = _READABLE_TIME.fullmatch(text.strip())
    if match is None:
        return None
    sign, days, hours, minutes, seconds = match.groups()
    whole_s = ((int(days or 0) * 24 + int(hours)) * 60 + int(minutes)) * 60
    return (whole_s + float(seconds)) * (-1.0 if sign else 1.0)


class _PassageCollector:
    """Collects passages from the elements of floating car data, time step by time step.

    Rows before the first time are dropped, but for the last.
    """

    def __init__(
        self,
        section: TrafficSection,
        first_s: float,
        choice: TravellerChoice,
        allowance: Allowance,
    ) -> None:
        self.passages: list[Passage] = []
        self.left_out: set[str] = set()  # identities that are not in `choice`
        # {(tag, identity): (last step, passage)}
        self.travellers: dict[tuple[str, str], tuple[int, Passage]] = {}
        self.step = -1
        self.time_s = -math.inf
        self._first_s = first_s
        self._time_unit = section.time_unit
        self._clock = TrafficClock(section.time_unit)
        self._ignore = section.ignore
        self._choice = choice
        self._allowance = allowance
        self._known_attributes = set(_KNOWN)
        self._vehicle_xy: tuple[str, str] | None = None  # position of the time step's last vehicle

    def collect(self, elements: Iterable[tuple[str, Mapping[str, str]]], last_s: float) -> None:
        """Collect from tags with attributes until a time.

        Raises ValueError if they are not valid.

        The first time step after the last time is needed as well.
        """
        for tag, attributes in elements:
            if tag == "timestep":
                previous_s = self.time_s
                self.begin_step(attributes["time"])
                if previous_s > last_s:
                    break
            elif tag in _MOVING and self.step >= 0:
                self.add(tag, attributes)
        if self.step < 0:
            raise ValueError("it has no time steps")

    def begin_step(self, text: str) -> None:
        """Begin a time step.

        Raises ValueError if its time is not after the last time step's.
        """
        time_s = _readable_seconds(text)
        if time_s is not None and self._time_unit is not None:
            raise ValueError(
                "its times are hours, minutes and seconds, so `time_unit` cannot be set"
            )
        if time_s is None:
            time_s = self._clock.seconds(_number("a timestep", "time", text))
        if not self.time_s < time_s < math.inf:
            raise ValueError(f"the time {time_s} is not after the previous time")
        self.time_s = time_s
        self.step += 1
        self._vehicle_xy = None

    def add(self, tag: str, attributes: Mapping[str, str]) -> None:
        """Add the row of a vehicle or person.

        Raises ValueError or KeyError if the row is not valid.
        """
        if not attributes.keys() <= self._known_attributes:
            unknown = attributes.keys() - self._known_attributes
            _check_ignored(tag, unknown, self._ignore)
            self._known_attributes |= unknown
        xy = attributes["x"], attributes["y"]
        if tag == "vehicle":
            self._vehicle_xy = xy
        elif xy == self._vehicle_xy:  # SUMO writes the riders of a vehicle after the vehicle
            return
        if not self._choice.has(attributes["id"]):
            if attributes["id"] not in self.left_out:
                self._allowance.take(_TRAVELLER_BYTES)
            self.left_out.add(attributes["id"])
            return
        passage = self._passage(tag, attributes)
        if self.time_s <= self._first_s:  # of earlier rows, only the last is needed
            del passage.times_s[:], passage.rows[:]
        else:
            self._allowance.take(_ROW_BYTES)
        identity = attributes["id"]
        named = f"{tag} {identity!r}"
        row = [_number(named, key, attributes[key]) for key in _ROW[:3]]
        row += [_number(named, key, attributes.get(key) or "0") for key in _ROW[3:]]
        if not all(map(math.isfinite, row)):
            raise ValueError(f"{named} has no finite position at {self.time_s:g} s")
        passage.times_s.append(self.time_s)
        passage.rows.extend(row)

    def _passage(self, tag: str, attributes: Mapping[str, str]) -> Passage:
        """Return the passage that an element continues, or a new passage."""
        traveller = tag, attributes["id"]
        last_step, passage = self.travellers.get(traveller, (-2, None))
        # SUMO omits vehicles while they are teleported.
        if passage is None or last_step < self.step - 1:
            self._allowance.take(_TRAVELLER_BYTES + len(attributes["id"]))
            passage = Passage(attributes["id"], attributes.get("type") or tag)
            self.passages.append(passage)
        self.travellers[traveller] = self.step, passage
        return passage


def _number(element: str, key: str, text: str) -> float:
    """Return the number in an attribute.

    Raises ValueError if the attribute is not a number.
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
    choice: TravellerChoice = TravellerChoice(),  # noqa: B008 - it never changes
) -> TrafficContent:
    """Read the vehicles and persons between two times, with the time steps before and after.

    The file may be of any length: only these rows stay in memory, for which the size of the file is
    an `Allowance`.

    Raises
    ------
    LidarError
        If the file cannot be read, is not floating car data, has unknown attributes, or unpacks to
        far more than its size.
    """
    try:
        allowance = Allowance(input_size(path), "Simulate a shorter time, or fewer vehicles")
        collector = _PassageCollector(section, first_s, choice, allowance)
        with prefixed(path):
            collector.collect(_elements(path), last_s)
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
    count = len(collector.travellers)
    return TrafficContent(present, plural(count, "vehicle") + " and persons", collector.left_out)


def _check_ignored(tag: str, names: Set[str], ignore: Sequence[str]) -> None:
    """Raise ValueError for a name of an attribute that fits no pattern to ignore."""
    for name in sorted(names):
        if not any(matches_pattern(name, pattern) for pattern in ignore):
            raise ValueError(
                f"its {tag} has the attribute {printable(name)!r}, which SUMO does not define. To "
                f"ignore it, set `ignore: {format_yaml_list([name])}`"
            )


def _elements(path: Path) -> Iterator[tuple[str, Mapping[str, str]]]:
    """Yield tags and attributes of the elements of an XML file, which is read in pieces.

    LidarError is raised for a .gz that unpacks to far more than its size.
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
                allowance.take(PIECE_BYTES + _ELEMENT_BYTES * len(elements))
            yield from elements
            elements.clear()


def carrier_of(
    entry: TrajectorySection,
    section: TrafficSection,
    content: TrafficContent,
    shape_of: Callable[[VehicleSection], SceneMesh],
    standing: StandingSurfaces,
) -> Track:
    """Return the local trajectory of the vehicle of the traffic that carries the sensors.

    Its frame is the frame of the vehicle's mesh. `content` has passages of that vehicle alone; the
    other arguments are as for `actors_of`.

    Raises
    ------
    LidarError
        If the vehicle is not in the simulation, has no shape, or is in the simulation for several
        times and `entry` does not say for which.
    """
    tracks: list[Track] = []
    for passage in content.passages:
        shape = passage.entry(section)
        mesh = None if shape is None else shape_of(shape)
        tracks += _tracks_of(passage, section, mesh, standing, 0.0)
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


def _tracks_of(
    passage: TrafficPassage,
    section: TrafficSection,
    mesh: SceneMesh | None,
    standing: StandingSurfaces,
    start_s: float,
) -> Sequence[Track]:
    """Return the local trajectories of a passage: several if it leaves `section.surfaces`."""
    track = passage.track(section, mesh, standing.origin, start_s)
    if section.surfaces:
        return follow_surfaces(track, standing.of_objects(section.surfaces))
    return [track]


def actors_of(
    section: TrafficSection,
    passages: Sequence[TrafficPassage],
    shape_of: Callable[[VehicleSection], SceneMesh],
    standing: StandingSurfaces,
    start_s: float,
) -> list[tuple[Actor, VehicleSection]]:
    """Make actors of passages, in a scene's local coordinates, each with its entry.

    Parameters
    ----------
    shape_of
        Returns the mesh of an entry.
    standing
        Surfaces of the scene, for `section.surfaces`; vehicles off these surfaces are not in the
        scene.
    start_s
        Start of the survey.

    Raises
    ------
    LidarError
        If a type has no shape, or there are too many actors.
    """
    actors: list[tuple[Actor, VehicleSection]] = []
    for passage in passages:
        entry = passage.entry(section)
        assert entry is not None, "objects without a shape are no actors"
        mesh = shape_of(entry)
        tracks = _tracks_of(passage, section, mesh, standing, start_s)
        named = replace(mesh, name=f"{entry.name or passage.kind} ({passage.name})")
        # Actors of an entry do not walk in step.
        share = zlib.crc32(passage.name.encode()) / 2**32
        offset_s = 0.0 if entry.animation is None else entry.animation.offset_s
        offset_s += 0.0 if mesh.animation is None else share * mesh.animation.duration_s
        actors += [(Actor(named, piece, offset_s), entry) for piece in tracks]
        if len(actors) > MAX_ACTORS:
            raise LidarError(
                f"{section.file} has more than {MAX_ACTORS:,} vehicles and persons during the "
                "survey. Shorten the survey, or simulate a part of the network."
            )
    return actors
