"""Rays whose directions have components of any size: none is lost, in whatever packet."""

import os
import subprocess
import sys

import numpy as np
import pytest

from raybeam import Instance, Mesh, MovingBodies, Opacity, Pattern, RayCaster, SubRays, pattern_rays
from raybeam.moving import nearest_body_hits
from raybeam.scan import check_scan

FIELDS = ("distance", "triangle", "u", "v", "instance")
SIZES = (5e-324, 1e-310, 1e-45, 1e-38, 1e-30, 3.7e-20, 8e-19, 2e-18, 6.1e-17, 1e-15, 1e-12, 0.0)
ORIGIN = [0.05, 0.1, 0.2]


def packets(count, seed=0):
    """Directions (count * 16, 3): in each packet, rays with tiny components on one or two axes.

    Further rays of the packet have components of the same sign there, and of about 1e-3.
    """
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 1, 3)) + rng.normal(0, 1e-3, (count, 16, 3))
    for packet in directions:
        tiny = rng.choice(16, rng.integers(1, 12), replace=False)
        size = rng.choice([-1.0, 1.0]) * rng.choice(SIZES)
        for axis in rng.permutation(3)[: rng.integers(1, 3)]:
            packet[:, axis] = rng.choice([-1.0, 1.0]) * rng.uniform(1e-4, 1e-3, 16)
            packet[tiny, axis] = size if rng.random() < 0.6 else -rng.choice(SIZES, len(tiny))
    return directions.reshape(-1, 3)


def turned(*degrees):
    """Matrix that turns about x, then y, then z: at right angles it has elements of 6e-17."""
    matrix = np.eye(3)
    for axis, angle in enumerate(np.radians(degrees)):
        turn = np.eye(3)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn[[i, j], [i, j]] = np.cos(angle)
        turn[[j, i], [i, j]] = np.sin(angle), -np.sin(angle)
        matrix = turn @ matrix
    return matrix


# Transforms of a single instance, by name.
TRANSFORMS = {
    "right angles": turned(90, 0, 270),
    "half a right angle": turned(45, 0, 90),
    "two angles": turned(0, 45, 135),
    "uneven": turned(0, 0, 45) @ np.diag([1e-3, 10.0, 1e3]),
    "a needle": turned(90, 0, 0) @ np.diag([1e-7, 1.0, 1e6]),
    "mirrored": turned(180, 90, 0) @ np.diag([1.0, -1, 1]),
    "nearly unturned": np.array([[1, 1e-17, -1e-9], [-3e-19, 1, 6e-17], [1e-40, 1e-18, 1]]),
}  # fmt: skip


def instance(mesh, name):
    return Instance(mesh, np.column_stack([TRANSFORMS[name], ORIGIN]))


def check(backend, instances, origins, directions, *, all_hit=True):
    """Check that a backend has the hits of NumPy, which has a hit of each ray if `all_hit`."""
    want = RayCaster.from_instances(instances, "numpy").cast(origins, directions)
    assert want.hit.all() if all_hit else 0.2 < want.hit.mean() < 0.9
    got = RayCaster.from_instances(instances, backend, threads=1).cast(origins, directions)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(got, name), getattr(want, name), err_msg=name)


@pytest.mark.extended(every=3)
@pytest.mark.parametrize("origin", [ORIGIN, [-5e-324, 1e-18, -0.0]])
def test_rays_at_a_mesh(backend, shapes, origin):
    check(backend, [Instance(Mesh(*shapes["sphere"]()))], origin, packets(60))


@pytest.mark.extended(keep=("tiles*",))
def test_rays_that_start_at_many_points(backend, shapes):
    directions = packets(60)
    rng = np.random.default_rng(1)
    origins = rng.uniform(-0.3, 0.3, directions.shape)
    origins[::3, 0] = rng.choice(SIZES, len(origins[::3]))
    check(backend, [Instance(Mesh(*shapes["sphere"]()))], origins, directions)


@pytest.mark.extended(keep=("tiles*",))
def test_rays_that_start_outside(backend, shapes):
    directions = packets(60) * 0.05
    directions[:, 0] = -1
    mesh = Mesh(*shapes["sphere"]())
    check(backend, [Instance(mesh)], [30.0, 0.1, -0.2], directions, all_hit=False)


@pytest.mark.extended
@pytest.mark.parametrize("name", TRANSFORMS)
def test_rays_at_an_instance(backend, shapes, name):
    check(backend, [instance(Mesh(*shapes["sphere"]()), name)], ORIGIN, packets(60))


@pytest.mark.extended(keep=("tiles*",))
def test_rays_at_many_instances(backend, shapes):
    """Also among instances that are turned by any angles, and after these have moved."""
    rng = np.random.default_rng(2)
    sphere = Mesh(*shapes["sphere"]())
    turns = np.linalg.qr(rng.normal(size=(20, 3, 3)))[0]
    places = np.concatenate([turns, rng.uniform(-5, 5, (20, 3, 1))], axis=2)
    shell = Mesh(shapes["cube"]()[0] * 9, shapes["cube"]()[1])
    instances = [instance(shell, "right angles"), *(Instance(sphere, place) for place in places)]
    check(backend, instances, ORIGIN, packets(60))
    casters = [RayCaster.from_instances(instances, each, threads=1) for each in ("numpy", backend)]
    hits = []
    for caster in casters:
        caster.set_transforms(0, instance(shell, "two angles").transform)
        hits.append(caster.cast(ORIGIN, packets(60)))
    assert hits[0].hit.all() and np.array_equal(hits[1].distance, hits[0].distance)


