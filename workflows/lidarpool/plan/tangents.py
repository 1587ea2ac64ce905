"""The shortest path around discs, exactly, through the graph of their tangents.

A shortest path in the plane around discs consists of straight pieces that touch discs and of arcs
along them (a taut string). So it is a shortest path of the graph
whose nodes are the points of contact of all common tangents, and whose edges are the tangents
that no disc blocks and the arcs between neighboring contacts: the tangent visibility graph of
Pocchiola and Vegter (1996), here without their sweep, every tangent against every disc.
"""

from __future__ import annotations

import heapq
from collections import defaultdict
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.base.arrays import Floats, Indices

from .geometry import PathAxes, segment_distances

# A tangent this close to a disc, as a share of the scene's size, passes it. Three discs with one
# common tangent are usual in constructed scenes, and rounding must not close the path.
_TOLERANCE = 1e-10
_TANGENTS_AT_ONCE = 4096  # limit for scenes with many discs, to bound the memory of the check

Graph = dict[int, list[tuple[int, float]]]  # {node: [(neighbor, length of the edge)]}


class _Tangents(NamedTuple):
    """Common tangents.

    Tangent t touches circle `circles[t, 0]` at `contacts[t, 0]`, and so on.
    """

    circles: Indices  # (t, 2)
    contacts: Floats  # (t, 2, 2)


def shortest_path_length(
    start: tuple[float, float], target: tuple[float, float], centers: ArrayLike, radii: ArrayLike
) -> float:
    """Return the length of the shortest path from `start` to `target` that enters no disc.

    Discs may overlap, touch and contain one another; a path may touch a disc's edge.

    Centers are (m, 2), and radii above 0 (m,); m may be 0. The length is inf if discs separate
    target and start, or contain one of the two.

    Notes
    -----
    A path no longer than some limit stays within an ellipse about its ends, and so meets only
    the discs that reach into the ellipse. At first the limit is the straight line; where the path
    around the discs in question is longer than the limit, so is the path around all, and the
    limit is raised. With k discs in question in the end it takes some k³ distance checks. Of
    thousands of discs these are few, unless discs bar the way and the path leads far around.

    Examples
    --------
    >>> shortest_path_length((0, 0), (3, 4), [], [])
    5.0
    """
    if start == target:
        return 0.0
    centers_, radii_ = _remove_nested(
        np.asarray(centers, float).reshape(-1, 2), np.asarray(radii, float).reshape(-1)
    )
    end_points = np.asarray([start, target], float)
    size = float(np.ptp(np.vstack([end_points, centers_]), axis=0).max() + radii_.max(initial=0.0))
    tolerance = _TOLERANCE * size
    # A path by way of a disc is at least as long as by way of the square around the disc: by the
    # corner or side of the square that is nearest to the straight line and its middle.
    axes = PathAxes(start, target)
    beside = np.abs(axes.to_local(centers_)) * axes.unit_m - radii_[:, None]
    x, y = np.maximum(beside, 0.0).T
    limit = axes.unit_m
    bounds = np.hypot(x + limit / 2, y) + np.hypot(x - limit / 2, y)
    sorted_bounds = np.sort(bounds)
    while True:
        in_question = bounds <= limit + tolerance
        length = _length_around(end_points, centers_[in_question], radii_[in_question], tolerance)
        if np.isinf(length) or not (bounds[~in_question] <= length + tolerance).any():
            return length
        # At least a quarter more of them, lest a long wall be examined disc by disc.
        next_bound = min(int(in_question.sum() * 1.25) + 1, len(bounds)) - 1
        limit = max(length, float(sorted_bounds[next_bound]))


def _length_around(end_points: Floats, centers: Floats, radii: Floats, tolerance: float) -> float:
    """Return the length of the shortest path between two ends (2, 2) around discs."""
    # The two ends are circles without radius, numbers 0 and 1.
    circles = np.vstack([end_points, centers])
    widths = np.concatenate([[0.0, 0.0], radii])
    tangents = _free_tangents(_all_tangents(circles, widths), circles, widths, tolerance)
    return _dijkstra(_graph(tangents, circles, widths), source=0, sink=1)


def _remove_nested(centers: Floats, radii: Floats) -> tuple[Floats, Floats]:
    """Return the discs that lie in no larger disc."""
    order = np.argsort(-radii, kind="stable")
    outermost: list[int] = []
    for disc in order:
        gaps = centers[outermost] - centers[disc]
        if not (np.sqrt((gaps**2).sum(axis=1)) + radii[disc] <= radii[outermost]).any():
            outermost.append(int(disc))
    return centers[outermost], radii[outermost]


