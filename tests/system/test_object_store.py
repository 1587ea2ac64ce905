"""Parts, runs and results in an object store that speaks S3."""

import json
import multiprocessing
import sys
from collections.abc import Callable, Iterator
from hashlib import sha256
from typing import Any

import fsspec
import numpy as np
import pytest
from fsspec.registry import _registry
from tests.clusters import thread_cluster
from tests.drives import the_scene, the_sweeps, write_set
from tests.killed_drivers import drive
from tests.system.default_survey import DEFAULT_CLOUD_SHA256
from tests.system.test_campaigns import BASE, CAMPAIGN, bytes_of
from tests.system.test_resume import SCANS
from tests.system.test_resume import SCENARIO as RESUMED

import lidarpool as package
from lidarfiles.clouds.built_in_formats import DATA_SETS
from lidarfiles.datasets.dataset import job_file
from lidarfiles.datasets.job_table import JobRow
from lidarfiles.parts.parts import unpack
from lidarpool.run.store.run_store import RunStore
from lidarsim.columns.part_columns import PartColumns
from lidarsim.io.storage import Storage
from lidarsim.sweeps.sweeps import SWEEPS_FILE

pytest.importorskip("s3fs", reason="parts in an object store need s3fs")
server = pytest.importorskip("moto.server", reason="the object store of these tests is moto's")

BUCKET = "s3://surveys"
SCENARIO = "scene: seed\ncloud: {keep_every: 5, precision_m: 0.01}\n"


