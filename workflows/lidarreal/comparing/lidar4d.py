"""Metrics of LiDAR-NeRF and LiDAR4D, which compare sweeps as range images of a fixed size.

The definitions are those of the evaluation code of LiDAR4D (Zheng et al. 2024), which extends the
metrics of LiDAR-NeRF (Tao et al. 2024). The names of the published tables are used in the
documentation. In array shapes, r and c are the rows and columns of a range image.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from itertools import starmap
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from lidarfiles.open3d_access.neighbors import nearest_neighbors
from lidarsim.columns.sweep import Sweep
from lidarsim.numerics.arrays import Bools, Floats

PROTOCOL = "lidar4d"
ROWS = 66
COLUMNS = 1030
FOV_UP_DEG = 2.0  # elevation of the first row
FOV_DEG = 26.9  # elevation of the first row minus that of the row after the last
MAX_DEPTH_M = 80.0  # returns at this range or beyond are omitted, and depths are clipped to it
F_SCORE_M2 = 0.05  # maximum squared distance of a matched point
_MIN_VALUE = 1e-6  # depth in meters, and intensity, of a cell without a return
_WINDOW = 7  # width of the windows of SSIM, in cells
_SSIM_CONSTANTS = (0.01, 0.03)
_FULL_SCALES = (1.0, 255.0, 65535.0)  # intensities that are stored for a white surface


@dataclass(frozen=True)
class Window:
    """Consecutive frames of KITTI-360, some of which are held out.

    Attributes
    ----------
    first, last
        Numbers of the first and last frame of `2013_05_28_drive_0000_sync`.
    held_out
        Numbers of the held-out frames.
    """

    first: int
    last: int
    held_out: tuple[int, ...]

    @property
    def count(self) -> int:
        """Number of frames."""
        return self.last - self.first + 1


def _window(first: int, count: int, step: int) -> Window:
    return Window(first, first + count - 1, tuple(first + step * k for k in (1, 2, 3, 4)))


# Windows by number of the first frame. The windows of 51 frames contain moving objects.
WINDOWS: Mapping[int, Window] = {
    **{first: _window(first, 64, 13) for first in (1538, 1728, 1908, 3353)},
    **{first: _window(first, 51, 10) for first in (2350, 4950, 8120, 10200, 10750, 11400)},
}


@dataclass(frozen=True, eq=False)
class PanoramaImage:
    """Range image of a sweep in the sensor frame.

    Attributes
    ----------
    depth_m
        Range of the nearest return in each cell in meters, 0 without a return. float64 (r, c).
    intensity
        Intensity of this return, 0 without a return. float64 (r, c), or None if it is unknown.
    """

    depth_m: Floats
    intensity: Floats | None

    @classmethod
    def from_points(cls, points: Floats, intensity: Floats | None = None) -> PanoramaImage:
        """Project points to the cells of an image.

        Points outside of the image are omitted. This includes points whose azimuth rounds to the
        column after the last, which is not wrapped around to the first column.

        Parameters
        ----------
        points
            Points in the sensor frame in meters. Shape (n, 3).
        intensity
            Intensities of the points on a scale from 0 to 1. Shape (n,).
        """
        range_m = np.linalg.norm(points, axis=1)
        level_m = np.hypot(points[:, 0], points[:, 1])
        azimuth_rad = np.arctan2(points[:, 1], points[:, 0])
        elevation_deg = np.degrees(np.arctan2(points[:, 2], level_m))
        # Halves are rounded to even numbers, as Python does.
        column = np.rint((np.pi - azimuth_rad) / (2 * np.pi) * COLUMNS).astype(np.int64)
        row = np.rint((FOV_UP_DEG - elevation_deg) / FOV_DEG * ROWS).astype(np.int64)
        inside = (row >= 0) & (row < ROWS) & (column < COLUMNS)
        rows = np.flatnonzero(inside & (range_m > 0) & (range_m < MAX_DEPTH_M))
        rows = rows[np.argsort(range_m[rows], kind="stable")]
        cell, nearest = np.unique(row[rows] * COLUMNS + column[rows], return_index=True)
        rows = rows[nearest]
        depth_m: Floats = np.zeros(ROWS * COLUMNS)
        depth_m[cell] = range_m[rows]
        depth_m = depth_m.reshape(ROWS, COLUMNS)
        if intensity is None:
            return cls(depth_m, None)
        intensities = np.zeros(ROWS * COLUMNS)
        intensities[cell] = intensity[rows]
        return cls(depth_m, intensities.reshape(ROWS, COLUMNS))

    @property
    def return_mask(self) -> Bools:
        """Mask of the cells with a return, of shape (r, c)."""
        return self.depth_m > 0

    def points(self) -> Floats:
        """Return the points of all returns, placed at the directions of their cells.

        The array has shape (n, 3), in meters.
        """
        row, column = np.nonzero(self.depth_m)
        azimuth_rad = np.pi - 2 * np.pi * column / COLUMNS
        elevation_rad = np.radians(FOV_UP_DEG - FOV_DEG * row / ROWS)
        level = np.cos(elevation_rad)
        directions = np.stack(
            [level * np.cos(azimuth_rad), level * np.sin(azimuth_rad), np.sin(elevation_rad)],
            axis=1,
        )
        return directions * self.depth_m[row, column][:, None]


class FrameMetrics(NamedTuple):
    """Metrics of a frame. NaN is a value that is undefined or unknown."""

    chamfer_m2: float
    f_score: float
    depth_rmse_m: float
    depth_median_abs_error_m: float
    depth_ssim: float
    depth_psnr_db: float
    depth_lpips: float
    intensity_rmse: float
    intensity_median_abs_error: float
    intensity_ssim: float
    intensity_psnr_db: float
    intensity_lpips: float
    ray_drop_rmse: float
    ray_drop_accuracy: float
    ray_drop_f1: float

    @classmethod
    def between(cls, simulated: PanoramaImage, recorded: PanoramaImage) -> FrameMetrics:
        """Compare the image of a simulated frame with the image of the recorded frame."""
        depth = _image_errors(simulated.depth_m, recorded.depth_m, MAX_DEPTH_M)
        intensity = tuple(np.nan for _ in depth)
        if simulated.intensity is not None and recorded.intensity is not None:
            intensity = _image_errors(simulated.intensity, recorded.intensity, 1.0)
        drop = _ray_drop_errors(simulated.return_mask, recorded.return_mask)
        points = _point_errors(simulated.points(), recorded.points())
        return cls._make([*points, *depth, *intensity, *drop])


class FrameCollector:
    """Computes the metrics of each frame of two recordings.

    Intensities are divided by the full scale of their recording: 1, 255 or 65535. If both are
    energies, they are divided by the highest one in the first frame of B. If only those of one
    recording are energies, the intensities of A are multiplied so that the medians of A and B are
    equal in the cells of the first frame that have returns in both.

    Parameters
    ----------
    energies
        Whether the intensities of A and B are energies.
    """

    def __init__(self, energies: tuple[bool, bool]) -> None:
        self._energies = energies
        self._scales: tuple[float, float] | None = None  # intensities of 1 in A and in B
        self._frames: list[FrameMetrics] = []
        self._numbers: list[tuple[int, int]] = []

    def add(self, numbers: tuple[int, int], a: Sweep, b: Sweep) -> None:
        """Compare a sweep of A with the recorded sweep of B, both in the sensor frame."""
        if self._scales is None and a.intensity is not None and b.intensity is not None:
            in_a, in_b = (PanoramaImage.from_points(one.points, one.intensity) for one in (a, b))
            self._scales = self._find_scales(in_a, in_b)
        scales = self._scales or (1.0, 1.0)
        images = [
            PanoramaImage.from_points(
                sweep.points, None if sweep.intensity is None else sweep.intensity / scale
            )
            for sweep, scale in zip((a, b), scales, strict=True)
        ]
        self._frames.append(FrameMetrics.between(*images))
        self._numbers.append(numbers)

    def figures(self) -> dict[str, Any] | None:
        """Return the mean metrics as a dictionary for JSON, or None without frames."""
        if not self._frames:
            return None
        scale_a, scale_b = self._scales or (1.0, 1.0)
        return average_metrics(
            self._frames,
            [[*numbers] for numbers in self._numbers],
            full_scale=scale_b,
            intensity_factor=scale_b / scale_a,
        )

    def _find_scales(self, a: PanoramaImage, b: PanoramaImage) -> tuple[float, float]:
        assert a.intensity is not None
        assert b.intensity is not None
        scale_b = full_scale_of(b.intensity, are_energies=self._energies[1])
        if not any(self._energies):
            return full_scale_of(a.intensity, are_energies=False), scale_b
        in_both = a.return_mask & b.return_mask
        if all(self._energies) or not in_both.any():
            return scale_b, scale_b
        medians = [float(np.median(image[in_both])) for image in (a.intensity, b.intensity)]
        factor = medians[1] / medians[0] if all(medians) else 1.0
        return scale_b / factor, scale_b


def average_metrics(
    frames: Sequence[FrameMetrics],
    numbers: Sequence[Any],
    *,
    full_scale: float | None = None,
    intensity_factor: float | None = None,
) -> dict[str, Any]:
    """Return the mean of each metric over frames, as a dictionary for JSON.

    Parameters
    ----------
    frames
        Metrics of each frame.
    numbers
        Numbers of the frames, or pairs of numbers.
    full_scale
        Recorded intensity that corresponds to 1.
    intensity_factor
        Factor by which the simulated intensities were multiplied in addition.
    """
    means = _by_group(FrameMetrics(*np.mean(frames, axis=0).tolist()))
    if means["intensity"] is not None:
        means["intensity"] |= {"full_scale": full_scale, "factor": intensity_factor}
    return {
        "protocol": PROTOCOL,
        "image": {
            "rows": ROWS,
            "columns": COLUMNS,
            "fov_up_deg": FOV_UP_DEG,
            "fov_deg": FOV_DEG,
            "max_depth_m": MAX_DEPTH_M,
        },
        "frames": len(frames),
        **means,
        "by_frame": [
            {"sweep": number} | _by_group(frame)
            for number, frame in zip(numbers, frames, strict=True)
        ],
    }


def _by_group(metrics: FrameMetrics) -> dict[str, Any]:
    """Return the metrics in groups for depth, intensity and ray drop. None is undefined."""
    values = {
        name: value if np.isfinite(value) else None for name, value in metrics._asdict().items()
    }
    grouped: dict[str, Any] = {name: values[name] for name in ("chamfer_m2", "f_score")}
    for group in ("depth", "intensity", "ray_drop"):
        prefix = f"{group}_"
        grouped[group] = {
            name.removeprefix(prefix): value
            for name, value in values.items()
            if name.startswith(prefix)
        }
    if grouped["intensity"]["rmse"] is None:
        grouped["intensity"] = None
    return grouped


def full_scale_of(intensity: Floats, *, are_energies: bool) -> float:
    """Return the recorded intensity that corresponds to 1 in the images.

    This is 1, 255 or 65535 or, for energies, the highest intensity.
    """
    highest = float(intensity.max(initial=0.0))
    if are_energies and highest:
        return highest
    return next((scale for scale in _FULL_SCALES if highest <= scale), highest)


def _point_errors(simulated: Floats, recorded: Floats) -> tuple[float, float]:
    """Return the Chamfer distance in square meters and the F-score of two point clouds."""
    if not len(simulated) or not len(recorded):
        return np.nan, 0.0
    pairs = (simulated, recorded), (recorded, simulated)
    squares = [distances**2 for distances, _ in starmap(nearest_neighbors, pairs)]
    precision, recall = (float(np.mean(square < F_SCORE_M2)) for square in squares)
    f_score = 2 * precision * recall / (precision + recall) if precision + recall else 0.0
    return float(sum(square.mean() for square in squares)), f_score


def _image_errors(simulated: Floats, recorded: Floats, highest: float) -> tuple[float, ...]:
    """Return RMSE, median absolute error, SSIM, PSNR and LPIPS over all cells, empty ones too."""
    simulated, recorded = (image.clip(_MIN_VALUE, highest) for image in (simulated, recorded))
    difference = simulated - recorded
    mean_square = float(np.mean(difference**2))
    psnr_db = 10 * np.log10(highest**2 / mean_square) if mean_square else np.nan
    return (
        float(np.sqrt(mean_square)),
        float(np.median(np.abs(difference))),
        structural_similarity(simulated, recorded),
        float(psnr_db),
        _lpips(simulated, recorded),
    )


def structural_similarity(simulated: Floats, recorded: Floats) -> float:
    """Return the mean structural similarity (SSIM) of two images.

    The windows have 7 x 7 cells with equal weights and lie within the image. Variances and the
    covariance are those of samples. The dynamic range is that of the recorded image. Returns NaN
    if the recorded image is constant.
    """
    span = float(np.ptp(recorded))
    if not span:
        return np.nan
    first, second = ((share * span) ** 2 for share in _SSIM_CONSTANTS)
    mean_a, mean_b = _window_means(simulated), _window_means(recorded)
    count = _WINDOW**2
    sample = count / (count - 1)
    variance_a = sample * (_window_means(simulated**2) - mean_a**2)
    variance_b = sample * (_window_means(recorded**2) - mean_b**2)
    covariance = sample * (_window_means(simulated * recorded) - mean_a * mean_b)
    similarity = (2 * mean_a * mean_b + first) * (2 * covariance + second)
    similarity /= (mean_a**2 + mean_b**2 + first) * (variance_a + variance_b + second)
    return float(similarity.mean())


def _window_means(image: Floats) -> Floats:
    return np.asarray(sliding_window_view(image, (_WINDOW, _WINDOW)).mean(axis=(2, 3)))


def has_lpips() -> bool:
    """Return whether the packages for LPIPS are installed."""
    return all(find_spec(package) is not None for package in ("torch", "lpips"))


def _lpips(simulated: Floats, recorded: Floats) -> float:
    """Return LPIPS (AlexNet) of two images, or NaN if its packages or weights are missing.

    The values of the images are passed as they are, although the network expects 0 to 1.
    """
    network = _lpips_network() if has_lpips() else None
    if network is None:
        return np.nan
    import torch

    tensors = [torch.from_numpy(image.astype(np.float32)) for image in (simulated, recorded)]
    with torch.no_grad():
        return float(network(*tensors, normalize=True).item())


@cache
def _lpips_network() -> Any:
    """Load the network, or return None if its weights cannot be downloaded."""
    import lpips

    try:
        return lpips.LPIPS(net="alex", verbose=False).eval()
    except OSError:
        return None


def _ray_drop_errors(simulated: Bools, recorded: Bools) -> tuple[float, float, float]:
    """Return RMSE, accuracy and F1 of the cells with a return.

    The simulation states for each cell whether there is a return, not how probable it is.
    """
    accuracy = float(np.mean(simulated == recorded))
    both = int((simulated & recorded).sum())
    total = int(simulated.sum() + recorded.sum())
    return float(np.sqrt(1 - accuracy)), accuracy, 2 * both / total if total else np.nan