def _all_tangents(centers: Floats, radii: Floats) -> _Tangents:
    """Return the common tangents of every two circles.

    The line {x: n·x = c} touches circle i at center_i + side_i · radius_i · n. Two circles share
    it when n · (center_j - center_i) = side_i · radius_i - side_j · radius_j, which for given
    sides has two solutions n, mirror images in the line of centers. Turning n and both sides
    around gives the same line, so side_i = 1 is enough.
    """
    i, j = np.triu_indices(len(radii), k=1)
    between = centers[j] - centers[i]
    distance = np.sqrt((between**2).sum(axis=1))
    circles = []
    contacts = []
    for side in (1.0, -1.0):
        # Equality is a point on a circle's edge, or two circles that touch; rounding may not
        # tell them apart. Side -1 of a point is its side 1 over again.
        fits = distance * (1 + _TOLERANCE) >= np.abs(radii[i] - side * radii[j])
        fits &= (distance > 0) & ((radii[j] > 0) | (side > 0))
        first = i[fits]
        second = j[fits]
        gap = distance[fits, None]
        unit = between[fits] / gap
        across = np.stack([-unit[:, 1], unit[:, 0]], axis=1)
        cosine = np.clip((radii[first] - side * radii[second])[:, None] / gap, -1.0, 1.0)
        for sine in (np.sqrt(1 - cosine**2), -np.sqrt(1 - cosine**2)):
            normal = cosine * unit + sine * across
            touched = [
                centers[first] + radii[first, None] * normal,
                centers[second] + side * radii[second, None] * normal,
            ]
            circles.append(np.stack([first, second], axis=1))
            contacts.append(np.stack(touched, axis=1))
    return _Tangents(np.concatenate(circles), np.concatenate(contacts))


def _free_tangents(
    tangents: _Tangents, centers: Floats, radii: Floats, tolerance: float
) -> _Tangents:
    """Return the tangents that enter no disc."""
    free = []
    for start in range(0, len(tangents.circles), _TANGENTS_AT_ONCE):
        part = slice(start, start + _TANGENTS_AT_ONCE)
        contacts = tangents.contacts[part]
        touched_circles = tangents.circles[part]
        enters = segment_distances(contacts[:, 0], contacts[:, 1], centers) < radii - tolerance
        # A tangent touches its two circles by construction.
        np.put_along_axis(enters, touched_circles, False, axis=1)
        free.append(~enters.any(axis=1))
    chosen = np.concatenate(free)
    return _Tangents(tangents.circles[chosen], tangents.contacts[chosen])


def _graph(tangents: _Tangents, centers: Floats, radii: Floats) -> Graph:
    """Return the graph of tangents and arcs.

    Nodes 0 and 1 are start and target.
    """
    graph: Graph = defaultdict(list)

    def connect(node: int, neighbor: int, length: float) -> None:
        graph[node].append((neighbor, length))
        graph[neighbor].append((node, length))

    owners = tangents.circles.reshape(-1)
    nodes = np.where(owners < 2, owners, 2 + np.arange(len(owners)))
    spans = tangents.contacts[:, 1] - tangents.contacts[:, 0]
    lengths = np.sqrt((spans**2).sum(axis=1))
    pairs = nodes.reshape(-1, 2).tolist()
    for (node, neighbor), length in zip(pairs, lengths.tolist(), strict=True):
        connect(node, neighbor, length)
    points = tangents.contacts.reshape(-1, 2)
    for circle in range(2, len(radii)):
        on_circle = np.flatnonzero(owners == circle)
        offsets = points[on_circle] - centers[circle]
        angles = np.arctan2(offsets[:, 1], offsets[:, 0])
        order = np.argsort(angles, kind="stable")
        for first, second, angle in _open_arcs(angles[order], circle, centers, radii):
            node, neighbor = (int(nodes[on_circle[order[p]]]) for p in (first, second))
            connect(node, neighbor, angle * float(radii[circle]))
    return graph


def _open_arcs(
    angles: Floats, circle: int, centers: Floats, radii: Floats
) -> list[tuple[int, int, float]]:
    """Return the arcs of `circle` between neighbors of the sorted `angles` that no disc blocks.

    Arcs are indices of two angles, and the angle between them. A contact lies in no other disc, so
    a disc that overlaps the circle covers a stretch between two contacts: the arc that holds the
    middle of the stretch is blocked.
    """
    if len(angles) < 2:
        return []
    gaps = centers - centers[circle]
    overlaps = np.sqrt((gaps**2).sum(axis=1)) < radii + radii[circle]
    overlaps[circle] = False
    overlaps[:2] = False
    middles = np.arctan2(gaps[overlaps, 1], gaps[overlaps, 0])
    blocked = np.zeros(len(angles), bool)
    blocked[np.searchsorted(angles, middles) - 1] = True  # before the first: the last arc, -1
    arc_angles = np.diff(angles, append=angles[0] + 2 * np.pi)
    return [
        (arc, (arc + 1) % len(angles), float(arc_angles[arc]))
        for arc in np.flatnonzero(~blocked).tolist()
    ]


def _dijkstra(graph: Graph, source: int, sink: int) -> float:
    """Return the length of the shortest path from `source` to `sink`, or inf without a path."""
    best = {source: 0.0}
    queue = [(0.0, source)]
    while queue:
        length, node = heapq.heappop(queue)
        if node == sink:
            return length
        if length > best[node]:
            continue
        for neighbor, edge in graph[node]:
            total = length + edge
            if total < best.get(neighbor, float("inf")):
                best[neighbor] = total
                heapq.heappush(queue, (total, neighbor))
    return float("inf")
