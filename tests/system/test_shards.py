"""Shards of campaigns and surveys, and what is merged of them."""

import json
import re
import shutil
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from distributed import Client
from tests.clusters import thread_cluster
from tests.killed_drivers import drive

from lidarfiles.clouds.built_in_formats import DATA_SETS
from lidarfiles.datasets.job_seconds import read_seconds
from lidarfiles.identity.sealed import seal_json, unseal_json
from lidarpool import Campaign, Job, LidarError, Noise, Scene, Sensor, Survey, box, merge, sweeps
from lidarpool.report.campaign_output import verify_dataset
from lidarscenario.shard import Shard
from lidarsim.io.storage import Storage

CAMPAIGN = """
base: base.yaml
count: 7
seed: 3
vary:
  noise.range_m: {uniform: [0.001, 0.05]}
  sensor.model: {choice: [velodyne/vlp16, velodyne/hdl32e]}
keep: FORMAT
splits: {train: 0.6, val: 0.4}
license: CC0
"""
BASE = """
poses: [[0, 0, 1]]
steps: 20
sensor: {model: velodyne/vlp16}
actors: [{name: Car, box: [4, 2, 1.5], at: {position: [6, 0, 0]}}]
scene: seed
pool: {backend: numpy, gpu: 1}
"""
SURVEY = """
sensor: {rays_per_revolution: 90, layers: 8, step_deg: 4}
poses: [[0, 0, 1], [1, 0, 1]]
steps: 25
cloud: {columns: [intensity]}
scene: seed
planning: {start: [25, 25], target: [-30, -20], trials: 3, iterations: 20}
output: {write: [las, kitti]}
pool: {backend: numpy, gpu: 1}
"""


@pytest.fixture(scope="module")
def slots() -> Iterator[str]:
    """Address of a cluster with the slots of a campaign and a survey."""
    with thread_cluster({"GPU": 1}, {"LIDAR": 5}, {"OTHER": 1}) as cluster:
        yield cluster.scheduler_address


@pytest.fixture(scope="module")
def campaigns(slots, tmp_path_factory) -> Callable[[str], Path]:
    """Return a folder with a campaign in a format as one run, `one`, and as `part-1` to 3."""
    made: dict[str, Path] = {}

    def folder_of(kept: str) -> Path:
        if kept not in made:
            folder = made[kept] = tmp_path_factory.mktemp(kept)
            (folder / "base.yaml").write_text(BASE)
            (folder / "c.yaml").write_text(CAMPAIGN.replace("FORMAT", kept))
            campaign = Campaign.load(folder / "c.yaml")
            with Client(slots, set_as_default=False) as client:
                assert campaign.run(folder / "one", client=client).done == 7
                for number in (1, 2, 3):
                    out = folder / f"part-{number}"
                    assert not campaign.run(out, client=client, shard=(number, 3)).failed
        return made[kept]

    return folder_of


@pytest.fixture
def parts(campaigns, tmp_path) -> list[Path]:
    """Copies of the three shards of a campaign, whose files a test may change."""
    folder = tmp_path / "shards"
    shutil.copytree(campaigns("folder"), folder)
    return [folder / f"part-{number}" for number in (1, 2, 3)]


def without_times(found: Any) -> Any:
    """Content of report.json but for times and figures of tasks."""
    if isinstance(found, list):
        return [without_times(one) for one in found]
    if not isinstance(found, dict):
        return found
    of_run = {"seconds", "slowest", "stages", "tasks"}
    return {name: without_times(one) for name, one in found.items() if name not in of_run}


def content(folder: Path) -> dict[str, Any]:
    """Content of a result or data set: bytes of each file, but of its report."""
    found: dict[str, Any] = {}
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        assert not path.is_symlink()
        name = path.relative_to(folder).as_posix()
        data = path.read_bytes()
        if name == "report.json":
            found[name] = without_times(json.loads(data))
        elif name not in ("report.html", "report.csv"):
            found[name] = data
    return found


@pytest.mark.slow(keep=("folder",))
@pytest.mark.parametrize("kept", DATA_SETS)
def test_shards_of_a_campaign_have_the_files_of_one_run(campaigns, tmp_path, kept):
    folder = campaigns(kept)
    out = tmp_path / "ds"
    report = merge([folder / f"part-{number}" for number in (3, 1, 2)], out)
    assert content(out) == content(folder / "one")
    assert report["jobs"] == {"described": 7, "done": 7, "failed": 0, "resumed": 0}
    neighbors = [row.split(",")[0] for row in (folder / "part-2/jobs.csv").read_text().split()[1:]]
    assert neighbors == ["1", "4"]
    some = next((out / ".jobs").iterdir())
    assert some.stat().st_nlink == 2  # a hard link


