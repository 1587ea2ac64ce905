"""Cells of organized clouds to which added returns belong."""

from __future__ import annotations

import numpy as np
import pytest

from lidarreal.augmentation.augmented_sweep import AugmentedSweep
from lidarreal.augmentation.rewriting.organized_cells import assign_cells
from lidarsim.columns.sweep import Sweep

RINGS, COLUMNS = 4, 90
MISSING = 0.3  # fraction of the pulses without a return


def grid(order, direction, seed=0):
    """Return the directions of all pulses, and a sweep with some returns."""
    ring, column = np.divmod(np.arange(RINGS * COLUMNS), COLUMNS)
    if order == "columns":
        column, ring = np.divmod(np.arange(RINGS * COLUMNS), RINGS)
    azimuth = 0.7 + direction * 2 * np.pi * (column + 0.2 * ring) / COLUMNS
    beams = np.stack([np.cos(azimuth), np.sin(azimuth), 0.1 * (ring - 1.5)], axis=1)
    rng = np.random.default_rng(seed)
    points = beams * rng.uniform(5, 30, (len(ring), 1))
    missing = rng.random(len(ring)) < MISSING
    points[missing] = np.nan
    sweep = Sweep(points, {"channel": ring, "intensity": np.ones(len(ring))})
    return beams, sweep, missing


def with_fog(beams, sweep, missing, own_template):
    """Lose every fourth return, and return fog from every second free pulse."""
    rows = np.arange(len(beams))
    kept = rows[~missing & (rows % 4 > 0)]
    fog = np.setdiff1d(rows, kept)[::2]
    rings = sweep.columns["channel"]
    template = fog.copy()
    if not own_template:  # the nearest recorded point of the same ring
        for k, row in enumerate(fog):
            same = np.flatnonzero((rings == rings[row]) & ~missing)
            template[k] = same[np.argmin(np.abs(same - row))]
    rows = np.concatenate([kept, fog])
    points = np.concatenate([sweep.points[kept], 3 * beams[fog]])
    template = np.concatenate([kept, template])
    is_recorded = np.arange(len(rows)) < len(kept)
    order = np.argsort(template, kind="stable")
    columns = {name: values[template[order]] for name, values in sweep.columns.items()}
    augmented = AugmentedSweep(Sweep(points[order], columns), template[order], is_recorded[order])
    return augmented, rows[order]


@pytest.mark.parametrize("own_template", [True, False])
@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("order", ["rows", "columns"])
def test_added_returns_are_in_the_cells_of_their_pulses(order, direction, own_template):
    for seed in range(5):
        beams, sweep, missing = grid(order, direction, seed)
        augmented, expected = with_fog(beams, sweep, missing, own_template)
        np.testing.assert_array_equal(assign_cells(sweep, augmented), expected)


def test_points_without_a_free_cell():
    beams, sweep, missing = grid("rows", 1)
    rows = np.flatnonzero(~missing)
    assert not missing[rows[3] - 1 : rows[3] + 2].all()
    full = Sweep(5 * beams, {"channel": sweep.columns["channel"]})
    count = len(full)
    template = np.append(np.arange(count), 7)
    points = np.concatenate([full.points, full.points[[7]] / 2])
    doubled = AugmentedSweep(Sweep(points), template, np.arange(count + 1) < count)
    assert assign_cells(full, doubled) is None
    unknown = sweep.replace(columns={})
    augmented, _ = with_fog(beams, sweep, missing, own_template=False)
    assert assign_cells(unknown, augmented) is None
    shuffled = np.random.default_rng(0).permutation(count)  # azimuths in any order
    moved = sweep.replace(points=sweep.points[shuffled], columns={"channel": np.zeros(count)})
    template = np.flatnonzero(moved.has_return)[[0, 0]]
    twice = AugmentedSweep(Sweep(moved.points[template]), template, np.array([True, False]))
    assert assign_cells(moved, twice) is None
