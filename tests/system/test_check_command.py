"""`lidarpool check`: what it says beforehand is what a run then does."""

import json
import re
import shlex
import shutil
from collections import namedtuple
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml
from distributed import Client
from tests.clusters import thread_cluster
from tests.meshes import PLY

import lidarpool.run.forecast
from lidarpool import (
    Fault,
    Mounted,
    Noise,
    Returns,
    Scene,
    SceneMesh,
    Sensor,
    Survey,
    Track,
    box,
    read_cloud,
    simulate,
)
from lidarpool.run.forecast import forecast
from lidarpool.run.options import RunOptions
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenes.writers.scene_file import write_scene
from lidarsim.scene.scene_mesh import Cutout
from lidarsim.simulator.rig import Rig
from lidarsim.simulator.sampling import sample_survey
from raybeam import available_backends

SHORT = {"scene": "seed", "sensor": {"layers": 8}, "pool": {"backend": "numpy"}}
PLANNED = SHORT | {"planning": {"start": [25, 25], "target": [-30, -20], "trials": 4}}
Usage = namedtuple("Usage", "total used free")


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """Address of a cluster without OTHER whose workers are threads of this process."""
    with thread_cluster({"GPU": 1}, {"LIDAR": 4}) as cluster:
        yield cluster.scheduler_address


@pytest.fixture
def check(tmp_path, lidarpool) -> Callable[..., Any]:
    """Check a scenario whose result would go to the folder `out`."""

    def check(*options: object, text: str = json.dumps(SHORT)) -> Any:
        (tmp_path / "s.yaml").write_text(text)
        return lidarpool("check", tmp_path / "s.yaml", "--out", tmp_path / "out", *options)

    return check


@pytest.mark.extended
def test_clear_air_leaves_all_of_the_light(tmp_path, lidarpool):
    (tmp_path / "clear.yaml").write_text("scene: seed\nweather: {visibility_km: 1000}\n")
    shown = lidarpool("check", tmp_path / "clear.yaml").out
    assert "air         extinction 0.00135/km: 100 % of the light returns from 50 m\n" in shown


@pytest.mark.extended
def test_what_is_counted_and_needed_is_what_a_run_gives(cluster, tmp_path):
    job = prepare(Scenario.from_data(SHORT), plans=False).job
    with Client(cluster, set_as_default=False) as client:
        made = forecast(job, tmp_path, RunOptions(backend="numpy"), client)
        result = simulate(
            job.scene, job.survey, client=client, backend="numpy", folder=tmp_path / "run"
        )
    estimate = {"rays": 24_000, "hits": result.hit_count, "points": len(result.points)}
    assert made["estimate"] == estimate and result.rays == 24_000
    assert made["precision_m"] == 0.001
    kept = sum(path.stat().st_size for path in (tmp_path / "run" / "parts").iterdir())
    assert 0.5 * kept < made["disk"]["parts"]
    assert made["disk"]["result"] > len(result.points) * 22


CYLINDER = trimesh.creation.cylinder(0.5, 4.0)
AROUND = [(3 * np.cos(angle), 3 * np.sin(angle), 0) for angle in np.linspace(0, 6, 20)]
TWO = [
    Mounted(Sensor.grid(1000, layers=32, step_deg=step, max_range_m=50), name=f"{step}")
    for step in (9, 20)
]
DRIVE = Track([0, 4], [(-4, -3, 0), (5, -3, 0)])


SURVEYS = {
    "sub-rays": Survey(Sensor.grid(), poses=AROUND, returns=Returns(subrays=61, divergence_mrad=3)),
    "dense": Survey(Sensor.grid(10_000, layers=200), poses=AROUND[:2], keep_every=7),
    "many stations": Survey(Sensor.grid(200, layers=2), poses=AROUND * 40, keep_every=7),
    "two sensors": Survey(sensors=TWO, trajectory=DRIVE),
    "many scans": Survey(Sensor.grid(100, layers=40, rate_hz=500), trajectory=DRIVE),
    "of channels": Survey(
        Sensor.grid(10_000, layers=200),
        poses=AROUND[:2],
        noise=Noise(channel_bias_m=[0.01] * 200, ripple_deg=0.01),
        faults=[Fault("dead_channels", channels=[199])],
    ),
}


