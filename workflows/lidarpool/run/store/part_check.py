"""Checks the parts that an earlier run has left, before a run relies on them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from operator import attrgetter

from lidarsim.words import listed

from ..pipeline.stage_messages import Receipt, scans_in_words
from .database import RunDatabase
from .stored_job import StoredJob

CHECKERS = 4  # threads that check parts; each has two copies of a part in memory
# values of a receipt that the part has as well
_IN_PART = attrgetter("first", "stop", "point_count")


def check_parts(
    job: StoredJob, db: RunDatabase, sizes: Mapping[str, int], strays: Sequence[str]
) -> list[str]:
    """Drop missing and damaged parts of a job, and commit parts that the database does not know.

    Parameters
    ----------
    job
        A job in flight, with its committed results.
    db
        The database; it may be new because it was lost, or an older copy.
    sizes
        {name of a file in storage: bytes}.
    strays
        Names of the parts of the job in storage, including committed parts.

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
                db.drop(job.committed, parts)
                notes.append(_note(job, parts, state))
        for receipt in filter(None, pool.map(job.receipt, unknown)):
            db.commit([(job.committed, receipt)])
    finally:
        pool.shutdown(cancel_futures=True)
    return notes


def _state(job: StoredJob, part: Receipt, sizes: Mapping[str, int]) -> str:
    """Return "missing", "damaged" by the checksum of any column, or "" for a valid part."""
    if part.name not in sizes:
        return "missing"
    if sizes[part.name] != part.size:
        return "damaged"
    receipt = job.receipt(part.name)
    return "" if receipt is not None and _IN_PART(receipt) == _IN_PART(part) else "damaged"


def _note(job: StoredJob, receipts: Sequence[Receipt], state: str) -> str:
    """Return a note that scans are repeated because their parts were missing or damaged."""
    names = listed([part.name for part in receipts])
    scans = listed([scans_in_words(part.first, part.stop) for part in receipts])
    verb = "was" if len(receipts) == 1 else "were"
    return f"repeated {scans}, because {names} {verb} {state} in {job.storage.url}"
