"""Compares two clouds or recordings of one place: ranges by cell, lost returns, distances."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from .._version import __version__
from ..base.arrays import AnyArray, Floats, Indices, Ints
from ..base.errors import LidarpoolError, explained
from ..base.open3d_module import load_open3d
from ..base.validation import checked
from ..base.words import counted
from ..columns.cloud import Cloud
from ..columns.parts import StoredCloud
from ..export.folder import result_folder, staging
from ..export.recordings import Recording, Turn, open_recording
from ..sensor.noise import Purpose, uniform
from .range_image import RangeImages, paired_images, range_images
from .ranks import rank_correlation

DISTANCES_M = (0.05, 0.1, 0.2, 0.5)
MOST_POINTS = 10_000_000  # of each cloud in memory
MOST_VALUES = 4_000_000  # cells and points of all sweeps, whose figures are taken
RESIDUALS: dict[str, Callable[[Floats], Any]] = {
    "bias_m": np.mean,
    "rmse_m": lambda values: np.sqrt(np.mean(values**2)),
    "median_m": lambda values: np.quantile(values, 0.5),
    "mad_m": lambda values: np.median(np.abs(values - np.quantile(values, 0.5))),
    "p05_m": lambda values: np.quantile(values, 0.05),
    "p95_m": lambda values: np.quantile(values, 0.95),
}

# Points (n, 3) of a cloud, and their distances (n,) to the other.
Above = tuple[Floats, Floats]


@dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """What `compare` has found; printed as a table."""

    figures: dict[str, Any]  # as in compare.json; lengths in metres, None for unknown
    images: RangeImages | None  # of the first pair of sweeps that has them
    residuals: Floats  # of all cells with a return in both, or of a choice
    distances: tuple[Floats, Floats]  # of A's points to B, and of B's to A
    lights: tuple[Floats, Floats]  # intensities of A and B that are compared
    above: tuple[Above, Above]  # of one pair of sweeps, or of all

    def __repr__(self) -> str:
        from .page.page import rendered

        return rendered("comparison.txt", report=self.figures).rstrip("\n")

    @checked
    def save(self, folder: str | Path) -> list[Path]:
        """Write compare.json, compare.html and pictures, and return their paths.

        LidarpoolError if the folder, which is made, cannot be written to.
        """
        from .comparison_page import write_comparison  # brings Matplotlib, which takes a moment

        place = Path(folder)
        with (
            result_folder(place),
            explained(f"The comparison cannot be written to {place}", "make room"),
            staging(place) as staged,
        ):
            names = write_comparison(staged, self)
            for name in names:
                (staged / name).replace(place / name)
        return [place / name for name in names]


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
    azimuth_deg: Annotated[float, Field(gt=0, le=90)] | None = None,
    distances_m: Sequence[float] = DISTANCES_M,
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
    azimuth_deg
        Width of a cell; by default the step from pulse to pulse, the coarser one.
    distances_m
        Distances within which a point is found by the other cloud, for precision and recall.
    most_points
        Points of each cloud in memory; of more, a share is chosen by a hash.

    Raises
    ------
    LidarpoolError
        If one cannot be read, is empty, or they have nothing that can be compared.
    """
    if not distances_m or any(not 0 < one < np.inf for one in distances_m):
        raise LidarpoolError(f"distances_m is {list(distances_m)}; it must be lengths in metres.")
    recordings = (
        open_recording(a, sensor_a, intensity_a, name="cloud A"),
        open_recording(b, sensor_b, intensity_b, name="cloud B"),
    )
    found = _Comparing(recordings, tuple(sorted(distances_m)), azimuth_deg)
    first, second = recordings
    if not first.whole and not second.whole:
        pairs = _pairs(first, second, match, found.notes)
        for number in sweeps or ():
            if not 0 <= number < len(pairs):
                raise LidarpoolError(
                    f"there is no sweep {number}: {counted(len(pairs), 'pair')} of sweeps, from 0."
                )
        if sweeps:
            pairs = [pairs[number] for number in sorted({*sweeps})]
        budget = MOST_VALUES // len(pairs)
        for i, j in pairs:
            found.add(first.turn(i), second.turn(j), budget)
        return found.result(len(pairs))
    one = first if first.whole else second
    if sweeps or match == "time":
        raise LidarpoolError(f"{one.name} has no sweeps: leave out --sweep and --match.")
    if not first.whole or not second.whole:
        found.notes.append(f"{one.name} has no sweeps: all points of both are compared at once")
    clouds = [found.cloud(one, most_points) for one in recordings]
    found.add(clouds[0], clouds[1], MOST_VALUES)
    return found.result(0)


