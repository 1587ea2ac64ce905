"""What moves in a scenario: sensors on carriers, actors on trajectories, traffic of SUMO."""

from __future__ import annotations

import gzip
import math
import zlib
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from io import BufferedIOBase
from pathlib import Path
from typing import Annotated, Any, Literal
from xml.parsers import expat

import numpy as np
from pydantic import Strict, model_validator

from lidarscenes.files.formats import ROBOTS
from lidarsim.base.arrays import Floats
from lidarsim.base.declared import (
    Several,
    Text,
    TextOrTexts,
    Triple,
    about,
    by_text,
    declared,
    one_of,
)
from lidarsim.base.errors import LidarError, message_of, prefixed
from lidarsim.base.input_files import open_input
from lidarsim.base.words import printable
from lidarsim.base.xmlfile import refuse_entity
from lidarsim.scene.actors import Actor
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.sensor import Mounted, Pose, Track, load_trajectory
from lidarsim.sensor.survey import StepCount
from lidarsim.sensor.trajectory import CLOCK_S, Beyond, InstrumentPose, quaternions_of, rotations_of
from lidarsim.sensor.trajectory_files import (
    Duration,
    Height,
    Latitude,
    Longitude,
    Seconds,
    TrajectoryFormat,
)

from .ground import Standing, following
from .sections import (
    DeformingSection,
    IgnoredColumns,
    MeshEntry,
    MeshFile,
    PathOf,
    PoseEntry,
    Section,
    SensorSection,
    by_position,
)

_READING = {"format", "columns", "ignore", "topic", "origin", "camera_axes", "offset_s"}
_OF_ROBOTS = {"file", "opacity"}  # fields of a mesh file that robots have


class MountSection(Section, InstrumentPose):
    """Position and angles of a sensor on its carrier; in YAML also just [x, y, z]."""

    link: Annotated[
        Text | None,
        about(
            "link of the robot that carries it, whose axes these are; what is seen of it is left "
            "out of the scene",
            "top_lidar_link",
        ),
    ] = None

    def pose(self) -> Pose:
        """Return it as a pose."""
        return Pose(**declared(self, Pose))


MountEntry = Annotated[MountSection, by_position(MountSection)]


class CarriedSection(SensorSection):
    """One of several sensors: its mount, and when it scans; in YAML also just the model."""

    mount: MountEntry = MountSection()
    start_s: Annotated[
        float, about("start, in seconds after that of the survey or station", ge=0, le=1e9)
    ] = 0.0
    steps: Annotated[
        StepCount | None, about("its time steps (scans), instead of the survey's", 120)
    ] = None

    def mounted(self, *given: Any) -> Mounted:
        """Return it on its carrier, as `SensorSection` does, with its own start and time steps."""
        made = super().mounted(*given)
        sensor = replace(made.sensor, start_ns=self.start_s * 1e9) if self.start_s else made.sensor
        return replace(made, sensor=sensor, steps=self.steps)


CarriedEntry = Annotated[CarriedSection, by_text("model", CarriedSection)]


class TimedPose(Section, Pose):
    """A pose at a time; if no pose has an angle, the carrier faces its direction of travel."""

    time_s: Annotated[Seconds, about("seconds, by the clock of the trajectory")]


