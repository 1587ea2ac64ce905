"""Campaigns: many jobs into one data set, whatever happens to workers, drivers and single jobs."""

import json
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from distributed import Client
from tests.clusters import thread_cluster
from tests.daemons import wait_until
from tests.killed_drivers import drive

import lidarpool.run.cluster.cluster
import lidarpool.run.writer
from lidarfiles.clouds.built_in_formats import DATA_SETS
from lidarfiles.datasets.dataset import DataSet
from lidarfiles.datasets.job_table import JobRow
from lidarfiles.identity.sealed import seal_json, unseal_json
from lidarpool import (
    Campaign,
    Job,
    LidarError,
    Material,
    Mounted,
    Scene,
    Sensor,
    Survey,
    simulate,
    sweeps,
)
from lidarpool.report.campaign_output import verify_dataset
from lidarpool.run.progress import Progress
from lidarsim.errors import explain_os_errors
from lidarsim.io.storage import Storage

BASE = """
sensor: {rays_per_revolution: 180, layers: 4, step_deg: 4}
poses: [[0, 0, 1]]
steps: 45
scene: seed
pool: {backend: numpy, gpu: 1}
"""
CAMPAIGN = """
base: base.yaml
count: 6
seed: 3
vary:
  noise.range_m: {uniform: [0.001, 0.05]}
  sensor.layers: {each: [2, 3, 4]}
keep: folder
"""
SLOTS = ({"GPU": 1}, {"LIDAR": 5})


@pytest.fixture(scope="module")
def slots() -> Iterator[str]:
    """Address of a cluster with the slots of a campaign."""
    with thread_cluster(*SLOTS) as cluster:
        yield cluster.scheduler_address


@pytest.fixture
def client(slots: str) -> Iterator[Client]:
    with Client(slots, set_as_default=False) as client:
        yield client


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """A folder with a campaign of six jobs."""
    (tmp_path / "base.yaml").write_text(BASE)
    (tmp_path / "c.yaml").write_text(CAMPAIGN)
    return tmp_path


def bytes_of(dataset: Path) -> dict[str, bytes]:
    """Bytes of the files of the jobs of a data set, and of its table of jobs if there is one."""
    names = re.compile(r"\.?jobs/|jobs\.")
    return {name: data for name, data in all_bytes_of(dataset).items() if names.match(name)}


def all_bytes_of(dataset: Path) -> dict[str, bytes]:
    """Bytes of each file of a data set, but of its report and of its unfinished run."""
    paths = {str(path.relative_to(dataset)): path for path in dataset.rglob("*") if path.is_file()}
    of_run = re.compile(r"run/|report\.(html|json|csv)$")
    return {name: path.read_bytes() for name, path in paths.items() if not of_run.match(name)}


