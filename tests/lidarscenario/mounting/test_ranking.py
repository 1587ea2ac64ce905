"""Tests of mount placements, metrics and the search, with values computed by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lidarscenario.mount_sections import VehicleFile
from lidarscenario.mounting.blind_loops import BeamSegments, CellGrid, lower_to_beams
from lidarscenario.mounting.evaluation import MountResult
from lidarscenario.mounting.placements import Placements, Target, grid_placements, pack_sweeps
from lidarscenario.mounting.ranking import (
    MountCandidate,
    RankingRules,
    evaluate_candidate,
    pareto_front,
    points_by_position,
    rank_candidates,
)
from lidarscenario.mounting.search import CandidateSearch
from lidarsim import Pose, box
from lidarsim.sensor import Sensor

TARGETS = (Target("car", 10, 0.1, 1.0), Target("cone", 4, 0.3, 3.0), Target("bus", 5, 0.1, 2.0))


def placed(rows, sizes=((4, 2, 1.5), (0.4, 0.4, 0.7), (12, 2.5, 3))):
    """Return placements from rows of class, x, y and heading."""
    kind, x, y, heading = (np.array(column) for column in zip(*rows, strict=True))
    meshes = tuple(box(target.name, size) for target, size in zip(TARGETS, sizes, strict=True))
    positions = np.stack([x, y, 0.0 * x], axis=1)
    return Placements(TARGETS, meshes, np.arange(3), kind, positions, heading)


def test_placements_are_turned_to_the_left():
    placements = placed([(0, 5.0, -3.0, 90.0), (1, -1.0, 0.0, 0.0), (0, 3.0, 4.0, -30.0)])
    corners = placements.footprints()
    np.testing.assert_allclose(corners[0].min(axis=0), (4, -5), atol=1e-9)
    np.testing.assert_allclose(corners[0].max(axis=0), (6, -1), atol=1e-9)
    front_left = np.array([2 * math.cos(-math.pi / 6) - math.sin(-math.pi / 6),
                           2 * math.sin(-math.pi / 6) + math.cos(-math.pi / 6)])  # fmt: skip
    assert np.abs(corners[2] - (3, 4) - front_left).max(axis=1).min() < 1e-9
    (matrix,) = placements.matrices()[:1]
    np.testing.assert_allclose(matrix @ (1, 0, 0, 1), (5, -2, 0, 1), atol=1e-9)
    np.testing.assert_allclose(placements.distances_m, [math.hypot(5, 3), 1, 5])
    np.testing.assert_allclose(placements.bearings_deg[1:], [180, math.degrees(math.atan2(4, 3))])
    assert placements.select(np.array([False, True, True])).target.tolist() == [1, 0]


def test_a_grid_has_all_distances_bearings_and_headings():
    meshes = [box("car", (4, 2, 1.5)), box("cone", (1, 1, 1))]
    grid = grid_placements(TARGETS[:2], meshes, [5, 9], 4, [0, 45, 90])
    assert len(grid) == 2 * 2 * 4 * 3
    assert grid.target.tolist() == [0] * 24 + [1] * 24
    np.testing.assert_allclose(
        grid.positions[:12:3], [(5, 0, 0), (0, 5, 0), (-5, 0, 0), (0, -5, 0)]
    )
    np.testing.assert_allclose(grid.distances_m[12:24], 9)
    assert grid.headings_deg[:4].tolist() == [0, 45, 90, 0]


def test_targets_beside_a_body_remain_and_overlapping_ones_do_not():
    """The body reaches from -1 to 4 m along x and from -1 to 1 m along y."""
    body = np.array([[-1.0, -1.0], [4.0, 1.0]])
    apart = [
        (0, 6.01, 0, 0), (0, -3.01, 0, 0), (0, 2, 2.01, 0), (0, 2, -2.01, 180), (0, 5.01, 0, 90),
        # 1.84 and 2.69 m from a corner, across and along the diagonal
        (0, 5.3, 2.3, 135), (0, 5.9, 2.9, 45), (0, -2.9, -2.9, 45),
    ]  # fmt: skip
    overlapping = [
        (0, 5.99, 0, 0), (0, -2.99, 0, 0), (0, 2, 1.99, 0), (0, 2, -1.99, 0), (0, 4.99, 0, 90),
        (0, 4.6, 1.6, 135), (0, 5.3, 2.3, 45), (0, -2.3, -2.3, 45), (0, 1, 0, 20),
    ]  # fmt: skip
    kept = placed(apart + overlapping).without_collisions(body)
    np.testing.assert_array_equal(kept.positions[:, :2], [row[1:3] for row in apart])


def result(points, lowest, unobstructed=None):
    """Return the evaluation of a sensor."""
    lowest = np.array(lowest, np.float32)
    open_m = lowest if unobstructed is None else np.array(unobstructed, np.float32)
    return MountResult(np.array(points), lowest, open_m, 100, 7, 0, np.zeros((1, 1)))


RULES = RankingRules((0.0, 0.3, 1.0), 0.3, 0.5, np.array([[1, 1, 1, 1], [1, 1, 1, 0]], bool), 0.25)
INF = math.inf
LEFT = result([12, 3, 6, 0, 4], [[0, 0.2, 0.5, INF], [0.3, 0.3, 2.0, 0]],
              [[0, 0.2, 0.0, INF], [0.001, 0.3, 2.0, 0]])  # fmt: skip
RIGHT = result([1, 8, 4, 0, 4], [[0.4, 0.1, INF, INF], [0, INF, 0.9, 0]])
PLACED = placed([(0, 5, 0, 0), (0, 0, 5, 0), (1, 5, 0, 0), (1, -5, 0, 0), (1, 0, 9, 0)])


def evaluated(name="both", rules=RULES, **sensors):
    sensors = sensors or {"left": LEFT, "right": RIGHT}
    mounts = {key: Pose((0, 0, 1)) for key in sensors}
    return evaluate_candidate(MountCandidate(name, mounts), sensors, PLACED, rules)


def test_sensors_add_points_and_the_lowest_of_them_sees_a_cell():
    found = evaluated()
    assert found.points.tolist() == [13, 11, 10, 0, 8]
    assert found.detection == {
        "car": 1,
        "cone": pytest.approx(2 / 3),
        "bus": pytest.approx(math.nan, nan_ok=True),
    }
    assert found.mean_points["car"] == 12 and found.mean_points["cone"] == 6
    assert found.redundancy["car"] == 0 and found.redundancy["cone"] == pytest.approx(2 / 3)
    assert found.detection_rate == pytest.approx((1 * 1 + 3 * 2 / 3) / 4)
    np.testing.assert_allclose(found.lowest_m, [[0, 0.1, 0.5, INF], [0, 0.3, 0.9, 0]])
    assert found.map_m2 == 7 * 0.25
    # Two of the seven cells are visible on the ground, four up to 0.3 m, and six up to 1 m.
    assert found.blind_m2 == {0.0: 5 * 0.25, 0.3: 3 * 0.25, 1.0: 0.25}
    # The vehicle hides a cell in the middle from the left sensor, which is visible from the right.
    assert found.hidden_m2 == {0.0: 0.25, 0.3: 0.25, 1.0: 0}
    assert found.twice_m2 == {0.0: 0, 0.3: 2 * 0.25, 1.0: 3 * 0.25}
    assert found.score == pytest.approx(0.75 - 0.5 * 3 / 7)
    one = evaluated(left=LEFT)
    assert one.detection["car"] == 0.5 and one.redundancy["car"] == 0


def test_the_required_number_of_points_is_sufficient():
    lowest = np.zeros((2, 4))
    found = evaluated(top=result([10, 9, 4, 3, 5], lowest), low=result([10, 0, 4, 0, 3], lowest))
    assert found.detection["car"] == 0.5 and found.detection["cone"] == pytest.approx(2 / 3)
    one = evaluated(top=result([10, 9, 4, 3, 5], lowest))
    assert one.detection["car"] == 0.5 and one.detection["cone"] == pytest.approx(2 / 3)
    assert found.redundancy["car"] == 0.5 and found.redundancy["cone"] == pytest.approx(1 / 3)


def test_candidates_are_sorted_by_score_then_blind_area_then_points():
    weightless = RULES._replace(blind_weight=0.0)
    names = ["worse", "blind", "few", "best", "same"]
    seen, hidden = np.zeros((2, 4)), np.full((2, 4), INF)
    points = {"worse": 0, "blind": 20, "few": 20, "best": 30, "same": 30}
    results = [
        evaluated(
            name, weightless, top=result([points[name]] * 5, hidden if name == "blind" else seen)
        )
        for name in names
    ]
    assert [one.candidate.name for one in rank_candidates(results)] == [
        "best", "same", "few", "blind", "worse",
    ]  # fmt: skip
    # A candidate with the same values dominates no other.
    assert pareto_front(results, 0.3).tolist() == [False, False, True, True, True]
    mixed = [
        evaluated("a", top=result([20] * 5, hidden)),
        evaluated("b", top=result([0] * 5, seen)),
    ]
    assert pareto_front(mixed, 1.0).tolist() == [True, True]


def test_points_are_averaged_over_headings():
    rows = [(0, 5, 0, 0), (0, 5, 0, 90), (0, 0, 9, 0), (1, 5, 0, 0), (0, 0, -5, 0)]
    placements = placed(rows)
    found = evaluate_candidate(
        MountCandidate("a", {}),
        {"top": result([2, 6, 7, 100, 9], np.zeros((2, 4)))},
        placements,
        RULES,
    )
    distances, bearings, mean = points_by_position(found, placements, 0)
    assert (distances.tolist(), bearings.tolist()) == ([5, 9], [0, 90, 270])
    np.testing.assert_array_equal(mean, [[4, math.nan, 9], [math.nan, 7, math.nan]])


@pytest.mark.parametrize(("toward", "cells"), [
    ((1, 0), [(2, column) for column in range(3, 9)]),
    ((-1, 0), [(2, column) for column in range(3, -1, -1)]),
    ((0, 1), [(row, 3) for row in range(2, 5)]),
    ((0, -1), [(row, 3) for row in range(2, -1, -1)]),
])  # fmt: skip
def test_a_beam_lowers_the_cells_below_it_to_its_height_where_it_leaves_them(toward, cells):
    """A map of 9 x 5 cells of 0.5 m from (-2, -1), and a beam from (-0.3, 0.2) that descends."""
    grid = CellGrid(-2.0, -1.0, 0.5, 9, 5)
    slope = 0.2
    start = np.array([-0.3, 0.2, 1.1])
    direction = np.array([*toward, -slope]) / math.hypot(1, slope)
    beams = BeamSegments(start[None], direction[None], np.array([0.05]), np.array([99.0]))
    lowest = np.full((5, 9), np.inf)
    lower_to_beams(grid, beams, 1.05, lowest)
    axis = 0 if toward[0] else 1
    expected = np.full((5, 9), np.inf)
    for row, column in cells:
        edge = (grid.x, grid.y)[axis] + 0.5 * ((column, row)[axis] + (sum(toward) > 0))
        height = 1.1 - slope * abs(edge - start[axis])
        expected[row, column] = height if height < 1.05 else np.inf
    np.testing.assert_allclose(lowest, expected, atol=1e-9)
    short = beams._replace(stop_m=np.array([0.9]))
    reached = np.full((5, 9), np.inf)
    lower_to_beams(grid, short, 0.95, reached)
    seen = np.isfinite(reached)
    assert 0 < seen.sum() < np.isfinite(expected).sum()
    end_m = 1.1 - slope * 0.9 / math.hypot(1, slope)
    assert reached[seen].min() == pytest.approx(end_m)
    rising = beams._replace(directions=direction[None] * (1, 1, -1))
    raised = np.full((5, 9), np.inf)
    lower_to_beams(grid, rising, 2.0, raised)
    row, column = cells[1]
    entry = (grid.x, grid.y)[axis] + 0.5 * ((column, row)[axis] + (sum(toward) < 0))
    assert raised[row, column] == pytest.approx(1.1 + slope * abs(entry - start[axis]))


def test_beams_that_pass_the_map_lower_nothing():
    grid = CellGrid(0.0, 0.0, 1.0, 3, 2)
    origins = np.array([(-1.0, 3.0, 1), (4, -1, 1), (-1, -1, 1), (1.5, 0.5, 1)])
    directions = np.array([(1.0, 0, 0), (0, 1, 0), (-1, 0, 0), (0, 0, -1)])
    beams = BeamSegments(origins, directions, np.zeros(4), np.array([9.0, 9, 9, 0.75]))
    lowest = np.full((2, 3), np.inf)
    lower_to_beams(grid, beams, 2.0, lowest)
    expected = np.full((2, 3), np.inf)
    expected[0, 1] = 0.25
    np.testing.assert_allclose(lowest, expected)


def test_targets_in_one_sweep_do_not_hide_each_other():
    """A near target, one behind it, one beside it, and one that surrounds the sensor."""
    rows = [
        (0, 6, 0, 90),
        (1, 20, 0.2, 0),
        (1, 0, 8, 0),
        (2, 5.5, 0, 0),
        (1, -15, -0.1, 0),
        (1, -7, 0.1, 0),
    ]
    view = np.ones(1440, bool)
    origin = np.array([0.3, 0.0, 1.8])
    sweeps = [sweep.tolist() for sweep in pack_sweeps(placed(rows), origin, Sensor.grid(), view)]
    assert sorted(index for sweep in sweeps for index in sweep) == list(range(6))
    assert [3] in sweeps
    together = {index: number for number, sweep in enumerate(sweeps) for index in sweep}
    assert together[0] != together[1] and together[4] != together[5]
    assert together[0] == together[2]
    view[:] = False
    view[4 * (92 + 180)] = True  # 92°
    (only,) = (
        sweep.tolist() for sweep in pack_sweeps(placed(rows[:3]), origin, Sensor.grid(), view)
    )
    assert only == [2]


def test_a_search_finds_the_best_mount_within_its_ranges():
    """The points depend on the distance from a mount that the search does not know."""
    ranges = {"x": [-1, 3], "y": [0.5, 0.5], "z": [1, 2], "pitch_deg": [-10, 10]}
    data = {
        "body": "van",
        "sensors": {"top": {"model": "vlp16", "ranges": ranges}},
        "targets": {"car": {"points": 1}},
        "search": {"samples": 6, "refinements": 5, "seed": 1},
    }
    vehicle = VehicleFile.from_data(data)
    best = np.array([2.2, 0.5, 1.3, 0, 4.0, 0])
    asked = []

    def evaluate(mounts):
        asked.extend(mounts)
        for _, pose in mounts:
            values = np.array([*pose.position, pose.yaw_deg, pose.pitch_deg, pose.roll_deg])
            away = float((np.abs(values - best) / (4, 1, 1, 1, 20, 1)).sum())
            yield result([1] * 5, np.full((2, 4), INF if away > 5 else 0.29 + away))

    rules = RULES._replace(heights_m=tuple(0.3 + 0.05 * n for n in range(40)), ranked_height_m=0.3)
    found = rank_candidates(CandidateSearch(vehicle, PLACED, rules, evaluate).run())
    pose = found[0].candidate.mounts["top"]
    assert pose.position == pytest.approx((2.2, 0.5, 1.3), abs=0.15)
    assert pose.pitch_deg == pytest.approx(4, abs=1.5)
    assert (pose.yaw_deg, pose.roll_deg) == (0, 0)
    assert asked[0][1].position == (1, 0.5, 1.5), "the center of the ranges is tried first"
    positions = np.array([pose.position for _, pose in asked])
    assert (positions >= (-1, 0.5, 1)).all() and (positions <= (3, 0.5, 2)).all()
    assert len({*asked}) == len(asked), "no mount is evaluated twice"
    assert max(abs(pose.pitch_deg) for _, pose in asked) <= 10