@pytest.fixture(scope="module")
def environment() -> Iterator[dict[str, str]]:
    """A server with a bucket; what whoever uses it needs to know."""
    store = server.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    store.start()
    host, port = store.get_host_and_port()
    environment = {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "AWS_ACCESS_KEY_ID": "anybody",
        "AWS_SECRET_ACCESS_KEY": "anything",
        "AWS_DEFAULT_REGION": "us-east-1",
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        fsspec.filesystem("s3").clear_instance_cache()
        fsspec.filesystem("s3").mkdir("surveys")
        yield environment
    store.stop()


@pytest.fixture
def run(environment, cluster, lidarpool, tmp_path) -> Callable[..., Any]:
    """Run the survey of the demo without planning, with its parts in a folder of the bucket."""
    (tmp_path / "s.yaml").write_text(SCENARIO)

    def run(folder: str, *options: str, scheduler: str = cluster) -> Any:
        return lidarpool(
            "run", tmp_path / "s.yaml", "--out", tmp_path / "out", "--cloud-only", "-q",
            "--scheduler", scheduler, "--scratch-dir", f"{BUCKET}/{folder}", *options,
        )  # fmt: skip

    return run


def test_parts_go_to_the_bucket_until_the_result_is_whole(run, tmp_path, monkeypatch):
    found: dict[str, list[PartColumns]] = {}  # {where: parts, before they went}
    remove = RunStore.remove

    def look(store: RunStore) -> None:
        storage = store.storage
        names = sorted(name for name in storage.sizes() if name.endswith(".npz"))
        found[storage.url] = [unpack(storage.read(name)) for name in names]
        remove(store)
        assert storage.sizes() == {}

    monkeypatch.setattr(RunStore, "remove", look)
    done = run("whole")
    assert (done.code, done.err) == (0, "")
    out = tmp_path / "out"
    assert sha256((out / "cloud.ply").read_bytes()).hexdigest() == DEFAULT_CLOUD_SHA256
    ((url, parts),) = found.items()
    assert url.startswith(f"{BUCKET}/whole/run-")
    assert [part.first for part in parts[1:]] == [part.stop for part in parts[:-1]]
    assert (parts[0].first, parts[-1].stop) == (0, 108)
    assert sum(len(part) for part in parts) == 995
    assert not (out / "run").exists()


@pytest.mark.slow
def test_a_result_goes_to_the_bucket(cluster, lidarpool, tmp_path, environment):
    (tmp_path / "s.yaml").write_text(SCENARIO)
    url = f"{BUCKET}/results/whole"
    Storage.at(f"{url}/pcd").write("000000.pcd", b"of an earlier result")
    Storage.at(url).write("path.png", b"of an earlier result")
    arguments = ["run", tmp_path / "s.yaml", "--scheduler", cluster, "--out", url]
    refused = lidarpool(*arguments, "--cloud-only", "-q")
    assert (
        refused.code == 2
        and "contains path.png, which would be replaced although it does not belong to a result"
        in refused.err
    )
    done = lidarpool(*arguments, "--cloud-only", "--json", "-q", "--overwrite")
    assert (done.code, done.err) == (0, "")
    out = Storage.at(url)
    assert Storage.at(f"{url}/run").sizes() == Storage.at(f"{url}/run/parts").sizes() == {}
    assert sha256(out.read("cloud.ply")).hexdigest() == DEFAULT_CLOUD_SHA256
    report = json.loads(out.read("report.json"))
    told = json.loads(done.out)
    assert told["folder"] == url and told["files"]["cloud.ply"] == f"{url}/cloud.ply"
    assert set(report["files"]) == Storage.at(url).sizes().keys()
    assert Storage.at(f"{url}/pcd").read("000000.pcd") == b"of an earlier result", "unlisted"
    Storage.at(url).discard("pcd")
    assert environment["AWS_SECRET_ACCESS_KEY"] not in json.dumps(report)

    exported = lidarpool("export", url, "--format", "pcd")
    assert (exported.code, exported.out) == (0, f"{url}/pcd\n")
    assert Storage.at(f"{url}/pcd").sizes()
    again = lidarpool("export", url, "--format", "pcd")
    assert again.code == 2 and f"{url}/pcd already exists. Pass another folder" in again.err

    Storage.at(url).remove(["report.json"])
    for command in (["plot"], ["export", "--format", "pcd", "--overwrite"], ["view"]):
        half = lidarpool(*command, url)
        assert half.code == 2 and f"{url} does not contain a complete result" in half.err


@pytest.mark.slow
def test_workers_put_files_of_sweeps_there(cluster, lidarpool, tmp_path, environment, monkeypatch):
    (tmp_path / "s.yaml").write_text(SCENARIO + "output: {write: [nuscenes]}\n")
    url = f"{BUCKET}/results/sweeps"
    here = tmp_path / "here"
    Storage.at(f"{url}/nuscenes").write("v1.0-lidarpool/map.json", b"of an earlier result")
    run = ["run", tmp_path / "s.yaml", "--scheduler", cluster, "--cloud-only", "-q"]
    run += ["--overwrite", "--out"]
    for place in (here, url):
        assert lidarpool(*run, place).code == 0
    report = json.loads(Storage.at(url).read("report.json"))
    assert report["tasks"]["LIDAR"]["export"] == 1
    system, folder = fsspec.url_to_fs(f"{url}/nuscenes")
    found = {name.removeprefix(f"{folder}/"): system.cat(name) for name in system.find(folder)}
    made = [path for path in (here / "nuscenes").rglob("*") if path.is_file()]
    assert found == {str(path.relative_to(here / "nuscenes")): path.read_bytes() for path in made}

    write = Storage.write

    def full(storage, name, data):
        if name.endswith(".bin"):
            raise OSError("Access Denied")
        write(storage, name, data)

    monkeypatch.setattr(Storage, "write", full)
    failed = lidarpool(*run, url, "--overwrite")
    assert failed.code == 2 and failed.err.count("\n") == 1
    assert f"Writing {url}/nuscenes failed: The worker" in failed.err
    assert "Access Denied" in failed.err and "--resume" in failed.err
    assert not {"nuscenes", "report.json"} & Storage.at(url).entries().keys()


@pytest.mark.slow
@pytest.mark.parametrize("format", DATA_SETS)
def test_a_data_set_is_written_and_read_in_the_bucket(environment, tmp_path, format):  # noqa: A002
    scene = the_scene()
    url = f"{BUCKET}/sets/{format}"
    here = tmp_path / "here"
    sweeps = the_sweeps(scene)
    data = write_set(url, format, scene, sweeps)
    write_set(here, format, scene, sweeps)
    system, folder = fsspec.url_to_fs(url)

    def files() -> dict[str, bytes]:
        system.invalidate_cache()
        names = system.find(folder)
        return {name.removeprefix(f"{folder}/"): system.cat(name) for name in names}

    made = [path for path in here.rglob("*") if path.is_file()]
    kept = {str(path.relative_to(here)): path.read_bytes() for path in made}
    assert files() == kept
    there, local = (package.sweeps(place, shuffle=1) for place in (url, here))
    for one, two in zip(there, local, strict=True):
        np.testing.assert_array_equal(one.points, two.points)
        assert (one.job, one.number, one.boxes.names) == (two.job, two.number, two.boxes.names)
    rows = [JobRow(number, f"{number:02}") for number in (0, 1)]
    assert [wrong for _, (_, wrong) in data.check_jobs(rows, contents=True)] == ["", ""]
    system.rm(f"{folder}/{job_file(format, '00', SWEEPS_FILE)}")
    assert [bool(wrong) for _, (_, wrong) in data.check_jobs(rows)] == [True, False]
    system.rm(f"{folder}/dataset.json")
    with pytest.raises(package.LidarError, match="contains an unfinished data set"):
        package.sweeps(url)


@pytest.mark.slow
@pytest.mark.slow(keep=("parquet",))
@pytest.mark.parametrize("format", ("kitti", "parquet"))  # pyarrow reads it
def test_forks_read_a_data_set_that_their_parent_has_opened(environment, format):  # noqa: A002
    scene = the_scene()
    url = f"{BUCKET}/forks/{format}"
    write_set(url, format, scene, the_sweeps(scene))
    data = package.sweeps(url, shuffle=2)
    alone = [sweep.points.tobytes() for sweep in data]
    context = multiprocessing.get_context("fork")  # as of workers of a DataLoader
    queue = context.Queue()

    def read() -> None:
        queue.put([sweep.points.tobytes() for sweep in data])

    forks = [context.Process(target=read, daemon=True) for _ in range(2)]
    for fork in forks:
        fork.start()
    assert [queue.get(timeout=60) for _ in forks] == [alone] * 2
    assert data[0].points.tobytes() == alone[0]


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("s3://nobody/x", "Create the bucket first"),
        ("s3://a:b@surveys/x", "must not contain a password"),
        ("s9://surveys/x", "Protocol not known: s9"),
    ],
)
@pytest.mark.parametrize("option", ["--out", "--scratch-dir"])
def test_a_place_that_there_cannot_be(option, url, words, lidarpool, run, tmp_path):
    is_out = option == "--out"
    refused = lidarpool("demo", "--out", url) if is_out else run("", "--scratch-dir", url)
    assert refused.code == 2 and (words in refused.err or option == "--scratch-dir")
    assert len(refused.err.splitlines()) == 1
    assert not (tmp_path / "out" / "run").exists()


