"""Copies of a scenario: where they stand, what they are called, and what cannot be."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from tests.shapes import quad

from lidarfiles.identity.fingerprint import fingerprint
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenes.writers.scene_file import write_scene
from lidarsim import LidarError, Pose, Scene, SceneMesh
from lidarsim.media.materials import MaterialTable


@pytest.fixture
def folder(tmp_path):
    """Make a hill, a roof over a part of it, and a tree whose origin is the foot of its stem."""
    x, y = np.meshgrid(np.linspace(-20, 20, 21), np.linspace(-10, 10, 11))
    points = np.stack([x, y, 2 + np.sin(x / 5) + y / 10], axis=-1).reshape(-1, 3)
    corner = np.arange(10 * 21).reshape(10, 21)[:, :-1].reshape(-1, 1)
    faces = np.concatenate([corner + np.array(more) for more in ((0, 1, 22), (0, 22, 21))])
    roof = quad("Roof", (10, -10, 8), (20, -10, 8), (20, 10, 8), (10, 10, 8))
    write_scene(tmp_path / "land.glb", Scene.from_meshes([SceneMesh("Hill", points, faces), roof]))
    tree = trimesh.util.concatenate(
        trimesh.creation.cylinder(
            0.2, 2, transform=[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]]
        ),
        trimesh.creation.icosphere(subdivisions=1).apply_translation((0, 0, 3)),
    )
    (tmp_path / "tree.stl").write_bytes(tree.export(file_type="stl"))
    return tmp_path


@pytest.fixture
def made(folder):
    """Return a function that builds a scenario with entries of `copies`."""

    def make(*copies, scene=None, **others):
        data = {"scene": {"files": "land.glb", **(scene or {}), "copies": [*copies]}, **others}
        return prepare(Scenario.from_data(data, folder=folder))

    return make


def places(scene, name="Tree"):
    """World positions of the origins of copies, in order."""
    at = scene.instances
    rows = [row for row in range(len(at)) if scene.names[at.owner[row]].startswith(name)]
    return at.transforms[rows, :, 3] + scene.origin


def height(at):
    """Heights of the hill's triangles above places (n, 2)."""
    x, y = at.T
    left = np.floor(x / 2) * 2
    low, high = (2 + np.sin(side / 5) for side in (left, left + 2))
    return low + (high - low) * (x - left) / 2 + y / 10


TREE = {"name": "Tree", "file": "tree.stl"}


def test_a_list_gives_places_turns_and_factors(made):
    turned = {"position": [1, 2, 3], "yaw_deg": 30, "pitch_deg": 5, "scale": [1, 2, 0.5]}
    scene = made(TREE | {"at": [[-3, 4], [5, 6, 7], turned]}).scene
    assert scene.names == ("Hill", "Roof", "Tree", "Tree.2", "Tree.3")
    assert np.allclose(
        places(scene), [[-3, 4, height(np.array([[-3, 4]]))[0]], [5, 6, 7], [1, 2, 3]]
    )
    linear = Pose((0, 0, 0), 30, 5).rotation * [1, 2, 0.5]
    assert np.allclose(scene.instances.transforms[2, :, :3], linear)
    assert len(scene.instances.mesh_parts) == 1 and scene.triangles == 400 + 2 + 3 * 208


@pytest.mark.extended
@pytest.mark.parametrize(
    ("text", "more"),
    [
        ("x,y,z,yaw_deg,scale\n1,2,3,90,2\n4,5,6,0,1\n", {}),
        (
            "# made by hand\nname;x;y;z;yaw_deg;scale\nbig;1;2;3;90;2\n# small\nsmall;4;5;6;0;1\n",
            {"ignore": "Name"},
        ),
        (
            "east\tnorth\tz\tyaw_deg\tscale_z\tscale_x\tscale_y\n1\t2\t3\t90\t2\t2\t2\n"
            "4\t5\t6\t0\t1\t1\t1\n",
            {"columns": {"x": "east", "y": "north"}},
        ),
        ("X,Y,Z,Yaw_deg,SCALE\n1,2,3,90,2\n4,5,6,0,1\n", {}),
        ("x,y,z,Yaw,scale\n1,2,3,90,2\n4,5,6,0,1\n", {"columns": {"yaw_deg": "Yaw"}}),
    ],
    ids=["commas", "semicolons, remarks, text", "tabs, other names", "capitals", "no unit"],
)
def test_a_table_gives_what_a_list_gives(made, folder, text, more):
    (folder / "trees.csv").write_text(text)
    by_table = made(TREE | {"table": {"file": "trees.csv", **more}}).scene
    big = {"position": [1, 2, 3], "yaw_deg": 90, "scale": 2}
    by_list = made(TREE | {"at": [big, [4, 5, 6]]}).scene
    assert fingerprint(by_table) == fingerprint(by_list)


