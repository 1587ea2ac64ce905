"""Disturb clients that share a partition until a given number of faults has been injected.

`python -m tests.chaos.sharing` starts three clients with different weights, each of which uses the
partition in several ways. Meanwhile, workers and clients are killed, workers are paused, and tasks
hang, block their workers or are canceled. After each run, the clients get a quiet phase in which
their shares are measured, and the scheduler must have forgotten all tasks at the end. The last line
of the output states what was lost or doubled, how much slot time a client owed the others because
its tasks had hung, how far the shares were off after that, and the longest time in which no task
ended although tasks waited. Runs with the same seed inject the same faults.
"""

from __future__ import annotations

import argparse
import logging
import multiprocessing
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, deque
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import dask
from distributed import Client
from distributed.diagnostics.plugin import SchedulerPlugin

import poolpart.shares
from poolpart import Pool
from poolpart.deploy import forked_workers, local_cluster

from .arena import WorkerProcesses
from .balancing import CONFIG, Silence, pause_for, send_signal
from .sharing_client import (
    CANCEL,
    END,
    FAULTS,
    FREEZE,
    HANG,
    ORDERS,
    PARTITION,
    QUIET,
    WORK_S,
    Verdict,
    judge,
    lines,
    set_phase,
    shares_of,
    spans_of,
)

KILL, PAUSE, CLIENT = "kill", "pause", "client"
KINDS = {KILL: 5, PAUSE: 3, CLIENT: 3, HANG: 3, FREEZE: 2, CANCEL: 4}
WEIGHTS = {"alice": 1.0, "bob": 1.0, "carol": 3.0}
WORKERS = 4
FAULTS_PER_RUN = 25
BETWEEN_S = 0.2, 1.5  # seconds between faults
PAUSED_S = 0.5, 3.0
SETTLES_WITHIN_S = 180.0
SETTLING_S = 3.0  # until tasks with the backlogs of all clients run
EVEN_S = 0.5  # difference of the accounts of clients whose tasks run in turn
MEASURED_S = 50 * WORK_S[1]
TOLERANCE = 0.1
WAITING = "waiting", "no-worker", "processing"  # states of tasks
LONGEST_STALL_S = 25.0  # four workers that hang one after the other, on a busy machine


class StallMonitor(SchedulerPlugin):
    """Scheduler plugin that records when tasks end, and which workers have left."""

    name = "stall-monitor"

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self.left: set[str] = set()
        self.longest_s = 0.0
        self.report = ""  # state during the longest stall
        self.faults: deque[str] = deque(maxlen=12)
        self._since = time.monotonic()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def transition(self, key: Any, start: str, finish: str, *_: Any, **__: Any) -> None:
        """Record that a task has ended."""
        if start == "processing" and finish in ("memory", "erred"):
            self._since = time.monotonic()

    def remove_worker(self, scheduler: Any, worker: str, **_: Any) -> None:
        """Record that a worker has left."""
        self.left.add(worker)

    def _watch(self) -> None:
        while not self._stop.wait(0.1):
            unfinished = [
                task for task in [*self.scheduler.tasks.values()] if task.state in WAITING
            ]
            if not unfinished:
                self._since = time.monotonic()
            seconds = time.monotonic() - self._since
            if seconds > self.longest_s + 0.5:
                self.report = self._state(unfinished)
            self.longest_s = max(self.longest_s, seconds)

    def _state(self, unfinished: list[Any]) -> str:
        now = time.time()
        workers = [
            f"{w.name} {w.status.name}, last heartbeat {now - w.last_seen:.1f} s ago, "
            f"{len(w.processing)} tasks, {len(w.executing)} running"
            for w in [*self.scheduler.workers.values()]
        ]
        states = Counter(
            f"{t.state} on {t.processing_on and t.processing_on.name}" for t in unfinished
        )
        return "; ".join([*workers, *(f"{n} {state}" for state, n in states.items()), *self.faults])

    def stop(self) -> None:
        """Stop looking for stalls."""
        self._stop.set()
        self._thread.join()


