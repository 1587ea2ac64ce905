"""Compare two clouds or recordings, using sweeps, range image cells and nearest neighbors."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from lidarfiles.clouds.posed_sweeps import PosedSweeps
from lidarfiles.clouds.recording import PointCloud, Recording
from lidarfiles.clouds.recording_ref import SeveralSensorsError
from lidarfiles.datasets.figures import rank_correlation
from lidarfiles.open3d_access.neighbors import nearest_neighbors
from lidarfiles.parts.parts import StoredCloud
from lidarfiles.recordings.opening import open_recording
from lidarsim._version import __version__
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.sweep import Sweep
from lidarsim.errors import LidarError
from lidarsim.io.writing_progress import WritingProgress
from lidarsim.numerics.arrays import Bools, Floats, Ints
from lidarsim.numerics.even_samples import even_indices
from lidarsim.schema.checks import check_choice, check_number
from lidarsim.words import join_names, plural

from .compared_sweep import bounds_of, compared_in_world, compared_sweep, origin_to_add, rings_note
from .comparison import Comparison
from .comparison_data import CELLS, RESIDUALS
from .lidar4d import PROTOCOL, FrameCollector
from .range_image import RangeImages, RayPairs, images_of_rays, pair_rays, range_images

MAX_POINTS = 10_000_000  # maximum number of points of each cloud in memory

MAX_VALUES = 4_000_000  # maximum number of cells and points in all sweeps that are compared

_LISTED_RINGS = 6  # maximum number of rings in a note


def compare(
    a: str | Path | Cloud | StoredCloud,
    b: str | Path | Cloud | StoredCloud,
    *,
    sweeps: Sequence[int] | None = None,
    match: Literal["order", "time"] = "order",
    sensor_a: str | None = None,
    sensor_b: str | None = None,
    intensity_a: str | None = None,
    intensity_b: str | None = None,
    unit_a: str | None = None,
    unit_b: str | None = None,
    keep_noise: bool = False,
    azimuth_deg: float | None = None,
    distances_m: Sequence[float] = (0.05, 0.1, 0.2, 0.5),
    max_points: int = MAX_POINTS,
    protocol: Literal["lidar4d"] | None = None,
    on_progress: WritingProgress = lambda *_: None,
) -> Comparison:
    """Compare two clouds or recordings of the same scene.

    B is the reference. Recordings of one sensor are compared sweep by sweep in the sensor frame.
    The comparison includes range images, returns that are present only in A or only in B,
    intensities, and distances to nearest neighbors. Recordings without rings have no range images.
    Clouds without sweeps, such as .las files, are compared in world coordinates, by distances and
    intensities only. The clouds are not aligned with each other beforehand.

    Parameters
    ----------
    a, b
        Clouds to compare. Each can be a result folder or its .ply file, a data set, a .pcd file or
        a folder of .pcd files, a .las, .laz, .e57, .pts, .ptx, .npy, .bin or text file (.xyz, .txt,
        .asc, .csv), a ROS 2 bag (.mcap or a folder), or a cloud in memory.
    sweeps
        Indices of the pairs of sweeps to compare, counted from 0. By default, all pairs are
        compared.
    match
        Whether to pair sweeps by their order or by time.
    sensor_a, sensor_b
        Name of the sensor (or topic of a bag) in recordings that contain several sensors.
    intensity_a, intensity_b
        Names of the columns that contain the intensities. The default is ``intensity``.
    unit_a, unit_b
        Length unit of a .las, .laz, .ply, .pcd, .ptx, .pts, .npy or text file (um, mm, cm, dm, m,
        km, in, ft, yd or mi). By default, the unit is the one stated in the file or its header, or
        meters if no unit is stated.
    keep_noise
        Whether to include points that are marked as withheld or classified as noise (classes 7 and
        18) in a .las or .laz file, or in the corresponding columns of other clouds.
    azimuth_deg
        Width of a cell of the range images in degrees. By default, it is the larger of the two
        recordings' azimuth steps between pulses.
    distances_m
        Distance thresholds in meters for precision and recall. A point counts as present in the
        other cloud if that cloud has a point within this distance.
    max_points
        Maximum number of points of each cloud in memory. Larger clouds are subsampled evenly.
    protocol
        Published evaluation protocol whose metrics are also computed: "lidar4d" for the range
        images and metrics of LiDAR4D. The sweeps of B are the recorded ones.
    on_progress
        Function that is called with the name of an activity, the number of completed items, the
        total number of items, and their unit, such as ("comparing", 7, 80, "sweeps").

    Returns
    -------
    Comparison
        The statistics of the comparison.

    Raises
    ------
    LidarError
        If A or B cannot be read, is empty, or has a coordinate system that distorts lengths, such
        as Web Mercator, or if A and B have no quantity in common that can be compared.
    """
    check_choice("match", match, ("order", "time"))
    check_number("max_points", max_points, whole=True, ge=1000)
    _check_options(azimuth_deg, distances_m, protocol)
    with _sensor_chosen_by("--sensor-a"):
        first = open_recording(
            a, sensor_a, intensity_a, name="cloud A", unit=unit_a, keep_noise=keep_noise
        )
    with _sensor_chosen_by("--sensor-b"):
        second = open_recording(
            b, sensor_b, intensity_b, name="cloud B", unit=unit_b, keep_noise=keep_noise
        )
    recordings = first, second
    comparing = _Comparing(recordings, tuple(sorted(distances_m)), azimuth_deg, protocol)
    if isinstance(first, Recording) and isinstance(second, Recording):
        pairs = _pair_sweeps(first, second, match)
        if sweeps:
            pairs = _choose_pairs(pairs, sweeps)
        elif len(pairs) < max(len(first), len(second)):
            comparing.add_note(
                f"A has {plural(len(first), 'sweep')} and B has {len(second):,}. Matching "
                f"by {match} results in {plural(len(pairs), 'pair')}"
            )
        comparing.pairs = pairs
        if {first.info.compensated, second.info.compensated} == {True, False}:
            comparing.add_note(
                _motion_note(*sorted((first, second), key=lambda r: not r.info.compensated))
            )
        budget = MAX_VALUES // len(pairs)
        for done, (number_a, number_b) in enumerate(pairs, 1):
            on_progress("comparing", done, len(pairs), "sweeps")
            sweep_a, sweep_b = (
                compared_sweep(recording, number, with_rays=comparing.has_same_rays)
                for recording, number in ((first, number_a), (second, number_b))
            )
            comparing.add_sweeps((number_a, number_b), sweep_a, sweep_b, budget)
        return comparing.result()
    cloud = first if isinstance(first, PointCloud) else second
    if sweeps or match == "time":
        raise LidarError(f"{cloud.info.name} has no sweeps. Omit `--sweep` and `--match`.")
    if azimuth_deg is not None:
        raise LidarError(f"{cloud.info.name} has no sweeps, which `--azimuth-deg` requires.")
    if protocol is not None:
        raise LidarError(
            f"{cloud.info.name} has no sweeps, which `--protocol {protocol}` requires."
        )
    comparing.notes.append(
        f"{cloud.info.name} has no sweeps, so all points are compared at once in world "
        "coordinates, and only by distance and intensity"
    )
    points_a = comparing.read_cloud(first, max_points)
    points_b = comparing.read_cloud(second, max_points)
    points_a, points_b = comparing.with_world_origin(points_a, points_b)
    if max(len(points_a), len(points_b)) > MAX_VALUES:
        comparing.add_note(f"distances are measured from {MAX_VALUES:,} points of each cloud")
    comparing.add_points(points_a, points_b, MAX_VALUES)
    return comparing.result()


def _check_options(
    azimuth_deg: float | None, distances_m: Sequence[float], protocol: str | None
) -> None:
    """Raise LidarError if an option of `compare` is invalid."""
    if azimuth_deg is not None:
        check_number("azimuth_deg", azimuth_deg, gt=0, le=90)
    if not distances_m or any(not 0 < distance < np.inf for distance in distances_m):
        raise LidarError(
            f"`distances_m` is {list(distances_m)}; it must contain positive lengths in meters."
        )
    if protocol is not None:
        check_choice("protocol", protocol, (PROTOCOL,))


@contextmanager
def _sensor_chosen_by(option: str) -> Iterator[None]:
    """Extend errors about ambiguous sensors to name the option that selects a sensor."""
    try:
        yield
    except SeveralSensorsError as error:
        raise SeveralSensorsError(error.contents, error.names, option) from error


def _motion_note(compensated: Recording, fired: Recording) -> str:
    """Return a note which states that only the first recording is compensated for motion."""
    return (
        f"{compensated.info.name} is compensated for the motion of the sensor during each sweep, "
        f"but {fired.info.name} contains points as fired, so the differences include this motion. "
        "Export the result as fired with `lidarpool export RESULT --format mcap` and compare the "
        "file, or "
        "export both with `--compensated`"
    )


def _choose_pairs(pairs: list[tuple[int, int]], sweeps: Sequence[int]) -> list[tuple[int, int]]:
    """Return the pairs with the given indices, sorted by index.

    Raises LidarError if an index is out of range.
    """
    for number in sweeps:
        if not 0 <= number < len(pairs):
            raise LidarError(
                f"Sweep pair {number} does not exist. Pairs are numbered from 0 to "
                f"{len(pairs) - 1:,}."
            )
    return [pairs[number] for number in sorted({*sweeps})]


def _pair_sweeps(a: Recording, b: Recording, match: str) -> list[tuple[int, int]]:
    pairs = [(number, number) for number in range(min(len(a), len(b)))]
    if match == "time":
        times_a = _sweep_times(a)
        times_b = _sweep_times(b)
        if pairs:
            order = np.argsort(times_a)
            sorted_times = times_a[order]
            midpoints = (sorted_times[1:] + sorted_times[:-1]) / 2
            nearest_a = order[np.searchsorted(midpoints, times_b)]
            period = np.median(np.diff(times_b)) if len(times_b) > 1 else 1e8
            close = np.flatnonzero(np.abs(times_a[nearest_a] - times_b) <= period / 2)
            pairs = [(int(nearest_a[number]), int(number)) for number in close]
    if not pairs:
        raise LidarError(
            f"{a.info.name} has {plural(len(a), 'sweep')} and {b.info.name} has {len(b):,}, but "
            f"none of them match by {match}."
        )
    return pairs


def _sweep_times(recording: Recording) -> Ints:
    if recording.stamps_ns is None:
        raise LidarError(f"{recording.info.name} has no sweep times. Omit `--match time`.")
    return recording.stamps_ns


class _CellPairs(NamedTuple):
    """Ranges of cells or rays with a return in both sweeps.

    All arrays have shape (k,).
    """

    residual: Floats  # meters
    ring: Ints
    intensity_a: Floats
    intensity_b: Floats


class _NearestPairs(NamedTuple):
    """Points of one cloud, each with its nearest neighbor in the other cloud.

    All arrays have shape (n,).
    """

    distance: Floats  # meters
    intensity: Floats  # intensity of the point
    nearest_intensity: Floats


@dataclass(eq=False)
class _Comparing:
    """Comparison in progress, to which pairs of sweeps are added one by one."""

    recordings: tuple[Recording | PointCloud, Recording | PointCloud]
    distances_m: tuple[float, ...]
    azimuth_deg: float | None
    protocol: str | None

    def __post_init__(self) -> None:
        self.notes: list[str] = []  # in addition to those of the recordings
        self.pairs: list[tuple[int, int]] = []  # indices of sweeps; empty for whole clouds
        self.point_counts = np.zeros(2, np.int64)
        self.images: RangeImages | None = None  # images of the first pair that has them
        self.pictured: tuple[int, int] | None = None  # pair of sweeps that `points` belongs to
        self.empty_pairs = 0  # number of pairs in which a sweep has no points
        # {reason why pairs of sweeps have no range images: number of these pairs}
        self.without_images: Counter[str] = Counter()
        self.frames: FrameCollector | None = None  # None without a protocol
        if self.protocol is not None:
            self.frames = self._collector(self.protocol)
        self.points: list[Floats] = []  # points of A and B in the first pair that has both
        self.cells: list[_CellPairs] = []
        # Pairs for the points of A, and for the points of B.
        self.nearest: tuple[list[_NearestPairs], list[_NearestPairs]] = ([], [])
        # {ring: (elevation, number of cells in each state of `CELLS`)}
        self.rings: dict[int, tuple[float, Ints]] = {}
        # Number of rays without range images in each state of `CELLS`. The first state cannot be
        # observed, so its count is 0.
        self.ray_counts = np.zeros(4, np.int64)

    def _collector(self, protocol: str) -> FrameCollector:
        """Return the collector of a protocol, or raise LidarError if returns were discarded."""
        for recording in self.recordings:
            if recording.info.thinned:
                raise LidarError(
                    f"{recording.info.name} contains only some of the returns, so the metrics of "
                    f"`--protocol {protocol}` are undefined. Use a result with `keep_every: 1`."
                )
        first, second = self.recordings
        return FrameCollector((first.info.energies, second.info.energies))

    def add_note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)

    def read_cloud(self, recording: Recording | PointCloud, max_points: int) -> Sweep:
        """Read a cloud in world coordinates, evenly subsampled to about `max_points` points."""
        count = recording.info.point_count
        fraction = 1.0 if count is None else min(1.0, max_points / max(count, 1))
        parts = []
        sweeps = PosedSweeps(recording)
        for number in range(len(recording)):
            part = compared_in_world(sweeps, number)
            if fraction < 1:
                part = part.select(even_indices(len(part), round(fraction * len(part))))
            parts.append(part)
        self.notes += sweeps.notes
        if fraction == 1 or not parts:
            return Sweep.concatenate(parts)
        self.add_note(
            f"{100 * fraction:.3g} % of the {count:,} points in {recording.info.name} are "
            "compared, sampled evenly. Distances to this cloud are therefore overestimated"
        )
        return Sweep.concatenate(parts)

    def with_world_origin(self, *clouds: Sweep) -> list[Sweep]:
        """Add the world origin of one recording to the points of the other, if these are local."""
        shifted = [*clouds]
        if all(map(len, clouds)):
            origins = [recording.info.world_origin for recording in self.recordings]
            bounds = [bounds_of(cloud.points) for cloud in clouds]
            if (shift := origin_to_add(origins, bounds)) is not None:
                local = clouds[shift.local]
                shifted[shift.local] = local.replace(points=local.points + shift.origin)
                self.add_note(shift.note([recording.info.name for recording in self.recordings]))
        return shifted

    def add_sweeps(self, numbers: tuple[int, int], a: Sweep, b: Sweep, budget: int) -> None:
        """Compare two sweeps in sensor coordinates.

        At most `budget` cells and points of each sweep are compared.
        """
        if max(len(a), len(b)) > budget:
            self.add_note(
                f"at most {budget:,} points and cells of each sweep are compared, sampled evenly"
            )
        if len(a) and len(b):
            self.pictured = self.pictured or numbers
            self._add_ranges(a, b, budget)
            if self.frames is not None:
                self.frames.add(numbers, a, b)
        else:
            self.empty_pairs += 1
        self.add_points(a, b, budget)

    def add_points(self, a: Sweep, b: Sweep, budget: int) -> None:
        """Compare the distances and intensities of two sweeps or clouds.

        At most `budget` points of each are compared.
        """
        self.point_counts += len(a), len(b)
        if not len(a) or not len(b):
            return
        for pairs, cloud, reference in zip(self.nearest, (a, b), (b, a), strict=True):
            chosen = cloud.select(even_indices(len(cloud), budget))
            distance, index = nearest_neighbors(chosen.points, reference.points)
            if len(self.points) < 2:
                self.points.append(chosen.points)
            intensity = chosen.intensity
            if intensity is None or reference.intensity is None:
                pairs.append(_NearestPairs(distance, *np.full((2, len(distance)), np.nan)))
            else:
                pairs.append(_NearestPairs(distance, intensity, reference.intensity[index]))

    @cached_property
    def has_same_rays(self) -> bool:
        first, second = self.recordings
        if first.ray_times is None or second.ray_times is None:
            return False
        return first.ray_times.are_same(second.ray_times)

    def _add_ranges(self, a: Sweep, b: Sweep, budget: int) -> None:
        """Compare the ranges of two sweeps by ray if both have the same rays, otherwise by cell.

        Sweeps with the same rays are compared even if there are no range images. Otherwise, the
        reason why there are none is recorded for a note.
        """
        first, second = self.recordings
        names = first.info.name, second.info.name
        rays = pair_rays(a, b) if self.has_same_rays else None
        images = None
        try:
            if rays is None:
                images = range_images(a, b, names, self.azimuth_deg)
            else:
                images = images_of_rays(rays, names, self.azimuth_deg)
        except LidarError as error:
            self.without_images[str(error)] += 1
        if images is not None:
            for note in (*rings_note(first, a), *rings_note(second, b), *images.notes):
                self.add_note(note)
            self._add_image_cells(images, budget)
        elif rays is not None:
            self._add_rays(rays, budget)

    def _add_image_cells(self, images: RangeImages, budget: int) -> None:
        self.images = self.images or images
        in_a, in_b = np.isfinite(images.compared[:, 0])
        self._count_cells(images, in_a, in_b)
        self._add_residuals(images.compared, images.rings[images.cell_rows], budget)

    def _add_rays(self, rays: RayPairs, budget: int) -> None:
        in_a, in_b = np.isfinite(rays.values[:, 0])
        states = in_b & ~in_a, in_a & ~in_b, in_a & in_b
        self.ray_counts[1:] += [np.count_nonzero(state) for state in states]
        self._add_residuals(rays.values, rays.rings, budget)

    def _add_residuals(self, compared: Floats, rings: Ints, budget: int) -> None:
        """Add the range residuals of cells or rays in which both sweeps have a return.

        `compared` contains the range and intensity in A and in B, with shape (2, 2, k), and `rings`
        contains the ring numbers, with shape (k,).
        """
        in_both = np.flatnonzero(np.isfinite(compared[:, 0]).all(axis=0))
        in_both = in_both[even_indices(len(in_both), budget)]
        (range_a, intensity_a), (range_b, intensity_b) = compared[..., in_both]
        self.cells.append(_CellPairs(range_a - range_b, rings[in_both], intensity_a, intensity_b))

    def _count_cells(self, images: RangeImages, in_a: Bools, in_b: Bools) -> None:
        """Count the cells of each ring by their state (see `CELLS`).

        The masks `in_a` and `in_b` mark returns. Both have shape (k,).
        """
        rows = images.cell_rows
        returned_a, returned_b = images.return_masks
        rows_of_neither, _ = np.nonzero(~returned_a & ~returned_b)
        rows_of_states = (
            rows_of_neither,
            rows[~in_a & in_b],
            rows[in_a & ~in_b],
            rows[in_a & in_b],
        )
        counts = np.stack(
            [np.bincount(state, minlength=len(images.rings)) for state in rows_of_states], axis=1
        )
        for ring, elevation, count in zip(
            images.rings.tolist(), images.elevation_deg.tolist(), counts, strict=True
        ):
            _, total = self.rings.get(ring, (0.0, np.zeros(4, np.int64)))
            self.rings[ring] = elevation, total + count

    def result(self) -> Comparison:
        counts = self.point_counts.tolist()
        for recording, count in zip(self.recordings, counts, strict=True):
            if not count:
                listed = "".join(f" {note}." for note in recording.omission_notes)
                raise LidarError(
                    f"{recording.info.name} contains no points, so there is nothing to compare."
                    f"{listed}"
                )
        if not self.points:
            raise LidarError("None of the pairs has points in both sweeps. Choose other sweeps.")
        from_a, from_b = (
            _NearestPairs(*map(np.concatenate, zip(*pairs, strict=True))) for pairs in self.nearest
        )
        residuals = np.empty(0)
        range_figures = None
        paired_by = "nearest points"
        is_close = from_a.distance <= self.distances_m[0]
        intensity_a = from_a.intensity[is_close]
        intensity_b = from_a.nearest_intensity[is_close]
        if self.cells:
            cells = _CellPairs(*map(np.concatenate, zip(*self.cells, strict=True)))
            residuals = cells.residual
            intensity_a = cells.intensity_a
            intensity_b = cells.intensity_b
            paired_by = "rays" if self.has_same_rays else "cells"
            range_figures = self._range_figures(cells, paired_by)
        is_known = np.isfinite(intensity_a) & np.isfinite(intensity_b)
        intensities = intensity_a[is_known], intensity_b[is_known]
        figures: dict[str, Any] = {
            "versions": {"lidarpool": __version__},
            **self._source_figures(),
            "pairs": len(self.pairs),
            "pictured": self.pictured and [*self.pictured],
            "notes": self._all_notes(),
            "ranges": range_figures,
            "intensity": self._intensity_figures(*intensities, paired_by),
            "distances": self._distance_figures(from_a.distance, from_b.distance),
            "lidar4d": None if self.frames is None else self.frames.figures(),
        }
        distances = from_a.distance, from_b.distance
        return Comparison(figures, self._images(), residuals, distances, intensities, self.points)

    def _source_figures(self) -> dict[str, Any]:
        """Return the names and sizes of A and B, and the indices of the compared sweeps."""
        counts = self.point_counts.tolist()
        return {
            key: {
                "name": recording.info.name,
                "sweeps": None if isinstance(recording, PointCloud) else len(recording),
                "compared_sweeps": self._compared_sweeps(number),
                "points": count,
            }
            for number, (key, recording, count) in enumerate(
                zip("ab", self.recordings, counts, strict=True)
            )
        }

    def _compared_sweeps(self, number: int) -> list[int] | None:
        """Return the compared sweeps of A (0) or B (1), or None if all of them are compared."""
        indices = sorted({pair[number] for pair in self.pairs})
        return None if len(indices) == len(self.recordings[number]) else indices

    def _intensity_figures(self, a: Floats, b: Floats, paired_by: str) -> dict[str, Any] | None:
        """Return statistics of paired intensities, or None if they have no rank correlation."""
        correlation = rank_correlation(a, b)
        if correlation is None:
            return None
        first, second = self.recordings
        return {
            "rank_correlation": correlation,
            "pairs": len(a),
            "of": paired_by,
            "columns": {"a": first.info.intensity_name, "b": second.info.intensity_name},
            "same_scale": first.info.energies and second.info.energies,
        }

    def _distance_figures(self, to_b: Floats, to_a: Floats) -> dict[str, Any]:
        """Return statistics of the distances from A to B and from B to A, in meters."""
        f_scores: list[dict[str, float | None]] = []
        for distance in self.distances_m:
            scores = _scores(float(np.mean(to_b <= distance)), float(np.mean(to_a <= distance)))
            f_scores.append({"distance_m": distance, **scores})
        return {
            "a_to_b": _distance_quantiles(to_b),
            "b_to_a": _distance_quantiles(to_a),
            "chamfer_m": float(to_b.mean() + to_a.mean()),
            "f_scores": f_scores,
        }

    def _all_notes(self) -> list[str]:
        """Return all notes. Recordings add notes when their poses and points are read."""
        recorded = [note for recording in self.recordings for note in recording.notes]
        omitted = [note for recording in self.recordings for note in recording.omission_notes]
        own = [*self.notes, *self._empty_notes(), *self._image_notes(), *self._dead_ring_notes()]
        notes = [*recorded, *own, *omitted]
        return list(dict.fromkeys(notes))

    def _empty_notes(self) -> list[str]:
        if not self.empty_pairs:
            return []
        total = plural(len(self.pairs), "pair")
        return [f"{self.empty_pairs:,} of {total} of sweeps have an empty sweep and are skipped"]

    def _image_notes(self) -> list[str]:
        """Return notes about sweeps that cannot be shown as range images.

        The notes state whether and how these sweeps are compared instead.
        """
        instead = "Their ranges are compared ray by ray"
        first, second = self.recordings
        if not self.has_same_rays:
            instead = "Their ranges are not compared"
            is_known = None not in (first.ray_times, second.ray_times)
            if first.info.energies and second.info.energies and not is_known:
                instead += (
                    ". To compare two results ray by ray, run both with `cloud: {columns: [time]}`"
                )
        return [
            f"{plural(count, 'pair')} of sweeps cannot be shown as range images, because {reason}. "
            f"{instead}"
            for reason, count in self.without_images.items()
        ]

    def _dead_ring_notes(self) -> list[str]:
        """Return a note for each recording in which rings have no returns, unlike in the other."""
        notes = []
        for state, recording in zip((1, 2), self.recordings, strict=True):  # see `CELLS`
            dead = [
                f"{ring} ({elevation:.1f}°)" if ring >= 0 else f"at {elevation:.1f}°"
                for ring, (elevation, counts) in self.rings.items()
                if counts[state] and not counts[3] and not counts[3 - state]
            ]
            if dead:
                rings = "ring" if len(dead) == 1 else "rings"
                others = len(dead) - _LISTED_RINGS
                listed = dead[:_LISTED_RINGS] + ([f"{others} others"] if others > 0 else [])
                notes.append(
                    f"{recording.info.name} has no returns in {rings} {join_names(listed)}"
                )
        return notes

    def _images(self) -> RangeImages | None:
        return None if self.ray_counts.any() else self.images

    def _range_figures(self, cells: _CellPairs, paired_by: str) -> dict[str, Any]:
        """Return statistics of all ranges, and of each ring by descending elevation."""
        images = self._images()
        has_gaps = not any(recording.info.thinned for recording in self.recordings)
        rings = sorted(self.rings.items(), key=lambda item: -item[1][0]) if images else []
        all_counts = sum((count for _, count in self.rings.values()), self.ray_counts)
        no_return = _no_return_figures(all_counts) if has_gaps else None
        if no_return is not None and images is None:  # rays without any return are unknown
            no_return |= dict.fromkeys(("in_both", "precision", "recall", "f1"))
        return {
            "paired_by": paired_by,
            "columns": None if images is None else images.ranges[0].shape[1],
            "azimuth_step_deg": None if images is None else images.step_deg,
            "hidden_points": (
                None if images is None else dict(zip("ab", images.hidden_shares, strict=True))
            ),
            "residual": _residual_figures(cells.residual),
            "no_return": no_return,
            "rings": [
                {
                    "ring": ring,
                    "elevation_deg": elevation,
                    **_residual_figures(cells.residual[cells.ring == ring]),
                    "no_return": _no_return_figures(count) if has_gaps else None,
                }
                for ring, (elevation, count) in rings
            ],
        }


def _residual_figures(values: Floats) -> dict[str, Any]:
    """Return residual statistics in meters, which are None if there are no residuals."""
    if not len(values):
        return {"cells": 0, **dict.fromkeys(RESIDUALS)}
    p05, median, p95 = np.quantile(values, (0.05, 0.5, 0.95)).tolist()
    mad = np.median(np.abs(values - median))
    rmse = np.sqrt(np.mean(values**2))
    figures = map(float, (values.mean(), rmse, median, mad, p05, p95))
    return {"cells": len(values), **dict(zip(RESIDUALS, figures, strict=True))}


def _no_return_figures(counts: Any) -> dict[str, Any]:
    """Evaluate how well A predicts which cells of B have no return.

    `counts` contains the number of cells in each state of `CELLS`.
    """
    in_both, in_a_only, in_b_only, _ = counts.tolist()
    precision = in_both / (in_both + in_a_only) if in_both + in_a_only else None
    recall = in_both / (in_both + in_b_only) if in_both + in_b_only else None
    return dict(zip(CELLS, counts.tolist(), strict=True)) | _scores(precision, recall)


def _scores(precision: float | None, recall: float | None) -> dict[str, float | None]:
    f1 = None
    if precision is not None and recall is not None:
        f1 = 2 * precision * recall / (precision + recall) if precision + recall else 0.0
    return {"precision": precision, "recall": recall, "f1": f1}


def _distance_quantiles(values: Floats) -> dict[str, Any]:
    """Return the mean and quantiles of distances in meters."""
    fractions = {"median_m": 0.5, "p90_m": 0.9, "p95_m": 0.95, "p99_m": 0.99, "max_m": 1.0}
    quantiles = np.quantile(values, list(fractions.values())).tolist()
    return {
        "points": len(values),
        "mean_m": float(values.mean()),
        **dict(zip(fractions, quantiles, strict=True)),
    }
