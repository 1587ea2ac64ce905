"""Parts, runs and results in an object store that speaks S3."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from hashlib import sha256
from typing import Any

import fsspec
import pytest
from fsspec.registry import _registry
from tests.lidarpool.test_store import JOB, add
from tests.system.default_survey import DEFAULT_CLOUD_SHA256
from tests.system.test_resume import DRIVERS, SCANS
from tests.system.test_resume import SCENARIO as RESUMED

from lidarpool import LidarpoolError
from lidarpool.base.storage import Storage
from lidarpool.columns.parts import PartColumns, unpack
from lidarpool.run.store import RunStore

pytest.importorskip("s3fs", reason="parts in an object store need s3fs")
server = pytest.importorskip("moto.server", reason="the object store of these tests is moto's")

BUCKET = "s3://surveys"
SCENARIO = "planning: {enabled: false}\n"


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
    """Run the default survey without planning, with its parts in a folder of the bucket."""
    (tmp_path / "s.yaml").write_text(SCENARIO)

    def run(folder: str, *options: str, scheduler: str = cluster) -> Any:
        return lidarpool(
            "run", tmp_path / "s.yaml", "--out", tmp_path / "out", "--only", "cloud", "-q",
            "--scheduler", scheduler, "--parts", f"{BUCKET}/{folder}", *options,
        )  # fmt: skip

    return run


@pytest.fixture
def check(tmp_path, monkeypatch) -> Callable[[str], dict[str, Any]]:
    """Check the result, and the parts that there were in a folder of the bucket; the report."""
    found: dict[str, list[PartColumns]] = {}  # {where: parts, before they went}
    remove = RunStore.remove

    def look(store: RunStore) -> str:
        storage = store.storage
        names = sorted(name for name in storage.sizes() if name.endswith(".npz"))
        found[storage.url] = [unpack(storage.read(name)) for name in names]
        left = remove(store)
        assert storage.sizes() == {}
        return left

    monkeypatch.setattr(RunStore, "remove", look)

    def check(folder: str) -> dict[str, Any]:
        out = tmp_path / "out"
        assert sha256((out / "cloud.ply").read_bytes()).hexdigest() == DEFAULT_CLOUD_SHA256
        report = json.loads((out / "report.json").read_text())
        ((url, parts),) = found.items()
        assert url.startswith(f"{BUCKET}/{folder}/run-")
        assert [part.first for part in parts[1:]] == [part.stop for part in parts[:-1]]
        assert (parts[0].first, parts[-1].stop) == (0, 108)
        assert sum(len(part) for part in parts) == report["points"] == 995
        assert not (out / "run").exists()
        return report

    return check


def test_parts_go_to_the_bucket_until_the_result_is_whole(run, check):
    done = run("whole")
    assert (done.code, done.err) == (0, "")
    check("whole")


# Ends its worker a moment after the third upload has begun.
DIES = """
import os, signal, threading
from lidarpool.base.storage import Storage
from lidarpool.run.store import RunStore
write, count = Storage.write, []
def write_and_die(storage, name, data):
    count.append(name)
    if len(count) == 3:
        threading.Timer(0.001, os.kill, (os.getpid(), signal.SIGKILL)).start()
    return write(storage, name, data)