def _pairs(a: Recording, b: Recording, match: str, notes: list[str]) -> list[tuple[int, int]]:
    """Numbers of the sweeps that belong together; a note if some are alone."""
    pairs = [(number, number) for number in range(min(a.count, b.count))]
    if match == "time":
        times = []
        for one in (a, b):
            if one.times is None:
                raise LidarpoolError(f"{one.name} has no times of sweeps: leave out --match time.")
            times.append(np.fromiter(one.times(), np.float64))
        of_a, of_b = times
        if pairs:
            order = np.argsort(of_a)
            near = order[np.searchsorted((of_a[order][1:] + of_a[order][:-1]) / 2, of_b)]
            period = np.median(np.diff(of_b)) if len(of_b) > 1 else 1e8
            close = np.flatnonzero(np.abs(of_a[near] - of_b) <= period / 2)
            pairs = [(int(near[j]), int(j)) for j in close]
    if not pairs:
        raise LidarpoolError(
            f"{a.name} with {counted(a.count, 'sweep')} and {b.name} with {b.count:,} have none of "
            f"the same {match}."
        )
    if len(pairs) < max(a.count, b.count):
        notes.append(
            f"A has {counted(a.count, 'sweep')}, B {b.count:,}: "
            f"{counted(len(pairs), 'pair')} by {match}"
        )
    return pairs


