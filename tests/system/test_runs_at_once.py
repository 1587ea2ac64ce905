"""Several runs at once on a cluster that has slots for one."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from distributed import Client

from lidarpool import Frame, LidarpoolError, Result, Scene, Sensor, Survey, simulate
from lidarpool.progress import Progress
from poolpart import Claim

SURVEY = Survey(Sensor(rays_per_revolution=180, layers=4, step_deg=5), [(0, 0, 1)], steps=72)


def test_they_run_one_after_the_other(cluster, left_over):
    """If each had some of the slots, all would wait for each other for ever."""
    results: list[Result] = []
    waited: set[str] = set()

    refused = threading.Event()

    def told(progress: Progress) -> None:
        waited.add(progress.waits_for)
        if progress.waits_for:
            refused.set()

    def hold(_: Frame) -> None:
        """Do not end before another has found the slots taken."""
        assert refused.wait(120)

    def run(go: threading.Barrier) -> None:
        with Client(cluster, set_as_default=False) as client:
            go.wait()
            results.append(
                simulate(
                    Scene.seed(), SURVEY, client=client, backend="numpy",
                    on_frame=hold, on_progress=told,
                )
            )  # fmt: skip

    for _ in range(3):
        go = threading.Barrier(3)
        threads = [threading.Thread(target=run, args=[go], daemon=True) for _ in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(120)
            assert not thread.is_alive(), "it waits for slots"
    assert len(results) == 9
    assert all(np.array_equal(results[0].hit_counts, other.hit_counts) for other in results)
    assert waited == {"", "LIDAR"}
    assert any("until other runs had left it 4 slots" in n for r in results for n in r.notes)
    with Client(cluster, set_as_default=False) as client:
        assert left_over(client) == ([], [], [])
        assert not client.run_on_scheduler(claims)


def claims(dask_scheduler=None) -> bool:
    return "poolpart-claims" in dask_scheduler.plugins


def test_slots_that_others_do_not_hold_are_not_waited_for_forever(cluster, monkeypatch, left_over):
    monkeypatch.setattr(
        "lidarpool.scan.stage_tasks.claim_slots", lambda *_: Claim(False, {"tcp://here": 0}, 3)
    )
    monkeypatch.setattr("lidarpool.watch.PATIENCE_S", 0.5)
    with Client(cluster, set_as_default=False) as client:
        with pytest.raises(
            LidarpoolError, match=r"'LIDAR' has had 3 of the 4 slots needed for 0 s: start another"
        ):
            simulate(Scene.seed(), SURVEY, client=client, backend="numpy")
        assert left_over(client) == ([], [], [])
