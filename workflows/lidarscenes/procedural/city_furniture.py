"""Detailed trees and cars of a generated city: where they stand."""

from __future__ import annotations

import numpy as np

from lidarsim.base.arrays import Floats, Ints
from lidarsim.base.errors import LidarError
from lidarsim.scene.scene_instances import SceneInstance

from .cars import all_cars
from .plants import SCALES, SPECIES, all_trees, placed

MOST_CARS = 50_000

# Along the edge of a block: metres between places, from the edge inwards, and free at the corners.
_TREE_APART_M = 7.0
_TREE_INWARDS_M = 1.3
_TREE_CORNER_M = 5.0
_CAR_APART_M = 6.5
_CAR_INWARDS_M = -1.3
_CAR_CORNER_M = 8.0
_CAR_SHIFT_M = 0.5  # at most, either way
_RIGHT_WAY = 0.9  # share of cars with the kerb at their right
_STREET_REACH_M = 3.5  # crowns at streets leave the middle of the carriageway free
# one tree at most in the middle part of a cell
_YARD_M = 6.0
_YARD_MIDDLE = 0.4
_STREETS_FIRST = 4.0  # how much rather a place at a street is taken
_LAMP_M = 1.5  # from a trunk
_ROOT_M = 0.1


def street_trees(
    blocks: Floats, boxes: list[Floats], lamps: list[Floats], z: float, count: int, seed: int
) -> list[SceneInstance]:
    """Place trees along streets, in yards and parks, whose crowns touch no building.

    Parameters
    ----------
    blocks
        (b, 2, 2): middles and sizes, metres.
    boxes, lamps
        Of each block: lowest and highest corners of its buildings, (n, 2, 2); its lamps, (n, 2).
    z
        Height of the ground there.

    Raises
    ------
    LidarError
        If they do not fit.
    """
    rng = np.random.default_rng([seed, count])
    meshes = all_trees(seed, _ROOT_M)
    reach = np.array([np.abs(mesh.vertices[:, :2]).max() * 2**0.5 for mesh in meshes])
    least = np.where([species.conifer for species in SPECIES], np.inf, reach) * SCALES[0]
    places = []
    rooms = []
    streets = []
    for (middle, size), box, posts in zip(blocks, boxes, lamps, strict=True):
        street, _ = _along(size, _TREE_APART_M, _TREE_INWARDS_M, _TREE_CORNER_M)
        yard = _yard(size, rng)
        xy = middle + np.concatenate([street, yard])
        at_street = np.arange(len(xy)) < len(street)
        gaps = np.maximum(box[None, :, 0] - xy[:, None], xy[:, None] - box[None, :, 1])
        room = gaps.max(axis=2).min(axis=1, initial=np.inf)
        room[at_street] = np.minimum(room[at_street], _STREET_REACH_M)
        post = np.linalg.norm(posts[None] - xy[:, None], axis=2).min(axis=1, initial=np.inf)
        fits = (room >= least.min()) & (post >= _LAMP_M)
        places.append(xy[fits])
        rooms.append(room[fits])
        streets.append(at_street[fits])
    xy, room, at_street = (np.concatenate(parts) for parts in (places, rooms, streets))
    chosen = _choose(np.where(at_street, _STREETS_FIRST, 1.0), count, "trees", rng)
    fitting = np.where(at_street[chosen, None], least, SCALES[0] * reach) <= room[chosen, None]
    kind = (fitting * rng.random(fitting.shape)).argmax(axis=1)
    most = np.minimum(room[chosen] / reach[kind], SCALES[1])
    scale = rng.uniform(SCALES[0], most)
    at = np.column_stack([xy[chosen], np.full(count, z)])
    return placed(meshes, kind, at, rng.uniform(0, 2 * np.pi, count), scale)


def parked_cars(blocks: Floats, count: int, seed: int) -> list[SceneInstance]:
    """Place cars at the kerbs of blocks (b, 2, 2), middles and sizes, along the streets.

    Raises
    ------
    LidarError
        If they do not fit.
    """
    rng = np.random.default_rng([seed, count])
    places = []
    ways = []
    for middle, size in blocks:
        xy, yaw = _along(size, _CAR_APART_M, _CAR_INWARDS_M, _CAR_CORNER_M)
        places.append(middle + xy)
        ways.append(yaw)
    xy = np.concatenate(places)
    way = np.concatenate(ways)
    chosen = _choose(np.ones(len(xy)), count, "cars", rng)
    way = way[chosen]
    ahead = np.column_stack([np.cos(way), np.sin(way)])
    xy = xy[chosen] + ahead * rng.uniform(-_CAR_SHIFT_M, _CAR_SHIFT_M, (count, 1))
    yaw = way + np.pi * (rng.random(count) > _RIGHT_WAY)
    meshes = all_cars()
    kind = rng.integers(len(meshes), size=count)
    return placed(meshes, kind, np.column_stack([xy, np.zeros(count)]), yaw, np.ones(count))


def _choose(weights: Floats, count: int, what: str, rng: np.random.Generator) -> Ints:
    """Choose places by weights (n,): (count,)."""
    if len(weights) < count:
        raise LidarError(
            f"The city has room for {len(weights):,} {what}, not {count:,}: give it more "
            f"triangles, which make it larger, or take fewer {what}."
        )
    return rng.choice(len(weights), count, replace=False, p=weights / weights.sum())


def _along(size: Floats, apart: float, inwards: float, corner: float) -> tuple[Floats, Floats]:
    """Places (n, 2) along the edges of a block around zero, and yaw (n,) with it at the right."""
    places = []
    yaws = []
    for turn in range(4):
        length = size[turn % 2]
        deep = size[1 - turn % 2] / 2 - inwards
        n = int((length - 2 * corner) / apart) + 1
        shift = (np.arange(n) - (n - 1) / 2) * apart
        cos = np.cos(turn * np.pi / 2)
        sin = np.sin(turn * np.pi / 2)
        # The edge at the block's lower side, turned.
        places.append(np.column_stack([cos * shift + sin * deep, sin * shift - cos * deep]))
        yaws.append(np.full(n, turn * np.pi / 2 + np.pi))
    return np.concatenate(places), np.concatenate(yaws)


def _yard(size: Floats, rng: np.random.Generator) -> Floats:
    """Places (n, 2) spread over a block around zero, behind those at its streets."""
    inner = size - 2 * (_TREE_INWARDS_M + _YARD_M / 2)
    n = (inner / _YARD_M).astype(np.int64)
    cells = np.stack(np.meshgrid(np.arange(n[0]), np.arange(n[1]), indexing="ij"), axis=-1)
    inside = 0.5 + _YARD_MIDDLE * rng.uniform(-0.5, 0.5, (n[0] * n[1], 2))
    return np.asarray(((cells.reshape(-1, 2) + inside) / n - 0.5) * inner)
