"""Compares two clouds or recordings of one place: ranges by cell, lost returns, distances."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from pydantic import Field

from lidarsim._version import __version__
from lidarsim.base.arrays import AnyArray, Floats, Ints
from lidarsim.base.errors import LidarError, explained
from lidarsim.base.sampling import even_indices
from lidarsim.base.validation import checked
from lidarsim.base.vocabulary import UNITS_M
from lidarsim.base.words import plural
from lidarsim.columns.cloud import Cloud
from lidarview.render import theme
from lidarview.render.picture_page import Page

from ..base.open3d_module import load_open3d
from ..columns.parts import StoredCloud
from ..datasets.figures import rank_correlation
from ..export.folder import result_folder, staging
from ..report.page.rendering import millimetres, rendered
from .range_image import RangeImages, paired_images, range_images
from .recordings import RecordedPoints, Recording, open_recording

MOST_POINTS = 10_000_000  # of each cloud in memory
MOST_VALUES = 4_000_000  # cells and points of all sweeps, whose figures are taken
RESIDUALS = ("bias_m", "rmse_m", "median_m", "mad_m", "p05_m", "p95_m")

# Points (n, 3) of a cloud, and their distances (n,) to the other.
Above = tuple[Floats, Floats]
WIDTH = 1600
# of charts, as shares of the width
LEFT = 0.075
RIGHT = 0.845
MOST_DOTS = 120_000
A = "#4477aa"
B = "#ee7733"
# no colours of residuals
ONLY_A = theme.rgb("#2ca25f")
ONLY_B = theme.rgb("#101418")
NONE = theme.rgb("#c8cbd0")  # within images, whatever the page's colours
LACKS = ("only A has a return", "only B has a return", "no return")
RANGES = "viridis"
DIFFERENCES = "RdBu_r"
FAR = "plasma"
SCALE = 6.0  # end of the scale of residuals, in median absolute deviations: about four sigma
CELLS = ("in_both", "in_a_only", "in_b_only", "returns_in_both")  # without a return, or with
CLOSEST_M = 0.001  # end of the scale of distances


@dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """What `compare` has found; printed as a table."""

    figures: dict[str, Any]  # as in compare.json; lengths in metres, None for unknown
    images: RangeImages | None  # of the first pair of sweeps that has them
    residuals: Floats  # of all cells with a return in both, or of a choice
    distances: tuple[Floats, Floats]  # of A's points to B, and of B's to A
    lights: tuple[Floats, Floats]  # intensities of A and B that are compared
    above: Sequence[Above]  # of A and of B: of one pair of sweeps, or of all

    def __repr__(self) -> str:
        return rendered("comparison.txt", report=self.figures).rstrip("\n")

    @checked
    def save(self, folder: str | Path) -> list[Path]:
        """Write compare.json, compare.html and pictures, and return their paths.

        LidarError if the folder, which is made, cannot be written to.
        """
        place = Path(folder)
        with (
            result_folder(place),
            explained(f"The comparison cannot be written to {place}", "make room"),
            staging(place) as staged,
        ):
            drawn = {"distances": draw_distances(self), "above": draw_above(self)}
            if self.images is not None:
                drawn = {"ranges": draw_ranges(self), "rings": draw_rings(self)} | drawn
            images = {name: page.svg() for name, page in drawn.items()}
            text = json.dumps(self.figures, indent=1, allow_nan=False) + "\n"
            page = rendered("comparison.html", report=self.figures, pictures=images)
            files = {"compare.json": text.encode(), "compare.html": page.encode()}
            files |= {f"compare-{name}.png": drawing.png() for name, drawing in drawn.items()}
            for name, content in files.items():
                (staged / name).write_bytes(content)
            return [(staged / name).replace(place / name) for name in files]


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
    azimuth_deg: Annotated[float, Field(gt=0, le=90)] | None = None,
    distances_m: Sequence[float] = (0.05, 0.1, 0.2, 0.5),
    most_points: Annotated[int, Field(ge=1000)] = MOST_POINTS,
) -> Comparison:
    """Compare two clouds or recordings of the same place; B is the reference.

    Recordings of one sensor are compared sweep by sweep in the sensor's axes: the range image,
    returns that only one of them has, intensities, and distances to nearest neighbours. A cloud
    without rings or sweeps has distances alone, in the world's axes. Nothing is aligned before.

    Parameters
    ----------
    a, b
        A result's folder or .ply, a data set, .pcd or a folder of them, .las, .laz, a bag of ROS 2
        (.mcap or a folder), or a cloud in memory.
    sweeps
        Only these pairs of sweeps, from 0.
    match
        Which sweeps belong together: those of the same number, or of the same time.
    sensor_a, sensor_b
        Of a recording of several: name of the sensor, or topic of a bag.
    intensity_a, intensity_b
        Columns to compare as intensity, if not ``intensity``.
    unit_a, unit_b
        Unit of a .las, .laz, .ply or .pcd (um, mm, cm, dm, m, km, in, ft, yd or mi), in place of
        metres or of the units of the coordinate system that a .las or .laz states.
    azimuth_deg
        Width of a cell; by default the step from pulse to pulse, the coarser one.
    distances_m
        Distances within which a point is found by the other cloud, for precision and recall.
    most_points
        Points of each cloud in memory; of more, a share is chosen evenly.

    Raises
    ------
    LidarError
        If one cannot be read, is empty, or they have nothing that can be compared.
    """
    if not distances_m or any(not 0 < one < np.inf for one in distances_m):
        raise LidarError(f"distances_m is {list(distances_m)}; it must be lengths in metres.")
    recordings = (
        open_recording(a, sensor_a, intensity_a, name="cloud A", unit=unit_a),
        open_recording(b, sensor_b, intensity_b, name="cloud B", unit=unit_b),
    )
    found = _Comparing(recordings, tuple(sorted(distances_m)), azimuth_deg)
    first, second = recordings
    if not first.is_cloud and not second.is_cloud:
        pairs = _pairs(first, second, match, found.notes)
        for number in sweeps or ():
            if not 0 <= number < len(pairs):
                raise LidarError(
                    f"there is no sweep {number}: {plural(len(pairs), 'pair')} of sweeps, from 0."
                )
        if sweeps:
            pairs = [pairs[number] for number in sorted({*sweeps})]
        budget = MOST_VALUES // len(pairs)
        for i, j in pairs:
            found.add(first.read_points(i), second.read_points(j), budget)
        return found.result(len(pairs))
    one = first if first.is_cloud else second
    if sweeps or match == "time":
        raise LidarError(f"{one.name} has no sweeps: leave out --sweep and --match.")
    if not first.is_cloud or not second.is_cloud:
        found.notes.append(f"{one.name} has no sweeps: all points of both are compared at once")
    found.add(found.cloud(first, most_points), found.cloud(second, most_points), MOST_VALUES)
    return found.result(0)


def _pairs(a: Recording, b: Recording, match: str, notes: list[str]) -> list[tuple[int, int]]:
    """Numbers of the sweeps that belong together; a note if some are alone."""
    pairs = [(number, number) for number in range(min(a.count, b.count))]
    if match == "time":
        times = []
        for one in (a, b):
            if one.times is None:
                raise LidarError(f"{one.name} has no times of sweeps: leave out --match time.")
            times.append(np.fromiter(one.times(), np.float64))
        of_a, of_b = times
        if pairs:
            order = np.argsort(of_a)
            near = order[np.searchsorted((of_a[order][1:] + of_a[order][:-1]) / 2, of_b)]
            period = np.median(np.diff(of_b)) if len(of_b) > 1 else 1e8
            close = np.flatnonzero(np.abs(of_a[near] - of_b) <= period / 2)
            pairs = [(int(near[j]), int(j)) for j in close]
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


@dataclass(eq=False)
class _Comparing:
    """What has been compared so far."""

    recordings: tuple[Recording, Recording]
    within: tuple[float, ...]
    azimuth_deg: float | None

    def __post_init__(self) -> None:
        self.notes = [text for one in self.recordings for text in one.notes]
        self.points = np.zeros(2, np.int64)
        self.images: RangeImages | None = None
        self.above: list[Above] = []
        # Of cells with a return in both: residual, ring, intensities of A and B.
        self.cells: list[tuple[AnyArray, ...]] = []
        # Of points of A, and of B: distance to the other, own intensity, that of the nearest.
        self.pairs: tuple[list[Any], list[Any]] = ([], [])
        # {ring: its elevation, and how many of its cells are of each of `CELLS`}
        self.rings: dict[int, tuple[float, Ints]] = {}

    def note(self, text: str) -> None:
        """Say something once."""
        if text not in self.notes:
            self.notes.append(text)

    def cloud(self, one: Recording, most: int) -> RecordedPoints:
        """Read all points in the world's axes, or about so many, chosen evenly."""
        share = 1.0 if one.points is None else min(1.0, most / max(one.points, 1))
        parts = []
        for number in range(one.count):
            part = one.read_points(number, in_world=True)
            parts.append(part.part(even_indices(len(part), round(share * len(part)))))
        if share == 1 or not parts:
            return RecordedPoints.joined(parts)
        self.note(
            f"{one.name} has {one.points:,} points, of which {100 * share:.3g} % are compared, "
            "chosen evenly: distances to it are too long"
        )
        return replace(RecordedPoints.joined(parts), rings=None)

    def add(self, a: RecordedPoints, b: RecordedPoints, budget: int) -> None:
        """Compare two sweeps or clouds, of each at most so many cells and points."""
        self.points += len(a), len(b)
        if max(len(a), len(b)) > budget:
            self.note(f"of each sweep, {budget:,} points and cells are compared, chosen evenly")
        if not len(a) or not len(b):
            self.note("pairs of which one has no points are left out")
            return
        self._add_images(a, b, budget)
        for found, turn, other in zip(self.pairs, (a, b), (b, a), strict=True):
            some = turn.part(even_indices(len(turn), budget))
            distance, index = nearest(some.points, other.points)
            if len(self.above) < 2:
                self.above.append((some.points, distance))
            if some.light is None or other.light is None:
                found.append((distance, *np.full((2, len(distance)), np.nan)))
            else:
                found.append((distance, some.light, other.light[index]))

    def _add_images(self, a: RecordedPoints, b: RecordedPoints, budget: int) -> None:
        first, second = self.recordings
        same = first.firings and first.firings == second.firings
        make = paired_images if same else range_images
        try:
            images = make(a, b, (first.name, second.name), self.azimuth_deg)
        except LidarError as error:
            self.note(f"no range image: {error}")
            return
        for text in images.notes:
            self.note(text)
        self.images = self.images or images
        row = images.row
        values = images.compared
        in_a, in_b = np.isfinite(values[:, 0])
        neither, _ = np.nonzero(~images.there[0] & ~images.there[1])
        states = [neither, row[~in_a & in_b], row[in_a & ~in_b], row[in_a & in_b]]
        counts = np.stack([np.bincount(s, minlength=len(images.rings)) for s in states], axis=1)
        for ring, elevation, count in zip(
            images.rings.tolist(), images.elevation_deg.tolist(), counts, strict=True
        ):
            _, earlier = self.rings.get(ring, (0.0, np.zeros(4, np.int64)))
            self.rings[ring] = elevation, earlier + count
        where = np.flatnonzero(in_a & in_b)
        where = where[even_indices(len(where), budget)]
        (range_a, *of_a), (range_b, *of_b) = values[..., where]
        self.cells.append((range_a - range_b, images.rings[row[where]], *of_a, *of_b))

    def result(self, pairs: int) -> Comparison:
        """Return all figures, of so many pairs of sweeps; 0 of whole clouds."""
        for one, points in zip(self.recordings, self.points.tolist(), strict=True):
            if not points:
                raise LidarError(f"{one.name} has no points: there is nothing to compare.")
        if not self.above:
            raise LidarError("No pair of sweeps has points in both: choose others.")
        (to_b, *of_points), (to_a, *_) = (
            tuple(map(np.concatenate, zip(*found, strict=True))) for found in self.pairs
        )
        residuals = np.empty(0)
        image = None
        of = "nearest points"
        mine, theirs = (light[to_b <= self.within[0]] for light in of_points)
        if self.images is not None:
            cells = tuple(map(np.concatenate, zip(*self.cells, strict=True)))
            residuals, rings, mine, theirs = cells
            image = self._of_images(residuals, rings)
            of = self.images.paired_by
        known = np.isfinite(mine) & np.isfinite(theirs)
        lights = mine[known], theirs[known]
        correlation = rank_correlation(*lights)
        light = {"rank_correlation": correlation, "pairs": len(lights[0]), "of": of}
        figures: dict[str, Any] = {
            "versions": {"lidarpool": __version__},
            **{
                key: {
                    "name": one.name,
                    "sweeps": None if one.is_cloud else one.count,
                    "points": count,
                }
                for key, one, count in zip("ab", self.recordings, self.points.tolist(), strict=True)
            },
            "pairs": pairs,
            "notes": self.notes,
            "range_image": image,
            "intensity": None if correlation is None else light,
            "distances": {
                "a_to_b": _distances(to_b),
                "b_to_a": _distances(to_a),
                "chamfer_m": float(to_b.mean() + to_a.mean()),
                "f_scores": [
                    {"distance_m": one}
                    | _scores(float(np.mean(to_b <= one)), float(np.mean(to_a <= one)))
                    for one in self.within
                ],
            },
        }
        return Comparison(figures, self.images, residuals, (to_b, to_a), lights, self.above)

    def _of_images(self, residuals: Floats, rings: Ints) -> dict[str, Any]:
        images = self.images
        assert images is not None
        gaps = not any(one.thinned for one in self.recordings)
        return {
            "paired_by": images.paired_by,
            "columns": images.ranges[0].shape[1],
            "azimuth_step_deg": images.step_deg,
            "hidden_points": dict(zip("ab", images.hidden_shares, strict=True)),
            "residual": _residuals(residuals),
            "no_return": _no_return(sum(n for _, n in self.rings.values())) if gaps else None,
            "rings": [
                {
                    "ring": ring,
                    "elevation_deg": elevation,
                    **_residuals(residuals[rings == ring]),
                    "no_return": _no_return(count) if gaps else None,
                }
                for ring, (elevation, count) in sorted(
                    self.rings.items(), key=lambda item: -item[1][0]
                )
            ],
        }


