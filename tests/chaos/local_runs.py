"""Kill commands that start their own cluster, until a given number of faults has been injected.

`python -m tests.chaos.local_runs` compares three cases with undisturbed runs:

- a survey;
- a campaign of 200 jobs;
- the shards of a survey and their merge, compared with the run that was not divided.

A fault kills the driver (with its scheduler), a worker, or all processes of a command at once. A
command whose driver was killed is repeated with `--resume`, as a user would do. The last line of
the output states whether all files are identical to those of the undisturbed run.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil

SURVEY = """
sensor: {rays_per_revolution: 720, layers: 8, step_deg: 2}
poses: [[0, 0, 1], [2, 0, 2], [4, 0, 2], [6, 1, 2], [4, 2, 2], [2, 2, 2]]
steps: 180
scene: seed
planning: {start: [25, 25], target: [-30, -20], trials: 3, iterations: 20}
output: {write: [las]}
"""
JOB = """
sensor: {rays_per_revolution: 90, layers: 4, step_deg: 4}
poses: [[0, 0, 1]]
steps: 9
scene: seed
"""
CAMPAIGN = """
base: job.yaml
count: 200
seed: 3
vary:
  noise.range_m: {uniform: [0.001, 0.05]}
  sensor.layers: {choice: [2, 4]}
keep: folder
"""
SHARDS = 3
DRIVER, WORKER, ALL = KINDS = "driver", "worker", "all at once"
SHARES = 1, 3, 1  # of the kinds; without workers, the driver is killed in place of a worker
FAULTS_PER_COMMAND = 4
STARTING = 0.3  # part of the faults at any moment of a start, in place of while workers work
START_S = 6.0  # the first seconds of a command
WORK_S = 4.0  # the first seconds of its workers
LOOK_EVERY_S = 0.1
# A nanny gives up if its first worker dies before the nanny has heard that the worker is up.
WORKER_IS_UP_S = 1.0
ENDS_WITHIN_S = 600.0
# Times, which no two runs share.
OF_ONE_RUN = {"report.json", "report.html", "report.csv"}


@dataclass
class Tally:
    """Faults injected so far, and defects found in the results."""

    done: Counter[str] = field(default_factory=Counter)  # {what was killed: how often}
    results: int = 0
    differing: list[str] = field(default_factory=list)  # files
    errors: list[str] = field(default_factory=list)  # commands that ended by themselves

    def __str__(self) -> str:
        faults = ", ".join(f"{count} {kind}" for kind, count in sorted(self.done.items()))
        identical = "no" if self.differing else "yes"
        return (
            f"faults {self.done.total()} ({faults}) results {self.results} identical {identical} "
            f"errors {len(self.errors)}"
        )

    @property
    def sound(self) -> bool:
        """Whether all results are equal to the undisturbed ones."""
        return not (self.differing or self.errors)


def commands_of(case: str, out: str) -> list[list[str]]:
    """Return the commands of a case.

    The last one writes to `out`.
    """
    options = ["--resume", "-q", "--backend", "numpy"]
    if case == "survey":
        return [["run", "survey.yaml", "--out", out, *options]]
    if case == "campaign":
        return [["run", "campaign.yaml", "--out", out, *options]]
    parts = [f"{out}-part-{number}" for number in range(1, SHARDS + 1)]
    shards = [
        ["run", "survey.yaml", "--shard", f"{number}/{SHARDS}", "--out", part, *options]
        for number, part in enumerate(parts, 1)
    ]
    return [*shards, ["merge", *parts, "--out", out, "-q"]]


REFERENCES = {"survey": "survey", "campaign": "campaign", "shards": "survey"}


class Arena:
    """Folder with scenarios in which commands are run and killed."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder = folder
        self._chance = random.Random(seed)
        for name, text in (("survey", SURVEY), ("job", JOB), ("campaign", CAMPAIGN)):
            (folder / f"{name}.yaml").write_text(text)

    def play(self, case: str, out: str, tally: Tally, faults: int) -> None:
        """Run the commands of a case while injecting at most `faults` faults."""
        for command in commands_of(case, out):
            allowed = min(FAULTS_PER_COMMAND, faults)
            faults -= self._disturb(command, tally, allowed)

    def _disturb(self, command: Sequence[str], tally: Tally, faults: int) -> int:
        """Repeat a command until it succeeds, and return the number of injected faults."""
        done = 0
        driver = self._start(command)
        while done < faults and self._has_come_to_a_moment(driver, has_workers=command[0] == "run"):
            kind = self._kill(driver)
            done += 1
            tally.done[kind] += 1
            if kind != WORKER:
                driver.communicate()
                driver = self._start(command)
        try:
            _, err = driver.communicate(timeout=ENDS_WITHIN_S)
        except subprocess.TimeoutExpired:
            self._kill_all(driver)
            err = f"did not end in {ENDS_WITHIN_S:g} s"
        if driver.returncode:
            tally.errors.append(f"{' '.join(command)}: {err.strip()}")
            print(f"a command ended: {tally.errors[-1]}", flush=True)
        return done

    def _has_come_to_a_moment(self, driver: subprocess.Popen[str], has_workers: bool) -> bool:
        """Wait until it is time for a fault.

        Return False if the command has ended before.
        """
        starting = self._chance.random() < STARTING or not has_workers
        while not starting and driver.poll() is None and not workers_of(driver.pid):
            time.sleep(LOOK_EVERY_S)
        with suppress(subprocess.TimeoutExpired):
            driver.wait(self._chance.uniform(0, START_S if starting else WORK_S))
            return False
        return True

    def _start(self, command: Sequence[str]) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-m", "lidarpool", *command],
            cwd=self.folder,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def _kill(self, driver: subprocess.Popen[str]) -> str:
        """Kill the driver, a worker or all processes, and return which of these."""
        [kind] = self._chance.choices(KINDS, SHARES)
        workers = workers_of(driver.pid)
        number = self._chance.random()
        if kind == ALL:
            self._kill_all(driver)
        elif kind == WORKER and workers:
            with suppress(psutil.NoSuchProcess):
                workers[int(number * len(workers))].kill()
        else:
            kind = DRIVER
            driver.kill()
        return kind

    @staticmethod
    def _kill_all(driver: subprocess.Popen[str]) -> None:
        with suppress(ProcessLookupError):
            os.killpg(driver.pid, signal.SIGKILL)


