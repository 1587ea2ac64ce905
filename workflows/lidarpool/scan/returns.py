"""The returns of a batch, with all that columns can be made from."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from raybeam import Pattern, ScanReturns

from ..sensor import ScanSpec

if TYPE_CHECKING:
    from .rig import Rig


class BatchReturns:
    """Returns that are kept of some consecutive scans of one station, in (scan, ray) order.

    Its attributes are arrays with one value a return, (n,), made when they are asked for: the
    sources of columns (`lidarpool.columns.table`).

    Parameters
    ----------
    rig
        Sensor, scene and survey.
    specs
        The scans; the firings of each begin where those of the one before end.
    found
        What was cast: rays numbered from 0 at the first firing.
    pattern, start
        What was cast from, and the number of its ray 0 within the pattern.
    positions, rotations, rays_per_pose
        Poses that it was cast from, as `RayCaster.scan` takes them.
    """

    def __init__(
        self,
        rig: Rig,
        specs: list[ScanSpec],
        found: ScanReturns,
        pattern: Pattern,
        start: int,
        positions: NDArray[np.float64],
        rotations: NDArray[np.float64] | None,
        rays_per_pose: int | None,
    ) -> None:
        self.sensor, self.scene, self.survey = rig.survey.sensor, rig.scene, rig.survey
        self.specs, self.found = specs, found
        self._pattern, self._start = pattern, start
        self._poses = positions, rotations, rays_per_pose

    def __len__(self) -> int:
        return len(self.found.ray)

    # -- which ray ---------------------------------------------------------------------------

    @cached_property
    def _first_rays(self) -> NDArray[np.int64]:
        """Number of the first ray of each scan."""
        begin = self.specs[0].firings[0]
        firsts = [spec.firings[0] - begin for spec in self.specs]
        return np.array(firsts, np.int64) * self.sensor.channels

    @cached_property
    def counts(self) -> NDArray[np.int64]:
        """Returns of each scan: (scans,)."""
        cuts = np.searchsorted(self.found.ray, self._first_rays)
        return np.diff(np.append(cuts, len(self))).astype(np.int64)

    @cached_property
    def scan(self) -> NDArray[np.int32]:
        """Number of the scan."""
        first = self.specs[0].scan
        return np.repeat(np.arange(first, first + len(self.specs), dtype=np.int32), self.counts)

    @cached_property
    def ray(self) -> NDArray[np.int64]:
        """Number of the ray within its scan."""
        return self.found.ray.astype(np.int64) - np.repeat(self._first_rays, self.counts)

    @cached_property
    def channel(self) -> NDArray[np.uint32]:
        """Beam of the sensor."""
        return np.asarray(self.found.ray % np.uint32(self.sensor.channels), np.uint32)

    @cached_property
    def firing(self) -> NDArray[np.int64]:
        """Number of the firing, from the beginning of the station."""
        return self.specs[0].firings[0] + self.found.ray // np.int64(self.sensor.channels)

    @cached_property
    def time(self) -> NDArray[np.int64]:
        """When the ray was fired, nanoseconds since the survey's start."""
        firings, which = np.unique(self.firing, return_inverse=True)
        return self.specs[0].start_ns + self.sensor.times_ns(firings)[which, self.channel]

    # -- where -------------------------------------------------------------------------------

    @cached_property
    def _rays(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        positions, rotations, rays_per_pose = self._poses
        return self._pattern.rays(
            self.found.ray,
            positions,
            rotations,
            start=self._start,
            rays_per_pose=rays_per_pose,
        )

    @property
    def origins(self) -> NDArray[np.float64]:
        """Where the rays left, metres, the scene's local coordinates: (n, 3)."""
        return np.broadcast_to(self._rays[0], (len(self), 3))

    @property
    def directions(self) -> NDArray[np.float64]:
        """Unit directions in the scene's axes: (n, 3)."""
        return self._rays[1]

    @property
    def range(self) -> NDArray[np.float64]:
        """Distance from where the ray left, metres."""
        return self.found.distance

    @cached_property
    def positions(self) -> NDArray[np.float64]:
        """Where the rays ended, metres, the scene's local coordinates: (n, 3)."""
        origins, directions = self._rays
        out = directions * self.found.distance[:, None]
        return np.add(out, origins, out=out)

    @cached_property
    def cells(self) -> NDArray[np.int32]:
        """Positions as whole multiples of the survey's precision: (3, n)."""
        scaled = self.positions / self.survey.precision_m
        cells = np.empty((3, len(self)), np.int32)
        cells[:] = np.rint(scaled, out=scaled).T
        return cells

    @property
    def cell_x(self) -> NDArray[np.int32]:
        """Of the positions."""
        return self.cells[0]

    @property
    def cell_y(self) -> NDArray[np.int32]:
        """Of the positions."""
        return self.cells[1]

    @property
    def cell_z(self) -> NDArray[np.int32]:
        """Of the positions."""
        return self.cells[2]

    @cached_property
    def _sensor_directions(self) -> NDArray[np.float64]:
        rows = (self._start + self.found.ray.astype(np.int64)) % len(self._pattern)
        return self._pattern.directions[rows]

    @cached_property
    def azimuth(self) -> NDArray[np.float64]:
        """Angle of the ray about the sensor's z axis, degrees, from 0 to 360."""
        x, y, _ = self._sensor_directions.T
        return np.degrees(np.arctan2(y, x)) % 360

    @cached_property
    def elevation(self) -> NDArray[np.float64]:
        """Angle of the ray above the sensor's xy plane, degrees."""
        return np.degrees(np.arcsin(np.clip(self._sensor_directions[:, 2], -1, 1)))

    # -- what --------------------------------------------------------------------------------

    @property
    def triangle(self) -> NDArray[np.int32]:
        """Triangle of the scene."""
        return self.found.triangle

    @cached_property
    def object(self) -> NDArray[np.int32]:
        """Object of the scene."""
        return self.scene.face_object[self.found.triangle]

    @cached_property
    def intensity(self) -> NDArray[np.float64]:
        """Cosine of the angle of incidence."""
        a, b, c = self.scene.vertices[self.scene.faces[self.found.triangle]].transpose(1, 0, 2)
        normals = np.cross(b - a, c - a)
        lengths = np.linalg.norm(normals, axis=1)
        return np.abs((normals * self.directions).sum(axis=1)) / lengths

    @property
    def return_number(self) -> NDArray[np.uint8]:
        """Which return of its ray: a ray has one."""
        return np.ones(len(self), np.uint8)

    @property
    def returns(self) -> NDArray[np.uint8]:
        """How many returns its ray has."""
        return np.ones(len(self), np.uint8)

    @property
    def semantic_class(self) -> NDArray[np.uint8]:
        """Class of what was hit; scenes do not state one yet."""
        return np.zeros(len(self), np.uint8)
