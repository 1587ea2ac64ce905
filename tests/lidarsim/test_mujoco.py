"""Lidars in worlds of MuJoCo, against MuJoCo's own rays."""

from __future__ import annotations

import numpy as np
import pytest

from lidarsim import LidarError, Material, Mounted, MujocoScanner, Pose, Sensor, load_sensor

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install mujoco")

VLP16 = load_sensor("velodyne/vlp16")
CENTERED = Sensor.grid(1800, 16, vertical_fov_deg=30, max_range_m=130)  # beams start at a point

GRID = Sensor.grid(rays_per_revolution=360, layers=16, step_deg=30, max_range_m=60)
GROUPS = np.array([1, 1, 1, 0, 0, 0], np.uint8)
WORLD = """
<mujoco>
  <asset>
    <hfield name="hills" nrow="15" ncol="17" size="3 2 1 0.3"/>
    <mesh name="wedge" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/>
    <texture name="gray" type="2d" builtin="flat" rgb1=".5 .5 .5" width="4" height="4"/>
    <material name="paint" texture="gray" rgba="1 .5 0 1"/>
    <material name="glass" rgba="1 1 1 0"/>
  </asset>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 .1"/>
    <geom name="board" type="plane" size="1 .5 .1" pos="-4 0 1" euler="0 80 0"/>
    <geom name="terrain" type="hfield" hfield="hills" pos="6 0 0" euler="3 4 30"/>
    <body name="robot" pos="0 0 1">
      <freejoint/>
      <geom name="trunk" type="box" size=".1 .2 .3"/>
      <site name="lidar" pos="0 0 .4" euler="0 3 20"/>
      <body name="arm" pos=".5 0 .3"><joint name="arm" type="hinge"/>
        <geom name="hand" type="box" size=".05 .1 .02"/>
      </body>
    </body>
    <body name="ball" pos="2 0 1"><freejoint/><geom type="sphere" size=".4"/></body>
    <body name="pill" pos="0 2 1" euler="20 40 0"><freejoint/>
      <geom type="capsule" size=".2 .5" material="paint"/>
    </body>
    <body name="can" pos="0 -2 1" euler="20 40 0"><freejoint/>
      <geom type="cylinder" size=".2 .5"/>
    </body>
    <body name="egg" pos="-2 0 1" euler="20 40 0"><freejoint/>
      <geom type="ellipsoid" size=".2 .5 .9"/>
    </body>
    <body name="wedge" pos="-2 -2 1" euler="20 40 0"><freejoint/>
      <geom type="mesh" mesh="wedge"/>
    </body>
    <body name="double" pos="1 1 1"><freejoint/>
      <geom name="hull" type="box" size=".3 .2 .3" group="3"/>
      <geom name="pane" type="box" size=".3 .2 .3" material="glass"/>
    </body>
    <body name="hoist" mocap="true" pos="2 -2 1"><geom type="box" size=".3 .2 .5"/></body>
    <body name="shelf" pos="3 3 0" euler="10 20 30">
      <body name="plank" pos=".2 .1 0" euler="5 5 5"><geom type="box" size=".1 .2 .9"/></body>
    </body>
  </worldbody>
</mujoco>
"""
TYPES = {
    1e-5: (0, 1, 6, 7),  # planes, height fields, boxes, meshes: meters along the ray
    1e-3: (2, 3, 4, 5),  # round: meters along the normal
}


@pytest.fixture
def world():
    model = mujoco.MjModel.from_xml_string(WORLD)
    model.hfield_data[:] = np.random.default_rng(0).uniform(0, 1, model.nhfielddata)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def shuffle(model, data, seed):
    """Move all bodies somewhat, the mocap body as well."""
    rng = np.random.default_rng(seed)
    data.mocap_pos += rng.uniform(-0.3, 0.3, data.mocap_pos.shape)
    mujoco.mj_integratePos(model, data.qpos, rng.uniform(-1, 1, model.nv), 0.2)
    mujoco.mj_forward(model, data)


def rays_of(model, data, sensor, firings):
    """Distances, geoms and cosines of MuJoCo's rays from the site, as the sensor fires them."""
    site = model.site("lidar").id
    directions = sensor.directions(np.arange(firings)).reshape(-1, 3)
    directions = directions @ data.site_xmat[site].reshape(3, 3).T
    count = len(directions)
    geom = np.zeros(count, np.int32)
    distance = np.zeros(count)
    normal = np.zeros(3 * count)
    mujoco.mj_multiRay(
        model, data, data.site_xpos[site].copy(), directions.ravel().copy(), GROUPS, True,
        model.site_bodyid[site], geom, distance, normal, count, 1e6,
    )  # fmt: skip
    distance[(distance < 0) | (distance > sensor.max_range_m)] = np.inf
    cosines = np.abs((normal.reshape(-1, 3) * directions).sum(axis=1))
    return distance, np.where(np.isfinite(distance), geom, -1), cosines


