"""The survey's stages as one would write them first: nothing in here survives a death.

Consumers block in `Queue.get`, the end is an item like others, nobody keeps count. It passes
the same points, so that the same nemesis strikes it and the same checker judges it.
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Sequence
from typing import Any

from distributed import Client, Future, Queue, secede

from poolpart import trace

from .arena import Arena
from .checker import Verdict, judge
from .nemesis import Fault, Nemesis

STOP = -1
BATCH = 4
CASTERS = COLLECTORS = 2
IDLE_MOST_S = 5.0  # without anything arriving; then a disturbed run is given up
START_MOST_S = 30.0  # the same before the first scan
UNDISTURBED_MOST_S = 120.0  # the same where nothing can be lost, so that it ends by itself


def generate(run: str, scans: int, outlet: str) -> None:
    """Stage 1."""
    secede()
    trace("generate.start", run=run, scans=[])
    queue = Queue(outlet)
    for first in range(0, scans, BATCH):
        item = list(range(first, min(first + BATCH, scans)))
        trace("generate.put", run=run, scans=item)
        queue.put(item)
        trace("generate.sent", run=run, scans=item)
    for _ in range(CASTERS):
        queue.put([STOP])


def cast(run: str, inlet: str, outlet: str) -> None:
    """Stage 2, as a task that runs as long as there is something to do."""
    secede()
    source, sink = Queue(inlet), Queue(outlet)
    while (item := list(source.get())) != [STOP]:
        trace("intersect.start", run=run, scans=item)
        time.sleep(0.002 * len(item))
        trace("intersect.cast", run=run, scans=item)
        sink.put(item)
        trace("intersect.end", run=run, scans=item)
    sink.put([STOP])


def collect(run: str, inlet: str, outlet: str) -> None:
    """Stage 4."""
    secede()
    source, sink = Queue(inlet), Queue(outlet)
    trace("collect.hello", run=run, scans=[])
    while (item := list(source.get())) != [STOP]:
        trace("collect.get", run=run, scans=item)
        trace("collect.part", run=run, scans=item)
        sink.put(item)
        trace("collect.sent", run=run, scans=item)
    sink.put([STOP])


def survey(
    client: Client, scans: int, start_most_s: float = START_MOST_S, idle_most_s: float = IDLE_MOST_S
) -> list[int]:
    """Run it; returns the scans that arrived, as they came."""
    run = uuid.uuid4().hex[:8]
    names = [f"naive-{run}-{number}" for number in range(3)]
    queues = [Queue(name, client=client) for name in names]
    arrived: list[int] = []
    tasks: list[Future] = [_submit(client, "LIDAR", generate, run, scans, names[0])]
    tasks += [_submit(client, "GPU", cast, run, *names[:2]) for _ in range(CASTERS)]
    tasks += [_submit(client, "LIDAR", collect, run, *names[1:]) for _ in range(COLLECTORS)]
    ends = 0
    deadline = time.monotonic() + start_most_s
    while ends < COLLECTORS and time.monotonic() < deadline:
        for item in queues[-1].get(batch=True):
            deadline = time.monotonic() + idle_most_s
            if list(item) == [STOP]:
                ends += 1
                continue
            arrived += item
            trace("driver.take", run=run, scans=list(item))
            trace("driver.frame", run=run, scans=list(item))
            trace("driver.points", run=run, scans=list(item))
        time.sleep(0.005)
    client.cancel(tasks)
    for queue in queues:
        queue.close()
    return arrived


def _submit(client: Client, partition: str, function: Any, *arguments: Any) -> Future:
    return client.submit(function, *arguments, resources={partition: 1}, pure=False)


def disturbed(arena: Arena, scans: int, faults: Sequence[Fault]) -> Verdict:
    """Run it under the nemesis, and judge what arrived: one row a scan, in order."""
    arena.wait_until_whole()
    arena.board.forget_events()
    patience = () if faults else (UNDISTURBED_MOST_S, UNDISTURBED_MOST_S)
    with Nemesis(arena, faults) as nemesis:
        arrived = survey(arena.client, scans, *patience)
    rows = sorted(arrived)
    return judge(arena.board.events(nemesis.run), scans, rows, range(scans))