class Arena(WorkerProcesses):
    """Cluster of worker processes of one partition, with one slot each."""

    def __init__(self) -> None:
        self._stack = ExitStack()

    def __enter__(self) -> Arena:
        with ExitStack() as stack:
            stack.enter_context(dask.config.set(CONFIG))
            multiprocessing.set_forkserver_preload(["distributed", "poolpart"])
            stack.enter_context(forked_workers())
            self.cluster = stack.enter_context(local_cluster({PARTITION: (WORKERS, 1)}))
            self.client = stack.enter_context(Client(self.cluster, set_as_default=False))
            self.client.register_plugin(Silence())
            self.wait_until_whole()
            pool = Pool.from_client(self.client)
            for name, weight in WEIGHTS.items():
                pool.set_weight(name, weight)
            self.monitor = StallMonitor(self.cluster.scheduler)
            self.cluster.scheduler.add_plugin(self.monitor)
            stack.callback(self.monitor.stop)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def residue(self) -> list[str]:
        """Return what the scheduler has not forgotten although no client has tasks."""
        deadline = time.monotonic() + 20.0
        while found := self._residue():
            if time.monotonic() > deadline:
                return found
            time.sleep(0.2)
        return []

    def owed_s(self) -> float:
        """Return how much more of its share a client has used than another one, in seconds."""
        shares = self.cluster.scheduler.plugins[poolpart.shares.NAME]
        tags = [
            a.tag for queue in [*shares.queues.values()] for a in queue.policy.accounts.values()
        ]
        return max(tags) - min(tags)

    def _residue(self) -> list[str]:
        scheduler = self.cluster.scheduler
        found = [f"task {key}: {task.state}" for key, task in [*scheduler.tasks.items()]]
        shares = scheduler.plugins[poolpart.shares.NAME]
        for queue in [*shares.queues.values()]:
            counts = {name: len(getattr(queue, name)) for name in ("held", "assigned", "heaps")}
            counts["without room"] = queue.held_without_room
            found += [f"{count} {name}" for name, count in counts.items() if count]
            found += [f"{w.name}: {load}" for w, load in [*queue.loads.items()] if load.used]
            for name, account in [*queue.policy.accounts.items()]:
                if account.is_active or account.slots:
                    found.append(f"{name}: {account}")
        workers = [*scheduler.workers.values()]
        found += [f"{w.name} {w.status.name}" for w in workers if w not in scheduler.running]
        return found


class Run:
    """A phase with faults, and a quiet one in which the shares are measured."""

    def __init__(self, arena: Arena, folder: Path, chance: random.Random) -> None:
        self.arena = arena
        self.folder = folder
        self.done: Counter[str] = Counter()  # faults by kind
        self.off = 0.0  # greatest relative deviation of a share
        self.owed_s = 0.0  # slot time that a client owed the others after the faults
        self._chance = chance
        self._helpers: list[threading.Thread] = []

    def play(self, faults: int) -> Verdict:
        """Inject faults, measure the shares, and examine what is left."""
        set_phase(self.folder, FAULTS)
        self._clients = {name: self._start_client(name) for name in WEIGHTS}
        deadline = time.monotonic() + SETTLES_WITHIN_S
        while not all(map(self._last_line, WEIGHTS)) and time.monotonic() < deadline:
            time.sleep(0.1)
        while self.done.total() < faults:
            time.sleep(self._chance.uniform(*BETWEEN_S))
            for name in self.arena.deserted:
                self.arena.revive(name)
            self._strike(*self._chance.choices([*KINDS], KINDS.values()))
        problems = self._measure()
        set_phase(self.folder, END)
        for name, client in self._clients.items():
            try:
                client.wait(SETTLES_WITHIN_S)
            except subprocess.TimeoutExpired:
                problems.append(f"{name} did not end")
                client.kill()
                client.wait()
        problems += self.arena.residue()
        verdict = judge(self.folder, self.arena.monitor.left)
        verdict.other += problems
        return verdict

    def _measure(self) -> list[str]:
        """Measure the shares in a quiet phase, and return problems."""
        set_phase(self.folder, QUIET)
        for helper in self._helpers:
            helper.join()
        self.arena.wait_until_whole()
        deadline = time.monotonic() + SETTLES_WITHIN_S
        waiting = {*WEIGHTS}
        while waiting := {name for name in waiting if not self._is_quiet(name)}:
            if time.monotonic() > deadline:
                return [f"{name} did not settle: {self._last_line(name)}" for name in waiting]
            time.sleep(0.1)
        time.sleep(SETTLING_S)
        owed_until = time.monotonic() + SETTLES_WITHIN_S
        while (owed_s := self.arena.owed_s()) > EVEN_S:
            self.owed_s = max(self.owed_s, owed_s)
            if time.monotonic() > owed_until:
                return [f"a client still owes {owed_s:.1f} s"]
            time.sleep(0.1)
        start = time.monotonic()
        time.sleep(MEASURED_S)
        end = time.monotonic()
        time.sleep(2 * WORK_S[1])
        shares = shares_of(spans_of(self.folder), start, end)
        fair = {name: weight / sum(WEIGHTS.values()) for name, weight in WEIGHTS.items()}
        self.off = max(abs(shares.get(name, 0.0) / fair[name] - 1) for name in fair)
        return [f"shares {shares}"] if self.off > TOLERANCE else []

    def _is_quiet(self, name: str) -> bool:
        return self._last_line(name).startswith("quiet")

    def _last_line(self, name: str) -> str:
        words = lines(self.folder / f"results-{name}.txt")
        return " ".join(words[-1]) if words else ""

    def _start_client(self, name: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "tests.chaos.sharing_client"]
        seed = str(self._chance.randrange(10**6))
        arguments = [self.arena.cluster.scheduler_address, str(self.folder), name, seed]
        return subprocess.Popen([*command, *arguments], stderr=subprocess.DEVNULL)

    def _strike(self, kind: str) -> None:
        """Inject a fault, unless no worker is in the required state."""
        pick = self._chance.random()
        seconds = self._chance.uniform(*PAUSED_S)
        client = self._chance.choice([*WEIGHTS])
        arena = self.arena
        if kind in ORDERS:
            (self.folder / f"order-{client}-{self.done.total():04}-{kind}").touch()
        elif kind == CLIENT:
            self._clients[client].kill()
            self._clients[client].wait()
            self._clients[client] = self._start_client(client)
        else:
            running = [name for name in arena.names("") if arena.address(name) and arena.pid(name)]
            if not running:
                return
            name = running[int(pick * len(running))]
            if kind == KILL:
                send_signal(arena.pid(name), signal.SIGKILL)
            else:
                arguments = arena.client, arena.address(name), seconds
                helper = threading.Thread(target=pause_for, args=arguments, daemon=True)
                self._helpers.append(helper)
                helper.start()
        self.done[kind] += 1
        arena.monitor.faults.append(f"{kind} {time.monotonic():.1f}")