class TrajectorySection(Section):
    """Poses over time, from a file or from points; in YAML also just the file's name."""

    file: Annotated[
        Text | None,
        about(
            "TUM, KITTI, .csv, a folder «oxts» or a bag of ROS 2, from the scenario's folder",
            "drive.tum",
        ),
    ] = None
    format: Annotated[
        TrajectoryFormat | None, about("by default as the content of the file says")
    ] = None
    times: Annotated[Text | None, about("for KITTI poses: the file of times")] = None
    columns: Annotated[
        dict[str, str] | None,
        about(
            "for a table: {time_s, x, y, z, qx, …, yaw_deg, …: name in the file}",
            {"time_s": "stamp"},
        ),
    ] = None
    ignore: IgnoredColumns = ()
    topic: Annotated[
        Text | None,
        about("for a bag with several: a topic of poses, or /tf:FRAME", "/odometry"),
    ] = None
    origin: Annotated[
        tuple[Latitude, Longitude, Height] | None,
        Strict(False),
        about(
            "for latitudes and longitudes: those of the world's zero, degrees, and its height, "
            "metres; by default the first position",
            [48.7758, 9.1829, 290],
        ),
    ] = None
    camera_axes: Annotated[
        bool | None,
        about("whether poses have camera axes (z ahead); by default those of KITTI have"),
    ] = None
    points: Annotated[
        Several[TimedPose], about("instead of a file: time_s, position and angles, world metres")
    ] = ()
    interpolation: Annotated[
        Literal["linear", "smooth"], about("of positions and rotations; IMUs need smooth")
    ] = "linear"
    offset_s: Annotated[Seconds, about("added to all times")] = 0.0
    start_s: Annotated[
        Seconds | None,
        about("start of the survey; by default the first time"),
    ] = None
    duration_s: Annotated[
        Duration | None, about("duration of the survey; by default to the end")
    ] = None
    surfaces: Annotated[
        TextOrTexts | None,
        about(
            "names of objects to follow, with * and ?; heights are then above them",
            "Terrain",
            min_length=1,
        ),
    ] = None
    beyond: Annotated[
        Beyond,
        about(
            "of actors, before the first and after the last time: an error (refuse), the same "
            "pose (hold), or not in the scene (absent)"
        ),
    ] = "refuse"

    _one_source = one_of("file", "points")

    def track(self, path: PathOf, standing: Standing, start_s: float | None = None) -> Track:
        """Return it in a scene's local coordinates; LidarError if it cannot be used.

        `path` returns that of a file, `standing` is what there is to follow; `start_s` is that of
        a survey, of whose clock it is.
        """
        way = self._level(path, standing.origin, start_s)
        if self.surfaces is None:
            return way
        # Pieces may end before the survey does.
        pieces = following(replace(way, beyond="hold"), standing.only(self.surfaces))
        if len(pieces) == 1 and self.beyond == "absent":
            return replace(pieces[0], beyond="absent")
        assert way.start_s is not None  # of every track
        begin = way.start_s
        end = way.start_s + way.duration_ns / 1e9
        for piece in pieces:
            if piece.times_s[0] <= begin + CLOCK_S and end - CLOCK_S <= piece.times_s[-1]:
                return replace(piece, beyond=way.beyond)
        raise LidarError(
            f"the trajectory leaves its surfaces ({', '.join(self.surfaces)}): let it end before."
        )

    def _level(self, path: PathOf, origin: Floats, start_s: float | None) -> Track:
        """Return it without surfaces."""
        own: dict[str, Any] = {
            "smooth": self.interpolation == "smooth",
            "start_s": self.start_s if start_s is None else start_s,
            "duration_s": self.duration_s,
            "beyond": self.beyond,
        }
        if self.file is not None:
            track = load_trajectory(
                path(self.file),
                times=None if self.times is None else path(self.times),
                **self.model_dump(include=_READING),
                **own,
            )
            return replace(track, positions=track.positions - origin)
        angles = [[p.yaw_deg, p.pitch_deg, p.roll_deg] for p in self.points]
        turned = any({"yaw_deg", "pitch_deg", "roll_deg"} & p.model_fields_set for p in self.points)
        return Track(
            np.array([p.time_s + self.offset_s for p in self.points]),
            np.array([p.position for p in self.points]) - origin,
            quaternions_of(rotations_of(np.array(angles))) if turned else None,
            **own,
        )


TrajectoryEntry = Annotated[TrajectorySection, by_text("file", TrajectorySection)]


class JointTable(Section):
    """Values of a robot's joints from a table; in YAML also just the file's name."""

    file: Annotated[Text, about("a table with a header, from the scenario's folder")]
    ignore: IgnoredColumns = ()


