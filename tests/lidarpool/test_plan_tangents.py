"""The tangent graph against formulas, and against polygons that hold or lie in the discs."""

import itertools
import math

import networkx
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from lidarpool.plan import shortest_path_length
from lidarpool.plan.geometry import segment_distances

CORNERS = 16
# By symmetry twice the way to the origin, where the inner tangent crosses.
FAR, NEAR, RADIUS = 10.0, math.hypot(5, 3.5), 4.0
ACROSS = 2 * (
    math.sqrt(FAR**2 - RADIUS**2)
    + math.sqrt(NEAR**2 - RADIUS**2)
    + RADIUS * (math.pi - math.atan2(3.5, 5) - math.acos(RADIUS / FAR) - math.acos(RADIUS / NEAR))
)


def over(rise: float, radius: float) -> float:
    """From (-5, 0) to (5, 0) over the top of a disc at (0, rise)."""
    apart = math.hypot(5, rise)
    bend = math.pi / 2 + math.atan2(rise, 5) - math.acos(radius / apart)
    return 2 * (math.sqrt(apart**2 - radius**2) + radius * bend)


# {case: (start, target, centres, radii, length)}
CASES = {
    "no disc": ((0, 0), (3, 4), [], [], 5),
    "nowhere to go": ((1, 1), (1, 1), [], [], 0),
    "out of the way": ((0, 0), (10, 0), [(5, 3)], [2.9], 10),
    "just touched": ((0, 0), (10, 0), [(5, 3)], [3], 10),
    "a small one": ((-5, 0), (5, 0), [(0, 0)], [0.01], over(0, 0.01)),
    "one whose edge the ends touch": ((-5, 0), (5, 0), [(0, 0)], [5], 5 * math.pi),
    "over one and under the next": ((-15, -3.5), (15, 3.5), [(-5, -3.5), (5, 3.5)], [4, 4], ACROSS),
    "two that overlap": ((-5, 0), (5, 0), [(0, 1.5), (0, -1.5)], [2, 2], over(1.5, 2)),
    "a gap": ((-5, 0), (5, 0), [(0, 2.01), (0, -2.01)], [2, 2], 10),
    "the same twice": ((-5, 0), (5, 0), [(0, 0), (0, 0)], [2, 2], over(0, 2)),
    "one within another": ((-5, 0), (5, 0), [(0, 0), (0.9, 0)], [2, 1], over(0, 2)),
    "a small one on top": ((-5, 1), (5, 1), [(0, 0), (0, 2)], [2, 0.5], over(1, 0.5)),
    "an end within one": ((0, 0), (9, 0), [(0.5, 0)], [1], math.inf),
}


@pytest.mark.parametrize("name", CASES)
def test_lengths_by_formula(name):
    *given, expected = CASES[name]
    assert shortest_path_length(*given) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("enclosed", [(0, 0), (9, 9)])
def test_a_closed_ring_of_discs_has_no_way_out(enclosed):
    angles = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    ring = 3 * np.stack([np.cos(angles), np.sin(angles)], axis=1) + enclosed
    closed, ajar = np.full(8, 1.2), np.full(8, 1.1)
    assert shortest_path_length((0, 0), (9, 9), ring, closed) == math.inf
    assert 9 * math.sqrt(2) <= shortest_path_length((0, 0), (9, 9), ring, ajar) < 14


def test_of_thousands_of_discs_those_out_of_reach_cost_nothing():
    """Looking at all of them would take an hour."""
    x, y = np.meshgrid(np.linspace(-50, 50, 60), np.linspace(6, 60, 50))
    grid = np.stack([x.ravel(), y.ravel()], axis=1)
    found = shortest_path_length((-5, 0), (5, 0), [*grid, (0, 0)], [*np.full(3000, 0.4), 2])
    assert found == pytest.approx(over(0, 2), rel=1e-12)


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