def nearest(points: Floats, others: Floats) -> tuple[Floats, Ints]:
    """Distances (n,) of points to the nearest of others, metres, and the numbers of these."""
    core = load_open3d().core
    origin = others.mean(axis=0)  # far from zero, squares would lose their digits
    tree = core.nns.NearestNeighborSearch(core.Tensor(others - origin))
    tree.knn_index()
    index, square = tree.knn_search(core.Tensor(points - origin), 1)
    return np.sqrt(square.numpy()[:, 0]), index.numpy()[:, 0]


def _residuals(values: Floats) -> dict[str, Any]:
    """Figures of residuals A - B; None where there are none."""
    if not len(values):
        return {"cells": 0, **dict.fromkeys(RESIDUALS)}
    low, median, high = np.quantile(values, (0.05, 0.5, 0.95)).tolist()
    mad = np.median(np.abs(values - median))
    rmse = np.sqrt(np.mean(values**2))
    figures = map(float, (values.mean(), rmse, median, mad, low, high))
    return {"cells": len(values), **dict(zip(RESIDUALS, figures, strict=True))}


def _no_return(counts: Any) -> dict[str, Any]:
    """Figures of cells without a return in A, with those in B as the truth."""
    both, of_a, of_b, _ = counts.tolist()
    precision = both / (both + of_a) if both + of_a else None
    recall = both / (both + of_b) if both + of_b else None
    return dict(zip(CELLS, counts.tolist(), strict=True)) | _scores(precision, recall)