@pytest.mark.extended(keep=("dense",))
@pytest.mark.slow(keep=("dense", "two sensors", "of channels"))
@pytest.mark.parametrize("name", SURVEYS)
def test_an_estimate_is_near_what_a_run_gives(name):
    """Of a thing that fills some scans and is in few of them."""
    survey = SURVEYS[name]
    scene = Scene.from_meshes([SceneMesh("Cylinder", CYLINDER.vertices, CYLINDER.faces)])
    made = sample_survey(scene, survey, "numpy")
    assert made["rays"] < survey.ray_count
    rig = Rig(scene, survey)
    found = [one for k in range(0, survey.scan_count, 36) for one in cast(rig, k)]
    assert made["points"] == pytest.approx(sum(map(len, found)), rel=0.05)
    assert made["hits"] == pytest.approx(sum(one.hit_counts.sum() for one in found), rel=0.05)


def cast(rig: Rig, first: int) -> Iterator[Any]:
    return rig.cast(first, min(first + 36, rig.survey.scan_count))


def test_it_tells_what_a_run_would_do_and_starts_nothing(check, tmp_path):
    outcome = check(text=json.dumps(PLANNED))
    assert outcome.code == 0
    for said in (
        "6 objects, 76,800 triangles",
        "108 scans (3 sweeps) from 3 poses, 24,000 rays",
        "4 trials",
    ):
        assert said in outcome.out
    last = outcome.out.splitlines()[-1]
    assert (
        last
        == f"The scenario can be run: lidarpool run {tmp_path / 's.yaml'} --out {tmp_path / 'out'}"
    )
    assert [path.name for path in tmp_path.iterdir()] == ["s.yaml"]


@pytest.mark.extended
def test_the_performance_of_each_sensor_is_named(check):
    assert "\nperformance ideal\n" in check().out
    vlp16 = {"model": "velodyne/vlp16"}
    by_sheet = vlp16 | {"performance": "datasheet"}
    for changed, words in (
        ({"sensors": {"roof": by_sheet, "nose": vlp16}}, "roof: datasheet; nose: ideal"),
        ({"sensor": by_sheet, "noise": {"dropout": 0.1}}, "datasheet except for noise"),
        ({"sensor": vlp16, "returns": {"mode": "dual"}}, "ideal except for returns"),
    ):
        scenario = {name: SHORT[name] for name in SHORT.keys() - {"sensor"}} | changed
        assert f"\nperformance {words}\n" in check(text=json.dumps(scenario)).out


def test_json_is_all_that_is_printed(check):
    outcome = check("--json")
    assert (outcome.code, outcome.err) == (0, "")
    said = json.loads(outcome.out, parse_constant=pytest.fail)
    assert said["can_run"] is True and said["reasons"] == []
    assert (said["scans"], said["rays"], said["trials"]) == (108, 24_000, 0)
    assert said["backend"] == "numpy"
    assert said["estimate"]["points"] > 0
    assert list(said["slots"]) == ["GPU", "LIDAR"]
    assert said["disk"]["free"] > said["disk"]["result"] > 0
    assert said["memory"]["needed"] > 200e6


