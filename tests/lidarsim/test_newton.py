"""Lidars in worlds of Newton, against closed forms; most tests use a stand-in for a model."""

from __future__ import annotations

import re
import runpy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lidarsim import LidarError, Material, Mounted, NewtonScanner, Noise, Pose, Sensor, load_sensor

PLANE, HFIELD, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH, CONE, HULL, SPLAT = range(1, 12)
VISIBLE, COLLIDES, SITE = 1, 2, 8
GRID = Sensor.grid(360, 48, vertical_fov_deg=60, max_range_m=40)
RING = Sensor.grid(8, 1, step_deg=45, vertical_fov_deg=0, max_range_m=40)


class Array:
    """An array of Warp, as far as it is needed."""

    def __init__(self, values: Any) -> None:
        self.values = np.array(values)

    def numpy(self) -> Any:
        return self.values


def transform(position=(0, 0, 0), yaw_deg=0.0, pitch_deg=0.0):
    """Position and quaternion (x, y, z, w), in single precision."""
    yaw, pitch = np.radians(yaw_deg) / 2, np.radians(pitch_deg) / 2
    x, y = -np.sin(yaw) * np.sin(pitch), np.cos(yaw) * np.sin(pitch)
    z, w = np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch)
    return np.array([*position, x, y, z, w], np.float32)


ORIGIN = transform()


class Builder:
    """What `newton.ModelBuilder` makes, for the arrays that a lidar needs."""

    def __init__(self) -> None:
        self.world = -1
        self.bodies: list[Any] = []
        self.shapes: list[Any] = []

    def body(self, label, at=ORIGIN):
        self.bodies.append((label, self.world, at))
        return len(self.bodies) - 1

    def shape(self, kind, scale, body=-1, at=ORIGIN, label="", *, flags=VISIBLE | COLLIDES,
              source=None, color=(0.5, 0.5, 0.5)):  # fmt: skip
        name = label or f"shape_{len(self.shapes)}"
        self.shapes.append((name, self.world, body, kind, flags, scale, color, at, source))

    def model(self, **others):
        names, worlds, bodies, kinds, flags, scales, colors, places, sources = zip(
            *self.shapes, strict=True
        )
        labels, body_worlds, _ = zip(*self.bodies, strict=True) if self.bodies else ((), (), ())
        return SimpleNamespace(
            body_label=[*labels], body_world=Array(body_worlds), shape_label=[*names],
            shape_world=Array(worlds), shape_body=Array(bodies), shape_type=Array(kinds),
            shape_flags=Array(flags), shape_scale=Array(scales), shape_color=Array(colors),
            shape_transform=Array(places), shape_source=[*sources], **others,
        )  # fmt: skip

    def state(self):
        return SimpleNamespace(body_q=Array([at for _, _, at in self.bodies]))


def tetrahedron():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    return SimpleNamespace(vertices=corners, indices=np.array([0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3]))


def roof():
    """A height field whose diagonals matter: the vertex in its middle is up."""
    data = np.zeros((3, 3), np.float32)
    data[1, 1] = 1
    return SimpleNamespace(data=data, nrow=3, ncol=3, hx=1.0, hy=2.0, min_z=-0.5, max_z=0.5)


def residual(name, p):
    """Distance of points in the frame of a shape from its surface, to first order."""
    x, y, z = p.T
    flat = np.hypot(x, y)
    match name:
        case "ball":
            return np.linalg.norm(p, axis=1) - 0.5
        case "pill":
            return np.hypot(flat, np.maximum(np.abs(z) - 0.4, 0)) - 0.3
        case "can":
            return np.maximum(flat - 0.4, np.abs(z) - 0.5)
        case "barrel":
            side = 0.3 + np.sqrt(1 - z**2) - np.sqrt(1 - 0.5**2)
            return np.where(np.abs(z) < 0.4999, flat - side, np.maximum(flat - 0.3, 0))
        case "cone":
            slant = (flat - 0.4 * (0.6 - z) / 1.2) * np.cos(np.arctan2(0.4, 1.2))
            return np.where(z < -0.5999, np.maximum(flat - 0.4, 0), slant)
        case "egg":
            scaled = p / [0.3, 0.5, 0.7]
            gradient = np.linalg.norm(2 * scaled / [0.3, 0.5, 0.7], axis=1)
            return ((scaled**2).sum(axis=1) - 1) / gradient
        case "crate":
            return (np.abs(p) - [0.3, 0.4, 0.5]).max(axis=1)
        case "wedge":  # the tetrahedron, scaled by (1, -2, 0.5)
            sides = np.stack([-x, y, -z, (x - y / 2 + 2 * z - 1) / np.sqrt(5.25)])
            return sides.max(axis=0)
        case "roof":  # scaled by (1, 0.5, 2): heights from -1 to 1 over ± 1 m
            one = np.maximum(np.abs(x), np.abs(y))
            same = 1 - 2 * one  # in cells whose diagonal meets the middle
            other = 1 - 2 * (np.abs(x) + np.abs(y))
            top = np.where(x * y >= 0, same, np.maximum(other, -1))
            return np.where((one > 0.9999) | (z < -0.9999), 0, (z - top) / 3)
    raise AssertionError(name)


