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
from tests.chaos.arena import Arena
from tests.chaos.events import STOP
from tests.chaos.nemesis import Fault
from tests.chaos.survey import PAUSES, disturbed, reference, survey

JOIN_S = 120.0
TIME_TO_LIVE_S = 300  # of the others; the stopped one is given up at once
STOP_S = 2.0  # for others to take over
SLOTS = {"GPU": 1, "LIDAR": 12}  # so many that all long stages go to the one that has them


@pytest.fixture(scope="module")
def arena():
    with Arena(pauses=PAUSES, time_to_live_s=TIME_TO_LIVE_S) as arena:
        yield arena


@pytest.fixture(scope="module")
def what():
    return survey()


@pytest.fixture(scope="module")
def known(arena, what):
    return reference(arena, what, None)


@pytest.fixture
def lonely(arena):
    """Start a worker without a nanny; returns its name."""
    started: list[subprocess.Popen[bytes]] = []

    def start(partition: str) -> str:
        name = f"lonely-{partition}"
        slots = SLOTS[partition]
        options = f"--no-nanny --no-dashboard --host 127.0.0.1 --nthreads {slots} --name {name}"
        command = [sys.executable, "-m", "distributed.cli.dask_worker"]
        started.append(
            subprocess.Popen(
                [
                    *command,
                    arena.client.scheduler.address,
                    *options.split(),
                    "--resources",
                    f"{partition}={slots}",
                ],
                env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
        )
        deadline = time.monotonic() + JOIN_S
        while name not in {str(w.name) for w in list(arena.cluster.scheduler.workers.values())}:
            assert time.monotonic() < deadline, f"{name} did not join"
            time.sleep(0.05)
        # Else the first surveys may be over before it has imported what it needs.
        [address] = [
            address
            for address, worker in list(arena.cluster.scheduler.workers.items())
            if str(worker.name) == name
        ]
        arena.client.run(lambda: bool(import_module("lidarpool.scan.stages")), workers=[address])
        return name

    yield start
    for process in started:
        process.kill()
        process.wait()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("partition", "point"),
    [
        ("GPU", "intersect.cast"),
        ("LIDAR", "collect.part"),
        ("LIDAR", "sort.put"),
        ("LIDAR", "generate.put"),
    ],
)
def test_what_it_does_when_it_wakes_up_counts_once(arena, what, known, lonely, partition, point):
    name = lonely(partition)
    fault = Fault(0, STOP, point, scan=100, worker=name, stop_s=STOP_S, given_up=True)
    for _ in range(10):
        outcome = disturbed(arena, what, known, [fault], None)
        assert outcome.sound, outcome.error or outcome.verdict
        if outcome.done:
            break  # else others had all that the newcomer was to do
    assert outcome.done == {(STOP, point): 1}
    assert outcome.verdict.recovered
