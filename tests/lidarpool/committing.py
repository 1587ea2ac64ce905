"""Parts that are committed as by a run, for tests."""

from __future__ import annotations

import numpy as np

from lidarpool.columns.parts import PartColumns, pack, part_name
from lidarpool.pipeline.messages import Receipt, samples_of_scan


def commit(store, first, counts, triangles, hits, number=0):
    """Write a part of scans, with so many points of each, and commit it; whether it was new."""
    rng = np.random.default_rng(first)
    counts, survey = np.array(counts), store.job.survey
    columns = {
        c.name: rng.integers(0, 2, counts.sum()).astype(c.dtype) for c in survey.stored_columns
    }
    samples = np.zeros((len(counts), samples_of_scan(survey.scan_count), 3), np.float32)
    samples[:] = [first, 0, 0]
    of_scans = np.zeros(len(counts), np.uint32)
    of_scans[0] = sum(hits)
    part = PartColumns(
        first, counts, columns, np.int32(triangles), np.int64(hits), of_scans, samples
    )
    data = bytes(pack(part))
    name = part_name(store.db.meta["mark"], number, first, part.stop)
    store.storage.prepare()
    store.storage.write(name, data)
    store.db.job(number, survey.scan_count)
    receipt = Receipt.of_part(part, number, name, len(data))
    return store.db.commit([receipt]) == [receipt]