SHAPES = {
    "ball": (SPHERE, (0.5, 1, 1), None),
    "pill": (CAPSULE, (0.3, 0.4, 0), None),
    "can": (CYLINDER, (0.4, 0.5, 0), None),
    "barrel": (CYLINDER, (0.3, 0.5, 1), None),
    "cone": (CONE, (0.4, 0.6, 0), None),
    "egg": (ELLIPSOID, (0.3, 0.5, 0.7), None),
    "crate": (BOX, (0.3, 0.4, 0.5), None),
    "wedge": (MESH, (1, -2, 0.5), tetrahedron()),
    "roof": (HFIELD, (1, 0.5, 2), roof()),
}


def frames(transforms):
    """Rotations (n, 3, 3) and positions (n, 3) of transforms."""
    from scipy.spatial.transform import Rotation

    transforms = np.asarray(transforms, np.float64)
    return Rotation.from_quat(transforms[:, 3:]).as_matrix(), transforms[:, :3]


def test_points_are_on_the_surfaces_of_all_shapes():
    """Each shape lies on a body that is turned, and is turned on it."""
    builder = Builder()
    builder.shape(PLANE, (0, 0, 0), at=transform((0, 0, -2)), label="ground")
    builder.shape(PLANE, (8, 14, 0), at=transform((0, 0, 2), 0, 180), label="ceiling")
    on_body = transform((0.2, 0.1, -0.1), 20, 30)
    for number, (name, (kind, scale, source)) in enumerate(SHAPES.items()):
        angle = np.radians(40 * number)
        at = transform((4 * np.cos(angle), 4 * np.sin(angle), 0.3), 50 * number, 25)
        body = builder.body(name, at)
        builder.shape(kind, scale, body, on_body, source=source)
    builder.body("lidar")
    scanner = NewtonScanner(builder.model(), GRID, body="lidar", precision_m=1e-6)
    (cloud,) = scanner.sweep(builder.state())
    names = scanner.names[0]
    assert names == ("ground", "ceiling", *SHAPES)
    rotations, positions = frames([at for _, _, at in builder.bodies])
    (turn,), (shift,) = frames([on_body])
    for number, name in enumerate(SHAPES):
        points = cloud.positions[cloud.object == names.index(name)]
        in_body = (points - positions[number]) @ rotations[number]
        error = residual(name, (in_body - shift) @ turn)
        assert len(points) > 50, name
        assert np.abs(error).max() < 6e-4, (name, np.abs(error).max())
    ground, ceiling = (cloud.positions[cloud.object == k] for k in (0, 1))
    assert np.abs(ground[:, 2] + 2).max() < 1e-5 and np.abs(ground).max() > 30
    assert np.abs(ceiling[:, 2] - 2).max() < 1e-5
    assert (np.abs(ceiling[:, :2]).max(axis=0) <= (4.0001, 7.0001)).all() and len(ceiling) > 100


def two_worlds(boxes_x=(3.0, 5.0), spacing=0.0):
    """Two worlds with a lidar, a box ahead and a post of their own, and a shared wall behind."""
    builder = Builder()
    builder.shape(BOX, (0.1, 5, 5), at=transform((-7, 0, 0)), label="wall")
    for world, x in enumerate(boxes_x):
        away = np.array([0, world * spacing, 0])
        builder.world = world
        body = builder.body("crate", transform(np.add(away, [x, 0, 0])))
        builder.shape(BOX, (0.5, 0.5, 0.5), body)
        builder.shape(CYLINDER, (0.2, 1, 0), at=transform(np.add(away, [0, 4, 0])), label="post")
        robot = builder.body("robot", transform(away))
        builder.shape(SPHERE, (0.3, 0, 0), robot)
        builder.shape(SPHERE, (0.01,) * 3, robot, transform((0, 0, 0.1)), "lidar", flags=SITE)
    builder.world = -1
    return builder


