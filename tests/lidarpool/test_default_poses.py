"""Default poses: on the floor of a place, around an object."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from click.testing import CliRunner
from tests.shapes import block, level, quad, wall
from trimesh import creation

from lidarpool.cli.commands import cli
from lidarscenario.advice import advice
from lidarscenario.default_poses import place_sensor, poses_around
from lidarscenario.plausibility import plausibility_warnings
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenes.procedural.city import city
from lidarscenes.procedural.floor import floor_and_ceiling
from lidarscenes.procedural.plants import SPECIES, tree
from lidarscenes.procedural.surroundings import PlacementChecker, is_obstructed
from lidarscenes.procedural.terrain import terrain
from lidarscenes.writers.scene_file import write_scene
from lidarsim import Mounted, Scene, SceneInstance, SceneMesh, Sensor, Survey, load_sensor
from lidarsim.scene.transform import Transform
from lidarsim.simulator.rig import Rig

GRID = Mounted(Sensor.grid())


def scene_of(*meshes, at=(0.0, 0.0, 0.0)):
    return Scene.from_meshes(
        SceneMesh(f"mesh{i}", mesh.vertices + at, mesh.faces) for i, mesh in enumerate(meshes)
    )


def inverted(mesh):
    mesh.invert()
    return mesh


OBJECTS = {
    "ball": (creation.icosphere(3, 0.5),),
    "large ball": (creation.icosphere(3, 5.0),),
    "casing": (creation.box((0.8, 0.6, 0.5)), inverted(creation.box((0.7, 0.5, 0.4)))),
    "round casing": (creation.icosphere(3, 4.0), inverted(creation.icosphere(3, 3.8))),
    "torus": (creation.torus(1, 0.3),),
    "capsule": (creation.capsule(12, 2.5),),
    "machine with an opening": (creation.torus(6, 4.5), creation.icosphere(3, 2.0)),
}


@pytest.mark.extended(every=3)
@pytest.mark.parametrize(
    ("name", "far"), [*((name, 0.0) for name in OBJECTS), ("casing", 4_000_000.0)]
)
def test_an_object_is_seen_from_around_it_and_only_from_outside(name, far):
    scene = scene_of(*OBJECTS[name], at=(far, far, 0))
    placed = place_sensor(scene, GRID)
    assert (
        placed.surrounds_object
        and "was recognized as an object" in placed.note
        and len(placed.poses) == 5
    )
    poses = [np.subtract(pose.position, scene.origin) for pose in placed.poses]
    middle = scene.bounds.mean(axis=0)
    sides = np.ptp(scene.bounds, axis=0)
    far_m = np.linalg.norm(poses - middle, axis=1)
    np.testing.assert_allclose(far_m, 1.5 * np.linalg.norm(sides), rtol=0.01)
    local = [
        replace(pose, position=tuple(at)) for pose, at in zip(placed.poses, poses, strict=True)
    ]
    rig = Rig(scene, Survey(Sensor.grid(), local), "auto")
    points = []
    for number in range(5):
        returns = list(rig.cast(36 * number, 36 * (number + 1)))
        assert sum(map(len, returns)) > 100, "each pose sees the object"
        points += [one.positions for one in returns]
    low = np.concatenate(points).min(axis=0)
    high = np.concatenate(points).max(axis=0)
    # No pose sees the underside.
    assert ((high - low)[:2] > 0.9 * sides[:2]).all()
    assert high[2] > scene.bounds[1, 2] - 0.1 * sides[2]
    assert not PlacementChecker(scene).cast_around(poses).back.any()


LONG = creation.cylinder(0.01, 6.0)
LONG.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))


@pytest.mark.extended
@pytest.mark.parametrize(
    ("mesh", "points", "rays"),
    [
        (creation.torus(1, 0.3), 100_000, 300_000),
        (creation.box((2, 1.2, 0.005)), 100_000, 300_000),
        pytest.param(LONG, 40_000, 5_000_000, marks=pytest.mark.slow),
    ],
    ids=["torus", "plate", "rod"],
)
def test_the_default_grid_is_narrowed_to_an_object(tmp_path, mesh, points, rays):
    mesh.export(tmp_path / "a.stl")
    built = prepare(Scenario.load(tmp_path / "a.stl"))
    survey = built.survey
    assert 0.6 * rays < survey.ray_count <= rays
    rig = Rig(built.scene, survey, "auto")
    hits = [sum(map(len, rig.cast(36 * n, 36 * (n + 1)))) for n in range(5)]
    assert sum(hits) == pytest.approx(points, rel=0.2)
    note, poses = advice(built)[-2:]
    assert "The default sensor is a grid of" in note
    assert yaml.safe_load(poses.partition("default poses are ")[2]) == built.placement.entries
    # The whole object is seen: no pose sees more of it without the narrow field of view.
    grid = built.placement.grid
    wide = {"vertical_fov_deg": 90, "horizontal_fov_deg": 90}
    share = {name: 90 / grid[name] for name in wide}
    counts = {
        "layers": int(grid["layers"] * share["vertical_fov_deg"]),
        "rays_per_revolution": int(grid["rays_per_revolution"] * share["horizontal_fov_deg"]),
    }
    rig = Rig(built.scene, replace(survey, sensor=Sensor.grid(**wide, **counts)), "auto")
    seen = sum(map(len, rig.cast(0, 180)))
    assert seen == pytest.approx(sum(hits), rel=0.1)


def test_a_sensor_of_the_users_stays_as_it_is(tmp_path):
    creation.torus(1, 0.3).export(tmp_path / "a.stl")
    for data in ({"sensor": {"layers": 40}}, {"mount": {"pitch_deg": 5}}):
        scenario = Scenario.from_data({"scene": "a.stl", **data}, folder=tmp_path)
        built = prepare(scenario)
        assert built.placement.surrounds_object and not built.placement.grid
        assert built.survey.ray_count == 200_000


BOX = (8, 6, 2.5)
PLACES = {
    "room": lambda: scene_of(inverted(creation.box(BOX))),
    "room with walls of some thickness": lambda: scene_of(
        creation.box((8.6, 6.6, 3.1)), inverted(creation.box(BOX))
    ),
    "box hall": lambda: scene_of(creation.box(BOX)),
    "ground": lambda: terrain(20_000, 0, 100.0),
    "ground that faces down": lambda: flipped(terrain(20_000, 0, 100.0)),
    "ground of some thickness": lambda: thick(terrain(20_000, 0, 100.0)),
    "large ground": lambda: terrain(300_000, 0, 1000.0),
    "city": lambda: city(20_000, 0),
    "another city": lambda: city(20_000, 7),
    "things on a slab": lambda: scene_of(
        creation.box((30, 20, 0.3)), creation.box((1, 1, 2)).apply_translation([5, 3, 1.15])
    ),
}


def thick(scene):
    """Ground as the top of a closed body, 0.3 m thick."""
    ground = trimesh.Trimesh(scene.vertices, scene.faces, process=False)
    edges, count = np.unique(ground.edges_sorted, axis=0, return_counts=True)
    known = {tuple(edge) for edge in edges[count == 1]}
    rim = np.array([edge for edge in ground.edges if tuple(sorted(edge)) in known])
    below = scene.vertices - [0, 0, 0.3]
    a, b = rim.T
    c, d = rim.T + len(below)
    walls = np.vstack([np.c_[b, a, c], np.c_[b, c, d]])
    faces = np.vstack([scene.faces, walls, scene.faces[:, ::-1] + len(below)])
    return scene_of(trimesh.Trimesh(np.vstack([scene.vertices, below]), faces, process=False))


def flipped(scene):
    return Scene(scene.vertices, scene.faces[:, ::-1], scene.face_object, scene.names, scene.origin)


@pytest.mark.extended
@pytest.mark.parametrize("name", PLACES)
def test_in_a_place_the_sensor_stands_in_the_middle(name):
    scene = PLACES[name]()
    placed = place_sensor(scene, GRID)
    assert len(placed.poses) == 3 and not placed.surrounds_object
    middle = (scene.bounds + scene.origin).mean(axis=0)
    assert all(pose.position[:2] == pytest.approx(middle[:2]) for pose in placed.poses)
    assert ("only the back faces" in placed.note) == (name == "box hall")


@pytest.mark.extended
@pytest.mark.parametrize("species", SPECIES, ids=lambda species: species.name)
def test_a_tree_is_an_object_and_on_ground_the_sensor_stands_beside_it(species):
    alone = tree(species)
    assert place_sensor(Scene.from_meshes([alone]), GRID).surrounds_object
    lawn = level("lawn", 0, 20)
    for far in (0.0, 4_000_000.0):
        meshes = [
            mesh.affine_transform(mesh.name, np.eye(3), np.full(3, far)) for mesh in (lawn, alone)
        ]
        scene = Scene.from_meshes(meshes)
        placed = place_sensor(scene, GRID)
        at = np.array([pose.position for pose in placed.poses]) - scene.origin
        assert not placed.surrounds_object and not placed.note
        assert not is_obstructed(scene, at)
        assert 1.9 < np.linalg.norm(at[0, :2] + scene.origin[:2] - far) < 8.1
        assert at[:, 2] + scene.origin[2] - far == pytest.approx([1, 2, 3])
    middle = np.array([[0, 0, 1.0]]) + far - scene.origin
    assert is_obstructed(scene, middle)


def test_a_narrow_sensor_is_farther_away_and_tilted():
    scene = scene_of(creation.icosphere(3, 0.5))
    carried = Mounted(load_sensor("velodyne/vlp32c"))  # from -25 to 15 degrees
    for pose in poses_around(scene, carried):
        towards = scene.vertices - pose.position
        x, _, z = (towards / np.linalg.norm(towards, axis=1, keepdims=True) @ pose.rotation).T
        assert (x > 0).all()
        elevations = np.degrees(np.arcsin(z))
        assert elevations.min() > -25 and elevations.max() < 15
    ship = scene_of(creation.box((90, 14, 20)))
    short = Mounted(load_sensor("ouster/os0-32"))
    far = [np.linalg.norm(pose.position) for pose in poses_around(ship, short)]
    assert min(far) > 56 and max(far) < short.sensor.max_range_m


def test_poses_within_a_closed_body_are_told_of_with_some_that_see_it(tmp_path):
    (tmp_path / "b.stl").write_bytes(creation.icosphere(3, 5.0).export(file_type="stl"))
    data = {"scene": {"files": ["b.stl"]}, "poses": [[0, 0, 0]]}
    given = Scenario.from_data(data, folder=tmp_path)
    [warning] = plausibility_warnings(prepare(given))
    assert "only the back faces of surfaces" in warning
    assert "To view the scene from outside, use poses: [{position: [" in warning
    data["poses"] = [[0, 0, 9]]
    assert plausibility_warnings(prepare(Scenario.from_data(data, folder=tmp_path))) == []


@pytest.mark.parametrize("far", [0.2, 5.0])
def test_a_card_seen_from_behind_is_no_body(far):
    fence = Scene.from_meshes([wall("Fence", 0, (-5, 5), (0, 2))])
    surroundings = PlacementChecker(fence)
    views = surroundings.cast_around([[-far, 0, 1]])
    assert views.back[views.hit].all() and views.hit.any()
    assert not surroundings.is_inside_body([-far, 0, 1])


@pytest.mark.parametrize(
    ("file", "length", "noted"),
    [
        ("screw.stl", 13.0, True),
        ("screw.stl", 4.0, False),
        ("screw.stl", 0.05, False),
        ("engine.glb", 700.0, True),  # of an exporter that writes millimeters
        ("engine.glb", 40.0, False),
    ],
)
def test_the_unit_of_a_long_object_is_asked_for(tmp_path, file, length, noted):
    capsule = creation.capsule(length * 0.8, length * 0.1)
    (tmp_path / file).write_bytes(capsule.export(file_type=file[-3:]))
    built = prepare(Scenario.load(tmp_path / file))
    notes = " ".join(advice(built))
    assert "was recognized as an object" in notes and ("possibly mm), or pass" in notes) == noted


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_files_of_our_own_need_no_unit_and_no_axes(tmp_path, suffix):
    scene = terrain(2_000, 0, 1000.0)
    write_scene(tmp_path / f"own{suffix}", scene)
    read = Scenario.load(tmp_path / f"own{suffix}")
    assert [note for note in advice(prepare(read)) if "default poses" not in note] == []


def test_default_poses_are_listed_to_the_millimeter(tmp_path):
    hall = creation.box((8, 6, 3))
    hall.apply_translation((1 / 3, 0, 1.5 + 1 / 7))
    (tmp_path / "hall.stl").write_bytes(hall.export(file_type="stl"))
    scenario = Scenario.load(tmp_path / "hall.stl")
    poses = [[0.333, 0.0, 0.893], [0.333, 0.0, 1.643], [0.333, 0.0, 2.393]]
    built = prepare(scenario)
    assert advice(built)[-1] == f"no poses are set, so the default poses are {poses}"
    assert built.placement.entries == poses
    assert init_poses(tmp_path) == poses


def init_poses(folder: Path) -> list[list[float]]:
    mesh = str(folder / "hall.stl")
    outcome = CliRunner().invoke(cli, ["init", str(folder / "new"), "--mesh", mesh])
    assert outcome.exit_code == 0
    return yaml.safe_load((folder / "new" / "scenario.yaml").read_text())["poses"]


CHECK = """
import re
from pathlib import Path
from lidarpool.cli.commands import main
try:
    main(["check", "forest.glb", "--out", "out"])
