"""How many scans are to be put into one item, so that it is worth its overhead."""

from __future__ import annotations

from poolpart import TaskRecord

from ..survey import Survey

BATCH_SECONDS = 0.05  # casting time that makes a batch worth its overhead
BATCH_RAYS = 1_000_000  # bounds a batch's memory, at 16 bytes a hit and 24 a direction
BATCHES_LEAST = 16  # for each slot, so that none idles for long in the end


def wished_scans(survey: Survey, slots: int, last: TaskRecord) -> int:
    """Say how many scans an item should have, from the last one: at most twice as many.

    Parameters
    ----------
    survey
        What is scanned.
    slots
        Items that are cast at a time.
    last
        The task that cast it.
    """
    rays_per_scan = max(1, survey.ray_count // survey.scan_count)
    most = min(BATCH_RAYS // rays_per_scan, survey.scan_count // (BATCHES_LEAST * slots))
    per_scan = max(last.seconds, 1e-6) / last.items
    return max(1, min(int(BATCH_SECONDS / per_scan), 2 * last.items, most))
