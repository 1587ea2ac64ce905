"""A finished result on a page: its scene, sensors, rays and planning; nobody looks yet."""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from lidarpool import Planning, Scene
from lidarpool.columns.table import CHANNEL, OBJECT, SCAN
from lidarpool.export.ply_format import header, row_type
from lidarpool.live.display import POSITION
from lidarpool.live.mesh_node import NEW_SHAPE_S, MeshNode
from lidarpool.live.page import live_page
from lidarpool.live.result_file import ResultFile
from lidarpool.live.result_page import ResultView
from lidarpool.plan import Plan
from lidarpool.run.picture_file import Pictured

POSES, STEPS = 25, 4


@pytest.fixture(scope="module")
def pictured():
    """Return a room with a roof, 6 by 8 by 3 metres, far from zero, scanned from 25 poses."""
    corners = np.array([(x, y, z) for x in (0, 6) for y in (0, 8) for z in (0, 3)], float)
    faces = [
        (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
        (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
    ]  # fmt: skip
    origin = np.array([500_000.0, 100.0, 0.0])
    scene = Scene(corners, np.int32(faces), np.zeros(12, np.int32), ("room",), origin)
    poses = np.column_stack([np.full(POSES, 3.0), np.linspace(1, 7, POSES), np.ones(POSES)])
    rays = np.stack([np.repeat(poses[:1], 9, axis=0), np.full((9, 3), 2.9)], axis=1)
    path = np.array([[1.0, 1.0], [5.0, 7.0]])
    return Pictured(
        scene,
        poses + origin,
        np.arange(12),
        rays.astype(np.float32),
        Planning((1, 1), (5, 7), [(1, 6)], 0.5),
        Plan(path, 7.2, 7.2, 1.0, 0, 1),
        (),
    )


@pytest.fixture
def folder(tmp_path, pictured):
    """Return the folder of a result: 10,000 points on the room's walls and ceiling."""
    random = np.random.default_rng(0)
    local = random.uniform((0, 0, 0), (6, 8, 3), (10_000, 3))
    local[::2, 0], local[1::2, 2] = 0.0, 3.0
    row = row_type(np.dtype(np.float64), (SCAN, CHANNEL, OBJECT))
    rows = np.zeros(10_000, row)
    for axis, name in enumerate("xyz"):
        rows[name] = local[:, axis] + pictured.scene.origin[axis]
    rows["scan"] = np.arange(10_000) // 100
    (tmp_path / "cloud.ply").write_bytes(header(row, 10_000) + rows.tobytes())
    parameters = {
        "origin": pictured.scene.origin.tolist(),
        "poses": POSES,
        "triangles": 12,
        "first_poses": [{"position": [3, 1, 1]}] * 10,
        "steps": STEPS,
    }
    report = {"points_by_object": {"room": 10_000}, "parameters": parameters}
    (tmp_path / "report.json").write_text(json.dumps(report))
    pictured.save(tmp_path / "pictures.npz")
    return tmp_path


@pytest.fixture
def page():
    """Return a page that nobody looks at."""
    with live_page("a result", port=0) as page:
        yield page


def drawn(page, file):
    """Return the view of a file, with all that there is drawn."""
    view = ResultView(page, file)
    if view._scene is not None:
        view._scene._prepared.result(timeout=120)
    view._draw()
    return view


def has(page, name):
    return page.scene.get_handle_by_name(name) is not None


def test_ranges_are_known_for_any_number_of_poses(folder, pictured):
    file = ResultFile(folder)
    assert "range" in [column.name for column in file.quantities]
    rows, _ = file.choose(0, 99, 10_000)
    at = pictured.poses[rows["scan"] // STEPS] - pictured.scene.origin
    assert np.allclose(rows["range"], np.linalg.norm(rows[POSITION] - at, axis=1), atol=1e-3)
    assert file.sensor_at(99) == pytest.approx([3, 7, 1])


def test_the_page_shows_scene_sensors_rays_and_planning(folder, page):
    view = drawn(page, ResultFile(folder))
    for name in ("/scene/other", "/poses", "/sensor", "/rays/earlier", "/path", "/discs/0"):
        assert has(page, name), name
    assert "hits per square metre" in view._scene._legend.content
    assert page.scene.get_handle_by_name("/sensor").position == pytest.approx([3, 7, 1])
    assert len(page.scene.get_handle_by_name("/poses").batched_positions) == POSES
    assert "10,000 of 10,000 points" in view._facts.content


def test_under_a_roof_the_page_is_cut_below_it_and_can_be_made_whole(folder, page):
    view = drawn(page, ResultFile(folder))
    assert 2.5 < view._cut.height < 3
    view._draw()
    free = page.scene.get_handle_by_name("/cloud")
    assert free is None or free.points[:, 2].max() <= view._cut.height
    assert page.scene.get_handle_by_name("/rays/earlier").points[..., 2].max() < 2.95
    cut = len(page.scene.get_handle_by_name(view._scene._node._names[0]).glb_data)
    view._cut._slider.value = view._cut._slider.max
    view._scene._near.value = True
    view._draw()
    assert view._cut.height is None
    assert len(page.scene.get_handle_by_name("/cloud").points) == 10_000
    assert len(page.scene.get_handle_by_name(view._scene._node._names[0]).glb_data) != cut
    view._cut._slider.value = -1.0  # not even the floor is left
    view._draw()
    assert not has(page, "/cloud")
    assert not has(page, "/scene/one")
    assert not has(page, "/scene/other")


def test_a_height_that_somebody_chose_stays(folder, page):
    view = drawn(page, ResultFile(folder))
    view._cut._slider.value = 1.0
    view._cut.propose(2.0)
    assert view._cut.height == 1.0


def test_without_pictures_the_cloud_is_shown_alone(folder, page):
    (folder / "pictures.npz").unlink()
    file = ResultFile(folder)
    assert (file.pictured, file.note) == (None, "")
    # The report names ten poses of 25.
    assert "range" not in [column.name for column in file.quantities]
    drawn(page, file)
    assert has(page, "/cloud")
    assert not has(page, "/poses")


def test_a_cloud_of_another_name_is_shown_alone(folder):
    shutil.copy(folder / "cloud.ply", folder / "mine.ply")
    file = ResultFile(folder / "mine.ply")
    assert (file.pictured, file.note, len(file)) == (None, "", 10_000)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04junk", b"\x93NUMPY"])
def test_damaged_pictures_are_noted_and_the_cloud_is_shown(folder, page, content):
    (folder / "pictures.npz").write_bytes(content)
    file = ResultFile(folder)
    assert file.pictured is None
    assert "shown without the scene" in file.note
    assert "pictures.npz" in file.note
    assert "\n" not in file.note
    view = drawn(page, file)
    assert "shown without the scene" in view._facts.content


def test_pictures_cut_off_anywhere_are_noted(folder):
    whole = (folder / "pictures.npz").read_bytes()
    for end in range(0, len(whole), max(1, len(whole) // 23)):
        (folder / "pictures.npz").write_bytes(whole[:end])
        assert ResultFile(folder).pictured is None


def test_pictures_of_another_run_are_noted(folder, pictured):
    replace(pictured, poses=pictured.poses[:3]).save(folder / "pictures.npz")
    assert "is of another run" in ResultFile(folder).note
    elsewhere = replace(pictured.scene, origin=pictured.scene.origin + 1000)
    replace(pictured, scene=elsewhere).save(folder / "pictures.npz")
    (folder / "report.json").unlink()
    file = ResultFile(folder)
    assert file.pictured is None
    assert "is of another run" in file.note


def test_a_mesh_is_never_gone_while_another_comes_and_none_is_left_over(page, monkeypatch):
    now = [0.0]
    # Not in the module `time` itself, which the page's own threads go by.
    clock = SimpleNamespace(monotonic=lambda: now[0])
    monkeypatch.setattr("lidarpool.live.mesh_node.time", clock)
    node = MeshNode(page, "/mesh")

    def shown():
        handles = (page.scene.get_handle_by_name(name) for name in ("/mesh/one", "/mesh/other"))
        return {handle.glb_data for handle in handles if handle is not None}

    for number in range(5):
        data = b"mesh %d" % number
        before = shown()
        node.show(data, "same")
        assert data in shown()
        assert not before or b"mesh %d" % (number - 1) in shown()
        assert len(shown()) <= 2
        now[0] += 1.0
        node.settle()
    now[0] += 10
    assert node.settle() is False
    assert shown() == {b"mesh 4"}
    node.show(b"elsewhere", "new")
    now[0] += NEW_SHAPE_S
    assert node.settle() is False
    assert shown() == {b"elsewhere"}
    node.visible = False
    node.show(b"hidden", "new")
    assert not any(
        page.scene.get_handle_by_name(name).visible for name in ("/mesh/one", "/mesh/other")
    )
    node.clear()
    assert shown() == set()
