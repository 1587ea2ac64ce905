"""A survey: one sensor, the poses it scans from, and the scans that follow from them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .errors import LidarpoolError
from .sensor import Sensor


@dataclass(frozen=True)
class Pose:
    """Where a sensor stands and how it is turned.

    Parameters
    ----------
    position
        x, y, z in metres, in the scene's own coordinates.
    yaw_deg, pitch_deg, roll_deg
        Turns about z, then the new y, then the new x, in degrees (aerospace order).
    """

    position: tuple[float, float, float]
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", tuple(float(x) for x in self.position))
        numbers = (*self.position, self.yaw_deg, self.pitch_deg, self.roll_deg)
        if len(self.position) != 3 or not np.isfinite(numbers).all():
            raise LidarpoolError(f"A pose needs three finite coordinates and angles, not {self}.")

    @property
    def rotation(self) -> NDArray[np.float64] | None:
        """Rotation from sensor to scene axes, (3, 3); None where the sensor is not turned."""
        if not (self.yaw_deg or self.pitch_deg or self.roll_deg):
            return None
        angles = np.radians([self.yaw_deg, self.pitch_deg, self.roll_deg])
        (cy, cp, cr), (sy, sp, sr) = np.cos(angles), np.sin(angles)
        return np.array(
            [
                [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
                [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
                [-sp, cp * sr, cp * cr],
            ]
        )


@dataclass(frozen=True)
class ScanSpec:
    """The rays fired in one time step from one pose; small enough to send by the million.

    `azimuths` is the half-open range of azimuth numbers, see `Sensor.sector`.
    """

    scan: int
    pose: Pose
    azimuths: tuple[int, int]

    def wire(self) -> list[float]:
        """Plain numbers, to travel through a pipe."""
        pose = self.pose
        angles = (pose.yaw_deg, pose.pitch_deg, pose.roll_deg)
        return [self.scan, *self.azimuths, *pose.position, *angles]

    @classmethod
    def from_wire(cls, numbers: Sequence[float]) -> ScanSpec:
        """Inverse of `wire`."""
        scan, first, stop, x, y, z, yaw, pitch, roll = numbers
        return cls(int(scan), Pose((x, y, z), yaw, pitch, roll), (int(first), int(stop)))

    def ray_count(self, sensor: Sensor) -> int:
        """Rays in this scan."""
        return (self.azimuths[1] - self.azimuths[0]) * sensor.layers


@dataclass(frozen=True)
class Survey:
    """All scans of one sensor: every time step from every pose, pose by pose.

    Parameters
    ----------
    sensor
        The lidar.
    poses
        Where it scans from, one after the other.
    steps
        Time steps from each pose.
    keep_every
        Of the hits of each scan, the cloud keeps every n-th.
    precision_m
        Points are rounded to multiples of this, in metres.

    Examples
    --------
    >>> survey = Survey(Sensor(), poses=[(0, 0, 1), (0, 0, 2), (0, 0, 3)])
    >>> survey.scan_count, survey.ray_count
    (108, 120000)
    """

    sensor: Sensor = field(default_factory=Sensor)
    poses: Sequence[Pose] = ()
    steps: int = 36
    keep_every: int = 5
    precision_m: float = 0.01

    def __post_init__(self) -> None:
        poses = tuple(p if isinstance(p, Pose) else Pose(tuple(p)) for p in self.poses)
        object.__setattr__(self, "poses", poses)
        if not poses:
            raise LidarpoolError("A survey needs at least one pose to scan from.")
        for name, least in (("steps", 1), ("keep_every", 1), ("precision_m", 1e-6)):
            value = getattr(self, name)
            if not least <= value < float("inf"):
                raise LidarpoolError(f"{name} is {value}; it must be at least {least}.")

    @property
    def scan_count(self) -> int:
        """Number of scans."""
        return len(self.poses) * self.steps

    @property
    def ray_count(self) -> int:
        """Number of rays in all scans."""
        return len(self.poses) * self.sensor.sector(self.steps - 1)[1] * self.sensor.layers

    def scan(self, index: int) -> ScanSpec:
        """Describe scan `index`: pose `index // steps`, time step `index % steps`."""
        pose, step = divmod(index, self.steps)
        return ScanSpec(index, self.poses[pose], self.sensor.sector(step))

    def scans(self) -> Iterator[ScanSpec]:
        """All scans in order."""
        return (self.scan(index) for index in range(self.scan_count))
