"""How far a run has come."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Progress:
    """Counts at one moment of a run.

    `generated`, `cast`, `framed` and `collected` are scans that have passed stage 1 to 4, out
    of `scans`; `trials_done` are planning trials out of `trials`. `seconds` is since the start,
    `replayed` are batches that were sent or cast once more. `paused` says that somebody has
    paused the run, and that nothing is under way any more. `waits_for` is the partition whose
    slots the survey needs and other runs hold; empty when it has them.
    """

    scans: int
    generated: int
    cast: int
    framed: int
    collected: int
    points: int
    trials: int
    trials_done: int
    seconds: float
    replayed: int = 0
    paused: bool = False
    waits_for: str = ""
