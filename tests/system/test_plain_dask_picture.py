"""The picture of the front page of poolpart shows what its caption says."""

import pytest
from docs.pictures import beside_plain_dask


@pytest.mark.slow
def test_partitions_keep_a_worker_free_and_the_memory_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(beside_plain_dask, "FRAMES", 120)
    monkeypatch.setattr(beside_plain_dask, "REQUESTS", 6)
    _, waiting = beside_plain_dask.run_pipeline("plain")
    times, bounded = beside_plain_dask.run_pipeline("partitions")
    assert len(times) == len(bounded) == 240
    assert bounded[-1] == waiting[-1] == 0
    assert bounded.max() < waiting.max()
    runs, waits = beside_plain_dask.run_requests("partitions")
    assert len(waits) == 6
    kinds = {run.kind for run in runs if run.worker == "GPU"}
    assert kinds == {"answer"}
