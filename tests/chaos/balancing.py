"""Disturb balanced partitions until a given number of faults has been injected.

`python -m tests.chaos.balancing` sends items through a pipeline whose partitions exchange workers.
The running times of the stages change during each run, so that workers are moved all the time.
Meanwhile, workers are killed, stopped, paused, added and removed, and the client is killed and
started again. The last line of the output states how many items were lost or arrived twice, and
how often a worker belonged to two partitions. Runs with the same seed inject the same faults.
"""

from __future__ import annotations

import argparse
import logging
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import dask
from distributed import Client, Scheduler
from distributed.diagnostics.plugin import SchedulerPlugin, WorkerPlugin

import poolpart.balancing
import poolpart.steward
from poolpart import Pool, n_workers, rest
from poolpart.deploy import forked_workers, local_cluster
from poolpart.deploy.local_processes import FixedCluster, ScriptlessNanny

from .arena import WorkerProcesses
from .pipeline import BALANCED, DECODE, DETECT, PARTITIONS, SOURCE, Verdict, judge

KILL, STOP, PAUSE, JOIN, LEAVE, CLIENT = KINDS = (
    "kill",  # SIGKILL of a worker
    "stop",  # SIGSTOP, and SIGCONT some time later; the scheduler gives up half of these workers
    "pause",  # as Dask does if memory is short, and on again some time later
    "join",
    "leave",  # gracefully
    "client",  # SIGKILL of the client, which is started again
)
SHARES = 5, 4, 3, 3, 3, 2
WORKERS = 3  # of each balanced partition at the start
FEWEST, MOST = 4, 8  # workers of all balanced partitions
SLOTS = 2
ITEMS = 600  # of a run
BETWEEN_S = 0.1, 1.2  # seconds between faults
STOPPED_S = 0.2, 3.0
ENDS_WITHIN_S = 300.0
SETTLES_WITHIN_S = 120.0
# The balancer decides often, and workers whose tasks do not end are given up soon.
QUICKLY = {"INTERVAL_S": 0.1, "DRAIN_S": 2.0, "PAUSE_S": 5.0}
CONFIG = {
    "logging.distributed": "critical",
    "distributed.scheduler.worker-ttl": "300s",
    "distributed.scheduler.allowed-failures": 100,  # no task is to blame
}


class MembershipMonitor(SchedulerPlugin):
    """Scheduler plugin that records workers to which tasks of two partitions could be sent."""

    name = "membership-monitor"

    def __init__(self, scheduler: Scheduler) -> None:
        self.scheduler = scheduler
        self.shared: list[str] = []

    def transition(self, *_: Any, **__: Any) -> None:
        """Check all workers after each change of a task."""
        for worker in self.scheduler.workers.values():
            if len(names := partitions_of(worker.resources)) > 1:
                self.shared.append(f"worker {worker.name}: {' and '.join(names)}")


class Silence(WorkerPlugin):
    """Plugin that disables the logs of current and future workers."""

    name = "silence"

    def setup(self, worker: Any) -> None:
        """Disable logging: that workers die here is no news."""
        logging.disable(logging.CRITICAL)


def partitions_of(resources: dict[str, float]) -> list[str]:
    """Return the partitions that a worker declares."""
    return [name for name, slots in resources.items() if slots and name in PARTITIONS]


