"""Sweeps and the standard names of their columns."""

from __future__ import annotations

import pickle
from types import SimpleNamespace

import numpy as np
import pytest

from lidarsim.columns.column_names import ALIASES, columns_for, standard_names, with_standard_names
from lidarsim.columns.sweep import Sweep

POINTS = np.array([[1, 0, 0], [np.nan, 0, 0], [0, 2, 0], [0, 0, 0]], np.float32)


@pytest.mark.parametrize("standard", ALIASES)
def test_every_alias_has_a_standard_name(standard):
    for alias in ALIASES[standard]:
        assert standard_names([alias]) == [standard], alias
        assert standard_names([f"scalar_{alias.upper()}"]) == [standard], alias
        assert standard_names([alias, standard]) == [alias, standard], "the exact name comes first"


def test_of_several_aliases_the_first_of_the_table_gets_the_name():
    assert standard_names(["label", "classification"]) == ["label", "class"]
    assert standard_names(["beam", "laser_id", "ring"]) == ["beam", "laser_id", "channel"]
    assert standard_names(["ring", "Ring"]) == ["channel", "Ring"]


def test_repeated_names_get_a_number_and_other_names_stay():
    assert standard_names(["t", "my column", "t"]) == ["t", "my column", "t_2"]
    assert standard_names(["X", "Ring"], among="xyz") == ["x", "Ring"]


def test_all_columns_of_a_quantity_are_found():
    columns = with_standard_names({"classification": np.zeros(2), "label": np.ones(2)})
    assert list(columns) == ["class", "label"]
    assert [*columns_for(columns, "class")] == ["class", "label"]
    stored = dict.fromkeys(["Label", "scalar_Classification", "Ring"], np.zeros(2))
    assert [*columns_for(stored, "class")] == ["scalar_Classification", "Label"]


def sweep(**fields):
    return Sweep(POINTS, {"channel": np.arange(4), "intensity": np.arange(4.0)}, **fields)


def test_returns_are_the_points_that_are_neither_nan_nor_zero():
    returns = sweep().returns()
    assert returns.points.tolist() == [[1, 0, 0], [0, 2, 0]] and returns.points.dtype == np.float64
    assert returns.rings.tolist() == [0, 2] and returns.intensity.tolist() == [0, 2]
    assert sweep().has_return.tolist() == [True, False, True, False]
    assert returns.returns() is returns


def test_selected_points_keep_what_the_recording_found():
    """The recording needs all points of a sweep, in their order."""
    calls = []

    def rings_of(whole):
        calls.append(len(whole))
        return np.arange(10, 14)

    facts = SimpleNamespace(rings_of=rings_of, times_of=lambda _: np.arange(4) / 10)
    bare = Sweep(POINTS, {}, facts=facts)
    chosen = bare.returns().select([1])
    assert chosen.rings.tolist() == [12] and chosen.times_s.tolist() == [0.2]
    assert calls == [4]
    again = pickle.loads(pickle.dumps(chosen))
    for copy in (again, again.returns(), again.select([0]), again.replace(pose=np.eye(4))):
        assert copy.rings.tolist() == [12] and copy.times_s.tolist() == [0.2]


def test_moved_points_keep_their_rings_and_times():
    """Rings that follow from elevation angles would be wrong in another frame."""
    facts = SimpleNamespace(
        rings_of=lambda sweep: np.nan_to_num(sweep.points[:, 0]).astype(int),
        times_of=lambda sweep: sweep.columns["t"],
    )
    recorded = Sweep(POINTS, {"t": np.arange(4)}, facts=facts)
    moved = recorded.replace(points=POINTS + 5, columns={})
    assert moved.rings.tolist() == [1, 0, 0, 0] and moved.times_s.tolist() == [0, 1, 2, 3]
    assert moved.with_columns().rings is None
    with pytest.raises(TypeError, match="no parameter 'channels'"):
        recorded.replace(channels=np.arange(4))


def test_poses_and_boxes_are_computed_when_they_are_requested():
    calls = []

    def pose():
        calls.append("pose")
        return np.eye(4)

    lazy = sweep(pose=pose, boxes=lambda: "boxes")
    assert not calls and lazy.pose is lazy.pose and calls == ["pose"]
    assert lazy.boxes == "boxes"
    moved = lazy.replace(pose=np.diag([-1.0, -1, 1, 1]))
    assert moved.in_world()[0].tolist() == [-1, 0, 0] and moved.rings.tolist() == [0, 1, 2, 3]


def test_intensity_is_the_reflectivity_of_sweeps_without_intensities():
    bare = Sweep(POINTS, {"reflectivity": np.arange(4)})
    assert bare.intensity.tolist() == [0, 1, 2, 3]
    assert bare.with_columns(intensity=None).intensity is None
    assert Sweep(POINTS).classes is None and Sweep(POINTS).rings is None


def test_joined_sweeps_have_all_columns_or_the_shared_ones():
    first = Sweep(POINTS[:1], {"a": np.array([1]), "b": np.array([2])})
    second = Sweep(POINTS[2:3], {"a": np.array([3])})
    joined = Sweep.concatenate([first, second, Sweep(POINTS[:0])])
    assert joined.columns["a"].tolist() == [1, 3] and np.isnan(joined.columns["b"][1])
    assert [*Sweep.concatenate([first, second], only_shared=True).columns] == ["a"]
    assert len(Sweep.concatenate([])) == 0
