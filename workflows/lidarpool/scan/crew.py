"""The workers of stage 2 as the driver sees them: prepared, at work, silent, gone."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable
from typing import Any

from distributed import Future

from poolpart import Whereabouts, look_for_tasks

from ..errors import LidarpoolError
from .failures import raise_if_failed, was_killed, words_on_memory
from .setup import SurveySetup
from .survey_run import SurveyRun

LOOK_EVERY_S = 1.0
SCENE_DEATHS = 4  # workers in a row that may die while they prepare themselves
PREPARING = "preparing the scene on the GPU workers"


class Crew:
    """The workers that cast; each has to prepare itself, also one that joins late.

    Dask runs a task where its inputs are, unless the wait there is longer than it takes to
    move them. Scans are so short that it would leave all of them to the one worker that has
    the scene, and a worker that was restarted would never get one.

    Parameters
    ----------
    run
        The run.
    setup
        Scene, sensor and backend.
    """

    def __init__(self, run: SurveyRun, setup: SurveySetup) -> None:
        self._run = run
        self._arguments = setup.__reduce__()[1]
        self._setups: list[Future] = []  # the last is in use
        self._prepared: dict[str, Future] = {}  # {address: task that readies the worker}
        self._died: list[str] = []  # while they prepared themselves, one after the other
        self._looked_at = float("-inf")
        self.seen = Whereabouts()

    def start(self) -> None:
        """Send the scene to the cluster and have all workers prepare themselves."""
        self._make_setup()
        self.look([])

    @property
    def setup(self) -> Future:
        """The scene and the sensor, on the workers."""
        return self._setups[-1]

    @property
    def futures(self) -> list[Future]:
        """All tasks of the crew."""
        return [*self._setups, *self._prepared.values()]

    @property
    def prepared(self) -> list[str]:
        """Addresses of the workers that are there, ready and heard of."""
        return [
            address
            for address, future in self._prepared.items()
            if future.status == "finished" and address not in self.seen.silent
        ]

    @property
    def slots(self) -> int:
        """Batches that the partition casts at a time."""
        return max(1, self.seen.slots)

    @property
    def takes_work(self) -> bool:
        """Whether batches may be submitted: to be cast now, or as soon as a worker is ready.

        Not once a worker has died of preparing: batches that wait for it would look guilty.
        """
        return bool(self.prepared) or not self._died

    @property
    def due(self) -> bool:
        """Whether it is time to look again."""
        return time.monotonic() - self._looked_at > LOOK_EVERY_S

    def look(self, keys: Collection[str]) -> Whereabouts:
        """See to workers that have come or gone; returns where they and the tasks are.

        Raises
        ------
        LidarpoolError
            If preparing the scene ends one worker after the other.
        """
        self._looked_at = time.monotonic()
        own = [future.key for future in self.futures]
        self.seen = look_for_tasks(self._run.client, self._run.gpu.name, [*keys, *own])
        self._renew_setup()
        for address in self._prepared.keys() - self.seen.members:
            self._bury(address)
        for address in self.seen.members - self._prepared.keys() - self.seen.silent:
            self._prepare(address)
        return self.seen

    def check(self) -> None:
        """Raise LidarpoolError if preparing has failed."""
        for future in self.futures:
            if future.status == "error" and was_killed(future):
                continue  # counted when its worker is missed
            raise_if_failed(future, PREPARING)

    def idle(self, busy: Iterable[str]) -> str | None:
        """Address of a prepared worker that is not one of these."""
        return next(iter(sorted(set(self.prepared) - set(busy))), None)

    def _make_setup(self, worker: str | None = None) -> None:
        key = self._run.key("scene", len(self._setups))
        self._setups.append(
            self._run.gpu.submit(_make_setup, *self._arguments, key=key, worker=worker)
        )

    def _renew_setup(self) -> None:
        """Make the scene anew where all workers that have it have fallen silent."""
        heard = sorted(self.seen.members - self.seen.silent)
        lost = self.seen.out_of_reach(self.setup.key) or (
            self.setup.status == "error" and was_killed(self.setup)
        )
        if heard and lost:
            self._make_setup()
            for address in heard:
                if self._prepared.get(address, self.setup).status != "finished":
                    self._prepared.pop(address, None)

    def _prepare(self, address: str) -> None:
        self._prepared[address] = self._run.gpu.submit(
            _prepare,
            self.setup,
            key=self._run.new_key("prepare", len(self._prepared)),
            priority=10,
            worker=address,
        )

    def _bury(self, address: str) -> None:
        """Forget a worker that has gone; it may have died of the scene."""
        future = self._prepared.pop(address)
        if future.status == "finished":
            self._died.clear()
            return
        place = self.seen.tasks.get(future.key)
        if place is not None and place.deaths:
            self._died.append(address)
        if len(self._died) >= SCENE_DEATHS and not self.prepared:
            raise LidarpoolError(
                f"{PREPARING} has ended {len(self._died)} of them, one after the other"
                f"{words_on_memory(self._run.client, self._died)}: "
                "look into their logs, or try another backend."
            )


def _make_setup(*arguments: Any) -> SurveySetup:
    return SurveySetup(*arguments)


def _prepare(setup: SurveySetup) -> None:
    setup.prepare()
