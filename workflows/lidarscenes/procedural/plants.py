"""Generate trees with trunks, branches, twigs, and leaves. Each leaf is a single triangle.

Following Weber and Penn (1995), a stem carries branches, branches carry twigs, and twigs carry
leaves, in the proportions of a species. A triangle is larger than a real leaf, so that a few of
them represent all leaves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.scene.scene_instances import SceneInstance
from lidarsim.scene.scene_mesh import SceneMesh, stack_meshes

SCALES = (0.7, 1.3)  # smallest and largest scale of trees in a scene
MAX_TREES = 100_000  # mesh files are limited to 200,000 nodes
_STEM_SIDES = 7
_BRANCH_SIDES = 4
_TWIG_SIDES = 3
_STEM_STEPS = 8
_BRANCH_STEPS = 3
_GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))


@dataclass(frozen=True)
class Species:
    """The proportions of a tree species.

    Heights within the crown are fractions from its lowest branch to its top.
    """

    name: str
    height_m: float
    trunk_m: float  # radius above the roots
    bare: float  # fraction of the height without branches
    crown: tuple[float, ...]  # branch lengths in meters at equal steps up the crown
    angle_deg: tuple[float, float]  # angles between the vertical and the lowest and highest branch
    rise_deg: float  # upward turn of a branch between its base and its end
    branches: int
    twigs: int  # twigs per branch
    leaves: int  # leaves per twig
    leaf_m: tuple[float, float]  # length and width of a triangle
    hang: float = 0.0  # downward component of twig and leaf directions
    conifer: bool = False


SPECIES = (
    Species(
        "Oak", 12, 0.36, bare=0.2, crown=(4.2, 5.2, 5.0, 3.8, 1.5), angle_deg=(85, 15), rise_deg=25,
        branches=48, twigs=10, leaves=13, leaf_m=(0.3, 0.24),
    ),
    Species(
        "Maple", 9, 0.2, bare=0.26, crown=(2.4, 3.3, 3.2, 2.4, 1.0), angle_deg=(70, 10),
        rise_deg=20, branches=40, twigs=10, leaves=13, leaf_m=(0.26, 0.22),
    ),
    Species(
        "Birch", 11, 0.15, bare=0.22, crown=(2.1, 2.4, 2.1, 1.5, 0.5), angle_deg=(50, 15),
        rise_deg=-20, branches=46, twigs=8, leaves=14, leaf_m=(0.22, 0.15), hang=0.9,
    ),
    Species(
        "Spruce", 15, 0.22, bare=0.13, crown=(3.1, 2.5, 1.8, 1.1, 0.15), angle_deg=(94, 60),
        rise_deg=14, branches=84, twigs=8, leaves=9, leaf_m=(0.36, 0.15), hang=0.35, conifer=True,
    ),
    Species(
        "Pine", 14, 0.24, bare=0.5, crown=(2.3, 3.0, 2.8, 2.2, 1.0), angle_deg=(85, 25),
        rise_deg=18, branches=34, twigs=10, leaves=15, leaf_m=(0.28, 0.14), conifer=True,
    ),
)  # fmt: skip


def tree(species: Species, seed: int = 0, root_m: float = 0.1) -> SceneMesh:
    """Return a tree whose base is at the origin.

    Parameters
    ----------
    species
        One of `SPECIES`, or a user-defined species.
    seed
        Seed of the random generator. The same seed always results in the same tree.
    root_m
        Length of the trunk below the ground in meters. It must be positive, and larger on slopes.

    Examples
    --------
    >>> oak = tree(SPECIES[0])
    >>> oak.name, 5_000 < len(oak.faces) < 20_000
    ('Oak', True)
    """
    rng = np.random.default_rng(seed)
    stem, radii = _stem(species, root_m, rng)
    branches, branch_radii = _branches(species, stem, radii, rng)
    twigs = _twigs(species, branches, rng)
    twig_radii = np.tile([0.25 * branch_radii.mean(), 0.004], (len(twigs), 1))
    parts = [
        _tubes(stem[None], radii[None], _STEM_SIDES),
        _tubes(branches, branch_radii, _BRANCH_SIDES),
        _tubes(twigs, twig_radii, _TWIG_SIDES),
        _leaves(species, twigs, rng),
    ]
    return SceneMesh(species.name, *stack_meshes(parts))


def all_trees(seed: int, root_m: float) -> tuple[SceneMesh, ...]:
    """Return one tree for each of `SPECIES`."""
    return tuple(tree(species, seed, root_m) for species in SPECIES)


def place_instances(
    meshes: Sequence[SceneMesh], kind: Ints, positions: Floats, yaw: Floats, scale: Floats
) -> list[SceneInstance]:
    """Return upright instances of meshes.

    Parameters
    ----------
    meshes
        The meshes.
    kind
        (n,) indices of the meshes.
    positions
        (n, 3) positions in meters.
    yaw
        (n,) rotations about z in radians.
    scale
        (n,) scale factors.
    """
    matrices = np.tile(np.eye(4), (len(kind), 1, 1))
    cos = scale * np.cos(yaw)
    sin = scale * np.sin(yaw)
    matrices[:, 0, 0] = cos
    matrices[:, 0, 1] = -sin
    matrices[:, 1, 0] = sin
    matrices[:, 1, 1] = cos
    matrices[:, 2, 2] = scale
    matrices[:, :3, 3] = positions
    return [SceneInstance(meshes[k], matrix) for k, matrix in zip(kind, matrices, strict=True)]


def _stem(species: Species, root_m: float, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return the points and radii of a stem from root to top, in meters."""
    fraction = np.linspace(0, 1, _STEM_STEPS)
    sway = np.cumsum(rng.normal(0, 0.012 * species.height_m, (_STEM_STEPS, 2)), axis=0)
    sway = (sway - sway[0]) * fraction[:, None]
    above = np.column_stack([sway, 0.97 * fraction * species.height_m])
    radii = species.trunk_m * (1 - fraction) ** 0.8 + 0.01
    radii[0] *= 1.35
    flare = [[above[1, 0] / 10, above[1, 1] / 10, 0.06 * species.height_m]]
    points = np.concatenate([[[0, 0, -root_m]], above[:1], flare, above[1:]])
    return points, np.concatenate([[1.3 * radii[0]], radii[:1], [species.trunk_m], radii[1:]])


