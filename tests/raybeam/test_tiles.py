"""Tiles of neighboring rays are cast together; which rays share one has no effect on any bit."""

import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest
from benchmarks.gpu_scenes import grid_faces

from raybeam import Instance, Mesh, Pattern, RayCaster, SubRays, available_backends

if reason := available_backends()["tiles"]:
    pytest.skip(f"tiles: {reason}", allow_module_level=True)

RINGS = 24
FIRINGS = 600


def lidar():
    """Directions of a turn, firing by firing (n, 3)."""
    azimuth = 2 * np.pi * np.arange(FIRINGS)[:, None] / FIRINGS
    elevation = np.radians(np.linspace(-40, 30, RINGS))
    x = np.cos(elevation) * np.cos(azimuth)
    y = np.cos(elevation) * np.sin(azimuth)
    return np.stack([x, y, np.broadcast_to(np.sin(elevation), x.shape)], axis=-1).reshape(-1, 3)


def soup(rng, count=4_000):
    """Triangles that pierce each other; some lie in one plane, and some of these are the same."""
    corners = rng.uniform(-20, 20, (count, 1, 3)) + rng.normal(size=(count, 3, 3))
    flat = rng.uniform(-20, 20, (count // 2, 3, 3))
    flat[..., 2] = -3
    whole = np.concatenate([corners, flat, flat[:100], flat[:50]])
    return whole.reshape(-1, 3), np.arange(3 * len(whole)).reshape(-1, 3)


@pytest.fixture(params=["soup", "vase", "terrain box"])
def mesh(request, shapes):
    return soup(np.random.default_rng(4)) if request.param == "soup" else shapes[request.param]()


def found(caster, directions, order, **options):
    """Distance and triangle of each ray, cast in some order from near the middle."""
    returns = caster.scan(Pattern(directions[order]), [0.05, 0.1, 0.4], **options)
    distance = np.full(len(directions), np.inf)
    triangle = np.full(len(directions), -1)
    distance[order[returns.ray]] = returns.distance
    triangle[order[returns.ray]] = returns.triangle
    return distance, triangle


@pytest.mark.extended
def test_neighbors_have_no_effect(mesh):
    directions = lidar()
    rng = np.random.default_rng(2)
    caster = RayCaster(*mesh, "tiles", threads=1)
    straight = np.arange(len(directions))
    want = found(caster, directions, straight)
    assert np.isfinite(want[0]).mean() > 0.3
    rings = straight.reshape(-1, RINGS).T.reshape(-1)
    for order in (rings, straight[::-1], rng.permutation(len(directions))):
        np.testing.assert_array_equal(found(caster, directions, order), want)
    few = np.sort(rng.choice(straight, 2_000, replace=False))
    got = caster.cast([0.05, 0.1, 0.4], directions[few])
    np.testing.assert_array_equal(got.distance, want[0][few])
    np.testing.assert_array_equal(got.triangle, want[1][few])


@pytest.mark.extended
@pytest.mark.parametrize("limits", [(0.0, np.inf), (0.7, 1.5)])
def test_tiles_have_the_bits_of_numpy(mesh, limits):
    directions = lidar()
    straight = np.arange(len(directions))
    given = {"t_min": limits[0], "t_max": limits[1]}
    (t, triangle), (t_2, triangle_2) = (
        found(RayCaster(*mesh, name), directions, straight, **given) for name in ("tiles", "numpy")
    )
    np.testing.assert_array_equal(t, t_2)
    np.testing.assert_array_equal(triangle, triangle_2)


def sheet(cells):
    """Squares from -1 to 1, of two triangles each."""
    line = np.linspace(-1, 1, cells + 1)
    points = np.stack(np.meshgrid(line, line, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    return points, grid_faces(cells + 1, cells + 1)


def ties(backend):
    """Hash of the hits of rays that meet several triangles at one distance, many at edges."""
    rng = np.random.default_rng(8)
    found = hashlib.sha256()
    points, faces = soup(rng)
    thrice = np.concatenate([faces, np.roll(faces, 1, axis=1), faces[:, ::-1]])
    (fine, small), (coarse, large) = sheet(20), sheet(7)
    both = np.concatenate([coarse, fine]), np.concatenate([large, small + len(coarse)])[::-1]
    places = [np.diag([1.0, k, k, 1]) for k in (1, -1)]
    stack = [Instance(Mesh(*m), p) for m in ((fine, small), both) for p in places]
    down = np.broadcast_to([0, 0, -1.0], fine.shape)
    around = rng.normal(size=(4_000, 3))
    for caster, start, directions in (
        (RayCaster(points, rng.permutation(thrice), backend), [0.05, 0.1, 0.4], around),
        (RayCaster(*both, backend), np.add(fine, [0, 0, 3]), down),
        (RayCaster.from_instances(stack, backend), np.add(fine, [0, 0, 3]), down),
        (RayCaster.from_instances(stack, backend), np.add(fine / 2, [0.025, 0, 3]), down),
    ):
        hits = caster.cast(start, directions)
        for column in (hits.distance, hits.triangle, hits.instance):
            found.update(column.tobytes())
    # Neighbors in tiles, in a plain scene and among instances.
    for caster in (
        RayCaster(points, rng.permutation(thrice), backend),
        RayCaster.from_instances(stack, backend),
    ):
        scans = {}  # {window: returns}
        for window in [(0, RINGS * FIRINGS)] * 4 + [(7, 5_000)]:
            if backend != "numpy" or window not in scans:
                scans[window] = caster.scan(Pattern(lidar()), [0.05, 0.1, 0.4], window=window)
            returns = scans[window]
            for column in (returns.ray, returns.distance, returns.triangle, returns.instance):
                found.update(column.tobytes())
    return found.hexdigest()


@pytest.mark.extended
def test_the_lowest_of_equals_wins():
    assert ties("tiles") == ties("numpy")


def run_python(code, *arguments, **environment):
    given = {**os.environ, **environment}
    subprocess.run([sys.executable, "-c", code, *arguments], check=True, env=given, timeout=300)


@pytest.mark.extended
def test_forked_processes_cast_too():
    """Workers are forked from a process that may have cast: threads do not survive that."""
    run_python(
        "import os, sys; from raybeam import RayCaster; "
        "mesh = [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]; "
        "cast = lambda: RayCaster(*mesh, 'tiles', threads=2).cast([0.2, 0.2, 5], [0, 0, -1]); "
        "assert cast().distance == 5; child = os.fork(); "
        "assert cast().distance == 5; child or os._exit(0); "
        "sys.exit(os.waitpid(child, 0)[1])"
    )


@pytest.mark.extended
def test_which_rays_go_together_changes_nothing(mesh):
    """A window may begin and end within a firing, and so within tiles."""
    caster = RayCaster(*mesh, backend="tiles", threads=1)
    given = Pattern(lidar())
    where = [0.05, 0.1, 0.4]
    expected = RayCaster(*mesh, backend="numpy").scan(given, where)
    for window in [(0, len(given))] * 5 + [(k, k + 700) for k in range(0, 13_000, 611)]:
        returns = caster.scan(Pattern(lidar()), where, window=window)
        begin, end = np.searchsorted(expected.ray, window)
        assert np.array_equal(returns.ray + window[0], expected.ray[begin:end])
        assert np.array_equal(returns.distance, expected.distance[begin:end])
        assert np.array_equal(returns.triangle, expected.triangle[begin:end])


def test_what_few_rays_hit_beside_many_that_miss():
    """Tiles at the end of a ring, or of a window, are not full."""
    card = np.array([[5, -2, -2], [5, 2, -2], [5, 2, 2], [5, -2, 2.0]]), [[0, 1, 2], [0, 2, 3]]
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(360)), np.radians(np.linspace(-30, 30, 31))
    )
    flat = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)
    given = Pattern(np.stack([*flat, np.sin(elevation)], axis=-1).swapaxes(0, 1).reshape(-1, 3))
    casters = [RayCaster(*card, backend=backend, threads=1) for backend in ("numpy", "tiles")]
    for start in range(0, 600, 50):  # ahead, the card; at the end, the other half of it
        window = (start, len(given) - 7)
        expected, returns = (c.scan(given, [0, 0, 0], window=window) for c in casters)
        assert np.array_equal(returns.ray, expected.ray) and len(returns) > 200
        assert np.array_equal(returns.distance, expected.distance)


def aimed(rng, mesh, position, count):
    """Directions at points in triangles of a mesh: a third at corners, a third at edges."""
    points, faces = mesh
    weights = rng.dirichlet([1, 1, 1], count)
    weights[::3] = np.eye(3)[rng.integers(3, size=len(weights[::3]))]
    weights[1::3, 0] = 0
    weights /= weights.sum(axis=1, keepdims=True)
    corners = np.asarray(points)[np.asarray(faces)[rng.integers(len(faces), size=count)]]
    directions = (corners * weights[..., None]).sum(axis=1) - position
    return directions[np.argsort(directions[:, 0])]


def squares(rng, cells):
    """Uneven squares on a grid, whose corners are round numbers, far from zero or not."""
    x, y = np.meshgrid(np.arange(cells + 1.0), np.arange(cells + 1.0), indexing="ij")
    height = np.round(rng.normal(size=x.shape), 1) * rng.choice([0, 0.1, 1])
    points = np.stack([x, y, height], axis=-1).reshape(-1, 3) - cells / 2
    return points + rng.choice([0, 5e5, 4e6]) * rng.choice([0, 1], 3), grid_faces(
        cells + 1, cells + 1
    )


def check_random_scene(seed):
    """Compare both backends, bit by bit, in a scene and from a place that a seed decides."""
    rng = np.random.default_rng(seed)
    mesh = squares(rng, int(rng.choice([1, 4, 30]))) if rng.random() < 0.5 else soup(rng, 300)
    middle = mesh[0].mean(axis=0)
    size = np.ptp(mesh[0], axis=0).max()
    position = middle + rng.normal(size=3) * size * rng.choice([0.1, 2, 100, 1e6])
    directions = aimed(rng, mesh, position, 1_500)
    if rng.random() < 0.2:
        directions[:, rng.integers(3)] *= 10.0 ** -rng.integers(10, 320)
    poses = {}
    if rng.random() < 0.4:
        position = position + rng.normal(size=3) * np.linspace(0, 1, 150)[:, None]
        poses = {"rays_per_pose": 10}
    given = Pattern(directions, step=int(rng.choice([1, 10])))
    expected, returns = (
        RayCaster(*mesh, backend=name, threads=1).scan(given, position, **poses)
        for name in ("numpy", "tiles")
    )
    for column in ("ray", "distance", "triangle"):
        got = getattr(returns, column)
        np.testing.assert_array_equal(got, getattr(expected, column), err_msg=f"seed {seed}")


def test_random_scenes_have_the_bits_of_numpy():
    """Margins cover the rounding of float32: with a margin of zero every tenth scene differs."""
    for seed in range(25):
        check_random_scene(seed)


@pytest.mark.extended
def test_more_random_scenes_have_the_bits_of_numpy():
    for seed in range(25, 250):
        check_random_scene(seed)


@pytest.mark.parametrize("subrays", [1, 7, 8, 19])
def test_sub_rays_in_tiles_have_the_bits_of_numpy(shapes, subrays):
    """Windows begin within a firing and within a beam; poses change within them."""
    rng = np.random.default_rng(subrays)
    angles = rng.normal(0, 1e-3, (subrays, 2))
    given = Pattern(lidar(), step=RINGS).with_sub_rays(SubRays(angles))
    casters = [RayCaster(*shapes["vase"](), backend=name) for name in ("numpy", "tiles")]
    track = np.linspace([0.05, 0.1, 0.4], [0.1, 0.1, 0.3], 200)
    for window in [(0, 30_000), (7, 5_000), (RINGS * subrays * 3 + 1, 20_000)]:
        options = {"window": window, "rays_per_pose": 300}
        expected, returns = (caster.scan(given, track, **options) for caster in casters)
        np.testing.assert_array_equal(returns.ray, expected.ray)
        np.testing.assert_array_equal(returns.distance, expected.distance)
        np.testing.assert_array_equal(returns.triangle, expected.triangle)
