"""What helps before the first run: init, schema, help, words for mistakes."""

import re
from importlib.resources import files
from pathlib import Path

import pytest
import trimesh

from lidarfiles.identity.fingerprint import fingerprint
from lidarpool.cli.commands import cli
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario


def test_init_writes_a_scenario_and_says_what_to_do_next(tmp_path, lidarpool):
    folder = tmp_path / "my surveys" / "hall"
    outcome = lidarpool("init", folder, "--all")
    assert (outcome.code, outcome.err) == (0, "")
    assert {path.name for path in folder.iterdir()} == {"scenario.schema.json", "scenario.yaml"}
    assert outcome.out.endswith(f"next: lidarpool check '{folder / 'scenario.yaml'}'\n")
    assert (
        Scenario.load(folder / "scenario.yaml").model_dump()
        == Scenario.from_data({"scene": "seed"}).model_dump()
    )
    first = (folder / "scenario.yaml").read_text().splitlines()[0]
    assert first == "# yaml-language-server: $schema=scenario.schema.json"
    assert lidarpool("schema").out == (folder / "scenario.schema.json").read_text()


def test_init_overwrites_nothing(tmp_path, lidarpool):
    (tmp_path / "scenario.yaml").write_text("mine")
    outcome = lidarpool("init", tmp_path)
    assert outcome.code == 2
    assert f"{tmp_path / 'scenario.yaml'} already exists and is not overwritten" in outcome.err
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


def test_init_with_meshes_names_them_as_seen_from_the_scenario(tmp_path, lidarpool):
    for name in ("my room.stl", "#1: é.glb"):
        (tmp_path / name).write_bytes(trimesh.creation.box().export(file_type=name[-3:]))
    options = ["--mesh", "my room.stl", "--mesh", "#1: é.glb", "--unit", "mm"]
    outcome = lidarpool("init", "a/b", *options)
    assert (outcome.code, outcome.err) == (0, "")
    assert outcome.out.startswith("Created a/b/scenario.yaml for my room.stl, #1: é.glb.")
    made = Scenario.load("a/b/scenario.yaml")
    files = [(entry.file, entry.unit) for entry in made.scene.files]
    assert files == [("../../my room.stl", "mm"), ("../../#1: é.glb", "mm")]
    assert len(prepare(made).scene.names) == 2
    assert made.poses is not None and len(made.poses) == 5, "around boxes of a millimeter"
    text = Path("a/b/scenario.yaml").read_text()
    assert "# The scene was recognized as an object of " in text and len(text.splitlines()) < 22
    assert made.sensor.horizontal_fov_deg < 45, "narrowed to them"
    rest = {"scene": {"files", "preset"}, "sensor": True, "poses": True}
    assert made.model_dump(exclude=rest) == Scenario().model_dump(exclude=rest)


@pytest.mark.parametrize("every", [True, False])
def test_init_writes_what_the_options_say(every, tmp_path, lidarpool):
    (tmp_path / "hall.stl").write_bytes(trimesh.creation.box((8, 6, 3)).export(file_type="stl"))
    model = files("lidarsim.sensor") / "data" / "velodyne" / "vlp16.yaml"
    (tmp_path / "mine.yaml").write_text(model.read_text())
    options = ["--mesh", "hall.stl", "--up-axis", "x", "--sensor", "mine.yaml", "--pose", "1,2.5,0"]
    options += ["--columns", "range", "--columns", "time,ray", "--format", "laz,mcap"]
    assert lidarpool("init", "new", *options, *["--all"] * every).code == 0
    text = (tmp_path / "new" / "scenario.yaml").read_text()
    assert ("  step_deg: 10.0 " in text) == every and "  - [1, 2.5, 0]\n" in text
    assert every or "\nsensor: ../mine.yaml " in text
    made = Scenario.load("new/scenario.yaml")
    (entry,), (pose,) = made.scene.files, made.poses
    assert (entry.file, entry.unit, entry.up_axis) == ("../hall.stl", None, "x")
    assert (made.sensor.model, pose.position) == ("../mine.yaml", (1, 2.5, 0))
    assert made.cloud.columns == ("range", "time", "ray")
    assert [one.format for one in made.output.write] == ["laz", "mcap"]


def test_init_writes_the_poses_that_were_chosen(tmp_path, lidarpool):
    (tmp_path / "hall.stl").write_bytes(trimesh.creation.box((8, 6, 3)).export(file_type="stl"))
    assert lidarpool("init", "new", "--mesh", "hall.stl", "--sensor", "vlp16").code == 0
    made = Scenario.load("new/scenario.yaml")
    chosen = prepare(Scenario.load("hall.stl", {"sensor": "vlp16"})).survey
    assert fingerprint(prepare(made).survey) == fingerprint(chosen)
    assert made.poses is not None


