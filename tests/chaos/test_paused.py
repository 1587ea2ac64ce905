"""Test a worker that is stopped, given up by the cluster, and then continued.

The worker then continues its tasks, although other workers have taken them over.
"""

import os
import signal
import subprocess
import sys
import time
from importlib import import_module

import pytest
from tests.chaos.events import STOP, Fault
from tests.chaos.survey import PLANNING, Reference, disturbed, room

import poolpart.task_locations
from lidarpool import simulate
from lidarpool.processes.tracing import trace_to
from lidarpool.run.pipeline.stage_names import GPU

JOIN_S = 300.0
STOP_S = 2.0  # for others to take over


@pytest.fixture
def lonely(arena):
    """Return a function that starts the only worker of a partition and returns the worker's name.

    The worker has no nanny, which would kill it when the scheduler gives up on it.
    """
    started: list[subprocess.Popen[bytes]] = []

    def start(partition: str, slots: int) -> str:
        name = f"lonely-{partition}"
        options = f"--no-nanny --no-dashboard --host 127.0.0.1 --nthreads {slots} --name {name}"
        command = [sys.executable, "-m", "distributed.cli.dask_worker"]
        command += [arena.client.scheduler.address, *options.split()]
        started.append(
            subprocess.Popen(
                [*command, "--resources", f"{partition}={slots}"],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
        )
        workers = arena.cluster.scheduler.workers
        deadline = time.monotonic() + JOIN_S
        while not (found := [a for a, w in list(workers.items()) if str(w.name) == name]):
            assert time.monotonic() < deadline, f"{name} did not join"
            time.sleep(0.05)
        arena.client.run(
            lambda: bool(import_module("lidarpool.run.pipeline.long_stages")), workers=found
        )
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
def test_given_up_by_the_scheduler_what_it_does_counts_once(
    arena, what, known, lonely, partition, slots, point
):
    name = lonely(partition, slots)
    fault = Fault(0, STOP, point, scan=100, worker=name, stop_s=STOP_S, given_up=True)
    outcome = disturbed(arena, what, known, [fault], worker_timeout_s=300.0)
    assert outcome.sound, outcome.error or outcome.verdict
    assert outcome.done == {(STOP, point): 1}  # there was no other worker that could come to it
    assert outcome.verdict.recovered


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["collect-0", GPU])
def test_given_up_by_the_driver_it_does_no_harm(arena, what, known, monkeypatch, stage):
    """The driver gives up on the worker long before the scheduler's timeout of five minutes."""
    monkeypatch.setattr("lidarpool.run.pipeline.policies.scans_per_batch", lambda *_: 10)
    seen = []
    stopped = []
    reasons = set()
    continued = []

    def given_up() -> bool:
        if stage == GPU:
            return "its worker has left or does not respond" in reasons
        return not {None, stopped[0]} & {_worker_of(arena, stage)}

    def on_frame(frame) -> None:
        seen.append(frame.scan)
        if not stopped:
            if frame.scan >= 60 and (pid := _worker_of(arena, stage)):
                stopped.append(pid)
                os.kill(pid, signal.SIGSTOP)
                # Only now: on a busy machine others that are well may be silent for so long.
                patience.setattr(poolpart.workers, "SILENT_S", 2.0)
        elif not continued and given_up():
            continued.append(frame.scan)
            patience.undo()
            os.kill(stopped[0], signal.SIGCONT)

    trace_to(lambda point, fields: reasons.add(fields.get("reason")))
    try:
        with monkeypatch.context() as patience:
            result = simulate(
                room(), what, PLANNING, client=arena.client, backend="numpy", on_frame=on_frame
            )
    finally:
        trace_to(None)
        os.kill(stopped[0], signal.SIGCONT)
    assert seen == list(range(what.scan_count))
    assert Reference.of(result) == known
    assert continued, "the run has ended without giving the worker up"


def _worker_of(arena, stage) -> int | None:
    """Return the process ID of the worker that runs a stage, or of a casting worker."""
    scheduler = arena.cluster.scheduler
    if stage == GPU:
        return next((w.pid for w in list(scheduler.workers.values()) if GPU in w.resources), None)
    tasks = [task for key, task in list(scheduler.tasks.items()) if str(key).startswith(stage)]
    pids = (w.pid for t in tasks for w in (t.processing_on, *(t.who_has or ())) if w)
    return next(pids, None)