def test_each_file_has_a_line_that_says_what_it_gave(check, tmp_path):
    road = Path(__file__).parents[2] / "examples" / "road.glb"
    shutil.copy(road, tmp_path)
    (tmp_path / "m.ply").write_text(PLY)
    scenario = SHORT | {"scene": ["road.glb", "m.ply"], "poses": [[0, 0, 2]]}
    scenario["scene"] = {"files": ["road.glb", {"file": "m.ply", "unit": "cm"}]}
    scenario["scene"]["copies"] = [
        {"name": "P", "file": "p.ply", "at": [[k, 0, 5] for k in range(4)]}
    ]
    write_scene(tmp_path / "p.ply", Scene.from_meshes([box("Post", (1, 1, 2))]))
    told = check(text=json.dumps(scenario)).out
    lines = [line[12:] for line in told.splitlines() if line.startswith("file  ")]
    assert lines == [
        "road.glb: 4 objects, 38 triangles, in m, Y-up",
        "m.ply: 1 object, 2 triangles, in cm, Z-up",
        "p.ply: 1 object, 12 triangles, in m, Z-up, 4 copies",
    ]
    scenario["cloud"] = {"columns": ["red"]}
    told = check(text=json.dumps(scenario)).out
    assert "38 triangles, in m, Y-up, 1 texture, 2 plain colors\n" in told
    assert "in cm, Z-up, no colors\n" in told and "are gray" not in told
    scenario["materials"] = [
        {"objects": "m", "reflectance": 0.5}, {"objects": "*", "reflectance": "texture"}
    ]  # fmt: skip
    told = check(text=json.dumps(scenario)).out
    assert (
        "note: 4 of 8 objects with `reflectance: texture` have no colors and are treated as gray: "
        in told
    )
    assert "gray: P, P.2, P.3, …\n" in told


def test_objects_with_masks_are_named(check, tmp_path):
    plate = np.eye(3) * 3
    cut = Cutout(np.eye(2, dtype=bool), np.zeros((1, 3, 2), np.float32))
    meshes = [SceneMesh(f"Bush {i}", plate + i, np.array([[0, 1, 2]]), (cut,)) for i in range(4)]
    floor = SceneMesh("Floor", plate, np.array([[0, 1, 2]]))
    write_scene(tmp_path / "m.glb", Scene.from_meshes([floor, *meshes]))
    scenario = SHORT | {"scene": "m.glb", "poses": [[0, 0, 2]]}
    told = check(text=json.dumps(scenario)).out
    assert "masks       4 objects have masks: Bush 0, Bush 1, Bush 2, …\n" in told
    said = json.loads(check("--json", text=json.dumps(scenario)).out)
    assert said["masked"] == [f"Bush {i}" for i in range(4)]
    scenario["scene"] = {"files": [{"file": "m.glb", "opacity": "ignore"}]}
    assert "have masks" not in check(text=json.dumps(scenario)).out


@pytest.mark.extended
def test_objects_that_sensors_do_not_see_are_named(check):
    names = list(Scene.seed().names)
    seats = {"front": {"unseen": [names[0], names[1]]}, "rear": {}, "blind": {"unseen": "*"}}
    scenario = SHORT | {"sensors": {k: SHORT.get("sensor", {}) | v for k, v in seats.items()}}
    scenario.pop("sensor", None)
    told = check(text=json.dumps(scenario)).out
    assert f"unseen      by front, 2 objects: {names[0]}, {names[1]}\n" in told
    assert f"unseen      by blind, 6 objects: {', '.join(names[:3])} and 3 more\n" in told
    said = json.loads(check("--json", text=json.dumps(scenario)).out)
    assert said["unseen"] == {"front": names[:2], "blind": names}
    scenario["sensors"]["rear"]["unseen"] = "Nobody"
    outcome = check(text=json.dumps(scenario))
    assert outcome.code == 2 and "unseen of sensor 'rear' contains 'Nobody'" in outcome.err
    assert f"Available names: {names[0]}, " in outcome.err
    told = check(text=json.dumps(SHORT | {"sensor": {"unseen": "*"}})).out
    assert "no ray hits a surface at any distance. Check unseen, poses and units" in told


def test_a_disk_without_room(check, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Usage(10**9, 10**9, 1_000_000))
    outcome = check()
    assert outcome.code == 2
    assert (
        "The scenario cannot be run. The disk of" in outcome.err
        and "has 0.95 MiB free" in outcome.err
    )
    assert "The scenario can be run" not in outcome.out


