"""A worker that is stopped until the scheduler has given it up, and then wakes up.

It has no nanny, which would have killed it: what it did before, it goes on with, beside
those who have taken its work over.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from importlib import import_module

import pytest
from tests.chaos.events import STOP
from tests.chaos.nemesis import Fault
from tests.chaos.survey import disturbed

JOIN_S = 300.0
STOP_S = 2.0  # for others to take over


@pytest.fixture
def lonely(arena):
    """Start a worker without a nanny, as the only one of its partition; returns its name."""
    started: list[subprocess.Popen[bytes]] = []

    def start(partition: str, slots: int) -> str:
        name = f"lonely-{partition}"
        options = f"--no-nanny --no-dashboard --host 127.0.0.1 --nthreads {slots} --name {name}"
        command = [sys.executable, "-m", "distributed.cli.dask_worker"]
        command += [arena.client.scheduler.address, *options.split()]
        started.append(
            subprocess.Popen(
                [*command, "--resources", f"{partition}={slots}"],
                env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
        )
        workers = arena.cluster.scheduler.workers
        deadline = time.monotonic() + JOIN_S
        while not (found := [a for a, w in list(workers.items()) if str(w.name) == name]):
            assert time.monotonic() < deadline, f"{name} did not join"
            time.sleep(0.05)
        arena.client.run(lambda: bool(import_module("lidarpool.scan.stages")), workers=found)
        arena.withdraw(partition)
        return name

    yield start
    for process in started:
        process.kill()
        process.wait()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("partition", "slots", "point"), [("GPU", 1, "intersect.cast"), ("LIDAR", 4, "collect.part")]
)
def test_what_it_does_when_it_wakes_up_counts_once(
    arena, what, known, lonely, partition, slots, point
):
    name = lonely(partition, slots)
    fault = Fault(0, STOP, point, scan=100, worker=name, stop_s=STOP_S, given_up=True)
    outcome = disturbed(arena, what, known, [fault], patience_s=300.0)
    assert outcome.sound, outcome.error or outcome.verdict
    assert outcome.done == {(STOP, point): 1}  # there was no other worker that could come to it
    assert outcome.verdict.recovered
