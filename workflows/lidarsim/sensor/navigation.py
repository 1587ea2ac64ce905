"""IMU and GNSS receiver of a carrier, and their errors, which drift.

Truth comes from the carrier's trajectory: what an inertial measurement unit reports are means over
its sampling interval, so that sums of its samples are the carrier's turns and changes of velocity,
whatever the trajectory does in between. To these come errors: white noise, a Gauss-Markov process
of first order for a bias that wanders about zero, and a random walk for one that wanders off
(IEEE Std 952-1997, annex C; Farrell 2008, chapter 4; Woodman 2007). Parameters are named as in the
`imu.yaml` of kalibr, whose model is the first and the last of the three.

The rotation of the Earth and its curvature are left out.
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

from ..base.arrays import Floats, Ints
from ..base.declared import MinMax, Seed, Several, UnitShare, about
from ..base.elementary import arctan2, exp, sin_cos
from ..base.elementary_scalars import exp_of, sin_cos_of
from ..base.errors import LidarError
from ..base.validation import checked_fields
from ..base.vectors import applied, hypot, into_axes, length, matmul, turned
from .random_numbers import Purpose, named_seed, normal
from .trajectory import AT_CENTRE, CENTRE, Pose, Trajectory, full_poses, velocities

WHITE = Purpose(41, "white noise of an instrument")
DRIVEN = Purpose(42, "steps of its bias")
WALK = Purpose(43, "steps of its random walk")
SKEW = Purpose(44, "scale factors of its axes, and angles between them")
OUTAGE = Purpose(45, "drift where there is no GNSS")
BLOCK = 1 << 14  # samples that are made at a time
RETURNS_IN_S = 1.0  # after an outage, 37 % of its error are left

Latitude = Annotated[float, Field(ge=-90, le=90)]
Longitude = Annotated[float, Field(ge=-360, le=360)]
GeodeticPosition = Annotated[
    tuple[Latitude, Longitude, Annotated[float, Field(ge=-1e5, le=1e6)]], Strict(False)
]
TurnNoise = Annotated[float, Field(ge=0, le=100)]  # of a gyroscope
SpeedNoise = Annotated[float, Field(ge=0, le=1000)]  # of an accelerometer
Deviation = Annotated[float, Field(ge=0, le=1e6)]  # metres
Correlation = Annotated[float, Field(ge=0.001, le=1e9)]  # seconds
Skew = Annotated[float, Field(ge=0, le=10)]  # degrees
Span = Annotated[float, Field(ge=0, le=1e9)]  # seconds


@dataclass(frozen=True)
@checked_fields
class Imu:
    """An inertial measurement unit on the carrier; without arguments it has no errors.

    Its `mount` is its pose in the carrier's axes. Noise is named and measured as in kalibr's
    `imu.yaml`.

    Raises
    ------
    LidarError
        If a number is outside its range.
    """

    rate_hz: Annotated[
        float, about("samples a second; update_rate of kalibr", ge=0.001, le=100_000)
    ] = 200.0
    mount: Annotated[Pose, AT_CENTRE, about("its pose in the carrier's axes")] = CENTRE
    gyroscope_noise_density: Annotated[TurnNoise, about("angle random walk, rad/s/sqrt(Hz)")] = 0.0
    gyroscope_bias: Annotated[
        TurnNoise,
        about(
            "standard deviation of a bias that wanders about zero (Gauss-Markov of "
            "first order), rad/s"
        ),
    ] = 0.0
    gyroscope_bias_time_s: Annotated[Correlation, about("its correlation time")] = 300.0
    gyroscope_random_walk: Annotated[TurnNoise, about("of the bias, rad/s^2/sqrt(Hz)")] = 0.0
    accelerometer_noise_density: Annotated[
        SpeedNoise, about("velocity random walk, m/s^2/sqrt(Hz)")
    ] = 0.0
    accelerometer_bias: Annotated[
        SpeedNoise, about("standard deviation of a bias that wanders about zero, m/s^2")
    ] = 0.0
    accelerometer_bias_time_s: Annotated[Correlation, about("its correlation time")] = 300.0
    accelerometer_random_walk: Annotated[SpeedNoise, about("of the bias, m/s^3/sqrt(Hz)")] = 0.0
    scale: Annotated[UnitShare, about("standard deviation of each axis's scale factor")] = 0.0
    misalignment_deg: Annotated[Skew, about("of angles between axes, standard deviation")] = 0.0


@dataclass(frozen=True)
@checked_fields
class Gnss:
    """A GNSS receiver on the carrier; without arguments it has no errors.

    Its `mount` is the pose of its antenna in the carrier's axes.

    Raises
    ------
    LidarError
        If a number is outside its range.
    """

    rate_hz: Annotated[float, about("positions a second", ge=0.0001, le=1000)] = 10.0
    mount: Annotated[Pose, AT_CENTRE, about("pose of its antenna in the carrier's axes")] = CENTRE
    horizontal_m: Annotated[
        Deviation, about("standard deviation of white noise to the east and north")
    ] = 0.0
    vertical_m: Annotated[Deviation, about("the same, up")] = 0.0
    drift_horizontal_m: Annotated[
        Deviation,
        about(
            "standard deviation of an error that drifts (Gauss-Markov of first order), "
            "to the east and north"
        ),
    ] = 0.0
    drift_vertical_m: Annotated[Deviation, about("the same, up")] = 0.0
    drift_time_s: Annotated[Correlation, about("correlation time of the drift")] = 600.0
    outages: Annotated[
        Several[MinMax[Span]],
        about("begins and ends, seconds; the IMU bridges them, without one no positions are there"),
    ] = ()
    origin: Annotated[
        GeodeticPosition | None,
        about(
            "latitude and longitude, degrees, and ellipsoidal height, metres, of the "
            "world's zero, x to the east and y to the north; by default by cloud.epsg",
            [48.7758, 9.1829, 290.0],
        ),
    ] = None


@dataclass(frozen=True)
@checked_fields
class Navigation:
    """What measures the carrier's own motion, and writes it beside the cloud.

    Parameters
    ----------
    imu, gnss
        An IMU and a GNSS receiver; None for none.

    Raises
    ------
    LidarError
        If a number is outside its range.
    """

    imu: Annotated[
        Imu | None,
        about(
            "inertial measurement unit: angular velocities and specific forces in imu.csv, "
            "/imu/data_raw",
            {"rate_hz": 200, "gyroscope_noise_density": 1.7e-4},
        ),
    ] = None
    gnss: Annotated[
        Gnss | None,
        about(
            "GNSS receiver: positions in gnss.csv, /gnss/fix",
            {"rate_hz": 10, "horizontal_m": 0.02, "drift_horizontal_m": 0.5},
        ),
    ] = None
    gravity_m_s2: Annotated[
        float, about("gravity, downwards along the world's z axis", ge=-100, le=100)
    ] = 9.80665
    seed: Annotated[Seed, about("the same seed gives the same errors")] = 0


class ImuSamples(NamedTuple):
    """Some consecutive samples of an IMU, in its own axes."""

    times_ns: Ints  # (k,): end of the interval, since the survey's start
    rates: Floats  # (k, 3): mean angular velocities over the interval before, rad/s
    forces: Floats  # (k, 3): mean specific forces, m/s^2: at rest, upwards, gravity


class Fixes(NamedTuple):
    """Some consecutive positions of a GNSS receiver's antenna."""

    times_ns: Ints  # (k,): since the survey's start
    positions: Floats  # (k, 3): metres, the scene's local coordinates