def _scores(precision: float | None, recall: float | None) -> dict[str, float | None]:
    f1 = None
    if precision is not None and recall is not None:
        f1 = 2 * precision * recall / (precision + recall) if precision + recall else 0.0
    return {"precision": precision, "recall": recall, "f1": f1}


def _distances(values: Floats) -> dict[str, Any]:
    shares = {"median_m": 0.5, "p90_m": 0.9, "p95_m": 0.95, "p99_m": 0.99, "max_m": 1.0}
    quantiles = np.quantile(values, list(shares.values())).tolist()
    return {
        "points": len(values),
        "mean_m": float(values.mean()),
        **dict(zip(shares, quantiles, strict=True)),
    }


def draw_ranges(found: Comparison) -> Page:
    """Draw the range images of both, and their residuals, below each other."""
    images = found.images
    assert images is not None
    rows = len(images.rings)
    high = int(np.clip(2.2 * rows, 90, 300))  # pixels of an image
    top = 150
    gap = 62
    below = 90
    height = top + 3 * high + 2 * gap + below
    page = Page((WIDTH, height))
    page.title(
        "Range images",
        f"{plural(rows, 'ring')}, {plural(images.ranges[0].shape[1], 'column')} of "
        f"{images.step_deg:.4g}°",
    )
    both = np.concatenate([image[np.isfinite(image)] for image in images.ranges])
    low, most = np.quantile(both, (0.01, 0.98)) if len(both) else (0.0, 1.0)
    norm = LogNorm(max(float(low), 0.01), max(float(most), float(low) * 1.01, 0.02))
    (in_a, in_b), residual = images.there, images.ranges[0] - images.ranges[1]
    scale = Normalize(-_limit(found), _limit(found))
    for k, words in enumerate(("A", "B", "A − B")):
        bottom = (height - top - (k + 1) * high - k * gap) / height
        axes = page.chart((LEFT, bottom, RIGHT - LEFT, high / height), ylabel="elevation, °")
        if k < 2:
            painted = theme.mapped(RANGES, norm(np.nan_to_num(images.ranges[k], nan=low)).filled(0))
            painted[~images.there[k]] = NONE
        else:
            painted = theme.mapped(DIFFERENCES, scale(1000 * np.nan_to_num(residual)).data)
            painted[~in_a & ~in_b] = NONE
            painted[in_a & ~in_b] = ONLY_A
            painted[~in_a & in_b] = ONLY_B
            axes.set_xlabel("azimuth, °")
            for text, colour in zip(LACKS, (ONLY_A, ONLY_B, NONE), strict=True):
                axes.plot([], [], "s", color=colour, ms=4, label=text)
            _key(page, axes)
        # As the sensor sees it: what is to its left is on the left.
        begin = images.start_deg - images.step_deg / 2
        end = begin + painted.shape[1] * images.step_deg
        extent = (end, begin, rows - 0.5, -0.5)
        axes.imshow(painted[:, ::-1], aspect="auto", interpolation="nearest", extent=extent)
        some = np.unique(np.linspace(0, rows - 1, min(rows, 5)).round().astype(int))
        axes.set_yticks(some, [f"{images.elevation_deg[row]:.1f}" for row in some])
        axes.grid(False)
        page.heading(axes, words)
    share = high / height
    bottom = (height - top - 2 * high - gap) / height
    ramp = np.linspace(0, 1, 256)
    frame = (0.862, bottom, 0.014, 2 * share + gap / height)
    page.colour_bar(theme.mapped(RANGES, ramp), norm, "range, m", frame)
    frame = (0.862, below / height, 0.014, share)
    page.colour_bar(theme.mapped(DIFFERENCES, ramp), scale, "A − B, mm", frame)
    return page


