"""Rings that are assigned to the runs of a sweep by their elevations."""

import numpy as np
import pytest

from lidarfiles.clouds.rings import assign_nearest


@pytest.mark.parametrize("seed", range(40))
def test_no_other_pairs_are_nearer(seed):
    optimize = pytest.importorskip("scipy.optimize")
    random = np.random.default_rng(seed)
    count, target_count = random.integers(1, 30, 2)
    # Rounded values are often equally far from two targets.
    values = random.normal(size=count).round(seed % 3)
    targets = random.normal(size=target_count).round(seed % 3)
    chosen, assigned = assign_nearest(values, targets)
    assert len({*chosen}) == len({*assigned}) == len(chosen) == min(count, target_count)
    rows, columns = optimize.linear_sum_assignment(np.abs(values[:, None] - targets))
    expected = np.abs(values[rows] - targets[columns]).sum()
    assert np.abs(values[chosen] - targets[assigned]).sum() == pytest.approx(expected)
    order = np.argsort(values[chosen], kind="stable")
    assert np.all(np.diff(targets[assigned][order]) >= 0)


def test_each_ring_is_assigned_once():
    chosen, assigned = assign_nearest(np.array([0.3, 0.1, 0.11]), np.array([0.1, 0.2, 0.3, 0.4]))
    assert dict(zip(chosen, assigned, strict=True)) == {1: 0, 2: 1, 0: 2}
    assert [len(part) for part in assign_nearest(np.zeros(0), np.zeros(3))] == [0, 0]
