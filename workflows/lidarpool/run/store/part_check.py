"""Checks the parts that an earlier run has left, before a run relies on them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from operator import attrgetter

from lidarsim.base.words import listed

from ..pipeline.messages import Receipt, scans_in_words
from .database import RunDatabase
from .job_under_way import JobUnderWay

CHECKERS = 4  # threads that check parts; each holds one in memory, twice
_IN_PART = attrgetter("first", "stop", "rows")  # of a receipt, what the part must say as well


def check_parts(
    job: JobUnderWay, db: RunDatabase, sizes: Mapping[str, int], strays: Sequence[str]
) -> list[str]:
    """Drop missing and damaged parts of a job, and commit parts that the database does not know.

    Parameters
    ----------
    job
        A job under way, with what is committed of it.
    db
        The database, which was lost perhaps, or is a copy of some seconds before.
    sizes
        Bytes of the files in storage, by name.
    strays
        Names of the parts of the job in storage, those that are committed among them.

    Returns
    -------
    Notes for the user: which scans are cast again, and why.
    """
    lost: dict[str, list[Receipt]] = {"missing": [], "damaged": []}
    committed = {part.name for part in job.parts.ordered}
    unknown = [name for name in strays if name not in committed]
    notes = []
    pool = ThreadPoolExecutor(min(CHECKERS, os.cpu_count() or 1), "check")
    try:
        states = pool.map(lambda part: _state(job, part, sizes), job.parts.ordered)
        for part, state in zip(job.parts.ordered, states, strict=True):
            if state:
                lost[state].append(part)
        for state, parts in lost.items():
            if parts:
                db.drop(job, parts)
                notes.append(_note(job, parts, state))
        for receipt in filter(None, pool.map(job.receipt, unknown)):
            db.commit([(job, receipt)])
    finally:
        pool.shutdown(cancel_futures=True)
    job.resumed = job.parts.scans_done
    return notes


def _state(job: JobUnderWay, part: Receipt, sizes: Mapping[str, int]) -> str:
    """Return "missing" or "damaged", to the checksum of each column; empty for a whole part."""
    if part.name not in sizes:
        return "missing"
    if sizes[part.name] != part.size:
        return "damaged"
    receipt = job.receipt(part.name)
    return "" if receipt is not None and _IN_PART(receipt) == _IN_PART(part) else "damaged"


def _note(job: JobUnderWay, parts: Sequence[Receipt], state: str) -> str:
    """Say which scans are cast again, and that their parts were missing or damaged."""
    names = listed([part.name for part in parts])
    scans = listed([scans_in_words(part.first, part.stop) for part in parts])
    verb = "was" if len(parts) == 1 else "were"
    return f"cast again: {scans}; {names} {verb} {state} in {job.storage.url}"