def draw_rings(found: Comparison) -> Page:
    """Draw residuals and lost returns of each ring, and a histogram of all residuals."""
    image = found.figures["range_image"]
    rows = [row for row in image["rings"] if row["cells"]]
    height = 760
    page = Page((WIDTH, height))
    page.title("Residuals by ring", f"A − B in {image['residual']['cells']:,} {image['paired_by']}")
    elevation = np.array([row["elevation_deg"] for row in rows])
    lows, middles, highs, means = (
        1000 * np.array([row[name] for row in rows])
        for name in ("p05_m", "median_m", "p95_m", "bias_m")
    )
    lost = image["no_return"] is not None
    wide, apart = (0.24, 0.075) if lost else (0.4, 0.1)
    axes = page.chart((LEFT, 0.13, wide, 0.64), xlabel="A − B, mm", ylabel="elevation, °")
    thick = float(np.clip(150 / max(len(rows), 1), 0.7, 4)) * page.unit
    axes.hlines(elevation, lows, highs, color=theme.UNSEEN, lw=thick, label="5 to 95 %")
    axes.axvline(0, color=theme.MUTED, lw=0.7 * page.unit)
    size = 3.4 * page.unit if len(rows) < 40 else 2 * page.unit
    axes.plot(middles, elevation, "o", color=A, ms=size, mew=0, label="median")
    axes.plot(means, elevation, "|", color=theme.SENSOR, ms=2 * size, mew=0.8 * page.unit,
              label="mean")  # fmt: skip
    limit = _limit(found)
    axes.set_xlim(-limit, limit)
    _key(page, axes)
    left = LEFT + wide + apart
    if lost:
        axes = page.chart((left, 0.13, wide, 0.64), xlabel="cells without a return, %")
        counts = np.array([[row["no_return"][name] for name in CELLS] for row in rows])
        for colour, which, words in ((A, 1, "A"), (B, 2, "B")):
            share = 100 * (counts[:, 0] + counts[:, which]) / counts.sum(axis=1)
            axes.plot(share, elevation, "o-", color=colour, ms=size, mew=0, lw=0.6 * page.unit,
                      label=words)  # fmt: skip
        axes.set_xlim(left=min(0, axes.get_xlim()[0]))
        _key(page, axes)
        left += wide + apart
    axes = page.chart((left, 0.13, wide, 0.64), xlabel="A − B, mm; more in the outer bins",
                      ylabel="cells", yscale="log")  # fmt: skip
    width = np.ceil(limit / 25) if limit > 10 else limit / 25  # ranges are often whole millimetres
    half = np.floor(limit / width) + 0.5
    edges = np.arange(-half, half + 1) * width
    values = np.clip(1000 * found.residuals, edges[0], edges[-1])
    axes.hist(values, bins=edges.tolist(), color=A)
    return page