@pytest.mark.skipif(
    "normal" not in mujoco.mj_multiRay.__doc__, reason="rays of this MuJoCo have no normals"
)
@pytest.mark.parametrize("objects", ["body", "geom"])
def test_ranges_are_those_of_mujoco(world, objects):
    model, data = world
    scanner = MujocoScanner(model, CENTERED, site="lidar", objects=objects)
    seen = set()
    for seed in range(3):
        shuffle(model, data, seed)
        image = scanner.ranges(data)
        distance, geom, cosines = rays_of(model, data, CENTERED, len(image))
        ranges = image.reshape(-1)
        assert (
            np.isfinite(ranges) != np.isfinite(distance)
        ).mean() < 1e-4  # at rims of round geoms
        both = np.isfinite(ranges) & np.isfinite(distance)
        is_round = np.isin(model.geom_type[geom], TYPES[1e-3])
        error = np.full(len(ranges), np.nan)
        error[both] = np.abs(ranges[both] - distance[both]) * np.where(is_round, cosines, 1)[both]
        for limit_m, types in TYPES.items():
            of_types = both & np.isin(model.geom_type[geom], types)
            # Of few rays past a rim, one of the two meets what is behind.
            assert of_types.sum() > 300 and np.quantile(error[of_types], 0.995) <= limit_m
        assert (error[both] > 1e-3).mean() < 1e-3
        seen |= {*geom.tolist()}
    assert seen >= {0, 1, 2} and len(seen) >= 10
    assert model.geom("trunk").id not in seen and model.geom("hull").id not in seen


def test_objects_are_bodies_or_geoms_and_keep_their_materials(world):
    model, data = world
    materials = [Material("*", material="paint", reflectance=0.25), Material("*", reflectance=0.5)]
    options = {"columns": ["intensity", "material", "red"], "materials": materials}
    scanner = MujocoScanner(model, VLP16, site="lidar", **options)
    cloud = scanner.sweep(data)
    visible = {scanner.names[number] for number in np.unique(cloud.object)}
    assert visible >= {"world", "ball", "pill", "can", "egg", "wedge", "hoist", "plank"}
    assert "robot" not in visible and "double" not in visible
    on_pill = cloud.object == scanner.names.index("pill")
    assert len({*cloud.material[on_pill].tolist()} | {*cloud.material[~on_pill].tolist()}) == 2
    assert {"floor", "board"} <= {*MujocoScanner(model, GRID, site="lidar", objects="geom").names}
    with_hull = MujocoScanner(model, VLP16, site="lidar", groups=(0, 3), exclude=["ball", "floor"])
    assert "double" in with_hull.names and "ball" not in with_hull.names


def test_beams_leave_while_the_world_moves(world):
    """A lidar that turns on a body, and a ball that falls freely."""
    model, data = world
    scanner = MujocoScanner(model, VLP16, body="robot", columns=["time"], precision_m=1e-5)
    data.joint("arm").qvel = 3
    times = []
    heights = []
    clouds = []
    for _ in range(int(0.25 / model.opt.timestep)):
        mujoco.mj_step(model, data)
        times.append(data.time)
        heights.append(data.body("ball").xpos[2])
        clouds += scanner.step(data)
    assert len(clouds) == 2
    for cloud in clouds:
        on_ball = cloud.object == scanner.names.index("ball")
        assert on_ball.sum() > 20
        height = np.interp(cloud.time[on_ball] / 1e9 + times[0], times, heights)
        centers = np.column_stack([np.full(len(height), 2.0), np.zeros(len(height)), height])
        radius = np.linalg.norm(cloud.positions[on_ball] - centers, axis=1)
        assert np.abs(radius - 0.4).max() < 1e-3
    mujoco.mj_resetData(model, data)
    mujoco.mj_forward(model, data)
    assert scanner.step(data) == []


def test_many_lidars_take_one_call(world):
    model, data = world
    scanner = MujocoScanner(model, Mounted(GRID, Pose((0, 0, 0.6))), body=["robot", "ball"])
    images = scanner.ranges(data)
    assert images.shape == (2, 360, 16)
    alone = MujocoScanner(model, Mounted(GRID, Pose((0, 0, 0.6))), body="robot", exclude=["ball"])
    assert np.array_equal(alone.ranges(data), images[0])
    with pytest.raises(LidarError, match="There are 2 lidars"):
        scanner.sweep(data)
    with pytest.raises(LidarError, match=r"Expected an mjData, but got .*'tuple'"):
        alone.step((data, data))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "body=NAME or site=NAME"),
        ({"site": "lidar", "body": "robot"}, "either the body or the site .* but not both"),
        ({"site": "lidr"}, "no site 'lidr'. Did you mean 'lidar'"),
        ({"body": 99}, "no body 99"),
        ({"site": "lidar", "exclude": ["bal"]}, "no body or geom 'bal'. Did you mean 'ball'"),
        ({"site": "lidar", "groups": [5]}, r"belongs to the groups \(5,\)"),
        ({"site": "lidar", "objects": "part"}, "objects must be .* but is 'part'"),
        ({"site": "lidar", "sag_m": 0}, "sag_m must be greater than 0, but is 0"),
    ],
)
def test_wrong_options(world, options, message):
    with pytest.raises(LidarError, match=message):
        MujocoScanner(world[0], GRID, **options)
