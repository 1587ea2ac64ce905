"""What a run tells its page: hits and progress; and what the page tells the run."""

import io
import struct

import numpy as np
import pytest
import trimesh

from lidarpool import Scene
from lidarpool.live.mesh_node import coloured_triangles
from lidarpool.live.run_panel import Occupancy, RunControl, RunPanel, RunState
from lidarpool.live.run_scene import Latest
from lidarpool.live.scene_layer import DisplaySurface, intensity_colours
from lidarpool.run.progress import Progress


def test_latest_drops_what_was_not_taken():
    latest = Latest()
    assert latest.take() is None
    for thing in range(10):
        latest.put(thing)
    assert latest.take() == 9
    latest.put(10)
    assert latest.take() == 10
    assert (latest.taken, latest.dropped) == (2, 9)


def test_triangles_come_back_from_their_file():
    corners = np.random.default_rng(0).random((7, 3, 3)).astype(np.float32)
    colours = np.arange(21, dtype=np.uint8).reshape(7, 3) * 12
    data = coloured_triangles(corners, colours)
    mesh = trimesh.load(io.BytesIO(data), file_type="glb", process=False).to_mesh()
    assert np.array_equal(mesh.vertices[mesh.faces].astype(np.float32), corners)
    assert len(data) == struct.unpack_from("<I", data, 8)[0]
    linear = np.frombuffer(data[-4 * 21 :], np.uint8).reshape(7, 3, 4)[:, :, :3] / 255
    screen = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert np.allclose(255 * screen, colours[:, None], atol=7)  # dark ones are coarse, linear


def test_few_triangles_are_shown_as_they_are():
    scene = Scene.seed()
    surface = DisplaySurface(scene)
    counts = np.zeros(len(scene.faces), np.int64)
    counts[:1000] = 20
    density, hit = surface.density(counts)
    assert surface.corners.shape == (len(scene.faces), 3, 3)
    assert (hit == (counts > 0)).all()
    assert density[:1000].min() > 0


def test_many_triangles_become_few_that_keep_shape_and_hits():
    scene = Scene.seed()
    surface = DisplaySurface(scene, most=5000)
    corners = surface.corners.reshape(-1, 3)
    assert 500 < len(surface.corners) <= 5000
    assert np.allclose(corners.min(axis=0), scene.vertices.min(axis=0), atol=0.5)
    assert np.allclose(corners.max(axis=0), scene.vertices.max(axis=0), atol=0.5)
    counts = np.full(len(scene.faces), 3)
    density, _ = surface.density(counts)
    a, b, c = surface.corners.astype(float).transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    assert (density * area).sum() == pytest.approx(counts.sum(), rel=1e-3)


def test_a_scene_of_which_nothing_is_left_is_still_shown():
    scene = Scene.seed()
    assert len(DisplaySurface(scene, most=1).corners) == 1


def test_what_was_not_hit_is_grey():
    density = np.array([0.0, 1.0, 10.0])
    colours = intensity_colours(density, density > 0, (1.0, 10.0))
    assert np.ptp(colours[0].astype(int)) < 20
    assert np.ptp(colours[1].astype(int)) > 60
    assert np.ptp(colours[2].astype(int)) > 60


def test_a_run_is_to_stand_still_until_it_may_go_on():
    control = RunControl()
    control.check()
    assert not control.paused
    control.pause()
    assert control.paused
    control.check()  # a pause ends nothing
    control.go_on()
    assert not control.paused


def test_a_stopped_run_ends_as_by_an_interrupt_also_when_it_is_paused():
    control = RunControl()
    control.pause()
    control.stop()
    assert control.stopped
    assert not control.paused
    with pytest.raises(KeyboardInterrupt):
        control.check()


def progress(seconds, done):
    return Progress(
        scans=100, generated=100, cast=done, framed=done, collected=done, points=2000,
        trials=0, trials_done=0, seconds=seconds,
    )  # fmt: skip


def test_the_panel_tells_stages_rates_points_and_slots():
    panel = RunPanel()
    panel.html(progress(0.0, 0), RunState("running"))
    text = panel.html(
        progress(5.0, 50), RunState("running", {"GPU": Occupancy(1, 2)}, 500, frames=4, skipped=46)
    )
    for words in (
        "<b>running</b>, 5 s",
        "10/s, 5 s left",
        "50 / 100",
        "<b>2,000 points</b>, 500 of them displayed",
        "4 frames displayed, 46 skipped",
        "slots busy: GPU 1 of 2",
    ):
        assert words in text
    assert "plan path" not in text


def test_the_panel_says_what_cannot_be_displayed():
    state = RunState("running", error="The part <1> cannot be read.")
    assert "The part &lt;1&gt; cannot be read." in RunPanel().html(progress(1.0, 1), state)


def test_the_panel_says_so_before_there_is_anything_to_tell():
    assert "starting" in RunPanel().html(None, RunState("starting"))