def draw_distances(found: Comparison) -> Page:
    """Draw cumulative distances in both directions, and intensities of A and B if known."""
    height = 760
    page = Page((WIDTH, height))
    far = found.figures["distances"]
    page.title(
        "Distances to the nearest neighbour",
        f"medians: A to B {millimetres(far['a_to_b']['median_m'])}, B to A "
        f"{millimetres(far['b_to_a']['median_m'])}",
    )
    wide = 0.4 if found.figures["intensity"] else 0.77
    axes = page.chart((LEFT, 0.13, wide, 0.64), xlabel="distance, m", ylabel="points within, %",
                      xscale="log", ylim=(0, 101))  # fmt: skip
    shares = np.linspace(0, 1, 1001)
    for values, colour, words in zip(found.distances, (A, B), ("A to B", "B to A"), strict=True):
        reach = np.quantile(values, shares).clip(CLOSEST_M)
        axes.plot(reach, 100 * shares, color=colour, lw=1.4 * page.unit, label=words)
    most = max(float(np.quantile(values, 0.999)) for values in found.distances)
    axes.set_xlim(CLOSEST_M, max(2 * most, 0.01))
    axes.xaxis.set_major_formatter("{x:g}")
    for one in far["f_scores"]:
        axes.axvline(one["distance_m"], color=theme.LINE, lw=0.9 * page.unit, ls=(0, (4, 3)))
    _key(page, axes)
    if found.figures["intensity"]:
        light = found.figures["intensity"]
        axes = page.chart((LEFT + 0.5, 0.13, 0.4, 0.64), xlabel="intensity in B",
                          ylabel="intensity in A")  # fmt: skip
        mine, theirs = found.lights
        axes.hist2d(theirs, mine, (_bins(theirs), _bins(mine)), norm=LogNorm(), cmap="viridis",
                    rasterized=True)  # fmt: skip
        axes.grid(False)
        told = f"rank correlation {light['rank_correlation']:.3f}"
        page.heading(axes, f"{told} of {light['pairs']:,} {light['of']}")
    return page


