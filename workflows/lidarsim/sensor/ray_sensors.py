"""Sensors whose beams do not sweep cones: prism scanners and lists of rays."""

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
    """A wedge prism that rotates about the x axis."""

    wedge_deg: float  # angle between the two faces
    index: Annotated[float, Field(gt=0)]  # refractive index
    rpm: float  # revolutions per minute about x, from y to z
    phase_deg: float = 0.0  # angle of the thin edge at time 0, from y to z
    inclined_first: bool = False  # whether light enters through the inclined face

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True)
class TurningMirror:
    """A plane mirror behind the prisms, which rotates about their axis."""

    tilt_deg: Annotated[float, Field(gt=0, lt=90)]  # angle between the normal and the axis
    rpm: float  # revolutions per minute about the axis, from x to y of the sensor
    phase_deg: float = 0.0  # azimuth of the normal at time 0, from x to y

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True, eq=False, repr=False)
class PrismSensor(Sensor):
    """A sensor with wedge prisms that rotate about a common axis at different rates.

    By default, the light enters the first prism along the axis, which is the x axis of the sensor.
    If there is a mirror, the common axis of the prisms and the mirror is the z axis instead, and
    the y and z axes of the prisms are the x and y axes of the sensor. The head only provides the
    firing times.

    Ray directions are computed by applying Snell's law at each face. Prisms are treated as thin, so
    that all rays start at the sensor origin. The pattern has no useful period.
    """

    # The default is a single beam along x. Several beams enter the first prism at different angles.
    beams: Beams = field(default_factory=lambda: Beams(np.zeros(1)))
    # Prisms in the order in which the light passes through them.
    prisms: tuple[Prism, ...] = (Prism(18, 1.5, 7294), Prism(18, 1.5, -4664, 0, True))
    mirror: TurningMirror | None = None
    cycle: ClassVar[str] = "frame"

    def __post_init__(self) -> None:
        super().__post_init__()
        self.directions(np.arange(0, 100_000, 97))  # raises LidarError on total reflection

    @property
    def period(self) -> int | None:
        """None, because the pattern does not repeat."""
        return None

    def directions(self, firings: Ints) -> Floats:
        """Return the ray directions of the given firings in the sensor frame.

        For `firings` of shape (k,), the result has shape (k, channels, 3). Directions are unit
        vectors. Directions of consecutive firings are cached for the latest sweeps, because they
        are needed again to encode the packets of a sweep. Cached arrays are read-only.
        """
        count = len(firings)
        key = (int(firings[0]), count) if count else (0, 0)
        if not count or count * self.channels > _MAX_KEPT_RAYS or (np.diff(firings) != 1).any():
            return self._compute_directions(firings)
        kept = _KEPT_DIRECTIONS.setdefault(self, {})
        directions = kept.get(key)
        if directions is None:
            directions = self._compute_directions(firings)
            directions.flags.writeable = False
            for oldest in [*kept][: max(0, len(kept) + 1 - _KEPT_SWEEPS)]:
                kept.pop(oldest, None)  # another thread may have removed the sweep
            kept[key] = directions
        return directions

    def _compute_directions(self, firings: Ints) -> Floats:
        """Compute the result of `directions` by Snell's law."""
        minutes = self.head.times_ns(firings) / 60e9
        flat = np.array([1.0, 0, 0])[:, None, None]
        ray = np.repeat(self.beam_directions.T[:, None, :], len(firings), axis=1)
        for prism in self.prisms:
            # Reduce the angle to one revolution, because the cosine of a large angle is imprecise.
            angle = 2 * np.pi * ((prism.rpm * minutes + prism.phase_deg / 360) % 1)
            # The normals point in the direction of the light. The faces diverge toward the thick
            # edge.
            sine, cosine = sin_cos_of(math.radians(prism.wedge_deg))
            inclined = np.empty((3, len(firings), 1))
            inclined[0] = cosine
            inclined[1:, :, 0] = sine * np.stack(sin_cos(angle)[::-1])
            if prism.inclined_first:
                inclined[1:] *= -1
            faces = (inclined, flat) if prism.inclined_first else (flat, inclined)
            for face, ratio in zip(faces, (1 / prism.index, prism.index), strict=True):
                ray = _refract(ray, face, ratio)
        if self.mirror is not None:
            ray = self._reflect(ray, minutes)
        return np.ascontiguousarray(ray.transpose(1, 2, 0))

    def _reflect(self, rays: Floats, minutes: Floats) -> Floats:
        """Reflect rays off the mirror. The axis of the mirror is the z axis of the result.

        The rays and the result have shape (3, k, c). The times of the firings in minutes have
        shape (k,).
        """
        assert self.mirror is not None
        angle = 2 * np.pi * ((self.mirror.rpm * minutes + self.mirror.phase_deg / 360) % 1)
        sine, cosine = sin_cos_of(math.radians(self.mirror.tilt_deg))
        normal = np.empty((3, len(minutes), 1))
        normal[0] = -cosine
        normal[1:, :, 0] = sine * np.stack(sin_cos(angle)[::-1])
        reflected = rays - 2 * (rays * normal).sum(axis=0) * normal
        return reflected[[1, 2, 0]]