class InstrumentedDrive(Protocol):
    """The properties of a survey that the samples of instruments follow from."""

    @property
    def navigation(self) -> Navigation | None:
        """Instruments on the carrier, if any."""

    @property
    def path(self) -> Trajectory:
        """Trajectory of the carrier."""

    @property
    def duration_ns(self) -> float:
        """Duration in nanoseconds."""

    @property
    def carrier(self) -> str:
        """Name of the carrier, for the seeds of its instruments."""


def check_navigation(navigation: Navigation, path: Trajectory, epsg: int | None) -> None:
    """Check that instruments can be on a carrier, in a coordinate system; LidarError if not."""
    if path.stations > 1:
        raise LidarError(
            f"navigation needs a carrier that drives or stands, and this one jumps between "
            f"{path.stations} poses: give a trajectory, or one pose."
        )
    gnss = navigation.gnss
    if gnss and epsg and gnss.origin is None and find_spec("rasterio") is None:
        raise LidarError(
            f"Latitudes of navigation.gnss in EPSG:{epsg} need rasterio: pip install "
            '"lidarpool[geo]", or give navigation.gnss.origin.'
        )


def imu_samples(drive: InstrumentedDrive, block: int = BLOCK) -> Iterator[ImuSamples]:
    """Yield the samples of the IMU on a drive, `block` samples at a time.

    A sample ends at each whole multiple of its interval within the drive. Samples do not depend on
    `block`.
    """
    navigation = drive.navigation
    path = drive.path
    if navigation is None or navigation.imu is None:
        return
    imu = navigation.imu
    seed = named_seed(navigation.seed, drive.carrier)
    gyroscope, turn_skew = _of_axes(imu, "gyroscope", seed)
    accelerometer, speed_skew = _of_axes(imu, "accelerometer", seed)
    gravity = np.array([0.0, 0.0, -navigation.gravity_m_s2])
    count = math.floor(drive.duration_ns * imu.rate_hz / 1e9 + 1e-6)
    for first in range(0, count, block):
        samples = np.arange(first, min(first + block, count))
        ends: Floats = np.append(samples, samples[-1] + 1) * 1e9 / imu.rate_hz
        _, turns, speeds = _moved(path, imu.mount, ends)
        middles = (ends[1:] + ends[:-1]) / 2
        _, halfway, _ = _moved(path, imu.mount, middles)
        forces = np.diff(speeds, axis=0) * imu.rate_hz - gravity
        rates = _rotation_vectors(turns[:-1], turns[1:]) * imu.rate_hz
        yield ImuSamples(
            np.rint(ends[1:]).astype(np.int64),
            turned(rates, turn_skew) + gyroscope.of(samples),
            turned(into_axes(forces, halfway), speed_skew) + accelerometer.of(samples),
        )