Storage.write = write_and_die
"""


@pytest.mark.slow
@pytest.mark.sample
def test_a_collector_dies_while_it_uploads(run, check, outside, environment):
    """The stages begin on the worker with more slots, which dies, and go on on the other."""
    cluster = outside()
    cluster.add(("GPU", 1), ("LIDAR", 4), **environment)
    doomed = cluster.add(("LIDAR", 8), preload=DIES, **environment)
    cluster.wait()
    done = run("died", scheduler=cluster.address)
    assert (done.code, done.err) == (0, "")
    assert cluster.processes.pop(doomed).wait(300) == -9
    report = check("died")
    assert report["replayed"] > 0


@pytest.mark.parametrize("place", ["s3://no/x", "s9://surveys/x"])
def test_a_place_that_there_cannot_be(place, run, tmp_path):
    refused = run("", "--parts", place)
    assert refused.code == 2
    assert len(refused.err.splitlines()) == 1
    assert place in refused.err
    assert not (tmp_path / "out" / "run").exists()


@pytest.mark.slow
def test_a_bucket_that_the_workers_cannot_reach(run, check, monkeypatch):
    """Parts come to it through the driver."""
    monkeypatch.setattr(Storage, "sees", lambda *_: False)
    done = run("far")
    assert (done.code, done.err) == (0, "")
    (note,) = (n for n in check("far")["notes"] if "cannot see" in n)
    assert note.startswith(f"LIDAR of partition LIDAR cannot see {BUCKET}/far/run-")


# -- runs and results ----------------------------------------------------------------------------


def result_at(url: str) -> dict[str, Any]:
    """Report of a whole result, which has left nothing of its run behind."""
    out = Storage.at(url)
    assert out.sizes().keys() >= {"cloud.ply", "report.json", "sweeps.npz"}
    assert Storage.at(f"{url}/run").sizes() == Storage.at(f"{url}/run/parts").sizes() == {}
    assert sha256(out.read("cloud.ply")).hexdigest() == DEFAULT_CLOUD_SHA256
    return json.loads(out.read("report.json"))


@pytest.mark.slow
def test_a_result_goes_to_the_bucket(cluster, lidarpool, tmp_path, environment):
    (tmp_path / "s.yaml").write_text(SCENARIO)
    url = f"{BUCKET}/results/whole"
    Storage.at(f"{url}/pcd").write("000000.pcd", b"of an earlier result")
    Storage.at(url).write("path.png", b"of an earlier result")
    arguments = ["run", tmp_path / "s.yaml", "--scheduler", cluster, "--out", url]
    refused = lidarpool(*arguments, "--only", "cloud", "-q")
    assert refused.code == 2 and "holds path.png, which no result there lists" in refused.err
    done = lidarpool(*arguments, "--only", "cloud", "--json", "-q", "--overwrite")
    assert (done.code, done.err) == (0, "")
    report = result_at(url)
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
    assert again.code == 2 and f"{url}/pcd is there already" in again.err

    Storage.at(url).remove(["report.json"])
    for command in (["plot"], ["export", "--format", "pcd"], ["view"]):
        half = lidarpool(*command, url)
        assert half.code == 2 and f"{url} has no complete result" in half.err


@pytest.mark.slow
def test_workers_put_files_of_sweeps_there(cluster, lidarpool, tmp_path, environment, monkeypatch):
    (tmp_path / "s.yaml").write_text(SCENARIO + "output: {write: [nuscenes]}\n")
    url, here = f"{BUCKET}/results/sweeps", tmp_path / "here"
    Storage.at(f"{url}/nuscenes").write("map.json", b"of an earlier result")
    run = [
        "run",
        tmp_path / "s.yaml",
        "--scheduler",
        cluster,
        "--only",
        "cloud",
        "-q",
        "--overwrite",
        "--out",
    ]
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
    assert f"Writing {url}/nuscenes failed: the worker" in failed.err
    assert "Access Denied" in failed.err and "--resume" in failed.err
    assert not Storage.at(url).has("nuscenes") and not Storage.at(url).has("report.json")


def test_damage_is_repaired_and_foreign_objects_stay(environment):
    url = f"{BUCKET}/results/damaged"
    store = RunStore(JOB, url)
    for scan in range(0, 6, 2):
        add(store, scan, scan + 2)
    storage, names = store.storage, store.points().names
    data = storage.read(names[1])
    storage.write(names[1], data[:500] + bytes([data[500] ^ 4]) + data[501:])
    foreign = {"a.npz", f"{names[0]}.bak", f".tmp-{names[0]}"}
    for name in foreign:
        storage.write(name, b"mine")
    Storage.at(f"{storage}/deeper").write(names[0], b"mine")
    store.save(now=True)
    again = RunStore(JOB, url, resume=True)
    assert again.notes == [f"cast again: scans 2 to 3; {names[1]} was damaged in {url}/parts"]
    assert add(again, 2, 4)
    again.tidy()
    assert len(again.points().load()) == 18
    assert f"{url}/parts holds what is not of this run and stays there" in again.remove()
    assert storage.sizes().keys() == foreign and Storage.at(url).sizes() == {}
    with pytest.raises(LidarpoolError, match=r"stays there, .* and 1 more: move it elsewhere"):
        RunStore(JOB, url)
    assert Storage.at(f"{storage}/deeper").sizes() == {names[0]: 4}


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("s3://nobody/x", "make the bucket first"),
        ("s3://a:b@surveys/x", "has a password: leave it out"),
        ("s9://surveys/x", "Protocol not known: s9"),
    ],
)
def test_a_result_that_cannot_go_there(url, words, lidarpool, environment):
    refused = lidarpool("demo", "--out", url)
    assert refused.code == 2 and words in refused.err
    assert len(refused.err.splitlines()) == 1


def test_a_place_is_looked_at_before_a_run(lidarpool, environment, tmp_path):
    (tmp_path / "s.yaml").write_text(SCENARIO)
    checked = lidarpool("check", tmp_path / "s.yaml", "--out", f"{BUCKET}/nothing")
    assert checked.code == 0 and Storage.at(f"{BUCKET}/nothing").sizes() == {}
    refused = lidarpool("check", tmp_path / "s.yaml", "--out", "s3://nobody/x")
    assert refused.code == 2 and "make the bucket first" in refused.err


def test_without_the_package_that_opens_it(lidarpool, monkeypatch):
    monkeypatch.setitem(sys.modules, "s3fs", None)
    monkeypatch.delitem(_registry, "s3", raising=False)
    refused = lidarpool("demo", "--out", f"{BUCKET}/x")
    assert refused.code == 2 and 'pip install "lidarpool[s3]"' in refused.err
    assert len(refused.err.splitlines()) == 1


def test_without_credentials_or_rights(lidarpool, environment, monkeypatch, tmp_path):
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    fsspec.filesystem("s3").clear_instance_cache()
    refused = lidarpool("demo", "--out", f"{BUCKET}/x")
    fsspec.filesystem("s3").clear_instance_cache()
    assert refused.code == 2 and "check the credentials and rights" in refused.err
    assert len(refused.err.splitlines()) == 1


@pytest.mark.slow
def test_drivers_are_killed_and_the_next_has_nothing_but_the_bucket(
    cluster, environment, lidarpool, tmp_path
):
    url, here = f"{BUCKET}/results/killed", tmp_path / "here"
    here.mkdir()
    (here / "s.yaml").write_text(RESUMED)
    whole = ["--out", tmp_path / "whole", "--only", "cloud", "-q", "--scheduler", cluster]
    assert lidarpool("run", here / "s.yaml", *whole).code == 0
    commit = 'before(RunDatabase, "commit", "COMMIT")'
    put = 'before(lidarpool.cli.run_command.Storage, "put", "PUT")'
    often = "\n    import lidarpool.run.remote as r, lidarpool.run.run as run"
    often += "\n    r.COPY_EVERY_S = r.COPY_REST = run.SAVE_EVERY_S = 0"
    script = DRIVERS.replace(commit, f"{commit}\n    {put}{often}")

    def drive(*kills: tuple[str, int]) -> list[int]:
        done = subprocess.run(
            [
                sys.executable, "-c", script,
                json.dumps(["run", "s.yaml", "--out", url, "--resume", "--scheduler", cluster]),
                json.dumps(kills),
            ],
            cwd=here,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert "Traceback" not in done.stderr, done.stderr
        return [json.loads(line)[1] for line in done.stdout.splitlines() if '"ended"' in line]

    moments = [("COMMIT", 1), ("driver.frame", 100), ("COMMIT", 4), ("OPEN", 1), ("SAVE", 1)]
    assert drive(*moments, ("PUT", 3)) == [-9] * 6
    assert "report.json" not in Storage.at(url).sizes()
    assert drive(("REMOVE", 1), ("", 1)) == [-9, 0]
    out = Storage.at(url)
    assert out.read("cloud.ply") == (tmp_path / "whole" / "cloud.ply").read_bytes()
    report = json.loads(out.read("report.json"))
    assert report["resumed_scans"] == report["scans"] == SCANS
    assert Storage.at(f"{url}/run").sizes() == Storage.at(f"{url}/run/parts").sizes() == {}
    assert {path.name for path in here.iterdir()} == {"s.yaml"}
