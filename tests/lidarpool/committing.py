"""Parts that are committed as by a run, for tests."""

from __future__ import annotations

import numpy as np

from lidarpool.columns.parts import PartColumns, pack, part_name
from lidarpool.pipeline.messages import Receipt, samples_of_scan, summary_type


def commit(store, first, counts, triangles, hits):
    """Write a part of scans, with so many points of each, and commit it; whether it was new."""
    rng = np.random.default_rng(first)
    counts, survey = np.array(counts), store.job.survey
    columns = {
        c.name: rng.integers(0, 2, counts.sum()).astype(c.dtype) for c in survey.stored_columns
    }
    part = PartColumns(first, counts, columns, np.int32(triangles), np.int64(hits))
    data, name = bytes(pack(part)), part_name(store.db.meta["mark"], first, part.stop)
    store.storage.prepare()
    store.storage.write(name, data)
    summaries = np.zeros(len(counts), summary_type(samples_of_scan(survey.scan_count)))
    summaries["samples"] = [first, 0, 0]
    box = () if part.cells is None else tuple(part.cells.ravel().tolist())
    receipt = Receipt(
        first, part.stop, name, len(part), len(data), sum(hits), box, summaries.tobytes()
    )
    return store.db.commit([receipt]) == [receipt]