def main(arguments: list[str] | None = None) -> int:
    """Disturb the clients and return 0 if all runs were sound."""
    parser = argparse.ArgumentParser(prog="tests.chaos.sharing", description=__doc__)
    parser.add_argument("--faults", type=int, default=200)
    parser.add_argument("--seed", type=int, default=None, help="random by default")
    options = parser.parse_args(arguments)
    seed = random.SystemRandom().randrange(10**6) if options.seed is None else options.seed
    print(f"seed {seed}", flush=True)
    logging.disable(logging.CRITICAL)  # that workers die here is no news
    chance = random.Random(seed)
    done: Counter[str] = Counter()
    verdicts: list[Verdict] = []
    off = owed_s = 0.0
    began_at = time.monotonic()
    with (
        tempfile.TemporaryDirectory(prefix="chaos-", ignore_cleanup_errors=True) as name,
        Arena() as arena,
    ):
        monitor = arena.monitor
        while done.total() < options.faults:
            folder = Path(name) / str(len(verdicts))
            folder.mkdir()
            run = Run(arena, folder, chance)
            verdict = run.play(min(FAULTS_PER_RUN, options.faults - done.total()))
            verdicts.append(verdict)
            done += run.done
            off = max(off, run.off)
            owed_s = max(owed_s, run.owed_s)
            seconds = time.monotonic() - began_at
            state = "sound" if verdict.sound else f"NOT SOUND {verdict}"
            print(
                f"{seconds:5.0f} s, {done.total()} faults, {verdict.rounds} rounds, owed "
                f"{run.owed_s:.1f} s, shares off by {run.off:.0%}, longest stall "
                f"{monitor.longest_s:.1f} s, {state}",
                flush=True,
            )
        stall_s = monitor.longest_s
        if stall_s > LONGEST_STALL_S:
            print(f"longest stall: {monitor.report}")
    faults = ", ".join(f"{count} {kind}" for kind, count in sorted(done.items()))
    lost, doubled, repeated, wrong = (
        sum(len(getattr(verdict, field)) for verdict in verdicts)
        for field in ("lost", "doubled", "repeated", "wrong")
    )
    items = sum(verdict.items for verdict in verdicts)
    print(
        f"faults {done.total()} ({faults}) items {items} lost {lost} duplicated {doubled} repeated "
        f"{repeated} wrong {wrong} owed {owed_s:.1f} s shares off by {off:.0%} longest stall "
        f"{stall_s:.1f} s"
    )
    sound = all(verdict.sound for verdict in verdicts) and stall_s <= LONGEST_STALL_S
    return 0 if sound else 1


if __name__ == "__main__":
    sys.exit(main())