def _of_axes(imu: Imu, name: str, seed: int) -> tuple[_Errors, Floats | None]:
    """Return the errors of an IMU's three gyroscopes, or the like, and their axes (3, 3)."""
    names = ("noise_density", "bias", "bias_time_s", "random_walk")
    seed = named_seed(seed, name)
    density, bias, time_s, walk = (getattr(imu, f"{name}_{one}") for one in names)
    white = density * math.sqrt(imu.rate_hz)
    three = np.ones(3)
    errors = _Errors(seed, 1 / imu.rate_hz, three * white, three * bias, time_s, three * walk)
    if not (imu.scale or imu.misalignment_deg):
        return errors, None
    sigma = np.where(np.eye(3, dtype=bool), imu.scale, math.radians(imu.misalignment_deg))
    drawn = normal(seed, SKEW, 0, np.arange(9)).reshape(3, 3)
    return errors, np.eye(3) + sigma * drawn


def fixes(drive: InstrumentedDrive, block: int = BLOCK) -> Iterator[Fixes]:
    """Yield the positions of the GNSS receiver on a drive, `block` positions at a time."""
    navigation = drive.navigation
    path = drive.path
    if navigation is None or navigation.gnss is None:
        return
    gnss = navigation.gnss
    errors = _Errors(
        named_seed(named_seed(navigation.seed, drive.carrier), "gnss"),
        1 / gnss.rate_hz,
        np.array([gnss.horizontal_m, gnss.horizontal_m, gnss.vertical_m]),
        np.array([gnss.drift_horizontal_m, gnss.drift_horizontal_m, gnss.drift_vertical_m]),
        gnss.drift_time_s,
        np.zeros(3),
    )
    count = math.floor(drive.duration_ns * gnss.rate_hz / 1e9 + 1e-6) + 1
    for first in range(0, count, block):
        samples = np.arange(first, min(first + block, count))
        times = np.asarray(samples * 1e9 / gnss.rate_hz, np.float64)
        places, _, _ = _moved(path, gnss.mount, times)
        places = places + errors.of(samples)
        for number, (begin, end) in enumerate(gnss.outages):
            if navigation.imu is None:
                there = (times < begin * 1e9) | (times >= end * 1e9)
                times = times[there]
                places = places[there]
            else:
                ends = times / 1e9 - begin, end - begin
                places += _bridged(navigation.imu, errors.seed, number, *ends)
        yield Fixes(np.rint(times).astype(np.int64), places)