# Cached directions for each sensor, by first firing and number of firings. The cache is not an
# attribute of the sensor because sensors are pickled.
_KEPT_DIRECTIONS: WeakKeyDictionary[PrismSensor, dict[tuple[int, int], Floats]] = (
    WeakKeyDictionary()
)
_KEPT_SWEEPS = 16
_MAX_KEPT_RAYS = 1 << 16  # maximum number of rays in a cached sweep, which takes 1.5 MB


def _refract(rays: Floats, normals: Floats, ratio: float) -> Floats:
    """Refract rays at a face by Snell's law.

    The rays and the result have shape (3, k, c). `ratio` is the refractive index before the face
    divided by the index behind it. The normals point in the direction of the light and have shape
    (3, k, 1) or (3, 1, 1).
    """
    # Components are computed one by one, which takes half as long as whole arrays.
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
    """A sensor that fires the rays of a list, such as a manufacturer's ray list, one by one.

    The list is repeated indefinitely. The head divides the list into time steps, but the times and
    azimuths of the head are not used.
    """

    beams: Beams = field(default_factory=lambda: Beams(np.zeros(1)))
    # Unit directions in firing order, with shape (n, 3).
    rays: Floats = field(default_factory=lambda: np.array([[1.0, 0, 0]]))
    # Firing times since the start of the list, with shape (n,).
    shot_ns: Floats = field(default_factory=lambda: np.zeros(1))
    cycle_ns: float = 1e8  # duration of the list
    # Origins of the rays in meters, with shape (n, 3), or None for the sensor origin.
    starts: Floats | None = None
    cycle: ClassVar[str] = "frame"

    @property
    def ring_step(self) -> int | None:
        """None, because the list may alternate between the rays of several channels."""
        return None

    @property
    def period(self) -> int | None:
        """Number of rays in the list, which is the period of the directions."""
        return len(self.rays)

    def directions(self, firings: Ints) -> Floats:
        """Return the ray directions of the given firings in the sensor frame.

        For `firings` of shape (k,), the result has shape (k, 1, 3). Directions are unit vectors.
        """
        return self.rays[firings % len(self.rays)][:, None, :]

    def origins(self, firings: Ints) -> Floats | None:
        """Return the ray origins of the given firings in the sensor frame, in meters.

        For `firings` of shape (k,), the result has shape (k, 1, 3). It is None if all rays start at
        the sensor origin.
        """
        if self.starts is None:
            return None
        return self.starts[firings % len(self.rays)][:, None, :]

    def begins_ns(self, firings: Ints) -> Floats:
        """Return the start times of firings in nanoseconds since the start of the station.

        `firings` and the result have shape (k,).
        """
        cycles, shots = np.divmod(firings, len(self.rays))
        times: Floats = self.start_ns + cycles * self.cycle_ns + self.shot_ns[shots]
        return times
