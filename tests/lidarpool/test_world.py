"""The section world: a survey in local coordinates, and what is written in a coordinate system."""

import json
import re
from pathlib import Path

import laspy
import numpy as np
import pyarrow.parquet as pq
import pye57
import pytest
import yaml
from click.testing import CliRunner
from tests.lidarpool.test_rasters import SLOPE, X0, Y0, write

from lidarfiles import read_cloud
from lidarfiles.clouds.las_header import las_system
from lidarfiles.clouds.writing import ExportSpec
from lidarpool.cli.commands import cli
from lidarpool.pages.preview import first_sweeps
from lidarscenario.advice import advice
from lidarscenario.empty_cloud import empty_cloud_reason
from lidarscenario.plausibility import plausibility_warnings
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarsim import LidarError, Scene
from lidarsim.scene.files.stated_system import StatedSystem

ORIGIN = [500_000, 5_400_000]
ROOM = {"copies": [{"name": "Room", "box": [8, 6, 3], "at": [[0, 0, 0]]}]}
PLAN = {"scene": ROOM, "poses": [[0, 0, 1], [1.5, -1, 1]], "sensor": "velodyne/vlp16", "steps": 2}


def job_of(**sections):
    return prepare(Scenario.from_data({**PLAN, **sections})).job


def cloud_of(job):
    (cloud,) = first_sweeps(job)
    return cloud