@pytest.mark.slow
@pytest.mark.usefixtures("pictures")
def test_shards_of_a_campaign_have_the_pictures_of_one_run(slots, tmp_path):
    (tmp_path / "base.yaml").write_text(BASE)
    (tmp_path / "c.yaml").write_text(CAMPAIGN.replace("FORMAT", "folder").replace("7", "2"))
    campaign = Campaign.load(tmp_path / "c.yaml")
    with Client(slots, set_as_default=False) as client:
        campaign.run(tmp_path / "one", client=client)
        for number in (1, 2, 3):  # the last is empty
            campaign.run(tmp_path / f"part-{number}", client=client, shard=(number, 3))
    merge([tmp_path / f"part-{number}" for number in (1, 2, 3)], tmp_path / "all")
    merge([tmp_path / "part-1", tmp_path / "part-2"], tmp_path / "two")
    one = content(tmp_path / "one")
    assert "pictures/job.png" in one and one == content(tmp_path / "all")
    assert one == content(tmp_path / "two")


# -- what is wrong --------------------------------------------------------------------------------


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)


def change(path: Path, old: str, new: str) -> None:
    path.write_text(path.read_text().replace(old, new))


def change_record(part: Path, old: str, new: str) -> None:
    """Change text of campaign.json, and its checksum."""
    path = part / "campaign.json"
    text = json.dumps(unseal_json(path.read_bytes()))
    assert old in text
    path.write_bytes(seal_json(json.loads(text.replace(old, new))))


DAMAGE = {
    "cut": lambda part: cut(part / "jobs/0001/cloud.ply"),
    "changed": lambda part: flip(part / "jobs/0001/cloud.ply"),
    "lost": lambda part: (part / "jobs/0001/cloud.ply").unlink(),
    "manifest": lambda part: flip(part / ".jobs/0001.json"),
}
NAMED = {"manifest": ".jobs/0001.json"}


@pytest.mark.extended
@pytest.mark.slow(keep=("changed", "manifest"))
@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_files_are_named_and_the_next_merge_takes_them(
    parts, campaigns, tmp_path, damage, slots
):
    DAMAGE[damage](parts[1])
    out = tmp_path / "ds"
    name = NAMED.get(damage, "0001/cloud.ply")
    with pytest.raises(LidarError, match=f"damaged.*part-2/.*{name}. Run"):
        merge(parts, out)
    assert not (out / "dataset.json").exists() and (out / ".jobs/0000.json").exists()
    with Client(slots, set_as_default=False) as client:
        campaign = Campaign.load(parts[0].parent / "c.yaml")
        campaign.run(parts[1], client=client, verify=True, shard=(2, 3))
    merge(parts, out)
    made = content(out)
    whole = content(campaigns("folder") / "one")
    notes = made.pop("report.json")["notes"]
    assert notes[0].startswith("these jobs are run again: job 0001")
    del whole["report.json"]
    assert made == whole


def test_a_data_set_that_is_given_by_another_name_keeps_its_files(parts, tmp_path):
    out = tmp_path / "ds"
    merge(parts, out)
    change(out / ".jobs/0001.json", "crc", "cRc")
    before = content(out)
    (tmp_path / "link").symlink_to(out)
    for given in (out, out / ".." / "ds", tmp_path / "link"):
        with pytest.raises(LidarError, match="ds is one of the shards, which must not be changed"):
            merge([*parts, given], out)
    assert content(out) == before


def test_a_shard_is_never_made_the_whole(parts):
    before = content(parts[0].parent)
    inside = parts[0] / "below/ds"
    around = parts[0].parent
    for out, relation in ((parts[0], "is one of"), (inside, "is inside"), (around, "contains")):
        with pytest.raises(LidarError, match=f"output folder {out} {relation} the shard"):
            merge(parts, out)
    with pytest.raises(LidarError, match="is one of the shards"):
        merge([parts[0].as_uri(), *parts[1:]], parts[0])
    with pytest.raises(LidarError, match="is one of the shards"):
        merge(parts, parts[0].as_uri())
    assert content(parts[0].parent) == before


