"""Disturb campaigns until a given number of faults has been injected.

`python -m tests.chaos.campaign` kills workers of an external cluster, and the driver, which is then
resumed. Files of jobs are deleted or cut in half before the driver resumes and after a data set is
finished. The last line of the output states whether a job was lost or duplicated, and whether all
files of jobs are identical to those of an undisturbed run.
"""

from __future__ import annotations

import argparse
import csv
import os
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from tests.system.conftest import OutsideCluster

BASE = """
sensor: {rays_per_revolution: 720, layers: 8, step_deg: 2}
poses: [[0, 0, 1], [2, 0, 2]]
steps: 180
scene: seed
"""
CAMPAIGN = """
base: base.yaml
count: 40
seed: 3
vary:
  noise.range_m: {uniform: [0.001, 0.05]}
  sensor.layers: {choice: [2, 4, 8]}
keep: folder
"""
WORKERS = {"GPU": 1, "LIDAR": 5}  # slots of each of two
SHARED = ("jobs.csv", "dataset.json", "campaign.json")
DRIVER = "driver"
HARMED = 0.5  # of the times that the driver is killed
HARMS = 4  # runs of a finished data set, each after a file was harmed
LINK = "link"  # is put before the driver that follows a killed one
LINKS = ("run", "run/parts", "jobs", ".jobs")
BETWEEN_S = 0.3, 4.0  # seconds between faults
ENDS_WITHIN_S = 300.0


@dataclass
class Tally:
    """Faults injected so far, and defects found in the data sets."""

    done: Counter[str] = field(default_factory=Counter)  # {what was killed or harmed: how often}
    datasets: int = 0
    lost: int = 0  # jobs
    doubled: int = 0
    differing: list[str] = field(default_factory=list)  # files
    errors: list[str] = field(default_factory=list)  # drivers that ended by themselves

    def __str__(self) -> str:
        faults = ", ".join(f"{count} {kind}" for kind, count in sorted(self.done.items()))
        identical = "no" if self.differing else "yes"
        return (
            f"faults {self.done.total()} ({faults}) data sets {self.datasets} lost {self.lost} "
            f"duplicated {self.doubled} identical {identical} errors {len(self.errors)}"
        )

    @property
    def sound(self) -> bool:
        """Whether all data sets are equal to the undisturbed one."""
        return not (self.lost or self.doubled or self.differing or self.errors)