finally:
    print(re.search(r"VmHWM:\\s*(\\d+)", Path("/proc/self/status").read_text())[1])
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
def test_looking_around_in_a_forest_takes_little_memory():
    """300 trees of 50,000 leaves: all triangles that pictures show took over a gigabyte."""
    rng = np.random.default_rng(0)
    leaves = rng.normal(size=(50_000, 1, 3)) + 0.05 * rng.normal(size=(50_000, 3, 3))
    tree = SceneMesh("Tree", leaves.reshape(-1, 3), np.arange(150_000).reshape(-1, 3))
    at = [(np.eye(3), np.array([8.0 * (k % 32), 8.0 * (k // 32), 0])) for k in range(300)]
    forest = [SceneInstance(tree, Transform(*each), f"Tree {k}") for k, each in enumerate(at)]
    write_scene(Path("forest.glb"), Scene.from_meshes(forest))
    run = subprocess.run([sys.executable, "-c", CHECK], capture_output=True, text=True, check=True)
    *told, peak = run.stdout.splitlines()
    assert "300 of them instances of 1 mesh, 15,000,000 triangles" in told[1]
    assert int(peak) < 400_000  # kB


def boxes(*sizes_and_heights):
    """Boxes, each of a size and with its middle at a height, over (0, 0)."""
    return Scene.from_meshes(block("box", size, (0, 0, z)) for size, z in sizes_and_heights)


def test_on_the_ground_of_a_terrain():
    scene = terrain(2000, 3, 100)
    floor = floor_and_ceiling(scene, 0, 0)[0]
    assert floor > scene.bounds[0, 2] + 0.1
    nearest = np.hypot(*scene.vertices[:, :2].T).argmin()
    assert floor == pytest.approx(scene.vertices[nearest, 2], abs=5)
    # Half of its triangles face down, as surfels of a cloud do.
    mixed = np.concatenate([scene.faces[::2], scene.faces[1::2, ::-1]])
    assert not place_sensor(
        Scene.from_meshes([SceneMesh("m", scene.vertices, mixed)]), GRID
    ).surrounds_object


def test_on_a_slab_and_not_on_the_roof():
    floor_and_roof = boxes(((8, 6, 0.2), -0.1), ((8, 6, 0.2), 3))
    assert floor_and_ceiling(floor_and_roof, 0, 0)[0] == pytest.approx(0)


def test_the_ceiling_is_above_the_furniture():
    room = (((8, 6, 0.2), -0.1), ((1, 1, 0.1), 0.75), ((8, 6, 0.2), 2.6), ((8, 6, 0.2), 5.6))
    assert floor_and_ceiling(boxes(*room), 0, 0) == pytest.approx((0, 2.5))
    assert floor_and_ceiling(boxes(*room[:2]), 0, 0) == (pytest.approx(0), np.inf)


def test_within_a_hall_that_is_one_box():
    assert floor_and_ceiling(boxes(((8, 6, 3), 1.5)), 0, 0)[0] == 0


def test_in_world_coordinates():
    shift = np.array([500_000.0, 4_000_000.0, 20_000.0])
    ground = np.array([[-9, -9, 0], [9, -9, 0], [9, 9, 3.6], [-9, 9, 3.6]])
    scene = Scene.from_meshes([quad("g", *(ground + shift))])
    assert floor_and_ceiling(scene, 500_001, 4_000_000)[0] == pytest.approx(20_001.8)
    assert floor_and_ceiling(scene, 500_001, 4_000_005)[0] == pytest.approx(20_002.8)
