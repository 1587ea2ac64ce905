"""Points are counted in a grid that becomes coarser: the counts are those of all points at once."""

from __future__ import annotations

import numpy as np
import pytest

from lidarpool.report.cloud_counts import CloudCounts, GridCounts
from lidarsim.columns.table import TABLE

NEAR = np.int64(0x15555555)  # added to coordinates


def walk(points: int, step: int, seed: int) -> np.ndarray:
    """Cells of points that go anywhere, (points, 2)."""
    steps = np.random.default_rng(seed).normal(0, step, (points, 2))
    return np.cumsum(steps, axis=0).astype(np.int32)


def box_of(cells: np.ndarray) -> np.ndarray:
    """Lowest and highest cells, (2, n)."""
    return np.stack([cells.min(axis=0), cells.max(axis=0)]).astype(np.int64)


def grid_of(cells: np.ndarray, across: int, pieces: int) -> GridCounts:
    """Counts of points that are added piece by piece."""
    grid = GridCounts(across)
    for piece in np.array_split(cells, pieces):
        grid.widen(box_of(piece))
        for block in np.array_split(piece, 3):
            grid.add_points(*block.T)
    return grid


@pytest.mark.parametrize("across", [2, 16])
@pytest.mark.parametrize("step", [0, 0.5, 30, 1e5])
def test_counts_are_those_of_the_finest_grid_that_holds_all_points(across, step):
    cells = walk(3000, step, seed=2) - 70
    sides = (1 << level for level in range(32))
    boxes = ((side, (box_of(cells) + NEAR) // side) for side in sides)
    side, numbers = next((s, n) for s, n in boxes if (n[1] - n[0] < across).all())
    expected = np.zeros(numbers[1] - numbers[0] + 1, np.int64)
    np.add.at(expected, tuple(((cells + NEAR) // side - numbers[0]).T), 1)
    for pieces in (1, 7, 500):
        for order in (cells, cells[::-1]):
            grid = grid_of(order, across, pieces)
            assert grid.side == side
            assert (grid.lowest == numbers[0] * side - NEAR).all()
            assert grid.counts.tolist() == expected.tolist()
            assert grid.total == len(cells)
            assert (grid.box == box_of(cells)).all()


@pytest.mark.parametrize("step", [0.5, 30, 1e5])
def test_merged_counts_are_those_of_one_grid(step):
    """Of threads that count pieces far apart, or nothing."""
    cells = walk(3000, step, seed=2)
    expected = grid_of(cells, 16, 1)
    for order in ([0, 1, 2, 3], [3, 1, 0, 2]):
        pieces = [grid_of(piece, 16, 2) for piece in np.array_split(cells, [100, 150, 2000])]
        merged = GridCounts(16)
        for k in order:
            merged.merge(pieces[k])
        merged.merge(GridCounts(16))
        assert merged.side == expected.side
        assert (merged.lowest == expected.lowest).all()
        assert merged.counts.tolist() == expected.counts.tolist()


def test_labels_of_no_surface_and_of_no_object_are_told_apart():
    counts = CloudCounts([TABLE["object"], TABLE["material"]], 3, 2, 0.01, np.zeros(3))
    labels = np.array([0, 0, -1, 2, 2, 2, -1, -1, 0], np.int32)
    counts.add_points(
        {"object": labels, "material": np.array([-1, 1, 1, 0, 0, 0, 0, 1, -1], np.int32)}
    )
    assert counts.by_object.tolist() == [3, 0, 3]
    assert counts.no_surface == 3
    assert counts.by_material.tolist() == [4, 3]
    assert counts.point_count == 9
    counts.add_points({"object": np.array([3], np.int32), "material": np.array([0], np.int32)})
    assert counts.point_count == 9  # an object that the scene lacks
    assert counts.limits == {"object": (-1, 3), "material": (-1, 1)}


def test_farthest_cells_are_counted():
    limits = np.array([[-(2**31), 0], [2**31 - 2**27, 0]], np.int32)
    grid = grid_of(limits, 64, 1)
    assert grid.counts.sum() == 2 and grid.counts[0, 0] == 1


def test_a_picture_from_above_has_a_point_or_two_in_a_pixel():
    cells = np.random.default_rng(2).integers(0, 40_000, (20_000, 3)).astype(np.int32)
    counts = CloudCounts([], 1, 0, 0.001, np.array([100.0, 0, 0]))
    counts.widen(box_of(cells))
    counts.add_positions(list(cells.T))
    above, corner, pixel_m = counts.top_view()
    rows, columns = above.shape
    assert above.sum() == len(cells)
    assert 100 <= rows <= 201 and 100 <= columns <= 201
    assert pixel_m == pytest.approx(40 / columns, rel=0.05)
    x, y = ((cells[:, :2] * 0.001 + [100, 0] - corner) // pixel_m).astype(int).T
    expected = np.zeros((rows, columns), int)
    np.add.at(expected, (y, x), 1)
    assert abs(expected - above).sum() <= 2 * len(cells) * 0.001 / pixel_m * 4
    assert counts.bounds == pytest.approx(np.array([[100, 0, 0], [140, 40, 40]]), abs=0.1)
