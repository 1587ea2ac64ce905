"""Parts in an object store that speaks S3."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from hashlib import sha256
from typing import Any

import pytest
from tests.system.default_survey import DEFAULT_CLOUD_SHA256

from lidarpool.columns.parts import PartColumns, unpack
from lidarpool.columns.storage import Storage
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
        Storage.at(BUCKET).prepare()
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

    def look(store: RunStore) -> None:
        storage = store.storage
        found[storage.url] = [unpack(storage.read(name)) for name in sorted(storage.sizes())]
        remove(store)
        assert storage.sizes() == {}

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
from lidarpool.columns.storage import Storage
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