def test_a_place_is_looked_at_before_a_run(lidarpool, environment, tmp_path):
    (tmp_path / "s.yaml").write_text(SCENARIO)
    checked = lidarpool("check", tmp_path / "s.yaml", "--out", f"{BUCKET}/nothing")
    assert checked.code == 0 and Storage.at(f"{BUCKET}/nothing").sizes() == {}
    refused = lidarpool("check", tmp_path / "s.yaml", "--out", "s3://nobody/x")
    assert refused.code == 2 and "Create the bucket first" in refused.err


def test_without_the_package_that_opens_it(lidarpool, monkeypatch):
    monkeypatch.setitem(sys.modules, "s3fs", None)
    monkeypatch.delitem(_registry, "s3", raising=False)
    refused = lidarpool("demo", "--out", f"{BUCKET}/x")
    assert refused.code == 2 and 'pip install -e ".[s3]" in a checkout of lidarpool' in refused.err
    assert len(refused.err.splitlines()) == 1


def test_without_credentials_or_rights(lidarpool, environment, monkeypatch, tmp_path):
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    fsspec.filesystem("s3").clear_instance_cache()
    refused = lidarpool("demo", "--out", f"{BUCKET}/x")
    fsspec.filesystem("s3").clear_instance_cache()
    assert refused.code == 2 and "Check the credentials" in refused.err
    assert len(refused.err.splitlines()) == 1