@pytest.mark.extended
def test_what_the_cloud_is_exported_to_counts(check, monkeypatch):
    kept = {"cloud": {"columns": ["intensity", "time"]}}  # as the layout would
    plain = json.loads(check("--json", text=json.dumps(SHORT | kept)).out)
    exported = json.dumps(SHORT | kept | {"output": {"write": ["ply", "las", "mcap"]}})
    said = json.loads(check("--json", text=exported).out)
    least = 2 * 20 * said["estimate"]["points"]
    assert said["disk"]["result"] > plain["disk"]["result"] + least
    monkeypatch.setattr("lidarfiles.clouds.format_row.find_spec", lambda name: None)
    outcome = check(text=exported)
    assert outcome.code == 2
    assert (
        'The scenario cannot be run:\nThe format las requires laspy and lazrs. Run pip install -e "'
        in outcome.err
    )


def test_an_error_of_several_jobs_is_a_line_with_its_jobs(tmp_path, lidarpool):
    trees = [[x, 5, 0] for x in range(9)]
    copies = [{"name": "tree", "box": [1, 1, 4], "at": trees}]
    base = SHORT | {"scene": {"preset": "seed", "copies": copies}}
    base["actors"] = [{"name": "Van", "box": [5, 2, 2], "at": [9, 9, 0]}]
    base["materials"] = [{"objects": "*"}]
    (tmp_path / "base.yaml").write_text(json.dumps(base))
    vary = {
        "materials.0.objects": {"each": ["Street*", "Hose", "Street*"]},
        "noise.range_m": {"uniform": [0.01, 0.02]},
    }
    campaign = {"base": "base.yaml", "count": 3, "vary": vary}
    (tmp_path / "c.yaml").write_text(json.dumps(campaign))
    outcome = lidarpool("check", tmp_path / "c.yaml", "--out", tmp_path / "out")
    assert outcome.code == 2
    start, streets, house = outcome.err.splitlines()[-3:]
    assert start == "lidarpool: None of the 3 checked jobs can be run."
    assert streets.startswith("jobs 0000, 0002: ") and streets.count("Street*") == 1
    assert streets.endswith("Similar names: tree* (9).")
    assert house.startswith("job 0001: ")


def test_all_reasons_are_given_at_once(check, tmp_path, monkeypatch):
    monkeypatch.setattr(lidarpool.run.forecast, "MEMORY_LIMIT", 1_000_000)
    (tmp_path / "out").write_text("")
    outcome = check("--json")
    assert outcome.code == 2
    said = json.loads(outcome.out)
    assert said["can_run"] is False
    assert len(said["reasons"]) == 3 and said["estimate"] is None
    assert "is a file" in said["reasons"][0]
    assert "Casting one scan takes about 1 MB, but a casting worker" in said["reasons"][1]
    assert "0.95 MiB of memory are available" in said["reasons"][2]


def test_a_scenario_with_errors_gives_json_too(check):
    outcome = check("--json", text=json.dumps(SHORT | {"poses": [[0, 0]]}))
    assert outcome.code == 2 and "poses[0].position[2] is required" in outcome.err
    said = json.loads(outcome.out)
    assert said["can_run"] is False and said["notes"] == []
    assert f"lidarpool: {said['reasons'][0]}" == outcome.err.strip()
    assert check(text="poses: 7").out == ""


def test_a_backend_that_is_not_here(check, monkeypatch):
    if not available_backends()["cuda"]:
        pytest.skip("there is a GPU")
    outcome = check("--backend", "cuda")
    assert (
        outcome.code == 2
        and "The scenario cannot be run. Backend 'cuda' cannot be used" in outcome.err
    )
    assert re.search(
        r"^cast by     \d+ casting workers? \(backend not yet known\)$", outcome.out, re.M
    )


def test_a_survey_that_hits_nothing_is_told_of(check):
    outcome = check("--json", text=json.dumps(SHORT | {"poses": [[0, 0, 1000]]}))
    assert outcome.code == 0
    [warning] = json.loads(outcome.out)["warnings"]
    assert "the cloud has no points: no ray hits a surface at any distance" in warning
    poses = yaml.safe_load(warning.partition("poses: ")[2])
    seen = check("--json", text=json.dumps(SHORT | {"poses": poses}))
    assert json.loads(seen.out)["estimate"]["hits"] > 0


