"""The tangent graph against formulas, and against polygons that hold or lie in the discs."""

import itertools
import math

import networkx
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from lidarpool.plan import shortest_path_length, tangents
from lidarpool.plan.geometry import segment_distances

CORNERS = 16


def around_one(reach: float, radius: float) -> float:
    """From (-reach, 0) to (reach, 0) around a disc at the origin."""
    angle = math.acos(radius / reach)
    return 2 * math.sqrt(reach**2 - radius**2) + radius * (math.pi - 2 * angle)


def test_without_discs_it_is_the_straight_line():
    assert shortest_path_length((0, 0), (3, 4), [], []) == 5
    assert shortest_path_length((1, 1), (1, 1), [], []) == 0


def test_a_disc_out_of_the_way_changes_nothing():
    assert shortest_path_length((0, 0), (10, 0), [(5, 3)], [2.9]) == 10


def test_a_disc_that_is_just_touched_changes_nothing():
    assert shortest_path_length((0, 0), (10, 0), [(5, 3)], [3]) == pytest.approx(10, rel=1e-12)


@pytest.mark.parametrize("radius", [0.01, 1, 4.99, 5])
def test_around_one_disc(radius):
    found = shortest_path_length((-5, 0), (5, 0), [(0, 0)], [radius])
    assert found == pytest.approx(around_one(5, radius), rel=1e-12)


def test_an_inner_tangent_between_two_discs():
    """Over the first disc and under the second, each a long way past the straight line."""
    discs = [(-5, -3.5), (5, 3.5)]
    found = shortest_path_length((-15, -3.5), (15, 3.5), discs, [4, 4])
    # By symmetry twice the way to the origin, where the inner tangent crosses.
    far, near, radius = 10.0, math.hypot(5, 3.5), 4.0
    straight = math.sqrt(far**2 - radius**2) + math.sqrt(near**2 - radius**2)
    bend = math.acos(radius / far) + math.acos(radius / near)
    between = math.pi - math.atan2(3.5, 5)
    assert found == pytest.approx(2 * (straight + radius * (between - bend)), rel=1e-12)


def test_discs_that_overlap_bar_the_gap():
    """Two overlapping discs, one above the other: around the whole of one, not between."""
    found = shortest_path_length((-5, 0), (5, 0), [(0, 1.5), (0, -1.5)], [2, 2])
    apart, radius = math.hypot(5, 1.5), 2.0
    bend = math.pi / 2 + math.atan2(1.5, 5) - math.acos(radius / apart)
    over = 2 * (math.sqrt(apart**2 - radius**2) + radius * bend)
    assert found == pytest.approx(over, rel=1e-12)


def test_discs_that_touch_leave_the_point_they_touch_in():
    open_gap = shortest_path_length((-5, 0), (5, 0), [(0, 2.01), (0, -2.01)], [2, 2])
    assert open_gap == pytest.approx(10, rel=1e-9)


def test_discs_within_discs_and_twice_the_same_count_once():
    """The way over the top is the shorter one, and the inner discs lie on it or beside it."""
    once = shortest_path_length((-5, 1), (5, 1), [(0, 0)], [2])
    twice = shortest_path_length((-5, 1), (5, 1), [(0, 0), (0, 0)], [2, 2])
    inner = shortest_path_length((-5, 1), (5, 1), [(0, 0.5), (0, 0), (0.9, 0)], [1, 2, 1])
    assert twice == pytest.approx(once, rel=1e-12)
    assert inner == pytest.approx(once, rel=1e-12)


def test_a_disc_over_the_arc_bars_it():
    """A small disc sits on top of a large one: the way over both rests on the small one alone."""
    over = shortest_path_length((-5, 1), (5, 1), [(0, 0), (0, 2)], [2, 0.5])
    apart, radius = math.hypot(5, 1), 0.5
    bend = math.pi / 2 + math.atan2(1, 5) - math.acos(radius / apart)
    straight = math.sqrt(apart**2 - radius**2)
    assert over == pytest.approx(2 * (straight + radius * bend), rel=1e-12)


@pytest.mark.parametrize("enclosed", [(0, 0), (9, 9)])
def test_a_closed_ring_of_discs_has_no_way_out(enclosed):
    angles = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    ring = 3 * np.stack([np.cos(angles), np.sin(angles)], axis=1) + enclosed
    closed, ajar = np.full(8, 1.2), np.full(8, 1.1)
    assert shortest_path_length((0, 0), (9, 9), ring, closed) == math.inf
    assert 9 * math.sqrt(2) <= shortest_path_length((0, 0), (9, 9), ring, ajar) < 14


def test_an_end_within_a_disc_is_cut_off():
    assert shortest_path_length((0, 0), (9, 0), [(0.5, 0)], [1]) == math.inf


