"""Rays that start inside a scene, or up to a million scene sizes away, hit what they are aimed at.

The result must not depend on which rays are cast together, or on what was cast before.
"""

import numpy as np
import pytest

from raybeam import Instance, Mesh, Pattern, RayCaster

PLATE = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]), [[0, 1, 2], [0, 2, 3]]
SIZE = 126.0
FIELDS = ("distance", "triangle", "instance")


def plates(rng, count):
    """Return centers (n, 3) and matrices (n, 3, 4) of plates, each turned about its normal."""
    centers = rng.uniform(-SIZE, SIZE, (count, 3)) * [1, 1, rng.choice([0.3, 1])]
    angles = rng.uniform(0, 2 * np.pi, count)
    matrices = np.zeros((count, 3, 4))
    matrices[:, 0, 0] = matrices[:, 1, 1] = np.cos(angles)
    matrices[:, 1, 0] = np.sin(angles)
    matrices[:, 0, 1] = -np.sin(angles)
    matrices[:, 2, 2] = 1
    matrices[:, :, 3] = centers
    return centers, matrices


def scene(matrices, backend, nested):
    """Return a caster of the plates, as instances or as a single mesh."""
    if nested:
        mesh = Mesh(*PLATE)
        return RayCaster.from_instances([Instance(mesh, m) for m in matrices], backend, threads=1)
    points = np.asarray(PLATE[0])
    vertices = np.einsum("nij,kj->nki", matrices[:, :, :3], points) + matrices[:, None, :, 3]
    faces = np.arange(len(matrices))[:, None, None] * 4 + np.asarray(PLATE[1])
    return RayCaster(vertices.reshape(-1, 3), faces.reshape(-1, 3), backend, threads=1)


def targets_on(rng, centers, count):
    """Return points (n, 3) well inside of plates."""
    offsets = rng.uniform([-0.6, -0.6, 0], [0.6, 0.6, 0], (count, 3))
    return centers[rng.integers(len(centers), size=count)] + offsets


def check_origins(seed, backend, *, nested, count=3_000):
    """Compare hits with NumPy's, and with the targets, in three orders."""
    rng = np.random.default_rng(seed)
    centers, matrices = plates(rng, 300)
    # Most bounds matter within a few sizes of the scene, and most of all beyond its corners; a
    # third of the rays are remote.
    sizes_away = np.where(
        rng.random(count) < 0.7, rng.uniform(0, 4, count), 10 ** rng.uniform(0, 6, count)
    )
    outward = rng.choice([-1.0, 1], (count, 3)) * rng.uniform(0.8, 1, (count, 3))
    outward[::3] = rng.uniform(-1, 1, (len(outward[::3]), 3))
    origins = outward * SIZE * sizes_away[:, None]
    directions = targets_on(rng, centers, count) - origins
    expected = scene(matrices, "numpy", nested).cast(origins, directions)
    aimed = np.linalg.norm(directions, axis=1)
    assert (expected.distance <= aimed * (1 + 1e-9)).all()
    caster = scene(matrices, backend, nested)
    by_distance = np.argsort(sizes_away)
    for order in (np.arange(count), by_distance, rng.permutation(count)):
        hits = caster.cast(origins[order], directions[order])
        for name in FIELDS:
            np.testing.assert_array_equal(
                getattr(hits, name), getattr(expected, name)[order], err_msg=f"{name}, seed {seed}"
            )
        caster.cast([0.0, 0, 5], rng.normal(size=(64, 3)))  # so that the next rays go one by one
    for k in range(20):
        assert caster.cast(origins[k], directions[k]).distance[0] == expected.distance[k]


@pytest.mark.parametrize("nested", [False, True], ids=["mesh", "instances"])
def test_scattered_origins(backend, nested):
    check_origins(0, backend, nested=nested)


@pytest.mark.extended
@pytest.mark.parametrize("nested", [False, True], ids=["mesh", "instances"])
@pytest.mark.parametrize("seed", range(1, 9))
def test_more_scattered_origins(seed, backend, nested):
    check_origins(seed, backend, nested=nested)


@pytest.mark.extended(every=4)
@pytest.mark.parametrize("nested", [False, True], ids=["mesh", "instances"])
@pytest.mark.parametrize("sizes_away", [0.5, 1.2, 1.9, 2.1, 5, 1e3, 1e6])
def test_patterns_from_outside(backend, nested, sizes_away):
    """A sweep of neighboring rays, as from a drone, after rays that are cast one by one."""
    rng = np.random.default_rng(int(10 * sizes_away))
    centers, matrices = plates(rng, 300)
    position = SIZE * sizes_away * np.array([1, 0.97, 0.9])
    directions = targets_on(rng, centers, 2_000) - position
    directions = directions[np.argsort(directions[:, 0] / np.linalg.norm(directions, axis=1))]
    pattern = Pattern(directions)
    expected = scene(matrices, "numpy", nested).scan(pattern, position)
    assert len(expected) == len(directions)
    caster = scene(matrices, backend, nested)
    for _ in range(2):
        hits = caster.scan(pattern, position)
        for name in ("ray", *FIELDS):
            np.testing.assert_array_equal(getattr(hits, name), getattr(expected, name))
        caster.cast([0.0, 0, 5], rng.normal(size=(64, 3)))