def test_each_lidar_sees_its_own_world():
    builder = two_worlds()
    scanner = NewtonScanner(builder.model(), RING, site="lidar", precision_m=1e-4)
    state = builder.state()
    images = scanner.ranges(state)
    assert images.shape == (2, 8, 1) and scanner.worlds == (0, 1) and len(scanner) == 2
    ahead, left, behind, right = images[:, ::2, 0].T
    assert np.allclose(ahead, [2.5, 4.5]) and np.allclose(left, 3.8, atol=5e-4)
    assert np.allclose(behind, 6.9) and np.isinf(right).all()
    assert scanner.names == (("wall", "post", "crate"),) * 2
    state.body_q.values[[0, 2]] = transform((2, 0, 0)), transform((4, 0, 0), 45)
    expected = [1.5, 4 - np.sqrt(0.5)]
    assert np.allclose(scanner.ranges(state)[:, 0, 0], expected)
    clouds = scanner.sweep(state)
    for cloud, x in zip(clouds, expected, strict=True):
        on_crate = cloud.object == scanner.names[0].index("crate")
        assert np.allclose(cloud.positions[on_crate][0], [x, 0, 0.1], atol=1e-3)


def test_a_lidar_can_see_all_worlds():
    builder = two_worlds()
    scanner = NewtonScanner(builder.model(), RING, site="lidar", worlds="all")
    images = scanner.ranges(builder.state())
    assert np.allclose(images[:, 0, 0], 2.5)  # the robots are invisible to both
    assert scanner.names[1] == ("wall", "post", "post.2", "crate", "crate.2")


def test_worlds_beside_each_other():
    """The posts have other poses in each world, and the wall ends beside the second one."""
    builder = two_worlds(spacing=5.1)
    scanner = NewtonScanner(builder.model(), RING, body="robot")
    ahead, left, behind, _ = scanner.ranges(builder.state())[:, ::2, 0].T
    assert np.allclose(ahead, [2.5, 4.5]) and np.allclose(left, 3.8, atol=5e-4)
    assert behind.tolist() == [np.float32(6.9), np.inf]
    alone = [
        NewtonScanner(two_worlds(spacing=5.1).model(), GRID, body=[index], columns=["range"])
        for index in (1, 3)
    ]
    together = NewtonScanner(builder.model(), GRID, body="robot", columns=["range"])
    for single, cloud in zip(alone, together.sweep(builder.state()), strict=True):
        (expected,) = single.sweep(builder.state())
        assert cloud.positions.tobytes() == expected.positions.tobytes() and len(cloud) > 500


def test_noise_differs_between_worlds_and_is_repeatable():
    builder = two_worlds((3.0, 3.0))
    options: dict[str, Any] = {"noise": Noise(range_m=0.02), "columns": ["range"]}
    scanner = NewtonScanner(builder.model(), GRID, body="robot", **options)
    state = builder.state()
    first = scanner.ranges(state, number=4)
    assert np.array_equal(first, scanner.ranges(state, number=4))
    both = np.isfinite(first).all(axis=0)
    error = first[0][both] - first[1][both]
    assert both.sum() > 1000 and 0.9 * 0.02 < error.std() / np.sqrt(2) < 1.1 * 0.02
    assert not np.array_equal(first, scanner.ranges(state))
    clouds = scanner.sweep(state, number=4)
    assert clouds[0].range.tobytes() != clouds[1].range.tobytes()
    assert scanner.step(0, state) == [[], []]
    (one,), (other,) = scanner.step(0.11, state)
    assert len(one) > 1000 and one.range[:500].tobytes() != other.range[:500].tobytes()


def test_boxes_fall_during_a_sweep():
    """Two worlds with different gravity, against the heights at the firing times."""
    builder = two_worlds((3.0, 3.0))
    model = builder.model()
    sensor = load_sensor("velodyne/vlp16")
    scanner = NewtonScanner(model, sensor, site="lidar", columns=["time"], precision_m=1e-5)
    gravity = np.array([9.81, 1.62])
    state = builder.state()
    clouds: list[list[Any]] = [[], []]

    def heights(times_s, world):
        return 1 - gravity[world] * times_s**2 / 2

    for step in range(111):
        time_s = step / 500
        for world in range(2):
            state.body_q.values[2 * world, 2] = heights(time_s, world)
        for world, sweeps in enumerate(scanner.step(10 + time_s, state)):
            clouds[world] += sweeps
        if step == 80:
            scanner.reset(1)
    assert [len(sweeps) for sweeps in clouds] == [2, 1]  # world 1 was reset after 0.16 s
    for world, sweeps in enumerate(clouds):
        (cloud,) = sweeps[:1]
        on_crate = cloud.object == scanner.names[world].index("crate")
        x, _, z = cloud.positions[on_crate].T
        seconds = cloud.time[on_crate] / 1e9
        middle = np.interp(seconds, np.arange(111) / 500, heights(np.arange(111) / 500, world))
        below = np.abs(x - 2.5) > 1e-4
        assert below.sum() > 5 or world == 1
        assert np.abs(z[below] - (middle - 0.5)[below]).max(initial=0) < 1e-4
        assert (np.abs(z - middle)[~below] < 0.5001).all()


