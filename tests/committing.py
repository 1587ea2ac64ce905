"""Parts that are committed as by a run, for tests."""

from __future__ import annotations

import numpy as np

from lidarfiles.parts.parts import pack, part_name
from lidarpool.run.pipeline.stage_messages import Receipt, samples_of_scan
from lidarsim.columns.part_columns import PartColumns


def commit(store, first, counts, triangles, hits, job=None, offset=0):
    """Write a part of scans, with so many points of each, and commit it; whether it was new.

    It is of the only job of a run, or of one that is under way. `offset` cells are added to x.
    """
    rng = np.random.default_rng(first)
    job = job or store.only_job.job
    counts = np.array(counts)
    survey = job.survey
    columns = {
        c.name: rng.integers(0, 2, counts.sum()).astype(c.dtype) for c in survey.stored_columns
    }
    columns["x"] += np.int32(offset)
    of_scans = np.zeros(len(counts), np.uint32)
    of_scans[0] = sum(hits)
    ends = np.zeros((len(counts), samples_of_scan(survey.scan_count), 3), np.float32)
    ends[..., 0] = first
    triangles = np.int32(triangles)
    hits = np.int64(hits)
    part = PartColumns(first, counts, columns, triangles, hits, of_scans, ends)
    data = b"".join(pack(part))
    name = part_name(store.db.meta["mark"], job.number, first, part.stop)
    store.storage.prepare()
    store.storage.write(name, data)
    receipt = Receipt.from_part(part, job.number, name, len(data))
    return bool(store.db.commit([(store.in_flight[job.number].committed, receipt)]))
