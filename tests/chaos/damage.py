"""Damage files of results and runs, and then read them: `python -m tests.chaos.damage`.

A bit of a file is flipped, the file is truncated, or a huge value is inserted, one damage at a
time. The files are those of a result, a data set, its shards, a stored run, and `inputs`:
recordings (.mcap, .pcap), OSI traces, HELIOS++ surveys and compiled loops. All readers of the file
must then return the same as before, or fail with an error message of one or two lines. Runs with
the same seed cause the same damages.
"""

from __future__ import annotations

import argparse
import hashlib
import logging
import random
import re
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from io import StringIO
from itertools import chain, zip_longest
from pathlib import Path

import numpy as np
from distributed import Client
from tests.chaos.inputs import write_inputs
from tests.chaos.target import Reader, Target
from tests.clusters import thread_cluster

import lidarpool
from lidarpool import Campaign, LidarError
from lidarpool.cli.commands import cli
from lidarpool.report.campaign_output import verify_dataset
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarsim.io.storage import Storage

BASE = """
sensor: {rays_per_revolution: 90, layers: 4, step_deg: 4}
poses: [[0, 0, 1]]
steps: 25
actors: [{name: Car, box: [4, 2, 1.5], at: {position: [6, 0, 0]}}]
scene: seed
pool: {backend: numpy, gpu: 1}
"""
CAMPAIGN = """
base: base.yaml
count: 4
seed: 3
vary: {noise.range_m: {uniform: [0.001, 0.05]}}
keep: folder
splits: {train: 0.5, val: 0.5}
"""
SLOTS = ({"GPU": 1}, {"LIDAR": 5}, {"OTHER": 1})
CUTS = 0.25  # share of the damages that cut a file
GROWTHS = 0.25  # share of the damages that make a part of a file large
# What takes the place of some bytes: numbers and lengths of binary files and of text, and depths.
LARGE = (
    *(number.to_bytes(4, "little") for number in (2**31 - 1, 2**32 - 1)),
    *(number.to_bytes(8, "little") for number in (2**63 - 1, 2**64 - 1)),
    b"1" * 200_000, b"9" * 5_000, b"1e308", b"[" * 100_000, b"<a>" * 100_000, b"a" * 2_000_000,
    b"nan", b"-1",
)  # fmt: skip
LINES_MOST = 3  # of an error, with its advice
SLOWEST_S = 60.0  # for a reader


@dataclass
class Outcome:
    """Results of reading damaged files."""

    ends: Counter[str] = field(default_factory=Counter)  # {"right", "refused", …: how often}
    faults: list[str] = field(default_factory=list)  # what should not have happened

    def __str__(self) -> str:
        ends = ", ".join(f"{count} {name}" for name, count in sorted(self.ends.items()))
        return f"damages {self.ends.total()} ({ends}) faults {len(self.faults)}"


def digest_of(*arrays: object) -> str:
    digest = hashlib.sha256()
    for values in arrays:
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


# -- readers ---------------------------------------------------------------------------------------


def read_sweeps(place: Path) -> str:
    """Read all sweeps of a data set, and return a description and a checksum."""
    saved = lidarpool.sweeps(place)
    words = [f"{one.job} {one.split} {dict(one.values)}" for one in saved]
    return f"{words} {digest_of(*(one.points for one in saved))}"


def read_verified(place: Path) -> str:
    """Verify all files of a data set against their stored checksums."""
    return verify_dataset(Storage.at(place))