def test_a_table_without_z_stands_on_the_surface(made, folder):
    (folder / "trees.csv").write_text("x,y\n1,2\n15,5\n")
    scene = made(TREE | {"table": "trees.csv"}).scene
    assert np.allclose(places(scene)[:, 2], [height(np.array([[1, 2]]))[0], 8])


@pytest.mark.extended
def test_scattered_copies_stand_on_what_is_seen_from_above(made):
    scatter = {"count": 300, "surfaces": "Hill", "spacing_m": 0.6, "scale": [0.5, 1.5]}
    scene = made(TREE | {"scatter": scatter}).scene
    at = places(scene)
    assert len(at) == 300 and np.abs(at[:, 2] - height(at[:, :2])).max() < 1e-6
    assert at[:, 0].max() < 10, "not under the roof"
    apart = np.linalg.norm(at[:, None, :2] - at[None, :, :2], axis=2)[np.triu_indices(300, 1)]
    assert 0.6 <= apart.min() < 1
    factors = np.linalg.norm(scene.instances.transforms[:, :, :3], axis=1)
    assert 0.5 <= factors.min() < 0.6 and 1.4 < factors.max() <= 1.5
    yaw = np.arctan2(*scene.instances.transforms[:, 1::-1, 0].T)
    assert np.abs(np.histogram(yaw, 4, (-np.pi, np.pi))[0] - 75).max() < 30
    share = np.mean(at[:, 0] < -5)  # of 30 m
    assert abs(share - 0.5) < 0.1


def test_without_a_name_they_stand_on_the_highest_surface_and_stay_in_a_rectangle(made):
    scene = made(TREE | {"scatter": {"count": 100, "within": [5, -5, 15, 5], "yaw_deg": 0}}).scene
    at = places(scene)
    low = at[:, 0] < 10
    high = at[:, 0] > 10
    assert low.sum() > 20 and np.abs(at[low, 2] - height(at[low, :2])).max() < 1e-6
    assert high.sum() > 20 and np.allclose(at[high, 2], 8)
    assert np.abs(at[:, 1]).max() <= 5 and at[:, 0].min() >= 5 and at[:, 0].max() <= 15
    assert np.array_equal(scene.instances.transforms[:, :, :3], np.tile(np.eye(3), (100, 1, 1)))


def test_a_ground_without_files_carries_copies_too(made):
    scatter = {"count": 20, "within": [100, 100, 120, 110]}
    scene_of = {"files": [], "ground": {"height_m": 1.5, "margin_m": 3}}
    scene = made(TREE | {"scatter": scatter}, scene=scene_of).scene
    assert np.allclose(places(scene)[:, 2], 1.5)
    assert scene.names[-1] == "Ground"
    low, high = scene.object_bounds[-1]
    assert (low[:2] <= [97, 97]).all() and (high[:2] >= [123, 113]).all()


@pytest.mark.extended
def test_the_seed_and_the_name_choose_the_places(made):
    def at(**more):
        entry = TREE | {"name": more.pop("name", "Tree"), "scatter": {"count": 40, **more}}
        return places(made(entry).scene, entry["name"])

    first = at()
    assert np.array_equal(at(), first) and np.array_equal(at(count=60)[:40], first)
    for other in (at(seed=1), at(name="Bush")):
        assert not np.isclose(other, first)[:, :2].any()
    # Kept, so that another machine or release that draws otherwise is noticed.
    assert np.allclose(first[:2, :2], FIRST, atol=1e-8)


FIRST = [[-13.69999781, 0.4128094], [-15.08835127, 4.14431452]]


