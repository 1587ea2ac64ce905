"""Noise model of a sensor, with range and angle errors, lost returns and false alarms."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf
from typing import Annotated

import numpy as np
from pydantic import Field

from ..errors import LidarError
from ..media.materials import normal_incidence_energy
from ..numerics.random_numbers import named_seed
from ..schema.checks import check_fields
from ..schema.declared import AngleDeg, Seed, Several, UnitShare, about, describe_allowed
from ..schema.value_texts import one_line

# Detection threshold for signal plus noise, in standard deviations.
THRESHOLD_SIGMAS = 5.0
TARGET_REFLECTANCE = 0.1  # reflectance to which specified detection ranges refer
# Maximum mean number of false alarms per pulse. Each ray has random numbers for 255 alarms.
MAX_ALARMS = 20

Meters = Annotated[float, Field(ge=0, le=1000)]
Bias = Annotated[float, Field(ge=-1000, le=1000)]
DecayTime = Annotated[float, Field(gt=0, le=1e7)]
AngleSigma = Annotated[float, Field(ge=0, le=10)]  # degrees


@dataclass(frozen=True)
class Noise:
    """Noise model of a sensor: range and angle errors, lost returns, and false alarms.

    By default, the sensor is ideal.

    The standard deviation of a range of r meters is ``range_m + range_per_m * r``. The term
    `range_at_threshold_m`, multiplied by the ratio of the detection threshold to the energy of the
    return, is added in quadrature. Rays are cast in noisy directions but reported with noise-free
    angles. Detection ranges refer to perpendicular surfaces in clear air.

    Raises
    ------
    LidarError
        If a number is out of range, or if `detection_range_m` is required but not set.
    """

    range_m: Annotated[Meters, about("standard deviation of the range in meters", 0.02)] = 0.0
    range_per_m: Annotated[
        float, about("increase of the standard deviation per meter of range", 0.0002, ge=0, le=1)
    ] = 0.0
    angle_deg: Annotated[
        AngleSigma, about("standard deviation of the beam direction in degrees, in both axes", 0.05)
    ] = 0.0
    dropout: Annotated[
        UnitShare, about("fraction of returns that are lost, regardless of their energy")
    ] = 0.0
    detection_range_m: Annotated[
        float | None,
        about(
            "range in meters at which half of the pulses are detected on a surface with 10 % "
            "reflectance; defines the detection threshold, below which returns are lost",
            100.0,
            ge=0.001,
            le=1e8,
        ),
    ] = None
    seed: Annotated[Seed, about("seed of the noise; the same seed produces the same noise")] = 0
    overlap_m: Annotated[
        Meters,
        about(
            "range in meters beyond which the receiver sees the whole beam; at closer range, "
            "returns from rain, snow, fog and dust do not become stronger"
        ),
    ] = 10.0
    range_at_threshold_m: Annotated[
        Meters,
        about(
            "standard deviation of the range, in meters, of a return at the detection threshold; "
            "inversely proportional to the energy, and added in quadrature",
            0.05,
        ),
    ] = 0.0
    walk_m: Annotated[
        float,
        about(
            "range walk, which is the distance in meters by which a return at 1.65 times the "
            "detection threshold appears closer; 4.3 times as large at 10,000 times the threshold",
            0.02,
            ge=0,
            le=10,
        ),
    ] = 0.0
    false_alarm_hz: Annotated[
        float,
        about(
            "rate of false alarms from dark counts and sunlight in Hz, while the receiver waits "
            "for returns",
            200.0,
            ge=0,
            le=1e9,
        ),
    ] = 0.0
    stray_light: Annotated[
        UnitShare,
        about(
            "blooming of retroreflectors, as the fraction of their light that a beam 1 degree "
            "away receives; decreases with the square of the angle",
            1e-6,
        ),
    ] = 0.0

    crosstalk: Annotated[
        bool, about("whether the sensor receives pulses from other sensors in the survey")
    ] = False
    velocity_m_s: Annotated[
        float, about("standard deviation of the radial velocity in m/s", ge=0, le=1000)
    ] = 0.0
    saturation: Annotated[
        float | None,
        about(
            "signal that saturates the receiver, as a multiple of the detection threshold; "
            "stronger pulses are clipped and widened, and hide returns close to them (default: no "
            "saturation)",
            100.0,
            ge=1,
            le=1e12,
        ),
    ] = None
    channel_bias_m: Annotated[
        Meters | Several[Bias],
        describe_allowed("a number from 0 to 1000, or a list of numbers, one for each channel"),
        about(
            "constant range errors of the channels in meters, as a standard deviation or as one "
            "value per channel"
        ),
    ] = 0.0
    warm_up_m: Annotated[
        Bias, about("range error in meters at the start of the warm-up, which decays exponentially")
    ] = 0.0
    warm_up_s: Annotated[
        DecayTime, about("time in seconds in which the warm-up error decays to 37 %")
    ] = 600.0
    ripple_deg: Annotated[
        AngleSigma, about("amplitude in degrees of the periodic azimuth error of a rotating head")
    ] = 0.0
    ripple_cycles: Annotated[
        int, about("number of periods of the azimuth error per revolution", ge=1, le=100_000)
    ] = 1
    ripple_phase_deg: Annotated[
        AngleDeg, about("phase of the azimuth error in degrees at azimuth 0")
    ] = 0.0

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)
        if np.ndim(self.channel_bias_m):
            biases = tuple(np.asarray(self.channel_bias_m, np.float64).tolist())
            object.__setattr__(self, "channel_bias_m", biases)
        threshold_fields = (
            "range_at_threshold_m",
            "walk_m",
            "false_alarm_hz",
            "stray_light",
            "crosstalk",
        )
        if self.detection_range_m is None:
            for name in (*threshold_fields, "saturation"):
                if getattr(self, name):
                    raise LidarError(
                        f"noise.{name} is relative to the detection threshold and requires "
                        "noise.detection_range_m."
                    )

    @property
    def threshold(self) -> float:
        """Energy at which half of the returns are detected, or 0 without a detection range."""
        if self.detection_range_m is None:
            return 0.0
        return float(TARGET_REFLECTANCE * normal_incidence_energy(self.detection_range_m))

    @property
    def saturation_energy(self) -> float:
        """Energy at which the receiver saturates, or infinity if it never saturates."""
        return inf if self.saturation is None else self.saturation * self.threshold

    @property
    def loses_returns(self) -> bool:
        """Whether returns can be lost."""
        return self.dropout > 0 or self.detection_range_m is not None

    @property
    def has_range_errors(self) -> bool:
        """Whether measured ranges differ from the true ranges."""
        random = self.range_m, self.range_per_m, self.range_at_threshold_m
        return any((*random, self.walk_m, self.channel_bias_m, self.warm_up_m))

    def for_sensor(self, name: str) -> Noise:
        """Return a copy with a seed that also depends on the name of a sensor."""
        return replace(self, seed=named_seed(self.seed, name))
