"""Noise of ranges and angles, lost returns and false ones; their random numbers.

A random number is a hash of (seed, name, purpose, scan, ray, number): the same on every worker and
in every batch, whatever the order of drawing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum, unique
from functools import cache
from hashlib import sha256
from math import inf
from statistics import NormalDist
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from ..base.arrays import Bools, Floats, Indices, Integers, Ints
from ..base.declared import AngleDeg, Seed, Several, UnitShare, about, allowed
from ..base.elementary import exp, log
from ..base.errors import LidarError
from ..base.validation import checked_fields
from .materials import at_right_angles

# Detection threshold for signal plus noise, in standard deviations.
THRESHOLD_SIGMAS = 5.0
TARGET_REFLECTANCE = 0.1  # reflectance of stated ranges
ALARMS_MOST = 20  # false alarms of a pulse on average: a ray has numbers for 255

Metres = Annotated[float, Field(ge=0, le=1000)]
Bias = Annotated[float, Field(ge=-1000, le=1000)]
DecayTime = Annotated[float, Field(gt=0, le=1e7)]
AngleSigma = Annotated[float, Field(ge=0, le=10)]  # degrees

_GAMMA = 0x9E3779B97F4A7C15
_NUMBERS = 256  # of one ray


@unique
class Purpose(Enum):
    """What random numbers are for, and its number in the hash: each one has numbers of its own.

    What is there several times, such as kinds of particles or instruments, has seeds of its own
    instead: see `named_seed`.
    """

    RANGE = 1  # noise of a return's range
    ACROSS = 2  # noise of a beam's direction
    UP = 3
    DETECTION = 4  # noise of a return's energy
    LOSS = 5  # whether a return is lost
    FOG_CELL = 10  # which cell of fog has the highest peak
    FOG_PLACE = 11  # where the peak is in its cell
    PARTICLES = 12  # how many drops or flakes a beam meets
    PARTICLE_RANGE = 13
    PARTICLE_DIAMETER = 14
    PARTICLE_SUBRAY = 15  # which it is in
    SPRAY = 16  # depth of spray until its next clump
    SPRAY_SUBRAY = 17
    SPRAY_DIAMETER = 18
    ALARM = 20  # time until the next false alarm
    PEAK = 21  # energy of a false alarm
    STRAY = 22  # noise of stray light's energy
    OTHER = 23  # noise of the energy of another sensor's pulse
    LEAF = 30  # depth of leaves that light gets through
    WHICH = 31  # which of the crowns that overlap the leaf is of
    VELOCITY = 40  # noise of a return's radial velocity
    WHITE = 41  # white noise of an instrument
    DRIVEN = 42  # steps of its bias
    WALK = 43  # steps of its random walk
    SKEW = 44  # scale factors of its axes, and angles between them
    OUTAGE = 45  # how it drifts where there is no GNSS
    SAMPLES = 50  # stream of the samples of a waveform
    SAMPLE = 51  # noise of a sample
    CHANNEL = 60  # a channel's error of range
    PACKET = 61  # whether a packet is lost


@dataclass(frozen=True)
@checked_fields
class Noise:
    """Noise of ranges and angles, lost returns and false ones; without arguments there is none.

    The standard deviation of a range of r metres is ``range_m + range_per_m * r``, and
    `range_at_threshold_m` times the threshold of detection over the return's energy is added in
    squares. Rays are cast in directions with noise, and reported with angles without. Stated
    detection ranges are for surfaces at right angles in clear air.

    Raises
    ------
    LidarError
        If a number is outside its range, or needs a detection range and there is none.
    """

    range_m: Annotated[Metres, about("standard deviation of ranges, metres", 0.02)] = 0.0
    range_per_m: Annotated[
        float, about("standard deviation added for each metre of range", 0.0002, ge=0, le=1)
    ] = 0.0
    angle_deg: Annotated[
        AngleSigma, about("standard deviation of beam directions, in both axes", 0.05)
    ] = 0.0
    dropout: Annotated[
        UnitShare, about("share of returns that are lost, whatever their energy")
    ] = 0.0
    detection_range_m: Annotated[
        float | None,
        about(
            "range at which a surface of 10 % reflectance returns half the pulses; "
            "weaker returns are lost",
            100.0,
            ge=0.001,
            le=1e8,
        ),
    ] = None
    seed: Annotated[Seed, about("the same seed gives the same noise")] = 0
    overlap_m: Annotated[
        Metres,
        about(
            "from here on the receiver sees the whole beam; nearer, rain, snow, fog "
            "and dust do not return more"
        ),
    ] = 10.0
    range_at_threshold_m: Annotated[
        Metres,
        about(
            "standard deviation of the range of a return at the threshold of "
            "detection, metres; falls as its energy grows, added in squares",
            0.05,
        ),
    ] = 0.0
    walk_m: Annotated[
        float,
        about(
            "range walk: a return 1.65 times as strong as the threshold of detection "
            "appears so much nearer, one 10,000 times as strong 4.3 times as much",
            0.02,
            ge=0,
            le=10,
        ),
    ] = 0.0
    false_alarm_hz: Annotated[
        float,
        about(
            "rate of false alarms, dark counts and sun, while the receiver waits for returns",
            200.0,
            ge=0,
            le=1e9,
        ),
    ] = 0.0
    stray_light: Annotated[
        UnitShare,
        about(
            "blooming of retro-reflectors: share of their light that a beam 1 degree "
            "beside them receives; falls with the square of the angle",
            1e-6,
        ),
    ] = 0.0

    crosstalk: Annotated[
        bool, about("whether it receives pulses of the other sensors of the survey")
    ] = False
    velocity_m_s: Annotated[
        float, about("standard deviation of radial velocities, m/s", ge=0, le=1000)
    ] = 0.0
    saturation: Annotated[
        float | None,
        about(
            "signal that fills the receiver, in thresholds of detection: stronger pulses are "
            "clipped and wider, and hide what is close; by default none",
            100.0,
            ge=1,
            le=1e12,
        ),
    ] = None
    channel_bias_m: Annotated[
        Metres | Several[Bias],
        allowed("a number of 0 to 1000, or a list of numbers, one for each channel"),
        about("constant errors of channels' ranges, metres: standard deviation, or one for each"),
    ] = 0.0
    warm_up_m: Annotated[Bias, about("error of ranges at the start, which decays, metres")] = 0.0
    warm_up_s: Annotated[DecayTime, about("time in which it falls to 37 %, seconds")] = 600.0
    ripple_deg: Annotated[AngleSigma, about("greatest error of azimuths, as the head turns")] = 0.0
    ripple_cycles: Annotated[int, about("how often it repeats in a turn", ge=1, le=100_000)] = 1
    ripple_phase_deg: Annotated[AngleDeg, about("its phase where the head is at azimuth 0")] = 0.0

    def __post_init__(self) -> None:
        if np.ndim(self.channel_bias_m):
            biases = tuple(np.asarray(self.channel_bias_m, np.float64).tolist())
            object.__setattr__(self, "channel_bias_m", biases)
        needs = "range_at_threshold_m", "walk_m", "false_alarm_hz", "stray_light", "crosstalk"
        if self.detection_range_m is None:
            for name in (*needs, "saturation"):
                if getattr(self, name):
                    raise LidarError(
                        f"noise.{name} is measured by the threshold of detection: give "
                        "noise.detection_range_m as well."
                    )

    @property
    def threshold(self) -> float:
        """Threshold of detection: the energy of returns of which half are detected, else 0."""
        if self.detection_range_m is None:
            return 0.0
        return float(TARGET_REFLECTANCE * at_right_angles(self.detection_range_m))

    @property
    def full(self) -> float:
        """Signal that fills the receiver: no recorded pulse is higher."""
        return inf if self.saturation is None else self.saturation * self.threshold

    @property
    def loses(self) -> bool:
        """Whether returns can be lost."""
        return self.dropout > 0 or self.detection_range_m is not None

    @property
    def moves_ranges(self) -> bool:
        """Whether ranges deviate."""
        random = self.range_m, self.range_per_m, self.range_at_threshold_m
        return any((*random, self.walk_m, self.channel_bias_m, self.warm_up_m))

    def named(self, name: str) -> Noise:
        """Return the noise of a sensor, whose name is part of all its random numbers."""
        return replace(self, seed=named_seed(self.seed, name))

    def ranges(
        self,
        distance: Floats,
        energy: Floats | None,
        scan: Integers,
        ray: Integers,
        number: Integers,
    ) -> Floats:
        """Return the reported ranges of returns (n,), metres, at least 0.

        The energies are needed where noise or walk depend on them.
        """
        sigma = self.range_m + self.range_per_m * distance
        if self.range_at_threshold_m and energy is not None:
            weak = self.range_at_threshold_m * self.threshold / energy
            sigma = np.sqrt(sigma * sigma + weak * weak)
        if self.walk_m and energy is not None:
            distance = distance - self.walk(energy)
        if sigma.any():  # else they would be drawn in vain
            distance = distance + sigma * normal(self.seed, Purpose.RANGE, scan, ray, number)
        return np.maximum(distance, 0)

    def offsets(self, channel: Integers, times_ns: Ints) -> Floats:
        """Return errors of range that last: of channels (n,) at times since the start, metres."""
        biases = np.asarray(self.channel_bias_m, np.float64)
        if not biases.ndim:
            each = np.arange(channel.max(initial=0) + 1)
            biases = biases * normal(self.seed, Purpose.CHANNEL, 0, each)
        out = biases[channel]
        if self.warm_up_m:
            out = out + self.warm_up_m * exp(times_ns * (-1e-9 / self.warm_up_s))
        return out

    def velocities(
        self, velocity: Floats, scan: Integers, ray: Integers, number: Integers
    ) -> Floats:
        """Return the reported radial velocities of returns (n,), m/s."""
        return velocity + self.velocity_m_s * normal(self.seed, Purpose.VELOCITY, scan, ray, number)

    def walk(self, energy: Floats) -> Floats:
        """By how much returns (n,) appear nearer than one at the threshold, metres.

        A pulse with the shape of a Gaussian, so high over a fixed threshold, crosses it so many
        standard deviations before its maximum.
        """
        over = np.maximum(energy / self.threshold, 1)
        return np.asarray(self.walk_m * np.sqrt(2 * log(over)))

    def false_alarms(
        self, gate_s: float, scan: Integers, ray: Integers
    ) -> tuple[Indices, Floats, Floats]:
        """Find false alarms of rays (n,), whose receivers are open for so many seconds.

        They come at the same rate at all times. Each is a maximum of the receiver's noise above the
        threshold: maxima of normally distributed noise of a narrow band have a Rayleigh
        distribution (Rice 1944).

        Returns
        -------
        Rows of the rays, the time since the receiver opened, in seconds, and energies: (k,) each.
        """
        rows, since = np.arange(len(ray)), np.zeros(len(ray))
        found: list[tuple[Indices, Floats, Floats]] = []
        number = 0
        while len(rows) or not found:
            # The time until the next one is exponentially distributed.
            left = uniform(self.seed, Purpose.ALARM, scan[rows], ray[rows], number)
            some = np.flatnonzero(left > exp(-self.false_alarm_hz * (gate_s - since)))
            rows, since, left = rows[some], since[some], left[some]
            since = np.minimum(since - log(left) / self.false_alarm_hz, gate_s)
            share = 1 - uniform(self.seed, Purpose.PEAK, scan[rows], ray[rows], number)
            peak = np.sqrt(1 - 2 / (THRESHOLD_SIGMAS * THRESHOLD_SIGMAS) * log(share))
            found.append((rows, since, self.threshold * peak))
            number += 1
        row, time, energy = map(np.concatenate, zip(*found, strict=True))
        return row, time, energy

    def angles(self, scan: Integers, ray: Integers) -> tuple[Floats, Floats]:
        """Deviations of beams, across and up: (n,) and (n,), radians."""
        sigma = np.radians(self.angle_deg)
        return (
            sigma * normal(self.seed, Purpose.ACROSS, scan, ray),
            sigma * normal(self.seed, Purpose.UP, scan, ray),
        )

    def detected(self, energy: Floats, scan: Integers, ray: Integers, number: Integers) -> Bools:
        """Whether returns (n,) are detected.

        The signal with its normally distributed noise has to pass a threshold: at an energy equal
        to the threshold half of the returns are detected, at 1.4 times as much 97.7 %, and at a
        fifth of it 3 in 100,000.
        """
        seen = uniform(self.seed, Purpose.LOSS, scan, ray, number) >= self.dropout
        if self.detection_range_m is not None:
            seen &= self.passes(Purpose.DETECTION, energy, scan, ray, number)
        return seen

    def passes(
        self, purpose: Purpose, energy: Floats, scan: Integers, ray: Integers, number: ArrayLike = 0
    ) -> Bools:
        """Whether signals (n,) with their noise pass the threshold, see `detected`."""
        above = THRESHOLD_SIGMAS * (energy / self.threshold - 1)
        return np.asarray(above + normal(self.seed, purpose, scan, ray, number) > 0)


def _mixed(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Last step of SplitMix64 (Steele, Lea and Flood 2014), in place."""
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        x ^= x >> np.uint64(shift)
        x *= np.uint64(factor)
    x ^= x >> np.uint64(31)
    return x


