"""Surveys, which define the sensors, the trajectory of their platform, and the scans."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import cached_property, partial
from itertools import accumulate
from math import ceil
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import AwareDatetime, Field, Strict

from ..columns.table import (
    COORDINATES,
    OPTIONAL,
    TABLE,
    Column,
    columns_in_parts,
    optional_columns,
    waveform_column,
)
from ..environment.notebook import html_picture, html_table
from ..errors import ArgumentError, LidarError
from ..media.materials import ClassNames, Material, find_class_names_error
from ..media.weather import EXIT_M, FAINTEST, Air, Weather, particle_range
from ..motion.measured_trajectory import MeasuredTrajectory, check_measurable, measured_mount
from ..motion.navigation import Navigation, check_navigation
from ..motion.trajectory import CENTER, Pose, Stations, Trajectory, as_pose, check_trajectory_type
from ..numerics.arrays import Floats, Ints
from ..schema.checks import check_fields, check_type
from ..schema.declared import FILLED_IN, FileSection, Names, Several, about, scenario_type
from ..schema.value_texts import format_value, one_line
from ..schema.vocabulary import OF_THE_WORLD, WORLD_EPSG
from ..sensor.noise import MAX_ALARMS, Noise
from ..sensor.optics import WINDOW_SIGMAS, Precision, Returns
from ..sensor.sensor import Sensor
from ..words import format_rounded, format_scan_counts, join_names, list_names, plural
from .faults import Fault, FaultKind, check_faults

STEPS = 36  # default number of steps per pose, which is one revolution of most sensors
MAX_STEPS = 10_000_000  # maximum number of steps along a trajectory
StepCount = Annotated[int, Field(ge=1, le=MAX_STEPS)]
OPTIONAL_NAMES = tuple(column.in_files for column in OPTIONAL)
MAX_SENSORS = 255  # limit of the column `sensor`
MAX_PARTICLES = 100  # maximum mean number of particles that return light per pulse
MAX_RAYS = 1 << 32  # maximum number of rays in a scan, which is cast in a single call
PRECISION_M = 0.01  # precision of points if the resolution of the sensor is unknown
START_FROM = datetime(2017, 1, 1, tzinfo=UTC)  # start of the current GPS-UTC offset of 18 s
# EPSG code of the world's coordinate system.
EpsgCode = Annotated[int, Field(ge=1024, le=32767)]
MAX_DURATION_NS = 2.0**63  # limit of the column `time`, which is 292 years


_ON_SENSORS = " To load a sensor model, use load_sensor('velodyne/vlp16')."


def nanoseconds(moment: datetime) -> int:
    """Convert a timezone-aware datetime to nanoseconds since 1970-01-01 UTC."""
    return (moment - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1) * 1000


@dataclass(frozen=True)
class Mounted:
    """A sensor mounted on a platform.

    Parameters
    ----------
    sensor
        The lidar.
    mount
        Pose of the sensor in the platform frame.
    name
        Name of the sensor, which is required if there are several sensors. All random numbers of
        the sensor depend on it.
    steps
        Number of time steps at each station. The default is the number in the survey.
    returns, noise
        Returns and noise of this sensor. The defaults are those of the survey, or otherwise those
        of the sensor.
    unseen
        Names of objects that are invisible to the sensor, such as its own housing; * and ? are
        wildcards. Rays pass through these objects.
    """

    sensor: Sensor
    mount: Pose = CENTER
    name: str = ""
    steps: StepCount | None = None
    returns: Returns | None = None
    noise: Noise | None = None
    unseen: Names = ()

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_type("sensor", self.sensor, Sensor, advice=_ON_SENSORS)
        check_fields(self)
        names = (self.unseen,) if isinstance(self.unseen, str) else tuple(self.unseen)
        object.__setattr__(self, "unseen", names)


@dataclass(frozen=True)
class ScanSpec:
    """The firings of a sensor in a single time step.

    Scans are the units that are ordered and delivered exactly once.

    Parameters
    ----------
    scan
        Index of the scan in the survey.
    station
        Index of the station in the `Trajectory`.
    firings
        Half-open range of firing indices, counted from the start of the station.
    start_ns
        Start of the station in nanoseconds since the start of the survey.
    sensor
        Index of the sensor.
    channels
        Number of channels of the sensor.
    random_offset
        Offset that is added to `scan` to obtain the index that selects the random numbers.
    repeats
        For a scan of a frozen sensor, the first scan of the sweep that is repeated, and the first
        scan of the sweep that it replaces.
    """

    scan: int
    station: int
    firings: tuple[int, int]
    start_ns: int = 0
    sensor: int = 0
    channels: int = 1
    random_offset: int = 0
    repeats: tuple[int, int] | None = None

    @property
    def ray_count(self) -> int:
        """Number of rays in this scan."""
        return (self.firings[1] - self.firings[0]) * self.channels

    def with_offsets(self, start_ns: int, random_offset: int) -> ScanSpec:
        """Return a copy with a new station start and a new offset for random numbers."""
        spec = object.__new__(type(self))  # five times as fast as `replace`
        vars(spec).update(vars(self), start_ns=start_ns, random_offset=random_offset)
        return spec


@dataclass(frozen=True, kw_only=True)
class CloudOptions(FileSection):
    """Options that select the points of a cloud and their columns.

    In Python, `columns` may also contain user-defined `Column` objects.
    """

    keep_every: Annotated[
        int,
        FILLED_IN,
        about(
            "keep only every n-th hit of a scan (default: every hit)",
            5,
            ge=1,
            le=1_000_000,
        ),
    ] = None  # type: ignore[assignment]
    precision_m: Annotated[
        Precision,
        FILLED_IN,
        about(
            "precision in meters to which coordinates are rounded (default: range resolution of "
            "the sensor, otherwise 0.001, or 0.01 in Python)",
            0.001,
        ),
    ] = None  # type: ignore[assignment]
    coordinates: Annotated[
        Literal[COORDINATES],  # type: ignore[valid-type]
        about(
            "frame of the coordinates: world, or sensor for the sensor frame at the time of firing"
        ),
    ] = "world"
    georeferencing: Annotated[
        Literal["exact", "measured"],
        about(
            "trajectory and mounts that transform points to world coordinates: exact, or measured "
            "with the errors in `navigation`"
        ),
    ] = "exact"
    columns: Annotated[
        Sequence[str | Column],
        scenario_type(Several[Literal[(*OPTIONAL_NAMES, *TABLE)]]),  # includes the default columns
        about(
            "columns in addition to x, y, z, scan, channel and object: "
            + ", ".join(OPTIONAL_NAMES),
            ["time", "range", "intensity"],
        ),
    ] = ()
    actor_visibility: Annotated[
        bool,
        about(
            "whether to determine the visible fraction, the truncation and the distance from the "
            "nearest ray for the box of each actor in each sweep"
        ),
    ] = False
    waveform_samples: Annotated[
        int,
        about(
            "number of waveform samples to record around each return, for LAS and LAZ; 0 for none",
            80,
            ge=0,
            le=4096,
        ),
    ] = 0
    start: Annotated[
        datetime | None,
        scenario_type(Annotated[AwareDatetime, Strict(False)] | None),
        about(
            "start time of the survey with a time zone, for LAS, LAZ and bags",
            "2026-11-21T10:00:00Z",
        ),
    ] = None

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)


class SensorSweeps(NamedTuple):
    """Sweeps of one sensor in a survey."""

    firsts: Ints  # (s,), index of the first scan
    starts_ns: Floats  # (s,), start of the first firing since the start of the survey
    stops_ns: Floats  # (s,), start of the last firing since the start of the survey


@dataclass(frozen=True)
class Survey(CloudOptions, Weather):
    """A simulated survey of a scene with one or more sensors on a platform.

    Scans are ordered by sensor: all scans of a sensor, in time order, come before the scans of the
    next sensor. Use the column `time` to find simultaneous points.

    With several sensors, the cloud always contains the column `sensor`. Without materials, all
    objects scatter half of the light.

    Parameters
    ----------
    sensor
        The lidar, if there is a single sensor without a mount.
    poses
        Consecutive poses of the sensor or platform, each as a `Pose` or as x, y, z.
    steps
        Number of time steps at each pose. The default is 36. Along a `Track`, the default covers
        its entire duration.
    trajectory
        Trajectory of a moving platform, as an alternative to `poses`.
    sensors
        `Mounted` sensors, as an alternative to `sensor`. Several sensors must have different names.
    materials
        Materials of objects or of individual faces. Faces are selected by the names of their
        materials in the scene file. If several entries apply to a face, the first one is used.
    returns
        Sub-rays of each beam, and the returns that are reported for each pulse. The default is that
        of the sensor.
    noise
        Noise of ranges and angles, and lost returns. The default is that of the sensor.
    navigation
        IMU and GNSS receiver of the platform, whose samples are written to files next to the cloud.
        With `georeferencing="measured"`, the points contain their errors and those of the mounts.
    faults
        Sensor faults, such as dirt or lost packets.
    classes
        Mapping from numbers to names of semantic classes, for reports and files. If it is set, the
        cloud contains the column `class`.
    epsg
        EPSG code of the world coordinates, which is written to files that support it. To place a
        scene with local coordinates in the world, use `Scene.with_world_origin`.
    **options
        Fields of `Weather` and `CloudOptions`, such as `rain_mm_h` and `keep_every`.

    Raises
    ------
    LidarError
        If a number is out of range, poses are missing, a column is unknown, or the trajectory is
        too short.

    Examples
    --------
    >>> survey = Survey(Sensor.grid(), poses=[(0, 0, 1), (0, 0, 2), (0, 0, 3)])
    >>> survey.scan_count, survey.ray_count
    (108, 120000)
    """

    sensor: Sensor = field(default_factory=Sensor.grid)
    poses: Sequence[Any] = ()
    steps: StepCount | None = None
    trajectory: Trajectory | None = None
    sensors: Sequence[Mounted] = ()
    materials: Sequence[Material] = ()
    returns: Annotated[Returns, FILLED_IN] = None  # type: ignore[assignment]
    noise: Annotated[Noise, FILLED_IN] = None  # type: ignore[assignment]
    navigation: Navigation | None = None
    faults: Sequence[Fault] = ()
    classes: ClassNames = field(default_factory=dict, compare=False)
    epsg: EpsgCode | None = None

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_type("sensor", self.sensor, Sensor, advice=_ON_SENSORS)
        check_fields(self)
        check_type("classes", self.classes, Mapping)
        if problem := find_class_names_error(self.classes):
            raise ArgumentError(f"classes: {problem}")
        if self.trajectory is not None:
            check_trajectory_type("trajectory", self.trajectory)
        self._set(poses=_poses(self.poses), sensors=tuple(self.sensors))
        self._set(trajectory=self._trajectory(), materials=tuple(self.materials))
        self._check_names()
        self._fill_in("returns", Returns())
        self._fill_in("noise", Noise())
        if self.sensors:
            self._set(sensor=self.sensors[0].sensor)
        added = {"sensor": len(self.sensors) > 1, "class": self.classes}
        columns = (*self.columns, *(name for name, present in added.items() if present))
        self._set(columns=optional_columns(columns), classes=dict(sorted(self.classes.items())))
        finest = min(
            mounted.sensor.optics.resolution_m or PRECISION_M for mounted in self.mounted_sensors
        )
        for name, default in {"keep_every": 1, "precision_m": finest}.items():
            if getattr(self, name) is None:
                self._set(**{name: default})
        self._check_values()
        if self.steps is None and self.path.duration_ns == float("inf"):
            self._set(steps=STEPS)
        for carried, steps in zip(self.mounted_sensors, self.steps_each, strict=True):
            self._check_duration(carried.sensor, steps)
        sensors = {carried.name: carried.sensor for carried in self.mounted_sensors}
        check_faults(self.faults, sensors, self.duration_ns)

    def _repr_html_(self) -> str:
        """Return an HTML table of the main properties, with an image if a package can draw it."""
        models = [
            f"{carried.name}: {carried.sensor.model}" if carried.name else carried.sensor.model
            for carried in self.mounted_sensors
        ]
        poses = plural(self.path.stations, "position")
        if self.path.moves:
            poses = "along a trajectory"
        rows = {
            "survey": f"{plural(len(models), 'sensor')}: {list_names(models, 8)}",
            "poses": poses,
            "scans": format_scan_counts(self.scan_count, self.sweep_count),
            "rays": f"{self.ray_count:,}",
            "duration": f"{self.duration_ns / 1e9:.6g} s",
            "columns": ", ".join(column.name for column in self.stored_columns),
        }
        return html_table(rows.items()) + html_picture(self)

    def _fill_in(self, name: str, default: Returns | Noise) -> None:
        """Fill in unset returns or noise with those of the sensors or with the default."""
        if getattr(self, name) is not None:
            return
        if self.sensors:
            sensors = [
                replace(mounted, **{name: getattr(mounted, name) or getattr(mounted.sensor, name)})
                for mounted in self.sensors
            ]
            self._set(sensors=tuple(sensors))
        else:
            default = getattr(self.sensor, name) or default
        self._set(**{name: default})

    def _set(self, **fields: Any) -> None:
        """Set fields even though the survey is frozen."""
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    def _trajectory(self) -> Trajectory:
        """Return the trajectory, or create stations from the poses.

        Raise LidarError if both or neither are set.
        """
        if self.trajectory is None:
            if not self.poses:
                raise LidarError("A survey requires at least one pose.")
            return Stations(tuple(self.poses))
        if self.poses and self.trajectory != Stations(tuple(self.poses)):
            raise LidarError("poses and a trajectory cannot be combined.")
        return self.trajectory

    def _check_names(self) -> None:
        """Check the number of sensors, and that their names are unique."""
        names = [carried.name for carried in self.sensors]
        if len(names) > MAX_SENSORS or len({*names}) < len(names):
            raise LidarError(
                f"A survey supports at most {MAX_SENSORS} sensors, each with a unique name. "
                f"The names are {join_names(names[:10])}."
            )

    def _check_values(self) -> None:
        """Check that the options are compatible with each other and with the sensors."""
        if self.epsg in WORLD_EPSG:
            raise LidarError(f"epsg is {self.epsg}, {OF_THE_WORLD}.")
        self._check_navigation()
        if self.start is not None and (self.start.tzinfo is None or self.start < START_FROM):
            raise LidarError(
                "start must be a time from 2017 on with its time zone, such as "
                f"2026-11-21T10:00:00Z, but is {self.start}."
            )
        for carried, returns in zip(self.mounted_sensors, self.returns_each, strict=True):
            returns.divergence(carried.sensor.optics)  # raises LidarError if it is unknown
            self._check_waveform(carried.sensor, returns)
        for number, noise in enumerate(self.noise_each):
            _check_noise(noise, self.mounted_sensors[number].sensor)
            if noise.crosstalk:
                self._check_crosstalk(number)
        if self.spray_g_m3 and not self.wet:
            raise LidarError("spray_g_m3 requires wet ground. Set wet to a value above 0.")
        if self.rain_mm_h or self.snow_mm_h or self.dust_mg_m3 or self.spray_g_m3:
            for number in range(len(self.mounted_sensors)):
                self._check_air(number)

    def _check_navigation(self) -> None:
        """Check that instruments and a measured trajectory can be simulated."""
        if self.georeferencing == "measured":
            check_measurable(self.navigation)
        if self.navigation is not None:
            check_navigation(self.navigation, self.path, self.epsg)

    def _check_waveform(self, sensor: Sensor, returns: Returns) -> None:
        """Check that the waveform samples are suitable for a sensor's pulse and for LAS files."""
        if returns.waveform != "none" or self.waveform_samples:
            sigma_ns = returns.system_ns(sensor.optics)
            min_samples = ceil(WINDOW_SIGMAS * sigma_ns / returns.sample_ns) + 2
            if 0 < self.waveform_samples < min_samples:
                raise LidarError(
                    f"waveform_samples must be at least {min_samples}, the number of samples of "
                    f"{returns.sample_ns:g} ns in one echo, but is {self.waveform_samples}."
                )
        if self.waveform_samples and abs(returns.sample_ns * 1000 % 1 - 0.5) < 0.5 - 1e-6:
            raise LidarError(
                f"returns.sample_ns is {returns.sample_ns:g}, but LAS stores sample times in whole "
                f"picoseconds. Set it to {round(returns.sample_ns, 3):g} to record "
                "waveform_samples."
            )

    def _check_crosstalk(self, number: int) -> None:
        """Check that crosstalk to a sensor can be simulated.

        Crosstalk requires several sensors, a maximum range for each of them, and the divergence of
        the affected sensor.
        """
        if len(self.mounted_sensors) == 1:
            raise LidarError(
                "noise.crosstalk requires at least two sensors, but this survey has one."
            )
        for carried in self.mounted_sensors:
            if not carried.sensor.max_range_m < float("inf"):
                raise LidarError(
                    f"noise.crosstalk requires a maximum range, but {carried.name} has none. Set "
                    "its max_range_m."
                )
        if not self.returns_each[number].divergence(self.mounted_sensors[number].sensor.optics):
            raise LidarError(
                "noise.crosstalk requires the beam divergence, but "
                f"{self.mounted_sensors[number].name} has none. Set returns.divergence_mrad."
            )

    def _check_air(self, number: int) -> None:
        """Check that a sensor's returns from the air can be simulated and are not too numerous."""
        carried = self.mounted_sensors[number]
        sensor = carried.sensor
        name = f" of {carried.name}" if carried.name else ""
        if self.noise_each[number].detection_range_m is None:
            missing = "is not set" if carried.noise is None else "is not in its data sheet"
            guess_m = sensor.max_range_m / 2 if sensor.max_range_m < np.inf else 100
            guess = f"{float(f'{guess_m:.3g}'):g}"  # avoids 1e+03, which YAML reads as a string
            raise LidarError(
                f"Returns from rain, snow, spray or dust require noise.detection_range_m{name}, "
                f"the range at 10 % reflectance, which {missing}. Set it, or use half of the "
                f"maximum range of the sensor: `noise: {{detection_range_m: {guess}}}`."
            )
        divergences = (self.returns_each[number].divergence_mrad, sensor.optics.divergence_mrad)
        if (self.particles or self.spray_g_m3) and divergences == (None, None):
            raise LidarError(
                f"Rain, snow and spray require the beam divergence{name}. Set "
                "returns.divergence_mrad."
            )
        if (particle_count := self.mean_particles(number)) > MAX_PARTICLES:
            raise LidarError(
                f"A pulse{name} would return from {particle_count:,.0f} drops or flakes, but the "
                f"limit is {MAX_PARTICLES}. Reduce rain_mm_h, snow_mm_h or noise.detection_range_m."
            )

    def _check_duration(self, sensor: Sensor, steps: int) -> None:
        """Check that the time steps of a sensor fit into the trajectory and exceed no limit."""
        needed_s = _last_firing_ns(sensor, steps) / 1e9
        available_s = self.path.duration_ns / 1e9
        if needed_s > available_s:
            raise LidarError(
                f"{steps} steps end at {needed_s:.6g} s, which is {needed_s - available_s:.6g} s "
                f"after the end of the trajectory ({available_s:.6g} s). Reduce steps, or omit it "
                "to use the whole trajectory."
            )
        first, stop = sensor.firings(0)
        if (rays := (stop - first) * sensor.channels) > MAX_RAYS:
            raise LidarError(
                f"A scan would have {rays:,} rays, but the limit is {MAX_RAYS:,}. Reduce step_deg "
                "or the number of rays."
            )
        duration_ns = firing_start_ns(sensor, sensor.firings(steps - 1)[1]) * self.path.stations
        if not duration_ns < MAX_DURATION_NS:
            raise LidarError(
                f"The survey would last {format_rounded(duration_ns / 1e9)} s, but times in "
                "nanoseconds are limited to 292 years. Increase rate_hz, or reduce start_s or "
                "steps."
            )

    @cached_property
    def path(self) -> Trajectory:
        """Trajectory of the platform, which has one station per pose if `poses` is set."""
        assert self.trajectory is not None  # set in __post_init__
        return self.trajectory

    @cached_property
    def measured(self) -> MeasuredTrajectory | None:
        """Trajectory with which points are georeferenced, or None if it is the true trajectory."""
        return MeasuredTrajectory.from_drive(self) if self.georeferencing == "measured" else None

    @property
    def reported_path(self) -> Trajectory:
        """Trajectory of the platform as reported with the points, either measured or true."""
        return self.path if self.measured is None else self.measured

    @cached_property
    def reported_mounts(self) -> tuple[Pose, ...]:
        """Mount of each sensor as reported with the points, either calibrated or true."""
        mounts = tuple(mounted.mount for mounted in self.mounted_sensors)
        if self.measured is None or self.navigation is None:
            return mounts
        error = self.navigation.mount_error
        return tuple(measured_mount(mount, error) for mount in mounts)

    @cached_property
    def mounted_sensors(self) -> tuple[Mounted, ...]:
        """Mounted sensors, including one that was passed as `sensor`."""
        return tuple(self.sensors) or (Mounted(self.sensor),)

    @property
    def platform_name(self) -> str:
        """Name of the first sensor, which determines the seeds of the platform's instruments."""
        return self.mounted_sensors[0].name

    @cached_property
    def returns_each(self) -> tuple[Returns, ...]:
        """Settings for the returns of each sensor."""
        return tuple(carried.returns or self.returns for carried in self.mounted_sensors)

    @cached_property
    def noise_each(self) -> tuple[Noise, ...]:
        """Noise of each sensor, with a seed that depends on the name of the sensor."""
        return tuple(
            (carried.noise or self.noise).for_sensor(carried.name)
            for carried in self.mounted_sensors
        )

    @cached_property
    def stored_columns(self) -> tuple[Column, ...]:
        """All columns that a run stores."""
        columns = columns_in_parts(optional_columns(self.columns))
        if self.waveform_samples:
            columns = (*columns, waveform_column(self.waveform_samples))
        return columns

    def extinction(self, sensor: Sensor) -> float:
        """Return the extinction coefficient of the air at a sensor's wavelength, in 1/m."""
        return self.extinction_at(sensor.optics.simulated_nm)

    def air(self, number: int) -> Air:
        """Return the properties of the air for the sensor with the given index."""
        optics = self.mounted_sensors[number].sensor.optics
        divergence = self.returns_each[number].divergence(optics)
        overlap_m = self.noise_each[number].overlap_m
        exit_m = self.returns_each[number].exit_m(optics) or EXIT_M
        return Air(self.extinction_at(optics.simulated_nm), exit_m, divergence, overlap_m)

    def mean_particles(self, number: int) -> float:
        """Return the mean number of drops and flakes per pulse that can cause a return."""
        if not self.particles:
            return 0.0
        sensor = self.mounted_sensors[number].sensor
        min_energy = FAINTEST * self.noise_each[number].threshold
        air = self.air(number)
        span = particle_range(sensor.min_range_m, sensor.max_range_m)
        return sum(air.mean_particles(kind, min_energy, *span) for kind in self.particles)

    @cached_property
    def steps_each(self) -> tuple[int, ...]:
        """Number of time steps of each sensor per station."""
        counts = []
        for carried in self.mounted_sensors:
            if steps := carried.steps or self.steps:
                counts.append(steps)
                continue
            candidates = range(1, MAX_STEPS + 2)
            end_ns = partial(_last_firing_ns, carried.sensor)
            counts.append(bisect_right(candidates, self.path.duration_ns, key=end_ns))
            if counts[-1] > MAX_STEPS:
                raise LidarError(
                    f"The trajectory lasts {self.path.duration_ns / 1e9:.6g} s, but a survey is "
                    f"limited to {MAX_STEPS:,} time steps, which take "
                    f"{end_ns(MAX_STEPS) / 1e9:.6g} s. Set duration_s or steps to use a part of "
                    "it, or increase step_deg."
                )
            if not counts[-1]:
                raise LidarError(
                    f"The trajectory lasts {self.path.duration_ns / 1e9:.6g} s, but the first time "
                    f"step of the sensor ends at {end_ns(1) / 1e9:.6g} s. Use a longer trajectory."
                )
        return tuple(counts)

    @cached_property
    def _firsts(self) -> list[int]:
        """Index of the first scan of each sensor, followed by the number of scans."""
        return [0, *accumulate(steps * self.path.stations for steps in self.steps_each)]

    @property
    def scan_count(self) -> int:
        """Number of scans."""
        return self._firsts[-1]

    @cached_property
    def sweeps_each(self) -> tuple[SensorSweeps, ...]:
        """First scan, start time and end time of each sensor's sweeps."""
        sweeps = []
        stations = np.arange(self.path.stations)[:, None]
        for number, carried in enumerate(self.mounted_sensors):
            sensor = carried.sensor
            steps = self.steps_each[number]
            base = self._firsts[number]
            firsts = np.flatnonzero(np.diff(sensor.revolutions(np.arange(steps)), prepend=-1))
            first_firings = [sensor.firings(step)[0] for step in firsts.tolist()]
            last_firings = [
                sensor.firings(step - 1)[1] - 1 for step in [*firsts[1:].tolist(), steps]
            ]
            starts_ns = sensor.begins_ns(np.array(first_firings)) + sensor.lead_ns
            stops_ns = sensor.begins_ns(np.array(last_firings)) + sensor.lead_ns
            sweeps.append(
                SensorSweeps(
                    (base + stations * steps + firsts).ravel(),
                    (stations * self.station_ns + starts_ns).ravel(),
                    (stations * self.station_ns + stops_ns).ravel(),
                )
            )
        return tuple(sweeps)

    @cached_property
    def sweep_stops(self) -> Ints:
        """Index one past the last scan of each sweep, in ascending order.

        The shape is (sweeps,), and the dtype is int64.
        """
        firsts = np.concatenate([sweeps.firsts for sweeps in self.sweeps_each])
        return np.append(firsts[1:], self.scan_count)

    @property
    def sweep_count(self) -> int:
        """Number of sweeps, which are revolutions or, for sensors without a rotating head, frames.

        The last sweep of a sensor at a station can be incomplete.
        """
        return sum(len(sweeps.firsts) for sweeps in self.sweeps_each)

    def sweeps_within(self, start: int, stop: int) -> int:
        """Return the number of sweeps that end within a range of scans."""
        before, until = np.searchsorted(self.sweep_stops, (start, stop), "right")
        return int(until - before)

    @property
    def ray_count(self) -> int:
        """Number of rays in all scans."""
        rays = (
            carried.sensor.firings(steps - 1)[1] * carried.sensor.channels
            for carried, steps in zip(self.mounted_sensors, self.steps_each, strict=True)
        )
        return self.path.stations * sum(rays)

    @cached_property
    def station_ns(self) -> int:
        """Time that all sensors need to finish their scans at a station, in nanoseconds."""
        return max(
            round(firing_start_ns(carried.sensor, carried.sensor.firings(steps - 1)[1]))
            for carried, steps in zip(self.mounted_sensors, self.steps_each, strict=True)
        )

    @property
    def duration_ns(self) -> float:
        """Time from the start of the survey to the start of the last firing, in nanoseconds."""
        pairs = zip(self.mounted_sensors, self.steps_each, strict=True)
        last = max(_last_firing_ns(carried.sensor, steps) for carried, steps in pairs)
        return (self.path.stations - 1) * self.station_ns + last

    def scan(self, index: int) -> ScanSpec:
        """Return the scan with the given index.

        Scans are ordered by sensor, station and step.
        """
        sensor = bisect_right(self._firsts, index) - 1
        station, step = divmod(index - self._firsts[sensor], self.steps_each[sensor])
        lidar = self.mounted_sensors[sensor].sensor
        start = station * self.station_ns
        return ScanSpec(index, station, lidar.firings(step), start, sensor, lidar.channels)

    def sensor_faults(self, sensor: int, *kinds: FaultKind) -> dict[int, Fault]:
        """Return the faults of the given kinds that affect a sensor.

        The keys are indices into `faults`.
        """
        name = self.mounted_sensors[sensor].name
        return {
            index: fault
            for index, fault in enumerate(self.faults)
            if fault.kind in kinds and fault.sensor in (None, name)
        }

    def sent_scan(self, index: int) -> ScanSpec:
        """Return the scan that a sensor sends as scan `index`, which may be an older scan.

        A frozen sensor repeats older scans: a sweep that starts while the sensor is frozen repeats
        the last sweep that started before the fault. The repeated scan depends only on times, so
        every worker selects the same scan.
        """
        spec = self.scan(index)
        frozen = self.sensor_faults(spec.sensor, "frozen").values()
        if not frozen:
            return spec
        firsts, starts_ns, _ = self.sweeps_each[spec.sensor]
        sweep = int(np.searchsorted(firsts, index, "right")) - 1
        source = sweep
        while active := [fault for fault in frozen if fault.is_active(starts_ns[source])]:
            source = int(np.searchsorted(starts_ns, active[0].from_s * 1e9)) - 1
        if source == sweep:
            return spec
        # The repeated sweep may have fewer scans if it is the last at a pose. `LossStep` then drops
        # the returns of the surplus scans.
        older = min(int(firsts[source] + index - firsts[sweep]), int(firsts[source + 1]) - 1)
        repeats = int(firsts[source]), int(firsts[sweep])
        return replace(self.scan(older), scan=index, random_offset=older - index, repeats=repeats)

    def scans(self) -> Iterator[ScanSpec]:
        """Return an iterator over all scans in order."""
        return (self.scan(index) for index in range(self.scan_count))

    def pose(self, index: int) -> Pose:
        """Return the pose of the sensor at the start of a scan."""
        spec = self.scan(index)
        time = self.begins_ns(index) - spec.start_ns
        return self.path.pose(spec.station, time).compose(self.mounted_sensors[spec.sensor].mount)

    def begins_ns(self, index: int) -> float:
        """Return the start time of a scan in nanoseconds since the start of the survey."""
        spec = self.scan(index)
        sensor = self.mounted_sensors[spec.sensor].sensor
        return spec.start_ns + firing_start_ns(sensor, spec.firings[0]) + sensor.lead_ns


