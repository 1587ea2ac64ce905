"""Light of a sensor, and the returns that it reports."""

from __future__ import annotations

from dataclasses import dataclass
from math import log, pi, sqrt
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ..base.arguments import checked_fields
from ..base.errors import LidarpoolError
from .disc import SUBRAYS

LIGHT_M_NS = 0.299792458  # in vacuum; in air it is slower by 0.03 %
FWHM = sqrt(8 * log(2))  # full width at half maximum of a Gaussian, in standard deviations
WINDOW_SIGMAS = 10  # that an echo takes in a waveform, to both sides together
# Standard deviation of the response of a Gaussian receiver times its bandwidth at -3 dB.
_RESPONSE = sqrt(log(2)) / (2 * pi)

Processing = Literal["none", "peaks", "gaussian"]
Mode = Literal["strongest", "first", "last", "dual", "all"]
# Full angle of a beam's cone, at 1/e² of its maximum.
Divergence = Annotated[float, Field(ge=0, le=1000)]
Pulse = Annotated[float, Field(ge=0, le=1e6)]
Precision = Annotated[float, Field(ge=1e-6, le=1000)]


@dataclass(frozen=True)
@checked_fields
class Optics:
    """Light and resolution of a sensor."""

    wavelength_nm: Annotated[
        float, Field(ge=200, le=20_000, description="of the laser; 905 if no source states it")
    ] = 905.0
    divergence_mrad: Annotated[
        Divergence | None, Field(description="full angle of the beam; None if unknown")
    ] = None
    pulse_ns: Annotated[Pulse, Field(description="length of a pulse")] = 5.0
    resolution_m: Annotated[
        Precision, Field(description="of reported ranges: default step for rounding positions")
    ] = 0.01


@dataclass(frozen=True)
@checked_fields
class Returns:
    """Sub-rays of a beam, and which of its returns are reported.

    "dual" reports the strongest and the last return, or the two strongest if those are one.

    Raises
    ------
    LidarpoolError
        If there is no such mode, or a number is outside its range.
    """

    mode: Annotated[
        Mode,
        Field(
            description="returns reported for a pulse; dual: strongest and last",
            examples=["dual"],
        ),
    ] = "strongest"
    subrays: Annotated[
        Literal[SUBRAYS],  # type: ignore[valid-type]
        Field(
            description="rays in a beam: 1, 7, 19, 37, 61, … 217; auto by performance",
            examples=[1],
        ),
    ] = 1
    divergence_mrad: Annotated[
        Divergence | None,
        Field(description="full angle of the beam; by default the sensor's", examples=[3.0]),
    ] = None
    pulse_ns: Annotated[
        Pulse | None,
        Field(
            description="length of the pulse, in waveforms at half of its maximum: surfaces less "
            "than half of it apart are one return; by default the sensor's, or 5",
            examples=[5.0],
        ),
    ] = None
    waveform: Annotated[
        Processing,
        Field(
            description="how returns are found in the waveform: peaks, or gaussian decomposition; "
            "none: hits within half of the pulse are one return"
        ),
    ] = "none"
    sample_ns: Annotated[
        float, Field(ge=0.001, le=1000, description="time between two samples of the waveform")
    ] = 1.0
    bandwidth_mhz: Annotated[
        float | None,
        Field(
            ge=0.1,
            le=1e6,
            description="of the receiver of waveforms, at -3 dB; by default without limit",
            examples=[300.0],
        ),
    ] = None

    def of(self, optics: Optics) -> tuple[float, float]:
        """Divergence, radians, and least distance of two returns, metres.

        Raises
        ------
        LidarpoolError
            If there are sub-rays, and the divergence is unknown.
        """
        wide = optics.divergence_mrad if self.divergence_mrad is None else self.divergence_mrad
        if wide is None and self.subrays > 1:
            raise LidarpoolError(
                f"returns.subrays is {self.subrays}, but the sensor has no divergence: give "
                "returns.divergence_mrad."
            )
        return (wide or 0.0) / 1000, LIGHT_M_NS * self.length_ns(optics) / 2

    def length_ns(self, optics: Optics) -> float:
        """Length of the pulse."""
        return optics.pulse_ns if self.pulse_ns is None else self.pulse_ns

    def system_ns(self, optics: Optics) -> float:
        """Return the standard deviation of the system waveform, ns.

        That is the pulse as the receiver sees it: both are Gaussian, and convolved.

        Raises
        ------
        LidarpoolError
            If the samples are too far apart for it.
        """
        response = 0.0 if self.bandwidth_mhz is None else 1000 * _RESPONSE / self.bandwidth_mhz
        sigma = sqrt((self.length_ns(optics) / FWHM) ** 2 + response**2)
        if not 2 * self.sample_ns <= FWHM * sigma * (1 + 1e-9):
            raise LidarpoolError(
                f"returns.sample_ns is {self.sample_ns:g}, and the pulse is {FWHM * sigma:.3g} ns "
                f"wide in the waveform: sample it twice at least, every {FWHM * sigma / 2:.3g} ns, "
                "or give a longer pulse_ns."
            )
        return sigma


def spread(
    directions: NDArray[np.float64], across: NDArray[np.float64], up: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Turn unit directions (n, 3) by small angles (n, k) or (1, k), radians: (n, k, 3), unit.

    The two axes across a ray are those of Duff et al. 2017, which exist for every direction.
    """
    x, y, z = directions.T
    sign = np.where(z < 0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    one = np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=1)
    other = np.stack([b, sign + y * y * a, -y], axis=1)
    straight = 1 / np.sqrt(1 + across**2 + up**2)
    across, up = across * straight, up * straight
    out = np.empty((3, len(directions), across.shape[1]))
    for axis in range(3):
        ahead, first, second = (v[:, axis, None] for v in (directions, one, other))
        out[axis] = (straight * ahead + across * first) + up * second
    return out.transpose(1, 2, 0)
