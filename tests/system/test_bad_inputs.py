"""What users get wrong: each with its message, exit code 2, and the earlier result untouched."""

import os
import re
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import trimesh
from tests.clusters import cluster_of, import_jobqueue, thread_cluster

import lidarpool.run.cluster.connection
import lidarpool.run.cluster.watch as lidarpool_watch
from raybeam import available_backends

BOX = trimesh.creation.box((2, 4, 6))

# One of each kind; what else is wrong with files is asked in the tests of each package.
# {case: (name of the file, its content, what the message says)}
FILES: dict[str, tuple[str, bytes | None, str]] = {
    "empty mesh": ("hall.stl", b"", "hall.stl is empty"),
    "cut mesh": ("hall.stl", BOX.export(file_type="stl")[:-60], "hall.stl"),
    "no scenario": ("s.yaml", None, "s.yaml does not exist"),
    "not YAML": ("s.yaml", b"scene: [seed\n", "s.yaml, line 2: "),
    "misspelt field": ("s.yaml", b"sensor: {layer: 3}\n", "Did you mean 'layers'?"),
    "misspelt mesh": ("s.yaml", b"scene: {files: [aa.stl]}\n", "Did you mean 'a.stl'?"),
    "two fields": (
        "s.yaml",
        b"scene: seed\nplanning: {start: [25, 25], target: [25, 25]}\n",
        "path are both (25.0, 25.0)",
    ),
    "too fine": (
        "s.yaml",
        b"scene: {preset: seed, ground: {margin_m: 1000000}}\ncloud: {precision_m: 0.000001}\n",
        "is too small for a scene",
    ),
}

# What comes back of a pulse; what numbers cannot be is asked in tests/lidarsim/test_echoes.py.
# {content of a scenario: what the message says}
RETURNS = {
    "materials: [{objects: V*, reflectance: 0.3}]": "no entry matches the object",
    "materials: [{objects: ['*', Vace]}]": "no object has that name. Did you mean 'Vase'?",
    "materials: [{objects: Q*}, {objects: '*'}]": (
        "'Q*', but no object has that name. Available names: "
    ),
    "returns: {subrays: 19}": (
        "beam divergence of the sensor is unknown. Set returns.divergence_mrad"
    ),
    "noise: {range_m: -0.01}": "noise.range_m must be from 0 to 1000, but is -0.01",
    "cloud: {columns: [intensities]}": "Did you mean 'intensity'?",
}
FILES |= {text: ("s.yaml", f"scene: seed\n{text}".encode(), says) for text, says in RETURNS.items()}

