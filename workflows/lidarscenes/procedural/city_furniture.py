"""Add detailed trees and cars to a generated city."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Bools, Floats, Ints
from lidarsim.scene.scene_instances import SceneInstance

from .cars import all_cars
from .plants import SCALES, SPECIES, all_trees, place_instances

MAX_CARS = 50_000

# Distance between positions along the edges of a block, inward offset from the edge, and free space
# at corners, in meters.
_TREE_APART_M = 7.0
_TREE_INWARD_M = 1.3
_TREE_CORNER_M = 5.0
_CAR_APART_M = 6.5
_CAR_INWARD_M = -1.3
_CAR_CORNER_M = 8.0
_CAR_SHIFT_M = 0.5  # maximum shift along the street
_CURB_ON_RIGHT = 0.9  # fraction of cars with the curb on their right
_STREET_REACH_M = 3.5  # maximum crown radius at streets, which keeps the center of the road free
# Yards and parks have at most one tree per cell, in its central part.
_YARD_M = 6.0
_YARD_MIDDLE = 0.4
_STREETS_FIRST = 4.0  # weight of positions at streets; the weight in yards and parks is 1
_LAMP_M = 1.5  # minimum distance from a trunk
_ROOT_M = 0.1


def street_trees(
    blocks: Floats, boxes: list[Floats], lamps: list[Floats], z: float, count: int, seed: int
) -> list[SceneInstance]:
    """Place trees along streets, in yards, and in parks. Their crowns do not touch buildings.

    Parameters
    ----------
    blocks
        (b, 2, 2) centers and sizes of the blocks in meters.
    boxes
        For each block, the lower and upper corners (n, 2, 2) of its buildings.
    lamps
        For each block, the positions (n, 2) of its street lamps.
    z
        Height of the ground in meters.
    count
        Number of trees.
    seed
        Seed of the random generator.

    Raises
    ------
    LidarError
        If there is not enough space for the trees.
    """
    rng = np.random.default_rng([seed, count])
    meshes = all_trees(seed, _ROOT_M)
    reach = np.array([np.abs(mesh.vertices[:, :2]).max() * 2**0.5 for mesh in meshes])
    min_room = np.where([species.conifer for species in SPECIES], np.inf, reach) * SCALES[0]
    blocks_with_objects = zip(blocks, boxes, lamps, strict=True)
    sites = [
        _tree_sites(block, box, posts, min_room.min(), rng)
        for block, box, posts in blocks_with_objects
    ]
    xy, room, at_street = (np.concatenate(parts) for parts in zip(*sites, strict=True))
    chosen = _choose(np.where(at_street, _STREETS_FIRST, 1.0), count, "trees", rng)
    fitting = np.where(at_street[chosen, None], min_room, SCALES[0] * reach) <= room[chosen, None]
    kind = (fitting * rng.random(fitting.shape)).argmax(axis=1)
    max_scale = np.minimum(room[chosen] / reach[kind], SCALES[1])
    scale = rng.uniform(SCALES[0], max_scale)
    positions = np.column_stack([xy[chosen], np.full(count, z)])
    return place_instances(meshes, kind, positions, rng.uniform(0, 2 * np.pi, count), scale)


class _TreeSites(NamedTuple):
    """Possible positions of trees in a block."""

    xy: Floats  # (n, 2) meters
    room: Floats  # (n,) distance to the nearest building, or the limit at streets
    at_street: Bools  # (n,)


def _tree_sites(
    block: Floats, boxes: Floats, lamps: Floats, min_room: float, rng: np.random.Generator
) -> _TreeSites:
    """Return those positions in a block that have enough space for the smallest tree.

    `block` (2, 2) contains the center and the size of the block, `boxes` (n, 2, 2) the corners of
    its buildings, and `lamps` (m, 2) the positions of its street lamps.
    """
    middle, size = block
    street, _ = _street_positions(size, _TREE_APART_M, _TREE_INWARD_M, _TREE_CORNER_M)
    yard = _yard_positions(size, rng)
    xy = middle + np.concatenate([street, yard])
    at_street = np.arange(len(xy)) < len(street)
    gaps = np.maximum(boxes[None, :, 0] - xy[:, None], xy[:, None] - boxes[None, :, 1])
    room = gaps.max(axis=2).min(axis=1, initial=np.inf)
    room[at_street] = np.minimum(room[at_street], _STREET_REACH_M)
    lamp_m = np.linalg.norm(lamps[None] - xy[:, None], axis=2).min(axis=1, initial=np.inf)
    fits = (room >= min_room) & (lamp_m >= _LAMP_M)
    return _TreeSites(xy[fits], room[fits], at_street[fits])


def parked_cars(blocks: Floats, count: int, seed: int) -> list[SceneInstance]:
    """Place cars along the curbs of blocks, given each block's center and size.

    Raises
    ------
    LidarError
        If there is not enough space for the cars.
    """
    rng = np.random.default_rng([seed, count])
    positions = []
    directions = []
    for middle, size in blocks:
        xy, yaw = _street_positions(size, _CAR_APART_M, _CAR_INWARD_M, _CAR_CORNER_M)
        positions.append(middle + xy)
        directions.append(yaw)
    xy = np.concatenate(positions)
    direction = np.concatenate(directions)
    chosen = _choose(np.ones(len(xy)), count, "cars", rng)
    direction = direction[chosen]
    ahead = np.column_stack([np.cos(direction), np.sin(direction)])
    xy = xy[chosen] + ahead * rng.uniform(-_CAR_SHIFT_M, _CAR_SHIFT_M, (count, 1))
    yaw = direction + np.pi * (rng.random(count) > _CURB_ON_RIGHT)
    meshes = all_cars()
    kind = rng.integers(len(meshes), size=count)
    return place_instances(
        meshes, kind, np.column_stack([xy, np.zeros(count)]), yaw, np.ones(count)
    )


def _choose(weights: Floats, count: int, plural: str, rng: np.random.Generator) -> Ints:
    """Choose `count` distinct rows at random, with probabilities proportional to the weights.

    Raises LidarError if there are fewer rows.
    """
    if len(weights) < count:
        raise LidarError(
            f"The city has room for {len(weights):,} {plural}, but {count:,} were requested. "
            "Increase the number of triangles, which enlarges the city, or request fewer "
            f"{plural}."
        )
    return rng.choice(len(weights), count, replace=False, p=weights / weights.sum())


def _street_positions(
    size: Floats, spacing: float, inward: float, corner: float
) -> tuple[Floats, Floats]:
    """Return positions along the edges of a block centered at the origin, and a yaw for each.

    A car that faces the direction of its yaw has the block on its right.
    """
    positions = []
    yaws = []
    for quarter in range(4):
        length = size[quarter % 2]
        distance = size[1 - quarter % 2] / 2 - inward
        n = int((length - 2 * corner) / spacing) + 1
        shift = (np.arange(n) - (n - 1) / 2) * spacing
        cos = np.cos(quarter * np.pi / 2)
        sin = np.sin(quarter * np.pi / 2)
        # Rotate the positions along the lower edge of the block.
        positions.append(
            np.column_stack([cos * shift + sin * distance, sin * shift - cos * distance])
        )
        yaws.append(np.full(n, quarter * np.pi / 2 + np.pi))
    return np.concatenate(positions), np.concatenate(yaws)


def _yard_positions(size: Floats, rng: np.random.Generator) -> Floats:
    """Return positions behind the street trees of a block centered at the origin."""
    inner = size - 2 * (_TREE_INWARD_M + _YARD_M / 2)
    n = (inner / _YARD_M).astype(np.int64)
    cells = np.stack(np.meshgrid(np.arange(n[0]), np.arange(n[1]), indexing="ij"), axis=-1)
    inside = 0.5 + _YARD_MIDDLE * rng.uniform(-0.5, 0.5, (n[0] * n[1], 2))
    return np.asarray(((cells.reshape(-1, 2) + inside) / n - 0.5) * inner)