@pytest.mark.slow
def test_drivers_are_killed_and_the_next_has_nothing_but_the_bucket(
    cluster, environment, lidarpool, tmp_path
):
    url = f"{BUCKET}/results/killed"
    here = tmp_path / "here"
    here.mkdir()
    (here / "s.yaml").write_text(RESUMED)
    whole = ["--out", tmp_path / "whole", "--cloud-only", "-q", "--scheduler", cluster]
    assert lidarpool("run", here / "s.yaml", *whole).code == 0
    often = "import lidarpool.run.store.remote as r, lidarpool.run.run_loop as run\n"
    often += "r.COPY_EVERY_S = r.COPY_REST = run.SAVE_EVERY_S = 0\n"
    run = ["s.yaml", "--out", url, "--resume", "--scheduler", cluster]
    moments = [("COMMIT", 1), ("driver.frame", 100), ("COMMIT", 4), ("OPEN", 1), ("SAVE", 1)]
    moments += [("PUT", 1), ("COPY", 2)]
    assert drive(here, moments, *run, prelude=often) == [-9] * 7
    assert "report.json" not in Storage.at(url).sizes()
    assert drive(here, [("REMOVE", 1), ("", 1)], *run, prelude=often) == [-9, 0]
    out = Storage.at(url)
    assert out.read("cloud.ply") == (tmp_path / "whole" / "cloud.ply").read_bytes()
    report = json.loads(out.read("report.json"))
    assert report["resumed_scans"] == report["scans"] == SCANS
    assert Storage.at(f"{url}/run").sizes() == Storage.at(f"{url}/run/parts").sizes() == {}
    assert {path.name for path in here.iterdir()} == {"s.yaml"}


@pytest.mark.slow
def test_a_campaign_goes_to_the_bucket_though_its_driver_is_killed(
    environment, lidarpool, tmp_path
):
    (tmp_path / "base.yaml").write_text(BASE)
    (tmp_path / "c.yaml").write_text(CAMPAIGN)
    url = f"{BUCKET}/datasets/killed"
    with thread_cluster({"GPU": 1}, {"LIDAR": 5}) as cluster:
        address = cluster.scheduler_address
        run = ["run", tmp_path / "c.yaml", "-q", "--scheduler", address, "--out"]
        assert lidarpool(*run, tmp_path / "here").code == 0
        kills = [("COMMIT", 2), ("END", 2), ("FINISH", 1), ("REMOVE", 1), ("", 1)]
        options = ["--resume", "-q", "--scheduler", address, "--out", url]
        assert drive(tmp_path, kills, "c.yaml", *options) == [-9] * 4 + [0]
    system, folder = fsspec.url_to_fs(url)
    system.invalidate_cache()
    found = {name.removeprefix(f"{folder}/"): system.cat(name) for name in system.find(folder)}
    jobs = {n: data for n, data in found.items() if n.startswith(("jobs/", ".jobs/", "jobs."))}
    assert jobs == bytes_of(tmp_path / "here")
    assert not any(name.startswith("run/") or name.endswith("-dataset") for name in found)


@pytest.mark.slow
def test_shards_in_the_bucket_are_merged_there_and_here(environment, lidarpool, tmp_path):
    (tmp_path / "base.yaml").write_text(BASE)
    (tmp_path / "c.yaml").write_text(CAMPAIGN.replace("count: 6", "count: 2"))
    (tmp_path / "s.yaml").write_text(BASE)
    with thread_cluster({"GPU": 1}, {"LIDAR": 5}) as cluster:
        for name, file in (("campaign", "c.yaml"), ("survey", "s.yaml")):
            run = ["run", tmp_path / file, "-q", "--scheduler", cluster.scheduler_address]
            assert lidarpool(*run, "--out", tmp_path / name).code == 0
            shards = [f"{BUCKET}/{name}/part-1", tmp_path / f"{name}-2"]
            for number, place in enumerate(shards, 1):
                assert lidarpool(*run, "--shard", f"{number}/2", "--out", place).code == 0
            for out in (f"{BUCKET}/{name}/all", tmp_path / f"{name}-all"):
                done = lidarpool("merge", *shards, "--out", out, "-q")
                assert done.code == 0, done
                notice = "warning: 1 job has no points: 0000" if name == "campaign" else ""
                assert done.err.partition(". ")[0] == notice, done
    system, folder = fsspec.url_to_fs(f"{BUCKET}/campaign/all")
    system.invalidate_cache()
    found = {name.removeprefix(f"{folder}/"): system.cat(name) for name in system.find(folder)}
    jobs = {n: data for n, data in found.items() if n.startswith(("jobs/", ".jobs/", "jobs."))}
    whole = bytes_of(tmp_path / "campaign")
    assert jobs == bytes_of(tmp_path / "campaign-all") == whole
    cloud = (tmp_path / "survey/cloud.ply").read_bytes()
    assert Storage.at(f"{BUCKET}/survey/all").read("cloud.ply") == cloud
    assert (tmp_path / "survey-all/cloud.ply").read_bytes() == cloud
