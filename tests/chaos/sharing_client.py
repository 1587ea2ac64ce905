"""Client of a shared partition that `tests.chaos.sharing` disturbs, and what it leaves behind.

A client works in rounds, each of which uses the partition in another way. It records each result in
a file, and each task records when and where it has run. If the client is killed, the next one with
the same name begins with the next round, and the round in between is not examined.
"""

from __future__ import annotations

import os
import random
import signal
import sys
import time
import traceback
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from zlib import crc32

from distributed import CancelledError, Client, Future, get_client, get_worker

from poolpart import Partition, TaskTimeoutError

from .pipeline import append

PARTITION = "CPU"
HANG, FREEZE, CANCEL = ORDERS = (
    "hang",  # a task that exceeds its time limit
    "freeze",  # the same, and its process does not respond
    "cancel",  # tasks that are canceled while some of them run
)
FAULTS, QUIET, END = "faults", "quiet", "end"  # phases
WORK_S = 0.02, 0.2  # running times of tasks
LIMIT_S = 2.0  # for hanging tasks
ENDLESS_S = 30.0
BACKLOG = 100  # tasks of a client that wait at least in the quiet phase
TIMED_OUT = "timed out"


# -- tasks -----------------------------------------------------------------------------------


def seconds_of(item: str) -> float:
    """Return the running time of an item."""
    shortest, longest = WORK_S
    return shortest + (longest - shortest) * (crc32(item.encode()) % 1000 / 1000)


def value_of(item: str) -> int:
    """Return the result of an item."""
    return crc32(item[::-1].encode())


def work(item: str, folder: Path, orders: Collection[str] = (), path: Path | None = None) -> int:
    """Process an item, and record where and when. `orders` may require that it does not end."""
    since = time.monotonic()
    if HANG in orders:
        time.sleep(3600)
    if FREEZE in orders:
        os.kill(os.getpid(), signal.SIGSTOP)
    time.sleep(ENDLESS_S if CANCEL in orders else seconds_of(item))
    address = get_worker().address
    append(folder / f"runs-{os.getpid()}.txt", f"{item} {since} {time.monotonic()} {address}")
    if path is not None:
        append(path, f"result {item} {value_of(item)}")
    return value_of(item)


def children(item: str) -> list[str]:
    """Return the items of the nested tasks of an item."""
    return [f"{item}.{number}" for number in range(3)]


def nested(item: str, folder: Path) -> int:
    """Process the children of an item in nested tasks, and wait for them."""
    client = get_client()
    futures = [client.submit(work, child, folder, pure=False) for child in children(item)]
    return sum(client.gather(futures))


# -- client ----------------------------------------------------------------------------------


