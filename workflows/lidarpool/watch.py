"""Noticing that a partition has lost its workers, for which Dask would wait for ever."""

from __future__ import annotations

import time
from collections.abc import Iterable

from distributed import Client

from poolpart import worker_identities

from .errors import LidarpoolError

WATCH_EVERY_S = 1.0
PATIENCE_S = 60.0  # how long a partition may be without workers; a nanny needs a few seconds


class Watch:
    """Notices a partition that stays without workers, or without such as take tasks.

    Parameters
    ----------
    client
        Client of the cluster.
    names
        Partitions whose workers get new tasks all the time.
    lasting
        Partitions whose tasks last as long as the run: workers that take no more are as good.
    """

    def __init__(self, client: Client, names: Iterable[str], lasting: Iterable[str] = ()) -> None:
        self.client, self.lasting = client, frozenset(lasting)
        self._looked = time.monotonic()
        # {partition: when workers were last there}
        self._seen = dict.fromkeys([*names, *self.lasting], self._looked)
        self._paused: set[str] = set()  # partitions that have only such

    def forget(self, names: Iterable[str]) -> None:
        """Look after these partitions no more: nothing is left to do there."""
        for name in names:
            self._seen.pop(name, None)

    def look(self, now: float) -> None:
        """Check, once in a while; LidarpoolError if a partition has been empty for too long."""
        if now - self._looked < WATCH_EVERY_S:
            return
        self._looked = now
        self._paused = set()
        for worker in worker_identities(self.client).values():
            for name in self._seen.keys() & worker["resources"].keys():
                if worker["status"] == "running" or name in self.lasting:
                    self._seen[name] = now
                else:
                    self._paused.add(name)
        for name, seen in self._seen.items():
            if now - seen > PATIENCE_S:
                raise LidarpoolError(self._complaint(name))

    def _complaint(self, name: str) -> str:
        start = f'start some with --resources "{name}=1" and run it again.'
        if name in self._paused:
            return (
                f"The workers of partition {name!r} have taken no tasks for {PATIENCE_S:.0f} s, so "
                "the run was ended: Dask pauses those whose memory is nearly full. Give them a "
                f"larger --memory-limit, or {start}"
            )
        return (
            f"Partition {name!r} has had no workers for {PATIENCE_S:.0f} s, so the run was ended: "
            + start
        )