def _branches(
    species: Species, stem: Floats, radii: Floats, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Return the points and radii of all branches, in meters."""
    n = species.branches
    fraction, full_length = _branch_shares(species, rng)
    height = species.height_m * (species.bare + (0.97 - species.bare) * fraction)
    foot = np.stack([np.interp(height, stem[:, 2], axis) for axis in stem.T], axis=1)
    azimuth = _GOLDEN_ANGLE * np.arange(n) + rng.normal(0, 0.3, n)
    length = full_length * rng.uniform(0.75, 1.08, n)
    lowest, highest = np.radians(species.angle_deg)
    lean = lowest + (highest - lowest) * fraction + rng.normal(0, 0.12, n)
    points = [foot]
    for step in range(_BRANCH_STEPS):
        tilt = lean - np.radians(species.rise_deg) * step / (_BRANCH_STEPS - 1)
        tilt = tilt + rng.normal(0, 0.1, n)
        direction = azimuth + rng.normal(0, 0.15, n) * step
        ahead = np.stack(
            [np.sin(tilt) * np.cos(direction), np.sin(tilt) * np.sin(direction), np.cos(tilt)],
            axis=1,
        )
        points.append(points[-1] + ahead * (length / _BRANCH_STEPS)[:, None])
    # At its base, a branch is half as thick as the stem, limited in proportion to its length.
    radius = np.minimum(0.5 * np.interp(height, stem[:, 2], radii), 0.006 + 0.022 * length)
    return np.stack(points, axis=1), radius[:, None] * np.linspace(1, 0.25, _BRANCH_STEPS + 1)


def _branch_shares(species: Species, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return the branches' heights as fractions of the crown height, and their lengths.

    Branches are denser where they are long, so that they fill the crown evenly.
    """
    n = species.branches
    steps = np.linspace(0, 1, 50)
    lengths = np.interp(steps, np.linspace(0, 1, len(species.crown)), species.crown)
    below = np.cumsum(lengths**1.5)
    fraction = np.interp((np.arange(n) + rng.uniform(0, 1, n)) / n, below / below[-1], steps)
    return fraction, np.interp(fraction, steps, lengths)


def _twigs(species: Species, branches: Floats, rng: np.random.Generator) -> Floats:
    """Return both ends of each twig on the outer parts of branches. Shape (n, 2, 3)."""
    n = len(branches)
    m = species.twigs
    fraction = np.sort(rng.uniform(0.2, 1, (n, m)), axis=1)
    fraction[:, -1] = 1
    position = fraction * _BRANCH_STEPS
    step = np.minimum(position.astype(np.int64), _BRANCH_STEPS - 1)
    row = np.arange(n)[:, None]
    begin = branches[row, step]
    end = branches[row, step + 1]
    foot = begin + (end - begin) * (position - step)[..., None]
    axis = _unit(_unit(end - begin) + 0.75 * rng.normal(size=(n, m, 3)) - [0, 0, species.hang])
    reach = np.linalg.norm(branches[:, -1] - branches[:, 0], axis=1)[:, None]
    length = np.maximum(0.4, 0.45 * reach * (1.3 - fraction)) * rng.uniform(0.7, 1.2, (n, m))
    return np.stack([foot, foot + axis * length[..., None]], axis=2).reshape(-1, 2, 3)


def _leaves(species: Species, twigs: Floats, rng: np.random.Generator) -> tuple[Floats, Ints]:
    """Return the vertices and faces of leaves around twigs. Leaves do not share vertices."""
    n = len(twigs)
    m = species.leaves
    length, width = species.leaf_m
    axis = twigs[:, 1:] - twigs[:, :1]
    foot = twigs[:, :1] + axis * rng.uniform(0.15, 1.05, (n, m, 1))
    foot = foot + rng.normal(0, 0.4 * length, (n, m, 3))
    ahead = _unit(_unit(axis) + 0.8 * rng.normal(size=(n, m, 3)) - [0, 0, species.hang])
    across = _unit(np.cross(ahead, rng.normal([0, 0, 0.8], 1, (n, m, 3))))
    size = rng.uniform(0.75, 1.25, (n, m, 1))
    tip = foot + ahead * length * size
    side = across * width / 2 * size
    corners = np.stack([foot - side, foot + side, tip], axis=2).reshape(-1, 3)
    return corners, np.arange(len(corners)).reshape(-1, 3)


def _tubes(paths: Floats, radii: Floats, sides: int) -> tuple[Floats, Ints]:
    """Return the vertices and faces of open tubes along the given paths."""
    n, k = radii.shape
    tangents = _unit(np.gradient(paths, axis=1))
    # Use the same reference axis along a tube, so that the tube is not twisted.
    upright = np.abs(tangents[:, :1, 2:]) > 0.8
    first = _unit(np.cross(tangents, np.where(upright, [1.0, 0, 0], [0, 0, 1.0])))
    second = np.cross(tangents, first)
    angle = 2 * np.pi * np.arange(sides)[:, None] / sides
    round_ = np.cos(angle) * first[:, :, None] + np.sin(angle) * second[:, :, None]
    points = paths[:, :, None] + radii[..., None, None] * round_
    ring = np.arange(n * k * sides).reshape(n, k, sides)
    next_in_ring = np.roll(ring, -1, axis=2)
    corners = [
        ring[:, :-1],
        next_in_ring[:, :-1],
        next_in_ring[:, 1:],
        ring[:, :-1],
        next_in_ring[:, 1:],
        ring[:, 1:],
    ]
    return points.reshape(-1, 3), np.stack(corners, axis=-1).reshape(-1, 3)


def _unit(vectors: Floats) -> Floats:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