def test_shapes_are_selected_by_their_flags_and_labels():
    builder = Builder()
    robot = builder.body("robot")
    builder.shape(SPHERE, (9, 9, 9), robot)
    for x, label, flags in ((1, "ghost", COLLIDES), (2, "pane", VISIBLE), (3, "wall", 3),
                            (0.5, "mark", VISIBLE | SITE), (0.7, "splat", VISIBLE)):  # fmt: skip
        kind = SPLAT if label == "splat" else BOX
        builder.shape(kind, (0.1, 1, 1), at=transform((x, 0, 0)), label=label, flags=flags)
    model, state = builder.model(), builder.state()

    def ahead(**options):
        return NewtonScanner(model, RING, body="robot", **options).ranges(state)[0, 0, 0]

    assert np.isclose(ahead(), 1.9) and np.isclose(ahead(geometry="collision"), 0.9)
    assert np.isclose(ahead(exclude=["pa*"]), 2.9)
    front = Mounted(RING, Pose((2.5, 0, 0)))
    scanner = NewtonScanner(model, front, body=0, columns=["intensity", "red"],
                            materials=[Material("wall", 0.25), Material("*", 0.5)])  # fmt: skip
    (cloud,) = scanner.sweep(state)
    assert np.isclose(cloud.positions[0, 0], 2.9) and cloud.red[0] == 128


def test_shapes_of_a_body_are_one_object_or_several():
    builder = Builder()
    robot = builder.body("robot")
    sled = builder.body("sled", transform((3, 0, 0)))
    for y in (-1, 1):
        builder.shape(BOX, (0.5, 0.5, 0.5), sled, transform((0, y, 0)), f"runner {y}")
    del robot
    model, state = builder.model(), builder.state()
    by_body = NewtonScanner(model, GRID, body="robot")
    by_shape = NewtonScanner(model, GRID, body="robot", objects="shape")
    assert by_body.names == (("sled",),) and by_shape.names == (("runner -1", "runner 1"),)
    assert np.array_equal(by_body.ranges(state), by_shape.ranges(state))
    assert {*by_shape.sweep(state)[0].object.tolist()} == {0, 1}


def test_parts_without_a_surface_are_stated(caplog):
    builder = Builder()
    builder.body("robot")
    builder.shape(BOX, (1, 1, 1))
    builder.shape(SPLAT, (1, 1, 1), label="scan of a room")
    NewtonScanner(builder.model(particle_count=400), RING, body="robot")
    assert "the model has Gaussian splats (scan of a room) and 400 particles" in caplog.text


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "body=LABEL or site=LABEL"),
        ({"site": "lidar", "body": "robot"}, "either the body or the site .* but not both"),
        ({"site": "lidr"}, "no site 'lidr'. Did you mean 'lidar'"),
        ({"site": "post"}, "no site 'post'"),
        ({"body": 99}, "no body 99"),
        ({"site": "lidar", "exclude": ["crat"]}, "no body or shape 'crat'. Did you mean 'crate'"),
        ({"site": "lidar", "worlds": "mine"}, "worlds must be 'own' or 'all', but is 'mine'"),
        ({"site": "lidar", "geometry": "both"}, "geometry must be 'visual' or 'collision'"),
        ({"site": "lidar", "objects": "part"}, "objects must be 'body' or 'shape'"),
        ({"site": "lidar", "sag_m": 0}, "sag_m must be greater than 0, but is 0"),
        ({"site": "lidar", "exclude": ["*"]}, "no shapes that are visible to the lidar"),
    ],
)
def test_wrong_options(options, message):
    with pytest.raises(LidarError, match=message):
        NewtonScanner(two_worlds().model(), RING, **options)


