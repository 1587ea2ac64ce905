"""Sensors without conical beams: behind prisms, or with listed rays."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from ..base.arrays import Floats, Ints
from ..base.elementary import sin_cos
from ..base.elementary_scalars import sin_cos_of
from ..base.errors import LidarError
from ..base.validation import checked_fields
from .beams import Beams
from .sensor import Sensor


@dataclass(frozen=True)
@checked_fields
class Prism:
    """A wedge prism that turns about x."""

    wedge_deg: float  # angle between its two faces
    index: Annotated[float, Field(gt=0)]  # refractive
    rpm: float  # turns a minute about x, from y to z
    phase_deg: float = 0.0  # angle of its thin edge at time 0, likewise
    inclined_first: bool = False  # light enters through the inclined face; else the flat one


@dataclass(frozen=True)
@checked_fields
class TurningMirror:
    """A plane mirror behind the prisms, which turns about their axis and looks up."""

    tilt_deg: Annotated[float, Field(gt=0, lt=90)]  # angle between its normal and the axis
    rpm: float  # turns a minute about the axis, from x to y of the sensor
    phase_deg: float = 0.0  # azimuth of its normal at time 0, likewise


@dataclass(frozen=True, eq=False)
class PrismSensor(Sensor):
    """Beams along x through wedge prisms that turn about x at different rates.

    With a mirror, the axis of prisms and mirror is z instead, and y and z of the prisms are x and y
    of the sensor. The head is only the clock. Directions are exact by Snell's law at each face.
    Prisms are thin: all rays start at the sensor's centre. The pattern has no useful period.
    """

    # One along x by default; others enter the first prism at an angle.
    beams: Beams = field(default_factory=lambda: Beams(np.zeros(1)))
    # In the order in which light passes them.
    prisms: tuple[Prism, ...] = (Prism(18, 1.5, 7294), Prism(18, 1.5, -4664, 0, True))
    mirror: TurningMirror | None = None
    cycle: ClassVar[str] = "frame"

    def __post_init__(self) -> None:
        super().__post_init__()
        self.directions(np.arange(0, 100_000, 97))  # LidarError if light does not get through

    @property
    def period(self) -> int | None:
        """See `Sensor.period`."""
        return None

    def directions(self, firings: Ints) -> Floats:
        """See `Sensor.directions`."""
        minutes = self.head.times_ns(firings) / 60e9
        flat = np.array([1.0, 0, 0])[:, None, None]
        ray = np.repeat(self.ahead.T[:, None, :], len(firings), axis=1)
        for prism in self.prisms:
            # Reduced to a turn first: the cosine of a large angle loses digits.
            angle = 2 * np.pi * ((prism.rpm * minutes + prism.phase_deg / 360) % 1)
            # Normals along the light's direction; the faces diverge towards the thick edge.
            sine, cosine = sin_cos_of(math.radians(prism.wedge_deg))
            inclined = np.empty((3, len(firings), 1))
            inclined[0] = cosine
            inclined[1:, :, 0] = sine * np.stack(sin_cos(angle)[::-1])
            if prism.inclined_first:
                inclined[1:] *= -1
            faces = (inclined, flat) if prism.inclined_first else (flat, inclined)
            for face, ratio in zip(faces, (1 / prism.index, prism.index), strict=True):
                ray = _refracted(ray, face, ratio)
        if self.mirror is not None:
            ray = self._reflected(ray, minutes)
        return np.ascontiguousarray(ray.transpose(1, 2, 0))

    def _reflected(self, rays: Floats, minutes: Floats) -> Floats:
        """Reflect rays (3, k, c) at the mirror, at times (k,): (3, k, c), z along the axis."""
        assert self.mirror is not None
        angle = 2 * np.pi * ((self.mirror.rpm * minutes + self.mirror.phase_deg / 360) % 1)
        sine, cosine = sin_cos_of(math.radians(self.mirror.tilt_deg))
        normal = np.empty((3, len(minutes), 1))
        normal[0] = -cosine
        normal[1:, :, 0] = sine * np.stack(sin_cos(angle)[::-1])
        reflected = rays - 2 * (rays * normal).sum(axis=0) * normal
        return reflected[[1, 2, 0]]


def _refracted(rays: Floats, normals: Floats, ratio: float) -> Floats:
    """Rays (3, k, c) behind a face, by Snell's law; `ratio` is the index before over that behind.

    The normals (3, k, 1), or (3, 1, 1), point along the light's direction.
    """
    along = (rays * normals).sum(axis=0)
    behind = 1 - ratio * ratio * (1 - along * along)
    if not (behind >= 0).all():
        raise LidarError(
            "A prism reflects light back at its inner face, so that no ray leaves the sensor: "
            "make its wedge or its index smaller."
        )
    behind = np.sqrt(behind)
    return ratio * rays + (behind - ratio * along) * normals


@dataclass(frozen=True, eq=False)
class ListedSensor(Sensor):
    """Rays listed one by one, as in a maker's file: one beam, each firing another direction.

    The list repeats. The head's time steps are parts of the list; its times and azimuths are
    not used.
    """

    beams: Beams = field(default_factory=lambda: Beams(np.zeros(1)))
    # (n, 3): unit directions in the order of firing, and (n,): firing times from 0 on.
    rays: Floats = field(default_factory=lambda: np.array([[1.0, 0, 0]]))
    shot_ns: Floats = field(default_factory=lambda: np.zeros(1))
    cycle_ns: float = 1e8  # duration of the list
    cycle: ClassVar[str] = "frame"

    @property
    def period(self) -> int | None:
        """See `Sensor.period`."""
        return len(self.rays)

    def directions(self, firings: Ints) -> Floats:
        """See `Sensor.directions`."""
        return self.rays[firings % len(self.rays)][:, None, :]

    def begins_ns(self, firings: Ints) -> Floats:
        """See `Sensor.begins_ns`."""
        cycles, shots = np.divmod(firings, len(self.rays))
        times: Floats = self.start_ns + cycles * self.cycle_ns + self.shot_ns[shots]
        return times
