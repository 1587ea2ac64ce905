"""Exact length of the shortest path around discs, computed with a graph of their tangents.

Like a taut string, a shortest path around discs consists of straight segments that touch discs and
of arcs along their edges. It is therefore a shortest path in a graph. The nodes are the contact
points of all common tangents, and the edges are the unblocked tangents and the arcs between
adjacent contact points. This is the tangent visibility graph of Pocchiola and Vegter (1996).
Instead of their sweep algorithm, every tangent is tested against every disc.
"""

from __future__ import annotations

import heapq
from collections import defaultdict
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.numerics.arrays import Floats, Indices

from .geometry import PathAxes, segment_distances

# Tangents may enter a disc by this fraction of the scene size. Constructed scenes often contain
# three discs with a common tangent, and rounding errors must not block such a path.
_TOLERANCE = 1e-10
_TANGENTS_AT_ONCE = 4096  # limit for scenes with many discs, to bound the memory of the check

Graph = dict[int, list[tuple[int, float]]]  # {node: [(neighbor, length of the edge)]}


class _Tangents(NamedTuple):
    """Common tangents of pairs of circles.

    Tangent t touches circle `circles[t, 0]` at `contacts[t, 0]`, and circle `circles[t, 1]` at
    `contacts[t, 1]`.
    """

    circles: Indices  # (t, 2)
    contacts: Floats  # (t, 2, 2)


def shortest_path_length(
    start: tuple[float, float], target: tuple[float, float], centers: ArrayLike, radii: ArrayLike
) -> float:
    """Return the length of the shortest path from `start` to `target` that enters no disc.

    Discs may overlap, touch or contain one another, and the path may touch the edge of a disc. The
    length is inf if the discs separate the target from the start, or if a disc contains either
    point.

    Parameters
    ----------
    start, target
        x and y of the end points of the path.
    centers
        Centers of the discs. Shape (m, 2), where m may be 0.
    radii
        Radii of the discs, greater than 0. Shape (m,).

    Notes
    -----
    A path no longer than a given limit stays within an ellipse whose foci are its end points, and
    can meet only the discs that reach into this ellipse. The initial limit is the straight-line
    distance. If the shortest path around the selected discs is longer than the limit, so is the
    path around all discs, and the limit is raised. With k discs selected in the end, the method
    needs about k³ distance checks. Even with thousands of discs k is small, unless discs block the
    way and require a long detour.

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
    # A path that touches a disc is at least as long as a path to the square around the disc. The
    # closest point of the square to the straight line and to its midpoint gives a lower bound.
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
        # Add at least a quarter of the discs, so that a long wall is not examined disc by disc.
        next_bound = min(int(in_question.sum() * 1.25) + 1, len(bounds)) - 1
        limit = max(length, float(sorted_bounds[next_bound]))


def _length_around(end_points: Floats, centers: Floats, radii: Floats, tolerance: float) -> float:
    """Return the length of the shortest path between two end points that enters no disc."""
    # The end points are circles 0 and 1, with radius 0.
    circles = np.vstack([end_points, centers])
    widths = np.concatenate([[0.0, 0.0], radii])
    tangents = _free_tangents(_all_tangents(circles, widths), circles, widths, tolerance)
    return _dijkstra(_graph(tangents, circles, widths), source=0, sink=1)


def _remove_nested(centers: Floats, radii: Floats) -> tuple[Floats, Floats]:
    order = np.argsort(-radii, kind="stable")
    outermost: list[int] = []
    for disc in order:
        gaps = centers[outermost] - centers[disc]
        if not (np.sqrt((gaps**2).sum(axis=1)) + radii[disc] <= radii[outermost]).any():
            outermost.append(int(disc))
    return centers[outermost], radii[outermost]


def _all_tangents(centers: Floats, radii: Floats) -> _Tangents:
    """Return the common tangents of all pairs of circles.

    The line {x: n·x = c} touches circle i at center_i + side_i · radius_i · n. Two circles share
    the line if n · (center_j - center_i) = side_i · radius_i - side_j · radius_j. For given sides,
    this equation has two solutions n, which are mirror images about the line through the centers.
    Reversing n and both sides yields the same line, so it suffices to consider side_i = 1.
    """
    i, j = np.triu_indices(len(radii), k=1)
    between = centers[j] - centers[i]
    distance = np.sqrt((between**2).sum(axis=1))
    circles = []
    contacts = []
    for side in (1.0, -1.0):
        # Equality means that a point lies on a circle, or that two circles touch. The tolerance
        # includes these cases despite rounding errors. Both sides of a point are the same.
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
    """Return the tangents that do not enter any disc."""
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

    Nodes 0 and 1 are the start and the target.
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
    """Return the unblocked arcs between adjacent contact points of `circle`.

    `angles` contains the sorted angles of the contact points. Each arc is returned as the indices
    of its two angles, and the angle between them. A contact point never lies inside another disc,
    so a disc that overlaps the circle covers an interval between two contact points. The arc that
    contains the center of this interval is blocked.
    """
    if len(angles) < 2:
        return []
    gaps = centers - centers[circle]
    overlaps = np.sqrt((gaps**2).sum(axis=1)) < radii + radii[circle]
    overlaps[circle] = False
    overlaps[:2] = False
    midpoints = np.arctan2(gaps[overlaps, 1], gaps[overlaps, 0])
    blocked = np.zeros(len(angles), bool)
    # The index -1 is correct: an angle before the first contact point lies on the last arc.
    blocked[np.searchsorted(angles, midpoints) - 1] = True
    arc_angles = np.diff(angles, append=angles[0] + 2 * np.pi)
    return [
        (arc, (arc + 1) % len(angles), float(arc_angles[arc]))
        for arc in np.flatnonzero(~blocked).tolist()
    ]


def _dijkstra(graph: Graph, source: int, sink: int) -> float:
    """Return the length of the shortest path from `source` to `sink`, or inf if there is none."""
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
