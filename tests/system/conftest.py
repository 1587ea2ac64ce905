from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from distributed import Client, Worker, WorkerPlugin
from tests.daemons import wait_until

import lidarpool.report.campaign_report
import lidarpool.report.charts
import lidarpool.report.result_pictures
import lidarpool.run.pipeline.long_stages
from lidarpool import Cloud
from lidarpool.cli.commands import main
from lidarpool.processes.tracing import trace_to
from lidarpool.run.cluster.connection import local_cluster
from poolpart.fetch import fetch_available
from poolpart.pipe_states import pipes_of


@pytest.fixture(scope="session")
def local_client() -> Iterator[Client]:
    """A local cluster of processes: two casting workers, one each of LIDAR and OTHER."""
    with (
        local_cluster(gpu_workers=2, other_workers=1) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


@pytest.fixture
def client(local_client: Client) -> Client:
    """The local cluster with all its workers: an earlier test may have killed some.

    One that was killed may be listed for a moment yet, and a run that begins then is without it.
    """

    def all_answer() -> bool:
        answers = local_client.run(os.getpid, on_error="return").values()
        return len(answers) == 4 and all(isinstance(pid, int) for pid in answers)

    wait_until(all_answer)
    return local_client


class _Saboteur(WorkerPlugin):
    """Ends a worker that comes to a point with a scan, as long as a file is there."""

    name = "saboteur"

    def __init__(self, point: str, scan: int, armed: Path) -> None:
        self.point = point
        self.scan = scan
        self.armed = armed

    def setup(self, worker: Worker) -> None:
        trace_to(self._strike)

    def teardown(self, worker: Worker) -> None:
        trace_to(None)

    def _strike(self, point: str, fields: dict[str, Any]) -> None:
        if point == self.point and self.scan in fields["scans"] and self.armed.exists():
            os.kill(os.getpid(), signal.SIGKILL)


@pytest.fixture
def sabotage(client: Client, tmp_path: Path) -> Iterator[Callable[..., Path]]:
    """Have workers die when they pass a point with a scan, as long as the file returned exists."""

    def sabotage(point: str, scan: int) -> Path:
        file = tmp_path / "armed"
        file.touch()
        client.register_plugin(_Saboteur(point, scan, file))
        return file

    yield sabotage
    client.unregister_worker_plugin("saboteur")


@pytest.fixture
def same_cloud() -> Callable[[Cloud, Cloud], bool]:
    def same(one: Cloud, two: Cloud) -> bool:
        return np.array_equal(one.positions, two.positions) and all(
            one.columns[name].tobytes() == two.columns[name].tobytes()  # NaN equals NaN
            for name in one.columns.keys() | two.columns.keys()
        )

    return same


@pytest.fixture
def left_over() -> Callable[[Client], tuple[list[str], list[str], list[str]]]:
    """What a scheduler still knows of tasks, pipes and variables, after a moment."""

    def look(dask_scheduler):
        pipes = pipes_of(dask_scheduler)
        variables = dask_scheduler.extensions["variables"].variables
        return [str(key) for key in dask_scheduler.tasks], list(pipes), list(variables)

    def left_over(client: Client) -> tuple[list[str], list[str], list[str]]:
        until = time.monotonic() + 300  # cancelling is told to the scheduler, not asked
        while any(found := client.run_on_scheduler(look)) and time.monotonic() < until:
            time.sleep(0.05)
        return found

    return left_over


class OutsideCluster:
    """A scheduler and workers from the `dask` command line, in processes of their own."""

    def __init__(self, folder: Path, **environment: str) -> None:
        self.folder = folder
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.workers: dict[str, int] = {}  # {process: how many are in it}
        self._added = 0  # workers, those that were killed among them
        file = folder / "scheduler.json"
        self._start(
            "scheduler", "--port", "0", "--no-dashboard",
            "--scheduler-file", str(file), "--host", "127.0.0.1", **environment,
        )  # fmt: skip
        wait_until(
            lambda: file.exists() and file.read_text().endswith("}")
        )  # it is written in pieces
        self.address = json.loads(file.read_text())["address"]

    def _start(self, command: str, *arguments: str, name: str = "", **environment: str) -> None:
        self.processes[name or command] = subprocess.Popen(
            [Path(sys.executable).with_name("dask"), command, *arguments],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **environment},
        )

    def add(self, *workers: tuple[str, int], preload: str = "", **environment: str) -> str:
        """Start workers, (partition, slots) each, in one process.

        Returns the name of the first, which is that of the process too. `preload` is Python that
        comes before its workers.
        """
        spec = {}
        for partition, slots in workers:
            name = f"{partition}-{self._added}"
            self._added += 1
            options = {"name": name, "nthreads": slots, "resources": {partition: slots}}
            options |= {"host": "127.0.0.1", "dashboard": False}
            spec[name] = {
                "cls": "distributed.Worker",
                "opts": {**options, "local_directory": str(self.folder)},
            }
        first = next(iter(spec))
        if preload:
            file = self.folder / f"{first}.py"
            file.write_text(preload)
            spec[first]["opts"]["preload"] = [str(file)]
        self._start("spec", self.address, "--spec", json.dumps(spec), name=first, **environment)
        self.workers[first] = len(spec)
        return first

    def wait(self) -> None:
        """Wait until all workers are there."""
        with Client(self.address, set_as_default=False) as client:
            client.wait_for_workers(sum(self.workers.values()), timeout=300)

    def kill(self, name: str) -> None:
        """Kill a process, without goodbye."""
        self.processes[name].kill()
        self.processes.pop(name).wait(300)
        self.workers.pop(name, None)

    def close(self) -> None:
        """End all processes."""
        for name in list(self.processes):
            self.kill(name)


