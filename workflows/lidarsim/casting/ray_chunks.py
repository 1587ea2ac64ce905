"""Central rays of pulses in consecutive scans, in chunks that limit memory use."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from raybeam import Pattern
from raybeam.scan import Scan, check_scan

from ..numerics.arrays import Bools, Floats
from ..sensor import Sensor
from ..survey.survey import ScanSpec
from .motion import CastPoses

CHUNK_RAYS = 1 << 17  # number of rays that are cast at a time


@dataclass(frozen=True, eq=False)
class RayChunk:
    """Consecutive rays, which are cast together."""

    start: int  # number of the first ray, counted from the first scan
    scan: Scan
    pattern: Pattern
    poses: CastPoses
    limits: dict[str, Any]  # further arguments of `SceneCaster.scan`
    allowed: Bools  # (n,), False for pulses that the platform blocks

    def computed_rays(self) -> Floats:
        """Compute the origins in meters and the directions of the rays, in shape (6, n)."""
        self.scan.rays(0, len(self.scan))  # writes the rays to `out`
        assert self.scan.out is not None
        return self.scan.out


def ray_chunks(
    sensor: Sensor,
    specs: Sequence[ScanSpec],
    pattern: Pattern,
    poses: CastPoses,
    window: tuple[int, int],
) -> Iterator[RayChunk]:
    """Yield the rays of consecutive scans at one station.

    `window` contains the first pattern row of the rays, and one past the last.
    """
    first, stop = window
    step = max(1, CHUNK_RAYS // (poses.rays_per_pose or 1)) * (poses.rays_per_pose or 1)
    for start in range(0, stop - first, step):
        count = min(step, stop - first - start)
        limits: dict[str, Any] = {
            "window": (first + start, first + start + count),
            "t_min": sensor.min_range_m,
            "t_max": sensor.max_range_m,
            "out": np.empty((6, count)),  # rays, which are computed only once
        }
        chunk_poses = poses.for_subrays(start, start + count, 1)
        scan = check_scan(pattern, **chunk_poses.caster_arguments, **limits)
        allowed = ~_is_blocked(sensor, specs, start, count)
        yield RayChunk(start, scan, pattern, chunk_poses, limits, allowed)


def _is_blocked(sensor: Sensor, specs: Sequence[ScanSpec], start: int, count: int) -> Bools:
    """Return whether the platform blocks each of `count` rays, starting with ray `start`."""
    if not sensor.has_blocked_directions:
        return np.zeros(count, np.bool_)
    rays = np.arange(start, start + count, dtype=np.int64)
    firing, channel = np.divmod(rays, sensor.channels)
    return sensor.is_blocked(specs[0].firings[0] + firing, channel)
