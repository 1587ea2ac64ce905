"""The pictures of a finished result, drawn again from its folder."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest

from lidarfiles import save_cloud
from lidarfiles.picture_file import PICTURE_FILE, PictureContent, SensorPositions, sensor_positions
from lidarpool.cli.commands import cli
from lidarpool.report.picture_content import planning_picture
from lidarscenario import Planning
from lidarscenario.plan import best
from lidarscenario.plan.trial import run_trial
from lidarsim import (
    Actor,
    Cloud,
    Column,
    LidarError,
    Mounted,
    Pose,
    Scene,
    SceneMesh,
    Sensor,
    Survey,
    Track,
    box,
)
from lidarsim.io.storage import Storage
from lidarsim.scene.shapes import seed_objects
from lidarview.render.picture_page import Page

SMALL = ("--size", "480x480")
NAMES = ("Kübel\x00", "a\udc80", "")  # as files may have them


@pytest.fixture(scope="module")
def planned() -> PictureContent:
    objects = seed_objects(rings=8, segments=12)[:3]
    scene = Scene.from_meshes(
        [SceneMesh(name, o.vertices, o.faces) for name, o in zip(NAMES, objects, strict=True)]
    )
    counts = np.arange(len(scene.faces), dtype=np.int64) % 5
    planning = Planning(
        (0, 0), (30, 0), [(15, 1)], 4.0, trials=3, particles=30, iterations=20, waypoints=2
    )
    trials = [run_trial(planning, number) for number in range(3)]
    rays = np.zeros((4, 2, 3), np.float32)
    rays[:, 1] = scene.vertices[:4]
    return PictureContent(
        scene,
        (SensorPositions(np.zeros(2), np.array([[0, 0, 1], [0, 0, 2.0]])),),
        counts,
        rays,
        planning_picture(planning, best(trials, planning), trials),
    )


@pytest.fixture(scope="module")
def unplanned(planned: PictureContent) -> PictureContent:
    return PictureContent(planned.scene, planned.sensors, planned.hit_counts, planned.sample_rays)


def cloud_at(positions: Any) -> Cloud:
    zeros = np.zeros(len(positions), np.int32)
    return Cloud(positions, {"scan": zeros, "channel": zeros, "object": zeros})


def make(folder: Path, shown: PictureContent) -> Path:
    """Write the folder of a result."""
    folder.mkdir()
    positions = shown.scene.vertices[::2]
    save_cloud(cloud_at(positions), folder / "cloud.ply")
    shown.save(folder / PICTURE_FILE)
    return folder


@pytest.fixture
def result(planned: PictureContent, tmp_path: Path) -> Path:
    return make(tmp_path / "result", planned)


def plot(*arguments: object) -> None:
    cli.main(["plot", *map(str, arguments)], standalone_mode=False)


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_what_is_pictured_comes_back(planned, unplanned, tmp_path):
    for shown in (planned, unplanned):
        shown.save(tmp_path / "a.npz")
        again = PictureContent.load(tmp_path / "a.npz")
        assert again.scene.names == shown.scene.names
        assert np.array_equal(again.hit_counts, shown.hit_counts)
        assert (again.planning is None) == (shown.planning is None)
        again.save(tmp_path / "b.npz")
        assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


@pytest.mark.slow
def test_what_moves_is_drawn_where_it_is_halfway(tmp_path):
    """Along x, the sensor at 10 m/s and an actor towards it."""
    scene = replace(
        Scene.seed(), actors=(Actor(box("Van", (5, 2, 2)), Track([0, 1], [[20, 3, 0], [0, 3, 0]])),)
    )
    drive = Track([0, 1], [[0, 0, 1], [10, 0, 1]])
    nose = Mounted(Sensor.grid(), Pose((2, 0, 0)), "nose")
    survey = Survey(trajectory=drive, sensors=[nose])
    none = np.zeros((0, 2, 3), np.float32)
    shown = PictureContent(
        scene, sensor_positions(survey), np.ones(scene.triangles, np.int64), none, duration_ns=1e9
    )
    again = PictureContent.load(make(tmp_path / "result", shown) / PICTURE_FILE)
    (way,) = again.sensors
    assert (way.name, way.moves) == ("nose", True)
    assert np.allclose(way.position_at(5e8), (7, 0, 1), atol=0.01)
    assert np.allclose(again.scene.solid(5e8).object_bounds[-1], [(7.5, 2, 0), (12.5, 4, 2)])
    assert again.caption == "1 moving sensor and 1 actor, at 0.5 s of 1 s"
    plot(tmp_path / "result", *SMALL)
    assert {"scene.png", "hits.png", "cloud.png"} <= names(tmp_path / "result")


def changed(data: bytes, **arrays: Any) -> bytes:
    """Write an archive with other arrays in it."""
    with np.load(io.BytesIO(data)) as archive:
        content = {**archive, **arrays}
    memory = io.BytesIO()
    np.savez(memory, **{name: array for name, array in content.items() if array is not None})
    return memory.getvalue()


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda data: b"nonsense", "is damaged"),
        (lambda data: data[: len(data) // 2], "is damaged"),
        (lambda data: changed(data, hit_counts=np.zeros(3)), r"hit_counts has shape \(3,\)"),
        (lambda data: changed(data, radii=None), "radii"),
        (lambda data: changed(data, sensor0=np.array([{}])), "is not an array of numbers"),
        (lambda data: changed(data, format=np.array(7)), "its format version is 7"),
    ],
)
def test_a_damaged_file_is_refused(damage, said, result):
    file = result / PICTURE_FILE
    file.write_bytes(damage(file.read_bytes()))
    with pytest.raises(LidarError, match=said) as caught:
        plot(result, "--only", "scene")
    assert str(file) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.extended
def test_the_cloud_is_colored_by_any_of_its_columns(unplanned, tmp_path, monkeypatch):
    wet = Column("wetness", "float32", "%", "how wet it is", source="wetness")
    shown = replace(unplanned, extra_columns=[replace(wet, source="")])
    result = make(tmp_path / "result", shown)
    positions = shown.scene.vertices
    zeros = np.zeros(len(positions), np.int32)
    wetness = np.linspace(0, 100, len(positions))
    columns = {"scan": zeros, "channel": zeros, "object": zeros + 1, "wetness": wetness}
    save_cloud(Cloud(positions, columns, [wet]), result / "cloud.ply")
    figures = []
    monkeypatch.setattr(
        Page, "save", lambda page, path: path.touch() or figures.append(page.figure)
    )
    for name in ("z", "wetness", "object", "ring", "x", "y"):
        plot(result, "--only", "cloud", "--color", name, *SMALL)
    assert [figure.axes[0].get_ylabel() for figure in figures[:2]] == ["z (m)", "wetness (%)"]
    assert [figure.axes[0].get_ylabel() for figure in figures[4:]] == ["x (m)", "y (m)"]
    keys = [[t.get_text() for t in figure.legends[0].get_texts()] for figure in figures[2:4]]
    assert [key[0] for key in keys] == ["a\ufffd", "channel 0"]
    with pytest.raises(LidarError, match=r"no column 'wettness'\. Did you mean 'wetness'"):
        plot(result, "--only", "cloud", "--color", "wettness")


@pytest.mark.extended
@pytest.mark.parametrize(
    ("coordinates", "pictures", "left_out"),
    [("world", {"scene.png", "hits.png", "cloud.png"}, "path"),
     ("world", {"scene.png", "hits.png", "cloud.png"}, "intensity"),
     ("sensor", {"scene.png", "hits.png"}, "cloud")],
)  # fmt: skip
def test_pictures_that_there_are_not(coordinates, pictures, left_out, unplanned, tmp_path):
    """No path without planning, nor intensity without its column; and some points do not fit."""
    result = make(tmp_path / "result", replace(unplanned, coordinates=coordinates))
    plot(result, *SMALL, "--out", tmp_path / "out")
    assert names(tmp_path / "out") == pictures
    with pytest.raises(LidarError, match=f"The picture '{left_out}' cannot be drawn"):
        plot(result, "--only", left_out)


def test_a_result_in_storage(result, tmp_path):
    url = f"memory://{tmp_path.name}/result"
    with pytest.raises(
        LidarError, match=f"^{url} does not contain a complete result, because report"
    ):
        plot(url, "--only", "path")
    for name in ("cloud.ply", PICTURE_FILE):
        Storage.at(url).put(result / name, name)
    Storage.at(url).write("report.json", b"{}")
    plot(url, *SMALL, "--only", "path")
    plot(url, *SMALL, "--only", "path", "--out", tmp_path / "here")
    assert Storage.at(url).read("path.png") == (tmp_path / "here" / "path.png").read_bytes()


@pytest.mark.parametrize("size", ["big", "480", "480x", "0x0", "479x480", "9000x9000", "1000x480"])
def test_sizes_that_cannot_be(size, result):
    words = "is not a picture size.*such as 1600x1000|cannot have .* pixels.*use 1600 x 1000"
    with pytest.raises((click.UsageError, LidarError), match=words):
        plot(result, "--size", size)


def test_folders_that_cannot_be_used(result, tmp_path):
    with pytest.raises(LidarError, match=r"none does not exist"):
        plot(tmp_path / "none")
    (tmp_path / "file").write_text("")
    with pytest.raises(LidarError, match=r"Cannot write to the folder .*file.below"):
        plot(result, "--out", tmp_path / "file" / "below")


def test_a_picture_takes_the_place_of_a_link(tmp_path):
    theirs = tmp_path / "theirs.png"
    link = tmp_path / "cloud.png"
    theirs.write_bytes(b"of another")
    link.symlink_to(theirs)
    Page((300, 200)).save(link)
    assert theirs.read_bytes() == b"of another" and not link.is_symlink()


@pytest.mark.extended
def test_intensity_and_true_color_are_drawn(unplanned, tmp_path):
    result = make(tmp_path / "result", unplanned)
    at = unplanned.scene.vertices
    zeros = np.zeros(len(at), np.int32)
    byte = np.full(len(at), 200, np.uint8)
    columns = dict.fromkeys(("scan", "channel", "object"), zeros)
    columns |= {"intensity": zeros + 1.0, "red": byte, "green": byte}
    save_cloud(Cloud(at, columns), result / "cloud.ply")
    with pytest.raises(LidarError, match="no column 'rgb'"):
        plot(result, "--only", "cloud", "--color", "rgb", *SMALL)
    save_cloud(Cloud(at, columns | {"blue": byte}), result / "cloud.ply")
    plot(result, "--only", "intensity", "--only", "cloud", "--color", "rgb", *SMALL)
    assert {"intensity.png", "cloud.png"} <= names(result)