def _check_noise(noise: Noise, sensor: Sensor) -> None:
    """Check that the noise suits a sensor and does not cause too many false alarms."""
    biases = noise.channel_bias_m
    channels = sensor.channels
    if isinstance(biases, Sequence) and len(biases) != channels:
        raise LidarError(
            f"noise.channel_bias_m must have one value for each of the {channels} channels of "
            f"{sensor.model}, or be their standard deviation, but has {len(biases)} values."
        )
    if noise.ripple_deg and sensor.spins(np.zeros(1, np.int64)) is None:
        raise LidarError(
            "noise.ripple_deg requires a sensor with a rotating head, but the head of "
            f"{sensor.model} does not rotate."
        )
    if noise.false_alarm_hz and not sensor.gate_s < float("inf"):
        raise LidarError(
            f"noise.false_alarm_hz requires a maximum range, but {sensor.model} has none. Set "
            "max_range_m."
        )
    if noise.false_alarm_hz and (mean := noise.false_alarm_hz * sensor.gate_s) > MAX_ALARMS:
        raise LidarError(
            f"noise.false_alarm_hz is {noise.false_alarm_hz:g}, which causes "
            f"{format_rounded(mean)} false alarms per pulse, but the limit is {MAX_ALARMS}. Reduce "
            "it, or reduce max_range_m."
        )


def firing_start_ns(sensor: Sensor, firing: int) -> float:
    """Return the start time of a firing in nanoseconds since the start of the station."""
    return float(sensor.begins_ns(np.array([firing], np.int64))[0])


def _last_firing_ns(sensor: Sensor, steps: int) -> float:
    """Return the start time of the last firing in the first `steps` time steps.

    The time is in nanoseconds since the start of the station.
    """
    return firing_start_ns(sensor, sensor.firings(steps - 1)[1] - 1) + sensor.lead_ns


def _poses(poses: Sequence[Any]) -> tuple[Pose, ...]:
    """Convert positions to poses. Raises LidarError if `poses` is not a list."""
    if isinstance(poses, str) or not isinstance(poses, Iterable):
        raise LidarError(
            f"poses must be a list of poses, such as [(0, 0, 1)], but is {format_value(poses)}."
        )
    return tuple(as_pose("poses", pose) for pose in poses)
