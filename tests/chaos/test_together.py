"""Several who share a cluster and do not see each other."""

from __future__ import annotations

import multiprocessing
import threading

import pytest
from distributed import Client, Queue
from tests.chaos.arena import Arena
from tests.chaos.driver import Driver
from tests.chaos.survey import PAUSES, PLANNING, reference, survey
from tests.chaos.traces import scheduler_state, settled_differences

ROUNDS_LEAST = 10
TIME_TO_LIVE_S = 300  # nobody is stopped here: a worker that is not heard of is only slow
FIRST, SECOND = survey(1, layers=4), survey(1, layers=6)


class Foreigner(threading.Thread):
    """Somebody who knows nothing of partitions: own client, own tasks, own queue."""

    def __init__(self, address: str) -> None:
        super().__init__(name="foreigner")
        self.address = address
        self.over = threading.Event()
        self.results: list[int] = []
        self.taken: list[int] = []

    def run(self) -> None:
        with Client(self.address) as client:
            queue = Queue("foreign", client=client)
            # Some rounds at least: what is asked is whether they are right, not how fast.
            while not self.over.is_set() or len(self.results) < ROUNDS_LEAST:
                count = len(self.results)
                queue.put(count)
                future = client.submit(pow, count, 2, pure=False)
                self.results.append(future.result(timeout=120))
                self.taken.append(queue.get(timeout=120))
            queue.close()


@pytest.mark.slow
def test_two_surveys_and_a_foreign_user_do_not_see_each_other():
    spawn = multiprocessing.get_context("spawn")
    with Arena(lidar=2, slots=5, pauses=PAUSES, time_to_live_s=TIME_TO_LIVE_S) as arena:
        before = scheduler_state(arena.client)  # of what a run has used nothing stays either
        alone = [reference(arena, what) for what in (FIRST, SECOND)]
        foreigner = Foreigner(arena.client.scheduler.address)
        foreigner.start()
        address, start = arena.client.scheduler.address, spawn.Barrier(2)
        drivers = [
            Driver(address, what, PLANNING, arena.board.folder, start) for what in (FIRST, SECOND)
        ]
        delivered = [driver.delivered() for driver in drivers]
        foreigner.over.set()
        foreigner.join(120)
        assert not foreigner.is_alive()
        spans = [
            (min(times), max(times))
            for one in delivered
            for times in [[event["t"] for event in arena.board.events(one.run)]]
        ]
        left = settled_differences(arena.client, before)
    for one, other in zip(delivered, alone, strict=True):
        assert one.error == ""
        assert one.reference == other
        assert (one.misplaced, one.replayed, one.dropped) == (0, 0, 0)
    # They did run at a time.
    assert max(start for start, _ in spans) < min(end for _, end in spans)
    assert len(foreigner.results) >= ROUNDS_LEAST
    assert foreigner.results == [count**2 for count in range(len(foreigner.results))]
    assert foreigner.taken == list(range(len(foreigner.taken)))
    assert left == []