def test_an_object_is_looked_at_from_around_it_and_no_gpu_is_spoken_of(tmp_path, lidarpool):
    (tmp_path / "ball.stl").write_bytes(trimesh.creation.icosphere(3, 0.5).export(file_type="stl"))
    outcome = lidarpool("check", tmp_path / "ball.stl")
    assert outcome.code == 0
    assert "from 5 poses" in outcome.out and "points      about 0 " not in outcome.out
    assert "hits, rounded to 0.001 m;" in outcome.out
    assert (
        "note: the scene was recognized as an object of 1 x 1 x 1 m, so the default is"
        in outcome.out
    )
    assert "worker with a GPU" not in outcome.out
    backend = next(name for name, missing in available_backends().items() if not missing)
    kind = "GPU" if backend == "cuda" else "CPU"
    assert re.search(
        rf"^cast by     \d+ casting workers? \({kind}, {backend}\)$", outcome.out, re.M
    )


@pytest.mark.slow
def test_options_describe_the_survey_of_a_mesh(cluster, tmp_path, lidarpool):
    mesh = trimesh.creation.box((8000, 3000, 6000))
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "my part.stl").write_bytes(mesh.export(file_type="stl"))
    options = ["--sensor", "vlp16", "--unit", "mm", "--up-axis", "y", "--pose", "-1,0,0.5"]
    options += ["--pose", "1,0,1.9", "--columns", "range,intensity", "--format", "las"]
    with_options = ["there/my part.stl", *options, "--scheduler", cluster]
    outcome = lidarpool("check", *with_options)
    assert outcome.code == 0, outcome.err
    assert (
        "size        8.00 x 6.00 x 3.00 m" in outcome.out
        and "72 scans (2 sweeps) from 2" in outcome.out
    )
    words = shlex.split(outcome.out.splitlines()[-1].partition("The scenario can be run: ")[2])
    assert words[:14] == ["lidarpool", "run", "there/my part.stl", *options[:11]]
    assert lidarpool(*words[1:], "--cloud-only", "--quiet").code == 0
    # The scenario that init writes of the same options gives the same.
    assert lidarpool("init", "a/b", "--mesh", "there/my part.stl", *options).code == 0
    of_scenario = ["--scheduler", cluster, "--out", "second", "--cloud-only"]
    assert lidarpool("run", "a/b/scenario.yaml", *of_scenario).code == 0
    for name in ("cloud.ply", "cloud.las"):
        made = [(tmp_path / f / name).read_bytes() for f in ("lidarpool-out", "second")]
        assert made[0] == made[1]
    cloud = read_cloud(tmp_path / "second" / "cloud.ply")
    assert {"range", "intensity"} <= cloud.columns.keys()


@pytest.mark.extended
def test_a_flight_is_told_by_its_lines_without_turns(check):
    """Lines of 200 cycles a second at 60 m/s, and a turn at half that speed."""
    way = [(0, 0, 0), (2, 120, 0), (6, 360, 0), (8, 480, 0), (14, 560, 60), (20, 480, 120)]
    way += [(22, 360, 120), (26, 120, 120), (28, 0, 120)]
    points = [{"time_s": t, "position": [x, y, 300]} for t, x, y in way]
    scenario = {
        "scene": {"ground": {}},
        "trajectory": {"points": points},
        "sensor": "airborne/riegl-vq780i",
        "pool": {"backend": "numpy"},
    }
    drive = json.loads(check("--json", text=json.dumps(scenario)).out)["drive"]
    assert drive["lines"]["count"] == 4, "straight lines between poses, two of them in the turn"
    scenario["trajectory"]["interpolation"] = "smooth"
    drive = json.loads(check("--json", text=json.dumps(scenario)).out)["drive"]
    assert drive["lines"]["count"] == 2
    assert drive["lines"]["seconds"] == pytest.approx(15, abs=1.5)
    [scanner] = drive["sensors"]
    assert scanner["meters_a_turn"] == pytest.approx(60 / 200, rel=0.02)
    assert drive["meters"] / drive["seconds"] / 200 < 0.95 * scanner["meters_a_turn"]
    told = check(text=json.dumps(scenario)).out
    model = scenario.pop("sensor")
    scenario["sensors"] = {"turn": {"model": model, "start_s": 12, "steps": 5400}}
    drive = json.loads(check("--json", text=json.dumps(scenario)).out)["drive"]
    [turn] = drive["sensors"]
    assert drive["lines"] is None
    assert turn["meters_a_turn"] < 0.95 * scanner["meters_a_turn"], "it fires during the turn only"
    assert re.search(
        r"^trajectory  .* s; 2 scanned flight lines, [\d,]+ m in 1\d\.\d s$", told, re.M
    )
    assert re.search(r"the platform moves 0\.30\d m per cycle on the flight lines$", told, re.M)


