"""Scenario sections for mounts, trajectories, actors and other motion."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Strict, model_validator

from lidarscenes.files.formats import ROBOTS
from lidarsim.errors import LidarError, prefix_errors
from lidarsim.io.time_units import TimeUnit, seconds_of
from lidarsim.motion.rotations import quaternions_of, rotations_of
from lidarsim.motion.trajectory import CLOCK_S, Beyond, InstrumentPose, Pose, Track
from lidarsim.motion.trajectory_files import (
    Duration,
    Height,
    Latitude,
    Longitude,
    Seconds,
    TrajectoryFormat,
    load_trajectory,
)
from lidarsim.numerics.arrays import Floats
from lidarsim.schema.declared import (
    Several,
    Text,
    TextOrTexts,
    Triple,
    about,
    accept_text,
    declared_values,
    require_one_of,
)
from lidarsim.survey.survey import Mounted, StepCount

from ..sections import (
    DeformingSection,
    IgnoredColumns,
    MeshEntry,
    MeshFile,
    NoiseSection,
    PoseEntry,
    ResolvePath,
    ReturnsSection,
    Section,
    SensorSection,
    by_position,
)
from .ground import SupportSurfaces, follow_surfaces

_READING_OPTIONS = {
    "format", "time_unit", "columns", "ignore", "topic", "origin", "camera_axes", "offset_s",
}  # fmt: skip
_ROBOT_FIELDS = {"file", "opacity", "assets"}  # fields of a mesh file that apply to robots


class MountSection(Section, InstrumentPose):
    """Position and angles of a sensor on its platform.

    In YAML, [x, y, z] alone is sufficient.
    """

    link: Annotated[
        Text | None,
        about(
            "robot link in whose axes the mount is defined, for a robot on the platform; the "
            "visible shape of the link is omitted from the scene; in the sensor file of lidarpool "
            "follow, the name of a frame",
            "top_lidar_link",
        ),
    ] = None

    def pose(self) -> Pose:
        """Convert the position and angles to a pose."""
        return Pose(**declared_values(self, Pose))


MountEntry = Annotated[MountSection, by_position(MountSection)]


class MountedSensorSection(SensorSection):
    """A sensor that is mounted on a platform.

    In YAML, the model alone is sufficient.
    """

    mount: MountEntry = MountSection()
    start_s: Annotated[
        float,
        about(
            "start of the sensor in seconds after the start of the survey or station",
            ge=0,
            le=1e9,
        ),
    ] = 0.0
    steps: Annotated[
        StepCount | None,
        about("number of time steps (scans) of the sensor (default: from the survey)", 120),
    ] = None

    def mounted_sensor(
        self,
        path: ResolvePath,
        mount: Pose,
        noise: NoiseSection,
        returns: ReturnsSection,
        name: str = "",
    ) -> Mounted:
        """Return the mounted sensor.

        It has the start time and the number of time steps of this section. The parameters are those
        of `SensorSection.mounted_sensor`. Raise LidarError if a file cannot be used.
        """
        mounted = super().mounted_sensor(path, mount, noise, returns, name)
        sensor = mounted.sensor
        if self.start_s:
            sensor = replace(sensor, start_ns=self.start_s * 1e9)
        return replace(mounted, sensor=sensor, steps=self.steps)


MountedSensorEntry = Annotated[MountedSensorSection, accept_text("model", MountedSensorSection)]


class TimedPose(Section, Pose):
    """A pose at a given time.

    If no pose has an angle, the platform is level and faces its direction of travel.
    """

    # The range is large, because `seconds_of` suggests a unit for times that are not in seconds.
    time_s: Annotated[float, about("time of the pose, in seconds", ge=-1e20, le=1e20)]


Identity = Annotated[Text, BeforeValidator(lambda v: str(v) if type(v) is int else v)]


TimeUnitEntry = Annotated[
    TimeUnit | None,
    about("unit of the times in the file (default: the unit that the file states)", "ns"),
]


class TrajectorySection(Section):
    """A trajectory from a file, from a list of poses, or from traffic.

    In YAML, the file name alone is sufficient.
    """

    file: Annotated[
        Text | None,
        about(
            "trajectory file in the TUM or KITTI format, .csv table, oxts folder or ROS 2 bag, "
            "relative to the folder of the scenario",
            "drive.tum",
        ),
    ] = None
    format: Annotated[
        TrajectoryFormat | None,
        about("format of the file (default: detected from its content)"),
    ] = None
    times: Annotated[Text | None, about("file with the times of KITTI poses")] = None
    time_unit: TimeUnitEntry = None
    columns: Annotated[
        dict[str, str] | None,
        about(
            "column names of a table for time_s, x, y, z, qx, qy, qz, qw, yaw_deg and other "
            "quantities",
            {"time_s": "stamp"},
        ),
    ] = None
    ignore: IgnoredColumns = ()
    topic: Annotated[
        Text | None,
        about(
            "topic with the poses, or /tf:FRAME; required for a bag with several topics",
            "/odometry",
        ),
    ] = None
    origin: Annotated[
        tuple[Latitude, Longitude, Height] | None,
        Strict(False),
        about(
            "latitude and longitude of the world origin in degrees, and its height in meters, for "
            "files with latitudes and longitudes (default: the first position)",
            [48.7758, 9.1829, 290],
        ),
    ] = None
    camera_axes: Annotated[
        bool | None,
        about(
            "whether the poses use camera axes, with z forward (default: true for KITTI poses only)"
        ),
    ] = None
    points: Annotated[
        Several[TimedPose],
        about("poses with time_s, position and angles, in world coordinates; replaces file"),
    ] = ()
    vehicle: Annotated[
        Identity | None,
        about(
            "ID of the vehicle in the traffic that carries the sensors of the survey, or host for "
            "the host vehicle of an OSI trace; replaces file",
            "host",
        ),
    ] = None
    interpolation: Annotated[
        Literal["linear", "smooth"],
        about("interpolation of positions and rotations; an IMU requires smooth"),
    ] = "linear"
    offset_s: Annotated[Seconds, about("offset in seconds that is added to all times")] = 0.0
    translation: Annotated[
        Triple, about("translation in meters that is added to all positions")
    ] = (0, 0, 0)
    start_s: Annotated[
        Seconds | None,
        about("time at which the survey starts (default: the start of the trajectory)"),
    ] = None
    duration_s: Annotated[
        Duration | None,
        about("duration of the survey (default: until the end of the trajectory)"),
    ] = None
    surfaces: Annotated[
        TextOrTexts | None,
        about(
            "names of objects that the trajectory follows, so that its heights are relative to "
            "them; may contain * and ?",
            "Terrain",
            min_length=1,
        ),
    ] = None
    beyond: Annotated[
        Beyond,
        about(
            "behavior of an actor before the first and after the last time: refuse raises an "
            "error, hold keeps the pose, and absent removes the actor from the scene"
        ),
    ] = "refuse"

    _one_source = require_one_of("file", "points", "vehicle")

    def track(
        self,
        path: ResolvePath,
        support: SupportSurfaces,
        start_s: float | None = None,
        *,
        name: str,
        without_angles: dict[str, bool],
    ) -> Track:
        """Return the trajectory in the local coordinates of a scene.

        Parameters
        ----------
        path
            Function that returns the path of a file in the scenario.
        support
            Surfaces of the scene, which the trajectory may follow.
        start_s
            Start of the survey in seconds, relative to the clock of its trajectory.
        name
            Name of the platform or actor on the trajectory, for notes.
        without_angles
            If the poses have no angles, `name` is added to this dictionary with the value True if
            the path has corners, otherwise False.

        Raises
        ------
        LidarError
            If a file cannot be read, or if the trajectory leaves its surfaces.
        """
        track = self._track_without_surfaces(path, support.origin, start_s)
        if track.quaternions is None:
            without_angles[name] = len(track.with_turns.times_s) > len(track.times_s)
        if self.surfaces is None:
            return track
        # The trajectory is split where it leaves the surfaces, so a piece may be too short.
        pieces = follow_surfaces(replace(track, beyond="hold"), support.select(self.surfaces))
        if len(pieces) == 1 and self.beyond == "absent":
            return replace(pieces[0], beyond="absent")
        assert track.start_s is not None  # set by Track.__post_init__
        start = track.start_s
        stop = track.start_s + track.duration_ns / 1e9
        for piece in pieces:
            if piece.times_s[0] <= start + CLOCK_S and stop - CLOCK_S <= piece.times_s[-1]:
                return replace(piece, beyond=track.beyond)
        raise LidarError(
            f"The trajectory leaves the surfaces that it follows ({', '.join(self.surfaces)}). "
            "Shorten it so that it ends on these surfaces."
        )

    def footprint(self, path: ResolvePath) -> Floats:
        """Return horizontal positions along the trajectory during the survey.

        The positions are in world coordinates, in meters, and have shape (n, 2). If the trajectory
        is that of a vehicle in traffic, the array is empty. `path` is a function that returns the
        path of a file in the scenario. Raise LidarError if a file cannot be read.
        """
        if self.vehicle is not None:
            return np.zeros((0, 2))
        track = self._track_without_surfaces(path, np.zeros(3), None)
        assert track.start_s is not None  # set by Track.__post_init__
        stop_s = track.start_s + track.duration_ns / 1e9
        within = (track.start_s <= track.times_s) & (track.times_s <= stop_s)
        ends, _ = track.poses(0, np.array([0.0, track.duration_ns]))
        return np.concatenate([ends, track.positions[within]])[:, :2]

    def _track_without_surfaces(
        self, path: ResolvePath, origin: Floats, start_s: float | None
    ) -> Track:
        """Return the trajectory in local coordinates, without placing it on surfaces.

        Heights are as in the file or pose list.
        """
        options: dict[str, Any] = {
            "smooth": self.interpolation == "smooth",
            "start_s": self.start_s if start_s is None else start_s,
            "duration_s": self.duration_s,
            "beyond": self.beyond,
        }
        if self.file is not None:
            track = load_trajectory(
                path(self.file),
                times=None if self.times is None else path(self.times),
                **self.model_dump(include=_READING_OPTIONS),
                **options,
            )
            return replace(track, positions=track.positions - origin + self.translation)
        angles = [[p.yaw_deg, p.pitch_deg, p.roll_deg] for p in self.points]
        has_angles = any(
            {"yaw_deg", "pitch_deg", "roll_deg"} & p.model_fields_set for p in self.points
        )
        try:
            seconds = seconds_of(np.array([p.time_s for p in self.points]), self.time_unit)
        except ValueError as error:
            raise LidarError(f"points: {error}.") from error
        return Track(
            seconds + self.offset_s,
            np.array([p.position for p in self.points]) - origin + self.translation,
            quaternions_of(rotations_of(np.array(angles))) if has_angles else None,
            **options,
        )


TrajectoryEntry = Annotated[TrajectorySection, accept_text("file", TrajectorySection)]


class JointTable(Section):
    """Joint values of a robot from a table.

    In YAML, the file name alone is sufficient.
    """

    file: Annotated[Text, about("table with a header, relative to the folder of the scenario")]
    time_unit: TimeUnitEntry = None
    ignore: IgnoredColumns = ()


class ActorSection(DeformingSection):
    """A moving or stationary object or robot.

    In the frame of the actor, x points forward and z points up.
    """

    name: Annotated[Text, about("name of the object")]
    file: Annotated[
        MeshEntry | None,
        about(
            "mesh file in the axes of the object, with options as in scene.files, or robot (.urdf)",
            "car.glb",
        ),
    ] = None
    trajectory: Annotated[
        TrajectoryEntry | None,
        about(
            "trajectory, with times of the same clock as the trajectory of the survey; an actor "
            "with neither trajectory nor at is the platform and follows the trajectory of the "
            "survey",
            "van.csv",
        ),
    ] = None
    at: Annotated[
        PoseEntry | None,
        about(
            "pose of a stationary actor, as [x, y, z] or with angles; replaces trajectory",
            [4, 5, 0],
        ),
    ] = None
    spray: Annotated[
        bool,
        about("whether the actor raises spray if weather.spray_g_m3 is set; robots never do"),
    ] = True
    joints: Annotated[
        Annotated[JointTable, accept_text("file", JointTable)] | None,
        about("table with time_s and the joint values of a robot, in radians or meters", "arm.csv"),
    ] = None

    @model_validator(mode="after")
    def _check_actor(self) -> ActorSection:
        """Raise ValueError if fields of an actor or robot cannot be combined."""
        trajectory = self.trajectory
        if trajectory is not None and self.at is not None:
            raise ValueError("`trajectory` and `at` cannot be combined.")
        if trajectory is not None and (
            trajectory.start_s is not None or trajectory.duration_s is not None
        ):
            raise ValueError(
                "An actor starts with the survey, so `start_s` and `duration_s` are not allowed. "
                "To shift its times, set `offset_s`."
            )
        if trajectory is not None and trajectory.vehicle is not None:
            raise ValueError(
                "`trajectory.vehicle` is only allowed in the trajectory of the survey. The "
                "vehicles of `traffic` are already actors."
            )
        if not self.robot and self.joints is not None:
            raise ValueError("`joints` requires a robot. Set `file` to a .urdf file.")
        if self.robot and (self.animation or self.wheels):
            raise ValueError("A robot has joints, so `animation` and `wheels` are not allowed.")
        if self.robot and self.robot.model_fields_set - _ROBOT_FIELDS:
            raise ValueError(
                "The file of a robot is in meters and in the axes of the robot. It can only be "
                "combined with `opacity` and `assets`."
            )
        return self

    @property
    def is_platform(self) -> bool:
        """Whether the actor is the platform, which follows the survey's trajectory."""
        return self.trajectory is None and self.at is None

    @property
    def robot(self) -> MeshFile | None:
        """File of the actor if it describes a robot, or None otherwise."""
        return self.file if self.file and self.file.file.lower().endswith(ROBOTS) else None

    def track(
        self,
        path: ResolvePath,
        support: SupportSurfaces,
        platform_track: Track | None,
        without_angles: dict[str, bool],
    ) -> Track:
        """Return the actor's trajectory from the start of the survey, in local coordinates.

        Parameters
        ----------
        path, support, without_angles
            As for `TrajectorySection.track`.
        platform_track
            Trajectory of the survey, or None if the survey has poses.
        """
        start_s = 0.0 if platform_track is None else platform_track.start_s or 0.0
        if self.at is not None:
            # Two poses define a clock, which the joints of a robot use.
            positions = np.array([self.at.position] * 2) - support.origin
            rotations = quaternions_of(np.array([self.at.rotation_matrix] * 2))
            times = start_s + np.arange(2.0)
            return Track(times, positions, rotations, start_s=start_s, beyond="hold")
        if self.trajectory is None:
            assert platform_track is not None, "guaranteed by the validation of the scenario"
            return platform_track
        with prefix_errors(f"actor {self.name!r}"):
            return self.trajectory.track(
                path, support, start_s, name=self.name, without_angles=without_angles
            )
