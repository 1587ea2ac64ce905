"""Check the parts of an earlier run before they are reused."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from operator import attrgetter

from lidarsim.words import list_names

from ..pipeline.stage_messages import Receipt, format_scans
from .database import RunDatabase
from .stored_job import StoredJob

CHECKERS = 4  # threads that check parts, each of which has two copies of a part in memory
# Values of a receipt that can also be read from the part.
_IN_PART = attrgetter("first", "stop", "point_count")


def check_parts(
    job: StoredJob, db: RunDatabase, sizes: Mapping[str, int], strays: Sequence[str]
) -> list[str]:
    """Drop missing and damaged parts of a job, and commit parts that the database lacks.

    Parameters
    ----------
    job
        Job in flight with its committed results.
    db
        Database of the run. It may be an older copy, or new because the original was lost.
    sizes
        Sizes of the files in the storage in bytes, by name.
    strays
        Names of all parts of the job in the storage, including committed parts.

    Returns
    -------
    Notes for the user that state which scans are cast again, and why.
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
    """Return "missing", "damaged", or an empty string if the part is valid.

    Reading the part verifies the checksums of its columns.
    """
    if part.name not in sizes:
        return "missing"
    if sizes[part.name] != part.size:
        return "damaged"
    receipt = job.receipt(part.name)
    return "" if receipt is not None and _IN_PART(receipt) == _IN_PART(part) else "damaged"


def _note(job: StoredJob, receipts: Sequence[Receipt], state: str) -> str:
    names = list_names([part.name for part in receipts])
    scans = list_names([format_scans(part.first, part.stop) for part in receipts])
    verb = "was" if len(receipts) == 1 else "were"
    return f"repeated {scans}, because {names} {verb} {state} in {job.storage.url}"
