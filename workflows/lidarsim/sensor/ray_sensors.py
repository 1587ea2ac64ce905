"""Sensors whose beams do not sweep cones: behind prisms, or with listed rays."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, ClassVar
from weakref import WeakKeyDictionary

import numpy as np
from pydantic import Field

from ..errors import LidarError
from ..numerics.arrays import Floats, Ints
from ..numerics.elementary import sin_cos
from ..numerics.elementary_scalars import sin_cos_of
from ..schema.checks import check_fields
from ..schema.value_texts import one_line
from .beams import Beams
from .sensor import Sensor


@dataclass(frozen=True)
class Prism:
    """A wedge prism that turns about x."""

    wedge_deg: float  # angle between its two faces
    index: Annotated[float, Field(gt=0)]  # refractive
    rpm: float  # revolutions a minute about x, from y to z
    phase_deg: float = 0.0  # angle of its thin edge at time 0, from y to z
    inclined_first: bool = False  # light enters through the inclined face, else the flat face

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True)
class TurningMirror:
    """A plane mirror behind prisms, which turns about the axis of the prisms and looks up."""

    tilt_deg: Annotated[float, Field(gt=0, lt=90)]  # angle between its normal and the axis
    rpm: float  # revolutions a minute about the axis, from x to y of the sensor
    phase_deg: float = 0.0  # azimuth of its normal at time 0, from x to y

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True, eq=False, repr=False)
class PrismSensor(Sensor):
    """Beams along x through wedge prisms that turn about x at different rates.

    With a mirror, the axis of prisms and mirror is z instead, and y and z of the prisms are x and y
    of the sensor. The head is only the clock. Directions are exact by Snell's law at each face.
    Prisms are thin: all rays start at the sensor's center. The pattern has no useful period.
    """

    # A beam along x by default; several beams enter the first prism at angles.
    beams: Beams = field(default_factory=lambda: Beams(np.zeros(1)))
    # In the order of the light's path.
    prisms: tuple[Prism, ...] = (Prism(18, 1.5, 7294), Prism(18, 1.5, -4664, 0, True))
    mirror: TurningMirror | None = None
    cycle: ClassVar[str] = "frame"

    def __post_init__(self) -> None:
        super().__post_init__()
        self.directions(np.arange(0, 100_000, 97))  # LidarError if light does not get through

    @property
    def period(self) -> int | None:
        """None: the pattern does not repeat."""
        return None

    def directions(self, firings: Ints) -> Floats:
        """Return the unit directions of firings (k,), in the sensor frame: (k, channels, 3).

        Directions of consecutive firings are read-only. Those of the latest sweeps are kept, as
        packets of a sweep need them again after it was cast.
        """
        count = len(firings)
        key = (int(firings[0]), count) if count else (0, 0)
        if not count or count * self.channels > _MAX_KEPT_RAYS or (np.diff(firings) != 1).any():
            return self._computed_directions(firings)
        kept = _KEPT_DIRECTIONS.setdefault(self, {})
        directions = kept.get(key)
        if directions is None:
            directions = self._computed_directions(firings)
            directions.flags.writeable = False
            for oldest in [*kept][: max(0, len(kept) + 1 - _KEPT_SWEEPS)]:
                kept.pop(oldest, None)  # another thread may have dropped the sweep
            kept[key] = directions
        return directions

    def _computed_directions(self, firings: Ints) -> Floats:
        """Return the directions of `directions`, by Snell's law."""
        minutes = self.head.times_ns(firings) / 60e9
        flat = np.array([1.0, 0, 0])[:, None, None]
        ray = np.repeat(self.ahead.T[:, None, :], len(firings), axis=1)
        for prism in self.prisms:
            # Reduced to one revolution first: the cosine of a large angle loses digits.
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
        """Reflect rays (3, k, c) at the mirror at times (k,), minutes: (3, k, c), z on the axis."""
        assert self.mirror is not None
        angle = 2 * np.pi * ((self.mirror.rpm * minutes + self.mirror.phase_deg / 360) % 1)
        sine, cosine = sin_cos_of(math.radians(self.mirror.tilt_deg))
        normal = np.empty((3, len(minutes), 1))
        normal[0] = -cosine
        normal[1:, :, 0] = sine * np.stack(sin_cos(angle)[::-1])
        reflected = rays - 2 * (rays * normal).sum(axis=0) * normal
        return reflected[[1, 2, 0]]


# {sensor: {(first firing, number of firings): directions}}; not in the sensors, which are pickled.
_KEPT_DIRECTIONS: WeakKeyDictionary[PrismSensor, dict[tuple[int, int], Floats]] = (
    WeakKeyDictionary()
)
_KEPT_SWEEPS = 16
_MAX_KEPT_RAYS = 1 << 16  # rays of a sweep that is kept: 1.5 MB


def _refracted(rays: Floats, normals: Floats, ratio: float) -> Floats:
    """Return the rays (3, k, c) behind a face, by Snell's law.

    `ratio` is the refractive index before the face over the index behind it. The normals
    (3, k, 1), or (3, 1, 1), point along the light's direction.
    """
    # Component by component: arrays of all components would take twice the time.
    cosine = rays[0] * normals[0] + rays[1] * normals[1] + rays[2] * normals[2]
    behind = 1 - ratio * ratio * (1 - cosine * cosine)
    if not (behind >= 0).all():
        raise LidarError(
            "No ray leaves the sensor because of total internal reflection in a prism. Reduce its "
            "wedge angle or its refractive index."
        )
    along_normal = np.sqrt(behind) - ratio * cosine
    refracted = ratio * rays
    for component, normal in zip(refracted, normals, strict=True):
        component += along_normal * normal
    return refracted


@dataclass(frozen=True, eq=False, repr=False)
class ListedSensor(Sensor):
    """A sensor with a list of rays, as in a maker's file: each firing is the next ray of the list.

    The list repeats. The head's time steps are parts of the list; its times and azimuths are
    not used.
    """

    beams: Beams = field(default_factory=lambda: Beams(np.zeros(1)))
    # (n, 3): unit directions in the order of firing, and (n,): firing times from 0 on.
    rays: Floats = field(default_factory=lambda: np.array([[1.0, 0, 0]]))
    shot_ns: Floats = field(default_factory=lambda: np.zeros(1))
    cycle_ns: float = 1e8  # duration of the list
    starts: Floats | None = None  # (n, 3): starts of the rays, meters; None for the center
    cycle: ClassVar[str] = "frame"

    @property
    def ring_step(self) -> int | None:
        """None: a list may have the rays of several channels in turn."""
        return None

    @property
    def period(self) -> int | None:
        """Number of rays in the list, after which directions repeat."""
        return len(self.rays)

    def directions(self, firings: Ints) -> Floats:
        """Return the unit directions of firings (k,), in the sensor frame: (k, 1, 3)."""
        return self.rays[firings % len(self.rays)][:, None, :]

    def origins(self, firings: Ints) -> Floats | None:
        """Return the starts of the rays of firings (k,), sensor frame: (k, 1, 3), meters.

        None if all rays start at the sensor's center.
        """
        if self.starts is None:
            return None
        return self.starts[firings % len(self.rays)][:, None, :]

    def begins_ns(self, firings: Ints) -> Floats:
        """Return the starts of firings (k,), nanoseconds since the start of the station: (k,)."""
        cycles, shots = np.divmod(firings, len(self.rays))
        times: Floats = self.start_ns + cycles * self.cycle_ns + self.shot_ns[shots]
        return times