def merged(shards: Path) -> str:
    """Merge the shards of a campaign or survey.

    Return everything except times and notes.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "out")
        lidarpool.merge([shards / "part-1", shards / "part-2"], out)
        if not (out / "dataset.json").exists():
            return digest_of(np.fromfile(out / "cloud.ply", np.uint8))
        return read_sweeps(out) + read_verified(out).replace(str(out), "")


class Resumed:
    """Readers that resume a data set or a run on a cluster of threads."""

    def __init__(self, client: Client, source: Path) -> None:
        self._client = client
        self._source = source

    def campaign(self, place: Path) -> str:
        campaign = Campaign.load(self._source / "c.yaml")
        campaign.run(place, client=self._client, verify=True)
        return read_sweeps(place) + read_verified(place)

    def survey(self, place: Path) -> str:
        job = prepare(Scenario.load(self._source / "base.yaml")).job
        result = lidarpool.simulate(
            job.scene, job.survey, client=self._client, backend="numpy", folder=place / "run",
            resume=True, batch_mb=1,
        )  # fmt: skip
        return digest_of(result.cloud.positions)


def shown(place: Path) -> str:
    """Answer all requests of a result's page."""
    from lidarview.viewer.result_views import open_result

    view = open_result(place)
    header, _ = view.answer("state", {}, lambda: False)
    for column in view.columns:
        view.answer("points", {"color": column, "most": "1000"}, lambda: False)
        view.answer("column", {"name": column}, lambda: False)
    if view.pictured is not None:
        view.answer("surface", {"color": "object"}, lambda: False)
    if view.sweeps is not None and len(view.sweeps):
        view.answer("range", {"sweep": "0"}, lambda: False)
    view.answer("point", {"row": "0"}, lambda: False) if header["points"] else None
    return ""  # a cloud has no checksum


def commanded(*arguments: str) -> Reader:
    """Return a reader that runs a command on a result.

    In the arguments, `{out}` stands for an output folder.
    """

    def read(place: Path) -> str:
        with tempfile.TemporaryDirectory() as out:
            texts = [one.format(place=place, out=out) for one in arguments]
            cli.main(texts, standalone_mode=False)
        return ""

    return read


RESULT_READERS = {
    "view": shown,
    "compare": commanded("compare", "{place}", "{place}/../whole", "--out", "{out}"),
    "export": commanded("export", "{place}", "-f", "las", "-f", "kitti", "--out", "{out}"),
    "plot": commanded("plot", "{place}", "--out", "{out}"),
}


# -- damage ----------------------------------------------------------------------------------------


def damaged(data: bytes, chance: random.Random) -> bytes:
    """Flip a bit in a file's content, truncate it, or insert a large value."""
    at = chance.randrange(len(data))
    kind = chance.random()
    if kind < CUTS:
        return data[:at]
    if kind < CUTS + GROWTHS:
        large = chance.choice(LARGE)
        return data[:at] + large + data[at + min(len(large), 8) :]
    return data[:at] + bytes([data[at] ^ 1 << chance.randrange(8)]) + data[at + 1 :]


def files_of(folder: Path) -> list[Path]:
    """Return relative paths of files in a folder.

    Of files whose names differ only in numbers, one is returned.
    """
    kinds: dict[str, Path] = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.stat().st_size:
            file = path.relative_to(folder)
            kinds.setdefault(re.sub(r"[0-9a-f]*\d[0-9a-f]*", "0", str(file)), file)
    return [*kinds.values()]