OPTIONS: dict[str, tuple[list[str], str]] = {
    "no scenario": (["run"], "Usage: lidarpool run"),
    "unknown backend": (["run", "good.yaml", "--backend", "gpu"], "'gpu' is not one of 'auto'"),
    "options of a mesh": (
        ["run", "good.yaml", "--pose", "0,0,1"],
        "`--pose` requires a mesh file. Set `poses` in good.yaml",
    ),
    "several meshes": (["run", "a.stl", "a.stl", "--pose", "0,0,1"], "require a single mesh file"),
    "misspelt model": (["run", "a.stl", "--sensor", "vlp61"], "Did you mean 'vlp16'?"),
    "no model": (["run", "a.stl", "--sensor", ""], "Unknown sensor model ''."),
    "misspelt column": (["run", "a.stl", "--columns", "rang,time"], "Did you mean 'range'?"),
    "misspelt format": (["run", "a.stl", "--format", "lass"], "Did you mean 'las'?"),
    "no place": (["run", "a.stl", "--pose", "0,0"], "'0,0' is not a position. Expected X,Y,Z"),
    "no time": (["run", "good.yaml", "--startup-timeout", "soon"], "'soon' is not a duration"),
    "both": (["run", "good.yaml", "--resume", "--restart"], "cannot be combined"),
    "certificates alone": (["doctor", "--tls-key", "a.stl"], "require `--scheduler` with"),
    "certificate that does not exist": (
        ["doctor", "--tls-ca", "ca.pem"],
        "'ca.pem' does not exist",
    ),
    "two clusters": (
        ["run", "good.yaml", "--cluster", "c.yaml", "--scheduler", "tcp://127.0.0.1:1"],
        "`--cluster` and `--scheduler` cannot be combined",
    ),
    "tls of a cluster file": (
        ["run", "good.yaml", "--cluster", "c.yaml", "--tls"],
        "`--tls` can only be used with the local cluster",
    ),
    "tls elsewhere": (
        ["run", "good.yaml", "--tls", "--scheduler", "tls://127.0.0.1:1"],
        "`--tls` can only be used with the local cluster",
    ),
    "scenario is a folder": (["run", "."], "Is a directory"),
    "name that no file can have": (["run", 300 * "x"], "File name too long"),
    "name that no folder can have": (["run", "good.yaml", "--out", 300 * "x"], "too long"),
    "out is a file": (["run", "good.yaml", "--out", "a.stl"], "a.stl is a file"),
    "out cannot be made": (["run", "good.yaml", "--out", "/proc/o"], "Cannot write to the folder"),
    "malformed address": (["run", "good.yaml", "--scheduler", "tcp://::1:x"], "tcp://host:8786"),
    "unknown scheme": (["run", "good.yaml", "--scheduler", "foo://127.0.0.1:1"], "scheme 'foo'"),
    "no host": (["run", "good.yaml", "--scheduler", "tcp://:8786"], "Expected a host"),
    "no port": (["doctor", "--scheduler", "localhost"], "a port from 1 to 65535"),
    "no certificates": (
        ["run", "good.yaml", "--scheduler", "tls://127.0.0.1:1"],
        "uses TLS, but `--tls-ca` and `--tls-cert` are missing",
    ),
    "certificates without encryption": (
        ["doctor", "--scheduler", "tcp://127.0.0.1:1", "--tls-ca", "a.stl"],
        "'tcp://127.0.0.1:1' does not start with tls://",
    ),
    "no scheduler file": (
        ["run", "good.yaml", "--startup-timeout", "0s", "--scheduler", "sched.json"],
        "The scheduler file sched.json does not exist",
    ),
    "no such scheduler file": (
        ["doctor", "--scheduler-file", "sched"],
        "The scheduler file sched does not exist",
    ),
    "another file": (
        ["doctor", "--scheduler-file", "good.yaml"],
        "The scheduler file good.yaml cannot be read",
    ),
    "address and file": (
        ["doctor", "--scheduler", "tcp://127.0.0.1:1", "--scheduler-file", "sched.json"],
        "`--scheduler` and `--scheduler-file` cannot be combined",
    ),
    "scene that is there": (["scene", "city", "good.ply"], "already exists. Use another name"),
    "no scheduler": (  # nor is a folder left behind
        [
            "run",
            "good.yaml",
            "--out",
            "new/deep",
            "--startup-timeout",
            "0s",
            "--scheduler",
            "tcp://127.0.0.1:1",
        ],
        "No Dask scheduler",
    ),
}


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A working folder with a good scenario and files in its output folder."""
    (tmp_path / "good.yaml").write_text(
        "scene: seed\nsensor: {layers: 2}\nsteps: 2\n"
        "planning: {start: [25, 25], target: [-30, -20]}\n"
    )
    (tmp_path / "a.stl").write_bytes(BOX.export(file_type="stl"))
    (tmp_path / "good.ply").touch()
    (tmp_path / "lidarpool-out").mkdir()
    for name in ("cloud.laz", "notes of mine.txt"):
        (tmp_path / "lidarpool-out" / name).write_text(f"an earlier {name}")
    return tmp_path


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give up soon; for addresses where nobody answers. On a busy machine a scheduler may not."""
    monkeypatch.setattr(lidarpool.run.cluster.connection, "CONNECT_TIMEOUT_S", 1)


def content(folder: Path) -> dict[str, bytes | None]:
    """All that is in a folder; None for a folder."""
    files = {path.relative_to(folder): path for path in folder.rglob("*")}
    return {str(k): None if p.is_dir() else p.read_bytes() for k, p in files.items()}


@pytest.fixture
def refused(place: Path, lidarpool: Callable[..., Any]) -> Callable[..., None]:
    """Run the command and check that it ends as it should on bad input."""

    def check(arguments: list[str], says: str) -> None:
        before = content(place)
        outcome = lidarpool(*arguments)
        assert says in outcome.err
        check_refusal(outcome.code, outcome.out, outcome.err)
        assert content(place) == before

    return check


