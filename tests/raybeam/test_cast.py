"""Closest hits against an independent oracle and against shapes whose answer is known."""

import numpy as np
import pytest
from benchmarks.gpu_scenes import grid_faces

from raybeam import RayCaster

TRIANGLE = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0]]), np.array([[0, 1, 2]])


def lines_and_triangles(vertices, faces, origin, direction):
    """For one ray and every triangle: distance, and how far inside the ray passes, in meters.

    Float64 brute force on the geometry's definition, with none of the package's formulas: the
    plane's distance from its normal, then the least signed distance of the point to an edge's
    plane that holds the ray.
    """
    a, b, c = (vertices[faces[:, k]] - origin for k in range(3))
    normal = np.cross(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (normal * a).sum(axis=1) / (normal @ direction)
        facing = np.sign(normal @ direction)
        sides = []
        for p, q in ((a, b), (b, c), (c, a)):
            across = np.cross(q - p, direction)
            sides.append(-(across * p).sum(axis=1) / np.linalg.norm(across, axis=1))
        margin = np.min(sides * -facing, axis=0)
    bad = ~np.isfinite(t) | ~np.isfinite(margin)
    return np.where(bad, np.inf, t), np.where(bad, -np.inf, margin)


def check(hits, mesh, rays, graze, t_min=0.0, t_max=np.inf):
    """Compare with the oracle; within `graze` meters of an edge either answer is right."""
    vertices, faces = mesh
    origins, directions = rays
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.broadcast_to(origins, unit.shape)
    surely_hit = 0
    for i in range(len(unit)):
        t, margin = lines_and_triangles(vertices, faces, origins[i], unit[i])
        sure = (margin > graze) & (t >= t_min) & (t <= t_max)
        nearest = t[sure].min(initial=np.inf)
        tolerance = 1e-4 + 2e-7 * min(nearest, 1e9)
        k = hits.triangle[i]
        if k < 0:
            assert nearest == np.inf
            assert (hits.distance[i], hits.u[i], hits.v[i]) == (np.inf, 0, 0)
            continue
        surely_hit += sure.any()
        assert t_min <= hits.distance[i] <= min(nearest + tolerance, t_max)
        assert margin[k] > -graze
        if margin[k] > graze:
            assert abs(hits.distance[i] - t[k]) < tolerance
            a, b, c = vertices[faces[k]]
            point = a + hits.u[i] * (b - a) + hits.v[i] * (c - a)
            # where a ray grazes, a hair's breadth of weight is a long way along the ray
            off = np.cross(point - origins[i], unit[i])
            assert np.linalg.norm(off) < tolerance
    return surely_hit


@pytest.mark.extended(every=15)
@pytest.mark.slow(every=5)
@pytest.mark.parametrize("kind", ["random", "sliver", "huge", "tiny"])
@pytest.mark.parametrize("offset", [0.0, 5e5, 4e6])
def test_agrees_with_brute_force(caster, backend, shapes, kind, offset):
    vertices, faces = shapes["soup"](kind)
    vertices = vertices + offset
    rng = np.random.default_rng(1)
    n = 200
    origins = rng.uniform(-60, 60, (n, 3)) + offset
    weights = rng.dirichlet([1, 1, 1], n)  # most rays are aimed at a triangle
    targets = (vertices[faces[rng.integers(len(faces), size=n)]] * weights[..., None]).sum(axis=1)
    directions = targets - origins
    directions[::10] = rng.normal(size=(len(directions[::10]), 3))
    size = np.ptp(vertices, axis=0).max()
    graze = size * 1e-12 + 1e-8
    engine = caster(vertices, faces)
    mesh = vertices, faces
    rays = origins, directions
    check(engine.cast(*rays, 5, 25), mesh, rays, graze, 5, 25)
    sure = check(engine.cast(*rays), mesh, rays, graze)
    if kind != "sliver":
        assert sure > 0.8 * n  # else the comparison says little


def test_cube_from_inside_and_outside(caster, shapes):
    cube = caster(*shapes["cube"]())
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    inside = cube.cast([0.25, 0.5, -0.5], axes)  # on the backs of its triangles
    np.testing.assert_allclose(inside.distance, [0.75, 0.5, 1.5, 1.25, 1.5, 0.5], rtol=1e-15)
    outside = cube.cast(10 * axes + [0.1, 0.2, 0.3], -axes)
    np.testing.assert_allclose(outside.distance, [9.1, 9.2, 9.3, 8.9, 8.8, 8.7], rtol=1e-14)
    assert not cube.cast(10 * axes, axes).hit.any()


def test_limits_count_on_both_ends(caster, shapes):
    cube = caster(*shapes["cube"]())
    ray = [-4, 0.25, 0.5], [[1, 0, 0]]
    assert cube.cast(*ray, t_min=3).distance == 3
    assert cube.cast(*ray, t_min=np.nextafter(3, 4)).distance == 5
    assert cube.cast(*ray, t_min=5).distance == 5
    assert not cube.cast(*ray, t_min=np.nextafter(5, 6)).hit
    assert cube.cast(*ray, t_max=3).distance == 3
    assert not cube.cast(*ray, t_max=np.nextafter(3, 0)).hit
    assert not cube.cast(*ray, t_min=3.5, t_max=4.5).hit


def test_start_on_a_surface(caster, shapes):
    cube = caster(*shapes["cube"]())
    start = [1, 0.25, 0.5]
    assert cube.cast(start, [[-1, 0, 0]]).distance == 0
    assert cube.cast(start, [[1, 0, 0]]).distance == 0
    assert cube.cast(start, [[-1, 0, 0]], t_min=1e-9).distance == 2
    assert not cube.cast(start, [[1, 0, 0]], t_min=1e-9).hit


@pytest.mark.parametrize("t_min", [0.0, 1.0])
def test_a_ray_that_grazes_what_it_starts_on_meets_the_wall_behind(caster, t_min):
    """The ground within rounding of `t_min`, before or behind it, takes nothing from the wall."""
    rng = np.random.default_rng(9)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    ground = [[-10, -10, 0], [10, -10, 0], [10, 10, 0], [-10, 10, 0]]
    points = np.array([*ground, *([x, y, 5] for x, y, _ in ground)], float)
    rim = [(k, (k + 1) % 4) for k in range(4)]
    walls = [row for a, b in rim for row in ([a, b, b + 4], [a, b + 4, a + 4])]
    room = caster(points @ turn.T + [100, 200, 300], [[0, 1, 2], [0, 2, 3], *walls])
    for rise in (0.03, 0.01, 0.003, 0.001):
        around = rng.uniform(0, 2 * np.pi, 2000)
        flat = np.sqrt(1 - rise**2)
        out = np.stack([flat * np.cos(around), flat * np.sin(around), np.full(2000, rise)], axis=1)
        start = np.pad(rng.uniform(-5, 5, (2000, 2)), ((0, 0), (0, 1))) - t_min * out
        hits = room.cast(start @ turn.T + [100, 200, 300], out @ turn.T, t_min)
        assert hits.hit.all()
        wall = hits.triangle >= 2
        assert 500 < wall.sum() < 2000
        points = (start + hits.distance[:, None] * out)[wall]
        np.testing.assert_allclose(np.abs(points[:, :2]).max(axis=1), 10, rtol=1e-9)


def test_edges_and_corners_belong_to_the_triangle(caster):
    triangle = caster(*TRIANGLE)
    on = np.array([[0, 0, 1], [4, 0, 1], [0, 4, 1], [2, 0, 1], [0, 2, 1], [2, 2, 1], [1, 3, 1.0]])
    assert triangle.cast(on, np.broadcast_to([0, 0, -1], on.shape)).hit.all()
    off = np.array([[-1e-9, 1, 1], [1, -1e-9, 1], [2 + 1e-9, 2, 1], [4 + 1e-9, 0, 1]])
    assert not triangle.cast(off, np.broadcast_to([0, 0, -1], off.shape)).hit.any()


def test_in_the_plane_is_a_miss(caster):
    triangle = caster(*TRIANGLE)
    origins = [[-1, 1, 0], [1, -1, 0], [-1, 0, 0], [-1, -1, 0], [1, 1, 0]]
    directions = [[1, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0], [1, 2, 0]]
    assert not triangle.cast(origins, directions).hit.any()


@pytest.mark.extended
def test_nearly_in_the_plane_stays_beside_the_triangle(caster):
    """Planes that float64 cannot hold: hit or miss is rounding, but no distance from elsewhere."""
    rng = np.random.default_rng(5)
    met = 0
    for _ in range(50):
        corners = rng.normal(size=(3, 3))
        weights = rng.dirichlet([1, 1, 1], (100, 2))
        start, end = np.einsum("nkc,cx->knx", weights, corners)
        origins = start - 3 * (end - start)
        directions = end - start
        hits = caster(corners, [[0, 1, 2]]).cast(origins, directions)
        axis = np.argmax(np.abs(directions), axis=1)[:, None]
        unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        points = origins + np.where(hits.hit, hits.distance, 0)[:, None] * unit
        along = np.take_along_axis(points, axis, axis=1)[:, 0][hits.hit]
        low = corners.min(axis=0)[axis[:, 0]]
        high = corners.max(axis=0)[axis[:, 0]]
        assert (along >= low[hits.hit] - 1e-9).all()
        assert (along <= high[hits.hit] + 1e-9).all()
        met += len(along)
    assert met > 0


def test_triangles_without_area_are_not_hit(caster):
    vertices = [[0, 0, 0], [1, 1, 1], [3, 3, 3], [0, 0, 0], [5, 0, 0]]
    degenerate = [[0, 0, 0], [0, 1, 1], [0, 1, 2], [0, 3, 4]]
    targets = np.array([[0, 0, 0], [1, 1, 1], [2, 2, 2], [2.5, 0, 0]])
    origin = np.array([1.0, 2, 5])
    beside = caster([*vertices, [-9, -9, -1], [9, -9, -1], [0, 9, -1]], [*degenerate, [5, 6, 7]])
    assert (beside.cast(origin, targets - origin).triangle == 4).all()


def test_nearest_of_equals_is_the_first(caster, shapes):
    vertices, faces = shapes["sphere"](12, 18)
    copies = np.concatenate([faces[::-1], faces, faces])
    directions = np.random.default_rng(6).normal(size=(2000, 3))
    once = caster(vertices, faces[::-1]).cast([0, 0, 0], directions)
    many = caster(vertices, copies).cast([0, 0, 0], directions)
    np.testing.assert_array_equal(many.triangle, once.triangle)
    np.testing.assert_array_equal(many.distance, once.distance)


def test_far_origins_lose_nothing(caster, shapes):
    vertices, faces = shapes["sphere"]()
    rng = np.random.default_rng(7)
    out = rng.normal(size=(500, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    aim = 0.9 * np.cross(out, rng.normal(size=(500, 3)))
    aim *= rng.uniform(0, 0.95, (500, 1)) / np.linalg.norm(aim, axis=1, keepdims=True)
    sphere = caster(vertices, faces)
    for far in (10, 1e3, 1e6):
        hits = sphere.cast(out * far + aim, -out)
        assert hits.hit.all()
        points = (far - hits.distance)[:, None] * out + aim
        np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1, atol=0.01)


def test_rays_from_absurdly_far_give_no_warning(caster, shapes):
    """Float64 cannot aim at the cube from there: a ray misses, or hits at its distance."""
    cube = caster(*shapes["cube"]())
    far = 1e100 * np.random.default_rng(3).normal(size=(300, 3))
    assert not cube.cast(far, far).hit.any()
    hits = cube.cast(far, -far)
    distance = np.where(hits.hit, np.linalg.norm(far, axis=1), np.inf)
    np.testing.assert_allclose(hits.distance, distance)


@pytest.mark.slow(every=3)
@pytest.mark.parametrize("size", [1e-30, 1e-6, 1e6, 1e30])
def test_any_unit_of_length(caster, shapes, size):
    vertices, faces = shapes["vase"](20, 20)
    rng = np.random.default_rng(8)
    origins = 0.1 * rng.normal(size=(300, 3))
    directions = rng.normal(size=(300, 3))
    want = caster(vertices, faces).cast(origins, directions)
    got = caster(vertices * size, faces).cast(origins * size, directions)
    np.testing.assert_array_equal(got.triangle, want.triangle)
    np.testing.assert_allclose(got.distance / size, want.distance, rtol=1e-12)


@pytest.mark.extended
@pytest.mark.slow(every=5)
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1, -1])
def test_corners_of_an_open_sheet_and_of_a_ball_are_hit(backend, shapes, axis, sign):
    """Along an axis, where a corner is on the border of its triangles' boxes, too."""
    way = sign * np.eye(3)[axis]
    x, y = np.meshgrid(np.arange(21) / 10, np.arange(21) / 10, indexing="ij")
    sheet = np.roll(np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3), axis + 1, axis=1)
    tip = np.roll([[0, 0, 0], [1, 0, 0], [0, 1, 0]], axis + 1, axis=1)
    for mesh in ((sheet, grid_faces(21, 21)), (tip, [[0, 1, 2]]), shapes["sphere"]()):
        at = mesh[0] * (way == 0) - 5 * way
        hits, want = (
            RayCaster(*mesh, name).cast(at, np.broadcast_to(way, at.shape))
            for name in (backend, "numpy")
        )
        assert hits.hit.all()
        for column in ("distance", "triangle"):
            np.testing.assert_array_equal(getattr(hits, column), getattr(want, column))


def test_vertices_of_no_triangle_do_not_count(caster, shapes):
    (points, faces), ways = shapes["sphere"](), np.random.default_rng(6).normal(size=(500, 3))
    want = caster(points, faces).cast([0, 0, 0], ways)
    got = caster(np.concatenate([points, [[1e9, 0, 0]]]), faces).cast([0, 0, 0], ways)
    np.testing.assert_array_equal(got.distance, want.distance)