@pytest.fixture(scope="module")
def finished(slots: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data set of a run that nobody disturbs, to be copied."""
    folder = tmp_path_factory.mktemp("whole")
    (folder / "base.yaml").write_text(BASE)
    (folder / "c.yaml").write_text(CAMPAIGN)
    with Client(slots, set_as_default=False) as client:
        assert Campaign.load(folder / "c.yaml").run(folder / "ds", client=client).done == 6
    return folder / "ds"


@pytest.fixture(scope="module")
def whole(finished: Path) -> dict[str, bytes]:
    """The jobs' files in it."""
    return bytes_of(finished)


SENSOR = Sensor.grid(rays_per_revolution=90, layers=2, step_deg=4)


def make(number: int, rng: np.random.Generator) -> Job:
    """A job that differs from the others in its pose."""
    return job(SENSOR, number)


def job(sensor: Sensor, number: int, **survey: Any) -> Job:
    what = Survey(sensor, [(number, 0, 1)], steps=45, keep_every=1, **survey)
    return Job(Scene.seed(), what, values={"x": number})


@pytest.mark.slow
@pytest.mark.slow(keep=("kitti",))
@pytest.mark.parametrize("keep", ["kitti", "nuscenes"])
def test_names_of_classes_are_in_the_data_set_and_its_card(client, tmp_path, keep):
    names = {40: "road", 10: "car"}
    sensor = Sensor.grid(360, 20, step_deg=4)

    def make_named(number: int, rng: np.random.Generator) -> Job:
        return job(sensor, number, materials=[Material("*", semantic_class=40)], classes=names)

    run = Campaign(make_named, 2, keep=keep).run(tmp_path / "ds", client=client)
    assert run.classes == sweeps(tmp_path / "ds").classes == names
    assert "| 40 road |" in (tmp_path / "ds/README.md").read_text()
    assert verify_dataset(Storage.at(tmp_path / "ds")).endswith("is intact, with 2 jobs")
    again = Campaign(make_named, 2, keep=keep).run(tmp_path / "ds", client=client, overwrite=True)
    assert again.done == 2, "all files are known as the data set's own"


@pytest.mark.extended
def test_a_note_says_which_sensor_is_lidar_top_of_nuscenes(client, tmp_path):
    def make_named(number: int, rng: np.random.Generator) -> Job:
        sensor = Sensor.grid(360, 20, step_deg=4)
        roof = Mounted(sensor, name="roof" if number else "LIDAR_TOP")
        what = Survey(sensors=[roof], poses=[(number, 0, 1)], steps=45)
        return Job(Scene.seed(), what, values={"x": number})

    run = Campaign(make_named, 3, keep="nuscenes").run(tmp_path / "ds", client=client)
    (note,) = run.notes
    assert "'roof' is renamed to 'LIDAR_TOP'" in note
    assert {sweep.sensor for sweep in sweeps(tmp_path / "ds")} == {"roof", "LIDAR_TOP"}
    assert [path.name for path in (tmp_path / "ds/samples").iterdir()] == ["LIDAR_TOP"]


# -- each job alone -------------------------------------------------------------------------------


@pytest.mark.slow
def test_each_job_alone_has_the_bytes_of_the_data_set(files, whole, lidarpool, slots):
    run = ["run", files / "c.yaml", "-q", "--scheduler", slots, "--cloud-only"]
    out = files / "job-5"
    done = lidarpool(*run, "--job", 5, "--out", out)
    assert (done.code, done.err) == (0, "")
    assert (out / "cloud.ply").read_bytes() == whole["jobs/0005/cloud.ply"]


@pytest.mark.slow
def test_any_number_of_workers_gives_the_same_bytes(files, whole):
    many = ({"GPU": 1}, {"GPU": 2, "A": 1}, {"LIDAR": 6}, {"LIDAR": 2, "A": 1})
    with thread_cluster(*many) as cluster, Client(cluster, set_as_default=False) as client:
        run = Campaign.load(files / "c.yaml").run(files / "ds", client=client)
    assert (run.done, run.failed, run.resumed) == (6, (), 0)
    scans = {stage.stage: stage.items for stage in run.stages}
    assert scans["export"] == scans["collect"] == 6 * 45
    assert bytes_of(files / "ds") == whole
    assert not (files / "ds" / "run").exists()


TWICE = """
base: parts/base.yaml
count: 5
seed: 2
vary:
  noise.range_m: {uniform: [0.001, 0.05]}
  trajectory: {each: [way.tum, way.tum, cut.tum]}
  actors.0.class: {choice: [3, 4]}
keep: FORMAT
splits: {train: 0.5, test: 0.5}
"""
TWICE_BASE = """
trajectory: way.tum
sensors: {roof: {model: velodyne/vlp16}, nose: {model: velodyne/vlp16, mount: [1, 0, 0]}}
actors: [{name: Car, box: [4, 2, 1.5], at: {position: [6, 0, 0]}}]
cloud: {columns: [class, time, intensity]}
scene: seed
pool: {backend: numpy, gpu: 1}
"""


@pytest.mark.usefixtures("pictures")
@pytest.mark.slow
@pytest.mark.slow(keep=("folder",))
@pytest.mark.parametrize("kept", DATA_SETS)
def test_a_campaign_has_the_same_bytes_twice(slots, tmp_path, monkeypatch, kept):
    """In other folders, by other paths and with other workers; two jobs fail with a message."""
    for name in ("here", "elsewhere/far"):
        parts = tmp_path / name / "parts"
        parts.mkdir(parents=True)
        (parts / "base.yaml").write_text(TWICE_BASE)
        (parts / "way.tum").write_text("0 0 0 1 0 0 0 1\n0.1 1 0 1 0 0 0 1\n")
        (parts / "cut.tum").write_text("0 0 0 1\n")
        (parts.parent / "c.yaml").write_text(TWICE.replace("FORMAT", kept))
    here = tmp_path / "here"
    with Client(slots, set_as_default=False) as client:
        run = Campaign.load(here / "c.yaml").run(here / "ds", client=client)
    assert [row.number for row in run.failed] == [2] and run.done == 4
    monkeypatch.chdir(tmp_path / "elsewhere")
    many = ({"GPU": 1}, {"GPU": 2, "A": 1}, {"LIDAR": 5}, {"LIDAR": 2, "A": 1})
    with thread_cluster(*many) as cluster, Client(cluster, set_as_default=False) as client:
        Campaign.load("far/c.yaml").run("ds", client=client)
    first = all_bytes_of(here / "ds")
    assert all_bytes_of(tmp_path / "elsewhere" / "ds") == first
    assert {"jobs.csv", "jobs.parquet", "dataset.json", "campaign.json"} <= first.keys()
    assert {"README.md", "splits/train.txt", "pictures/results.png"} <= first.keys()
    assert b"c.yaml: job 2: parts/cut.tum is not a valid trajectory" in first["jobs.csv"]


# -- jobs that fail -------------------------------------------------------------------------------


def failing(*numbers: int) -> Callable[[int, np.random.Generator], Job]:
    def make_or_fail(number: int, rng: np.random.Generator) -> Job:
        if number in numbers:
            raise RuntimeError("no such street")
        return make(number, rng)

    return make_or_fail


@pytest.mark.slow(keep=("(0,)",))
@pytest.mark.parametrize("numbers", [(0,), (2,), (0, 1, 2)], ids=str)
def test_jobs_that_cannot_be_made(client, tmp_path, numbers):
    campaign = Campaign(failing(*numbers), 3, keep="folder")
    run = campaign.run(tmp_path / "ds", client=client)
    assert [row.number for row in run.failed] == [*numbers]
    assert all("RuntimeError: no such street" in row.error for row in run.failed)
    assert run.done == 3 - len(numbers)


def in_worker() -> bool:
    """Whether a worker calls: those of these tests are threads."""
    return "Dask-Default-Threads" in threading.current_thread().name


@dataclass(frozen=True, eq=False)
class Breaks(Sensor):
    """A sensor of a user's own that raises in a worker."""

    where: str = ""

    def directions(self, firings: Any) -> Any:
        if self.where == "cast" and in_worker():
            raise ZeroDivisionError("no direction")
        return super().directions(firings)

    def firings(self, step: int) -> tuple[int, int]:
        if self.where == "describe" and step == 44 and in_worker():
            raise ZeroDivisionError("no such step")
        return super().firings(step)


def breaking(where: str) -> Callable[[int, np.random.Generator], Job]:
    def make_one_that_breaks(number: int, rng: np.random.Generator) -> Job:
        breaks = Breaks(SENSOR.beams, head=SENSOR.head, where=where)
        return job(breaks if number == 1 else SENSOR, number)

    return make_one_that_breaks


WORDS = {"cast": "no direction", "describe": "ZeroDivisionError: no such step"}


@pytest.mark.extended
@pytest.mark.slow(keep=("cast",))
@pytest.mark.parametrize("where", WORDS)
def test_a_sensor_that_raises_in_a_worker_fails_its_job_only(client, tmp_path, where, left_over):
    run = Campaign(breaking(where), 4, keep="folder").run(tmp_path / "ds", client=client)
    assert [row.name for row in run.failed] == ["0001"] and run.done == 3
    assert WORDS[where] in run.failed[0].error and run.failed[0].values == {"x": 1}
    assert sorted(path.name for path in (tmp_path / "ds" / "jobs").iterdir()) == [
        "0000", "0002", "0003",
    ]  # fmt: skip
    assert left_over(client) == ([], [], [])


@dataclass(frozen=True, eq=False)
class Unpicklable(Sensor):
    """A sensor of a user's own that cannot be sent to workers."""

    def __reduce__(self) -> Any:
        raise TypeError("cannot pickle a laser")


@pytest.mark.extended
def test_jobs_that_cannot_be_sent_to_workers_fail_alone(client, tmp_path, left_over):
    kinds = (Unpicklable, Sensor, Unpicklable, Unpicklable, Sensor)

    def make_one(number: int, rng: np.random.Generator) -> Job:
        return job(kinds[number](SENSOR.beams, head=SENSOR.head), number)

    run = Campaign(make_one, 5, keep="folder").run(tmp_path / "ds", client=client)
    assert [row.number for row in run.failed] == [0, 2, 3] and run.done == 2
    unsent = "The survey cannot be sent to the workers: cannot pickle a laser."
    assert {row.error for row in run.failed} == {unsent}
    assert left_over(client) == ([], [], [])


@pytest.mark.extended
def test_a_job_that_cannot_be_written_fails_alone_and_leaves_nothing(client, tmp_path, monkeypatch):
    write = DataSet.write_job

    def fail(self: DataSet, row: JobRow, *arguments: Any, **more: Any) -> JobRow:
        if (made := write(self, row, *arguments, **more)).number == 1:
            raise ValueError("cannot be written")
        return made

    monkeypatch.setattr(DataSet, "write_job", fail)
    run = Campaign(make, 3, keep="folder").run(tmp_path / "ds", client=client)
    assert [row.name for row in run.failed] == ["0001"] and run.done == 2
    assert "cannot be written" in run.failed[0].error
    names = {Path(name).stem for name in bytes_of(tmp_path / "ds") if name.startswith(".jobs")}
    assert names == {"0000", "0001", "0002"}
    manifest = (tmp_path / "ds" / ".jobs" / "0001.json").read_text()
    assert '"files": {}' in manifest and "cannot be written" in manifest
    assert not (tmp_path / "ds" / "jobs" / "0001").exists()


@pytest.mark.extended
def test_a_broken_mesh_is_named_with_its_values(files, lidarpool, slots):
    (files / "base.yaml").write_text(BASE.replace("scene: seed", "scene: {files: {file: a.obj}}"))
    vary = "scene.files.0.file: {each: [a.obj, b.obj]}"
    (files / "c.yaml").write_text(f"base: base.yaml\ncount: 4\nvary: {{{vary}}}\nkeep: folder\n")
    (files / "a.obj").write_text("v -9 -9 0\nv 9 -9 0\nv 9 9 0\nf 1 2 3\n")
    (files / "b.obj").write_text("nothing")
    run = ["run", files / "c.yaml", "-q", "--scheduler", slots, "--out", files / "ds"]
    for option in ((), ("--resume",), ("--retry-failed",)):
        failed = lidarpool(*run, *option)
        assert failed.code == 2 and "Traceback" not in failed.err
        lines = failed.err.splitlines()
        assert lines[0] == "lidarpool: 2 jobs failed and 2 succeeded:"
        value = "(scene.files.0.file b.obj)"
        assert lines[1].startswith(f"jobs 0001 {value}, 0003 {value}: b.obj ")
        assert lines[2:] == ["To run the failed jobs again, use `--retry-failed`."]
    (files / "c.yaml").write_text((files / "c.yaml").read_text().replace("[a.obj", "[b.obj"))
    other = lidarpool(*run, "--resume")
    assert other.code == 2 and other.err.count("\n") == 1
    assert "the campaign has changed: vary.scene.files.0.file changed from " in other.err
    assert "b.obj" in other.err.partition("changed from ")[2]
    assert (
        "Only `pool` and `count` may change, and `count` must not decrease. Remove it" in other.err
    )
    assert "--restart" in other.err and "choose a different folder" in other.err


def third_if(there: Path, made: list[int]) -> Callable[[int, np.random.Generator], Job]:
    """Make jobs, the third of them with another sensor, and only if a file is there."""

    def make_if_there(number: int, rng: np.random.Generator) -> Job:
        made.append(number)
        if number == 2 and not there.exists():
            raise FileNotFoundError(there)
        return job(replace(SENSOR, name="new model" if number == 2 else "old model"), number)

    return make_if_there


@pytest.mark.extended
def test_failed_jobs_are_done_again_and_no_others(client, tmp_path):
    there = tmp_path / "there"
    made = []
    campaign = Campaign(third_if(there, made), 4, keep="folder")
    run = campaign.run(tmp_path / "ds", client=client)
    assert [row.number for row in run.failed] == [2] and run.done == 3
    assert run.sensors == {"lidar": "old model, 10 Hz"}
    before = bytes_of(tmp_path / "ds")
    with pytest.raises(LidarError, match=r"contains an unfinished run with 4 of 4 jobs"):
        campaign.run(tmp_path / "ds", client=client)
    assert campaign.run(tmp_path / "ds", client=client, resume=True).failed == run.failed
    there.touch()
    made.clear()
    again = campaign.run(tmp_path / "ds", client=client, retry_failed=True)
    assert (again.done, again.failed, again.resumed) == (4, (), 3)
    assert again.sensors == {"lidar": "new model, 10 Hz; old model, 10 Hz"}
    assert "new model, 10 Hz; old model, 10 Hz" in (tmp_path / "ds" / "README.md").read_text()
    assert set(made) <= {0, 2}  # the first says which values there are
    after = bytes_of(tmp_path / "ds")
    for name in (".jobs/0002.json", "jobs.csv", "jobs.parquet"):  # said that the job had failed
        before.pop(name)
    assert before.items() <= after.items() and len(after) > len(before)
    assert not (tmp_path / "ds" / "run").exists()
    assert campaign.run(tmp_path / "ds", client=client, retry_failed=True).done == 4


# -- damaged files, mended meshes, and more jobs --------------------------------------------------


def flip(path: Path) -> None:
    """Change a bit in the middle of a file."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


HARM = {
    "deleted": (Path.unlink, "jobs/0002/cloud.ply"),
    "cut": (cut, "jobs/0002/cloud.ply"),
    "flipped": (flip, "jobs/0002/sweeps.npz"),
    "manifest cut": (cut, ".jobs/0002.json"),
    "manifest flipped": (flip, ".jobs/0002.json"),
}


@pytest.mark.slow(keep=("manifest flipped",))
@pytest.mark.parametrize("harm", HARM)
def test_a_damaged_job_is_named_and_made_again(files, finished, whole, lidarpool, slots, harm):
    change, name = HARM[harm]
    run = ["run", files / "c.yaml", "--scheduler", slots, "--out", files / "ds"]
    shutil.copytree(finished, files / "ds")
    sound = lidarpool("run", "--verify", files / "ds")
    assert (sound.code, sound.out) == (0, f"{files / 'ds'} is intact, with 6 jobs\n")
    change(files / "ds" / name)
    for command in (["run", "--verify", files / "ds"], [*run, "-q", "--job", 2]):
        found = lidarpool(*command)
        assert found.code == 2
        assert f"damaged: job 0002 ({name} is missing or damaged). " in found.err
        assert "bit-identical" not in found.out and found.err.count("\n") == 1
    again = lidarpool(*run, "--verify" if harm == "flipped" else "--resume")
    assert again.code == 0 and "note: these jobs are run again: job 0002 (" in again.out
    assert bytes_of(files / "ds") == whole
    assert not (files / "ds" / "run").exists()


@pytest.mark.slow
def test_jobs_of_an_unfinished_campaign_are_looked_at(client, tmp_path):
    there = tmp_path / "there"
    campaign = Campaign(third_if(there, []), 4, keep="kitti")
    campaign.run(tmp_path / "ds", client=client)
    poses = tmp_path / "ds" / "sequences" / "01" / "poses.txt"
    before = poses.read_bytes()
    cut(poses)
    there.touch()
    run = campaign.run(tmp_path / "ds", client=client, resume=True)
    assert (run.done, run.resumed, len(run.failed)) == (3, 3, 1)  # the failed one stays
    assert poses.read_bytes() == before


def test_nothing_but_a_data_set_can_be_verified(files, lidarpool):
    (files / "report.json").write_text("{}")
    for place, says in (
        (files, "is not a lidarpool data set"),
        (files, "the two lines `base: scenario.yaml` and `keep: kitti`"),
        (files / "none", "does not exist"),
    ):
        refused = lidarpool("run", "--verify", place)
        assert refused.code == 2 and says in refused.err
    for option in (["--verify"], ["--job", 1], ["--retry-failed"]):
        refused = lidarpool("run", files / "base.yaml", "--out", files / "ds", *option)
        assert refused.code == 2 and "can only be used with campaigns" in refused.err


SQUARE = "v -9 -9 0\nv 9 -9 0\nv 9 9 0\nf 1 2 3\n"


@pytest.mark.slow
def test_a_mended_mesh_is_taken_and_another_is_not_mixed_in(files, lidarpool, slots):
    (files / "base.yaml").write_text(BASE.replace("scene: seed", "scene: {files: {file: a.obj}}"))
    vary = "scene.files.0.file: {each: [a.obj, b.obj, c.obj]}"
    (files / "c.yaml").write_text(f"base: base.yaml\nvary: {{{vary}}}\nkeep: folder\n")
    a, b, c = (files / f"{name}.obj" for name in "abc")
    run = ["run", files / "c.yaml", "-q", "--scheduler", slots, "--out", files / "ds"]
    a.write_text(SQUARE), b.write_text("nothing")
    begun = lidarpool(*run)
    assert begun.code == 2 and "c.obj does not exist" in begun.err
    assert not (files / "ds").exists()
    c.write_text(SQUARE)
    assert "1 job failed" in lidarpool(*run).err
    b.write_text(SQUARE)
    assert lidarpool(*run, "--job", 1).code == 0
    c.unlink()  # of a job that is done
    a.write_text(SQUARE.replace("9", "8"))
    mixed = lidarpool(*run, "--retry-failed")
    assert mixed.code == 2 and mixed.err.count("\n") == 1
    assert "were created from a different version of a.obj: 0000. Restore that version" in mixed.err
    a.write_text(SQUARE)
    b.unlink()  # fails its job, and no other
    assert "b.obj" in lidarpool(*run, "--retry-failed").err
    b.write_text(SQUARE)
    assert lidarpool(*run, "--retry-failed").code == 0
    compared = lidarpool(*run, "--job", 1).out
    assert f"the points of job 0001 are bit-identical to those in {files / 'ds'}" in compared


@pytest.mark.slow
def test_a_campaign_grows_and_keeps_its_jobs(files, whole, lidarpool, slots):
    run = ["run", files / "c.yaml", "-q", "--scheduler", slots, "--out", files / "ds", "--resume"]
    for count in (2, 6):
        (files / "c.yaml").write_text(CAMPAIGN.replace("count: 6", f"count: {count}"))
        grown = lidarpool(*run)
        assert grown.code == 0 and grown.out.count(f"{count} jobs, ") == 1
    assert bytes_of(files / "ds") == whole
    (files / "c.yaml").write_text(CAMPAIGN.replace("count: 6", "count: 3"))
    fewer = lidarpool(*run)
    assert fewer.code == 2 and fewer.err.count("\n") == 1
    assert (
        "contains job 0003, which is not part of this run, because the campaign has 3 jobs"
        in fewer.err
    )
    assert bytes_of(files / "ds") == whole and not (files / "ds" / "run").exists()


# -- places and options ---------------------------------------------------------------------------


def test_one_slot_too_few_names_what_it_is_for(files, lidarpool, tmp_path):
    run = ["run", files / "c.yaml", "-q", "--out", files / "ds", "--startup-timeout", "0s"]
    with thread_cluster({"GPU": 1}, {"LIDAR": 4}) as few:
        refused = lidarpool(*run, "--scheduler", few.scheduler_address)
    assert refused.code == 2 and refused.err.count("\n") == 1
    assert "writing jobs of a campaign" in refused.err and '--resources "LIDAR=' in refused.err
    assert "stored in" not in refused.err and not (files / "ds").exists()


def test_other_content_or_software_is_refused(files, finished, lidarpool, slots):
    run = ["run", files / "c.yaml", "-q", "--scheduler", slots, "--out", files / "ds"]
    (files / "c.yaml").write_text(CAMPAIGN.replace("[2, 3, 4]", "[2, 3, 4.5]"))
    assert lidarpool(*run).code == 2 and not (files / "ds").exists()
    (files / "c.yaml").write_text(CAMPAIGN)
    shutil.copytree(finished, files / "ds")
    again = lidarpool(*run)
    assert again.code == 2 and "each data set requires a separate folder" in again.err
    assert lidarpool(*run, "--resume").code == 0, "it is complete"
    (files / "c.yaml").write_text(CAMPAIGN.replace("seed: 3", "seed: 4"))
    for more in (["--resume"], ["--job", 1]):
        other = lidarpool(*run, *more)
        assert other.code == 2 and "a different campaign (seed changed from 3 to 4)" in other.err
    (files / "c.yaml").write_text(CAMPAIGN)
    record = files / "ds" / "campaign.json"
    made = unseal_json(record.read_bytes())
    made["casting"]["numpy"] = "1.0"
    record.write_bytes(seal_json(made))
    old = lidarpool(*run, "--job", 1)
    assert old.code == 2 and "was created with numpy 1.0, " in old.err and old.err.count("\n") == 1


def all_of(folder: Path) -> dict[str, bytes]:
    """All files in a folder and below."""
    found = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in found}


@pytest.fixture(scope="module")
def full_disk(slots, tmp_path_factory):
    """A campaign of three jobs, of which one is in the data set when the disk is full; its place.

    Its run is known by that place, where its copy is put for each test.
    """
    write = DataSet.write_job

    def fail(self: DataSet, row: JobRow, *arguments: Any, **more: Any) -> JobRow:
        made = write(self, row, *arguments, **more)
        if row.number:
            with explain_os_errors(f"Job {row.name} cannot be written"):
                raise OSError(28, "No space left on device")
        return made

    campaign = Campaign(make, 3, keep="folder")
    ds = tmp_path_factory.mktemp("full") / "ds"
    with (
        Client(slots, set_as_default=False) as client,
        pytest.MonkeyPatch.context() as patched,
        pytest.raises(LidarError, match=r"Job 000\d .*No space left") as ended,
    ):  # the others would fail, too
        patched.setattr(DataSet, "write_job", fail)
        campaign.run(ds, client=client)
    assert "of 3 jobs are stored in" in ended.value.__notes__[0] and bytes_of(ds)
    shutil.copytree(ds, ds.with_name("copy"))
    return campaign, ds.parent


@pytest.fixture
def here(full_disk, tmp_path):
    """The folder with such a data set and nothing else."""
    folder = full_disk[1]
    (folder / "copy").rename(tmp_path / "copy")
    shutil.rmtree(folder)
    shutil.copytree(tmp_path / "copy", folder / "ds")
    yield folder
    (tmp_path / "copy").rename(folder / "copy")


@pytest.fixture
def unwritten(full_disk):
    """Such a campaign."""
    return full_disk[0]


def lead_away(link: Path, stranger: Path) -> dict[str, bytes]:
    """Put a link in place of a folder, which is kept beside; returns what it leads to."""
    stranger.mkdir()
    left = shutil.ignore_patterns(".lidarpool-*")
    shutil.copytree(
        link if link.exists() else link.parents[1], stranger, ignore=left, dirs_exist_ok=True
    )
    (stranger / "thesis.txt").write_text("mine")
    if link.exists():
        link.rename(stranger.with_name("kept"))
    link.symlink_to(stranger)
    return all_of(stranger)


@pytest.fixture(scope="module")
def three(slots, full_disk, tmp_path_factory):
    """What it gives on an empty disk."""
    folder = tmp_path_factory.mktemp("three")
    with Client(slots, set_as_default=False) as client:
        full_disk[0].run(folder, client=client)
    return bytes_of(folder)


@pytest.mark.slow
@pytest.mark.slow(keep=("run", "jobs/0001"))
@pytest.mark.parametrize("where", ["run", "run/parts", "jobs", "jobs/0001", ".jobs"])
def test_nothing_behind_a_link_is_touched(client, here, unwritten, three, where):
    link = here / "ds" / where
    stranger = here / "stranger"
    before = lead_away(link, stranger)
    for how in ("resume", "restart"):
        with pytest.raises(LidarError) as caught:
            unwritten.run(here / "ds", client=client, **{how: True})
        assert f"{link} is a symbolic link, but links in {here / 'ds'} are not followed. " in str(
            caught.value
        )
        assert len(str(caught.value).splitlines()) == 1
    assert all_of(stranger) == before
    link.unlink()
    if (here / "kept").exists():
        (here / "kept").rename(link)
    run = unwritten.run(here / "ds", client=client, resume=True)
    assert (run.done, run.failed) == (3, ()) and not (here / "ds" / "run").exists()
    assert bytes_of(here / "ds") == three


@pytest.mark.slow
@pytest.mark.slow(keep=(".jobs/*.json",))
@pytest.mark.parametrize("harm", ["jobs/*/cloud.ply", ".jobs/*.json"])
def test_a_campaign_whose_only_job_was_harmed_goes_on(client, here, unwritten, monkeypatch, harm):
    for path in (here / "ds").glob(harm):
        path.unlink()
    for _ in range(2):  # what is to be done again is forgotten first, and nothing else is there
        with monkeypatch.context() as patched, pytest.raises(LidarError, match="no cluster"):
            patched.setattr(lidarpool.run.cluster.cluster, "open_client", refuse)
            unwritten.run(here / "ds", client=client, resume=True)
    assert unwritten.run(here / "ds", client=client, resume=True).done == 3
    (here / "ds" / "run").mkdir()  # a run that was killed as it removed itself
    assert unwritten.run(here / "ds", client=client, resume=True).done == 3
    assert not (here / "ds" / "run").exists()


def refuse(*_: Any, **__: Any) -> None:
    raise LidarError("no cluster")


LOST = {
    "database": lambda run: (run / "run.db").unlink(),
    "half of it": lambda run: cut(run / "run.db"),
    "all": shutil.rmtree,
}


@pytest.mark.extended
@pytest.mark.slow(keep=("half of it",))
@pytest.mark.parametrize("lost", LOST)
def test_finished_jobs_are_known_without_the_database(client, here, unwritten, lost):
    ds = here / "ds"
    before = bytes_of(ds)
    known = len([*(ds / ".jobs").iterdir()])
    LOST[lost](ds / "run")
    with pytest.raises(
        LidarError, match=r"run\.db is damaged|contains \.jobs/000\d\.json, but .* separate folder"
    ):
        unwritten.run(ds, client=client)
    run = unwritten.run(ds, client=client, resume=True)
    assert (run.done, run.resumed, run.failed) == (3, known, ())
    assert before.items() <= bytes_of(ds).items()
    cast = {stage.stage: stage.items for stage in run.stages}
    assert cast.get("intersect", 0) == 45 * (3 - known)


@pytest.mark.extended
def test_a_run_removes_its_own_files_only(client, here, unwritten):
    ds = here / "ds"
    for name in ("thesis.txt", "jobs/thesis.txt", "jobs/0000/thesis.txt", "README.md", "x/cloud"):
        (ds / name).parent.mkdir(exist_ok=True)
        (ds / name).write_text("mine")
        before = all_of(ds)
        for how in ("restart", "resume"):
            with pytest.raises(
                LidarError, match=f"contains {name}, but a data set requires a separate folder"
            ):
                unwritten.run(ds, client=client, **{how: True})
        assert before == all_of(ds) | {"run/run.db": before["run/run.db"]}
        (ds / name).unlink()
    (ds / "x").rmdir()
    assert unwritten.run(ds, client=client, restart=True).resumed == 0
    # An empty folder that is called run says nothing, nor does one that is called points.
    (here / "other" / "run").mkdir(parents=True)
    (here / "mine").mkdir()
    (here / "other" / "jobs").symlink_to(here / "mine")
    for how in ("resume", "restart", "overwrite"):
        with pytest.raises(LidarError, match=r"jobs is a symbolic link"):
            unwritten.run(here / "other", client=client, **{how: True})
    assert [*(here / "mine").iterdir()] == []


@pytest.mark.slow
@pytest.mark.slow(keep=("kitti",))
@pytest.mark.usefixtures("pictures")
@pytest.mark.parametrize("kept", DATA_SETS)
def test_a_finished_data_set_is_replaced_on_request_only(client, tmp_path, kept):
    ds = tmp_path / "ds"
    Campaign(make, 2, keep=kept, splits={"a": 0.5, "b": 0.5}).run(ds, client=client)
    before = all_of(ds)
    other = Campaign(failing(1), 2, keep="folder")
    for options in ({}, {"restart": True}):
        with pytest.raises(LidarError, match=r"contains a finished data set, .* `--overwrite`"):
            other.run(ds, client=client, **options)
        assert all_of(ds) == before
    (ds / "run").mkdir()
    (ds / "notes.txt").write_text("mine")
    with pytest.raises(
        LidarError, match=r"contains notes\.txt, but a data set requires a separate folder\. Move"
    ):
        other.run(ds, client=client, overwrite=True)
    (ds / "notes.txt").unlink()
    assert all_of(ds) == before
    assert len(other.run(ds, client=client, restart=True, overwrite=True).failed) == 1
    assert {name.split("/")[0] for name in all_of(ds)} == {
        "run", ".jobs", "jobs", "campaign.json", "dataset.json", "jobs.csv", "jobs.parquet",
        "README.md", "report.html", "report.csv", "report.json", "pictures",
    }  # fmt: skip
    with pytest.raises(LidarError, match="contains a finished data set"):
        other.run(ds, client=client, restart=True)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--job", 99], "Job 99 does not exist"),
        (["--resume", "--overwrite"], "`restart` and `overwrite` cannot be combined with `resume`"),
        (["--cloud-only"], "cannot be used with campaigns"),
        (["--resume", "--restart"], "`restart` and `overwrite` cannot be combined"),
        (["--retry-failed", "--restart"], "`restart` and `overwrite` cannot be combined"),
        (["--retry-failed", "--job", 1], "--retry-failed"),
    ],
)
def test_options_that_do_not_go_together(files, lidarpool, options, words, slots):
    refused = lidarpool(
        "run", files / "c.yaml", "-q", "--out", files / "ds", *options, "--scheduler", slots
    )
    assert refused.code == 2 and refused.err.count("\n") == 1
    assert words in refused.err
    assert not (files / "ds").exists()


@pytest.mark.slow
def test_several_scenarios_are_a_campaign(files, lidarpool, slots):
    (files / "other.yaml").write_text(BASE.replace("steps: 45", "steps: 30"))
    two = [files / "base.yaml", files / "other.yaml"]
    done = lidarpool("run", *two, "-q", "--scheduler", slots, "--out", files / "ds")
    assert done.code == 0, done
    for path in two:
        alone = ["--out", files / path.stem, "--cloud-only"]
        assert lidarpool("run", path, "-q", "--scheduler", slots, *alone).code == 0
        cloud = (files / path.stem / "cloud.ply").read_bytes()
        assert cloud == (files / "ds" / "jobs" / path.stem / "cloud.ply").read_bytes()


# -- workers and drivers that die -----------------------------------------------------------------

KILLS = [
    ("OPEN", 1),
    ("COMMIT", 4),
    ("END", 1),
    ("TABLE", 1),
    ("FINISH", 1),
    ("REMOVE", 1),
    ("", 1),
]

forks = pytest.mark.skipif(sys.platform == "win32", reason="forks")


@pytest.mark.extended
@forks
@pytest.mark.parametrize(
    "kills",
    [
        pytest.param([("COMMIT", 4), ("FINISH", 1), ("", 1)], id="some"),
        pytest.param(KILLS, id="all", marks=pytest.mark.slow),
    ],
)
def test_killed_drivers_leave_the_same_bytes_and_no_remains(
    files, slots, whole, client, left_over, kills
):
    parts = files / "parts"
    options = ["--resume", "-q", "--scheduler", slots, "--out", "ds", "--scratch-dir", str(parts)]
    ended = drive(files, kills, "c.yaml", *options)
    assert ended == [-9] * (len(kills) - 1) + [0]
    assert bytes_of(files / "ds") == whole
    rows = (files / "ds" / "jobs.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows[1:]] == [str(number) for number in range(6)]
    times = [row.split(",")[1] for row in (files / "ds" / "report.csv").read_text().split()[1:]]
    assert len(times) == 6 and all(time == "" or float(time) > 0 for time in times)
    notes = json.loads((files / "ds" / "report.json").read_text())["notes"]
    assert ("" in times) == any(note.startswith("the casting times of these") for note in notes)
    names = {path.name for path in (files / "ds").iterdir()}
    assert not names & {"run"} and not any(name.endswith("-dataset") for name in names)
    assert [*parts.rglob("*")] == []
    assert left_over(client) == ([], [], [])


@pytest.mark.slow
def test_an_interrupted_driver_says_how_to_go_on(files, slots, client):
    (files / "c.yaml").write_text(CAMPAIGN.replace("count: 6", "count: 100"))
    command = ["run", "c.yaml", "-q", "--scheduler", slots, "--out", "ds"]
    with subprocess.Popen(
        [sys.executable, "-m", "lidarpool", *command],
        cwd=files, stderr=subprocess.PIPE, text=True,
    ) as run:  # fmt: skip
        wait_until(lambda: [*(files / "ds" / ".jobs").glob("*")])
        run.send_signal(signal.SIGINT)
        _, err = run.communicate(timeout=300)
    assert run.returncode == 130, err
    assert err.startswith("\nlidarpool: Interrupted. All processes were stopped")  # behind the ^C
    assert re.search(r" of 100 jobs are stored in .*ds/run\. Continue with `--resume` .*\.\n$", err)


@pytest.mark.slow
def test_killed_workers_change_no_byte(outside, files, whole):
    cluster = outside()
    gpu = cluster.add(("GPU", 1))
    lidar = cluster.add(("LIDAR", 5))
    cluster.wait()
    strikes = [(1, gpu, ("GPU", 1)), (2, lidar, ("LIDAR", 5)), (4, None, ("LIDAR", 1))]

    def on_progress(progress: Progress) -> None:
        while strikes and progress.jobs_done >= strikes[0][0]:
            _, name, another = strikes.pop(0)
            if name:
                cluster.kill(name)
            cluster.add(another)

    with Client(cluster.address, set_as_default=False) as client:
        campaign = Campaign.load(files / "c.yaml")
        run = campaign.run(files / "ds", client=client, on_progress=on_progress)
    assert (run.done, run.failed, strikes) == (6, (), [])
    assert bytes_of(files / "ds") == whole
    assert not (files / "ds" / "run").exists()
    report = json.loads((files / "ds" / "report.json").read_text())
    assert (report["notes"], report["replayed"]) == ([*run.notes], run.replayed)


# -- others on the same cluster -------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("other", ["campaign", "survey"])
def test_two_at_once_share_the_slots(other, files, whole, monkeypatch):
    """There are slots for the stages of both, and none for writing."""
    monkeypatch.setattr(lidarpool.run.writer, "MAX_STALL_S", 0.5)
    campaign = Campaign.load(files / "c.yaml")
    scene = Scene.seed()
    survey = job(SENSOR, 3).survey
    running = threading.Event()

    def watched(progress: Progress) -> None:
        if not progress.waits_for:
            running.set()

    def run_other() -> Any:
        assert running.wait(300)
        with Client(cluster.scheduler_address, set_as_default=False) as client:
            if other == "survey":
                return simulate(scene, survey, client=client, backend="numpy")
            return Campaign.load(files / "c.yaml").run(files / "ds2", client=client)

    with (
        thread_cluster({"GPU": 1}, {"LIDAR": 8}) as cluster,
        Client(cluster, set_as_default=False) as client,
        ThreadPoolExecutor(1) as pool,
    ):
        beside = pool.submit(run_other)
        run = campaign.run(files / "ds", client=client, on_progress=watched)
        found = beside.result(300)
    assert run.done == 6 and bytes_of(files / "ds") == whole
    assert other == "survey" or (found.done == 6 and bytes_of(files / "ds2") == whole)


@pytest.mark.slow
def test_jobs_are_written_here_when_no_worker_has_a_slot_left(files, whole, monkeypatch):
    """Its last slots went with a worker that does not come back."""
    monkeypatch.setattr(lidarpool.run.writer, "MAX_STALL_S", 0.05)
    needed = {"GPU": 1, "LIDAR": 3}
    monkeypatch.setattr(lidarpool.run.cluster.cluster, "slots_needed", lambda *_, **__: needed)
    with (
        thread_cluster({"GPU": 1}, {"LIDAR": 4}) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        run = Campaign.load(files / "c.yaml").run(files / "ds", client=client)
    assert run.done == 6 and bytes_of(files / "ds") == whole


@pytest.mark.slow
def test_workers_that_do_not_see_the_data_set(files, whole, monkeypatch, client):
    monkeypatch.setattr(Storage, "has_content", lambda *_: not in_worker())
    run = Campaign.load(files / "c.yaml").run(files / "ds", client=client)
    assert run.done == 6 and bytes_of(files / "ds") == whole
    for words in ("no worker of partition LIDAR can access", "the driver wrote the data set"):
        assert any(words in note for note in run.notes)
