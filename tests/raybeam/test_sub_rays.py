"""Sub-rays are made while they are cast: all backends cast those that `pattern_rays` returns."""

import numpy as np
import pytest

from raybeam import MovingBodies, Pattern, PoseMotion, RayCaster, SubRays, pattern_rays
from raybeam.moving import nearest_body_hits
from raybeam.pattern_rays import compute_rays_numpy
from raybeam.poses import check_poses
from raybeam.scan import check_scan

RINGS = 7
FIRINGS = 45


def beams():
    """Directions firing by firing (n, 3), one of them straight up."""
    turn = 2 * np.pi * np.arange(FIRINGS) / FIRINGS
    steps = np.linspace(-60, 90, RINGS)
    azimuth, elevation = np.meshgrid(turn, np.radians(steps), indexing="ij")
    x = np.cos(elevation) * np.cos(azimuth)
    y = np.cos(elevation) * np.sin(azimuth)
    return np.stack([x, y, np.sin(elevation)], axis=-1).reshape(-1, 3)


def pattern(rng, count, kind):
    angles = rng.normal(scale=0.003, size=(count, 2))
    starts = rng.normal(scale=0.01, size=(count, 2)) if "starts" in kind else None
    axis = np.array([0.0, 0.0, 1.0]) if "axis" in kind else None
    offsets = rng.normal(scale=0.001, size=(len(beams()), 2)) if "offsets" in kind else None
    origins = rng.normal(scale=0.1, size=beams().shape) if "origins" in kind else None
    return Pattern(beams(), origins, SubRays(angles, starts, axis), offsets)


