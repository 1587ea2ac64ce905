"""Where a sensor is: poses, and trajectories that give a pose for each firing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..base.errors import LidarpoolError


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


class Trajectory(Protocol):
    """Poses over time. A survey has stations: between them it jumps, within one it moves.

    Scans of one station follow one another, and the head turns on from each to the next.
    """

    @property
    def stations(self) -> int:
        """How many there are."""

    @property
    def moves(self) -> bool:
        """Whether the sensor moves within a station, so that each firing has its own pose."""

    def pose(self, station: int, time_ns: float = 0.0) -> Pose:
        """Pose so long after the beginning of a station."""

    def poses(
        self, station: int, times_ns: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Positions (k, 3) and rotations (k, 3, 3) at times (k,) of a station that moves."""


@dataclass(frozen=True)
class Stations:
    """The simplest trajectory: the sensor stands at one pose after the other."""

    at: tuple[Pose, ...]

    @property
    def stations(self) -> int:
        """See `Trajectory.stations`."""
        return len(self.at)

    @property
    def moves(self) -> bool:
        """See `Trajectory.moves`."""
        return False

    def pose(self, station: int, time_ns: float = 0.0) -> Pose:
        """See `Trajectory.pose`."""
        return self.at[station]

    def poses(
        self, station: int, times_ns: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """See `Trajectory.poses`."""
        pose, count = self.at[station], len(times_ns)
        rotation = pose.rotation
        turned = None if rotation is None else np.broadcast_to(rotation, (count, 3, 3))
        return np.broadcast_to(np.array(pose.position), (count, 3)), turned