class Arena(WorkerProcesses):
    """Cluster of worker processes with a balanced group.

    If `declared` is true, the workers are started with the resources of their partitions. If not,
    the pool is divided by rules.
    """

    def __init__(self, declared: bool) -> None:
        self.declared = declared
        self._stack = ExitStack()

    def __enter__(self) -> Arena:
        with ExitStack() as stack:
            stack.enter_context(dask.config.set(CONFIG))
            multiprocessing.set_forkserver_preload(["distributed", "poolpart"])
            stack.enter_context(forked_workers())
            self.cluster = stack.enter_context(self._start())
            self.client = stack.enter_context(Client(self.cluster, set_as_default=False))
            self.client.register_plugin(Silence())
            self.wait_until_whole()
            if not self.declared:
                rules = {SOURCE: n_workers(1), DECODE: n_workers(WORKERS), DETECT: rest()}
                Pool.from_client(self.client).divide(rules)
            self.source = self._members(SOURCE)
            self._spec = self.cluster.worker_spec[min({*self._all()} - {*self.source})]
            self._joined = 0
            self.monitor = MembershipMonitor(self.cluster.scheduler)
            self.cluster.scheduler.add_plugin(self.monitor)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _start(self) -> FixedCluster:
        if self.declared:
            return local_cluster({SOURCE: (1, SLOTS), **dict.fromkeys(BALANCED, (WORKERS, SLOTS))})
        options = {"nthreads": SLOTS, "host": "127.0.0.1", "dashboard": False}
        options["silence_logs"] = logging.CRITICAL
        scheduler = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0", "dashboard": False}
        return FixedCluster(
            workers={
                f"worker-{number}": {"cls": ScriptlessNanny, "options": options}
                for number in range(1 + len(BALANCED) * WORKERS)
            },
            scheduler={"cls": Scheduler, "options": scheduler},
            silence_logs=logging.CRITICAL,
        )

    def _members(self, partition: str) -> list[str]:
        workers = list(self.cluster.scheduler.workers.values())
        return sorted(str(w.name) for w in workers if partition in partitions_of(w.resources))

    def _all(self) -> list[str]:
        return self.names("")

    @property
    def balanced(self) -> list[str]:
        """Names of the workers of the balanced group, including those that are down."""
        return [name for name in self._all() if name not in self.source]

    def join(self) -> None:
        """Start another worker of the balanced group."""
        self._joined += 1
        prefix = "worker" if not self.declared else BALANCED[self._joined % 2]
        self.cluster.worker_spec[f"{prefix}-1{self._joined:03}"] = self._spec
        self.cluster.sync(self.cluster._correct_state)

    def leave(self, name: str) -> None:
        """Stop a worker for good."""
        del self.cluster.worker_spec[name]
        self.cluster.sync(self.cluster._correct_state)

    def settle(self) -> list[str]:
        """Wait until each worker belongs to one partition. Return those for which this fails."""
        self.wait_until_whole()
        deadline = time.monotonic() + SETTLES_WITHIN_S
        while strays := self._strays():
            if time.monotonic() > deadline:
                return strays
            time.sleep(0.1)
        return []

    def _strays(self) -> list[str]:
        """Return the workers that do not belong to the partition that the scheduler knows."""
        own = self.client.run(_own_resources, on_error="ignore")
        strays = []
        for address, worker in list(self.cluster.scheduler.workers.items()):
            names = partitions_of(worker.resources)
            if len(names) != 1 or partitions_of(own.get(address, {})) != names:
                strays.append(f"worker {worker.name}: {names}, {own.get(address)}")
        if self._members(SOURCE) != self.source:
            strays.append(f"{SOURCE}: {self._members(SOURCE)}")
        return strays

    @property
    def moves(self) -> int:
        """Number of workers that the balancer has moved so far."""
        return sum(poolpart.balancing.move_counts(self.cluster.scheduler).values())


def _own_resources(dask_worker: Any) -> dict[str, float]:
    return dict(dask_worker.state.total_resources)


def send_signal(pid: int | None, number: signal.Signals) -> None:
    """Send a signal to a process, unless it has ended."""
    with suppress(ProcessLookupError):
        if pid is not None:
            os.kill(pid, number)


def pause_for(client: Client, address: str | None, seconds: float) -> None:
    """Pause a worker for some time, as Dask does if memory is short."""

    def pause_at(fraction: float, dask_worker: Any) -> None:
        dask_worker.memory_manager.memory_pause_fraction = fraction

    for fraction in (1e-9, 0.8):
        with suppress(OSError, ValueError):  # it died by another fault
            client.run(pause_at, fraction, workers=[address], on_error="ignore")
        if fraction < 0.8:
            time.sleep(seconds)