class Arena:
    """Cluster with two workers of each kind in separate processes, and a driver."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder = folder
        self._chance = random.Random(seed)
        (folder / "base.yaml").write_text(BASE)
        (folder / "c.yaml").write_text(CAMPAIGN)
        (folder / "cluster").mkdir()
        self.cluster = OutsideCluster(folder / "cluster")
        self._workers = [self._worker(kind) for kind in (*WORKERS, *WORKERS)]
        self.cluster.wait()

    def _worker(self, kind: str) -> str:
        return self.cluster.add((kind, WORKERS[kind]))

    def start(self, out: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [
                *(sys.executable, "-m", "lidarpool", "run", "c.yaml", "--resume", "-q"),
                *("--out", out, "--scheduler", self.cluster.address, "--backend", "numpy"),
            ],
            cwd=self.folder,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )

    def _harm(self, dataset: Path) -> list[str]:
        """Delete a file of the data set, cut it in half, or flip a bit in it.

        Return what was done.
        """
        kinds = ("jobs/*/[cs]*", ".jobs/*.json", "run/run.db", *SHARED)
        found = sorted(path for kind in kinds for path in dataset.glob(kind))
        if not found:
            return []
        path = self._chance.choice(found)
        of_points = path.relative_to(dataset).parts[0] == "jobs"  # compared by --verify alone
        harm = self._chance.choice(
            ("deleted", "cut") if of_points else ("deleted", "cut", "flipped")
        )
        if harm == "deleted" and path.name != "campaign.json":  # whose data set it is
            path.unlink()
            return [harm]
        data = bytearray(path.read_bytes())
        if harm == "flipped":
            data[self._chance.randrange(len(data))] ^= 1 << self._chance.randrange(8)
        else:
            del data[len(data) // 2 :]
            harm = "cut"
        path.unlink()
        path.write_bytes(data)
        return [harm]

    def disturb(self, out: str, tally: Tally, faults: int) -> None:
        """Create a data set while injecting at most `faults` faults."""
        driver = self.start(out)
        harms = HARMS if faults else 0  # of the finished data set
        while driver.poll() is None and faults:
            time.sleep(self._chance.uniform(*BETWEEN_S))
            kind = self._chance.choice((*WORKERS, DRIVER, LINK))
            if driver.poll() is not None:
                break
            faults -= 1
            tally.done[kind] += 1
            if kind in WORKERS:
                name = self._chance.choice([n for n in self._workers if n.startswith(kind)])
                self._workers.remove(name)
                self.cluster.kill(name)
                self._workers.append(self._worker(kind))
                continue
            driver.kill()
            driver.communicate()
            if self._chance.random() < HARMED:
                tally.done.update(self._harm(self.folder / out))
            if kind == LINK and (self.folder / out / "run" / "run.db").exists():
                self._lead_away(out, tally)
            driver = self.start(out)
        while True:
            _, err = driver.communicate(timeout=ENDS_WITHIN_S)
            if driver.returncode == 0 and not harms:
                return
            if driver.returncode == 0:
                harms -= 1
                tally.done.update(self._harm(self.folder / out))
            else:
                tally.errors.append(err)
                print(f"a driver ended: {err.strip()}", flush=True)
            if len(tally.errors) > 10:
                return
            driver = self.start(out)

    def _lead_away(self, out: str, tally: Tally) -> None:
        """Check that a driver rejects a link to a foreign folder and does not change the folder."""
        link = self.folder / out / self._chance.choice(LINKS)
        stranger = self.folder / "stranger"
        aside = self.folder / "aside"
        stranger.mkdir(exist_ok=True)
        (stranger / "thesis.txt").write_text("mine")
        link.parent.mkdir(exist_ok=True)
        if link.exists():
            link.rename(aside)
        link.symlink_to(stranger)
        driver = self.start(out)
        _, err = driver.communicate(timeout=ENDS_WITHIN_S)
        if driver.returncode != 2 or f"{link} is a symbolic link" not in err:
            tally.errors.append(f"with {link} as a link: {err}")
        if [path.name for path in stranger.iterdir()] != ["thesis.txt"]:
            tally.differing.append(f"files behind {link}")
        link.unlink()
        if aside.exists():
            aside.rename(link)


def files_of(dataset: Path) -> dict[str, bytes]:
    """Return the content of all files that belong to a data set's jobs, keyed by path."""
    found = [path for folder in ("jobs", ".jobs") for path in (dataset / folder).rglob("*")]
    return {str(p.relative_to(dataset)): p.read_bytes() for p in found if p.is_file()}


def judge(dataset: Path, reference: dict[str, bytes], tally: Tally) -> None:
    """Compare a data set with the undisturbed one."""
    rows: Counter[str] = Counter()
    with suppress(FileNotFoundError), (dataset / "jobs.csv").open(newline="") as file:
        rows.update(row["number"] for row in csv.DictReader(file))
    count = sum(1 for name in reference if name.startswith(".jobs/"))
    tally.datasets += 1
    tally.lost += count - len(rows)
    tally.doubled += sum(times - 1 for times in rows.values())
    found = files_of(dataset)
    tally.differing += [
        name for name in {*found, *reference} if found.get(name) != reference.get(name)
    ]
    left = [*(dataset / "run").rglob("*"), *dataset.glob("run"), *dataset.glob(".lidarpool-*")]
    tally.differing += [str(path.relative_to(dataset)) for path in left]


def main(arguments: list[str] | None = None) -> int:
    """Disturb campaigns and return 0 if all data sets are sound."""
    parser = argparse.ArgumentParser(prog="tests.chaos.campaign", description=__doc__)
    parser.add_argument("--faults", type=int, default=60)
    parser.add_argument("--seed", type=int, default=None, help="random by default")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin none later")
    options = parser.parse_args(arguments)
    seed = random.SystemRandom().randrange(10**6) if options.seed is None else options.seed
    print(f"seed {seed}", flush=True)
    tally = Tally()
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="chaos-", ignore_cleanup_errors=True) as folder:
        arena = Arena(Path(folder), seed)
        try:
            arena.disturb("reference", tally, 0)
            reference = files_of(Path(folder, "reference"))
            while (left := options.faults - tally.done.total()) > 0:
                if time.monotonic() - started > options.seconds:
                    break
                out = f"ds-{tally.datasets}"
                arena.disturb(out, tally, left)
                judge(Path(folder, out), reference, tally)
                print(f"{time.monotonic() - started:5.0f} s: {tally}", flush=True)
        finally:
            arena.cluster.close()
    if tally.differing:
        print("differ:", ", ".join(sorted({*tally.differing})[:20]))
    print(tally)
    return 0 if tally.sound else 1


if __name__ == "__main__":
    sys.exit(main())