def named_seed(seed: int, name: str) -> int:
    """Return the seed of what has a name: the same on every machine; without a name `seed`."""
    if not name:
        return seed
    return int.from_bytes(sha256(f"{seed}\n{name}".encode()).digest()[:8], "little") >> 1


def starts(seed: int, *purposes: Purpose) -> NDArray[np.uint64]:
    """Beginnings of the hashes of purposes, see `raw`: (k,)."""
    start = _mixed(np.array([int(seed) * _GAMMA % 2**64], np.uint64))
    return _mixed(start + np.array([one.value * _GAMMA % 2**64 for one in purposes], np.uint64))


def raw(
    seed: int, purpose: Purpose, scan: ArrayLike, ray: ArrayLike, number: ArrayLike = 0
) -> NDArray[np.uint64]:
    """64 random bits for each ray: uint64 (n,).

    The seed is below 2**63. The others are (n,) or one for all: the ray within its scan,
    below 2**32, and the number, below 256.
    """
    start = starts(seed, purpose)
    # A stream of SplitMix64 for each scan, of which a ray has 256 numbers.
    begins = _mixed(start + np.asarray(scan).astype(np.uint64) * np.uint64(_GAMMA))
    steps = np.asarray(ray).astype(np.uint64) * np.uint64(_NUMBERS)
    steps = steps + np.asarray(number).astype(np.uint64) + np.uint64(1)
    return _mixed(begins + steps * np.uint64(_GAMMA))