def _bridged(imu: Imu, seed: int, number: int, since: Floats, lasts: float) -> Floats:
    """Errors of positions (k, 3) while an IMU bridges an outage, and after: seconds since it began.

    A bias b grows to b t^2 / 2, a velocity random walk N to N sqrt(t^3 / 3) (Groves 2013).
    """
    grown = np.clip(since, 0, lasts)[:, None]
    left = exp(np.minimum(lasts - since, 0) / RETURNS_IN_S)[:, None]
    bias, walk = (normal(seed, OUTAGE, number, np.arange(3), k) for k in range(2))
    by_bias = imu.accelerometer_bias * bias * (grown * grown / 2)
    by_walk = imu.accelerometer_noise_density * walk * (grown * np.sqrt(grown / 3))
    return np.asarray(left * (by_bias + by_walk))


def _moved(path: Trajectory, mount: Pose, times_ns: Floats) -> tuple[Floats, Floats, Floats]:
    """Positions (k, 3), rotations (k, 3, 3) and velocities (k, 3) of something on a carrier."""
    times_ns = np.minimum(times_ns, path.duration_ns)
    places, turns = full_poses(path, 0, times_ns)
    speeds, rates = velocities(path, 0, times_ns)
    levers = applied(turns, mount.position)
    return places + levers, matmul(turns, mount.turn), speeds + np.cross(rates, levers)


def _rotation_vectors(before: Floats, after: Floats) -> Floats:
    """Rotation vectors (k, 3), radians, from rotations (k, 3, 3) to others, in their axes."""
    turn = matmul(before.transpose(0, 2, 1), after)
    sines = np.stack([turn[:, k, j] - turn[:, j, k] for j, k in ((1, 2), (2, 0), (0, 1))], axis=1)
    sines /= 2
    sine = length(sines)
    cosine = (turn[:, 0, 0] + turn[:, 1, 1] + turn[:, 2, 2] - 1) / 2
    scale = np.where(sine > 1e-9, arctan2(sine, cosine) / np.maximum(sine, 1e-9), 1.0)
    return np.asarray(sines * scale[:, None])


class _Errors:
    """White noise, a Gauss-Markov process and a random walk along three axes.

    Both processes are sums over hashes from the first sample on, in one order: samples must be
    asked for in order, and in which pieces does not matter.
    """

    def __init__(
        self,
        seed: int,
        step_s: float,
        white: Floats,  # (3,): standard deviation of a sample
        bias: Floats,  # (3,): standard deviation of the Gauss-Markov process
        bias_time_s: float,
        walk: Floats,  # (3,): of the random walk in a second
    ) -> None:
        self.seed = seed
        self._white = white
        self._bias = bias
        self._walk = walk * math.sqrt(step_s)
        self._kept = exp_of(-step_s / bias_time_s)
        self._driven = bias * math.sqrt(1 - self._kept * self._kept)
        self._biases: Floats = np.zeros(3)  # of the last sample
        self._walked: Floats = np.zeros(3)

    def of(self, samples: Ints) -> Floats:
        """Return the errors of the next samples (k,): (k, 3)."""
        out = np.zeros((len(samples), 3))
        if self._white.any():
            out += self._white * self._normal(WHITE, samples)
        if self._bias.any():
            noise = self._normal(DRIVEN, samples)
            noise[samples > 0] *= self._driven
            noise[samples == 0] *= self._bias  # a bias that has been there for long
            kept = self._kept
            for axis in range(3):
                made = accumulate(
                    noise[:, axis].tolist(),
                    lambda bias, step: kept * bias + step,
                    initial=float(self._biases[axis]),
                )
                out[:, axis] += (values := np.array(list(made))[1:])
                self._biases[axis] = values[-1]
        if self._walk.any():
            noise = self._walk * self._normal(WALK, samples)
            noise[0] += self._walked
            walked = np.cumsum(noise, axis=0)
            self._walked = walked[-1]
            out += walked
        return out

    def _normal(self, purpose: Purpose, samples: Ints) -> Floats:
        """Make normal deviates for samples (k,) along each axis: (k, 3)."""
        high, low = np.divmod(samples, 1 << 32)
        return np.stack([normal(self.seed, purpose, high, low, axis) for axis in range(3)], axis=1)