class ActorSection(DeformingSection):
    """An object or robot that moves or stands; its axes have x ahead and z up."""

    name: Annotated[Text, about("name of the object")]
    file: Annotated[
        MeshEntry | None,
        about("its mesh in its own axes, as in scene.files, or a robot: .urdf", "car.glb"),
    ] = None
    trajectory: Annotated[
        TrajectoryEntry | None,
        about(
            "its trajectory, by the clock of the survey's; without it and at it is the carrier, "
            "and has the survey's",
            "van.csv",
        ),
    ] = None
    at: Annotated[
        PoseEntry | None,
        about("instead of a trajectory: where it stands, [x, y, z] or with angles", [4, 5, 0]),
    ] = None
    spray: Annotated[
        bool, about("whether its wheels raise spray, with weather.spray_g_m3; robots raise none")
    ] = True
    joints: Annotated[
        Annotated[JointTable, by_text("file", JointTable)] | None,
        about(
            "of a robot: a table of time_s and the values of joints, radians or metres", "arm.csv"
        ),
    ] = None

    @model_validator(mode="after")
    def _of_actor(self) -> ActorSection:
        way = self.trajectory
        if way is not None and self.at is not None:
            raise ValueError("give either trajectory or at, not both.")
        if way is not None and (way.start_s is not None or way.duration_s is not None):
            raise ValueError("an actor starts with the survey: give offset_s, not start_s.")
        if not self.robot and self.joints is not None:
            raise ValueError("joints are those of a robot: give a .urdf as its file.")
        if self.robot and (self.animation or self.wheels):
            raise ValueError("a robot has joints: leave out animation and wheels.")
        if self.robot and self.robot.model_fields_set - _OF_ROBOTS:
            raise ValueError("a robot is in metres and in its own axes: give just its file.")
        return self

    @property
    def is_carrier(self) -> bool:
        """Whether it has the survey's trajectory, and carries its sensors."""
        return self.trajectory is None and self.at is None

    @property
    def robot(self) -> MeshFile | None:
        """Its file, if that is one of a robot."""
        return self.file if self.file and self.file.file.lower().endswith(ROBOTS) else None

    def way(self, path: PathOf, standing: Standing, carrier: Track | None) -> Track:
        """Return its trajectory from the survey's start on."""
        start_s = 0.0 if carrier is None else carrier.start_s or 0.0
        if self.at is not None:
            # Of two poses: joints of a robot go by the clock of its trajectory.
            places = np.array([self.at.position] * 2) - standing.origin
            turns = quaternions_of(np.array([self.at.rotation_matrix] * 2))
            times = start_s + np.arange(2.0)
            return Track(times, places, turns, start_s=start_s, beyond="hold")
        if self.trajectory is None:
            assert carrier is not None, "checked with the scenario"
            return carrier
        with prefixed(f"actor {self.name!r}"):
            return self.trajectory.track(path, standing, start_s)


ACTORS_MOST = 10_000
_PIECE = 1 << 20  # bytes of a file that are read at a time
_MOVING = ("vehicle", "person", "container")
_ROW = ("x", "y", "angle", "z", "slope")
# Attributes that SUMO's documentation of --fcd-output defines, and that nothing here uses.
_UNUSED = frozenset((
    "acceleration", "accelerationLat", "arrivalDelay", "blockTime", "boardingTime", "delay",
    "distance", "edge", "entryTime", "eventTime", "lane", "leaderGap", "leaderID", "leaderSpeed",
    "odometer", "pos", "posLat", "queue", "segment", "signals", "speed", "speedFactor", "speedLat",
    "stopDelay", "tag", "timeLoss", "vehicle", "waiting",
))  # fmt: skip
_KNOWN = _UNUSED.union(_ROW, ("id", "type"))


class VehicleSection(DeformingSection):
    """What vehicles and persons of some types look like."""

    types: Annotated[
        TextOrTexts,
        about("types of SUMO, with * and ?; of several entries the first that fits", min_length=1),
    ] = ("*",)
    name: Annotated[
        Text | None, about("of its objects, before the identity in brackets; by default the type")
    ] = None