TABLE_EDITS = {
    "the number of another shard": lambda text: text.replace("\n1,0001,", "\n0,0000,"),
    "a foreign number": lambda text: text.replace("\n1,", "\n3,"),
    "a number out of range": lambda text: text.replace("\n4,", f"\n{10**18},"),
    "the number of another row": lambda text: text.replace("\n4,0004,", "\n1,0001,"),
    "an error of a finished job": lambda text: re.sub(r",,(\d+,\d+)", r",x,\1", text),
    "a split": lambda text: text.replace(",train,", ",trazn,").replace(",val,", ",vel,"),
    "a cut row": lambda text: "".join(text.splitlines(keepends=True)[:-1]),
    "other commas": lambda text: text.replace(",", ";"),
    "a hash": lambda text: re.sub(r",\w{64}", f",{64 * 'a'}", text),
    "nothing": lambda text: "",
}


@pytest.mark.slow(keep=("a foreign number", "a hash"))
@pytest.mark.parametrize("edit", TABLE_EDITS)
def test_a_table_of_jobs_is_only_compared(parts, campaigns, tmp_path, edit, slots):
    table = parts[1] / "jobs.csv"
    out = tmp_path / "ds"
    whole = table.read_text()
    table.write_text(TABLE_EDITS[edit](whole))
    assert table.read_text() != whole
    merge(parts, out)  # whose rows are those of manifests
    assert content(out) == content(campaigns("folder") / "one")
    with pytest.raises(LidarError, match=r"jobs\.csv is damaged.*--resume` to rewrite"):
        sweeps(parts[1])
    with pytest.raises(LidarError, match=r"jobs\.csv is damaged"):
        verify_dataset(Storage.at(parts[1]))
    with Client(slots, set_as_default=False) as client:
        campaign = Campaign.load(parts[0].parent / "c.yaml")
        campaign.run(parts[1], client=client, resume=True, shard=(2, 3))
    verify_dataset(Storage.at(parts[1]))
    assert table.read_text() == whole


SECONDS_EDITS = {
    "another header": lambda path: path.write_text("a,b\n1,2\n"),
    "no number": lambda path: path.write_text("number,seconds\n1,x\n"),
    "no file": lambda path: path.unlink(),
}


@pytest.mark.parametrize("edit", SECONDS_EDITS)
def test_casting_times_that_are_lost_are_noted(parts, campaigns, tmp_path, edit):
    out = tmp_path / "ds"
    SECONDS_EDITS[edit](parts[1] / "report.csv")
    merge(parts, out)
    (note,) = json.loads((out / "report.json").read_text())["notes"]
    assert "part-2/report.csv: " in note
    one = content(campaigns("folder") / "one")
    made = content(out)
    del one["report.json"], made["report.json"]
    assert made == one
    seconds = read_seconds(Storage.at(out))
    assert seconds.keys() == {0, 2, 3, 5, 6} and min(seconds.values()) > 0  # without shard 2


def test_notes_of_a_damaged_report_are_lost_with_a_note(parts, tmp_path):
    (parts[1] / "report.json").write_text("[]")
    merge(parts, tmp_path / "ds")
    (note,) = json.loads((tmp_path / "ds" / "report.json").read_text())["notes"]
    assert "part-2/report.json is damaged" in note and note.endswith("Its notes are lost")


def test_a_manifest_of_another_job_is_refused(parts, tmp_path):
    shutil.copy(parts[0] / ".jobs/0003.json", parts[1] / ".jobs/0003.json")
    with pytest.raises(
        LidarError, match=r"part-2/\.jobs/0003\.json belongs to job 3, which is not"
    ):
        merge(parts, tmp_path / "ds")
    (parts[1] / ".jobs/0003.json").rename(parts[1] / ".jobs/0004.json")
    with pytest.raises(LidarError, match=r"damaged: .*part-2/\.jobs/0004\.json\. Run"):
        merge(parts, tmp_path / "ds")
    (parts[1] / ".jobs/0004.json").unlink()
    with pytest.raises(LidarError, match=r"damaged: the manifest of job 4 in .*part-2\. Run"):
        merge(parts, tmp_path / "ds")


def test_a_damaged_record_of_a_campaign_is_named_and_made_again(parts, tmp_path, slots):
    path = parts[1] / "campaign.json"
    whole = path.read_bytes()
    other_type = seal_json(unseal_json(whole) | {"files": 5})
    for data in (whole[:90] + b"x" + whole[91:], b"[]", other_type):
        path.write_bytes(data)
        with pytest.raises(LidarError, match=r"campaign\.json is damaged or has been edited: its "):
            merge(parts, tmp_path / "ds")
    with Client(slots, set_as_default=False) as client:
        campaign = Campaign.load(parts[0].parent / "c.yaml")
        run = campaign.run(parts[1], client=client, resume=True, shard=(2, 3))
    assert (run.resumed, run.done) == (2, 2)
    assert run.notes == ("campaign.json was damaged and has been recreated",)
    merge(parts, tmp_path / "ds")


