"""A scene keeps every triangle, name and digit of the meshes it is made of."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidarscenario.advice import advice
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarsim import LidarError, Scene, SceneMesh
from lidarsim.scene.object_names import unique_names
from lidarsim.scene.transform import UP_AXES, Transform

FACES = np.array([[0, 1, 2]])


def triangle(name="T", at=(0.0, 0.0, 0.0)):
    return SceneMesh(name, np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]) + np.array(at), FACES)


def world(scene):
    return scene.vertices[scene.faces] + scene.origin


@pytest.mark.extended
@given(
    st.tuples(*[st.floats(-6e6, 6e6)] * 3),
    st.lists(st.tuples(*[st.floats(-500, 500)] * 3), min_size=1, max_size=5),
)
def test_world_coordinates_come_back(center, offsets):
    given = [triangle(at=np.add(center, offset)) for offset in offsets]
    scene = Scene.from_meshes(given)
    expected = np.concatenate([mesh.vertices[mesh.faces] for mesh in given])
    np.testing.assert_allclose(world(scene), expected, rtol=0, atol=2e-9)
    np.testing.assert_array_equal(scene.origin, np.round(scene.origin))
    if np.abs(center).max() > 11_000:
        assert np.abs(scene.vertices).max() < 1001
    elif np.abs(center).max() < 9_000:
        assert not scene.origin.any()


@pytest.mark.extended
@given(st.lists(st.sampled_from(["a", "b", "a.2", "a.3", "b.2.2"]), max_size=12))
def test_unique_names(names):
    unique = unique_names(names)
    assert len(set(unique)) == len(names)
    for position, (name, plain) in enumerate(zip(unique, names, strict=True)):
        if plain not in names[:position]:
            assert name == plain
        else:
            assert name.startswith(f"{plain}.")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"faces": np.empty((0, 3), int)}, "must have the shape .f, 3."),
        ({"faces": [[0, 1, 3]]}, "refer to the 3 vertices"),
        ({"faces": [[0, 1, -1]]}, "refer to the 3 vertices"),
        ({"vertices": [[0, 0, 0], [1, 0, 0], [0, np.nan, 0]]}, "1 of the 3 vertices"),
        ({"vertices": np.zeros((3, 2))}, r"the shape \(v, 3\)"),
        ({"face_object": [1]}, "face_object"),
        ({"face_object": [0, 0]}, "face_object"),
        ({"origin": [0, 0, np.inf]}, "origin"),
        ({"origin": [0, 0]}, "origin"),
    ],
)
def test_scenes_that_do_not_fit_together(change, message):
    good = {
        "vertices": np.eye(3),
        "faces": [[0, 1, 2]],
        "face_object": [0],
        "names": ("T",),
        "origin": np.zeros(3),
    }
    Scene(**good)
    with pytest.raises(LidarError, match=message):
        Scene(**(good | change))


@pytest.mark.parametrize("axis", "xyz")
def test_the_up_axis_becomes_z(axis):
    matrix = UP_AXES[axis]
    np.testing.assert_array_equal(matrix @ np.eye(3)["xyz".index(axis)], [0, 0, 1])
    assert np.linalg.det(matrix) == 1


def test_scale_then_x_then_y_then_z_then_translation():
    placed = Transform.from_parts((10, 20, 30), (90, 0, 90), (2, 3, 4))
    # x: scaled to 2, stays under the turn about x, goes to y under the turn about z.
    np.testing.assert_allclose(placed.linear.T, [[0, 2, 0], [0, 0, 3], [4, 0, 0]], atol=1e-12)
    assert placed.offset.tolist() == [10, 20, 30]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Transform.from_parts(scale=0), "flattens"),
        (lambda: Transform.from_parts((0, 0, np.nan)), "finite"),
        (lambda: Transform.from_matrix(np.eye(3)), "four rows"),
        (lambda: Transform.from_matrix(np.full((4, 4), 1.0)), "0 0 0 1 as the last row"),
        (lambda: Transform(np.eye(2), np.zeros(3)), r"\(2, 2\)"),
    ],
)
def test_no_placements(make, message):
    with pytest.raises(LidarError, match=message):
        make()


VERTICES = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
TWICE = VERTICES + "o Wall\nf 1 2 3\no Door\nf 1 2 3\no Wall\nf 1 2 3\nf 1 3 2\n"


def face_counts(scene):
    counts = np.bincount(scene.face_object, minlength=len(scene.names))
    return dict(zip(scene.names, counts.tolist(), strict=True))


def test_objects_of_one_name_are_told_apart_with_a_note_or_joined(tmp_path, caplog):
    path = tmp_path / "a.obj"
    path.write_text(TWICE)
    assert face_counts(Scene.load(path)) == {"Wall": 1, "Door": 1, "Wall.2": 2}
    (note,) = [line for line in caplog.messages if "a duplicate name" in line]
    assert note.startswith(f"{path}: 1 object with a duplicate name has a number appended: Wall.2")
    assert 'Scene.load(path, same_names="join")' in note
    caplog.clear()
    assert face_counts(Scene.load(path, same_names="join")) == {"Wall": 3, "Door": 1}
    assert not [line for line in caplog.messages if "a duplicate name" in line]


def test_a_group_that_comes_again_continues(tmp_path, caplog):
    path = tmp_path / "a.obj"
    path.write_text(TWICE.replace("o ", "g "))
    assert face_counts(Scene.load(path)) == {"Wall": 3, "Door": 1}
    assert "another one" not in caplog.text


@pytest.mark.parametrize(
    ("same_names", "counts"),
    [
        (None, {"Wall": 1, "Door": 1, "Wall.2": 2, "Wall.3": 1}),
        ("number", {"Wall": 1, "Door": 1, "Wall.2": 2, "Wall.3": 1}),
        ("join", {"Wall": 4, "Door": 1}),
    ],
)
def test_equal_names_of_the_files_of_a_scenario(tmp_path, same_names, counts):
    (tmp_path / "a.obj").write_text(TWICE)
    (tmp_path / "b.obj").write_text(VERTICES + "o Wall\nf 1 2 3\n")
    section = {"files": ["a.obj", "b.obj"]}
    if same_names:
        section["same_names"] = same_names
    built = prepare(Scenario.from_data({"scene": section, "poses": [[0, 0, 1]]}, folder=tmp_path))
    assert face_counts(built.scene) == counts
    notes = [note for note in advice(built) if "a duplicate name" in note]
    assert len(notes) == (same_names != "join")
    if notes:
        assert (
            "Wall.2, Wall.3. To merge objects with the same name, use same_names: join in scene"
        ) in notes[0]
