"""Scenes written as mesh files come back as they were; nothing half-written is left."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from lidarpool import LidarpoolError, Scene
from lidarpool.cli.scene_commands import scene as command
from lidarpool.scene.city import city
from lidarpool.scene.scene_file import write_scene


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".obj", ".GLB"])
def test_round_trip(tmp_path, suffix):
    made = city(5_000)
    read = Scene.load(write_scene(tmp_path / f"town{suffix}", made))
    assert len(read.faces) == len(made.faces)
    if suffix == ".ply":
        assert read.names == ("town",)
    else:
        assert read.names == made.names
        np.testing.assert_array_equal(read.face_object, np.sort(made.face_object))
        np.testing.assert_allclose(read.object_bounds, made.object_bounds, atol=1e-4)
    corners = np.sort(made.vertices[made.faces].reshape(-1, 9).round(2), axis=0)
    np.testing.assert_allclose(
        np.sort(read.vertices[read.faces].reshape(-1, 9).round(2), axis=0), corners, atol=0.011
    )
    assert [path.name for path in tmp_path.iterdir()] == [f"town{suffix}"]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("town.stl", "has the ending .stl; scenes are written as .ply, .glb, .obj"),
        ("town", r"has the ending \(none\)"),
        ("nowhere/town.ply", "nowhere does not exist"),
    ],
)
def test_places_that_are_none(tmp_path, name, words):
    with pytest.raises(LidarpoolError, match=words):
        write_scene(tmp_path / name, city(1_000))
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_what_was_there(tmp_path, monkeypatch):
    path = tmp_path / "town.ply"
    path.write_text("before")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(LidarpoolError, match="No space left"):
        write_scene(path, city(1_000))
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ["city", "out.glb", "--triangles", "3000", "--seed", "5"],
            r"2,9\d\d triangles, \d+ objects, \d+ x \d+ x \d+ m: out.glb\n",
        ),
        (
            ["terrain", "out.ply", "--triangles", "800", "--side", "50"],
            r"800 triangles, 1 object, 50 x 50 x 8 m: out.ply\n",
        ),
        (
            ["city", "out.glb", "--triangles", "20000", "--trees", "40", "--cars", "20"],
            r"\d+,\d+ triangles, \d+ objects, \d+ x \d+ x \d+ m: out.glb\n",
        ),
        (
            ["terrain", "out.glb", "--triangles", "800", "--side", "100", "--trees", "30"],
            r"\d+,\d+ triangles, 31 objects, 100 x 100 x \d+ m: out.glb\n",
        ),
    ],
)
def test_commands(tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(command, arguments, catch_exceptions=False)
    assert done.exit_code == 0
    assert re.fullmatch(words, done.output)
    assert len(Scene.load(arguments[1]).faces) > 700


def test_files_that_cannot_share_meshes_do_not_hold_a_forest(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = ["terrain", "out.obj", "--triangles", "800", "--side", "1000", "--trees", "5000"]
    with pytest.raises(LidarpoolError, match=r"out.obj would hold 4\d,\d+,\d+ triangles, because"):
        CliRunner().invoke(command, arguments, catch_exceptions=False)
    assert not list(tmp_path.iterdir())