class _Comparing:
    """What has been compared so far."""

    def __init__(
        self,
        recordings: tuple[Recording, Recording],
        within: tuple[float, ...],
        azimuth_deg: float | None,
    ) -> None:
        self.recordings, self.within, self.azimuth_deg = recordings, within, azimuth_deg
        self.notes = [text for one in recordings for text in one.notes]
        self.points = np.zeros(2, np.int64)
        self.images: RangeImages | None = None
        self.above: list[Above] = []
        # Of cells with a return in both: residual, ring, intensities of A and B.
        self.cells: list[tuple[AnyArray, ...]] = []
        # Of points of A, and of B: distance to the other, own intensity, that of the nearest.
        self.pairs: tuple[list[Any], list[Any]] = ([], [])
        # {ring: its elevation, cells with a return in both, in none, only in B, only in A}
        self.rings: dict[int, tuple[float, Ints]] = {}

    def note(self, text: str) -> None:
        """Say something once."""
        if text not in self.notes:
            self.notes.append(text)

    def cloud(self, one: Recording, most: int) -> Turn:
        """Read all points in the world's axes, or a choice of about so many."""
        share = 1.0 if one.points is None else min(1.0, most / max(one.points, 1))
        parts = []
        for number in range(one.count):
            part = one.turn(number, in_world=True)
            parts.append(part.part(chosen(len(part), round(share * len(part)), number)))
        if share == 1 or not parts:
            return Turn.joined(parts)
        self.note(
            f"{one.name} has {one.points:,} points, of which {100 * share:.3g} % are compared, "
            "chosen by a hash: distances to it are too long"
        )
        return replace(Turn.joined(parts), rings=None)

    def add(self, a: Turn, b: Turn, budget: int) -> None:
        """Compare two sweeps or clouds, of each at most about so many cells and points."""
        self.points += len(a), len(b)
        if max(len(a), len(b)) > budget:
            self.note(
                f"of each sweep, {budget:,} points and cells are compared at most, chosen by a hash"
            )
        if not len(a) or not len(b):
            self.note("pairs of which one has no points are left out")
            return
        self._add_images(a, b, budget)
        for found, turn, other in zip(self.pairs, (a, b), (b, a), strict=True):
            some = turn.part(chosen(len(turn), budget, len(found)))
            distance, index = nearest(some.points, other.points)
            if len(self.above) < 2:
                self.above.append((some.points, distance))
            if some.light is None or other.light is None:
                found.append((distance, *np.full((2, len(distance)), np.nan)))
            else:
                found.append((distance, some.light, other.light[index]))

    def _add_images(self, a: Turn, b: Turn, budget: int) -> None:
        first, second = self.recordings
        same = first.firings and first.firings == second.firings
        make = paired_images if same else range_images
        try:
            images = make(a, b, (first.name, second.name), self.azimuth_deg)
        except LidarpoolError as error:
            self.note(f"no range image: {error}")
            return
        for text in images.notes:
            self.note(text)
        self.images = self.images or images
        row, values = images.row, images.compared
        in_a, in_b = np.isfinite(values[:, 0])
        states = [row[state] for state in (in_a & in_b, ~in_a & in_b, in_a & ~in_b)]
        states.insert(1, np.nonzero(~images.there[0] & ~images.there[1])[0])
        counts = np.stack([np.bincount(s, minlength=len(images.rings)) for s in states], axis=1)
        for ring, elevation, count in zip(
            images.rings.tolist(), images.elevation_deg.tolist(), counts, strict=True
        ):
            _, earlier = self.rings.get(ring, (0.0, np.zeros(4, np.int64)))
            self.rings[ring] = elevation, earlier + count
        where = np.flatnonzero(in_a & in_b)
        where = where[chosen(len(where), budget, len(self.cells))]
        (range_a, *of_a), (range_b, *of_b) = values[..., where]
        self.cells.append((range_a - range_b, images.rings[row[where]], *of_a, *of_b))

    def result(self, pairs: int) -> Comparison:
        """Return all figures, of so many pairs of sweeps; 0 of whole clouds."""
        for one, points in zip(self.recordings, self.points.tolist(), strict=True):
            if not points:
                raise LidarpoolError(f"{one.name} has no points: there is nothing to compare.")
        if not self.above:
            raise LidarpoolError("No pair of sweeps has points in both: choose others.")
        (to_b, *of_points), (to_a, *_) = (
            tuple(map(np.concatenate, zip(*found, strict=True))) for found in self.pairs
        )
        residuals, image, of = np.empty(0), None, "nearest points"
        mine, theirs = (light[to_b <= self.within[0]] for light in of_points)
        if self.images is not None:
            cells = tuple(map(np.concatenate, zip(*self.cells, strict=True)))
            residuals, rings, mine, theirs = cells
            image, of = self._of_images(residuals, rings), self.images.paired_by
        known = np.isfinite(mine) & np.isfinite(theirs)
        lights = mine[known], theirs[known]
        correlation = rank_correlation(*lights)
        figures: dict[str, Any] = {
            "versions": {"lidarpool": __version__},
            **{
                key: {"name": one.name, "sweeps": None if one.whole else one.count, "points": count}
                for key, one, count in zip("ab", self.recordings, self.points.tolist(), strict=True)
            },
            "pairs": pairs,
            "notes": self.notes,
            "range_image": image,
            "intensity": None
            if correlation is None
            else {"rank_correlation": correlation, "pairs": len(lights[0]), "of": of},
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
        above = self.above[0], self.above[1]
        return Comparison(figures, self.images, residuals, (to_b, to_a), lights, above)

    def _of_images(self, residuals: Floats, rings: Ints) -> dict[str, Any]:
        images = self.images
        assert images is not None
        gaps = not any(one.thinned for one in self.recordings)
        return {
            "paired_by": images.paired_by,
            "columns": images.ranges[0].shape[1],
            "azimuth_step_deg": images.step_deg,
            "hidden_points": dict(zip("ab", images.hidden, strict=True)),
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


def chosen(count: int, most: int, group: int) -> Indices:
    """Choose about `most` numbers below `count`, in order, by their hashes; all of fewer."""
    if count <= most:
        return np.arange(count)
    return np.flatnonzero(uniform(0, Purpose.CHOICE, group, np.arange(count)) < most / count)


def nearest(points: Floats, others: Floats) -> tuple[Floats, Ints]:
    """Distances (n,) of points to the nearest of others, metres, and the numbers of these."""
    core = load_open3d().core
    origin = others.mean(axis=0)  # far from zero, squares would lose their digits
    tree = core.nns.NearestNeighborSearch(core.Tensor(others - origin))
    tree.knn_index()
    index, square = tree.knn_search(core.Tensor(points - origin), 1)
    return np.sqrt(square.numpy()[:, 0]), index.numpy()[:, 0]


def _residuals(values: Floats) -> dict[str, Any]:
    """Figures of residuals A - B, `RESIDUALS`; None where there are none."""
    figures = (float(figure(values)) if len(values) else None for figure in RESIDUALS.values())
    return {"cells": len(values), **dict(zip(RESIDUALS, figures, strict=True))}


def _no_return(counts: Any) -> dict[str, Any]:
    """Figures of cells without a return in A, with those in B as the truth."""
    returns, both, of_a, of_b = counts.tolist()
    names = {"in_both": both, "in_a_only": of_a, "in_b_only": of_b, "returns_in_both": returns}
    precision = both / (both + of_a) if both + of_a else None
    return names | _scores(precision, both / (both + of_b) if both + of_b else None)


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
