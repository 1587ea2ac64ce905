"""Light of a sensor, and the returns that it reports."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..base.arguments import checked_fields
from ..base.errors import LidarpoolError
from .disc import SUBRAYS

LIGHT_M_NS = 0.299792458  # in vacuum; in air it is slower by 0.03 %
MODES = ("strongest", "first", "last", "dual", "all")

Mode = Literal["strongest", "first", "last", "dual", "all"]


def check_numbers(thing: object, limits: Mapping[str, tuple[float, float]]) -> None:
    """Refuse fields outside their limits, both included; LidarpoolError names the first."""
    for name, (least, most) in limits.items():
        value = getattr(thing, name)
        if value is not None and not least <= value <= most:  # nor NaN
            allowed = f"at least {least:g}" if most == np.inf else f"{least:g} to {most:g}"
            raise LidarpoolError(f"{name} is {value}; it must be {allowed}.")


@dataclass(frozen=True)
@checked_fields
class Optics:
    """Light and resolution of a sensor.

    Parameters
    ----------
    wavelength_nm
        Of the laser; 905 if no source states it.
    divergence_mrad
        Full angle of the beam's cone, at 1/e² of its maximum; None if unknown.
    pulse_ns
        Length of a pulse.
    resolution_m
        Of reported ranges: default step for rounding positions.
    """

    wavelength_nm: float = 905.0
    divergence_mrad: float | None = None
    pulse_ns: float = 5.0
    resolution_m: float = 0.01

    def __post_init__(self) -> None:
        limits = {"wavelength_nm": (200, 20_000), "divergence_mrad": (0, 1000)}
        check_numbers(self, {**limits, "pulse_ns": (0, 1e6), "resolution_m": (1e-6, 1000)})


@dataclass(frozen=True)
@checked_fields
class Returns:
    """Sub-rays of a beam, and which returns are reported.

    Parameters
    ----------
    mode
        Returns of a pulse to report: the strongest, the first, the last, the strongest and the
        last ("dual"; the two strongest if those are one), or all.
    subrays
        Rays in a beam: 1, 7, 19, 37, 61, 91, 127, 169 or 217.
    divergence_mrad
        Full angle of the beam; None for the sensor's.
    pulse_ns
        Length of the pulse; None for the sensor's. Hits within half of it are one return.

    Raises
    ------
    LidarpoolError
        If there is no such mode, or a number is outside its range.
    """

    mode: Mode = "strongest"
    subrays: int = 1
    divergence_mrad: float | None = None
    pulse_ns: float | None = None

    def __post_init__(self) -> None:
        if self.subrays not in SUBRAYS:
            known = ", ".join(map(str, SUBRAYS))
            raise LidarpoolError(f"subrays is {self.subrays}; it must be one of {known}.")
        check_numbers(self, {"divergence_mrad": (0, 1000), "pulse_ns": (0, 1e6)})

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
        pulse_ns = optics.pulse_ns if self.pulse_ns is None else self.pulse_ns
        return (wide or 0.0) / 1000, LIGHT_M_NS * pulse_ns / 2


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