def geodetic(positions: Floats, origin: tuple[float, float, float]) -> Floats:
    """Latitudes, longitudes (degrees) and ellipsoidal heights of points east, north and up of one.

    Through Cartesian coordinates of WGS 84; Bowring's (1985) latitude is exact to 1e-9 degrees
    below a height of 10 km.

    Parameters
    ----------
    positions
        (k, 3): metres.
    origin
        Latitude, longitude and height.
    """
    lat = math.radians(origin[0])
    lon = math.radians(origin[1])
    (sp, cp), (sl, cl) = sin_cos_of(lat), sin_cos_of(lon)
    wide = _A / math.sqrt(1 - _E2 * sp * sp)
    east, north, up = positions.T
    x = (wide + origin[2]) * cp * cl - sl * east - sp * cl * north + cp * cl * up
    y = (wide + origin[2]) * cp * sl + cl * east - sp * sl * north + cp * sl * up
    z = (wide * (1 - _E2) + origin[2]) * sp + cp * north + sp * up
    level = hypot(x, y)
    small = _A * math.sqrt(1 - _E2)
    far = hypot(z, level)
    slope = (small * z) / (_A * level) * (1 + _E2 / (1 - _E2) * small / far)
    cos = 1 / np.sqrt(1 + slope * slope)
    sin = slope * cos
    above = z + _E2 / (1 - _E2) * small * (sin * sin * sin)
    bow = arctan2(above, level - _E2 * _A * (cos * cos * cos))
    sin, cos = sin_cos(bow)
    across = _A / np.sqrt(1 - _E2 * sin * sin)
    height = level * cos + z * sin - _A * _A / across
    return np.column_stack([np.degrees(bow), np.degrees(arctan2(y, x)), height])


def local_positions(places: Floats, origin: tuple[float, float, float]) -> Floats:
    """Return positions east, north and up of an origin (k, 3), metres; inverse of `geodetic`.

    Parameters
    ----------
    places
        (k, 3): latitudes and longitudes, degrees, and ellipsoidal heights, metres.
    origin
        Latitude, longitude and height.
    """
    (sp, cp), (sl, cl) = (sin_cos_of(math.radians(angle)) for angle in origin[:2])
    x, y, z = (_cartesian(places) - _cartesian(np.array([origin], np.float64))).T
    east = cl * y - sl * x
    outward = cl * x + sl * y
    return np.column_stack([east, cp * z - sp * outward, cp * outward + sp * z])


def _cartesian(places: Floats) -> Floats:
    """Return geocentric coordinates (k, 3), metres, of latitudes, longitudes and heights (k, 3)."""
    latitude, longitude, height = places.T
    (sp, cp), (sl, cl) = sin_cos(np.radians(latitude)), sin_cos(np.radians(longitude))
    across = _A / np.sqrt(1 - _E2 * sp * sp)
    level = (across + height) * cp
    return np.column_stack([level * cl, level * sl, (across * (1 - _E2) + height) * sp])


# of WGS 84
_A = 6378137.0
_F = 1 / 298.257223563
_E2 = _F * (2 - _F)
