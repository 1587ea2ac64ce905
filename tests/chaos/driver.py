"""A survey whose driver is a process of its own."""

from __future__ import annotations

import multiprocessing
import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from distributed import Client

from lidarpool import Planning, Survey, simulate
from lidarpool.base.tracing import trace_to
from poolpart import placement_violations

from .events import Board, Sink
from .survey import Reference, room


@dataclass(frozen=True)
class Delivered:
    """What a driver reports in the end."""

    run: str
    reference: Reference | None  # None where it failed
    misplaced: int
    replayed: int
    dropped: int
    error: str = ""


class Driver:
    """Starts a survey on a cluster, in a new process.

    Parameters
    ----------
    address
        Of the scheduler.
    what, planning
        The survey and what is planned meanwhile.
    folder
        Of the board to log to.
    """

    def __init__(self, address: str, what: Survey, planning: Planning | None, folder: Path) -> None:
        context = multiprocessing.get_context("spawn")
        self._answers, outlet = context.Pipe(duplex=False)
        self.process = context.Process(
            target=_drive, args=(outlet, address, what, planning, folder), daemon=True
        )
        self.process.start()
        outlet.close()

    @property
    def is_done(self) -> bool:
        """Whether it has reported, or died."""
        return self._answers.poll() or not self.process.is_alive()

    def delivered(self, timeout_s: float = 600.0) -> Delivered:
        """Wait for its report."""
        if not self._answers.poll(timeout_s):
            self.process.kill()
            raise TimeoutError(f"The driver has reported nothing for {timeout_s} s.")
        answer: Delivered = self._answers.recv()
        self._answers.close()
        self.process.join(120)
        self.process.close()
        return answer


def _drive(
    outlet: Connection, address: str, what: Survey, planning: Planning | None, folder: Path
) -> None:
    run = ""
    log = Sink(Board(folder), "driver", lambda _: None)

    def note(point: str, fields: Mapping[str, object]) -> None:
        nonlocal run
        run = str(fields.get("run", ""))
        log(point, fields)

    trace_to(note)
    try:
        with Client(address) as client:
            result = simulate(room(), what, planning, client=client, backend="numpy")
            outlet.send(
                Delivered(
                    run,
                    Reference.of(result),
                    len(placement_violations(result.records)),
                    result.replayed,
                    result.duplicates_dropped,
                )
            )
    except Exception:
        outlet.send(Delivered(run, None, 0, 0, 0, traceback.format_exc()))
