"""A survey: sensors on a carrier, its trajectory, and the resulting scans."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import cached_property, partial
from itertools import accumulate
from math import ceil
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AwareDatetime, Field, Strict

from ..base.arrays import Floats, Ints
from ..base.declared import FILLED_IN, Several, about, written_as
from ..base.errors import LidarError
from ..base.validation import checked_fields, shown
from ..columns.table import (
    COORDINATES,
    OPTIONAL,
    TABLE,
    Column,
    optional_columns,
    stored,
    waveform_column,
)
from .faults import Fault, FaultKind, check_faults
from .materials import ClassNames, Material
from .navigation import Navigation, check_navigation
from .noise import ALARMS_MOST, Noise
from .optics import WINDOW_SIGMAS, Precision, Returns
from .sensor import Sensor
from .trajectory import CENTRE, Pose, Stations, Trajectory, pose_of
from .weather import EXIT_M, FAINTEST, Air, Weather, reach

STEPS = 36  # default at each pose: one turn of most sensors
STEPS_MOST = 10_000_000  # along a trajectory
StepCount = Annotated[int, Field(ge=1, le=STEPS_MOST)]
OPTIONAL_NAMES = tuple(column.in_files for column in OPTIONAL)
SENSORS_MOST = 255  # the type of the column
PARTICLES_MOST = 100  # that a pulse may return from
RAYS_MOST = 1 << 32  # of a scan, which is cast in one call
PRECISION_M = 0.01  # of points, if a sensor states no resolution
START_FROM = datetime(2017, 1, 1, tzinfo=UTC)  # since when GPS and UTC have been 18 s apart
LASTS_MOST_NS = 2.0**63  # the type of the column time: 292 years


def nanoseconds(when: datetime) -> int:
    """Nanoseconds from 1970-01-01 UTC to a time with a time zone."""
    return (when - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1) * 1000


@dataclass(frozen=True)
@checked_fields
class Mounted:
    """A sensor on a carrier.

    Parameters
    ----------
    sensor
        The lidar.
    mount
        Its pose in the carrier's axes.
    name
        Its name, needed if there are several; part of all its random numbers.
    steps
        Time steps from each station; by default those of the survey.
    returns, noise
        Its own; by default those of the survey, if it gives them, else those of the sensor.
    """

    sensor: Sensor
    mount: Pose = CENTRE
    name: str = ""
    steps: StepCount | None = None
    returns: Returns | None = None
    noise: Noise | None = None


@dataclass(frozen=True)
class ScanSpec:
    """The firings of one time step of a sensor: the unit of ordering and exactly-once delivery.

    Parameters
    ----------
    scan
        Its number in the survey.
    station
        Station of the trajectory, see `Trajectory`.
    firings
        Half-open range of firings, counted from the start of the station.
    start_ns
        Start of the station, nanoseconds since the survey's start.
    sensor
        Number of its sensor.
    channels
        Of that.
    ahead
        By how many scans its random numbers are ahead of its number.
    repeats
        Of a frozen sensor: the first scan of the sweep that it sends again, and of its own.
    """

    scan: int
    station: int
    firings: tuple[int, int]
    start_ns: int = 0
    sensor: int = 0
    channels: int = 1
    ahead: int = 0
    repeats: tuple[int, int] | None = None

    @property
    def ray_count(self) -> int:
        """Rays in this scan."""
        return (self.firings[1] - self.firings[0]) * self.channels


@dataclass(frozen=True, kw_only=True)
@checked_fields
class CloudOptions:
    """Which hits become points, and their columns.

    In Python a column may also be your own `Column`.
    """

    keep_every: Annotated[
        int,
        FILLED_IN,
        about(
            "keep every n-th hit of a scan; by default every hit, of a scene with the "
            "default objects every 5th",
            5,
            ge=1,
            le=1_000_000,
        ),
    ] = None  # type: ignore[assignment]
    precision_m: Annotated[
        Precision,
        FILLED_IN,
        about(
            "step in metres that points are rounded to; by default the sensor's resolution of "
            "ranges; if it states none 0.001, with the default objects and in Python 0.01",
            0.001,
        ),
    ] = None  # type: ignore[assignment]
    coordinates: Annotated[
        Literal[COORDINATES],  # type: ignore[valid-type]
        about("world; or sensor: its axes when it fired, as sensor drivers have them"),
    ] = "world"
    columns: Annotated[
        Sequence[str | Column],
        written_as(Several[Literal[(*OPTIONAL_NAMES, *TABLE)]]),  # those always there, too
        about(
            "columns in addition to x, y, z, scan, channel and object: "
            + ", ".join(OPTIONAL_NAMES),
            ["time", "range", "intensity"],
        ),
    ] = ()
    waveform_samples: Annotated[
        int,
        about(
            "samples of the waveform that are recorded around each return, for LAS and "
            "LAZ; 0 for none",
            80,
            ge=0,
            le=4096,
        ),
    ] = 0
    epsg: Annotated[
        int | None,
        about(
            "EPSG code of the world's coordinate system, for LAS and LAZ, that rasters "
            "are brought to; by default theirs",
            25832,
            ge=1024,
            le=32767,
        ),
    ] = None
    start: Annotated[
        datetime | None,
        written_as(Annotated[AwareDatetime, Strict(False)] | None),
        about(
            "when the survey starts, with its time zone, for LAS, LAZ and bags",
            "2026-11-21T10:00:00Z",
        ),
    ] = None


@dataclass(frozen=True)
@checked_fields
class Survey(CloudOptions, Weather):
    """All scans of a carrier's sensors.

    Scans of a sensor are in time order, and all scans of one sensor come before those of the next,
    so that a batch is one cast, and each part belongs to one sensor or two. The column `time`
    shows which points are simultaneous.

    Several sensors always have the column `sensor`. Without materials, all objects scatter half of
    the light.

    Parameters
    ----------
    sensor
        The lidar, if there is one without a carrier.
    poses
        Its poses one after the other: `Pose`, or x, y, z.
    steps
        Time steps from each pose, 36 by default; along a `Track` by default as many as it lasts.
    trajectory
        Instead of `poses`, if the carrier moves.
    sensors
        Instead of `sensor`: `Mounted`, each with its own name if there are several.
    materials
        Materials of objects, and of faces by the names of their materials; the first entry for a
        face counts.
    returns
        Sub-rays of a beam, and which returns of a pulse are reported; by default the sensor's.
    noise
        Noise of ranges and angles, and lost returns; by default the sensor's.
    navigation
        IMU and GNSS receiver of the carrier, whose samples are written beside the cloud.
    faults
        Faults of sensors, such as dirt or lost packets.
    classes
        Names of semantic classes, {number: name}, for reports and files; they add the column.
    **options
        The fields of `Weather` and `CloudOptions`, such as `rain_mm_h` and `keep_every`.

    Raises
    ------
    LidarError
        If a number is out of range, there is no pose, or no such column, or if the trajectory
        does not last long enough.

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

    def __post_init__(self) -> None:
        self._set(poses=_poses(self.poses), sensors=tuple(self.sensors))
        self._set(trajectory=self._trajectory(), materials=tuple(self.materials))
        self._check_names()
        for name, kind in (("returns", Returns), ("noise", Noise)):
            if getattr(self, name) is None:
                owns = [getattr(one, name) or getattr(one.sensor, name) for one in self.sensors]
                each = zip(self.sensors, owns, strict=True)
                self._set(sensors=tuple(replace(one, **{name: own}) for one, own in each))
                self._set(**{name: (not owns and getattr(self.sensor, name)) or kind()})
        if self.sensors:
            self._set(sensor=self.sensors[0].sensor)
        extra = {"sensor": len(self.sensors) > 1, "class": self.classes}
        columns = (*self.columns, *(name for name, needed in extra.items() if needed))
        self._set(columns=optional_columns(columns), classes=dict(sorted(self.classes.items())))
        finest = min(one.sensor.optics.resolution_m or PRECISION_M for one in self.carried)
        for name, default in {"keep_every": 1, "precision_m": finest}.items():
            if getattr(self, name) is None:
                self._set(**{name: default})
        self._check_values()
        if self.steps is None and self.path.duration_ns == float("inf"):
            self._set(steps=STEPS)
        for carried, steps in zip(self.carried, self.steps_each, strict=True):
            self._check_duration(carried.sensor, steps)
        sensors = {carried.name: carried.sensor for carried in self.carried}
        check_faults(self.faults, sensors, self.duration_ns)

    def _set(self, **fields: Any) -> None:
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    def _trajectory(self) -> Trajectory:
        if self.trajectory is None:
            if not self.poses:
                raise LidarError("A survey needs at least one pose to scan from.")
            return Stations(tuple(self.poses))
        if self.poses and self.trajectory != Stations(tuple(self.poses)):
            raise LidarError("A survey has either poses or a trajectory, not both.")
        return self.trajectory

    def _check_names(self) -> None:
        names = [carried.name for carried in self.sensors]
        if len(names) > SENSORS_MOST or len({*names}) < len(names):
            raise LidarError(
                f"A survey has at most {SENSORS_MOST} sensors, each with a name of its own; given: "
                f"{', '.join(names[:10])}."
            )

    def _check_values(self) -> None:
        if self.navigation is not None:
            check_navigation(self.navigation, self.path, self.epsg)
        if self.start is not None and (self.start.tzinfo is None or self.start < START_FROM):
            raise LidarError(
                f"start is {self.start}; it must be a time from 2017 on, with its time zone: "
                "2026-11-21T10:00:00Z."
            )
        for carried, returns in zip(self.carried, self.returns_each, strict=True):
            returns.of(carried.sensor.optics)  # LidarError if they do not fit together
            if returns.waveform != "none" or self.waveform_samples:
                sigma_ns = returns.system_ns(carried.sensor.optics)
                least = ceil(WINDOW_SIGMAS * sigma_ns / returns.sample_ns) + 2
                if 0 < self.waveform_samples < least:
                    raise LidarError(
                        f"waveform_samples is {self.waveform_samples}, and one echo takes {least} "
                        f"samples of {returns.sample_ns:g} ns: record as many at least."
                    )
            if self.waveform_samples and abs(returns.sample_ns * 1000 % 1 - 0.5) < 0.5 - 1e-6:
                raise LidarError(
                    f"returns.sample_ns is {returns.sample_ns:g}, and LAS records whole "
                    f"picoseconds: with waveform_samples, give {round(returns.sample_ns, 3):g}."
                )
        for number, noise in enumerate(self.noise_each):
            _check_noise(noise, self.carried[number].sensor)
            if noise.crosstalk:
                self._check_crosstalk(number)
        if self.spray_g_m3 and not self.wet:
            raise LidarError(
                "spray_g_m3 is of wheels on wet ground, and none is: give wet as well, 0 to 1."
            )
        if self.returns_light or self.spray_g_m3:
            for number in range(len(self.carried)):
                self._check_air(number)

    def _check_crosstalk(self, number: int) -> None:
        """Check that there are other sensors, and that what a sensor sees ends."""
        if len(self.carried) == 1:
            raise LidarError(
                "noise.crosstalk needs several sensors, and this survey has one: give sensors."
            )
        for carried in self.carried:
            if not carried.sensor.max_range_m < float("inf"):
                raise LidarError(
                    f"noise.crosstalk needs sensors with a greatest range, and {carried.name} has "
                    "none: give its max_range_m."
                )
        wide, _ = self.returns_each[number].of(self.carried[number].sensor.optics)
        if not wide:
            raise LidarError(
                "noise.crosstalk needs a field of view as wide as the beam, and "
                f"{self.carried[number].name} has no divergence: give returns.divergence_mrad."
            )

    def _check_air(self, number: int) -> None:
        """Check that a sensor says what it detects, and that this is not too much."""
        carried = self.carried[number]
        sensor = carried.sensor
        name = f" of {carried.name}" if carried.name else ""
        if self.noise_each[number].detection_range_m is None:
            lacks = "is not given" if carried.noise is None else "its data sheet does not state"
            guess = sensor.max_range_m / 2 if sensor.max_range_m < np.inf else 100
            raise LidarError(
                f"Returns from rain, snow, spray, dust or fog need noise.detection_range_m{name}, "
                f"the range at 10 % reflectance, which {lacks}: write what is known of it, or "
                f"half of the sensor's range, noise: {{detection_range_m: {guess:.3g}}}."
            )
        wide = (self.returns_each[number].divergence_mrad, sensor.optics.divergence_mrad)
        if (self.particles or self.spray_g_m3) and wide == (None, None):
            raise LidarError(
                f"Rain, snow and spray need the width of the beam{name}: give "
                "returns.divergence_mrad."
            )
        if (met := self.met(number)) > PARTICLES_MOST:
            raise LidarError(
                f"A pulse{name} would return from {met:,.0f} drops or flakes, more than "
                f"{PARTICLES_MOST}: make rain_mm_h, snow_mm_h or noise.detection_range_m smaller."
            )

    def _check_duration(self, sensor: Sensor, steps: int) -> None:
        """Check that the trajectory lasts as long as a sensor, and that its numbers do not end."""
        needed = _end_ns(sensor, steps) / 1e9
        there = self.path.duration_ns / 1e9
        if needed > there:
            raise LidarError(
                f"steps {steps} take until {needed:.6g} s and the trajectory lasts {there:.6g} s, "
                f"{needed - there:.6g} s less: take fewer steps, or leave them out for as many as "
                "it lasts."
            )
        first, stop = sensor.firings(0)
        if (rays := (stop - first) * sensor.channels) > RAYS_MOST:
            raise LidarError(
                f"A scan would have {rays:,} rays, more than {RAYS_MOST:,}: make step_deg smaller, "
                "or take fewer rays."
            )
        lasts = begin_ns(sensor, sensor.firings(steps - 1)[1]) * self.path.stations
        if not lasts < LASTS_MOST_NS:
            raise LidarError(
                f"The survey would last {lasts / 1e9:.3g} s, and times are counted in nanoseconds "
                "for 292 years: make rate_hz larger, or start_s or steps smaller."
            )

    @cached_property
    def path(self) -> Trajectory:
        """The trajectory, or the poses as one."""
        assert self.trajectory is not None  # made of the poses by default
        return self.trajectory

    @cached_property
    def carried(self) -> tuple[Mounted, ...]:
        """The sensors, also if there is only one."""
        return tuple(self.sensors) or (Mounted(self.sensor),)

    @property
    def carrier(self) -> str:
        """Name of the carrier, for the seeds of its instruments: that of its first sensor."""
        return self.carried[0].name

    @cached_property
    def returns_each(self) -> tuple[Returns, ...]:
        """What each sensor reports of its pulses."""
        return tuple(carried.returns or self.returns for carried in self.carried)

    @cached_property
    def noise_each(self) -> tuple[Noise, ...]:
        """Noise of each sensor, whose seed its name is part of."""
        return tuple((carried.noise or self.noise).named(carried.name) for carried in self.carried)

    @cached_property
    def stored_columns(self) -> tuple[Column, ...]:
        """All columns of a part."""
        columns = stored(optional_columns(self.columns))
        if self.waveform_samples:
            columns = (*columns, waveform_column(self.waveform_samples))
        return columns

    def extinction(self, sensor: Sensor) -> float:
        """Extinction of the air for a sensor's light, 1/m."""
        return self.takes(sensor.optics.wavelength_nm)

    def air(self, number: int) -> Air:
        """Air as a sensor sees it."""
        optics = self.carried[number].sensor.optics
        divergence, _ = self.returns_each[number].of(optics)
        overlap_m = self.noise_each[number].overlap_m
        exit_m = self.returns_each[number].exit_m(optics) or EXIT_M
        return Air(self.takes(optics.wavelength_nm), exit_m, divergence, overlap_m)

    def met(self, number: int) -> float:
        """Count drops and flakes that a pulse of a sensor may return from, on the average."""
        if not self.particles:
            return 0.0
        sensor = self.carried[number].sensor
        least = FAINTEST * self.noise_each[number].threshold
        air = self.air(number)
        span = reach(sensor.min_range_m, sensor.max_range_m)
        return sum(air.met(kind, least, *span) for kind in self.particles)

    @cached_property
    def steps_each(self) -> tuple[int, ...]:
        """Time steps of each sensor from each station."""
        counts = []
        for carried in self.carried:
            if given := carried.steps or self.steps:
                counts.append(given)
                continue
            lasts = range(1, STEPS_MOST + 1)
            ends = partial(_end_ns, carried.sensor)
            counts.append(bisect_right(lasts, self.path.duration_ns, key=ends))
            if not counts[-1]:
                raise LidarError(
                    f"The trajectory lasts {self.path.duration_ns / 1e9:.6g} s, and one time step "
                    f"of the sensor takes until {ends(1) / 1e9:.6g} s."
                )
        return tuple(counts)

    @cached_property
    def _firsts(self) -> list[int]:
        """First scan of each sensor, and one past the last of all."""
        return [0, *accumulate(steps * self.path.stations for steps in self.steps_each)]

    @property
    def scan_count(self) -> int:
        """Number of scans."""
        return self._firsts[-1]

    @cached_property
    def sweeps_each(self) -> tuple[tuple[Ints, Floats, Floats], ...]:
        """First scans of each sensor's sweeps, and when their first and last firings begin, ns."""
        out = []
        stations = np.arange(self.path.stations)[:, None]
        for number, carried in enumerate(self.carried):
            sensor = carried.sensor
            steps = self.steps_each[number]
            base = self._firsts[number]
            firsts = np.flatnonzero(np.diff(sensor.turns(np.arange(steps)), prepend=-1))
            begins = [sensor.firings(step)[0] for step in firsts.tolist()]
            ends = [sensor.firings(step - 1)[1] - 1 for step in [*firsts[1:].tolist(), steps]]
            times = (sensor.begins_ns(np.array(each)) + sensor.lead_ns for each in (begins, ends))
            begin, end = ((stations * self.station_ns + each).ravel() for each in times)
            out.append(((base + stations * steps + firsts).ravel(), begin, end))
        return tuple(out)

    @property
    def ray_count(self) -> int:
        """Number of rays in all scans."""
        each = (
            carried.sensor.firings(steps - 1)[1] * carried.sensor.channels
            for carried, steps in zip(self.carried, self.steps_each, strict=True)
        )
        return self.path.stations * sum(each)

    @cached_property
    def station_ns(self) -> int:
        """Duration of a station: until the last sensor is done."""
        return max(
            round(begin_ns(carried.sensor, carried.sensor.firings(steps - 1)[1]))
            for carried, steps in zip(self.carried, self.steps_each, strict=True)
        )

    @property
    def duration_ns(self) -> float:
        """Time until the last firing begins."""
        each = zip(self.carried, self.steps_each, strict=True)
        last = max(_end_ns(carried.sensor, steps) for carried, steps in each)
        return (self.path.stations - 1) * self.station_ns + last

    def scan(self, index: int) -> ScanSpec:
        """Describe scan `index`: sensor by sensor, station by station, step by step."""
        sensor = bisect_right(self._firsts, index) - 1
        station, step = divmod(index - self._firsts[sensor], self.steps_each[sensor])
        lidar = self.carried[sensor].sensor
        start = station * self.station_ns
        return ScanSpec(index, station, lidar.firings(step), start, sensor, lidar.channels)

    def faults_of(self, sensor: int, *kinds: FaultKind) -> dict[int, Fault]:
        """Return the faults of some kinds of a sensor, by their indices in `faults`."""
        name = self.carried[sensor].name
        return {
            index: fault
            for index, fault in enumerate(self.faults)
            if fault.kind in kinds and fault.sensor in (None, name)
        }

    def sent_scan(self, index: int) -> ScanSpec:
        """Describe the scan that a sensor sends as scan `index`: an older scan of a frozen sensor.

        A sweep that begins while the sensor is frozen repeats the last sweep that began before.
        The older scan follows from times alone, wherever scans are cast.
        """
        spec = self.scan(index)
        frozen = self.faults_of(spec.sensor, "frozen").values()
        if not frozen:
            return spec
        firsts, begins, _ = self.sweeps_each[spec.sensor]
        sweep = int(np.searchsorted(firsts, index, "right")) - 1
        source = sweep
        while active := [fault for fault in frozen if fault.during(begins[source])]:
            source = int(np.searchsorted(begins, active[0].from_s * 1e9)) - 1
        if source == sweep:
            return spec
        # The last sweep at a pose may have fewer scans: then the others are lost, see `LossStep`.
        older = min(int(firsts[source] + index - firsts[sweep]), int(firsts[source + 1]) - 1)
        repeats = int(firsts[source]), int(firsts[sweep])
        return replace(self.scan(older), scan=index, ahead=older - index, repeats=repeats)

    def scans(self) -> Iterator[ScanSpec]:
        """All scans in order."""
        return (self.scan(index) for index in range(self.scan_count))

    def pose(self, index: int) -> Pose:
        """Pose of its sensor at the start of scan `index`."""
        spec = self.scan(index)
        time = self.begins_ns(index) - spec.start_ns
        return self.path.pose(spec.station, time).then(self.carried[spec.sensor].mount)

    def begins_ns(self, index: int) -> float:
        """Start of scan `index`, nanoseconds since the survey's start."""
        spec = self.scan(index)
        sensor = self.carried[spec.sensor].sensor
        return spec.start_ns + begin_ns(sensor, spec.firings[0]) + sensor.lead_ns