def test_an_unfinished_run_is_told_of(check, tmp_path):
    (tmp_path / "out" / "run").mkdir(parents=True)
    (tmp_path / "out" / "run" / "run.db").write_bytes(b"")
    outcome = check()
    assert outcome.code == 0
    assert "contains an unfinished run. Continue it with `--resume`" in outcome.out


@pytest.mark.slow
def test_the_command_that_is_named_runs_where_another_result_is(
    check, cluster, tmp_path, lidarpool
):
    first = SHORT | {"steps": 3}
    (tmp_path / "s.yaml").write_text(json.dumps(first))
    given = ("--out", tmp_path / "out", "--cloud-only", "--scheduler", cluster)
    assert lidarpool("run", tmp_path / "s.yaml", *given).code == 0
    for k, number in enumerate((2, 3), 4):  # a result of another survey is in the way each time
        outcome = check("--scheduler", cluster, text=json.dumps(SHORT | {"steps": k}))
        assert "contains the result of a different survey" in outcome.out
        words = shlex.split(outcome.out.splitlines()[-1].partition("The scenario can be run: ")[2])
        assert str(tmp_path / f"out-{number}") in words
        assert lidarpool(*words[1:], "--cloud-only").code == 0


def test_workers_that_cast_are_no_gpus_without_any(check):
    outcome = check()
    assert re.search(r"^cast by     \d+ casting workers? \(CPU, numpy\)$", outcome.out, re.M)
    assert re.search(
        r"^casting     \d+ slots? in partition GPU, at least 1 needed$", outcome.out, re.M
    )


def test_a_cluster_that_can_do_it(check, cluster):
    outcome = check("--scheduler", cluster)
    assert outcome.code == 0, outcome.err
    assert "LIDAR       4 slots, at least 4 needed" in outcome.out
    assert "partition GPU has no worker" not in outcome.out, "nobody expects one"
    assert f"--scheduler {cluster}" in outcome.out.splitlines()[-1]


def test_a_cluster_that_lacks_a_partition(check, cluster):
    outcome = check("--scheduler", cluster, "--json", text=json.dumps(PLANNED))
    assert outcome.code == 2
    said = json.loads(outcome.out)
    assert said["slots"]["OTHER"] == {"needed": 1, "there": 0}
    assert "Partition 'OTHER' has 0 of the 1 required slot" in said["reasons"][0]
    assert said["reasons"][0] in outcome.err


@pytest.mark.parametrize(("size", "unit"), [((400, 300, 250), "mm"), ((8, 6, 3), None)])
def test_sizes_that_speak_of_another_unit(size, unit, check, tmp_path, lidarpool):
    mesh = trimesh.creation.box(size)
    (tmp_path / "my box.stl").write_bytes(mesh.export(file_type="stl"))
    outcome = lidarpool("check", tmp_path / "my box.stl")
    assert outcome.code == 0
    assert ("my box.stl states no unit" in outcome.out) == (unit is not None)
    assert unit is None or f"possibly {unit}), or" in outcome.out
    assert unit is None or f"or pass `--unit {unit}` with a mesh file" in outcome.out
    given = check(text="scene: {files: [{file: my box.stl, unit: m}]}")
    assert given.code == 0 and "states no unit" not in given.out