def test_init_without_a_mesh_is_short_too(tmp_path, lidarpool):
    assert lidarpool("init", "new", "--sensor", "vlp16").code == 0
    text = (tmp_path / "new" / "scenario.yaml").read_text()
    assert "\nscene: seed " in text and "\nsensor: vlp16 " in text and text.count("\n") < 15
    assert len(prepare(Scenario.load("new/scenario.yaml")).scene.names) == 6


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--mesh", "nowhere.stl"], "nowhere.stl does not exist"),
        (["--mesh", "notes.txt"], "If it is a point cloud, convert it to a mesh"),
        (["--sensor", "vlp61"], "Did you mean 'vlp16'?"),
        (["--unit", "mm"], "require `--mesh`"),
        (["--mesh", "notes.txt", "--unit", "ells"], "ells"),
    ],
)
def test_init_with_what_is_no_mesh_writes_nothing(options, says, tmp_path, lidarpool):
    (tmp_path / "notes.txt").write_text("")
    outcome = lidarpool("init", "new", *options)
    assert (outcome.code, outcome.out) == (2, "")
    assert says in outcome.err
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("name", sorted(cli.commands))
def test_help_of_each_command_shows_examples(name, lidarpool):
    commands = getattr(cli.commands[name], "commands", {"": None})
    for inner in commands:
        words = [name, *([inner] if inner else [])]
        outcome = lidarpool(*words, "--help")
        assert outcome.code == 0
        examples = outcome.out.partition("Examples:")[2].partition("\n\n")[0]
        assert len(re.findall(rf"\blidarpool {' '.join(words)}\b", examples)) >= 1, words


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (["run", "--bakend", "numpy", "x.yaml"], "'--backend'"),
        (["scene", "ciyt", "x.ply"], "'city'"),
        (["scheme"], "'schema'"),
    ],
)
def test_what_is_misspelt_is_answered_with_what_was_meant(arguments, meant, lidarpool):
    outcome = lidarpool(*arguments)
    assert outcome.code == 2 and outcome.out == ""
    assert re.search(rf"Did you mean (one of: )?.*{meant}", outcome.err), outcome.err


def test_sensors_states_when_the_data_sheet_applies(tmp_path, lidarpool):
    (tmp_path / "mine.yaml").write_text(
        (files("lidarsim.sensor") / "data" / "velodyne" / "vlp16.yaml").read_text()
    )
    for name, applies in (
        ("velodyne/vlp16", "with performance: datasheet"),
        ("mine.yaml", "unless performance is ideal"),
    ):
        lines = lidarpool("sensors", name).out.splitlines()
        row = lines.index(f"data sheet   the noise and returns below apply {applies}")
        assert lines[row + 1].startswith("noise        range_m: 0.03")
    assert "data sheet   " not in lidarpool("sensors", "velodyne/vlp32c").out


def test_sensors_lists_models_and_draws_the_beams_of_one(tmp_path, lidarpool):
    outcome = lidarpool("sensors")
    assert outcome.code == 0
    rows = {line.split()[0]: " ".join(line.split()[1:]) for line in outcome.out.splitlines()}
    assert rows["velodyne/vlp16"] == "16 360° x -15.0° to 15.0° 0.4 to 130 m 5 to 20 289,352"
    assert rows["livox/mid70"].startswith("1 70.4° circle, forward")
    assert max(map(len, outcome.out.splitlines())) <= 116
    outcome = lidarpool("sensors", "velodyne/vlp16")
    assert outcome.out.startswith("Velodyne VLP-16\nangles ")
    out = "lidarpool sensors velodyne/vlp16 --out"
    draw = f"To draw its pattern: {out} pattern.png"
    assert outcome.out.endswith(f"\n{draw}\nTo export its rays: {out} rays.npz\n")
    assert list(tmp_path.iterdir()) == []
    pictures = {"livox/mid40": "rose.png", "airborne/riegl-vq780i": "lines.png", "vlp16": "v.png"}
    for name, target in pictures.items():
        assert lidarpool("sensors", name, "--out", target).out.endswith(f"\n{target}\n")
    assert {(tmp_path / name).read_bytes()[:4] for name in pictures.values()} == {b"\x89PNG"}
    assert lidarpool("sensors", "").code == 2
    outcome = lidarpool("sensors", "velodyne/vlp61")
    assert outcome.code == 2 and "Did you mean 'velodyne/vlp16'?" in outcome.err


def test_sensors_writes_a_file_and_says_what_the_file_lacks(tmp_path, lidarpool):
    options = ("--max-range", "50", "--seconds", "0.001", "--out", "v.csv")
    outcome = lidarpool("sensors", "vlp16", *options)
    assert outcome.code == 0, outcome.err
    lacks = "beam divergence; rays after 0.001051 s, where the pattern does not repeat"
    assert outcome.out.endswith(f"\n304 rays: v.csv\nnot stored in the file: {lacks}\n")
    assert "# max_range_m: 50.0" in (tmp_path / "v.csv").read_text()
    again = lidarpool("sensors", "vlp16", "--out", "v.csv")
    assert (
        again.code == 2
        and "v.csv already exists. Use another name, or pass `--overwrite`." in again.err
    )
    outcome = lidarpool("sensors", "--calibration", "v.csv", "--out", "v.npz")
    assert outcome.code == 0 and (tmp_path / "v.npz").exists()
    assert lidarpool("sensors", "vlp16", "--seconds", "1").code == 2
    assert lidarpool("sensors", "--out", "v.npz").code == 2