def attempt(reader: Reader, place: Path) -> tuple[str, str]:
    """Read a damaged folder, and return how this ended and what was read or printed."""
    started = time.monotonic()
    try:
        with redirect_stdout(StringIO()), redirect_stderr(StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            read = reader(place)
    except LidarError as error:
        lines = str(error).count("\n") + 1
        return ("refused" if lines <= LINES_MOST else "many lines"), str(error)
    except Exception:
        return "traceback", traceback.format_exc()
    return ("read" if time.monotonic() - started < SLOWEST_S else "slow"), read


@contextmanager
def copied(whole: Path) -> Iterator[Path]:
    """Yield a copy of the folder `whole` that can be damaged."""
    copy = whole.with_name("damaged")
    shutil.copytree(whole, copy)
    try:
        yield copy
    finally:
        shutil.rmtree(copy)


def attack(
    whole: Path, reader: Reader, file: Path, count: int, chance: random.Random, outcome: Outcome,
    name: str,
) -> None:  # fmt: skip
    """Damage a file `count` times, and read the folder after each damage."""
    data = (whole / file).read_bytes()
    with copied(whole) as copy:
        _, expected = attempt(reader, copy)
    for _ in range(count):
        content = damaged(data, chance)
        with copied(whole) as copy:
            path = copy / file
            path.unlink()
            path.write_bytes(content)
            end, words = attempt(reader, copy)
        if end == "read":
            end = "right" if words == expected else "wrong"
        outcome.ends[end] += 1
        if end not in ("right", "refused"):
            outcome.faults.append(f"{name} of {file}: {end}\n{words}")


def targets(folder: Path, client: Client) -> list[Target]:
    """Create a result, a data set, shards of both, a stored run, and input files."""
    (folder / "base.yaml").write_text(BASE)
    (folder / "c.yaml").write_text(CAMPAIGN)
    wholes = {name: folder / name / "whole" for name in ("result", "set", "shards", "runs", "run")}
    for whole in wholes.values():
        whole.mkdir(parents=True)
    scheduler = ("--scheduler", client.scheduler.address, "-q")
    run = ["run", str(folder / "base.yaml"), *scheduler]
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        cli.main([*run, "--out", str(wholes["result"])], standalone_mode=False)
        for number in (1, 2):
            out = wholes["runs"] / f"part-{number}"
            shard = f"{number}/2"
            cli.main([*run, "--out", str(out), "--shard", shard], standalone_mode=False)
    campaign = Campaign.load(folder / "c.yaml")
    campaign.run(wholes["set"], client=client, overwrite=True)
    for number in (1, 2):
        campaign.run(wholes["shards"] / f"part-{number}", client=client, shard=(number, 2))
    job = prepare(Scenario.load(folder / "base.yaml")).job
    lidarpool.simulate(
        job.scene, job.survey, client=client, backend="numpy", folder=wholes["run"] / "run",
        batch_mb=1,
    )  # fmt: skip
    resumed = Resumed(client, folder)

    def is_kept(file: Path) -> bool:
        return file.suffix in (".json", ".csv", ".npz", ".ply") and file.name != "report.json"

    return [
        Target(wholes["shards"], {"merge": merged}, is_kept),
        Target(wholes["runs"], {"merge of runs": merged}),
        Target(wholes["set"], {"sweeps": read_sweeps}, lambda f: is_kept(f) and f.suffix != ".ply"),
        Target(wholes["set"], {"resume": resumed.campaign}, is_kept),
        Target(wholes["run"], {"resume of a run": resumed.survey}, lambda f: f.suffix == ".db"),
        Target(wholes["run"], {"resume of a run": resumed.survey}, lambda f: f.suffix != ".db"),
        Target(wholes["result"], RESULT_READERS),
        *write_inputs(folder, client),
    ]


def fuzz(count: int, seed: int, seconds: float = float("inf"), tell: bool = False) -> Outcome:
    """Damage each file `count` times in random order, or until the time is up."""
    chance = random.Random(seed)
    outcome = Outcome()
    with (
        tempfile.TemporaryDirectory(prefix="damage-") as folder,
        thread_cluster(*SLOTS) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        rounds_of_targets = []
        for target in targets(Path(folder), client):
            rounds = [
                (target, name, reader, file)
                for name, reader in target.readers.items()
                for file in files_of(target.whole)
                if target.chosen(file)
            ]
            chance.shuffle(rounds)
            rounds_of_targets.append(rounds)
        chance.shuffle(rounds_of_targets)
        # In turn, so that a short time reaches a file of each target.
        turns = chain.from_iterable(zip_longest(*rounds_of_targets))
        started = time.monotonic()
        for target, name, reader, file in filter(None, turns):
            if time.monotonic() - started > seconds:
                break
            before = len(outcome.faults)
            attack(target.whole, reader, file, count, chance, outcome, name)
            if tell:
                print(
                    f"{time.monotonic() - started:5.0f} s: {name} of {file}: {outcome}", flush=True
                )
                print("\n".join(outcome.faults[before:]), end="", flush=True)
    return outcome


def main(arguments: list[str] | None = None) -> int:
    """Damage files and return 0 if every reader succeeded or failed with a short error."""
    parser = argparse.ArgumentParser(prog="tests.chaos.damage", description=__doc__)
    parser.add_argument("--count", type=int, default=200, help="damages of each file and reader")
    parser.add_argument("--seed", type=int, default=None, help="random by default")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin none later")
    options = parser.parse_args(arguments)
    logging.disable(logging.CRITICAL)
    seed = random.SystemRandom().randrange(10**6) if options.seed is None else options.seed
    print(f"seed {seed}", flush=True)
    outcome = fuzz(options.count, seed, options.seconds, tell=True)
    print(outcome)
    return 1 if outcome.faults else 0


if __name__ == "__main__":
    sys.exit(main())