@pytest.mark.extended(keep=("tiles*",))
@pytest.mark.parametrize("nested", [False, True])
def test_rays_at_a_mask(backend, shapes, nested):
    vertices, faces = shapes["sphere"]()
    uv = np.random.default_rng(3).random((len(faces), 3, 2))
    mesh = Mesh(vertices, faces, Opacity(np.array([[True, False], [False, True]]), uv))
    check(
        backend,
        [instance(mesh, "right angles") if nested else Instance(mesh)],
        ORIGIN,
        packets(60),
        all_hit=False,
    )


@pytest.mark.extended(keep=("tiles*",))
def test_rays_at_moving_bodies(backend, shapes):
    """Poses turn by right angles, so directions in the axes of the bodies are tiny, too."""
    directions = packets(60)
    turns = np.array([turned(0, 0, 0), turned(90, 0, 90), turned(0, 180, 0)])
    sizes = np.array([3.0, 5.0, 8.0])

    def poses(body, times):
        assert np.isfinite(times).all()
        places = np.tile(ORIGIN, (len(body), 1))
        return np.concatenate([places.T, turns[body].transpose(1, 2, 0).reshape(9, -1)])

    found = []
    for name in ("numpy", backend):
        meshes = [Mesh(shapes["sphere"]()[0] * size, shapes["sphere"]()[1]) for size in sizes]
        shapes_of = tuple(RayCaster.from_instances([Instance(m)], name, threads=1) for m in meshes)
        boxes = sizes[:, None, None] * np.array([[-1.0] * 3, [1.0] * 3])
        presence = np.array([[0.0, 0.3], [0.0, 0.6], [0.0, 1.0]])
        moving = MovingBodies(shapes_of, boxes, np.arange(3), presence, poses)
        times = np.linspace(0, 1, len(directions))
        scan = check_scan(Pattern(directions), ORIGIN)
        found.append(nearest_body_hits(moving, scan, lambda ray, times=times: times[ray]))
    assert set(found[0].body.tolist()) == {0, 1, 2}  # each ray hits a body
    for name in ("body", "distance", "triangle"):
        np.testing.assert_array_equal(getattr(found[1], name), getattr(found[0], name))


@pytest.mark.extended
@pytest.mark.parametrize("count", [1, 2, 5, 16, 19])
def test_few_rays(backend, shapes, count):
    directions = packets(2, 4)[:count]
    check(backend, [Instance(Mesh(*shapes["sphere"]()))], ORIGIN, directions)


@pytest.mark.extended(keep=("tiles*",))
def test_sub_rays(backend, shapes):
    """Six sub-rays around beams on a regular grid, of which a ring is level."""
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(0, 360, 0.5)), np.radians([-1.0, 0.0, 1.0]), indexing="ij"
    )
    flat = np.cos(elevation)
    beams = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
    around = np.radians(60 * np.arange(6))
    angles = 1e-3 * np.stack([np.cos(around), np.sin(around)], axis=-1)
    pattern = Pattern(beams.reshape(-1, 3)).with_sub_rays(
        SubRays(np.concatenate([[[0, 0]], angles]))
    )
    _, directions = pattern_rays(pattern, np.arange(len(pattern)), ORIGIN)
    assert ((directions > -1e-18) & (directions < 0)).any()
    want, got = (
        RayCaster(*shapes["sphere"](), name, threads=1).scan(pattern, ORIGIN)
        for name in ("numpy", backend)
    )
    assert len(want) == len(pattern)
    np.testing.assert_array_equal(got.ray, want.ray)
    np.testing.assert_array_equal(got.distance, want.distance)


def check_instruction_set():
    """Check meshes and instances, in a process with other vector instructions."""
    ring = np.radians(np.arange(0, 360, 30))
    points = np.array([[0, 0, 1], *([np.cos(a), np.sin(a), 0] for a in ring), [0, 0, -1]])
    side = np.stack([np.arange(1, 13), np.roll(np.arange(1, 13), -1)], axis=1)
    caps = [np.column_stack([side, np.full(12, apex)]) for apex in (0, 13)]
    mesh = Mesh(points, np.concatenate(caps))
    check("tiles", [Instance(mesh)], ORIGIN, packets(60))
    for name in TRANSFORMS:
        check("tiles", [instance(mesh, name)], ORIGIN, packets(60))


@pytest.mark.slow
@pytest.mark.parametrize("features", ["", "+sse4.2,+avx"])
def test_vectors_of_every_width(tmp_path, features):
    """Without fused multiply-adds: margins cover what those leave out."""
    code = "from tests.raybeam.test_tiny_components import check_instruction_set as check; check()"
    environment = {
        **os.environ,
        "NUMBA_CPU_NAME": "generic",
        "NUMBA_CPU_FEATURES": features,
        "NUMBA_CACHE_DIR": str(tmp_path),
    }
    subprocess.run([sys.executable, "-c", code], check=True, env=environment, timeout=300)