@pytest.mark.parametrize(
    ("origin", "added"),
    [
        (ORIGIN, [500_000, 5_400_000, 0]),
        ([500_000.125, 5_400_000.001, 312.5], [500_000.125, 5_400_000.001, 312.5]),
    ],
)
def test_a_local_plan_is_written_in_its_system(tmp_path, origin, added):
    local = cloud_of(job_of()).positions
    job = job_of(world={"epsg": 25832, "origin": origin})
    assert [pose.position for pose in job.survey.poses] == [(0, 0, 1), (1.5, -1, 1)]
    cloud = cloud_of(job)
    expected = np.round(local + added, 6)
    np.testing.assert_array_equal(cloud.positions, expected)
    for name in ("las", "laz", "ply", "e57", "parquet"):
        ExportSpec(name).write(tmp_path / f"cloud.{name}", cloud, job.sweeps)
    for name in ("las", "laz"):
        las = laspy.read(tmp_path / f"cloud.{name}")
        np.testing.assert_allclose(las.xyz, expected, rtol=0, atol=1e-8)
        assert 'AUTHORITY["EPSG","25832"]]' in las_system(tmp_path / f"cloud.{name}").text
    np.testing.assert_array_equal(read_cloud(tmp_path / "cloud.ply").positions, expected)
    head = (tmp_path / "cloud.ply").read_bytes().partition(b"end_header")[0].decode()
    comments = [line.removeprefix("comment ") for line in head.splitlines()]
    assert StatedSystem.from_comments(comments) == StatedSystem("EPSG:25832")
    part = pq.read_table(tmp_path / "cloud.parquet" / "part-00000.parquet")
    np.testing.assert_array_equal(np.stack([part[axis] for axis in "xyz"], axis=1), expected)
    assert part.schema.metadata[b"crs"] == b"EPSG:25832"
    with pye57.E57(str(tmp_path / "cloud.e57")) as file:
        assert StatedSystem(file.root["coordinateMetadata"].value()).units() is not None
        assert 'AUTHORITY["EPSG","25832"]]' in file.root["coordinateMetadata"].value()
        np.testing.assert_allclose(file.get_header(0).translation, np.add([0, 0, 1], added))
        scan = file.read_scan(0, ignore_missing_fields=True)
        points = np.stack([scan[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
    np.testing.assert_allclose(points, expected, rtol=0, atol=1e-6)


def test_without_a_world_files_state_no_system(tmp_path):
    job = job_of()
    cloud = cloud_of(job)
    for name in ("las", "ply", "e57", "parquet"):
        ExportSpec(name).write(tmp_path / f"cloud.{name}", cloud, job.sweeps)
    assert las_system(tmp_path / "cloud.las") is None
    assert b"crs" not in (tmp_path / "cloud.ply").read_bytes().partition(b"end_header")[0]
    assert b"crs" not in pq.read_schema(tmp_path / "cloud.parquet/part-00000.parquet").metadata
    with pye57.E57(str(tmp_path / "cloud.e57")) as file:
        assert file.root["coordinateMetadata"].value() == ""


def test_a_scene_is_placed_in_python_and_again():
    scene = Scene.seed()
    placed = scene.with_world_origin((500_000, 5_400_000, 300))
    np.testing.assert_array_equal(placed.vertices, scene.vertices)
    assert placed.origin.tolist() == [500_000, 5_400_000, 300]
    assert placed.with_world_origin((1, 2, 3)).origin.tolist() == [1, 2, 3]
    assert placed.with_world_origin((0, 0, 0)).origin.tolist() == [0, 0, 0]
    with pytest.raises(LidarError, match="must be x, y and z in meters"):
        scene.with_world_origin((1, 2))


def test_fields_that_do_not_fit_the_world_are_refused(tmp_path):
    with pytest.raises(LidarError, match=r"world\.origin"):
        Scenario.from_data({"world": {"origin": [1]}})
    with pytest.raises(LidarError, match=r"Unknown field '.*epsg'"):
        Scenario.from_data({"cloud": {"epsg": 25832}})
    with pytest.raises(LidarError, match=r"`world\.epsg` .*EPSG:3857.*a world map projection"):
        job_of(world={"epsg": 3857, "origin": ORIGIN})
    track = {"points": [{"time_s": 0, "position": [0, 0, 1]}, {"time_s": 1, "position": [1, 0, 1]}]}
    with pytest.raises(
        LidarError, match=r"Set `world\.epsg` instead of `navigation\.gnss\.origin`"
    ):
        Scenario.from_data(
            {
                "trajectory": track,
                "world": {"epsg": 25832, "origin": ORIGIN},
                "navigation": {"gnss": {"origin": [48.7, 9.1, 290.0]}},
            }
        )


def test_a_raster_that_is_in_the_system_is_not_moved_by_its_origin(tmp_path):
    write(tmp_path / "hills.tif", SLOPE)
    world = {"origin": [X0, Y0]}

    def built(*files):
        data = {"scene": {"files": [*files]}, "world": world}
        return prepare(Scenario.from_data(data, folder=tmp_path))

    with pytest.raises(
        LidarError, match=rf"translation: \[-{X0}, -{Y0}, 0\]` for the file, or remove"
    ):
        built("hills.tif")
    world["epsg"] = 25832
    scene = built({"file": "hills.tif", "translation": [-X0, -Y0, 0]}).job.scene
    lower, upper = scene.bounds + scene.origin
    assert (np.abs(lower[:2] - (X0, Y0)) < 100).all() and (np.abs(upper[:2] - (X0, Y0)) < 100).all()


def test_notes_and_reasons_have_the_coordinates_of_the_scenario():
    far = job_of(world={"epsg": 25832, "origin": ORIGIN}, poses=[[900, 0, 1]])
    reason = empty_cloud_reason(far.scene, far.survey)
    assert "The sensor starts at (900.000, 0.000, 1.000)" in reason and "500" not in reason
    built = prepare(Scenario.from_data({**PLAN, "world": {"origin": ORIGIN}}))
    assert "500,000" not in " ".join(note for note in advice(built) if "projected" not in note)


def placed_at(place, **world):
    """Return the warnings of a room at a place of its file's coordinates."""
    copies = [{"name": "Room", "box": [8, 6, 3], "at": [[*place, 0]]}]
    data = {"scene": {"copies": copies}, "poses": [[place[0], place[1], 1]], "world": world}
    return plausibility_warnings(prepare(Scenario.from_data({**PLAN, **data}), plans=False))


def test_a_scene_outside_the_area_of_use_is_told_with_both_remedies():
    [twice] = placed_at(ORIGIN, epsg=25832, origin=ORIGIN)
    assert re.fullmatch(
        r"The scene is at x 1,000,000, y 10,800,000, outside the area of use of EPSG:25832 \(.*\), "
        r"which is Europe .*\. If the files of the scene have world coordinates, remove "
        r"`world\.origin`, which moves it inside\. Otherwise, set `world\.epsg` to the system of "
        r"these coordinates\.",
        twice,
    )
    [no_origin] = placed_at((0, 0), epsg=25832)
    remedy = "set `world.origin` to the world coordinates of their origin."
    assert no_origin.endswith(f"If they have local coordinates, {remedy}")
    with pytest.raises(
        LidarError, match=r"Switzerland\. If the files .* set `world\.epsg` to the system"
    ):
        placed_at((600_000, 200_000), epsg=2056)
    with pytest.raises(LidarError, match=r"outside the area of use of EPSG:31467") as wrong:
        placed_at(ORIGIN, epsg=31467)
    assert "such as EPSG:32632, in which they are inside this area" in str(wrong.value)
    assert "EPSG:32626" not in str(wrong.value)


@pytest.mark.parametrize(
    ("place", "world"),
    [
        ((0, 0), {"epsg": 25832, "origin": ORIGIN}),
        ((3000, 3000), {"epsg": 25832, "origin": ORIGIN}),
        ((12_345, 400_000), {"epsg": 25832, "origin": [500_000, 5_000_000]}),  # without leading 5
        (ORIGIN, {"epsg": 25832}),
        (ORIGIN, {}),
        ((0, 0), {}),
        ((0, 0), {"origin": ORIGIN}),
        ((0, 0), {"epsg": 27700, "origin": [530_000, 180_000]}),  # the grid's zero is in its area
    ],
)
def test_scenes_in_their_system_are_not_told(place, world):
    assert placed_at(place, **world) == []


@pytest.mark.parametrize("epsg", [{}, {"epsg": 25832}])
def test_an_origin_that_is_added_twice_is_told_wherever_it_ends(epsg):
    [twice] = placed_at((300_000, 4_000_000), origin=[290_000, 4_010_000], **epsg)
    assert twice == (
        "`world.origin` (x 290,000, y 4,010,000) is added to the coordinates of the scene's files, "
        "although these coordinates are already close to it (x 300,000, y 4,000,000). If they are "
        "world coordinates, remove `world.origin`."
    )


@pytest.mark.extended(keep=("check",))
@pytest.mark.parametrize("command", ["check", "run", "stations"])
def test_commands_warn_of_the_place(tmp_path, command):
    scenario = tmp_path / "room.yaml"
    copies = [
        {"name": "Room", "box": [8, 6, 3], "at": [[*ORIGIN, 0]]},
        {"name": "Chimney", "box": [1, 1, 1], "at": [[*ORIGIN, 3]]},
    ]
    scene = {"copies": copies, "ground": {"height_m": -0.1, "margin_m": 3}}
    world = {"epsg": 25832, "origin": ORIGIN}
    data = {**PLAN, "scene": scene, "poses": [[*ORIGIN, 1]], "world": world}
    scenario.write_text(yaml.safe_dump(data))
    options = {
        "check": [],
        "run": ["--out", f"{tmp_path}/out", "--cloud-only"],
        "stations": ["--sensor", "riegl-vz400", "--count", "1", "--out", f"{tmp_path}/plan"],
    }
    outcome = CliRunner().invoke(cli, [command, str(scenario), *options[command]])
    assert outcome.exit_code == 0, outcome.output
    problem = "The scene is at x 1,000,000, y 10,800,000, outside the"
    assert outcome.output.count(problem) == 1
    if command == "run":
        [note] = json.loads((tmp_path / "out/report.json").read_text())["notes"]
        assert note.startswith(problem)
        assert "points in the cloud on 1 of 3 objects" in outcome.output  # all in the room
    if command == "stations":  # the scenario has the same origin, and the warning as a comment
        planned = (tmp_path / "plan/stations.yaml").read_text()
        assert f"# Warning: {problem}" in planned
        assert yaml.safe_load(planned)["world"] == {"epsg": 25832, "origin": [*ORIGIN, 0]}


def test_results_of_python_note_the_place():
    """Whoever makes a job, its result has the warning among its notes."""
    job = job_of(world={"epsg": 25832, "origin": [0, 0]})
    assert job.location_warning.startswith("The scene is at x 0, y 0, outside the area of use")
    assert job_of(world={"epsg": 25832, "origin": ORIGIN}).location_warning == ""


def test_projected_coordinates_without_a_system_are_noted(tmp_path):
    """The note and the axes of a mesh from the command line, and of a scenario with the mesh."""
    x, y = ORIGIN
    corners = [(0, 0, 0), (9, 0, 0), (0, 9, 0), (0, 0, 9)]
    lines = [f"v {x + a} {y + b} {c}" for a, b, c in corners] + ["f 1 3 2", "f 1 2 4", "f 1 4 3"]
    (tmp_path / "house.obj").write_text("\n".join(lines) + "\n")
    plan = {"poses": [[x - 3, y - 3, 1]]}

    def checked(name, **sections):
        if sections:
            data = {**plan, **sections}
            (tmp_path / name).write_text(yaml.safe_dump(data))
        outcome = CliRunner().invoke(cli, ["check", str(tmp_path / name), "--json"])
        assert outcome.exit_code == 0, outcome.output
        return json.loads(outcome.stdout)["notes"]

    def noted(notes):
        return [note for note in notes if "probably projected coordinates" in note]

    of_mesh = checked("house.obj")
    [note] = noted(of_mesh)
    assert note.startswith("the scene is at x 500,00") and "Set `world: {epsg: CODE}`" in note
    [axes] = [note for note in of_mesh if "does not state its axes" in note]
    assert "set `--up-axis y`. To silence this note, pass `--up-axis` explicitly" in axes
    assert "up_axis:" not in axes
    of_scenario = checked("far.yaml", scene="house.obj")
    assert len(noted(of_scenario)) == 1
    [axes] = [note for note in of_scenario if "does not state its axes" in note]
    assert "set {file: …, up_axis: y}" in axes and "--up-axis" not in axes
    assert not noted(checked("known.yaml", scene="house.obj", world={"epsg": 25832}))
    near = {"scene": {"files": [{"file": "house.obj", "translation": [-x, -y, 0]}]}}
    assert not noted(checked("near.yaml", **near, poses=[[-3, -3, 1]]))


@pytest.mark.slow
def test_stations_and_check_name_the_system(tmp_path):
    scenario = tmp_path / "room.yaml"
    ground = {"height_m": 0, "margin_m": 3}
    data = {**PLAN, "scene": {**ROOM, "ground": ground}, "world": {"epsg": 25832, "origin": ORIGIN}}
    scenario.write_text(yaml.safe_dump(data))
    shown = CliRunner().invoke(cli, ["check", str(scenario)]).output
    assert (
        "world       EPSG:25832 (ETRS89 / UTM zone 32N); (500,000, 5,400,000, 0) m is added"
        in shown
    )
    assert "x -7.00 to 7.00, y -6.00 to 6.00, z 0.00 to 3.00" in shown
    options = ["--sensor", "riegl-vz400", "--count", "1", "--out", f"{tmp_path}/plan", "--json"]
    outcome = CliRunner().invoke(cli, ["stations", str(scenario), *options])
    assert outcome.exit_code == 0, outcome.exception
    figures = json.loads(outcome.stdout)
    assert np.abs(figures["stations"][0]["position"]).max() < 10
    assert (figures["epsg"], figures["world_origin"]) == (25832, [500_000, 5_400_000, 0])
    planned = Scenario.load(Path(tmp_path / "plan/stations.yaml"))
    assert planned.world.origin == (500_000, 5_400_000, 0) and planned.world.epsg == 25832
    assert np.abs(planned.poses[0].position).max() < 10