def uniform(
    seed: int, purpose: Purpose, scan: ArrayLike, ray: ArrayLike, number: ArrayLike = 0
) -> Floats:
    """Numbers uniform in [0, 1), multiples of 2**-53: (n,); arguments as of `raw`."""
    bits = raw(seed, purpose, scan, ray, number) >> np.uint64(11)
    return bits.astype(np.float64) * 2.0**-53


def normal(
    seed: int, purpose: Purpose, scan: ArrayLike, ray: ArrayLike, number: ArrayLike = 0
) -> Floats:
    """Numbers of mean 0 and variance 1, normally distributed: (n,); arguments as of `raw`.

    They are quantiles of 65,536 equal shares of the distribution, so none is beyond 4.3.
    """
    return quantiles()[raw(seed, purpose, scan, ray, number) >> np.uint64(48)]


@cache
def quantiles() -> Floats:
    """Quantiles of 65,536 equal shares of the normal distribution."""
    shares = (np.arange(2**15) + 0.5) / 2**16
    low = np.array([NormalDist().inv_cdf(share) for share in shares])
    table = np.concatenate([low, -low[::-1]])
    # To single precision, in which the logarithms of C libraries are the same.
    return (table / np.sqrt((table**2).mean())).astype(np.float32).astype(np.float64)