def _check_noise(noise: Noise, sensor: Sensor) -> None:
    """Check that a sensor can have its noise, and that false alarms are not too many."""
    biases = noise.channel_bias_m
    channels = sensor.channels
    if isinstance(biases, Sequence) and len(biases) != channels:
        raise LidarError(
            f"noise.channel_bias_m has {len(biases)} numbers; {sensor.model} needs {channels}: "
            "give one for each channel, or their standard deviation."
        )
    if noise.ripple_deg and sensor.spins(np.zeros(1, np.int64)) is None:
        raise LidarError(f"noise.ripple_deg needs a head that turns, unlike {sensor.model}'s.")
    if noise.false_alarm_hz and not sensor.gate_s < float("inf"):
        raise LidarError(
            f"noise.false_alarm_hz needs a sensor with a greatest range, and {sensor.model} has "
            "none: give max_range_m."
        )
    if noise.false_alarm_hz and (mean := noise.false_alarm_hz * sensor.gate_s) > ALARMS_MOST:
        raise LidarError(
            f"noise.false_alarm_hz is {noise.false_alarm_hz:g}, which are {mean:.3g} false alarms "
            f"of each pulse; {ALARMS_MOST} are possible: make it or max_range_m smaller."
        )


def begin_ns(sensor: Sensor, firing: int) -> float:
    """Start of a firing, nanoseconds since that of the station."""
    return float(sensor.begins_ns(np.array([firing], np.int64))[0])


def _end_ns(sensor: Sensor, steps: int) -> float:
    """Start of the last firing of so many time steps."""
    return begin_ns(sensor, sensor.firings(steps - 1)[1] - 1) + sensor.lead_ns


def _poses(given: Sequence[Any]) -> tuple[Pose, ...]:
    if isinstance(given, str) or not isinstance(given, Iterable):
        raise LidarError(f"poses is {shown(given)}; it must be a list of poses: [(0, 0, 1)].")
    return tuple(pose_of("poses", pose) for pose in given)