@pytest.fixture(scope="module")
def outside(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., OutsideCluster]]:
    """Start clusters from the `dask` command line that end with the module."""
    clusters: list[OutsideCluster] = []

    def start(**environment: str) -> OutsideCluster:
        clusters.append(OutsideCluster(tmp_path_factory.mktemp("cluster"), **environment))
        return clusters[-1]

    yield start
    for cluster in clusters:
        cluster.close()


FIRST_STEP = re.compile(r"^\d\d:\d\d:\d\d  reading the (scene|source|data set)\n")


@dataclass(frozen=True)
class Outcome:
    """How a command ended."""

    code: int
    out: str
    err: str


@pytest.fixture(name="lidarpool")
def run_lidarpool(capfd: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """Run the command in this process."""

    def run(*arguments: object) -> Outcome:
        capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            main([str(argument) for argument in arguments])
        out, err = capfd.readouterr()
        # The first step comes before everything else; tests of `first_step` have it.
        return Outcome(int(ended.value.code or 0), out, re.sub(FIRST_STEP, "", err))

    return run


class BlankPage:
    """Stands for a drawn picture."""

    def save(self, path: Path) -> None:
        path.write_bytes(b"x")

    def html(self) -> str:
        return "<svg></svg>"


@pytest.fixture
def pictures() -> None:
    """Have pictures drawn."""


@pytest.fixture(autouse=True)
def _no_pictures(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the drawing out otherwise, which takes longer than a small survey."""
    if "pictures" in request.fixturenames:
        return
    monkeypatch.setattr(lidarpool.report.result_pictures, "take_shot", lambda *_, **__: None)
    for name in ("draw_scene", "draw_hits", "draw_cloud", "draw_path"):
        monkeypatch.setattr(lidarpool.report.result_pictures, name, lambda *_, **__: BlankPage())
    for name in ("draw_varied", "draw_results"):
        monkeypatch.setattr(lidarpool.report.campaign_report, name, lambda *_: None)
    monkeypatch.setattr(lidarpool.report.charts, "draw_sweep", lambda *_: None)


@pytest.fixture
def all_records(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait for the records of the long stages: a run does without those that come too late."""
    monkeypatch.setattr(lidarpool.run.pipeline.long_stages, "LAST_WORDS_S", 120.0)
    patient = partial(fetch_available, patience_s=120.0)
    monkeypatch.setattr(lidarpool.run.pipeline.long_stages, "fetch_available", patient)


@pytest.fixture
def small_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put ten scans into a batch, however long they take.

    By default the machine's speed decides, and a survey of small scans may be under way as a
    whole, or stage 1 have ended, when the driver sees the first frames.
    """
    monkeypatch.setattr("lidarpool.run.pipeline.policies.scans_per_batch", lambda *_: 10)
