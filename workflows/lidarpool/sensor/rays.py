"""Sensors whose rays lie on no cones about an axis: behind two prisms, or listed one by one."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from .beams import Beams
from .sensor import Sensor


@dataclass(frozen=True, eq=False)
class PrismSensor(Sensor):
    """One beam along x through two wedge prisms that turn about x at rates of their own.

    The head is only the clock. Directions follow exactly from Snell's law in vectors at each of
    the four faces. The prisms stand back to back: where the first has its inclined face before
    its flat one, the second has it behind. They are thin: all rays leave from the sensor's
    centre. No turn of both together is short enough to be called a period.

    Parameters
    ----------
    wedge_deg
        Angle between the two faces of a prism.
    index
        Refractive index of both.
    rpm
        Turns a minute of the first and the second prism, about x from y to z.
    phase_deg
        Where their thin edges are at time 0, likewise.
    inclined_first
        Whether the beam enters the first prism by its inclined face.
    """

    beams: Beams = field(default_factory=lambda: Beams(np.zeros(1)))
    wedge_deg: float = 18.0
    index: float = 1.5
    rpm: tuple[float, float] = (7294.0, -4664.0)
    phase_deg: tuple[float, float] = (0.0, 0.0)
    inclined_first: bool = False
    cycle: ClassVar[str] = "frame"

    @property
    def period(self) -> int | None:
        """See `Sensor.period`."""
        return None

    def directions(self, firings: NDArray[np.int64]) -> NDArray[np.float64]:
        """See `Sensor.directions`."""
        minutes = self.head.times_ns(firings) / 60e9
        wedge, flat = np.radians(self.wedge_deg), np.array([[1.0], [0.0], [0.0]])
        ray = np.zeros((3, len(firings)))
        ray[0] = 1
        for number, (rpm, phase) in enumerate(zip(self.rpm, self.phase_deg, strict=True)):
            # Within a turn first: the cosine of a large angle has lost digits.
            angle = 2 * np.pi * ((rpm * minutes + phase / 360) % 1)
            # Normals along the way of the light; the faces part towards the thick edge.
            inclined = np.empty_like(ray)
            inclined[0] = np.cos(wedge)
            inclined[1], inclined[2] = np.sin(wedge) * np.cos(angle), np.sin(wedge) * np.sin(angle)
            if self.inclined_first == (number == 0):
                inclined[1:] *= -1
                ray = _refracted(_refracted(ray, inclined, 1 / self.index), flat, self.index)
            else:
                ray = _refracted(_refracted(ray, flat, 1 / self.index), inclined, self.index)
        return np.ascontiguousarray(ray.T)[:, None, :]


def _refracted(
    rays: NDArray[np.float64], normals: NDArray[np.float64], ratio: float
) -> NDArray[np.float64]:
    """Rays (3, k) behind a face, by Snell's law; `ratio` is the index before over that behind.

    The normals (3, k), or (3, 1), point along the way of the light.
    """
    along = (rays * normals).sum(axis=0)
    behind = np.sqrt(1 - ratio**2 * (1 - along**2))
    return ratio * rays + (behind - ratio * along) * normals


@dataclass(frozen=True, eq=False)
class ListedSensor(Sensor):
    """Rays listed one by one, as in a maker's file: one beam, each firing another direction.

    After the last it begins again. The head's time steps are shares of the list; its own times
    and azimuths have no meaning.

    Parameters
    ----------
    rays
        float64 (n, 3): unit directions in the order of firing.
    shot_ns
        float64 (n,): when each is fired, from 0 on, in order.
    cycle_ns
        How long the list takes.
    """

    beams: Beams = field(default_factory=lambda: Beams(np.zeros(1)))
    rays: NDArray[np.float64] = field(default_factory=lambda: np.array([[1.0, 0, 0]]))
    shot_ns: NDArray[np.float64] = field(default_factory=lambda: np.zeros(1))
    cycle_ns: float = 1e8
    cycle: ClassVar[str] = "frame"

    @property
    def period(self) -> int | None:
        """See `Sensor.period`."""
        return len(self.rays)

    def directions(self, firings: NDArray[np.int64]) -> NDArray[np.float64]:
        """See `Sensor.directions`."""
        return self.rays[firings % len(self.rays)][:, None, :]

    def begins_ns(self, firings: NDArray[np.int64]) -> NDArray[np.float64]:
        """See `Sensor.begins_ns`."""
        cycles, shots = np.divmod(firings, len(self.rays))
        times: NDArray[np.float64] = self.start_ns + cycles * self.cycle_ns + self.shot_ns[shots]
        return times
