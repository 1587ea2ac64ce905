"""Statistics of a data set: totals, label counts, bins and correlations, recomputed by hand."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from lidarfiles.datasets.figures import DataSetStatistics, VariedQuantity, rank_correlation
from lidarfiles.datasets.job_table import JobRow


def varied(values: list[object]) -> VariedQuantity:
    """Return the values of a quantity in jobs; None for a job without the quantity."""
    jobs = (
        JobRow(n, f"{n}", "train", {} if value is None else {"it": value})
        for n, value in enumerate(values)
    )
    (found,) = DataSetStatistics(["it"], jobs).varied_quantities
    return found


def names_of(labeled: VariedQuantity) -> list[str | None]:
    """Return the label of each job, or None."""
    return [None if np.isnan(value) else labeled.labels[int(value)] for value in labeled.values]


@pytest.mark.parametrize("count", [11, 12, 13, 20])
def test_only_the_rarest_of_more_than_twelve_labels_share_one(count):
    """Label k has 30 - k jobs, except that the first label is the rarest."""
    labels = [f"label {k:02}" for k in range(count)]
    jobs = [name for k, name in enumerate(labels) for _ in range(30 - k if k else 2)] + [None]
    folded = varied(jobs).merge_rare_labels()
    if count <= 12:
        assert folded.labels == tuple(labels) and names_of(folded) == jobs
        return
    frequent = labels[1:12]
    others = f"{count - 11} others"
    assert folded.labels == (*frequent, others)
    expected = [name if name in (*frequent, None) else others for name in jobs]
    assert names_of(folded) == expected
    counted = Counter(name for name in expected if name)
    assert folded.counts().tolist() == [counted[name] for name in folded.labels]


def test_words_numbers_and_truth_values_of_a_quantity_are_labels_in_order():
    mixed = varied(["auto", 2, None, 1.5, True, "auto", 2.0])
    assert mixed.labels == ("1.5", "2", "auto", "true")
    assert names_of(mixed) == ["auto", "2", None, "1.5", "true", "auto", "2"]
    assert mixed.counts().tolist() == [1, 2, 2, 1]
    numbers = varied([3, None, 0.5])
    assert numbers.labels == () and numbers.known_values.tolist() == [3, 0.5]


@pytest.mark.parametrize(
    ("values", "edges"),
    [
        ([2, 5, 32], np.arange(1.5, 33)),  # whole numbers, a bin for each
        ([2, 5, 33], np.linspace(2, 33, 7)),  # too many whole numbers
        ([2, 5.5, 32], np.linspace(2, 32, 7)),
        ([7, 7], [6.5, 7.5]),
        ([0.25, 0.25], np.linspace(-0.25, 0.75, 7)),
        ([], [-0.5, 0.5, 1.5]),
        (np.linspace(0, 99.5, 25), np.linspace(0, 99.5, 11)),  # twice the root of their number
        (np.linspace(0, 99.5, 400), np.linspace(0, 99.5, 25)),
        (np.geomspace(0.1, 2.1, 9), np.geomspace(0.1, 2.1, 7)),
        (np.geomspace(0.1, 1.9, 9), np.linspace(0.1, 1.9, 7)),  # not even a factor of 20
        (np.linspace(0.1, 99.5, 9), np.linspace(0.1, 99.5, 7)),
        (np.geomspace(0.1, 2.1, 9) - 0.1, np.linspace(0, 2, 7)),  # from zero
    ],
)
def test_bins_suit_the_distribution(values, edges):
    found = varied(list(values))
    np.testing.assert_allclose(found.edges, edges, rtol=1e-12, atol=1e-12)
    assert found.is_log == (np.ptp(np.diff(edges)) > 1e-9)


def test_a_logarithmic_distribution_has_its_median_below_the_mean_of_both_means():
    """The limit is the geometric mean of the geometric and the arithmetic mean of the limits."""
    limit = np.sqrt(np.sqrt(0.5 * 50.3) * (0.5 + 50.3) / 2)
    for median, is_log in ((0.999 * limit, True), (1.001 * limit, False)):
        assert varied([0.5, median, 50.3]).is_log == is_log


def test_long_labels_are_slanted():
    labels = varied(["short", "much longer"])
    assert labels.needs_slanted_labels(100) and not labels.needs_slanted_labels(1000)
    assert varied(["a"] * 20).needs_slanted_labels(10) and not varied([1, 2]).needs_slanted_labels(
        10
    )


def test_ranks_of_ties_are_their_mean():
    rng = np.random.default_rng(3)
    a, b = rng.integers(0, 6, (2, 40))
    ranks = [[np.sum(x < y) + (np.sum(x == y) + 1) / 2 for y in x] for x in (a, b)]
    assert rank_correlation(a, b) == pytest.approx(np.corrcoef(ranks)[0, 1])
    assert rank_correlation(a, np.zeros(40)) is None
    assert rank_correlation(np.array([0, 1]), np.array([5, 3])) == pytest.approx(-1)


def test_totals_and_spreads_are_of_finished_jobs():
    rng = np.random.default_rng(4)
    numbers = rng.integers(1, 1000, (30, 5))
    names = ("scans", "sweeps", "rays", "hits", "points")
    rows = [
        JobRow(
            n, f"{n:02}", ("train", "val")[n % 2], {"rain": float(n)},
            "failed" if n % 7 == 3 else "", **dict(zip(names, map(int, numbers[n]), strict=True)),
            seconds=float(n % 5), classes={n % 3: int(numbers[n, 4])},
        )
        for n in range(30)
    ]  # fmt: skip
    figures = DataSetStatistics(["rain"], rows)
    done = np.array([n % 7 != 3 for n in range(30)])
    assert (figures.jobs, figures.done, len(figures.failed)) == (30, done.sum(), (~done).sum())
    assert figures.totals == dict(zip(names, numbers[done].sum(axis=0).tolist(), strict=True))
    for split, own in (("train", done[::2]), ("val", done[1::2])):
        assert figures.splits[split]["jobs"] == own.sum()
    for number in range(3):
        rows_of_class = np.flatnonzero(done & (np.arange(30) % 3 == number))
        points = numbers[rows_of_class, 4].sum()
        assert figures.classes[number] == {"points": points, "jobs": len(rows_of_class)}
    points = np.sort(numbers[done, 4])
    spread = figures.percentiles("points")
    assert (spread["lowest"], spread["highest"]) == (points[0], points[-1])
    for share, name in ((0.1, "tenth"), (0.5, "median"), (0.9, "ninetieth")):
        assert spread[name] == pytest.approx(np.quantile(points, share))
    slowest = sorted(np.flatnonzero(done).tolist(), key=lambda n: (-(n % 5), n))[:10]
    assert [row.number for row in figures.slowest] == slowest
    (described,) = figures.summaries()
    assert described["rank_correlation_with_points"] == pytest.approx(
        rank_correlation(np.flatnonzero(done), numbers[done, 4]), abs=1e-6
    )
    assert (described["lowest"], described["median"], described["highest"]) == (0, 14.5, 29)
    assert DataSetStatistics(["rain"]).percentiles("points") is None
    failed = [JobRow(n, f"{n}", "train", {}, "failed") for n in range(203)]
    assert [row.number for row in DataSetStatistics([], failed).failed] == [*range(200)]
