"""Sections of a scenario about what moves: trajectories, and mounts of sensors."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import model_validator

from ..base.arrays import Floats
from ..base.declared import Several, Text, TextOrTexts, declared, is_text, short, told
from ..base.errors import LidarpoolError, prefixed
from ..scene.urdf import SUFFIXES as ROBOTS
from ..sensor import Mounted, Pose, Sensor, Track, load_trajectory
from ..sensor.survey import Steps
from ..sensor.trajectory import CLOCK_S, Beyond, InstrumentPose
from ..sensor.trajectory_files import Duration, Seconds, TrajectoryFormat, quaternions_from_degrees
from .sections import MeshEntry, PathOf, Section, SensorSection, ShapeSection
from .standing import Standing, following

_OF_ROBOTS = {"file", "opacity"}  # fields of a mesh file that robots have


class MountSection(Section, InstrumentPose):
    """Position and angles of a sensor on its carrier, in the carrier's axes."""

    link: Annotated[
        Text | None,
        told(
            "link of the robot that carries it, whose axes these are; what is seen of it is left "
            "out of the scene",
            "top_lidar_link",
        ),
    ] = None

    def pose(self) -> Pose:
        """Return it as a pose."""
        return Pose(**declared(self, Pose))


class CarriedSection(SensorSection):
    """One of several sensors: its mount, and when it scans."""

    mount: MountSection = MountSection()
    start_s: Annotated[
        float, told("start, in seconds after that of the survey or station", ge=0, le=1e9)
    ] = 0.0
    steps: Annotated[
        Steps | None,
        told("its time steps (scans), instead of the survey's", 120),
    ] = None

    def sensor(self, path: PathOf) -> Sensor:
        """Make the sensor, which starts at its own time; errors as of `SensorSection`."""
        made = super().sensor(path)
        return replace(made, start_ns=self.start_s * 1e9) if self.start_s else made

    def mounted(self, *given: Any) -> Mounted:
        """Return it on its carrier, as `SensorSection` does, with its time steps."""
        return replace(super().mounted(*given), steps=self.steps)


class TimedPose(Section, Pose):
    """A pose at a time; if no pose has an angle, the carrier faces its direction of travel."""

    time_s: Annotated[Seconds, told("seconds, by the clock of the trajectory")]