def poses(rng, kind, rays):
    turns = np.linalg.qr(rng.normal(size=(rays // 49 + 1, 3, 3)))[0]
    if kind == "stands":
        return {"positions": [0.1, 0.2, 0.3]}
    if kind == "far away":
        return {"positions": [300.0, 0.2, 0.3], "rotations": turns[0]}
    many = {"positions": rng.normal(scale=0.1, size=(len(turns), 3)), "rotations": turns}
    # It turns so slowly that its directions remain unit vectors, which `cast` leaves as they are.
    velocities, rates = rng.normal(size=(2, len(turns), 3))
    motion = PoseMotion(rng.uniform(0, 1e-3, 49), velocities, 1e-9 * rates)
    return {**many, "rays_per_pose": 49, "motion": motion if kind == "moves" else None}


@pytest.mark.extended
@pytest.mark.slow(every=5)
@pytest.mark.parametrize("place", ["stands", "turns", "moves", "far away"])
@pytest.mark.parametrize("kind", ["", "axis starts offsets", "starts origins", "offsets"])
def test_a_scan_has_the_bits_of_rays_made_one_by_one(backend, shapes, place, kind):
    rng = np.random.default_rng(7)
    caster = RayCaster(*shapes["vase"](), backend=backend, threads=1)
    for count in (1, 7, 19):
        given = pattern(rng, count, kind)
        where = poses(rng, place, len(given))
        start = 5
        stop = len(given) - 3
        returns = caster.scan(given, **where, window=(start, stop))
        ray = np.arange(stop - start)
        hits = caster.cast(*pattern_rays(given, ray, **where, start=start))
        assert np.array_equal(returns.ray, np.flatnonzero(hits.hit))
        assert np.array_equal(returns.distance, hits.distance[hits.hit])
        assert np.array_equal(returns.triangle, hits.triangle[hits.hit])


@pytest.mark.slow(every=3)
@pytest.mark.parametrize("place", ["stands", "turns", "moves", "far away"])
@pytest.mark.parametrize(
    ("kind", "count"),
    [("none", 1), ("origins", 1), ("", 7), ("axis starts offsets", 7), ("starts origins", 7)],
)
def test_loops_make_the_rays_of_numpy(place, kind, count):
    check_rays_of_loops(place, kind, count)


@pytest.mark.parametrize(
    ("place", "kind"),
    [("stands", "starts"), ("turns", "axis starts"), ("moves", "axis starts offsets")],
)
def test_loops_make_the_lone_sub_rays_of_numpy(place, kind):
    check_rays_of_loops(place, kind, 1)


def check_rays_of_loops(place, kind, count):
    rng = np.random.default_rng(9)
    given = pattern(rng, count, kind)
    if kind in ("none", "origins"):
        given = Pattern(given.directions[:3], None if kind == "none" else given.origins[:3])
    where = {"rotations": None, "rays_per_pose": None, **poses(rng, place, 2_000)}
    ray = rng.permutation(2_000)[:1_100]
    made = pattern_rays(given, ray, **where, start=4)
    asked = where["positions"], where["rotations"], where["rays_per_pose"], 2_000
    plain = compute_rays_numpy(given, 4, ray, check_poses(*asked, where.get("motion")))
    for one, other in zip(made, plain, strict=True):
        assert np.array_equal(one, other)


def test_angles_and_starts_of_sub_rays_are_those_given():
    angles = np.array([[0.0, 0.0], [0.02, 0.0], [0.0, -0.01]])
    starts = np.array([[0, 0], [0.3, 0], [0, 0.2]])
    axis = np.array([0.0, 0.0, 1.0])
    given = Pattern([[0.0, 5.0, 0.0]], [1.0, 2.0, 3.0], SubRays(angles, starts, axis))
    origins, directions = pattern_rays(given, [0, 1, 2], [10.0, 0.0, 0.0])
    assert (len(given), repr(given)) == (3, "Pattern(1 directions, origins, 3 sub-rays each)")
    # Across is counter-clockwise about z, up is towards it.
    expected = np.array([[0, 1, 0], [-0.02, 1, 0], [0, 1, -0.01]])
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(directions, expected, atol=1e-15)
    np.testing.assert_allclose(origins, [[11, 2, 3], [10.7, 2, 3], [11, 2, 3.2]], atol=1e-15)


def test_offsets_add_to_the_angles_of_each_beam():
    both = SubRays(np.array([[0.001, 0.002]]))
    moved = Pattern(beams(), None, both, np.tile([0.003, -0.001], (len(beams()), 1)))
    expected = Pattern(beams(), None, SubRays(np.array([[0.001 + 0.003, 0.002 - 0.001]])))
    ray = np.arange(len(beams()))
    _, moved_directions = pattern_rays(moved, ray, [0, 0, 0])
    _, expected_directions = pattern_rays(expected, ray, [0, 0, 0])
    assert np.array_equal(moved_directions, expected_directions)


@pytest.mark.extended
@pytest.mark.parametrize("kind", ["", "axis starts offsets", "starts origins", "offsets"])
def test_sub_rays_hit_what_moves(shapes, kind):
    pytest.importorskip("numba")
    """Bodies that stand are hit where the same shape is."""
    rng = np.random.default_rng(8)
    shape = RayCaster(*(mesh := shapes["vase"]()), backend="numpy")
    given = pattern(rng, 7, kind)
    where = poses(rng, "moves", 7 * len(beams()))
    corners = np.array([mesh[0].min(axis=0), mesh[0].max(axis=0)])

    def stand(bodies, times):
        table = np.zeros((12, len(bodies)))
        table[[3, 7, 11]] = 1
        return table

    alone = MovingBodies((shape,), corners[None], np.zeros(1, int), np.array([[-1.0, 1.0]]), stand)
    scan = check_scan(given, **where)
    found = nearest_body_hits(alone, scan, lambda ray: 1e-6 * ray)
    expected = shape.scan(given, **where)
    ray = np.flatnonzero(found.body >= 0)
    assert np.array_equal(ray, expected.ray) and len(ray) > 100
    np.testing.assert_allclose(found.distance[ray], expected.distance, rtol=1e-12)
    assert np.array_equal(found.triangle[ray], expected.triangle)
