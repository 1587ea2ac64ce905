"""Noticing that a partition has lost its workers, for which Dask would wait for ever."""

from __future__ import annotations

import time

from distributed import Client

from .errors import LidarpoolError

WATCH_EVERY_S = 1.0
PATIENCE_S = 60.0  # how long a partition may be without workers; a nanny needs a few seconds


class Watch:
    """Notices a partition that stays without workers.

    Parameters
    ----------
    client
        Client of the cluster.
    names
        Partitions to look after.
    """

    def __init__(self, client: Client, names: set[str]) -> None:
        self.client, self.names = client, names
        self._looked = time.monotonic()
        self._seen = dict.fromkeys(names, self._looked)

    def look(self, now: float) -> None:
        """Check, once in a while; LidarpoolError if a partition has been empty for too long."""
        if now - self._looked < WATCH_EVERY_S:
            return
        self._looked = now
        for worker in self.client.scheduler_info(n_workers=-1)["workers"].values():
            for name in self.names & set(worker["resources"]):
                self._seen[name] = now
        for name, seen in self._seen.items():
            if now - seen > PATIENCE_S:
                raise LidarpoolError(
                    f"Partition {name!r} has had no workers for {PATIENCE_S:.0f} s, so the run "
                    f'was ended: start some with --resources "{name}=1" and run it again.'
                )