class TrajectorySection(Section):
    """Poses over time, from a file or from points; in YAML also just the file's name."""

    file: Annotated[
        Text | None, told("TUM, KITTI or .csv, from the scenario's folder", "drive.tum")
    ] = None
    format: Annotated[
        TrajectoryFormat | None, told("by default kitti with times, csv for a .csv, else tum")
    ] = None
    times: Annotated[Text | None, told("for KITTI poses: the file of times")] = None
    columns: Annotated[
        dict[str, str] | None,
        told(
            "for a table: {time_s, x, y, z, qx, …, yaw_deg, …: name in the file}",
            {"time_s": "stamp"},
        ),
    ] = None
    camera_axes: Annotated[
        bool | None,
        told("whether poses have camera axes (z ahead); by default those of KITTI have"),
    ] = None
    points: Annotated[
        Several[TimedPose],
        told("instead of a file: time_s, position and angles, world metres"),
    ] = ()
    interpolation: Annotated[
        Literal["linear", "smooth"], told("of positions and rotations; IMUs need smooth")
    ] = "linear"
    offset_s: Annotated[Seconds, told("added to all times")] = 0.0
    start_s: Annotated[
        Seconds | None,
        told("start of the survey; by default the first time"),
    ] = None
    duration_s: Annotated[
        Duration | None, told("duration of the survey; by default to the end")
    ] = None
    surfaces: Annotated[
        TextOrTexts | None,
        told(
            "names of objects to follow, with * and ?; heights are then above them",
            "Terrain",
            min_length=1,
        ),
    ] = None
    beyond: Annotated[
        Beyond,
        told(
            "of actors, before the first and after the last time: an error (refuse), the same "
            "pose (hold), or not in the scene (absent)"
        ),
    ] = "refuse"

    @model_validator(mode="after")
    def _one_source(self) -> TrajectorySection:
        if (self.file is None) != bool(self.points):
            raise ValueError("give either file or points.")
        return self

    def track(self, path: PathOf, standing: Standing, start_s: float | None = None) -> Track:
        """Return it in a scene's local coordinates; LidarpoolError if it cannot be used.

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
        begin, end = way.start_s, way.start_s + way.duration_ns / 1e9
        for piece in pieces:
            if piece.times_s[0] <= begin + CLOCK_S and end - CLOCK_S <= piece.times_s[-1]:
                return replace(piece, beyond=way.beyond)
        raise LidarpoolError(
            f"the trajectory leaves its surfaces ({', '.join(self.surfaces)}): let it end before."
        )

    def _level(self, path: PathOf, origin: Floats, start_s: float | None) -> Track:
        """Return it without surfaces."""
        start_s = self.start_s if start_s is None else start_s
        smooth = self.interpolation == "smooth"
        if self.file is not None:
            track = load_trajectory(
                path(self.file),
                format=self.format,
                times=None if self.times is None else path(self.times),
                columns=self.columns,
                camera_axes=self.camera_axes,
                offset_s=self.offset_s,
                smooth=smooth,
                start_s=start_s,
                duration_s=self.duration_s,
                beyond=self.beyond,
            )
            return replace(track, positions=track.positions - origin)
        angles = [[p.yaw_deg, p.pitch_deg, p.roll_deg] for p in self.points]
        turned = any({"yaw_deg", "pitch_deg", "roll_deg"} & p.model_fields_set for p in self.points)
        return Track(
            np.array([p.time_s + self.offset_s for p in self.points]),
            np.array([p.position for p in self.points]) - origin,
            quaternions_from_degrees(np.array(angles)) if turned else None,
            smooth,
            start_s,
            self.duration_s,
            self.beyond,
        )


TrajectoryEntry = Annotated[
    TrajectorySection, short(is_text, lambda v: {"file": v}, Text | TrajectorySection)
]


class ActorSection(ShapeSection):
    """An object or robot that moves through the scene; its axes have x ahead and z up."""

    name: Annotated[Text, told("name of the object")]
    file: Annotated[
        MeshEntry | None,
        told("its mesh in its own axes, as in scene.files, or a robot: .urdf", "car.glb"),
    ] = None
    trajectory: Annotated[
        TrajectoryEntry | None,
        told(
            "its trajectory, by the clock of the survey's; by default it is the carrier, and has "
            "the survey's",
            "van.csv",
        ),
    ] = None
    joints: Annotated[
        Text | None,
        told(
            "of a robot: a table of time_s and the values of joints, radians or metres", "arm.csv"
        ),
    ] = None

    @model_validator(mode="after")
    def _of_actor(self) -> ActorSection:
        way = self.trajectory
        if way is not None and (way.start_s is not None or way.duration_s is not None):
            raise ValueError("an actor starts with the survey: give offset_s, not start_s.")
        if not self.is_robot and self.joints is not None:
            raise ValueError("joints are those of a robot: give a .urdf as its file.")
        if self.is_robot and self.file is not None and self.file.model_fields_set - _OF_ROBOTS:
            raise ValueError("a robot is in metres and in its own axes: give just its file.")
        return self

    @property
    def is_robot(self) -> bool:
        """Whether its file is that of a robot."""
        return self.file is not None and self.file.file.lower().endswith(ROBOTS)

    def way(self, path: PathOf, standing: Standing, carrier: Track | None) -> Track:
        """Return its trajectory from the survey's start on."""
        if self.trajectory is None:
            assert carrier is not None, "checked with the scenario"
            return carrier
        start_s = 0.0 if carrier is None else carrier.start_s
        with prefixed(f"actor {self.name!r}"):
            return self.trajectory.track(path, standing, start_s)