class RoundClient:
    """Client that works in rounds until the phase is `END`."""

    def __init__(self, address: str, folder: Path, name: str, seed: int) -> None:
        self.address = address
        self.folder = folder
        self.name = name
        self.seed = seed
        self.path = folder / f"results-{name}.txt"

    def run(self) -> None:
        """Run all rounds, and raise an error if one of them fails."""
        kinds = self.mapped, self.unordered, self.submitted, self.nested, self.each
        number = 1 + max(
            (int(line[1]) for line in lines(self.path) if line[0] == "begin"), default=0
        )
        with Client(self.address, name=self.name) as client:
            self.part = Partition(PARTITION, client)
            while (phase := phase_of(self.folder)) != END:
                if phase == QUIET:
                    self.keep_busy()
                    continue
                self.chance = random.Random(f"{self.seed} {self.name} {number}")
                orders = self._pop_orders()
                if CANCEL in orders:
                    play = self.canceled
                elif orders:
                    play = self.limited
                else:
                    play = self.chance.choice(kinds)
                items = [f"{self.name}-{number}-{k}" for k in range(self.chance.randrange(15, 60))]
                append(self.path, f"begin {number} {play.__name__} {len(items)} {time.monotonic()}")
                play(items, orders)
                append(self.path, f"end {number} {time.monotonic()}")
                number += 1

    def _pop_orders(self) -> list[str]:
        """Return orders of the same kind that wait for this client."""
        waiting = sorted(self.folder.glob(f"order-{self.name}-*"))
        kinds = [path.name.rpartition("-")[2] for path in waiting]
        taken = [
            path
            for path, kind in zip(waiting, kinds, strict=True)
            if (kind == CANCEL) == (kinds[0] == CANCEL)
        ]
        for path in taken:
            path.unlink()
        return [path.name.rpartition("-")[2] for path in taken]

    def record(self, items: Iterable[str], values: Iterable[object]) -> None:
        """Record results."""
        for item, value in zip(items, values, strict=True):
            text = TIMED_OUT if isinstance(value, TaskTimeoutError) else value
            append(self.path, f"result {item} {text}")

    # -- rounds ------------------------------------------------------------------------------

    def mapped(self, items: list[str], _: object) -> None:
        """Process items with `map`."""
        self.record(items, self.part.map(work, items, folder=self.folder))

    def unordered(self, items: list[str], _: object) -> None:
        """Process items with `map` in the order of completion."""
        for value in self.part.map(_with_item, items, folder=self.folder, ordered=False, chunk=1):
            append(self.path, f"result {value[0]} {value[1]}")

    def submitted(self, items: list[str], _: object) -> None:
        """Process items with `submit`."""
        futures = [self.part.submit(work, item, self.folder) for item in items]
        self.record(items, [future.result() for future in futures])

    def nested(self, items: list[str], _: object) -> None:
        """Process the children of items in nested tasks."""
        parents = items[:8]
        futures = [self.part.submit(nested, item, self.folder) for item in parents]
        values = [future.result() for future in futures]
        right = [sum(map(value_of, children(item))) for item in parents]
        for item, value, expected in zip(parents, values, right, strict=True):
            append(self.path, f"result {item} {value_of(item) if value == expected else 'wrong'}")
        self.record(items[8:], map(value_of, items[8:]))

    def each(self, items: list[str], _: object) -> None:
        """Process items with `for_each`, whose tasks record the results themselves."""
        path = self.path.with_name(f"each-{self.path.name}")
        done = self.part.for_each(items, work, folder=self.folder, path=path)
        arrived = {line[1] for line in lines(path)}
        if done == len(items):
            self.record(items, (value_of(i) if i in arrived else "missing" for i in items))

    def limited(self, items: list[str], orders: list[str]) -> None:
        """Process items with a time limit, which some of them exceed."""
        of_items: list[list[str]] = [[] for _ in items]
        for order, number in zip(
            orders, self.chance.sample(range(len(items)), len(orders)), strict=True
        ):
            of_items[number] = [order]
        results = self.part.map(
            work,
            items,
            [self.folder] * len(items),
            of_items,
            timeout_s=LIMIT_S,
            return_exceptions=True,
        )
        self.record(items, results)
        late = [item for item, order in zip(items, of_items, strict=True) if order]
        append(self.path, " ".join(["late", *late]))

    def canceled(self, items: list[str], _: object) -> None:
        """Cancel some of the tasks, of which some may be running."""
        count = self.chance.randrange(1, 12)
        endless, others = items[:count], items[count:]
        futures = [self.part.submit(work, item, self.folder, [CANCEL]) for item in endless]
        rest = [self.part.submit(work, item, self.folder) for item in others]
        time.sleep(self.chance.uniform(0.0, 1.0))
        outcomes = self.part.cancel(
            futures, running="restart", recompute=self.chance.random() < 0.5
        )
        kinds = Counter(outcome.partition(":")[0] for outcome in outcomes.values())
        append(self.path, " ".join(["canceled", *(f"{k}={n}" for k, n in kinds.items())]))
        for item, future in zip(endless, futures, strict=True):
            try:
                future.result(timeout=ENDLESS_S)
            except CancelledError:
                append(self.path, f"result {item} {value_of(item)}")
            else:
                append(self.path, f"result {item} not-canceled")
        self.record(others, [future.result() for future in rest])

    def keep_busy(self) -> None:
        """Have tasks wait for slots until the quiet phase has ended."""
        waiting: list[Future] = []
        append(self.path, f"quiet {time.monotonic()}")
        while phase_of(self.folder) == QUIET:
            waiting = [future for future in waiting if not future.done()]
            if len(waiting) < BACKLOG:
                items = [f"{self.name}-quiet{time.monotonic()}-{k}" for k in range(BACKLOG)]
                waiting += [self.part.submit(work, item, self.folder) for item in items]
            time.sleep(0.2)
        self.part.cancel(waiting)


def _with_item(item: str, folder: Path) -> tuple[str, int]:
    return item, work(item, folder)