class Run:
    """A pass of all items through the pipeline, during which faults are injected."""

    def __init__(self, arena: Arena, folder: Path, chance: random.Random) -> None:
        self.arena = arena
        self.folder = folder
        self.done: Counter[str] = Counter()  # faults by kind
        self._chance = chance
        self._helpers: list[threading.Thread] = []

    def play(self, faults: int) -> Verdict:
        """Process all items, and inject at most `faults` faults meanwhile."""
        self._client = self._start_client()
        deadline = time.monotonic() + ENDS_WITHIN_S
        while self._client.poll() is None and time.monotonic() < deadline:
            time.sleep(self._chance.uniform(*BETWEEN_S))
            for name in self.arena.deserted:
                self.arena.revive(name)
            if faults > self.done.total() and self._client.poll() is None:
                self._strike(*self._chance.choices(KINDS, SHARES))
        hangs = self._client.poll() is None
        self._client.kill()
        self._client.wait()
        for helper in self._helpers:
            helper.join()
        strays = self.arena.settle()
        verdict = judge(self.folder, ITEMS)
        verdict.shared += [*dict.fromkeys(self.arena.monitor.shared), *strays]
        self.arena.monitor.shared.clear()
        if hangs:
            verdict.errors += f"The client did not end within {ENDS_WITHIN_S:g} s."
        return verdict

    def _start_client(self) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "tests.chaos.pipeline"]
        arguments = [self.arena.cluster.scheduler_address, str(self.folder), str(ITEMS)]
        return subprocess.Popen([*command, *arguments], stderr=subprocess.DEVNULL)

    def _strike(self, kind: str) -> None:
        """Inject a fault, unless no worker is in the required state."""
        pick = self._chance.random()
        stopped_s = self._chance.uniform(*STOPPED_S)
        arena = self.arena
        names = [*arena.balanced, *arena.source] if kind in (KILL, STOP) else arena.balanced
        running = [name for name in names if arena.address(name) and arena.pid(name)]
        if kind == CLIENT:
            self._client.kill()
            self._client.wait()
            self._client = self._start_client()
        elif kind == JOIN:
            if len(arena.balanced) >= MOST:
                return
            arena.join()
        elif not running or (kind == LEAVE and len(arena.balanced) <= FEWEST):
            return
        else:
            name = running[int(pick * len(running))]
            strike = {KILL: self._kill, STOP: self._stop, PAUSE: self._pause, LEAVE: self._leave}
            strike[kind](name, stopped_s)
        self.done[kind] += 1

    def _kill(self, name: str, _: float) -> None:
        send_signal(self.arena.pid(name), signal.SIGKILL)

    def _stop(self, name: str, seconds: float) -> None:
        pid = self.arena.pid(name)
        send_signal(pid, signal.SIGSTOP)
        self._start(self._wake, pid, seconds)
        if seconds < sum(STOPPED_S) / 2:
            self._start(self.arena.give_up, pid)

    def _wake(self, pid: int | None, seconds: float) -> None:
        time.sleep(seconds)
        send_signal(pid, signal.SIGCONT)

    def _pause(self, name: str, seconds: float) -> None:
        self._start(pause_for, self.arena.client, self.arena.address(name), seconds)

    def _leave(self, name: str, _: float) -> None:
        self.arena.leave(name)

    def _start(self, act: Any, *arguments: object) -> None:
        helper = threading.Thread(target=act, args=arguments, name=act.__name__, daemon=True)
        self._helpers.append(helper)
        helper.start()


def main(arguments: list[str] | None = None) -> int:
    """Disturb the pipeline and return 0 if all runs were sound."""
    parser = argparse.ArgumentParser(prog="tests.chaos.balancing", description=__doc__)
    parser.add_argument("--faults", type=int, default=200)
    parser.add_argument("--seed", type=int, default=None, help="random by default")
    options = parser.parse_args(arguments)
    seed = random.SystemRandom().randrange(10**6) if options.seed is None else options.seed
    print(f"seed {seed}", flush=True)
    logging.disable(logging.CRITICAL)  # that workers die here is no news
    for name, value in QUICKLY.items():
        setattr(poolpart.balancing, name, value)
    poolpart.steward.HOLD_S = 60.0  # a busy machine needs time to start a worker again
    chance = random.Random(seed)
    done: Counter[str] = Counter()
    verdicts: list[Verdict] = []
    moves = 0
    began_at = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="chaos-", ignore_cleanup_errors=True) as name:
        while not verdicts or done.total() < options.faults:
            folder = Path(name) / str(len(verdicts))
            folder.mkdir()
            with Arena(declared=len(verdicts) % 2 == 1) as arena:
                run = Run(arena, folder, chance)
                verdicts.append(run.play(options.faults - done.total()))
                moves += arena.moves
            done += run.done
            seconds = time.monotonic() - began_at
            state = "sound" if verdicts[-1].sound else f"NOT SOUND {verdicts[-1]}"
            print(f"{seconds:5.0f} s, {done.total()} faults, {moves} moves, {state}", flush=True)
    faults = ", ".join(f"{count} {kind}" for kind, count in sorted(done.items()))
    lost, doubled, shared = (
        sum(len(getattr(verdict, field)) for verdict in verdicts)
        for field in ("lost", "doubled", "shared")
    )
    print(
        f"faults {done.total()} ({faults}) runs {len(verdicts)} moves {moves} lost {lost} "
        f"duplicated {doubled} in two partitions {shared}"
    )
    return 0 if all(verdict.sound for verdict in verdicts) else 1


if __name__ == "__main__":
    sys.exit(main())