def test_a_manifest_that_names_files_elsewhere_is_damaged(parts, tmp_path):
    path = parts[1] / ".jobs/0001.json"
    out = tmp_path / "below/ds"
    (parts[1].parent / "stranger").write_text("of others")
    manifest = json.loads(path.read_text())
    del manifest["crc"]
    manifest["files"] = {"../stranger": 0} | manifest["files"]
    crc = zlib.crc32(json.dumps(manifest).encode())
    path.write_text(json.dumps(manifest | {"crc": crc}))
    with pytest.raises(
        LidarError, match=r"^These files are missing or damaged: .*part-2/\.jobs/0001\.json"
    ):
        merge(parts, out)
    assert not (out.parent / "stranger").exists()


STRANGE_ENTRIES = {
    "an unknown entry of the row": lambda manifest: manifest["row"].update(color="red"),
    "no points": lambda manifest: manifest["row"].pop("points"),
    "a broken number": lambda manifest: manifest["row"].update(number=1.0),
    "a class without number": lambda manifest: manifest["row"].update(classes={"car": 1}),
    "no files": lambda manifest: manifest.pop("files"),
    "a list of files": lambda manifest: manifest.update(files=["cloud.ply"]),
    "a list of software": lambda manifest: manifest.update(made_with=["numpy"]),
}


@pytest.mark.slow(keep=("no points", "no files"))
@pytest.mark.parametrize("edit", STRANGE_ENTRIES)
def test_a_manifest_with_other_entries_is_damaged(parts, tmp_path, edit):
    path = parts[1] / ".jobs/0001.json"
    manifest = json.loads(path.read_text())
    del manifest["crc"]
    STRANGE_ENTRIES[edit](manifest)
    crc = zlib.crc32(json.dumps(manifest).encode())
    path.write_text(json.dumps(manifest | {"crc": crc}))
    with pytest.raises(
        LidarError, match=r"^These files are missing or damaged: .*part-2/\.jobs/0001\.json"
    ):
        merge(parts, tmp_path / "ds")


def doubled(parts: list[Path]) -> list[Path]:
    shutil.copytree(parts[0], parts[0].with_name("again"))
    return [*parts, parts[0].with_name("again")]


def foreign(old: str, new: str) -> Callable[[list[Path]], list[Path]]:
    def make(parts: list[Path]) -> list[Path]:
        change_record(parts[1], old, new)
        return parts

    return make


def unfinished(parts: list[Path]) -> list[Path]:
    (parts[2] / "report.json").unlink()
    return parts