def check_refusal(code: int, out: str, err: str) -> None:
    assert code == 2
    assert out == ""
    assert err.startswith("lidarpool: ")
    told = [line for line in err.splitlines() if not re.match(r"\d\d:\d\d:\d\d  ", line)]
    names = [line for line in told if line.startswith("  ")]  # lines of a long list
    assert 1 <= len(told) - len(names) <= 3
    assert max(map(len, names), default=0) <= 100
    assert "Traceback" not in err
    assert max(map(len, told)) < 500


@pytest.mark.parametrize("case", FILES)
def test_a_bad_file(case, place, refused):
    name, data, says = FILES[case]
    if data is not None:
        (place / name).write_bytes(data)
    refused(["run", name], says)


@pytest.mark.extended(every=2)
@pytest.mark.parametrize("case", OPTIONS)
def test_bad_arguments(case, refused, impatient):
    refused(*OPTIONS[case])


def test_cuda_without_a_gpu(refused):
    if not available_backends()["cuda"]:
        pytest.skip("there is a GPU")
    refused(["run", "good.yaml", "--backend", "cuda"], "Backend 'cuda' cannot be used")


@pytest.mark.skipif(sys.platform == "win32", reason="no locks on folders")
def test_out_is_in_use_by_another_run(place, refused):
    import fcntl

    handle = os.open(place / "lidarpool-out", os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)
    refused(["run", "good.yaml"], "Another run or export is using the folder")
    os.close(handle)


@pytest.mark.extended
def test_a_listener_that_is_no_scheduler(refused, impatient):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        command = ["run", "good.yaml", "--startup-timeout", "0s"]
        refused([*command, "--scheduler", f"tcp://127.0.0.1:{port}"], "No Dask scheduler")


CLUSTERS: dict[str, tuple[list[dict[str, int]], str]] = {
    "no workers": ([], "has no workers. Start workers"),
    "little LIDAR": (
        [{"GPU": 1}, {"LIDAR": 3}, {"OTHER": 1}],
        "Partition 'LIDAR' has 3 of the 4 required slots",
    ),
    "no OTHER": ([{"GPU": 1}, {"LIDAR": 4}], "unless `planning` is removed from the scenario"),
    "two resources": (
        [{"GPU": 1, "LIDAR": 4}, {"OTHER": 1}],
        "declares the resources GPU and LIDAR",
    ),
}


@pytest.mark.parametrize("case", CLUSTERS)
def test_a_cluster_that_lacks_something(case, refused):
    resources, says = CLUSTERS[case]
    with thread_cluster(*resources) as cluster:
        command = ["run", "good.yaml", "--scheduler", cluster.scheduler_address]
        refused(command if case == "two resources" else [*command, "--startup-timeout", "0s"], says)


# {scenario: what the message says about the casting worker}
TOO_LARGE: dict[str, str] = {
    "steps: 100000\npool: {batch_mb: 501}": (
        "`batch_mb` is 501, but the casting worker at {worker} has only 500 MB for each slot. "
        "Reduce it, or start the casting workers with a larger `--memory-limit`."
    ),
    "sensor: {rays_per_revolution: 100000, layers: 128, step_deg: 360}": (
        "Casting one scan takes about 1,916 MB, but the casting worker at {worker} has only "
        "500 MB for each slot. Use a smaller `step_deg`, fewer rays or fewer columns, or start "
    ),
}


@pytest.mark.slow
@pytest.mark.slow(keep=("steps: 100000*",))
@pytest.mark.parametrize("scenario", TOO_LARGE)
def test_what_does_not_fit_into_the_memory_of_a_worker(place, lidarpool, refused, scenario):
    (place / "s.yaml").write_text(f"scene: seed\n{scenario}")
    workers = {
        "caster": {"resources": {"GPU": 2}, "memory_limit": 1_000_000_000},
        "others": {"resources": {"LIDAR": 4}},
    }
    with cluster_of(workers, {}, host="127.0.0.1") as cluster:
        options = ["s.yaml", "--scheduler", cluster.scheduler_address]
        says = TOO_LARGE[scenario].format(worker=cluster.workers["caster"].worker_address)
        refused(["run", *options], says)
        outcome = lidarpool("check", *options)
        assert outcome.code == 2 and says in outcome.err