def test_materials_and_classes_are_those_of_the_names(made):
    crate = {"name": "Crate", "box": [1, 1, 1], "at": [[0, 0], [3, 0], [6, 0]], "class": 5}
    materials = [
        {"objects": "Crate.3", "reflectance": 0.4, "class": 7},
        {"objects": "Crate*", "reflectance": 0.9},
        {"objects": "*", "reflectance": 0.2, "class": 1},
    ]
    tree = TREE | {"at": [[9, 0]], "class": 6}
    built = made(crate, tree, materials=materials)
    table = MaterialTable.build(built.survey.materials, built.scene.surface_kinds)
    assert built.scene.names[2:] == ("Crate", "Crate.2", "Crate.3", "Tree")
    assert table.semantic_class.tolist() == [1, 1, 5, 5, 7, 6]
    assert table.reflectance.tolist() == [0.2, 0.2, 0.9, 0.9, 0.4, 0.2]
    built = made(crate)
    table = MaterialTable.build(built.survey.materials, built.scene.surface_kinds)
    assert table.semantic_class.tolist() == [0, 0, 5, 5, 5]


def test_a_file_is_read_once_for_all_entries(made, monkeypatch):
    from lidarscenario import static_scene as module

    read = []
    plain = module.load_objects
    monkeypatch.setattr(
        module, "load_objects", lambda path, **more: read.append(path.name) or plain(path, **more)
    )
    scene = made(TREE | {"at": [[0, 0]]}, TREE | {"name": "Bush", "at": [[5, 0]]}).scene
    assert read == ["land.glb", "tree.stl"] and len(scene.instances.mesh_parts) == 1
    assert scene.names[2:] == ("Tree", "Bush")


WRONG = {
    "neither": ({"name": "A", "at": [[0, 0]]}, "Set exactly one of file and box."),
    "no place": (TREE, "Set exactly one of at, table and scatter."),
    "two": (TREE | {"at": [[0, 0]], "table": "a.csv"}, "Set exactly one of at, table and scatter."),
    "short": (TREE | {"at": [[0]]}, "at least 2 items"),
    "outside": (
        TREE | {"at": [[0, 0], [99, 1], [99, 2]]},
        "copies[0]: There is no upward-facing surface at x 99, y 1 to place a copy on. "
        "Set the z coordinate of 2 copies.",
    ),
    "name": (TREE | {"scatter": {"count": 1, "surfaces": "Hil"}}, "'Hil', but no object has"),
    "ordered": (
        TREE | {"scatter": {"count": 1, "within": [5, 0, 4, 1]}},
        "with the lower corner first",
    ),
    "full": (
        TREE | {"scatter": {"count": 9, "spacing_m": 25}},
        "of 9 copies fit on * within x -20 to 20, y -10 to 10. Reduce",
    ),
    "no file": (TREE | {"table": "none.csv"}, "none.csv does not exist."),
    "no column": (TREE | {"table": "a.csv"}, "it has no column 'y'. Its columns are x, z"),
    "nan": (
        TREE | {"table": {"file": "a.csv", "columns": {"y": "z"}}},
        "its column 'z' contains 'nan' in line 2. Each row must have a number in this column.",
    ),
    "some heights": (
        TREE | {"table": "some.csv"},
        ("its column 'z' contains '' in line 5. Each row must have a number in this column. "
         "Correct the value, or ignore the column."),
    ),
    "angle": (
        TREE | {"table": "yaw.csv"},
        ("column 'yaw' has no unit. Rename it to yaw_deg (degrees) or yaw_rad, or set "
         "`columns: {yaw_deg: yaw}`"),
    ),
    "mesh": ({"name": "A", "file": "b.stl", "at": [[0, 0]]}, "b.stl"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_is_told_in_a_line(made, folder, name, monkeypatch):
    monkeypatch.setattr("lidarscenario.static_scene.MAX_DRAWS", 0)
    entry, says = WRONG[name]
    (folder / "a.csv").write_text("x,z\n1,nan\n")
    (folder / "some.csv").write_text("x,y,z\n# first\n1,2,3\n\n4,5,\n")
    (folder / "yaw.csv").write_text("x,y,yaw\n1,2,90\n")
    with pytest.raises(LidarError) as raised:
        made(entry)
    assert says in str(raised.value) and len(str(raised.value).splitlines()) == 1


def test_nothing_to_stand_on(made):
    with pytest.raises(LidarError, match=r"no surface to place objects on\. Add `scene\.files`"):
        made(TREE | {"scatter": {"count": 1}}, scene={"files": []})
    with pytest.raises(LidarError, match="Set the z coordinate of 1 copy"):
        made(TREE | {"at": [[0, 0]]}, scene={"files": []})
