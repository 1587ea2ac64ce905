"""Pipeline of balanced partitions that `tests.chaos.balancing` disturbs, and what it leaves behind.

A client sends the items that are still missing through three stages, and appends each result to a
file. If the client is killed, the next one continues with the items that are missing in the file.
"""

from __future__ import annotations

import os
import sys
import time
import traceback
import uuid
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from distributed import Client

from poolpart import Partition, Pipe, Pool

SOURCE, DECODE, DETECT = PARTITIONS = "SOURCE", "DECODE", "DETECT"
BALANCED = DECODE, DETECT
SLOW_S, FAST_S = 0.24, 0.06  # running times of an item in the two balanced stages
PHASE = 150  # number of items after which the other stage is the slow one
CAPACITY = 16  # of the pipes
CHUNK = 25  # items that the producer sends at once, in turn with single items
_RESULTS = "results.txt"
_SPANS = "spans-*.txt"
_ERRORS = "errors.txt"
_END = "end.txt"


def seconds_of(item: int) -> tuple[float, float]:
    """Return the running times of an item in the two balanced stages."""
    return (SLOW_S, FAST_S) if item // PHASE % 2 else (FAST_S, SLOW_S)


def append(path: Path, line: str) -> None:
    """Append a line in one system call, so that a killed process leaves no part of it."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    try:
        os.write(descriptor, f"{line}\n".encode())
    finally:
        os.close(descriptor)


# -- stages ----------------------------------------------------------------------------------


@contextmanager
def recorded(folder: Path, partition: str) -> Iterator[None]:
    """Record in which partition this process works, from the start to the end of the block."""
    path = folder / _SPANS.replace("*", str(os.getpid()))
    append(path, f"{time.monotonic()} {partition} 1")
    try:
        yield
    finally:
        append(path, f"{time.monotonic()} {partition} -1")


def produce(items: list[int], folder: Path, raw: Pipe) -> None:
    """Send items, in turn one at a time and several at once."""
    with recorded(folder, SOURCE):
        for number, start in enumerate(range(0, len(items), CHUNK)):
            chunk = items[start : start + CHUNK]
            if number % 2:
                raw.put_many(chunk)
            else:
                for item in chunk:
                    raw.put(item)
        raw.close()


def decode(item: int, folder: Path, frames: Pipe) -> None:
    """Run the first balanced stage."""
    with recorded(folder, DECODE):
        time.sleep(seconds_of(item)[0])
        frames.put(item)


def detect(item: int, folder: Path, boxes: Pipe) -> None:
    """Run the second balanced stage."""
    with recorded(folder, DETECT):
        time.sleep(seconds_of(item)[1])
        boxes.put((item, item**2))


# -- client ----------------------------------------------------------------------------------


def run_client(address: str, folder: Path, total: int) -> None:
    """Process the missing items, and raise an error if this is not possible."""
    try:
        with Client(address) as client:
            _process(client, folder, total)
    except BaseException:
        append(folder / _ERRORS, traceback.format_exc())
        raise


def _process(client: Client, folder: Path, total: int) -> None:
    missing = sorted({*range(total)} - results_of(folder).keys())
    group = Pool.from_client(client).balance(BALANCED, min=1)
    source, decoding, detecting = (Partition(name, client) for name in PARTITIONS)
    run = uuid.uuid4().hex[:8]
    raw, frames, boxes = (Pipe(f"{n}-{run}", CAPACITY, client) for n in ("raw", "frames", "boxes"))
    with raw, frames, boxes:
        listener = boxes.listen(partial(_record, folder))
        producer = source.submit(produce, missing, folder, raw)
        first = decoding.for_each(raw, decode, folder=folder, frames=frames, wait=False)
        second = detecting.for_each(frames, detect, folder=folder, boxes=boxes, wait=False)
        counts = [first.result()]
        frames.close()
        counts.append(second.result())
        boxes.close()
        listener.join()
        producer.result()
    append(folder / _END, f"{len(missing)} items, {counts}, {len(group.stats().moves)} moves")


def _record(folder: Path, result: tuple[int, int]) -> None:
    append(folder / _RESULTS, f"{result[0]} {result[1]}")


# -- what is left behind ---------------------------------------------------------------------


def results_of(folder: Path) -> Counter[int]:
    """Return how often each item has arrived with the right value."""
    path = folder / _RESULTS
    lines = path.read_text().splitlines() if path.exists() else []
    pairs = [tuple(map(int, line.split())) for line in lines]
    return Counter(item for item, value in pairs if value == item**2)


def errors_of(folder: Path) -> str:
    """Return the errors of clients that were not killed."""
    path = folder / _ERRORS
    return path.read_text() if path.exists() else ""


def shared_spans(folder: Path) -> list[str]:
    """Return the processes in which tasks of two partitions have run at the same time."""
    found = []
    for path in sorted(folder.glob(_SPANS)):
        running: Counter[str] = Counter()
        for line in path.read_text().splitlines():
            at, partition, change = line.split()
            running[partition] += int(change)
            if len(names := [name for name, count in running.items() if count > 0]) > 1:
                found.append(f"process {path.stem} at {at}: {' and '.join(sorted(names))}")
    return found


@dataclass
class Verdict:
    """Defects of a run."""

    lost: list[int] = field(default_factory=list)
    doubled: list[int] = field(default_factory=list)
    unexpected: list[int] = field(default_factory=list)
    shared: list[str] = field(default_factory=list)  # workers in two partitions at a time
    errors: str = ""

    @property
    def sound(self) -> bool:
        """Whether there are no defects."""
        return not (self.lost or self.doubled or self.unexpected or self.shared or self.errors)


def judge(folder: Path, total: int) -> Verdict:
    """Compare the results of a run with the items."""
    results = results_of(folder)
    return Verdict(
        lost=sorted({*range(total)} - results.keys()),
        doubled=sorted(item for item, count in results.items() if count > 1),
        unexpected=sorted(results.keys() - {*range(total)}),
        shared=shared_spans(folder),
        errors=errors_of(folder),
    )


if __name__ == "__main__":
    run_client(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]))