def phase_of(folder: Path) -> str:
    """Return the current phase."""
    return (folder / "phase.txt").read_text()


def set_phase(folder: Path, phase: str) -> None:
    """Change the phase atomically."""
    (folder / "next-phase.txt").write_text(phase)
    (folder / "next-phase.txt").rename(folder / "phase.txt")


# -- what is left behind ---------------------------------------------------------------------


def lines(path: Path) -> list[list[str]]:
    """Return the words of each line of a file, which may not exist."""
    return [line.split() for line in path.read_text().splitlines()] if path.exists() else []


@dataclass
class Span:
    """Run of an item on a worker, to its end."""

    item: str
    start: float
    end: float
    worker: str


def spans_of(folder: Path) -> list[Span]:
    """Return all runs of items."""
    return [
        Span(item, float(start), float(end), worker)
        for path in folder.glob("runs-*.txt")
        for item, start, end, worker in lines(path)
    ]


def shares_of(spans: Iterable[Span], start: float, end: float) -> dict[str, float]:
    """Return the fraction of the slot time between two times in the quiet phase, by client.

    Canceled tasks that still run are not counted, because clients are not charged for them.
    """
    used: defaultdict[str, float] = defaultdict(float)
    for span in spans:
        if QUIET not in span.item:
            continue
        used[span.item.partition("-")[0]] += max(0.0, min(end, span.end) - max(start, span.start))
    total = sum(used.values())
    return {client: seconds / total for client, seconds in used.items()}


@dataclass
class Verdict:
    """Defects of a run."""

    lost: list[str] = field(default_factory=list)
    doubled: list[str] = field(default_factory=list)  # results that arrived twice
    repeated: list[str] = field(default_factory=list)  # items that ran again without a reason
    wrong: list[str] = field(default_factory=list)
    other: list[str] = field(default_factory=list)
    rounds: int = 0
    items: int = 0

    @property
    def sound(self) -> bool:
        """Whether there are no defects."""
        return not (self.lost or self.doubled or self.repeated or self.wrong or self.other)


def judge(folder: Path, left: Collection[str]) -> Verdict:
    """Examine all rounds that have ended. `left` has the addresses of workers that have left."""
    verdict = Verdict()
    workers: defaultdict[str, list[str]] = defaultdict(list)
    for span in spans_of(folder):
        workers[span.item].append(span.worker)
    for path in sorted(folder.glob("results-*.txt")):
        for item_lines in _rounds(lines(path)):
            _judge_round(item_lines, workers, left, verdict)
    errors = folder / "errors.txt"
    verdict.other += [errors.read_text()] if errors.exists() else []
    return verdict


def _rounds(of_client: list[list[str]]) -> Iterator[list[list[str]]]:
    """Yield the lines of each round that has ended."""
    starts = [k for k, line in enumerate(of_client) if line[0] == "begin"]
    for start, end in pairwise([*starts, len(of_client)]):
        found = of_client[start:end]
        if any(line[0] == "end" for line in found):
            yield found


def _judge_round(
    found: list[list[str]], workers: dict[str, list[str]], left: Collection[str], verdict: Verdict
) -> None:
    _, number, kind, count, _ = found[0]
    results = [(line[1], " ".join(line[2:])) for line in found if line[0] == "result"]
    client = next((item.partition("-")[0] for item, _ in results), "?")
    late = {item for line in found if line[0] == "late" for item in line[1:]}
    times = Counter(item for item, _ in results)
    for item in (f"{client}-{number}-{k}" for k in range(int(count))):
        if not times[item]:
            verdict.lost.append(f"{kind} {item}")
        elif times[item] > 1:
            verdict.doubled.append(f"{kind} {item}")
        again = [worker for worker in workers[item] if worker not in left]
        if len(again) > 1:
            verdict.repeated.append(f"{kind} {item} on {' and '.join(again)}")
    for item, value in results:
        if value != (TIMED_OUT if item in late else str(value_of(item))):
            verdict.wrong.append(f"{kind} {item}: {value}")
    verdict.rounds += 1
    verdict.items += int(count)


if __name__ == "__main__":
    target, where, called, number = sys.argv[1:]
    try:
        RoundClient(target, Path(where), called, int(number)).run()
    except BaseException:
        append(Path(where) / "errors.txt", f"{called}: {traceback.format_exc()}")
        raise
