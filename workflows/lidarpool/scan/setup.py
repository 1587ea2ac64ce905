"""What stage 2 needs on each worker: the scene with its ray caster, and the sensor."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
from distributed import get_worker
from numpy.typing import NDArray

from poolpart import own_device
from raybeam import Pattern, RayCaster, Returns

from ..scene import Scene
from ..sensor import Sensor
from ..survey import Pose, ScanSpec


@dataclass(eq=False)
class SurveySetup:
    """The scene and the sensor of a survey, as they lie in a worker's memory.

    It is the result of one task, so it travels to a worker once, and Dask makes it again if
    all workers that had it die (scattered data would be lost with them). The ray caster is
    built once on each worker, at the first scan, and is not sent along.

    Parameters
    ----------
    scene
        The scene.
    sensor
        The lidar.
    backend
        Name of the ray-casting backend, the same on all workers.
    """

    scene: Scene
    sensor: Sensor
    backend: str

    def __post_init__(self) -> None:
        self._lock = threading.Lock()
        self._caster: RayCaster | None = None
        self._pattern: Pattern | None = None

    def __reduce__(self) -> tuple[type[SurveySetup], tuple[object, ...]]:
        return SurveySetup, (self.scene, self.sensor, self.backend)

    def _ready(self) -> tuple[RayCaster, Pattern]:
        with self._lock:
            if self._caster is None or self._pattern is None:
                self._pattern = Pattern(self.sensor.directions.reshape(-1, 3))
                self._caster = RayCaster(
                    self.scene.vertices,
                    self.scene.faces,
                    backend=self.backend,
                    threads=get_worker().state.nthreads,
                    device=own_device(),
                )
            return self._caster, self._pattern

    def prepare(self) -> None:
        """Build the ray caster now rather than at the first scan."""
        self._ready()

    def cast(self, pose: Pose, azimuths: tuple[int, int]) -> Returns:
        """Closest hits of the rays at a range of azimuths from one pose.

        Rays are numbered from 0 at the first azimuth, ring by ring within an azimuth. The
        range may go past a revolution's end, as those of `Sensor.sector` do.
        """
        caster, pattern = self._ready()
        sensor, layers = self.sensor, self.sensor.layers
        turn = sensor.rays_per_revolution
        pieces = []
        first, stop = azimuths
        while first < stop:
            start = first % turn
            length = min(stop - first, turn - start)
            piece = caster.scan(
                pattern,
                pose.position,
                pose.rotation,
                window=(start * layers, (start + length) * layers),
                t_min=sensor.min_range_m,
                t_max=sensor.max_range_m,
            )
            pieces.append((piece, (first - azimuths[0]) * layers))
            first += length
        if len(pieces) == 1:
            return pieces[0][0]
        return Returns(
            ray=np.concatenate([piece.ray + offset for piece, offset in pieces]),
            distance=np.concatenate([piece.distance for piece, _ in pieces]),
            triangle=np.concatenate([piece.triangle for piece, _ in pieces]),
        )


def ray_directions(
    sensor: Sensor, spec: ScanSpec, rays: NDArray[np.integer]
) -> NDArray[np.float64]:
    """Look up unit directions of some rays of a scan in the scene's axes: (len(rays), 3)."""
    azimuth, ring = np.divmod(rays.astype(np.int64), sensor.layers)
    azimuth += spec.azimuths[0]
    azimuth %= sensor.rays_per_revolution
    directions = sensor.directions[azimuth, ring]
    rotation = spec.pose.rotation
    if rotation is None:
        return directions
    # Written out, not as a matrix product: BLAS may add in another order for another number
    # of rays, and the same ray must give the same bits in every batch.
    x, y, z = directions.T
    return np.stack([r[0] * x + r[1] * y + r[2] * z for r in rotation], axis=1)
