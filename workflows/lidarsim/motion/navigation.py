"""Simulation of a platform's IMU and GNSS receiver, including drift.

True values are computed from the trajectory of the platform. The samples of an inertial measurement
unit (IMU) are means over the sampling interval. Their sums are therefore exactly the rotations and
velocity changes of the platform, regardless of how it moves between two samples.

Three kinds of errors are added to the true values: white noise, a first-order Gauss-Markov process
for a bias that fluctuates about zero, and a random walk for a bias that drifts away (IEEE Std
952-1997, annex C; Farrell 2008, chapter 4; Woodman 2007). The parameters have the same names as in
Kalibr's `imu.yaml`. Kalibr models the white noise and the random walk.

The rotation and the curvature of the Earth are neglected.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import accumulate
from typing import Annotated, NamedTuple, Protocol

import numpy as np
from pydantic import Field, Strict

from ..environment.extras import install_command
from ..errors import LidarError
from ..numerics.arrays import Floats, Ints
from ..numerics.elementary import arctan2, exp, sin_cos
from ..numerics.elementary_scalars import exp_of, sin_cos_of
from ..numerics.random_numbers import Purpose, named_seed, normal
from ..numerics.vectors import hypot, matmul, matvec, norm, rotate, rotate_into_frames
from ..schema.checks import check_fields, check_order
from ..schema.declared import FileSection, MinMax, Seed, Several, Triple, UnitShare, about
from ..schema.value_texts import one_line
from .rotations import rotation_sines
from .trajectory import AT_CENTER, CENTER, Pose, Trajectory, full_poses, velocities

WHITE = Purpose(41, "white noise of an instrument")
DRIVEN = Purpose(42, "bias steps of an instrument")
WALK = Purpose(43, "random walk steps of an instrument")
SKEW = Purpose(44, "scale factors and misalignments of the axes of an instrument")
OUTAGE = Purpose(45, "drift during GNSS outages")
BLOCK = 1 << 14  # number of samples in a block
RETURNS_IN_S = 1.0  # time in which the error decays to 37 % after an outage

Latitude = Annotated[float, Field(ge=-90, le=90)]
Longitude = Annotated[float, Field(ge=-360, le=360)]
GeodeticPosition = Annotated[
    tuple[Latitude, Longitude, Annotated[float, Field(ge=-1e5, le=1e6)]], Strict(False)
]
TurnNoise = Annotated[float, Field(ge=0, le=100)]  # gyroscope noise
SpeedNoise = Annotated[float, Field(ge=0, le=1000)]  # accelerometer noise
Deviation = Annotated[float, Field(ge=0, le=1e6)]  # meters
Correlation = Annotated[float, Field(ge=0.001, le=1e9)]  # seconds
Skew = Annotated[float, Field(ge=0, le=10)]  # degrees
Span = Annotated[float, Field(ge=0, le=1e9)]  # seconds
AttitudeError = Annotated[float, Field(ge=0, le=45)]  # degrees
# Correlation time in seconds. It must be longer than the interval between two attitude errors.
AttitudeTime = Annotated[float, Field(ge=1, le=1e9)]


@dataclass(frozen=True)
class Imu(FileSection):
    """An inertial measurement unit (IMU) on the platform.

    By default, the measurements have no errors.

    `mount` is the pose of the IMU in the platform frame. The noise parameters have the names and
    units of Kalibr's `imu.yaml`. They affect the samples of the IMU. The roll, pitch and heading
    errors are errors of the attitude that a navigation system computes, and only affect the
    measured trajectory.

    Raises
    ------
    LidarError
        If a number is out of range.
    """

    rate_hz: Annotated[
        float, about("number of samples per second; update_rate in Kalibr", ge=0.001, le=100_000)
    ] = 200.0
    mount: Annotated[Pose, AT_CENTER, about("pose of the IMU in the platform frame")] = CENTER
    gyroscope_noise_density: Annotated[TurnNoise, about("angle random walk in rad/s/sqrt(Hz)")] = (
        0.0
    )
    gyroscope_bias: Annotated[
        TurnNoise,
        about(
            "standard deviation of a bias in rad/s that fluctuates about zero (first-order "
            "Gauss-Markov process)"
        ),
    ] = 0.0
    gyroscope_bias_time_s: Annotated[
        Correlation, about("correlation time of the bias in seconds")
    ] = 300.0
    gyroscope_random_walk: Annotated[
        TurnNoise, about("random walk of the bias in rad/s^2/sqrt(Hz)")
    ] = 0.0
    accelerometer_noise_density: Annotated[
        SpeedNoise, about("velocity random walk in m/s^2/sqrt(Hz)")
    ] = 0.0
    accelerometer_bias: Annotated[
        SpeedNoise, about("standard deviation of a bias in m/s^2 that fluctuates about zero")
    ] = 0.0
    accelerometer_bias_time_s: Annotated[
        Correlation, about("correlation time of the bias in seconds")
    ] = 300.0
    accelerometer_random_walk: Annotated[
        SpeedNoise, about("random walk of the bias in m/s^3/sqrt(Hz)")
    ] = 0.0
    scale: Annotated[UnitShare, about("standard deviation of the scale factor of each axis")] = 0.0
    misalignment_deg: Annotated[
        Skew, about("standard deviation in degrees of the misalignment between axes")
    ] = 0.0
    roll_pitch_deg: Annotated[
        AttitudeError,
        about(
            "standard deviation in degrees of the roll and pitch errors of the measured "
            "trajectory (first-order Gauss-Markov process)"
        ),
    ] = 0.0
    heading_deg: Annotated[
        AttitudeError,
        about("standard deviation in degrees of the heading error of the measured trajectory"),
    ] = 0.0
    attitude_time_s: Annotated[
        AttitudeTime,
        about("correlation time of the roll, pitch and heading errors in seconds"),
    ] = 300.0

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True)
class Gnss(FileSection):
    """A GNSS receiver on the platform.

    By default, the measurements have no errors.

    `mount` is the pose of the antenna in the platform frame.

    Raises
    ------
    LidarError
        If a number is out of range.
    """

    rate_hz: Annotated[float, about("number of positions per second", ge=0.0001, le=1000)] = 10.0
    mount: Annotated[Pose, AT_CENTER, about("pose of the antenna in the platform frame")] = CENTER
    horizontal_m: Annotated[
        Deviation, about("standard deviation of the white noise to the east and north, in meters")
    ] = 0.0
    vertical_m: Annotated[
        Deviation, about("standard deviation of the vertical white noise, in meters")
    ] = 0.0
    drift_horizontal_m: Annotated[
        Deviation,
        about(
            "standard deviation of the drift to the east and north, in meters (first-order "
            "Gauss-Markov process)"
        ),
    ] = 0.0
    drift_vertical_m: Annotated[
        Deviation, about("standard deviation of the vertical drift, in meters")
    ] = 0.0
    drift_time_s: Annotated[Correlation, about("correlation time of the drift in seconds")] = 600.0
    outages: Annotated[
        Several[MinMax[Span]],
        about(
            "start and end times of outages, in seconds after the start of the survey; an IMU "
            "bridges outages, and without an IMU, positions are missing"
        ),
    ] = ()
    origin: Annotated[
        GeodeticPosition | None,
        about(
            "latitude and longitude in degrees and ellipsoidal height in meters of the world "
            "origin, with x to the east and y to the north (default: from `world.epsg`)",
            [48.7758, 9.1829, 290.0],
        ),
    ] = None
    offset_m: Annotated[
        Triple,
        about(
            "constant error to the east, north and up in meters, such as a base station error",
            [0.05, 0, -0.1],
        ),
    ] = (0, 0, 0)

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)
        for index, outage in enumerate(self.outages):
            check_order(f"outages[{index}]", outage)


@dataclass(frozen=True)
class Navigation(FileSection):
    """Instruments that measure the motion of the platform.

    Their samples are written to files next to the point cloud.

    Parameters
    ----------
    imu, gnss
        The IMU and the GNSS receiver, or None if the platform does not have them.
    gravity_m_s2
        Gravitational acceleration in m/s^2, which points down along the z axis of the world.
    seed
        Seed for the measurement errors.
    mount_error
        Calibration error of the sensor mounts. The position is the lever arm error in the platform
        frame, and the angles are the boresight errors about the platform's axes. It affects points
        that are georeferenced by the measured trajectory.

    Raises
    ------
    LidarError
        If a number is out of range.
    """

    imu: Annotated[
        Imu | None,
        about(
            "inertial measurement unit; angular velocities and specific forces are written to "
            "imu.csv and /imu/data_raw",
            {"rate_hz": 200, "gyroscope_noise_density": 1.7e-4},
        ),
    ] = None
    gnss: Annotated[
        Gnss | None,
        about(
            "GNSS receiver; positions are written to gnss.csv and /gnss/fix",
            {"rate_hz": 10, "horizontal_m": 0.02, "drift_horizontal_m": 0.5},
        ),
    ] = None
    gravity_m_s2: Annotated[
        float,
        about(
            "gravitational acceleration in m/s^2 along the negative z axis of the world",
            ge=-100,
            le=100,
        ),
    ] = 9.80665
    seed: Annotated[Seed, about("seed of the errors; the same seed produces the same errors")] = 0
    mount_error: Annotated[
        Pose,
        AT_CENTER,
        about(
            "calibration error of all sensor mounts, for `cloud.georeferencing: measured`: "
            "the position is the lever arm error in meters, and the angles are the boresight "
            "errors in degrees, in the platform frame",
            {"position": [0.01, 0, 0], "roll_deg": 0.01},
        ),
    ] = CENTER

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)


class ImuSamples(NamedTuple):
    """Consecutive samples of an IMU in the IMU frame.

    Attributes
    ----------
    times_ns
        Ends of the sampling intervals in nanoseconds since the start of the survey. Shape (k,).
    rates
        Mean angular velocities in the sampling intervals, in rad/s. Shape (k, 3).
    forces
        Mean specific forces in m/s^2, which point up when the platform is at rest. Shape (k, 3).
    """

    times_ns: Ints
    rates: Floats
    forces: Floats


class GnssFixes(NamedTuple):
    """Consecutive antenna positions measured by a GNSS receiver."""

    times_ns: Ints  # (k,), since the start of the survey
    positions: Floats  # (k, 3), meters, scene coordinates


class InstrumentedDrive(Protocol):
    """Properties of a survey that determine the samples of its instruments."""

    @property
    def navigation(self) -> Navigation | None:
        """Instruments on the platform, or None if it has none."""

    @property
    def path(self) -> Trajectory:
        """Trajectory of the platform."""

    @property
    def duration_ns(self) -> float:
        """Duration of the survey in nanoseconds."""

    @property
    def platform_name(self) -> str:
        """Name of the platform, from which the seeds of its instruments are derived."""


def check_navigation(navigation: Navigation, path: Trajectory, epsg: int | None) -> None:
    """Check that instruments can be simulated for a trajectory and a coordinate system.

    Raises
    ------
    LidarError
        If the platform jumps between poses, or if geodetic positions require a package that is not
        installed.
    """
    if path.stations > 1:
        raise LidarError(
            f"navigation requires a continuous motion, but the survey has {path.stations} separate "
            "poses. Use a trajectory, or a single pose."
        )
    gnss = navigation.gnss
    if gnss and epsg and gnss.origin is None and find_spec("rasterio") is None:
        raise LidarError(
            f"Latitudes of navigation.gnss in EPSG:{epsg} require rasterio. Run "
            f"{install_command('lidarpool[geo]')}, or set navigation.gnss.origin."
        )


def imu_samples(drive: InstrumentedDrive, block: int = BLOCK) -> Iterator[ImuSamples]:
    """Yield the IMU samples of a drive in blocks of `block` samples.

    A sample ends at each multiple of the sampling interval within the drive. Samples do not depend
    on `block`.
    """
    navigation = drive.navigation
    if navigation is None or navigation.imu is None:
        return
    imu = navigation.imu
    seed = named_seed(navigation.seed, drive.platform_name)
    gyroscopes = _Triad.from_imu(imu, "gyroscope", seed)
    accelerometers = _Triad.from_imu(imu, "accelerometer", seed)
    count = math.floor(drive.duration_ns * imu.rate_hz / 1e9 + 1e-6)
    for first in range(0, count, block):
        samples = np.arange(first, min(first + block, count))
        truth = _true_samples(drive.path, imu, navigation.gravity_m_s2, samples)
        yield ImuSamples(
            truth.times_ns,
            gyroscopes.measure(truth.rates, samples),
            accelerometers.measure(truth.forces, samples),
        )


def _true_samples(path: Trajectory, imu: Imu, gravity_m_s2: float, samples: Ints) -> ImuSamples:
    """Return the samples with the given indices that an ideal IMU takes on a trajectory."""
    ends_ns: Floats = np.append(samples, samples[-1] + 1) * 1e9 / imu.rate_hz
    motion = _mounted_motion(path, imu.mount, ends_ns)
    midpoints = (ends_ns[1:] + ends_ns[:-1]) / 2
    halfway = _mounted_motion(path, imu.mount, midpoints).rotations
    gravity = np.array([0.0, 0.0, -gravity_m_s2])
    forces = np.diff(motion.velocities, axis=0) * imu.rate_hz - gravity
    rates = _rotation_vectors(motion.rotations[:-1], motion.rotations[1:]) * imu.rate_hz
    times_ns = np.rint(ends_ns[1:]).astype(np.int64)
    return ImuSamples(times_ns, rates, rotate_into_frames(forces, halfway))


class _Triad(NamedTuple):
    """The three gyroscopes or the three accelerometers of an IMU."""

    errors: _Errors
    axes: Floats | None  # (3, 3), misaligned and scaled axes in the IMU frame

    @classmethod
    def from_imu(cls, imu: Imu, name: str, seed: int) -> _Triad:
        """Create the gyroscopes or the accelerometers of an IMU.

        `name` is either "gyroscope" or "accelerometer".
        """
        names = ("noise_density", "bias", "bias_time_s", "random_walk")
        seed = named_seed(seed, name)
        density, bias, time_s, walk = (getattr(imu, f"{name}_{suffix}") for suffix in names)
        white = density * math.sqrt(imu.rate_hz)
        three = np.ones(3)
        errors = _Errors(seed, 1 / imu.rate_hz, three * white, three * bias, time_s, three * walk)
        if not (imu.scale or imu.misalignment_deg):
            return cls(errors, None)
        sigma = np.where(np.eye(3, dtype=bool), imu.scale, math.radians(imu.misalignment_deg))
        skews = normal(seed, SKEW, 0, np.arange(9)).reshape(3, 3)
        return cls(errors, np.eye(3) + sigma * skews)

    def measure(self, truth: Floats, samples: Ints) -> Floats:
        """Add the errors of the next samples to the true values.

        For `samples` of shape (k,), `truth` and the result have shape (k, 3).
        """
        return rotate(truth, self.axes) + self.errors.next_errors(samples)


def gnss_fixes(drive: InstrumentedDrive, block: int = BLOCK) -> Iterator[GnssFixes]:
    """Yield the GNSS positions of a drive in blocks of `block` positions."""
    navigation = drive.navigation
    path = drive.path
    if navigation is None or navigation.gnss is None:
        return
    gnss = navigation.gnss
    errors = GnssErrors(navigation, drive.platform_name)
    count = math.floor(drive.duration_ns * gnss.rate_hz / 1e9 + 1e-6) + 1
    for first in range(0, count, block):
        samples = np.arange(first, min(first + block, count))
        times = np.asarray(samples * 1e9 / gnss.rate_hz, np.float64)
        positions = _mounted_motion(path, gnss.mount, times).positions
        positions = positions + errors.next_errors(samples)
        if navigation.imu is None:
            for begin, end in gnss.outages:
                received = (times < begin * 1e9) | (times >= end * 1e9)
                times = times[received]
                positions = positions[received]
        yield GnssFixes(np.rint(times).astype(np.int64), positions)


class GnssErrors:
    """Errors of consecutive GNSS positions, including those in outages that an IMU bridges.

    Errors must be requested in order.
    """

    def __init__(self, navigation: Navigation, platform_name: str) -> None:
        gnss = navigation.gnss
        assert gnss is not None  # callers check this
        self._gnss = gnss
        self._imu = navigation.imu
        self._errors = _Errors(
            named_seed(named_seed(navigation.seed, platform_name), "gnss"),
            1 / gnss.rate_hz,
            np.array([gnss.horizontal_m, gnss.horizontal_m, gnss.vertical_m]),
            np.array([gnss.drift_horizontal_m, gnss.drift_horizontal_m, gnss.drift_vertical_m]),
            gnss.drift_time_s,
            np.zeros(3),
        )

    def next_errors(self, samples: Ints) -> Floats:
        """Return the errors of the next positions in meters.

        For indices of shape (k,), the result has shape (k, 3).
        """
        errors = self._errors.next_errors(samples) + np.array(self._gnss.offset_m)
        if self._imu is not None:
            times_s = samples / self._gnss.rate_hz
            for number, (begin, end) in enumerate(self._gnss.outages):
                errors += _bridging_errors(
                    self._imu, self._errors.seed, number, times_s - begin, end - begin
                )
        return errors


class AttitudeErrors:
    """Roll, pitch and heading errors of a navigation system, in degrees.

    Errors must be requested in order.
    """

    def __init__(self, navigation: Navigation, platform_name: str, rate_hz: float) -> None:
        imu = navigation.imu
        assert imu is not None  # callers check this
        self._errors = _Errors(
            named_seed(named_seed(navigation.seed, platform_name), "attitude"),
            1 / rate_hz,
            np.zeros(3),
            np.array([imu.roll_pitch_deg, imu.roll_pitch_deg, imu.heading_deg]),
            imu.attitude_time_s,
            np.zeros(3),
        )

    def next_errors(self, samples: Ints) -> Floats:
        """Return the roll, pitch and heading errors of the next samples in degrees.

        For indices of shape (k,), the result has shape (k, 3).
        """
        return self._errors.next_errors(samples)


def _bridging_errors(
    imu: Imu, seed: int, number: int, since_s: Floats, duration_s: float
) -> Floats:
    """Return the position errors during and after an outage that an IMU bridges.

    After the time t, the error is b t^2 / 2 for a bias b, and N sqrt(t^3 / 3) for a velocity random
    walk N (Groves 2013).

    Parameters
    ----------
    imu
        The IMU that bridges the outage.
    seed
        Seed for the random numbers.
    number
        Index of the outage, on which the random numbers depend.
    since_s
        Time in seconds since the start of the outage. Shape (k,).
    duration_s
        Duration of the outage in seconds.

    Returns
    -------
    array
        Errors in meters. Shape (k, 3).
    """
    elapsed = np.clip(since_s, 0, duration_s)[:, None]
    remaining = exp(np.minimum(duration_s - since_s, 0) / RETURNS_IN_S)[:, None]
    bias, walk = (normal(seed, OUTAGE, number, np.arange(3), k) for k in range(2))
    by_bias = imu.accelerometer_bias * bias * (elapsed * elapsed / 2)
    by_walk = imu.accelerometer_noise_density * walk * (elapsed * np.sqrt(elapsed / 3))
    return np.asarray(remaining * (by_bias + by_walk))


class _Motion(NamedTuple):
    """Motion of an instrument in the scene frame."""

    positions: Floats  # (k, 3), meters
    rotations: Floats  # (k, 3, 3)
    velocities: Floats  # (k, 3), m/s


def _mounted_motion(path: Trajectory, mount: Pose, times_ns: Floats) -> _Motion:
    """Return the motion of an instrument on a platform at the given times."""
    times_ns = np.minimum(times_ns, path.duration_ns)
    positions, rotations = full_poses(path, 0, times_ns)
    speeds, rates = velocities(path, 0, times_ns)
    levers = matvec(rotations, mount.position)
    return _Motion(
        positions + levers,
        matmul(rotations, mount.rotation_matrix),
        speeds + np.cross(rates, levers),
    )


def _rotation_vectors(earlier: Floats, later: Floats) -> Floats:
    """Return the rotation vectors between pairs of rotations, in radians.

    The rotations have shape (k, 3, 3). The vectors have shape (k, 3) and are in the frames of the
    earlier rotations.
    """
    change = matmul(earlier.transpose(0, 2, 1), later)
    sines = rotation_sines(change)
    sines /= 2
    sine = norm(sines)
    cosine = (change[:, 0, 0] + change[:, 1, 1] + change[:, 2, 2] - 1) / 2
    scale = np.where(sine > 1e-9, arctan2(sine, cosine) / np.maximum(sine, 1e-9), 1.0)
    return np.asarray(sines * scale[:, None])


class _Errors:
    """White noise, a Gauss-Markov process and a random walk along three axes.

    Samples must be requested in order, because both processes accumulate random numbers from the
    first sample on. The sizes of the blocks do not affect the results.
    """

    def __init__(
        self,
        seed: int,
        step_s: float,
        white: Floats,  # (3,), standard deviation of a sample
        bias: Floats,  # (3,), standard deviation of the Gauss-Markov process
        bias_time_s: float,
        walk: Floats,  # (3,), standard deviation of the random walk after one second
    ) -> None:
        self.seed = seed
        self._white = white
        self._bias = bias
        self._walk = walk * math.sqrt(step_s)
        self._persistence = exp_of(-step_s / bias_time_s)
        self._driven = bias * math.sqrt(1 - self._persistence * self._persistence)
        self._biases: Floats = np.zeros(3)  # biases of the last sample
        self._walked: Floats = np.zeros(3)

    def next_errors(self, samples: Ints) -> Floats:
        """Return the errors of the next samples.

        For sample indices of shape (k,), the result has shape (k, 3).
        """
        errors = np.zeros((len(samples), 3))
        if self._white.any():
            errors += self._white * self._normal(WHITE, samples)
        if self._bias.any():
            noise = self._normal(DRIVEN, samples)
            noise[samples > 0] *= self._driven
            noise[samples == 0] *= self._bias  # the process is stationary from the first sample on
            persistence = self._persistence
            for axis in range(3):
                biases = accumulate(
                    noise[:, axis].tolist(),
                    lambda bias, step: persistence * bias + step,
                    initial=float(self._biases[axis]),
                )
                errors[:, axis] += (values := np.array(list(biases))[1:])
                self._biases[axis] = values[-1]
        if self._walk.any():
            noise = self._walk * self._normal(WALK, samples)
            noise[0] += self._walked
            walked = np.cumsum(noise, axis=0)
            self._walked = walked[-1]
            errors += walked
        return errors

    def _normal(self, purpose: Purpose, samples: Ints) -> Floats:
        """Return a standard normal deviate for each sample and axis."""
        high_bits, low_bits = np.divmod(samples, 1 << 32)
        return np.stack(
            [normal(self.seed, purpose, high_bits, low_bits, axis) for axis in range(3)], axis=1
        )


def to_geodetic(positions: Floats, origin: tuple[float, float, float]) -> Floats:
    """Convert local positions to geodetic coordinates.

    The conversion uses WGS 84 geocentric coordinates and the latitude formula of Bowring (1985),
    which is exact to 1e-9 degrees below a height of 10 km.

    Parameters
    ----------
    positions
        Positions in meters to the east, north and up from the origin. Shape (k, 3).
    origin
        Latitude and longitude in degrees and ellipsoidal height in meters.

    Returns
    -------
    array
        Latitudes and longitudes in degrees and ellipsoidal heights in meters. Shape (k, 3).
    """
    x, y, z = _geocentric(positions, origin)
    level = hypot(x, y)
    semi_minor = _A * math.sqrt(1 - _E2)
    distance = hypot(z, level)
    # The geodetic latitude is computed from the reduced latitude.
    slope = (semi_minor * z) / (_A * level) * (1 + _E2 / (1 - _E2) * semi_minor / distance)
    cos = 1 / np.sqrt(1 + slope * slope)
    sin = slope * cos
    rise = z + _E2 / (1 - _E2) * semi_minor * (sin * sin * sin)
    latitude = arctan2(rise, level - _E2 * _A * (cos * cos * cos))
    sin, cos = sin_cos(latitude)
    radius = _A / np.sqrt(1 - _E2 * sin * sin)
    height = level * cos + z * sin - _A * _A / radius
    return np.column_stack([np.degrees(latitude), np.degrees(arctan2(y, x)), height])


def _geocentric(
    positions: Floats, origin: tuple[float, float, float]
) -> tuple[Floats, Floats, Floats]:
    """Convert local positions to geocentric coordinates in meters.

    Each coordinate has shape (k,). The parameters are those of `to_geodetic`.
    """
    sp, cp = sin_cos_of(math.radians(origin[0]))
    sl, cl = sin_cos_of(math.radians(origin[1]))
    radius = _A / math.sqrt(1 - _E2 * sp * sp)
    east, north, up = positions.T
    x = (radius + origin[2]) * cp * cl - sl * east - sp * cl * north + cp * cl * up
    y = (radius + origin[2]) * cp * sl + cl * east - sp * sl * north + cp * sl * up
    z = (radius * (1 - _E2) + origin[2]) * sp + cp * north + sp * up
    return x, y, z


def from_geodetic(coordinates: Floats, origin: tuple[float, float, float]) -> Floats:
    """Convert geodetic coordinates to local positions. This is the inverse of `to_geodetic`.

    Parameters
    ----------
    coordinates
        Latitudes and longitudes in degrees and ellipsoidal heights in meters. Shape (k, 3).
    origin
        Latitude and longitude in degrees and ellipsoidal height in meters.

    Returns
    -------
    array
        Positions in meters to the east, north and up from the origin. Shape (k, 3).
    """
    (sp, cp), (sl, cl) = (sin_cos_of(math.radians(angle)) for angle in origin[:2])
    x, y, z = (_cartesian(coordinates) - _cartesian(np.array([origin], np.float64))).T
    east = cl * y - sl * x
    outward = cl * x + sl * y
    return np.column_stack([east, cp * z - sp * outward, cp * outward + sp * z])


def _cartesian(coordinates: Floats) -> Floats:
    """Convert geodetic coordinates to geocentric coordinates in meters.

    Both have shape (k, 3).
    """
    latitude, longitude, height = coordinates.T
    sp, cp = sin_cos(np.radians(latitude))
    sl, cl = sin_cos(np.radians(longitude))
    radius = _A / np.sqrt(1 - _E2 * sp * sp)
    level = (radius + height) * cp
    return np.column_stack([level * cl, level * sl, (radius * (1 - _E2) + height) * sp])


# Semi-major axis in meters, flattening, and squared eccentricity of WGS 84.
_A = 6378137.0
_F = 1 / 298.257223563
_E2 = _F * (2 - _F)
