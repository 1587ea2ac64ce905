"""Occupancy of voxel grids: closed forms, containment, and rays by brute force."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest
import trimesh
from tests.lidarscenes.test_scene_flow import straight
from tests.shapes import block, level, solid

from lidarsim import (
    Actor,
    LidarError,
    Material,
    Mounted,
    Pose,
    Scene,
    SceneMesh,
    Sensor,
    Survey,
    box,
)
from lidarsim.scene.files.meshfile import load_objects
from lidarsim.scene.scene_instances import SceneInstance
from lidarsim.simulator.occupancy import FREE, OccupancySimulator, VoxelGrid
from lidarsim.simulator.occupancy import voxel_loops as loops
from lidarsim.simulator.occupancy.marks import HIT, TRAVERSED

SENSOR = Sensor.grid(720, 60, 60.0, step_deg=360, min_range_m=0.5, max_range_m=30.0)
FEW_RAYS = Sensor.grid(36, 8, 60.0, step_deg=360, min_range_m=0.5, max_range_m=30.0)
GRID = VoxelGrid((-4, -4, -2), (12, 4, 2), 0.5)
PEDESTRIAN = Path(__file__).parents[2] / "examples/pedestrian.glb"


def occupancy_of(scene, survey=None, grid=GRID, number=0, **options):
    survey = survey or Survey(SENSOR, poses=[(0, 0, 0)], steps=1)
    return OccupancySimulator(scene, survey, grid, backend="numpy", **options).sweep(number)


def centers_of(grid):
    steps = [np.arange(count) + 0.5 for count in grid.shape]
    cells = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1)
    return cells * grid.voxel_m + np.array(grid.lower)


def overlap(grid, lower, upper):
    """Voxels that overlap a box whose sides lie inside voxels."""
    centers = centers_of(grid)
    half = grid.voxel_m / 2
    return ((centers + half > lower) & (centers - half < upper)).all(axis=-1)


def test_a_box_in_front_of_a_sensor_is_occupied_and_hides_what_is_behind_it():
    lower, upper = np.array([4.1, -1.2, -1.3]), np.array([6.3, 1.4, 1.1])
    mesh = block("Box", upper - lower, (lower + upper) / 2)
    scene = Scene.from_meshes([mesh])
    survey = Survey(
        SENSOR, poses=[(0, 0, 0)], steps=1, materials=[Material("*", semantic_class=10)]
    )
    found = occupancy_of(scene, survey)
    expected = overlap(GRID, lower, upper)
    np.testing.assert_array_equal(found.occupied, expected)
    np.testing.assert_array_equal(found.classes, np.where(expected, 10, 0))
    np.testing.assert_array_equal(found.instances, np.where(expected, 0, FREE))
    x, y, z = np.moveaxis(centers_of(GRID), -1, 0)
    beside = (np.abs(y) < 0.5) & (np.abs(z) < 0.5)
    front = beside & (x > 4) & (x < 4.5)
    assert found.hit[front].all() and front.any()
    before = beside & (x > 1) & (x < 4)
    assert (found.observed & ~found.occupied & ~found.hit)[before].all()
    # The shadow has the directions of the front side; this part of it contains whole voxels.
    shadow = (x > 5) & (np.abs(y) < 1.0 / 4.1 * (x - 0.25) - 0.25)
    shadow &= np.abs(z) < 1.0 / 4.1 * (x - 0.25) - 0.25
    assert shadow.sum() > 200 and not found.observed[shadow].any()
    assert not found.hit[~expected].any()
    sky = (x < -1) & (x > -3) & beside  # rays without a return observe up to the maximum range
    assert found.observed[sky].all()


def turns_around(mesh, points):
    """Solid angle of a mesh seen from points, as a fraction of the sphere (Van Oosterom 1983)."""
    total = np.zeros(len(points))
    for corners in mesh.triangles:
        a, b, c = corners[:, None] - points
        sizes = [np.linalg.norm(vector, axis=1) for vector in (a, b, c)]
        above = np.einsum("ni,ni->n", a, np.cross(b, c))
        below = sizes[0] * sizes[1] * sizes[2]
        for p, q, size in ((a, b, sizes[2]), (b, c, sizes[0]), (c, a, sizes[1])):
            below += np.einsum("ni,ni->n", p, q) * size
        total += 2 * np.arctan2(above, below)
    return total / (4 * np.pi)


@pytest.mark.extended
def test_voxels_with_centers_in_closed_meshes_are_occupied():
    ring = trimesh.creation.torus(2.0, 0.9, 16, 12)
    ball = trimesh.creation.icosphere(1, 1.0)
    turn = trimesh.transformations.euler_matrix(0.3, 0.7, 0.2) @ np.diag([1.5, 1.2, 1.0, 1.0])
    turn[:3, 3] = 7, 0.3, 0.2
    ball_mesh = solid("Ball", ball)
    instance = SceneInstance(ball_mesh, turn, "Ball")
    open_ball = SceneMesh("Half", ball.vertices * 1.3 + (9.5, 2, 0), ball.faces[:-8])
    ring.apply_transform(trimesh.transformations.euler_matrix(0.4, 0.2, 0.1))
    scene = Scene.from_meshes([solid("Ring", ring), instance, open_ball])
    grid = VoxelGrid((-4, -4, -2), (12, 4, 2), 0.4)
    found = occupancy_of(scene, Survey(FEW_RAYS, poses=[(0, 0, 0)], steps=1), grid)
    centers = centers_of(grid).reshape(-1, 3)
    placed = ball.copy().apply_transform(turn)
    inside = [turns_around(mesh, centers).reshape(grid.shape) > 0.5 for mesh in (ring, placed)]
    for number, contained in enumerate(inside):
        assert contained.sum() > 40
        assert (found.instances[contained] == number).all()
    # All other occupied voxels intersect a surface, and all sampled points are in such voxels.
    rest = found.occupied & ~inside[0] & ~inside[1]
    meshes = [ring, placed, trimesh.Trimesh(open_ball.vertices, open_ball.faces)]
    for number, mesh in enumerate(meshes):
        points, _ = trimesh.sample.sample_surface(mesh, 5_000, seed=1)
        cells = np.floor(grid.to_voxels(points)).astype(int)
        cells = cells[((cells >= 0) & (cells < grid.shape)).all(axis=1)]
        assert (found.instances[tuple(cells.T)] == number).all()
        _, away, _ = trimesh.proximity.closest_point_naive(
            mesh, centers_of(grid)[rest & (found.instances == number)][::4]
        )
        assert away.max() <= 0.4 * np.sqrt(3) / 2 + 1e-6
    middle = tuple(np.floor(grid.to_voxels(np.array([[9.5, 2.0, 0.0]]))[0]).astype(int))
    assert not found.occupied[middle]  # the mesh is open


def test_voxel_centers_in_tetrahedra_are_found():
    """The tetrahedra extend beyond the grid. Voxels in the first keep its number."""
    random = np.random.default_rng(3)
    shape = (7, 6, 8)
    centers = np.stack(np.meshgrid(*(np.arange(count) + 0.5 for count in shape), indexing="ij"), -1)
    counts = np.zeros(2, np.int64)
    for orientation in (1, -1) * 10:
        found = np.full(shape, -1, np.int32)
        expected = found.copy()
        for number in (4, 2):
            corners = random.uniform(-3, 11, (4, 3))
            shares = np.linalg.solve(
                (corners[1:] - corners[0]).T, (centers - corners[0])[..., None]
            )
            inside = (shares > 0).all(axis=(-2, -1)) & (shares.sum(axis=(-2, -1)) < 1)
            expected[inside & (expected < 0)] = number
            faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])[:, ::orientation]
            loops.add_interior(np.ascontiguousarray(corners[faces]), number, found)
        np.testing.assert_array_equal(found, expected)
        counts += (found == 4).sum(), (found == 2).sum()
    assert counts.min() > 200


def test_surfaces_intersect_the_same_voxels_as_clipped_triangles():
    random = np.random.default_rng(4)
    corners = random.uniform(-1, 7, (40, 3, 3))
    for triangle in corners:
        found = np.full((6, 5, 4), -1, np.int32)
        none = np.full(found.shape, -1, np.int32)
        numbers = np.zeros(1, np.int32)
        square = np.full(found.shape, 9e9)
        loops.add_surfaces(triangle[None], numbers, numbers - 1, none, found, square)
        weights = random.dirichlet((1, 1, 1), 4000)
        cells = np.floor(weights @ triangle).astype(int)
        cells = cells[((cells >= 0) & (cells < found.shape)).all(axis=1)]
        assert (found[tuple(cells.T)] == 0).all()
        for cell in np.argwhere(found == 0):
            assert clipped(triangle, cell - 2e-6, cell + 1 + 2e-6)


def test_voxels_have_the_squared_distance_of_the_closest_triangle():
    """Beside triangles of any shape, some are lines or points."""
    random = np.random.default_rng(8)
    triangles = random.uniform(-1, 5, (30, 3, 3))
    triangles[20:25, 2] = triangles[20:25, :2].mean(axis=1)
    triangles[25:28, 2] = triangles[25:28, 0]
    triangles[28:] = triangles[28:, :1]
    found = np.full((4, 3, 5), -1, np.int32)
    none = np.full(found.shape, -1, np.int32)
    square = np.full(found.shape, 9e9)
    numbers = np.arange(len(triangles), dtype=np.int32)
    loops.add_surfaces(triangles, numbers, np.full_like(numbers, -1), none, found, square)
    # The closest of many points of each triangle, at most a few millimeters from the closest one.
    u, v = np.meshgrid(np.linspace(0, 1, 201), np.linspace(0, 1, 201))
    weights = np.stack([1 - u, u * (1 - v), u * v], axis=-1).reshape(-1, 3)
    for cell in np.argwhere(found >= 0):
        points = weights @ triangles[found[tuple(cell)]]
        expected = ((points - cell - 0.5) ** 2).sum(axis=1).min()
        assert square[tuple(cell)] == pytest.approx(expected, abs=0.01)
    assert {*found.ravel().tolist()} & {*range(20, 28)}


def clipped(polygon, lower, upper):
    """Whether a polygon has a part between two corners (Sutherland and Hodgman)."""
    polygon = list(polygon)
    for axis, (bound, sign) in product(range(3), ((0, 1), (1, -1))):
        limit = (lower, upper)[bound][axis]
        kept = []
        for a, b in zip(polygon, polygon[1:] + polygon[:1], strict=True):
            from_a, from_b = sign * (a[axis] - limit), sign * (b[axis] - limit)
            if from_a >= 0:
                kept.append(a)
            if (from_a >= 0) != (from_b >= 0):
                kept.append(a + (b - a) * from_a / (from_a - from_b))
        polygon = kept
    return bool(polygon)


def test_rays_pass_the_voxels_that_brute_force_finds():
    random = np.random.default_rng(7)
    shape = (8, 6, 5)
    origins = random.uniform(-3, 10, (3, 300))
    directions = random.normal(size=(3, 300))
    directions[0, :20] = 0
    directions[1, 10:30] = 0
    directions /= np.linalg.norm(directions, axis=0)
    ends = random.uniform(1, 15, 300)
    hits = random.random(300) < 0.5
    lower = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
    for ray in range(300):
        marks = np.zeros(shape, np.uint8)
        one = np.s_[:, ray : ray + 1]
        loops.add_rays(
            origins[one].copy(), directions[one].copy(), 0.5, ends[[ray]], hits[[ray]], marks
        )
        begin, end = np.full(shape, 0.5), np.full(shape, ends[ray])
        for axis in range(3):
            origin, direction = origins[axis, ray], directions[axis, ray]
            if direction == 0:
                end[(origin < lower[..., axis]) | (origin > lower[..., axis] + 1)] = -np.inf
                continue
            first = (lower[..., axis] - origin) / direction
            second = (lower[..., axis] + 1 - origin) / direction
            begin = np.maximum(begin, np.minimum(first, second))
            end = np.minimum(end, np.maximum(first, second))
        assert (marks[end - begin > 1e-9] & TRAVERSED).all()
        assert (end - begin > -1e-9)[marks > 0].all()
        at = np.floor(origins[:, ray] + ends[ray] * directions[:, ray]).astype(int)
        is_hit = hits[ray] and ((at >= 0) & (at < shape)).all()
        assert np.argwhere(marks & HIT).tolist() == ([at.tolist()] if is_hit else [])


def test_actors_are_at_their_poses_at_the_start_of_a_sweep():
    car = Actor(box("Car", (2.2, 1.4, 0.9)), straight((3.1, 1.1, -1.55), (20, 0, 0)))
    late = Actor(
        box("Late", (1.0, 1.0, 1.0)), straight((-2.2, -2.2, 0.0), (0, 0, 0), 0.15, beyond="absent")
    )
    ground = level("Ground", -1.8)
    scene = Scene.from_meshes([ground]).with_actors([car, late])
    path = straight((0, 0, 0), (10, 0, 0))
    survey = Survey(
        sensors=[Mounted(FEW_RAYS, Pose((0, 0, 0.2)), "roof")], trajectory=path, steps=3,
        materials=[
            Material("Car", semantic_class=10), Material("*", semantic_class=40),
        ],
    )  # fmt: skip
    for number in range(3):
        found = occupancy_of(scene, survey, number=number, frame="platform")
        start_s = survey.sweeps_each[0].starts_ns[number] / 1e9
        x = 3.1 + 10 * start_s
        body = overlap(GRID, (x - 1.1, 0.4, -1.55), (x + 1.1, 1.8, -0.65))
        road = overlap(GRID, (-40, -40, -1.81), (40, 40, -1.79))
        assert (found.classes[body & ~road] == 10).all()
        assert (found.instances[body & ~road] == 1).all()
        assert (found.classes[road & ~body] == 40).all() and (found.occupied[road]).all()
        present = overlap(GRID, (-2.7 - 10 * start_s, -2.7, -0.5), (-1.7 - 10 * start_s, -1.7, 0.5))
        assert (found.instances[present & ~road] == (2 if start_s <= 0.15 else FREE)).all()
    in_sensor = occupancy_of(scene, survey, VoxelGrid((-4, -4, -2.2), (12, 4, 1.8), 0.5))
    in_platform = occupancy_of(scene, survey, frame="platform")
    np.testing.assert_array_equal(in_sensor.instances, in_platform.instances)
    np.testing.assert_array_equal(in_sensor.observed, in_platform.observed)


def test_the_closest_surface_and_the_visible_objects_count():
    ground = level("Ground", -1.7)  # 0.05 m above the centers of the lowest voxels
    hood = block("Hood", (1.0, 1.0, 0.2), (0.6, 0.1, -0.9))
    crate = block("Crate", (0.9, 0.9, 0.1), (5.1, 0.1, -1.78))  # its top is 0.02 m above them
    scene = Scene.from_meshes([ground, hood, crate])
    carried = Mounted(SENSOR, Pose((0, 0, 0)), unseen=["Hood"])
    survey = Survey(sensors=[carried], poses=[(0, 0, 0)], steps=1)
    found = occupancy_of(scene, survey)
    top = overlap(GRID, (4.7, -0.3, -1.9), (5.4, 0.4, -1.6))
    assert top.sum() == 4
    np.testing.assert_array_equal(found.instances == 2, top)
    lowest = found.instances[:, :, 0]
    assert set(np.unique(lowest)) == {0, 2} and (found.instances[:, :, 1:] == FREE).all()
    assert found.observed[overlap(GRID, (1.1, -0.2, -0.95), (1.2, 0.2, -0.85))].all()


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("yaw_deg", [0, 90])
@pytest.mark.parametrize(
    ("ground_m", "car_m"), [(-1.5, -1.5), (-1.5, -1.53), (-1.4, -1.4), (-1.5, -1.3)]
)
def test_voxels_in_a_solid_are_its_own_where_it_stands(ground_m, car_m, yaw_deg, order):
    """The ground is on a boundary of voxels (-1.5), or in the lower half of a voxel."""
    ground = level("Ground", ground_m)
    car = block("Car", (2.2, 1.8, 1.4), (1.9, 0.3, car_m + 0.7))
    scene = Scene.from_meshes([ground, car][::order])
    survey = Survey(FEW_RAYS, poses=[Pose((0, 0, 0), yaw_deg=yaw_deg)], steps=1)
    found = occupancy_of(scene, survey, GRID)
    x, y, z = np.moveaxis(centers_of(GRID), -1, 0)
    if yaw_deg:
        x, y = -y, x
    inside = (np.abs(x - 1.9) < 1.1) & (np.abs(y - 0.3) < 0.9)
    inside &= (z > car_m) & (z < car_m + 1.4)
    car_number = scene.object_names.index("Car")
    assert inside.any()
    assert (found.instances[inside] == car_number).all()
    beside = (np.abs(x - 1.9) > 1.4) | (np.abs(y - 0.3) > 1.2)
    touched = np.abs(z - ground_m) < GRID.voxel_m / 2 + 1e-6
    ground_number = scene.object_names.index("Ground")
    np.testing.assert_array_equal(
        found.instances[beside], np.where(touched, ground_number, FREE)[beside]
    )


def test_surfaces_in_a_solid_keep_their_voxels():
    """A driver in a closed car, whose surfaces pass through voxels with centers in the car."""
    car = block("Car", (4.2, 2.2, 1.4), (6.1, 0.3, -0.8))
    driver = block("Driver", (0.9, 0.4, 0.9), (6.0, 0.2, -0.8))
    found = occupancy_of(Scene.from_meshes([car, driver]), Survey(FEW_RAYS, poses=[(0, 0, 0)]))
    crossed = overlap(GRID, (5.55, 0.0, -1.25), (6.45, 0.4, -0.35))
    crossed &= np.abs(centers_of(GRID) - (6.0, 0.2, -0.8)).max(axis=-1) < 0.6
    assert (found.instances == 1).sum() >= 4
    assert (found.instances[~crossed] != 1).all()


def test_a_walking_person_is_deformed_as_at_the_start_of_a_sweep():
    (mesh,) = load_objects(PEDESTRIAN, animation="Walk").static
    person = Actor(mesh, straight((4.0, 0.1, -1.4), (1.4, 0, 0)))
    scene = Scene.from_meshes([level("Ground", -1.9)]).with_actors([person])
    survey = Survey(FEW_RAYS, trajectory=straight((0, 0, 0), (0, 0, 1e-9)), steps=4)
    grid = VoxelGrid((3, -1, -1.7), (6, 1, 0.9), 0.1)
    shapes = []
    for number in (0, 3):
        found = occupancy_of(scene, survey, grid, number)
        moved = person.mesh_at(survey.sweeps_each[0].starts_ns[number])
        cells = np.floor(grid.to_voxels(moved.vertices[np.unique(moved.faces)])).astype(int)
        cells = cells[((cells >= 0) & (cells < grid.shape)).all(axis=1)]
        assert len(cells) > 100 and (found.instances[tuple(cells.T)] == 1).all()
        shapes.append(found.occupied.sum())
    assert shapes[0] != shapes[1]


def test_following_sweeps_observe_more():
    scene = Scene.from_meshes([block("Box", (2, 2, 2), (5, 0, 0))])
    survey = Survey(SENSOR, trajectory=straight((0, 0, 0), (0, 30, 0)), steps=3)
    simulator = OccupancySimulator(scene, survey, GRID, backend="numpy")
    alone = simulator.sweep(0)
    np.testing.assert_array_equal(alone.observed_later, alone.observed)
    later = simulator.sweep(0, following=5)  # there are two
    np.testing.assert_array_equal(later.observed, alone.observed)
    gained = later.observed_later & ~later.observed
    assert gained.sum() > 100 and (later.observed_later | ~later.observed).all()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (((0, 0, 0), (1, 1, 1), 0.3), "must be a multiple of the voxel size, 0.3 m"),
        (((0, 0, 0), (1, 1, -1), 0.5), "must be a multiple"),
        (((0, 0, 0), (1000, 1000, 1000), 0.1), "at most 100,000,000 voxels"),
        (((0, 0, 0), (np.inf, 1, 1), 0.1), "must be finite"),
    ],
)
def test_invalid_grids(arguments, words):
    with pytest.raises(LidarError, match=words):
        VoxelGrid(*arguments)


def test_the_largest_grid():
    assert VoxelGrid((-500, 0, -1), (0, 250, 1.5), 0.25).shape == (2000, 1000, 10)
    assert VoxelGrid((-500, -200, 0), (0, 300, 400), 1).shape == (500, 500, 400)
    with pytest.raises(LidarError, match="this one has 100,250,000"):
        VoxelGrid((-500, -200, 0), (0, 300, 401), 1)