def test_an_end_on_the_edge_of_a_disc():
    assert shortest_path_length((-2, 0), (2, 0), [(0, 0)], [2]) == pytest.approx(2 * math.pi)


def test_the_default_scene():
    centres = [(-20, -20), (20, -20), (-20, 20), (20, 20), (-10, -5), (5, 5)]
    found = shortest_path_length((25, 25), (-30, -20), centres, [2] * 6)
    assert math.dist((25, 25), (-30, -20)) < found < 71.3


def test_of_thousands_of_discs_those_out_of_reach_cost_nothing():
    """Looking at all of them would take an hour."""
    x, y = np.meshgrid(np.linspace(-50, 50, 60), np.linspace(6, 60, 50))
    grid = np.stack([x.ravel(), y.ravel()], axis=1)
    found = shortest_path_length((-5, 0), (5, 0), [*grid, (0, 0)], [*np.full(3000, 0.4), 2])
    assert found == pytest.approx(around_one(5, 2), rel=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_leaving_out_what_is_out_of_reach_changes_nothing(seed):
    random = np.random.default_rng(seed)
    centres, radii = random.uniform(-20, 20, (60, 2)), random.uniform(0.5, 3.2, 60)
    ends = np.array([[-24.0, -3], [24, 5]])
    centres, radii = tangents._outermost(centres, radii)
    of_all = tangents._around(ends, centres, radii, tolerance=1e-9)
    assert shortest_path_length(*map(tuple, ends), centres, radii) == pytest.approx(
        of_all, rel=1e-12
    )


def polygon(centre, radius):
    angles = 2 * np.pi * np.arange(CORNERS) / CORNERS
    return centre + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def enters(first, last, centre, apothem):
    """Whether each segment passes the inside of the polygon of `CORNERS` sides (Cyrus-Beck)."""
    angles = 2 * np.pi * (np.arange(CORNERS) + 0.5) / CORNERS
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    begins = (first - centre) @ normals.T - apothem
    along = (last - first) @ normals.T
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = -begins / along
    outside = (np.abs(along) < 1e-12) & (begins > -1e-9)
    enter = np.where(along < -1e-12, crossing, 0).max(axis=1).clip(0)
    leave = np.where(along > 1e-12, crossing, 1).min(axis=1).clip(max=1)
    return (leave - enter > 1e-7) & ~outside.any(axis=1)


def polygon_path(start, target, centres, radii, *, hold):
    """Shortest path around polygons that hold the discs, or lie in them: a visibility graph."""
    shrink = math.cos(math.pi / CORNERS)
    outer = radii / shrink if hold else radii
    points = np.concatenate(
        [[start, target], *(polygon(c, r) for c, r in zip(centres, outer, strict=True))]
    )
    one, other = np.array(list(itertools.combinations(range(len(points)), 2))).T
    free = np.ones(len(one), bool)
    for centre, radius in zip(centres, outer, strict=True):
        free &= ~enters(points[one], points[other], centre, radius * shrink)
    graph = networkx.Graph()
    graph.add_nodes_from(range(len(points)))
    lengths = np.hypot(*(points[one] - points[other]).T)
    graph.add_weighted_edges_from(
        zip(one[free].tolist(), other[free].tolist(), lengths[free].tolist(), strict=True)
    )
    try:
        return networkx.dijkstra_path_length(graph, 0, 1)
    except networkx.NetworkXNoPath:
        return math.inf


coordinate = st.integers(-40, 40).map(lambda n: n / 4)
disc = st.tuples(coordinate, coordinate, st.integers(2, 24).map(lambda n: n / 4))


@settings(max_examples=60)
@given(discs=st.lists(disc, min_size=1, max_size=4))
@example(discs=[(0, 0, 3), (0, 4, 3), (0, -4, 3)])  # a wall
@example(discs=[(-8, 3, 3), (-8, -3, 3), (-14, 0, 4)])  # the start in a bay
@example(discs=[(0, 0, 2), (0, 0, 3), (3, 0, 3)])
def test_it_lies_between_the_ways_around_polygons_within_and_without(discs):
    start, target = np.array([-12.0, 0.1]), np.array([12.0, -0.1])
    centres, radii = np.array(discs)[:, :2], np.array(discs)[:, 2]
    ends = np.array([start, target])
    assume((segment_distances(ends, ends, centres) > radii / math.cos(math.pi / CORNERS)).all())
    found = shortest_path_length(tuple(start), tuple(target), centres, radii)
    assert polygon_path(start, target, centres, radii, hold=False) <= found + 1e-6
    assert found <= polygon_path(start, target, centres, radii, hold=True) + 1e-6
    assert found >= math.dist(start, target) - 1e-9