def draw_above(found: Comparison) -> Page:
    """Draw both clouds from above, coloured by the distance to the other."""
    height = 830
    page = Page((WIDTH, height))
    page.title("From above", "the nearest neighbour in the other cloud; the farthest on top")
    above = found.above
    low = np.min([np.quantile(points[:, :2], 0.01, axis=0) for points, _ in above], axis=0)
    high = np.max([np.quantile(points[:, :2], 0.99, axis=0) for points, _ in above], axis=0)
    side = 1.06 * max(float((high - low).max()), 1e-3) / 2
    wide = 0.36
    tall = 0.36 * WIDTH / height
    everything = np.concatenate([distances for _, distances in above])
    most = max(float(np.quantile(everything, 0.99)), 10 * CLOSEST_M)
    least = max(CLOSEST_M, min(float(np.quantile(everything, 0.05)), most / 10))
    norm = LogNorm(least, most)
    for k, (points, distances) in enumerate(above):
        axes = page.chart((LEFT + k * (wide + 0.045), 0.12, wide, tall), xlabel="x, m",
                          ylabel="" if k else "y, m")  # fmt: skip
        some = even_indices(len(points), MOST_DOTS)
        some = some[np.argsort(distances[some])]
        axes.scatter(
            points[some, 0], points[some, 1], c=np.maximum(distances[some], least),
            cmap=FAR, norm=norm, s=(1.6 if len(some) > 40_000 else 3) * page.unit**2, lw=0,
            rasterized=True,
        )  # fmt: skip
        middle = (low + high) / 2
        axes.set(xlim=middle[0] + np.array([-side, side]), ylim=middle[1] + np.array([-side, side]))
        page.heading(axes, ("A, distance to B", "B, distance to A")[k])
    page.colour_bar(theme.mapped(FAR, np.linspace(0, 1, 256)), norm, "distance, m",
                    (0.875, 0.12, 0.014, tall))  # fmt: skip
    return page


def _limit(found: Comparison) -> float:
    """End of the scale of residuals, millimetres."""
    told = found.figures["range_image"]["residual"]
    return max(1000 * (abs(told["median_m"]) + SCALE * told["mad_m"]), 0.1) if told["cells"] else 1


def _bins(values: AnyArray) -> AnyArray:
    """Edges of bins of intensities, between whole numbers if they are such."""
    most = max(float(np.quantile(values, 0.995)), 1e-12)
    if most <= 300 and (values == np.round(values)).all():
        return np.arange(-0.5, most + 1)
    return np.linspace(0, most, 121)


def _key(page: Page, axes: Axes) -> None:
    """Put a legend of what has a label above axes, at their right end."""
    handles, _ = axes.get_legend_handles_labels()
    style = {"ncols": len(handles), "columnspacing": 1.2, "borderaxespad": 0.3}
    page.key(handles, 6.8, axes, loc="lower right", bbox_to_anchor=(1, 1), **style)