def workers_of(pid: int) -> list[psutil.Process]:
    """Return the worker processes of a driver that have been running for a while.

    The driver starts its workers with a fork server.
    """
    with suppress(psutil.NoSuchProcess):
        servers = psutil.Process(pid).children()
        workers = [worker for server in servers for worker in server.children()]
        started_before = time.time() - WORKER_IS_UP_S
        return sorted(
            (worker for worker in workers if worker.create_time() < started_before),
            key=lambda worker: worker.pid,
        )
    return []


def files_of(folder: Path) -> dict[str, bytes]:
    """Return the content of a result's files, keyed by path, without files that contain times."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.name not in OF_ONE_RUN
    }


def judge(folder: Path, reference: dict[str, bytes], tally: Tally) -> None:
    """Compare the files of a result with those of an undisturbed run."""
    files = files_of(folder)
    tally.results += 1
    tally.differing += [
        f"{folder.name}/{name}"
        for name in sorted({*files, *reference})
        if files.get(name) != reference.get(name)
    ]


def main(arguments: list[str] | None = None) -> int:
    """Disturb commands and return 0 if all results are sound."""
    parser = argparse.ArgumentParser(prog="tests.chaos.local_runs", description=__doc__)
    parser.add_argument("--faults", type=int, default=30)
    parser.add_argument("--seed", type=int, default=None, help="random by default")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin none later")
    parser.add_argument("--cases", nargs="+", choices=[*REFERENCES], default=[*REFERENCES])
    options = parser.parse_args(arguments)
    seed = random.SystemRandom().randrange(10**6) if options.seed is None else options.seed
    print(f"seed {seed}", flush=True)
    tally = Tally()
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="chaos-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        arena = Arena(folder, seed)
        references: dict[str, dict[str, bytes]] = {}
        while tally.done.total() < options.faults and not tally.errors[10:]:
            if tally.results and time.monotonic() - started > options.seconds:
                break
            case = options.cases[tally.results % len(options.cases)]
            reference = REFERENCES[case]
            if reference not in references:
                arena.play(reference, reference, tally, 0)
                references[reference] = files_of(folder / reference)
            out = f"{case}-{tally.results}"
            arena.play(case, out, tally, options.faults - tally.done.total())
            judge(folder / out, references[reference], tally)
            print(f"{time.monotonic() - started:5.0f} s, {case}: {tally}", flush=True)
    if tally.differing:
        print("differ:", ", ".join(tally.differing[:20]))
    print(tally)
    return 0 if tally.sound else 1


if __name__ == "__main__":
    sys.exit(main())
