"""Compares two clouds or recordings of one place: ranges by cell, lost returns, distances."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from pydantic import Field

from lidarsim._version import __version__
from lidarsim.base.arrays import AnyArray, Bools, Floats, Ints
from lidarsim.base.errors import LidarError, explained
from lidarsim.base.sampling import even_indices
from lidarsim.base.signatures import ReadableSignature
from lidarsim.base.validation import checked
from lidarsim.base.vocabulary import UNITS_M
from lidarsim.base.words import plural
from lidarsim.columns.cloud import Cloud
from lidarview.render import theme
from lidarview.render.picture_page import Page, label_logarithms

from ..base.neighbours import nearest
from ..clouds.folder import result_folder, staging
from ..clouds.recording import RecordedPoints, Recording
from ..columns.parts import StoredCloud
from ..datasets.figures import rank_correlation
from ..recordings.recordings import open_recording
from ..report.page.rendering import millimetres, rendered
from .range_image import RangeImages, paired_images, range_images

MAX_POINTS = 10_000_000  # of each cloud in memory
MAX_VALUES = 4_000_000  # cells and points of all sweeps whose figures are taken
RESIDUALS = ("bias_m", "rmse_m", "median_m", "mad_m", "p05_m", "p95_m")
CELLS = ("in_both", "in_a_only", "in_b_only", "returns_in_both")  # without a return, or with

WIDTH = 1600  # of charts, pixels
# of charts, as shares of the width
LEFT = 0.075
RIGHT = 0.845
MAX_DOTS = 120_000
# colours of A and B
A_COLOUR = "#4477aa"
B_COLOUR = "#ee7733"
# no colours of residuals
ONLY_A = theme.rgb("#2ca25f")
ONLY_B = theme.rgb("#101418")
NO_RETURN = theme.rgb("#c8cbd0")  # within images, whatever the page's colours
GAP_LABELS = ("only A has a return", "only B has a return", "no return")
# colour maps
RANGE_COLOURS = "viridis"
RESIDUAL_COLOURS = "RdBu_r"
DISTANCE_COLOURS = "plasma"
RESIDUAL_SCALE = 6.0  # end of the scale, in median absolute deviations: about four sigma
MIN_DISTANCE_M = 0.001  # end of the scale of distances


class MeasuredPoints(NamedTuple):
    """Points of a cloud, and their distances to the compared cloud."""

    points: Floats  # (n, 3), metres
    distances: Floats  # (n,), metres


@dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """Result of `compare`; printed as a table."""

    __signature__ = ReadableSignature()

    figures: dict[str, Any]  # as in compare.json; lengths in metres, None for unknown
    images: RangeImages | None  # of the first pair of sweeps that has range images
    residuals: Floats  # (k,): of all cells with a return in both, or of a choice, metres
    distances: tuple[Floats, Floats]  # of A's points to B, and of B's to A, metres
    intensities: tuple[Floats, Floats]  # of A and B that are compared
    measured_points: Sequence[MeasuredPoints]  # of A and of B: of one pair of sweeps, or of all

    def __repr__(self) -> str:
        return rendered("comparison.txt", report=self.figures).rstrip("\n")

    @checked
    def save(self, folder: str | Path) -> list[Path]:
        """Write compare.json, compare.html and pictures, and return their paths.

        LidarError if the folder, which is created, cannot be written to.
        """
        path = Path(folder)
        with (
            result_folder(path),
            explained(f"The comparison cannot be written to {path}", "make room"),
            staging(path) as staged,
        ):
            pages = {"distances": draw_distances(self), "above": draw_above(self)}
            if self.images is not None:
                pages = {"ranges": draw_ranges(self), "rings": draw_rings(self)} | pages
            pictures = {name: page.svg() for name, page in pages.items()}
            text = json.dumps(self.figures, indent=1, allow_nan=False) + "\n"
            report = rendered("comparison.html", report=self.figures, pictures=pictures)
            files = {"compare.json": text.encode(), "compare.html": report.encode()}
            files |= {f"compare-{name}.png": page.png() for name, page in pages.items()}
            for name, content in files.items():
                (staged / name).write_bytes(content)
            return [(staged / name).replace(path / name) for name in files]


@checked
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
    unit_a: Literal[tuple(UNITS_M)] | None = None,  # type: ignore[valid-type]
    unit_b: Literal[tuple(UNITS_M)] | None = None,  # type: ignore[valid-type]
    keep_noise: bool = False,
    azimuth_deg: Annotated[float, Field(gt=0, le=90)] | None = None,
    distances_m: Sequence[float] = (0.05, 0.1, 0.2, 0.5),
    most_points: Annotated[int, Field(ge=1000)] = MAX_POINTS,
) -> Comparison:
    """Compare two clouds or recordings of the same place; B is the reference.

    Recordings of one sensor are compared sweep by sweep in the sensor's axes: the range image,
    returns that only A or B has, intensities, and distances to nearest neighbours. A cloud without
    rings or sweeps has distances alone, in the world frame. Clouds are compared as they are,
    without alignment.

    Parameters
    ----------
    a, b
        A result's folder or .ply, a data set, .pcd or a folder of them, .las, .laz, .e57, text
        (.xyz, .txt, .asc, .csv), .pts, .ptx, .npy, .bin, a bag of ROS 2 (.mcap or a folder), or a
        cloud in memory.
    sweeps
        Only these pairs of sweeps, from 0.
    match
        Whether sweeps of the same number or of the same time belong together.
    sensor_a, sensor_b
        Of a recording of several: name of the sensor, or topic of a bag.
    intensity_a, intensity_b
        Columns to compare as intensity, if not ``intensity``.
    unit_a, unit_b
        Unit of a .las, .laz, .ply, .pcd, .ptx, .pts, .npy or text (um, mm, cm, dm, m, km, in, ft,
        yd or mi), in place of metres or of the units that a .las, a .laz or a header states.
    keep_noise
        Whether points are compared that a .las or .laz withholds or classifies as noise (classes 7
        and 18), and those of such columns of other clouds; by default they are left out.
    azimuth_deg
        Width of a cell; by default the step from pulse to pulse, the coarser one.
    distances_m
        Distances within which a point counts as present in the compared cloud, for precision and
        recall.
    most_points
        Points of each cloud in memory; of more, a share is chosen evenly.

    Raises
    ------
    LidarError
        If A or B cannot be read or is empty, has lengths that are not true, as in Web Mercator, or
        A and B share no quantity to compare.
    """
    if not distances_m or any(not 0 < distance < np.inf for distance in distances_m):
        raise LidarError(f"distances_m is {list(distances_m)}; it must be lengths in metres.")
    first = open_recording(
        a, sensor_a, intensity_a, name="cloud A", unit=unit_a, keep_noise=keep_noise
    )
    second = open_recording(
        b, sensor_b, intensity_b, name="cloud B", unit=unit_b, keep_noise=keep_noise
    )
    comparing = _Comparing((first, second), tuple(sorted(distances_m)), azimuth_deg)
    if not first.is_cloud and not second.is_cloud:
        pairs = _pair_sweeps(first, second, match, comparing.notes)
        if sweeps:
            pairs = _choose_pairs(pairs, sweeps)
        budget = MAX_VALUES // len(pairs)
        for number_a, number_b in pairs:
            comparing.add(first.read_points(number_a), second.read_points(number_b), budget)
        return comparing.result(len(pairs))
    cloud = first if first.is_cloud else second
    if sweeps or match == "time":
        raise LidarError(f"{cloud.name} has no sweeps: leave out --sweep and --match.")
    if not first.is_cloud or not second.is_cloud:
        comparing.notes.append(
            f"{cloud.name} has no sweeps: all points of both are compared at once"
        )
    points_a = comparing.read_cloud(first, most_points)
    points_b = comparing.read_cloud(second, most_points)
    comparing.add(points_a, points_b, MAX_VALUES)
    return comparing.result(0)


def _choose_pairs(pairs: list[tuple[int, int]], sweeps: Sequence[int]) -> list[tuple[int, int]]:
    """Return the pairs at indices `sweeps`, in order; LidarError for an index out of range."""
    for number in sweeps:
        if not 0 <= number < len(pairs):
            raise LidarError(
                f"there is no sweep {number}: {plural(len(pairs), 'pair')} of sweeps, from 0."
            )
    return [pairs[number] for number in sorted({*sweeps})]


def _pair_sweeps(a: Recording, b: Recording, match: str, notes: list[str]) -> list[tuple[int, int]]:
    """Return the numbers of sweeps of A and B that belong together.

    Appends a note if sweeps are left over. LidarError if no sweeps belong together.
    """
    pairs = [(number, number) for number in range(min(a.count, b.count))]
    if match == "time":
        times_a = _sweep_times(a)
        times_b = _sweep_times(b)
        if pairs:
            order = np.argsort(times_a)
            sorted_times = times_a[order]
            middles = (sorted_times[1:] + sorted_times[:-1]) / 2
            nearest_a = order[np.searchsorted(middles, times_b)]
            period = np.median(np.diff(times_b)) if len(times_b) > 1 else 1e8
            close = np.flatnonzero(np.abs(times_a[nearest_a] - times_b) <= period / 2)
            pairs = [(int(nearest_a[number]), int(number)) for number in close]
    if not pairs:
        raise LidarError(
            f"{a.name} with {plural(a.count, 'sweep')} and {b.name} with {b.count:,} have none of "
            f"the same {match}."
        )
    if len(pairs) < max(a.count, b.count):
        notes.append(
            f"A has {plural(a.count, 'sweep')}, B {b.count:,}: "
            f"{plural(len(pairs), 'pair')} by {match}"
        )
    return pairs


def _sweep_times(recording: Recording) -> Floats:
    """Return the start of each sweep, ns; LidarError if the recording has no times."""
    if recording.times is None:
        raise LidarError(f"{recording.name} has no times of sweeps: leave out --match time.")
    return np.fromiter(recording.times(), np.float64)


class _CellPairs(NamedTuple):
    """Cells with a return in both sweeps, (k,) each."""

    residual: Floats  # metres
    ring: Ints
    intensity_a: Floats
    intensity_b: Floats


class _NearestPairs(NamedTuple):
    """Points of a cloud, each with its nearest neighbour in the compared cloud, (n,) each."""

    distance: Floats  # metres
    intensity: Floats  # of the point
    nearest_intensity: Floats


@dataclass(eq=False)
class _Comparing:
    """Running totals of a comparison, pair of sweeps by pair of sweeps."""

    recordings: tuple[Recording, Recording]
    distances_m: tuple[float, ...]
    azimuth_deg: float | None

    def __post_init__(self) -> None:
        self.notes = [note for recording in self.recordings for note in recording.notes]
        self.point_counts = np.zeros(2, np.int64)
        self.images: RangeImages | None = None
        self.measured_points: list[MeasuredPoints] = []
        self.cells: list[_CellPairs] = []
        self.nearest: tuple[list[_NearestPairs], list[_NearestPairs]] = ([], [])  # from A, from B
        # {ring: its elevation, and the number of its cells in each state of `CELLS`}
        self.rings: dict[int, tuple[float, Ints]] = {}

    def note(self, text: str) -> None:
        """Add a note, unless the same note was added before."""
        if text not in self.notes:
            self.notes.append(text)

    def read_cloud(self, recording: Recording, max_points: int) -> RecordedPoints:
        """Read points in the world frame: all, or about `max_points`, chosen evenly."""
        count = recording.point_count
        share = 1.0 if count is None else min(1.0, max_points / max(count, 1))
        parts = []
        for number in range(recording.count):
            part = recording.read_points(number, in_world=True)
            parts.append(part.part(even_indices(len(part), round(share * len(part)))))
        if share == 1 or not parts:
            return RecordedPoints.joined(parts)
        self.note(
            f"{recording.name} has {count:,} points, of which {100 * share:.3g} % are compared, "
            "chosen evenly: distances to it are too long"
        )
        return replace(RecordedPoints.joined(parts), rings=None)

    def add(self, a: RecordedPoints, b: RecordedPoints, budget: int) -> None:
        """Compare two sweeps or clouds, at most `budget` cells and points of each."""
        self.point_counts += len(a), len(b)
        if max(len(a), len(b)) > budget:
            self.note(f"of each sweep, {budget:,} points and cells are compared, chosen evenly")
        if not len(a) or not len(b):
            self.note("pairs of which one has no points are left out")
            return
        self._add_images(a, b, budget)
        for pairs, cloud, reference in zip(self.nearest, (a, b), (b, a), strict=True):
            chosen = cloud.part(even_indices(len(cloud), budget))
            distance, index = nearest(chosen.points, reference.points)
            if len(self.measured_points) < 2:
                self.measured_points.append(MeasuredPoints(chosen.points, distance))
            intensity = chosen.intensities
            if intensity is None or reference.intensities is None:
                pairs.append(_NearestPairs(distance, *np.full((2, len(distance)), np.nan)))
            else:
                pairs.append(_NearestPairs(distance, intensity, reference.intensities[index]))

    def _add_images(self, a: RecordedPoints, b: RecordedPoints, budget: int) -> None:
        """Compare the range images of two sweeps; add a note instead if there are none."""
        first, second = self.recordings
        same_rays = first.firing_key and first.firing_key == second.firing_key
        make_images = paired_images if same_rays else range_images
        try:
            images = make_images(a, b, (first.name, second.name), self.azimuth_deg)
        except LidarError as error:
            self.note(f"no range image: {error}")
            return
        for note in images.notes:
            self.note(note)
        self.images = self.images or images
        in_a, in_b = np.isfinite(images.compared[:, 0])
        self._count_cells(images, in_a, in_b)
        in_both = np.flatnonzero(in_a & in_b)
        in_both = in_both[even_indices(len(in_both), budget)]
        (range_a, intensity_a), (range_b, intensity_b) = images.compared[..., in_both]
        ring = images.rings[images.rows[in_both]]
        self.cells.append(_CellPairs(range_a - range_b, ring, intensity_a, intensity_b))

    def _count_cells(self, images: RangeImages, in_a: Bools, in_b: Bools) -> None:
        """Add the cells of each ring to its states; `in_a` and `in_b` (k,) mark returns."""
        rows = images.rows
        returned_a, returned_b = images.returned
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

    def result(self, pair_count: int) -> Comparison:
        """Return all figures of a number of pairs of sweeps; 0 for clouds without sweeps."""
        counts = self.point_counts.tolist()
        for recording, count in zip(self.recordings, counts, strict=True):
            if not count:
                listed = "".join(f" {note}." for note in recording.left_out_notes)
                raise LidarError(
                    f"{recording.name} has no points: there is nothing to compare.{listed}"
                )
        if not self.measured_points:
            raise LidarError("No pair of sweeps has points in both: choose others.")
        from_a, from_b = (
            _NearestPairs(*map(np.concatenate, zip(*pairs, strict=True))) for pairs in self.nearest
        )
        residuals = np.empty(0)
        image_figures = None
        paired_by = "nearest points"
        is_close = from_a.distance <= self.distances_m[0]
        intensity_a = from_a.intensity[is_close]
        intensity_b = from_a.nearest_intensity[is_close]
        if self.images is not None:
            cells = _CellPairs(*map(np.concatenate, zip(*self.cells, strict=True)))
            residuals = cells.residual
            intensity_a = cells.intensity_a
            intensity_b = cells.intensity_b
            image_figures = self._image_figures(cells)
            paired_by = self.images.paired_by
        is_known = np.isfinite(intensity_a) & np.isfinite(intensity_b)
        intensities = intensity_a[is_known], intensity_b[is_known]
        figures: dict[str, Any] = {
            "versions": {"lidarpool": __version__},
            **self._source_figures(),
            "pairs": pair_count,
            "notes": self.notes + [note for r in self.recordings for note in r.left_out_notes],
            "range_image": image_figures,
            "intensity": _intensity_figures(*intensities, paired_by),
            "distances": self._distance_figures(from_a.distance, from_b.distance),
        }
        distances = from_a.distance, from_b.distance
        return Comparison(
            figures, self.images, residuals, distances, intensities, self.measured_points
        )

    def _source_figures(self) -> dict[str, Any]:
        """Return the name and the sizes of A and B."""
        counts = self.point_counts.tolist()
        return {
            key: {
                "name": recording.name,
                "sweeps": None if recording.is_cloud else recording.count,
                "points": count,
            }
            for key, recording, count in zip("ab", self.recordings, counts, strict=True)
        }

    def _distance_figures(self, to_b: Floats, to_a: Floats) -> dict[str, Any]:
        """Return figures of the distances of A's points to B, and of B's to A, metres."""
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

    def _image_figures(self, cells: _CellPairs) -> dict[str, Any]:
        """Return figures of the range images and of each ring, the highest first."""
        images = self.images
        assert images is not None
        has_gaps = not any(recording.thinned for recording in self.recordings)
        rings = sorted(self.rings.items(), key=lambda item: -item[1][0])
        all_counts = sum(count for _, count in self.rings.values())
        return {
            "paired_by": images.paired_by,
            "columns": images.ranges[0].shape[1],
            "azimuth_step_deg": images.step_deg,
            "hidden_points": dict(zip("ab", images.hidden_shares, strict=True)),
            "residual": _residual_figures(cells.residual),
            "no_return": _no_return_figures(all_counts) if has_gaps else None,
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


def _intensity_figures(a: Floats, b: Floats, paired_by: str) -> dict[str, Any] | None:
    """Return figures of pairs of intensities (n,); None without a rank correlation."""
    correlation = rank_correlation(a, b)
    if correlation is None:
        return None
    return {"rank_correlation": correlation, "pairs": len(a), "of": paired_by}


def _residual_figures(values: Floats) -> dict[str, Any]:
    """Return figures of residuals A - B (n,), metres; None for each figure without residuals."""
    if not len(values):
        return {"cells": 0, **dict.fromkeys(RESIDUALS)}
    p05, median, p95 = np.quantile(values, (0.05, 0.5, 0.95)).tolist()
    mad = np.median(np.abs(values - median))
    rmse = np.sqrt(np.mean(values**2))
    figures = map(float, (values.mean(), rmse, median, mad, p05, p95))
    return {"cells": len(values), **dict(zip(RESIDUALS, figures, strict=True))}


def _no_return_figures(counts: Any) -> dict[str, Any]:
    """Return figures of cells without a return in A, with cells of B as the truth.

    `counts` (4,) are the cells of each state of `CELLS`.
    """
    in_both, in_a_only, in_b_only, _ = counts.tolist()
    precision = in_both / (in_both + in_a_only) if in_both + in_a_only else None
    recall = in_both / (in_both + in_b_only) if in_both + in_b_only else None
    return dict(zip(CELLS, counts.tolist(), strict=True)) | _scores(precision, recall)


def _scores(precision: float | None, recall: float | None) -> dict[str, float | None]:
    """Return precision, recall and their harmonic mean; None where undefined."""
    f1 = None
    if precision is not None and recall is not None:
        f1 = 2 * precision * recall / (precision + recall) if precision + recall else 0.0
    return {"precision": precision, "recall": recall, "f1": f1}


def _distance_quantiles(values: Floats) -> dict[str, Any]:
    """Return the mean and quantiles of distances (n,), metres."""
    shares = {"median_m": 0.5, "p90_m": 0.9, "p95_m": 0.95, "p99_m": 0.99, "max_m": 1.0}
    quantiles = np.quantile(values, list(shares.values())).tolist()
    return {
        "points": len(values),
        "mean_m": float(values.mean()),
        **dict(zip(shares, quantiles, strict=True)),
    }


class _ImageLayout(NamedTuple):
    """Heights, in pixels, of a page with three range images in a column."""

    image_height: int
    page_height: int
    top: int = 150
    gap: int = 62
    bottom: int = 90

    @classmethod
    def for_rows(cls, rows: int) -> _ImageLayout:
        """Lay out images of a number of rings."""
        image_height = int(np.clip(2.2 * rows, 90, 300))
        defaults = cls._field_defaults
        gaps = defaults["top"] + 2 * defaults["gap"] + defaults["bottom"]
        return cls(image_height, 3 * image_height + gaps)

    def image_bottom(self, number: int) -> float:
        """Return the lower edge of an image, from 0, as a share of the page."""
        pixels = self.page_height - self.top - (number + 1) * self.image_height - number * self.gap
        return pixels / self.page_height


def draw_ranges(comparison: Comparison) -> Page:
    """Draw the range images of A and B, and their residuals, in a column."""
    images = comparison.images
    assert images is not None
    row_count, column_count = images.ranges[0].shape
    layout = _ImageLayout.for_rows(row_count)
    page = Page((WIDTH, layout.page_height))
    size = f"{plural(row_count, 'ring')}, {plural(column_count, 'column')}"
    page.title("Range images", f"{size} of {images.step_deg:.4g}°")
    range_scale = _range_scale(images)
    limit = _residual_limit(comparison)
    residual_scale = Normalize(-limit, limit)
    share = layout.image_height / layout.page_height
    for number, words in enumerate(("A", "B", "A − B")):
        frame = (LEFT, layout.image_bottom(number), RIGHT - LEFT, share)
        axes = page.chart(frame, ylabel="elevation, °")
        if number < 2:
            colours = _range_colours(images, number, range_scale)
        else:
            colours = _residual_colours(images, residual_scale)
            axes.set_xlabel("azimuth, °")
            _draw_gap_legend(page, axes)
        _show_image(axes, images, colours)
        page.heading(axes, words)
    ramp = np.linspace(0, 1, 256)
    frame = (0.862, layout.image_bottom(1), 0.014, 2 * share + layout.gap / layout.page_height)
    page.colour_bar(theme.mapped(RANGE_COLOURS, ramp), range_scale, "range, m", frame)
    frame = (0.862, layout.bottom / layout.page_height, 0.014, share)
    page.colour_bar(theme.mapped(RESIDUAL_COLOURS, ramp), residual_scale, "A − B, mm", frame)
    return page


def _range_scale(images: RangeImages) -> LogNorm:
    """Return the scale of colours of ranges, metres."""
    ranges = np.concatenate([image[np.isfinite(image)] for image in images.ranges])
    min_m, max_m = np.quantile(ranges, (0.01, 0.98)) if len(ranges) else (0.0, 1.0)
    return LogNorm(max(float(min_m), 0.01), max(float(max_m), float(min_m) * 1.01, 0.02))


def _range_colours(images: RangeImages, index: int, scale: LogNorm) -> AnyArray:
    """Return the colours (r, c, …) of the ranges of A (0) or B (1)."""
    ranges = np.nan_to_num(images.ranges[index], nan=1.0)
    colours = theme.mapped(RANGE_COLOURS, scale(ranges).filled(0))
    colours[~images.returned[index]] = NO_RETURN
    return colours


def _residual_colours(images: RangeImages, scale: Normalize) -> AnyArray:
    """Return the colours (r, c, …) of the residuals, and of cells without a return."""
    residual = images.ranges[0] - images.ranges[1]
    in_a, in_b = images.returned
    colours = theme.mapped(RESIDUAL_COLOURS, scale(1000 * np.nan_to_num(residual)).data)
    colours[~in_a & ~in_b] = NO_RETURN
    colours[in_a & ~in_b] = ONLY_A
    colours[~in_a & in_b] = ONLY_B
    return colours


def _draw_gap_legend(page: Page, axes: Axes) -> None:
    """Draw a legend of the colours of cells without a return."""
    for text, colour in zip(GAP_LABELS, (ONLY_A, ONLY_B, NO_RETURN), strict=True):
        axes.plot([], [], "s", color=colour, ms=4, label=text)
    _draw_legend(page, axes)


def _show_image(axes: Axes, images: RangeImages, colours: AnyArray) -> None:
    """Show colours (r, c, …) as the sensor sees the cells: its left is on the left."""
    row_count, column_count = colours.shape[:2]
    start_deg = images.start_deg - images.step_deg / 2
    stop_deg = start_deg + column_count * images.step_deg
    extent = (stop_deg, start_deg, row_count - 0.5, -0.5)
    axes.imshow(colours[:, ::-1], aspect="auto", interpolation="nearest", extent=extent)
    rows = np.unique(np.linspace(0, row_count - 1, min(row_count, 5)).round().astype(int))
    axes.set_yticks(rows, [f"{images.elevation_deg[row]:.1f}" for row in rows])
    axes.grid(False)


def draw_rings(comparison: Comparison) -> Page:
    """Draw residuals and lost returns of each ring, and a histogram of all residuals."""
    image = comparison.figures["range_image"]
    rings = [ring for ring in image["rings"] if ring["cells"]]
    page = Page((WIDTH, 760))
    page.title("Residuals by ring", f"A − B in {image['residual']['cells']:,} {image['paired_by']}")
    has_gaps = image["no_return"] is not None
    width = 0.24 if has_gaps else 0.4
    gap = 0.075 if has_gaps else 0.1
    second_x = LEFT + width + gap
    third_x = second_x + (width + gap)
    frames = [(x, 0.13, width, 0.64) for x in (LEFT, second_x, third_x)]
    limit = _residual_limit(comparison)
    axes = page.chart(frames[0], xlabel="A − B, mm", ylabel="elevation, °")
    _draw_ring_residuals(page, axes, rings, limit)
    if has_gaps:
        axes = page.chart(frames[1], xlabel="cells without a return, %")
        _draw_ring_gaps(page, axes, rings)
    frame = frames[2] if has_gaps else frames[1]
    axes = page.chart(
        frame, xlabel="A − B, mm; more in the outer bins", ylabel="cells", yscale="log"
    )
    _draw_residual_histogram(axes, comparison.residuals, limit)
    return page


def _draw_residual_histogram(axes: Axes, residuals: Floats, limit: float) -> None:
    """Draw the histogram of residuals (k,) in metres, up to a limit in millimetres."""
    bin_mm = np.ceil(limit / 25) if limit > 10 else limit / 25  # ranges are often whole millimetres
    outer = np.floor(limit / bin_mm) + 0.5
    edges = np.arange(-outer, outer + 1) * bin_mm
    values = np.clip(1000 * residuals, edges[0], edges[-1])
    axes.hist(values, bins=edges.tolist(), color=A_COLOUR)


def _marker_size(page: Page, rings: Sequence[Any]) -> float:
    """Return the size of the markers of rings, points."""
    return 3.4 * page.unit if len(rings) < 40 else 2 * page.unit


def _draw_ring_residuals(
    page: Page, axes: Axes, rings: Sequence[Mapping[str, Any]], limit: float
) -> None:
    """Draw the spread, median and mean of the residuals of each ring, up to a limit in mm."""
    elevation = np.array([ring["elevation_deg"] for ring in rings])
    p05, median, p95, mean = (
        1000 * np.array([ring[name] for ring in rings])
        for name in ("p05_m", "median_m", "p95_m", "bias_m")
    )
    line_width = float(np.clip(150 / max(len(rings), 1), 0.7, 4)) * page.unit
    axes.hlines(elevation, p05, p95, color=theme.UNSEEN, lw=line_width, label="5 to 95 %")
    axes.axvline(0, color=theme.MUTED, lw=0.7 * page.unit)
    size = _marker_size(page, rings)
    axes.plot(median, elevation, "o", color=A_COLOUR, ms=size, mew=0, label="median")
    mean_style: dict[str, Any] = {"color": theme.SENSOR, "ms": 2 * size, "mew": 0.8 * page.unit}
    axes.plot(mean, elevation, "|", label="mean", **mean_style)
    axes.set_xlim(-limit, limit)
    _draw_legend(page, axes)


def _draw_ring_gaps(page: Page, axes: Axes, rings: Sequence[Mapping[str, Any]]) -> None:
    """Draw the share of cells without a return of each ring, in A and in B."""
    elevation = np.array([ring["elevation_deg"] for ring in rings])
    counts = np.array([[ring["no_return"][name] for name in CELLS] for ring in rings])
    style: dict[str, Any] = {"ms": _marker_size(page, rings), "mew": 0, "lw": 0.6 * page.unit}
    for colour, state, label in ((A_COLOUR, 1, "A"), (B_COLOUR, 2, "B")):
        share = 100 * (counts[:, 0] + counts[:, state]) / counts.sum(axis=1)
        axes.plot(share, elevation, "o-", color=colour, label=label, **style)
    axes.set_xlim(left=min(0, axes.get_xlim()[0]))
    _draw_legend(page, axes)


def draw_distances(comparison: Comparison) -> Page:
    """Draw cumulative distances in both directions, and intensities of A and B if known."""
    page = Page((WIDTH, 760))
    distances = comparison.figures["distances"]
    page.title(
        "Distances to the nearest neighbour",
        f"medians: A to B {millimetres(distances['a_to_b']['median_m'])}, B to A "
        f"{millimetres(distances['b_to_a']['median_m'])}",
    )
    intensity = comparison.figures["intensity"]
    axes = page.chart(
        (LEFT, 0.13, 0.4 if intensity else 0.77, 0.64),
        xlabel="distance, m",
        ylabel="points within, %",
        xscale="log",
        ylim=(0, 101),
    )
    shares = np.linspace(0, 1, 1001)
    labels = ("A to B", "B to A")
    for values, colour, label in zip(
        comparison.distances, (A_COLOUR, B_COLOUR), labels, strict=True
    ):
        quantiles = np.quantile(values, shares).clip(MIN_DISTANCE_M)
        axes.plot(quantiles, 100 * shares, color=colour, lw=1.4 * page.unit, label=label)
    max_m = max(float(np.quantile(values, 0.999)) for values in comparison.distances)
    right_m = max(2 * max_m, 0.01)
    axes.set_xlim(MIN_DISTANCE_M, right_m)
    label_logarithms(axes.xaxis, right_m < 1000 * MIN_DISTANCE_M)
    for score in distances["f_scores"]:
        axes.axvline(score["distance_m"], color=theme.LINE, lw=0.9 * page.unit, ls=(0, (4, 3)))
    _draw_legend(page, axes)
    if intensity:
        _draw_intensities(page, comparison)
    return page


def _draw_intensities(page: Page, comparison: Comparison) -> None:
    """Draw the histogram of pairs of intensities, on the right."""
    figures = comparison.figures["intensity"]
    frame = (LEFT + 0.5, 0.13, 0.4, 0.64)
    axes = page.chart(frame, xlabel="intensity in B", ylabel="intensity in A")
    intensity_a, intensity_b = comparison.intensities
    bins = _intensity_bins(intensity_b), _intensity_bins(intensity_a)
    axes.hist2d(intensity_b, intensity_a, bins, norm=LogNorm(), cmap="viridis", rasterized=True)
    axes.grid(False)
    correlation = f"rank correlation {figures['rank_correlation']:.3f}"
    page.heading(axes, f"{correlation} of {figures['pairs']:,} {figures['of']}")


def draw_above(comparison: Comparison) -> Page:
    """Draw both clouds from above, coloured by the distance between the clouds."""
    height = 830
    page = Page((WIDTH, height))
    page.title("From above", "the nearest neighbour in the other cloud; the farthest on top")
    measured = comparison.measured_points
    lower = np.min([np.quantile(points[:, :2], 0.01, axis=0) for points, _ in measured], axis=0)
    upper = np.max([np.quantile(points[:, :2], 0.99, axis=0) for points, _ in measured], axis=0)
    half_side = 1.06 * max(float((upper - lower).max()), 1e-3) / 2
    width = 0.36
    chart_height = 0.36 * WIDTH / height
    scale = _distance_scale(np.concatenate([distances for _, distances in measured]))
    middle = (lower + upper) / 2
    for number, cloud in enumerate(measured):
        frame = (LEFT + number * (width + 0.045), 0.12, width, chart_height)
        axes = page.chart(frame, xlabel="x, m", ylabel="" if number else "y, m")
        _scatter_points(page, axes, cloud, scale)
        span = np.array([-half_side, half_side])
        axes.set(xlim=middle[0] + span, ylim=middle[1] + span)
        page.heading(axes, ("A, distance to B", "B, distance to A")[number])
    ramp = theme.mapped(DISTANCE_COLOURS, np.linspace(0, 1, 256))
    page.colour_bar(ramp, scale, "distance, m", (0.875, 0.12, 0.014, chart_height))
    return page


def _distance_scale(distances: Floats) -> LogNorm:
    """Return the scale of colours of distances (n,), metres."""
    max_m = max(float(np.quantile(distances, 0.99)), 10 * MIN_DISTANCE_M)
    min_m = max(MIN_DISTANCE_M, min(float(np.quantile(distances, 0.05)), max_m / 10))
    return LogNorm(min_m, max_m)


def _scatter_points(page: Page, axes: Axes, cloud: MeasuredPoints, scale: LogNorm) -> None:
    """Draw points of a cloud from above, coloured by distance, the most distant on top."""
    rows = even_indices(len(cloud.points), MAX_DOTS)
    rows = rows[np.argsort(cloud.distances[rows])]
    axes.scatter(
        cloud.points[rows, 0],
        cloud.points[rows, 1],
        c=np.maximum(cloud.distances[rows], scale.vmin or 0.0),
        cmap=DISTANCE_COLOURS,
        norm=scale,
        s=(1.6 if len(rows) > 40_000 else 3) * page.unit**2,
        lw=0,
        rasterized=True,
    )


def _residual_limit(comparison: Comparison) -> float:
    """Return the end of the scale of residuals, millimetres."""
    residual = comparison.figures["range_image"]["residual"]
    if not residual["cells"]:
        return 1
    return max(1000 * (abs(residual["median_m"]) + RESIDUAL_SCALE * residual["mad_m"]), 0.1)


def _intensity_bins(values: AnyArray) -> AnyArray:
    """Return the edges of bins of intensities (n,), between whole numbers if all are whole."""
    upper = max(float(np.quantile(values, 0.995)), 1e-12)
    if upper <= 300 and (values == np.round(values)).all():
        return np.arange(-0.5, upper + 1)
    return np.linspace(0, upper, 121)


def _draw_legend(page: Page, axes: Axes) -> None:
    """Draw a legend of all labels above axes, at their right end."""
    handles, _ = axes.get_legend_handles_labels()
    style = {"ncols": len(handles), "columnspacing": 1.2, "borderaxespad": 0.3}
    page.key(handles, 6.8, axes, loc="lower right", bbox_to_anchor=(1, 1), **style)
