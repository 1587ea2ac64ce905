"""Scenes written as mesh files come back as they were; nothing half-written is left."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner

from lidarpool.cli.scenario_commands import scene as command
from lidarscenes.procedural.city import city
from lidarscenes.writers.scene_file import write_scene
from lidarsim import LidarError, Scene, SceneInstance, box
from lidarsim.scene.colors import WHITE, Colors
from lidarsim.scene.files.meshfile import load_meshes
from lidarsim.scene.scene_mesh import Cutout


@pytest.mark.extended
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


def test_colors_come_back_from_a_glb_file(tmp_path):
    """A texture, colors of corners, a plain color, none; instances; and a mask with a color."""
    rng = np.random.default_rng(3)
    cube = box("Cube", (1, 1, 1))
    faces = np.zeros(12, np.int32)
    image = rng.integers(0, 256, (8, 4, 3)).astype(np.uint8)
    uv = rng.uniform(-1, 2, (12, 3, 2)).astype(np.float32)
    corners = rng.integers(0, 256, (12, 3, 3)).astype(np.uint8)
    red = np.uint8([[[200, 10, 3]]])
    several = Colors((red, image), (np.arange(12) % 2).astype(np.int32), uv)
    kinds = {
        "Textured": Colors((image,), faces, uv),
        "Tinted": Colors((image,), faces, uv, corners),
        "Corners": Colors((WHITE,), faces, None, corners),
        "Plain": Colors.plain(red, 12),
        "Both": several,
        "Bare": None,
    }
    meshes = [replace(cube, name=name, colors=own) for name, own in kinds.items()]
    mask = rng.random((4, 4)) < 0.5
    card = replace(cube, name="Card", cutouts=(Cutout(mask, uv),), colors=Colors.plain(red, 12))
    copies = np.tile(np.eye(4), (3, 1, 1))
    copies[:, 0, 3] = 5, 9, 13
    placed = SceneInstance.from_matrices(replace(meshes[4], name="Copy"), copies, "Copy")
    path = write_scene(tmp_path / "all.glb", Scene.from_meshes([*meshes, card, *placed]))
    wanted = {mesh.name: (mesh, np.zeros(3)) for mesh in [*meshes, card]}
    names = ("Copy", "Copy.2", "Copy.3")
    wanted |= {n: (meshes[4], one.matrix[:3, 3]) for n, one in zip(names, placed, strict=True)}
    read = {}
    for one in load_meshes(path, colors=True):
        mesh = one.flat() if isinstance(one, SceneInstance) else one
        read.setdefault(mesh.name, []).append(mesh)
    assert {*read} == {*wanted}
    for name, (mesh, shift) in wanted.items():
        found = {}
        for part in read[name]:
            own = part.colors
            shades = np.full((len(part.faces), 3), 188) if own is None else own.mean_colors()
            for triangle, shade in zip(part.vertices[part.faces], shades, strict=True):
                key = tuple(triangle.mean(axis=0).round(3) + 0.0)
                found[key] = shade.astype(int)
        expected = np.full((12, 3), 188) if mesh.colors is None else mesh.colors.mean_colors()
        for triangle, shade in zip(mesh.vertices[mesh.faces] + shift, expected, strict=True):
            key = tuple(triangle.mean(axis=0).round(3) + 0.0)
            assert np.abs(found[key] - shade.astype(int)).max() <= 1, name
    assert [len(part.cutouts) for part in read["Card"]] == [1]
    # trimesh, another reader
    seen = trimesh.load(path).geometry
    assert seen["Plain"].visual.material.main_color.tolist() == [147, 1, 0, 255]  # linear
    texture = np.asarray(seen["Textured"].visual.material.baseColorTexture.convert("RGB"))
    np.testing.assert_array_equal(texture, image)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("town.stl", "has the extension .stl. Scenes can be written as .ply, .glb, .obj"),
        ("town", r"has the extension \(none\)"),
        ("nowhere/town.ply", "nowhere does not exist"),
    ],
)
def test_places_that_are_none(tmp_path, name, words):
    with pytest.raises(LidarError, match=words):
        write_scene(tmp_path / name, city(1_000))
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_what_was_there(tmp_path, monkeypatch):
    path = tmp_path / "town.ply"
    path.write_text("before")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(LidarError, match="No space left"):
        write_scene(path, city(1_000))
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ["terrain", "out.ply", "--triangles", "800", "--side", "50"],
            r"800 triangles, 1 object, 50 x 50 x 8 m: out.ply\n",
        ),
        (
            ["city", "out.glb", "--triangles", "20000", "--trees", "40", "--cars", "20"],
            r"\d+,\d+ triangles, \d+ objects, \d+ x \d+ x \d+ m: out.glb\n",
        ),
    ],
)
def test_commands(arguments, words):
    done = CliRunner().invoke(command, arguments, catch_exceptions=False)
    assert done.exit_code == 0
    assert re.fullmatch(words, done.output)
    assert len(Scene.load(arguments[1]).faces) > 700


@pytest.mark.slow
def test_files_that_cannot_share_meshes_do_not_hold_a_forest(tmp_path):
    arguments = ["terrain", "out.obj", "--triangles", "800", "--side", "1000", "--trees", "5000"]
    with pytest.raises(LidarError, match=r"out.obj would contain 4\d,\d+,\d+ triangles, because"):
        CliRunner().invoke(command, arguments, catch_exceptions=False)
    assert not list(tmp_path.iterdir())