def test_wrong_models_and_states():
    builder = two_worlds()
    model = builder.model()
    model.shape_type.values[1] = 17
    with pytest.raises(LidarError, match=r"The shape 'shape_1' .* unknown type 17.*`exclude`"):
        NewtonScanner(model, RING, site="lidar")
    assert NewtonScanner(model, RING, site="lidar", exclude=["crate"]).names[0] == ("wall", "post")
    builder.body("mast")
    with pytest.raises(LidarError, match=r'belongs to no world.*Pass worlds="all"'):
        NewtonScanner(builder.model(), RING, body="mast")
    scanner = NewtonScanner(builder.model(), RING, site="lidar")
    with pytest.raises(LidarError, match="The state has 4 bodies, but the model has 5"):
        scanner.ranges(two_worlds().state())
    state = builder.state()
    state.body_q.values[2, 0] = np.nan
    with pytest.raises(LidarError, match=r"pose of body 2 \('crate'\) is not finite"):
        scanner.ranges(state)


def test_wrong_arguments():
    builder = two_worlds()
    scanner = NewtonScanner(builder.model(), RING, site="lidar")
    state = builder.state()
    for scan in (scanner.sweep, scanner.ranges, lambda states: scanner.step(0.1, states)):
        with pytest.raises(LidarError, match=r"single newton\.State, but got .*'tuple'"):
            scan((state, state))
    for time_s, kind in ((state, "SimpleNamespace"), ("0.1", "str")):
        with pytest.raises(LidarError, match=f"time in seconds.* has the type '{kind}'"):
            scanner.step(time_s, state)
    for world in (9, -1, "a", 1.5, True):
        with pytest.raises(LidarError, match=rf"No lidar belongs to the world .*{world}.*\(0, 1\)"):
            scanner.reset(world)
    scanner.reset(np.int32(1))


@pytest.fixture(scope="module")
def newton() -> Any:
    """Newton, which compiles its kernels for a minute at first: pip install newton."""
    newton = pytest.importorskip("newton", reason="Newton is not installed: pip install newton")
    import warp

    warp.config.quiet = True
    return newton


def real_shapes(newton, builder):
    """Add bodies with all shapes of Newton, and return the number of bodies."""
    import warp

    slope = np.add.outer(np.arange(4.0), np.arange(5.0))  # its diagonals do not matter
    field = newton.Heightfield(slope / 4, 4, 5, hx=1.0, hy=0.8)
    wedge = newton.Mesh(tetrahedron().vertices, tetrahedron().indices)
    builder.add_ground_plane(height=-2)
    builder.add_shape_plane(xform=transform((0, 0, 2), 0, 170), width=8, length=14)
    builder.add_shape_heightfield(
        xform=transform((-4, -3, -1), 20, 10), heightfield=field, scale=(1, 1.5, 0.7)
    )
    kinds = [
        lambda body, **to: builder.add_shape_sphere(body, radius=0.5, **to),
        lambda body, **to: builder.add_shape_capsule(body, radius=0.3, half_height=0.4, **to),
        lambda body, **to: builder.add_shape_cylinder(body, radius=0.4, half_height=0.5, **to),
        lambda body, **to: builder.add_shape_cylinder(
            body, radius=0.3, half_height=0.5, barrel_radius=1.0, **to
        ),
        lambda body, **to: builder.add_shape_cone(body, radius=0.4, half_height=0.6, **to),
        lambda body, **to: builder.add_shape_ellipsoid(body, rx=0.3, ry=0.5, rz=0.7, **to),
        lambda body, **to: builder.add_shape_box(body, hx=0.3, hy=0.4, hz=0.5, **to),
        lambda body, **to: builder.add_shape_mesh(body, mesh=wedge, scale=(1, -2, 0.5), **to),
        lambda body, **to: builder.add_shape_convex_hull(body, mesh=wedge, **to),
    ]
    for number, add in enumerate(kinds):
        angle = np.radians(35 * number)
        at = transform((4 * np.cos(angle), 4 * np.sin(angle), 0.3), 50 * number, 25)
        body = builder.add_body(xform=warp.transform(*at), label=f"body {number}")
        add(body, xform=warp.transform(*transform((0.2, 0.1, -0.1), 20, 30)))
    lidar = builder.add_body(label="lidar")
    builder.add_shape_box(lidar, hx=1, hy=1, hz=1)
    return len(kinds)