WRONG = {
    "missing": (lambda parts: parts[:2], r"^These shards are missing: 3/3\."),
    "whole": (foreign('"2/3"', '"1/1"'), r"part-2 is a complete run\. Specify it alone, or"),
    "twice": (doubled, r"^Shard 1/3 is in both .*part-1 and .*again\. Specify only one"),
    "no shard": (lambda parts: [*parts, parts[0].parent], "shards contains no finished shard"),
    "unfinished": (unfinished, "^.*part-3 contains no finished shard"),
    "division": (foreign('"2/3"', '"2/4"'), "part-2 and .* differ in the number of shards"),
    "campaign": (foreign('"vary": "', '"vary": "0'), r"part-2 and .*part-1 differ in vary\."),
    "file": (foreign('"files": []', '"files": [["a.glb", "1"]]'), ""),
    "software": (foreign("(sources ", "(sources x"), r"part-2 and .*part-1 differ in lidarpool\."),
    "workers": (
        foreign('"numpy": "', '"numpy": "0'),
        "part-2 and .*part-1 differ in the numpy of the wo",
    ),
    "count": (
        foreign('"count": 7', '"count": 11'),
        "^These shards are missing: 1/3, 3/3.* larger count",
    ),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_shards_that_do_not_fit_together_are_named(parts, tmp_path, wrong, lidarpool):
    make, told = WRONG[wrong]
    given = make(parts)
    if not told:  # a file that only one has seen
        merge(given, tmp_path / "ds")
        return
    done = lidarpool("merge", *given, "--out", tmp_path / "ds", "-q")
    assert done.code == 2 and done.err.count("\n") == 1
    assert re.search(told, done.err.removeprefix("lidarpool: ")), done.err
    assert not (tmp_path / "ds").exists()


def test_meshes_of_all_shards_are_the_same(parts, tmp_path):
    for part, digest in zip(parts, "112", strict=True):
        change_record(part, '"files": []', f'"files": [["a.glb", "{digest}"]]')
    with pytest.raises(LidarError, match=r"part-3 and .*part-1 differ in the file a\.glb\."):
        merge(parts, tmp_path / "ds")


def test_merge_leaves_other_files_and_runs(parts, tmp_path):
    out = tmp_path / "ds"
    out.mkdir()
    (out / "thesis.txt").write_text("mine")
    with pytest.raises(
        LidarError, match=r"contains thesis\.txt, but a data set requires a separate folder"
    ):
        merge(parts, out)
    assert [*out.iterdir()] == [out / "thesis.txt"]
    for given, told in (([], "no shards to merge"), ([tmp_path / "none"], "none does not exist")):
        with pytest.raises(LidarError, match=told):
            merge(given, tmp_path / "new")


# -- some of them, and more later -----------------------------------------------------------------


def test_shards_are_added_later(parts, campaigns, tmp_path):
    out = tmp_path / "ds"
    report = merge([parts[0], parts[2], tmp_path / "none"], out, partial=True)
    assert report["notes"] == ["these shards are missing: 2/3"] and report["jobs"]["done"] == 5
    assert json.loads((out / "campaign.json").read_text())["shards"] == ["1/3", "3/3"]
    shutil.rmtree(parts[0])
    assert merge([parts[1]], out)["notes"] == []
    whole = content(campaigns("folder") / "one")
    assert content(out) == whole
    merge([parts[1], parts[2]], out)  # again
    assert content(out) == whole


@pytest.mark.slow
def test_a_campaign_that_has_grown_is_merged_into_the_same_place(parts, tmp_path, slots):
    out = tmp_path / "ds"
    file = parts[0].parent / "c.yaml"
    merge(parts, out)
    shutil.copytree(parts[1], tmp_path / "earlier")
    change(file, "count: 7", "count: 9")
    campaign = Campaign.load(file)
    with Client(slots, set_as_default=False) as client:
        campaign.run(tmp_path / "one", client=client)
        for number in (2, 3):  # jobs 7 and 8; the first shard has none of them
            run = campaign.run(parts[number - 1], client=client, resume=True, shard=(number, 3))
            assert run.done == 3
    with pytest.raises(LidarError, match=r"^These shards are missing: 3/3"):
        merge([parts[1]], out)
    merge([parts[1], parts[2]], out)
    assert content(out) == content(tmp_path / "one")
    merge([tmp_path / "earlier"], out)  # which has not grown
    assert content(out) == content(tmp_path / "one")


def test_failed_jobs_are_in_the_table_until_they_are_done(tmp_path, slots):
    (tmp_path / "base.yaml").write_text(BASE)
    (tmp_path / "c.yaml").write_text(CAMPAIGN.replace("FORMAT", "folder").replace("7", "2"))
    change(
        tmp_path / "base.yaml",
        "actors: [{name: Car, box: [4, 2, 1.5]",
        "actors: [{name: Car, file: a.stl",
    )
    (tmp_path / "a.stl").write_text("solid a\nendsolid a\n")
    campaign = Campaign.load(tmp_path / "c.yaml")
    with Client(slots, set_as_default=False) as client:
        for number in (1, 2):
            run = campaign.run(tmp_path / f"part-{number}", client=client, shard=(number, 2))
            assert len(run.failed) == 1
    report = merge([tmp_path / "part-1", tmp_path / "part-2"], tmp_path / "ds")
    assert (report["jobs"]["done"], report["jobs"]["failed"]) == (0, 2)
    assert "0001" in (tmp_path / "ds" / "jobs.csv").read_text()


@pytest.mark.slow
def test_jobs_that_shards_have_retried_stay_done_in_the_data_set(tmp_path, slots):
    def make(number: int, rng: np.random.Generator) -> Job:
        if not (tmp_path / "open").exists():
            raise RuntimeError("the street is closed")
        survey = Survey(Sensor.grid(36, 4), poses=[(0, 0, 1)], noise=Noise(range_m=0.02))
        return Job(Scene.from_meshes([box("Car", (4, 2, 3))]), survey)

    campaign = Campaign(make, 2)
    out = tmp_path / "ds"
    parts = [tmp_path / "part-1", tmp_path / "part-2"]
    with Client(slots, set_as_default=False) as client:
        some = {"client": client, "backend": "numpy"}
        for number, part in enumerate(parts, 1):
            assert len(campaign.run(part, shard=(number, 2), **some).failed) == 1
        assert merge(parts, out)["jobs"]["failed"] == 2
        assert len(campaign.run(out, retry_failed=True, **some).failed) == 2
        (tmp_path / "open").touch()
        assert not campaign.run(parts[0], shard=(1, 2), retry_failed=True, **some).failed
        assert merge(parts, out)["jobs"]["done"] == 1
        assert campaign.run(out, resume=True, **some).done == 1
        assert campaign.run(out, retry_failed=True, **some).done == 2
    assert merge(parts, out)["jobs"]["done"] == 2  # the second shard still has a failed job


TRIANGLE = (
    "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 1\nvertex 4 0 1\nvertex 0 4 2\n"
    "endloop\nendfacet\nendsolid a\n"
)


@pytest.mark.slow
def test_shards_fit_together_after_a_mesh_was_repaired(tmp_path, slots):
    (tmp_path / "base.yaml").write_text(BASE.replace("box: [4, 2, 1.5]", "file: a.stl"))
    vary = "base: base.yaml\nvary: {actors.Car.file: {each: [a.stl, b.stl]}}\nkeep: kitti\n"
    (tmp_path / "c.yaml").write_text(vary)
    for name in "ab":
        (tmp_path / f"{name}.stl").write_text(TRIANGLE)
    change(tmp_path / "b.stl", TRIANGLE, "solid b\nendsolid b\n")
    campaign = Campaign.load(tmp_path / "c.yaml")
    parts = [tmp_path / "part-1", tmp_path / "part-2"]
    with Client(slots, set_as_default=False) as client:
        for number, failed in ((1, 0), (2, 1)):
            run = campaign.run(parts[number - 1], client=client, shard=(number, 2))
            assert len(run.failed) == failed
        (tmp_path / "b.stl").write_text(TRIANGLE)
        assert campaign.run(parts[1], client=client, shard=(2, 2), retry_failed=True).done == 1
        with pytest.raises(LidarError, match=r"differ in the file b\.stl\."):
            merge(parts, tmp_path / "ds")
        assert campaign.run(parts[0], client=client, shard=(1, 2), resume=True).done == 1
        assert merge(parts, tmp_path / "ds")["jobs"]["done"] == 2


# -- kills ----------------------------------------------------------------------------------------

KILLED = """
import json, os, signal, sys
from lidarpool import merge
from lidarsim.io.storage import Storage
from lidarfiles.datasets.job_table import read_table
import lidarpool.report.campaign_output as output
owners = {"copy_from": Storage, "write_table": output, "finish": output.DataSet}
def die_at(name, number):
    left, function = [number], getattr(owners[name], name)
    def call(*arguments, **options):
        left[0] -= 1
        if not left[0]:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*arguments, **options)
    setattr(owners[name], name, call)
for moment in json.loads(sys.argv[1]):
    if not (child := os.fork()):
        die_at(*moment)
        merge(sys.argv[3:], sys.argv[2])
        os._exit(0)
    if os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) != -signal.SIGKILL:
        sys.exit(f"{moment} did not come")
"""


def killed(out: Path, parts: list[Path], *moments: tuple[str, int]) -> None:
    """Merge, killed at some calls: forks of one process, which has imported all."""
    arguments = [json.dumps(moments), str(out), *map(str, parts)]
    subprocess.run([sys.executable, "-W", "ignore", "-c", KILLED, *arguments], check=True)


@pytest.mark.extended
def test_a_killed_merge_goes_on(parts, campaigns, tmp_path):
    out = tmp_path / "ds"
    killed(out, parts, ("copy_from", 5), ("copy_from", 5), ("write_table", 1), ("finish", 1))
    assert not (out / "dataset.json").exists()
    times = {path: path.stat().st_ctime_ns for path in (out / "jobs").rglob("*.ply")}
    assert len(times) == 7
    merge(parts, out)
    assert content(out) == content(campaigns("folder") / "one")
    assert times == {path: path.stat().st_ctime_ns for path in times}  # they were not taken again


@pytest.mark.slow
@pytest.mark.slow(keep=("finish",))
@pytest.mark.parametrize("moment", ("write_table", "finish"))
def test_seconds_of_shards_outlast_a_killed_merge(parts, tmp_path, moment):
    out = tmp_path / "ds"
    merge(parts[:2], out, partial=True)
    seconds = read_seconds(Storage.at(out))
    assert min(seconds.values()) > 0
    killed(out, parts[2:], (moment, 1))
    merge(parts[2:], out)
    assert json.loads((out / "report.json").read_text())["notes"] == []
    assert read_seconds(Storage.at(out)) | seconds == read_seconds(Storage.at(out))


# -- surveys --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def survey(slots, tmp_path_factory) -> Path:
    """A folder with a survey."""
    folder = tmp_path_factory.mktemp("survey")
    (folder / "s.yaml").write_text(SURVEY)
    return folder


@pytest.mark.extended
def test_shards_of_a_survey_have_the_files_of_one_run(survey, lidarpool, slots, small_batches):
    run = ["run", survey / "s.yaml", "-q", "--scheduler", slots, "--out"]
    assert lidarpool(*run, survey / "one").code == 0
    for number in (1, 2, 3):
        done = lidarpool(*run, survey / f"part-{number}", "--shard", f"{number}/3", "--json")
        assert done.code == 0 and json.loads(done.out)["shard"] == f"{number}/3"
        assert {path.name for path in (survey / f"part-{number}").iterdir()} == {"run"}
    shards = [survey / f"part-{number}" for number in (2, 3, 1)]
    done = lidarpool("merge", *shards, "--out", survey / "all", "-q", "--json")
    assert (done.code, done.err) == (0, "")
    one = content(survey / "one")
    assert content(survey / "all") == one and {"cloud.ply", "cloud.las"} < one.keys()
    assert one["report.json"]["planning"]["trials"] == 3
    _some_of_a_survey(survey, shards)
    _a_damaged_shard_of_a_survey(survey, shards, one)
    _another_shard_in_the_folder(survey, lidarpool, slots)


def _some_of_a_survey(survey: Path, shards: list[Path]) -> None:
    with pytest.raises(LidarError, match=r"These shards are missing: 1/3. Specify"):
        merge(shards[:2], survey / "some")
    with pytest.raises(LidarError, match="part-2 is one of the shards, which must not be changed"):
        merge(shards, shards[0])
    with pytest.raises(LidarError, match="part-2 contains a shard of a survey"):
        merge(shards[1:], shards[0])
    report = merge(shards[:2], survey / "some", partial=True)
    assert "these shards are missing: 1/3" in report["notes"] and report["planning"] is None
    killed(survey / "some", shards, ("copy_from", 3))
    merge(shards, survey / "some")
    assert content(survey / "some") == content(survey / "all")


def _a_damaged_shard_of_a_survey(survey: Path, shards: list[Path], one: dict[str, Any]) -> None:
    part = min((shards[0] / "run/parts").glob("*.npz"))
    whole = part.read_bytes()
    for data in (whole[:-1], whole[:200] + bytes([whole[200] ^ 1]) + whole[201:]):
        part.unlink()
        part.write_bytes(data)
        with pytest.raises(
            LidarError, match=f"^These files are missing or damaged: .*{part.name}. Run their"
        ):
            merge(shards, survey / "repaired")
    part.unlink()
    part.write_bytes(whole)
    merge(shards, survey / "repaired")
    assert content(survey / "repaired") == one
    (survey / "elsewhere").mkdir()
    (survey / "s.yaml").rename(survey / "elsewhere/s.yaml")
    with pytest.raises(LidarError, match=r"s\.yaml, the scenario of these shards, does not exist"):
        merge(shards, survey / "moved")
    merge(shards, survey / "moved", scenario=survey / "elsewhere/s.yaml")
    change(survey / "elsewhere/s.yaml", "steps: 25", "steps: 26")
    with pytest.raises(LidarError, match=r"does not match these shards, .*steps .*--scen"):
        merge(shards, survey / "none", scenario=survey / "elsewhere/s.yaml")
    change(survey / "elsewhere/s.yaml", "steps: 26", "steps: 25")
    (survey / "elsewhere/s.yaml").rename(survey / "s.yaml")


def _another_shard_in_the_folder(survey: Path, lidarpool: Callable[..., Any], slots: str) -> None:
    before = content(survey / "part-2")
    run = ["run", survey / "s.yaml", "-q", "--scheduler", slots, "--out", survey / "part-2"]
    for shard in (["--shard", "3/3"], ["--shard", "2/4"], []):
        for more in ([], ["--resume"]):
            refused = lidarpool(*run, *shard, *more)
            assert refused.code == 2 and "it is shard 2/3 rather than" in refused.err, refused
    assert lidarpool(*run, "--shard", "2/3", "--resume").code == 0
    assert content(survey / "part-2").keys() == before.keys()


@pytest.mark.slow
def test_killed_drivers_of_a_shard_leave_the_same_points(tmp_path, slots):
    (tmp_path / "s.yaml").write_text(SURVEY)
    run = ["s.yaml", "-q", "--scheduler", slots]
    kills = [("COMMIT", 2), ("COMMIT", 1), ("", 1)]
    shard = [*run, "--resume", "--shard"]
    assert drive(tmp_path, kills, *shard, "1/2", "--out", "part-1") == [-9, -9, 0]
    for command in ([*shard, "2/2", "--out", "part-2"], [*run, "--out", "one"]):
        assert drive(tmp_path, [("", 1)], *command) == [0]
    merge([tmp_path / "part-1", tmp_path / "part-2"], tmp_path / "all")
    assert content(tmp_path / "all") == content(tmp_path / "one")


@pytest.mark.slow
def test_the_first_shard_plans_though_it_has_no_scans(tmp_path, lidarpool, slots):
    (tmp_path / "s.yaml").write_text(SURVEY.replace("steps: 25", "steps: 1"))  # two scans
    run = ["run", tmp_path / "s.yaml", "-q", "--scheduler", slots, "--cloud-only"]
    parts = [tmp_path / f"part-{number}" for number in (1, 2, 3)]
    for number, part in enumerate(parts, 1):
        assert lidarpool(*run, "--shard", f"{number}/3", "--out", part).code == 0
    with pytest.raises(LidarError, match=r"^These shards are missing: 1/3\. Specify"):
        merge(parts[1:], tmp_path / "all")
    report = merge(parts, tmp_path / "all")
    assert report["planning"]["trials"] == 3 and "report.html" not in report["files"]
    assert lidarpool(*run, "--out", tmp_path / "one").code == 0
    assert content(tmp_path / "all") == content(tmp_path / "one")


# -- shards ---------------------------------------------------------------------------------------


@pytest.mark.extended
def test_a_folder_keeps_its_shard(parts, lidarpool, slots):
    before = content(parts[1])
    run = ["run", parts[0].parent / "c.yaml", "-q", "--scheduler", slots, "--out", parts[1]]
    for shard in (["--shard", "3/3"], ["--shard", "2/4"], []):
        refused = lidarpool(*run, "--resume", *shard)
        assert refused.code == 2 and "contains shard 2/3, but this run is " in refused.err
        assert "contains a finished data set" in lidarpool(*run, *shard).err
    assert lidarpool(*run, "--shard", "2/3", "--resume").code == 0
    assert content(parts[1]) == before


def slurm(*values: int) -> dict[str, str]:
    return dict(zip(("ID", "MIN", "MAX", "STEP", "COUNT"), map(str, values), strict=True))


SHARDS = [
    ("3/10", {}, Shard(3, 10)),
    ("auto/10", {"JOB_COMPLETION_INDEX": "2"}, Shard(3, 10)),
    ("auto", slurm(14, 10, 28, 2, 10), Shard(3, 10)),
    (
        "auto",
        slurm(9, 1, 3, 1, 3),
        "Shard 9/3 does not exist. The shard number must be from 1 to 3",
    ),
    (
        "auto",
        slurm(2, 1, 9, 2, 6),
        "cannot be determined from SLURM_ARRAY_TASK_ID=2, ",
    ),  # 1-3,5-9:2
    ("auto", {}, "cannot be determined from SLURM_ARRAY_TASK_ID="),
    ("auto/10", {"JOB_COMPLETION_INDEX": "x"}, "cannot be determined from JOB_COMPLETION_INDEX=x"),
    ("auto/10", {"JOB_COMPLETION_INDEX": "10"}, "Shard 11/10 does not exist"),
    ("0/10", {}, "Shard 0/10 does not exist"),
    ("11/10", {}, "Shard 11/10 does not exist"),
    ("3", {}, "Invalid shard '3'"),
]


@pytest.mark.parametrize(("text", "environment", "wanted"), SHARDS, ids=str)
def test_a_shard_is_given_or_found(text, environment, wanted):
    names = {
        n if n.isupper() and "_" in n else f"SLURM_ARRAY_TASK_{n}": v
        for n, v in environment.items()
    }
    if isinstance(wanted, Shard):
        assert Shard.parse(text, names) == wanted
    else:
        with pytest.raises(LidarError, match=wanted):
            Shard.parse(text, names)


@pytest.mark.parametrize("count", [0, 1, 7, 10, 101])
def test_shards_are_all_of_it(count):
    every = [Shard(number, 10) for number in range(1, 11)]
    scans = [scan for shard in every for scan in shard.scans(count)]
    assert scans == [*range(count)]
    assert sorted(job for shard in every for job in shard.jobs(count)) == scans
    assert {len(shard.scans(count)) for shard in every} <= {count // 10, count // 10 + 1}