def test_workers_that_are_waited_for_are_named_meanwhile(place, lidarpool, monkeypatch):
    monkeypatch.setattr(lidarpool_watch, "REPORT_EVERY_S", 0.0)
    with thread_cluster({"GPU": 1}, {"OTHER": 1}) as cluster:
        address = cluster.scheduler_address
        outcome = lidarpool("run", "good.yaml", "--scheduler", address, "--startup-timeout", "1s")
    assert outcome.code == 2
    assert re.search(
        r"note: waiting for workers for up to \d s more: Partition 'LIDAR' has 0 of the 4 required",
        outcome.err,
    )
    assert outcome.err.splitlines()[-1].startswith("lidarpool: Partition 'LIDAR' has 0 of the 4")


QUEUE = """
cluster: dask_jobqueue.SLURMCluster
arguments:
  cores: 1
  memory: 1GB
  scheduler_options: {host: 127.0.0.1, port: 0, dashboard_address: "127.0.0.1:0"}
partitions: {GPU: {workers: 2}, LIDAR: {slots: 4}, OTHER: {}}
"""


@pytest.mark.extended
def test_jobs_that_do_not_begin_are_cancelled(place, refused, monkeypatch):
    job = import_jobqueue().slurm.SLURMJob
    submitted: list[str] = []
    cancelled: list[str] = []

    async def submit(self: object, script: str) -> str:
        submitted.append(str(len(submitted)))
        return f"Submitted batch job {submitted[-1]}"

    async def cancel(self: object, number: str, command: str) -> None:
        cancelled.append(number)

    monkeypatch.setattr(job, "_submit_job", submit)
    monkeypatch.setattr(job, "_close_job", cancel)
    (place / "queue.yaml").write_text(QUEUE)
    refused(
        ["run", "good.yaml", "--cluster", "queue.yaml", "--startup-timeout", "0s", "--quiet"],
        "has no workers",
    )
    assert len(submitted) == 4
    assert sorted(cancelled) == submitted

    (place / "queue.yaml").write_text(QUEUE.replace("slots: 4", "slots: 3"))
    refused(
        ["run", "good.yaml", "--cluster", "queue.yaml"],
        "queue.yaml: Partition LIDAR has 3 slots, but the run needs 4",
    )
    assert len(submitted) == 4


def test_a_backend_that_the_workers_lack(cluster, refused):
    if not available_backends()["cuda"]:
        pytest.skip("there is a GPU")
    refused(
        ["run", "good.yaml", "--backend", "cuda", "--scheduler", cluster],
        "Backend 'cuda' cannot be used on the casting worker at",
    )


WITHOUT_LIDARPOOL = """
import sys

OURS = (
    "lidarfiles", "lidarlive", "lidarpool", "lidarreal", "lidarscenario", "lidarscenes", "lidarsim",
    "lidarview", "poolpart", "raybeam",
)

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in OURS:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Absent())
"""
ANOTHER_PYTHON = "import platform; platform.python_version = lambda: '3.99.1'"
OTHER_SOURCES = "import lidarfiles.identity.versions as s; s.source_hash = lambda: '12345678'"


@pytest.mark.extended
@pytest.mark.parametrize(
    ("preload", "message"),
    [
        pytest.param(
            WITHOUT_LIDARPOOL,
            "does not have lidarpool. Install lidarpool",
            marks=pytest.mark.slow,
        ),
        (OTHER_SOURCES, "(sources 12345678), but the run requires"),
        pytest.param(
            ANOTHER_PYTHON, "has Python 3.99.1, but the run requires", marks=pytest.mark.slow
        ),
    ],
    ids=["none", "other sources", "another Python"],
)
def test_workers_whose_lidarpool_is_not_ours(outside, place, refused, preload, message):
    cluster = outside()
    cluster.add(("GPU", 1), preload=preload)
    cluster.wait()
    refused(["run", "good.yaml", "--scheduler", cluster.address], message)


@pytest.mark.extended
def test_a_run_without_open3d_ends_before_it_starts(place, refused, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d.pybind", None)
    refused(["run", "good.yaml"], "Writing clouds requires Open3D, which cannot be loaded")
