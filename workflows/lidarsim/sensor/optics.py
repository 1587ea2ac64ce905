"""Optical parameters of a sensor, and settings of the returns that it reports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi, sqrt
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from ..errors import LidarError
from ..numerics.elementary_scalars import log_of
from ..numerics.vectors import hypot
from ..schema.checks import check_fields
from ..schema.declared import FileSection, about, describe_allowed
from ..schema.value_texts import one_line
from ..words import format_rounded
from .disc import SUBRAYS, Beam, Profile
from .reflectivity import SCALES

LIGHT_M_NS = 0.299792458  # speed of light in vacuum; the speed in air is 0.03 % lower
FWHM = sqrt(8 * log_of(2.0))  # full width at half maximum of a Gaussian, in standard deviations
# Cosine of incidence below which the correction of reported intensities does not increase further.
MIN_COSINE = 0.01
# Width of a return in a waveform, in standard deviations of the system waveform.
WINDOW_SIGMAS = 10
# Number of standard deviations beyond which a return is set to 0, because it is less than 4e-6 of
# its maximum.
CUT = WINDOW_SIGMAS / 2
# Product of a Gaussian receiver's -3 dB bandwidth and the standard deviation of its response.
_RESPONSE = sqrt(log_of(2.0)) / (2 * pi)

Processing = Literal["none", "peaks", "gaussian"]
Mode = Literal["strongest", "first", "last", "dual", "two_strongest", "all"]
SINGLE_RETURN: tuple[Mode, ...] = ("strongest", "first", "last")  # modes with one return
TWO_RETURNS: tuple[Mode, ...] = ("dual", "two_strongest")  # modes with at most two returns


_USUAL_NM = 905.0  # wavelength of most lidars
AngleMrad = Annotated[float, Field(ge=0, le=1000)]
# Full cone angle of a beam at 1/e² of the maximum, or a horizontal and a vertical angle.
Divergence = Annotated[
    AngleMrad | Annotated[Sequence[AngleMrad], Field(min_length=2, max_length=2)],
    describe_allowed("from 0 to 1000, or two such numbers as [horizontal, vertical]"),
]
Diameter = Annotated[float, Field(ge=0, le=10)]
Wavelength = Annotated[float, Field(ge=200, le=20_000)]
Pulse = Annotated[float, Field(ge=0, le=1e6)]
Precision = Annotated[float, Field(ge=1e-6, le=1000)]


@dataclass(frozen=True)
class Optics(FileSection):
    """Optical parameters and range resolution of a sensor."""

    wavelength_nm: Annotated[
        Wavelength | None,
        about("laser wavelength in nanometers, or None if it is unknown and simulated as 905"),
    ] = None
    divergence_mrad: Annotated[
        Divergence | None,
        about(
            "full divergence angle of the beam in mrad, or a horizontal and a vertical angle; None "
            "if unknown"
        ),
    ] = None
    pulse_ns: Annotated[Pulse, about("duration of a pulse in nanoseconds")] = 5.0
    resolution_m: Annotated[
        Precision | None,
        about("range resolution in meters, the default precision of positions; None if unknown"),
    ] = None
    beam_profile: Annotated[Profile, about("distribution of light over the sub-rays of a beam")] = (
        "even"
    )
    exit_diameter_m: Annotated[Diameter, about("width of the beam where it leaves the sensor")] = (
        0.0
    )
    reflectivity: Annotated[
        Literal[tuple(SCALES)],  # type: ignore[valid-type]
        about("scale of the column `reflectivity`; Velodyne's if unknown"),
    ] = "velodyne"
    incidence_exponent: Annotated[
        float,
        about(
            "exponent of the cosine of incidence in reported intensities; 1 for received "
            "intensities",
            ge=0,
            le=4,
        ),
    ] = 1.0

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)
        if isinstance(self.divergence_mrad, (Sequence, np.ndarray)):
            object.__setattr__(self, "divergence_mrad", tuple(self.divergence_mrad))

    @property
    def simulated_nm(self) -> float:
        """Wavelength of the simulated light in nanometers, which is 905 if it is unknown."""
        return _USUAL_NM if self.wavelength_nm is None else self.wavelength_nm


@dataclass(frozen=True)
class Returns:
    """Settings for the sub-rays of a beam, and for the returns that are reported per pulse.

    The mode "dual" reports the strongest and the last return, or the two strongest returns if the
    last return is the strongest. The mode "two_strongest" always reports the two strongest returns.

    Raises
    ------
    LidarError
        If the mode is unknown, or if a number is out of range.
    """

    mode: Annotated[
        Mode,
        about(
            "returns that are reported per pulse; dual reports the strongest and the last", "dual"
        ),
    ] = "strongest"
    subrays: Annotated[
        Literal[SUBRAYS],  # type: ignore[valid-type]
        about(
            "number of rays per beam: 1, 7, 19, 37, 61, … 217 (default: 1, or 7 if performance is "
            "datasheet)",
            1,
        ),
    ] = 1
    divergence_mrad: Annotated[
        Divergence | None,
        about(
            "full divergence angle of the beam in mrad, or a horizontal and a vertical angle "
            "(default: from the sensor)",
            3.0,
        ),
    ] = None
    pulse_ns: Annotated[
        Pulse | None,
        about(
            "duration of the pulse in nanoseconds, at half maximum for waveforms; surfaces that "
            "are less than half of the pulse length apart merge into one return (default: from the "
            "sensor, otherwise 5)",
            5.0,
        ),
    ] = None
    beam_profile: Annotated[
        Profile | None,
        about(
            "distribution of light over the beam (default: from the sensor, otherwise even)",
            "gaussian",
        ),
    ] = None
    exit_diameter_m: Annotated[
        Diameter | None,
        about(
            "diameter of the beam in meters where it leaves the sensor (default: from the sensor, "
            "otherwise 0)",
            0.01,
        ),
    ] = None
    waveform: Annotated[
        Processing,
        about(
            "how returns are extracted from the waveform: peaks detects its peaks, and gaussian "
            "decomposes it into Gaussians; with none, no waveform is computed, and hits within "
            "half of the pulse length merge into one return"
        ),
    ] = "none"
    sample_ns: Annotated[
        float, about("sampling interval of the waveform in nanoseconds", ge=0.001, le=1000)
    ] = 1.0
    bandwidth_mhz: Annotated[
        float | None,
        about(
            "bandwidth (-3 dB) of the waveform receiver in MHz (default: unlimited)",
            300.0,
            ge=0.1,
            le=1e6,
        ),
    ] = None

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)
        if isinstance(self.divergence_mrad, (Sequence, np.ndarray)):
            object.__setattr__(self, "divergence_mrad", tuple(self.divergence_mrad))

    def divergence(self, optics: Optics) -> float:
        """Return the full divergence angle of the beam, in radians.

        If the horizontal and the vertical angle differ, the result is their geometric mean.

        Raises
        ------
        LidarError
            If the beam has several sub-rays but its divergence is unknown.
        """
        across, up = self._divergences(optics)
        return across if across == up else float(np.sqrt(across * up))

    def min_gap_m(self, optics: Optics) -> float:
        """Return the minimum distance between two separate returns, in meters.

        This distance is half the length of the pulse.
        """
        return LIGHT_M_NS * self.length_ns(optics) / 2

    def beam(self, optics: Optics) -> Beam:
        """Return the sub-rays of a sensor's beam.

        Raises
        ------
        LidarError
            If the beam has several sub-rays but its divergence is unknown.
        """
        profile = optics.beam_profile if self.beam_profile is None else self.beam_profile
        divergences = self._divergences(optics)
        return Beam.from_divergences(self.subrays, divergences, profile, self.exit_m(optics))

    def exit_m(self, optics: Optics) -> float:
        """Return the width of the beam at the sensor's exit in meters, or 0 if it is unknown."""
        return optics.exit_diameter_m if self.exit_diameter_m is None else self.exit_diameter_m

    def _divergences(self, optics: Optics) -> tuple[float, float]:
        """Return the full horizontal and vertical divergence angles of the beam, in radians."""
        divergence_mrad = (
            optics.divergence_mrad if self.divergence_mrad is None else self.divergence_mrad
        )
        if divergence_mrad is None and self.subrays > 1:
            raise LidarError(
                f"returns.subrays is {self.subrays}, but the beam divergence of the sensor is "
                "unknown. Set returns.divergence_mrad."
            )
        if isinstance(divergence_mrad, Sequence):
            across, up = divergence_mrad
        else:
            across = up = divergence_mrad or 0.0
        return across / 1000, up / 1000

    def length_ns(self, optics: Optics) -> float:
        """Return the pulse length in nanoseconds."""
        return optics.pulse_ns if self.pulse_ns is None else self.pulse_ns

    def system_ns(self, optics: Optics) -> float:
        """Return the standard deviation of the system waveform in nanoseconds.

        The system waveform is the convolution of the pulse and the receiver's response, which are
        both Gaussian.

        Raises
        ------
        LidarError
            If the interval between samples is too long to resolve the waveform.
        """
        response = 0.0 if self.bandwidth_mhz is None else 1000 * _RESPONSE / self.bandwidth_mhz
        sigma = hypot(self.length_ns(optics) / FWHM, response)
        if not 2 * self.sample_ns <= FWHM * sigma * (1 + 1e-9):
            raise LidarError(
                f"returns.sample_ns must be at most {format_rounded(FWHM * sigma / 2)}, which is "
                f"half of the pulse width in the waveform, but is {self.sample_ns:g}. Reduce it, "
                "or increase pulse_ns."
            )
        return sigma