class TrafficSection(Section):
    """Vehicles and persons that SUMO has moved; each is an actor while it is in the simulation."""

    file: Annotated[Text, about("what sumo --fcd-output writes, .xml or .xml.gz")]
    vehicles: Annotated[
        Several[VehicleSection], about("shapes of vehicles and persons, by type", min_length=1)
    ]
    ignore: Annotated[
        TextOrTexts, about("names of attributes in the file to leave out, with * and ?", "battery*")
    ] = ()
    offset_s: Annotated[Seconds, about("added to all times")] = 0.0
    translation: Annotated[Triple, about("added to all positions, metres")] = (0, 0, 0)
    surfaces: Annotated[
        TextOrTexts | None,
        about(
            "names of objects to stand on, with * and ?; by default heights are the file's",
            min_length=1,
        ),
    ] = None
    interpolation: Annotated[Literal["linear", "smooth"], about("of poses between time steps")] = (
        "linear"
    )

    def shape_of(self, kind: str) -> VehicleSection:
        """Return the entry of a type; LidarError if there is none."""
        for entry in self.vehicles:
            if any(fnmatchcase(kind, one) for one in entry.types):
                return entry
        raise LidarError(
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


def read_fcd(
    path: Path, first_s: float, last_s: float, ignore: Sequence[str] = ()
) -> tuple[list[Passage], int]:
    """Read what is there between two times, with the time steps before and after.

    The file may be of any length: only these rows are kept. `ignore` are names of attributes to
    leave out, with * and ?.

    Returns
    -------
    Passages in the order in which they begin, and how many vehicles and persons came by.

    Raises
    ------
    LidarError
        If it cannot be read, is no floating car data, or has attributes that are not known.
    """
    known_attributes = set(_KNOWN)
    passages: list[Passage] = []
    known: dict[tuple[str, str], tuple[int, Passage]] = {}  # {who: last step, passage}
    step = -1
    time = -math.inf
    vehicle: tuple[str, str] | None = None  # place of the last one of the time step
    try:
        for tag, at in _elements(path):
            if tag == "timestep":
                before = time
                time = float(at["time"])
                if not before < time < math.inf:
                    raise ValueError(f"the time {time} does not come after the one before")
                if before > last_s:  # the first time step after the last time is needed as well
                    break
                step = step + 1
                vehicle = None
            elif tag in _MOVING and step >= 0:
                if not at.keys() <= known_attributes:
                    known_attributes |= _ignored(tag, at.keys() - known_attributes, ignore)
                place = at["x"], at["y"]
                if tag == "vehicle":
                    vehicle = place
                elif place == vehicle:  # SUMO writes who rides in a vehicle after it
                    continue
                who = tag, at["id"]
                last, passage = known.get(who, (-2, None))
                # SUMO takes vehicles out while it moves them.
                if passage is None or last < step - 1:
                    passage = Passage(at["id"], at.get("type") or tag)
                    passages.append(passage)
                known[who] = step, passage
                if time <= first_s:  # of those before the first time the last is needed
                    del passage.times_s[:], passage.rows[:]
                row = [float(at[key]) for key in _ROW[:3]]
                row += [float(at.get(key) or 0) for key in _ROW[3:]]
                if not all(map(math.isfinite, row)):
                    raise ValueError(f"{tag} {at['id']!r} has no finite position at {time:g} s")
                passage.times_s.append(time)
                passage.rows.extend(row)
        if step < 0:
            raise ValueError("it has no time steps")
    except (OSError, EOFError, zlib.error, ValueError, KeyError, expat.ExpatError) as error:
        raise LidarError(
            f"{path} is not usable as floating car data, which sumo --fcd-output writes: "
            f"{message_of(error)}"
        ) from error
    there = [one for one in passages if len(one.times_s) > 1 and one.times_s[-1] >= first_s]
    return there, len(known)


def _ignored(tag: str, names: Set[str], ignore: Sequence[str]) -> Set[str]:
    """Return names of attributes that are all ignored; ValueError for one that is not."""
    for name in sorted(names):
        if not any(fnmatchcase(name, pattern) for pattern in ignore):
            raise ValueError(
                f"its {tag} has the attribute {printable(name)!r}, which --fcd-output does not "
                f"define: give ignore: [{printable(name)}] to leave it out"
            )
    return names


def _elements(path: Path) -> Iterator[tuple[str, Mapping[str, str]]]:
    """Yield tags and attributes of the elements of a file, of which it holds a piece at a time."""
    begun: list[tuple[str, Mapping[str, str]]] = []
    parser = expat.ParserCreate()
    parser.EntityDeclHandler = refuse_entity
    parser.StartElementHandler = lambda tag, at: begun.append((tag, at))
    with open_input(path) as file:
        is_packed = path.suffix.lower() == ".gz"
        content: BufferedIOBase = gzip.GzipFile(fileobj=file) if is_packed else file
        while piece := content.read(_PIECE):
            parser.Parse(piece)
            yield from begun
            begun.clear()
    parser.Parse(b"", True)


def actors_of(
    section: TrafficSection,
    passages: list[Passage],
    shape_of: Callable[[VehicleSection], SceneMesh],
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
    LidarError
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
            fronts[:, 2] = section.translation[2]
            slope = 0 * slope
        # Angles are clockwise from north, and slopes positive uphill.
        turns = rotations_of(np.column_stack([90.0 - angle, -slope, np.zeros(len(x))]))
        # SUMO places the middle of the front bumper.
        places = fronts - turns[:, :, 0] * mesh.vertices[:, 0].max() - standing.origin
        smooth = section.interpolation == "smooth"
        way = Track(times, places, quaternions_of(turns), smooth, start_s, beyond="absent")
        ways = following(way, follows) if follows else [way]
        named = replace(mesh, name=f"{entry.name or one.kind} ({one.name})")
        # Those of one entry do not walk in step.
        share = zlib.crc32(one.name.encode()) / 2**32
        offset_s = 0.0 if entry.animation is None else entry.animation.offset_s
        offset_s += 0.0 if mesh.animation is None else share * mesh.animation.duration_s
        actors += [(Actor(named, way, offset_s), entry) for way in ways]
        if len(actors) > ACTORS_MOST:
            raise LidarError(
                f"{section.file} has more than {ACTORS_MOST:,} vehicles and persons during the "
                "survey: make the survey shorter, or simulate a part of the network."
            )
    return actors
