"""Measure held-out sweeps with the metrics of LiDAR4D.

Both sweeps are in the sensor frame at the timestamp of the sweep, so both are compensated for the
motion of the sensor if the alignment determines it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Floats, Ints

from ..comparing.lidar4d import FrameMetrics, PanoramaImage, average_metrics, full_scale_of
from .alignment import AlignedSweep, AlignedSweeps
from .held_out import HeldOutPulses, HeldOutRays


class HeldOutFrames(NamedTuple):
    """Metrics of held-out sweeps."""

    sweep: Ints  # (k,), sweep numbers
    metrics: Floats  # (k, m), fields of `FrameMetrics`
    full_scale: Floats  # (k,), recorded intensity that corresponds to 1

    @classmethod
    def from_rays(
        cls, sweeps: AlignedSweeps, rays: HeldOutRays, pulses: HeldOutPulses
    ) -> HeldOutFrames:
        """Compare simulated rays with the recorded points of their sweeps.

        Parameters
        ----------
        sweeps
            All sweeps.
        rays
            Simulated rays, in the order of `pulses`.
        pulses
            Returned and lost pulses of each held-out sweep.
        """
        numbers = [number for number in pulses if len(sweeps.read(number).points)]
        intensities = [sweeps.read(number).intensities for number in numbers]
        known = [values for values in intensities if values is not None]
        full_scale = np.nan
        if known:
            energies = sweeps.recorded.recording.info.energies
            full_scale = full_scale_of(np.concatenate(known), are_energies=energies)
        frames = []
        for number in numbers:
            chosen = rays.select(rays.sweep == number)
            recorded = sweeps.read(number)
            simulated = _simulated_image(
                chosen, pulses[number], sweeps.alignment.poses[number], full_scale
            )
            intensity = None if recorded.intensities is None else recorded.intensities / full_scale
            image = PanoramaImage.from_points(recorded.points, intensity)
            frames.append(FrameMetrics.between(simulated, image))
        count = len(FrameMetrics._fields)
        return cls(
            np.array(numbers, np.int64),
            np.array(frames, np.float64).reshape(-1, count),
            np.full(len(numbers), full_scale),
        )

    @classmethod
    def figures(cls, parts: Sequence[HeldOutFrames]) -> dict[str, Any] | None:
        """Return the mean metrics of all parts as a dictionary for JSON, or None without frames."""
        sweep, metrics, full_scale = (np.concatenate(part) for part in zip(*parts, strict=True))
        if not len(sweep):
            return None
        frames = [FrameMetrics(*row) for row in metrics.tolist()]
        return average_metrics(
            frames, sweep.tolist(), full_scale=float(full_scale[0]), intensity_factor=1.0
        )


def _simulated_image(
    rays: HeldOutRays, pulses: tuple[AlignedSweep, AlignedSweep], pose: Floats, full_scale: float
) -> PanoramaImage:
    """Return the range image of the simulated rays of a sweep."""
    hit = np.isfinite(rays.simulated_m)
    origins = np.concatenate([part.origins for part in pulses])[hit]
    toward = np.concatenate([part.world for part in pulses])[hit] - origins
    toward *= (rays.simulated_m[hit] / np.linalg.norm(toward, axis=1))[:, None]
    points = (origins + toward - pose[:3, 3]) @ pose[:3, :3]
    intensity = rays.simulated_intensity[hit]
    if not np.isfinite(intensity).any():
        return PanoramaImage.from_points(points)
    return PanoramaImage.from_points(points, np.nan_to_num(intensity) / full_scale)