@pytest.mark.slow
def test_ranges_are_those_of_newtons_own_rays(newton):
    import warp

    builder = newton.ModelBuilder()
    kinds = real_shapes(newton, builder)
    model = builder.finalize(device="cpu")
    state = model.state()
    scanner = NewtonScanner(model, GRID, body="lidar", objects="shape")
    ranges = scanner.ranges(state)[0].reshape(-1)
    (cloud,) = scanner.sweep(state)
    assert len(np.unique(cloud.object)) == kinds + 3
    directions = GRID.directions(np.arange(360)).reshape(-1, 3).astype(np.float32)
    hidden = model.shape_label[-1]
    is_hidden = np.array([label == hidden for label in model.shape_label])
    flags = model.shape_flags.numpy()
    flags[is_hidden] = 0
    model.shape_flags.assign(flags)
    model.bvh_build_shapes(state)
    count = len(directions)
    distance = warp.zeros(count, dtype=float)
    normal = warp.zeros(count, dtype=warp.vec3)
    newton.intersect_ray(
        model,
        ray_origins=warp.zeros(count, dtype=warp.vec3),
        ray_directions=warp.array(directions, dtype=warp.vec3),
        ray_worlds=warp.full(count, -1, dtype=warp.int32),
        out_dist=distance,
        out_normal=normal,
        fast_math=False,
    )
    expected = distance.numpy().astype(np.float64)
    expected[(expected < 0) | (expected > GRID.max_range_m)] = np.inf
    assert (np.isfinite(ranges) != np.isfinite(expected)).mean() < 1e-3
    both = np.isfinite(ranges) & np.isfinite(expected)
    cosines = np.abs((normal.numpy() * directions).sum(axis=1))
    error = np.abs(ranges[both] - expected[both]) * cosines[both]
    assert both.sum() > 8000
    assert (error > 1e-3).mean() < 3e-3  # at rims, where one of the two meets what is behind
    assert np.quantile(error, 0.99) < 6e-4


@pytest.mark.slow
def test_boxes_fall_as_newton_lets_them(newton):
    """Three worlds with boxes at different heights, against free fall."""
    world = newton.ModelBuilder()
    crate = world.add_body(label="crate")
    world.add_shape_box(crate, hx=0.5, hy=0.5, hz=0.5)
    world.add_site(-1, label="lidar")
    builder = newton.ModelBuilder()
    builder.add_ground_plane(height=-1)
    builder.replicate(world, 3)
    model = builder.finalize(device="cpu")
    states = model.state(), model.state()
    heights = np.array([0.4, 0.6, 0.8])
    poses = states[0].body_q.numpy()
    poses[:, :3] = np.stack([[3.0, 3, 3], [0, 0, 0], heights], axis=1)
    states[0].body_q.assign(poses)
    solver = newton.solvers.SolverXPBD(model)
    scanner = NewtonScanner(
        model, load_sensor("velodyne/vlp16"), site="lidar", columns=["time"], precision_m=1e-5
    )
    assert scanner.worlds == (0, 1, 2)
    assert scanner.names[0] == ("ground_plane", "crate")
    step_s = 1 / 500
    clouds: list[Any] = [[], [], []]
    for step in range(60):
        for sweeps, completed in zip(clouds, scanner.step(step * step_s, states[0]), strict=True):
            sweeps += completed
        states[0].clear_forces()
        solver.step(states[0], states[1], None, None, step_s)
        states = states[::-1]
    for (cloud,), height in zip(clouds, heights, strict=True):
        x, _, z = cloud.positions[cloud.object == 1].T
        seconds = cloud.time[cloud.object == 1] / 1e9
        middle = height - 9.81 * seconds * (seconds + step_s) / 2  # of semi-implicit steps
        front = np.abs(x - 2.5) < 1e-4
        assert front.sum() > 100 and (np.abs(z - middle)[front] < 0.501).all()
        below = ~front & (z < middle)
        assert np.abs(z - middle + 0.5)[below].max(initial=0) < 1e-4
    below = [(c.object == 1) & (c.positions[:, 0] > 2.501) for (c,) in clouds]
    assert sum(rows.sum() for rows in below) > 20


@pytest.mark.slow
def test_the_example_scans_falling_boxes(newton, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    example = Path(__file__).parents[2] / "examples" / "newton_lidar.py"
    runpy.run_path(str(example), run_name="__main__")
    lines = re.findall(r"s, world (\d): 1[45],.* points, (.*) on boxes", capsys.readouterr().out)
    assert [int(world) for world, _ in lines] == [*range(8)] * 5
    assert all(int(count.replace(",", "")) > 500 for _, count in lines)
    assert (tmp_path / "boxes.ply").exists()
