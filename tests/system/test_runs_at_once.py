"""Several runs at once on a cluster that has slots for one."""

from __future__ import annotations

import threading

import pytest
from distributed import Client

from lidarpool import Frame, LidarpoolError, Result, Scene, Sensor, Survey, simulate
from lidarpool.run.progress import Progress
from poolpart import Pool

SURVEY = Survey(Sensor.grid(rays_per_revolution=180, layers=4, step_deg=5), [(0, 0, 1)], steps=72)


def test_they_run_one_after_the_other(cluster, left_over, same_cloud):
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

    go = threading.Barrier(3)
    threads = [threading.Thread(target=run, args=[go], daemon=True) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
        assert not thread.is_alive(), "it waits for slots"
    assert len(results) == 3
    assert all(same_cloud(results[0].cloud, other.cloud) for other in results)
    assert waited == {"", "LIDAR"}
    assert any("until other runs had left it 4 slots" in n for r in results for n in r.notes)
    with Client(cluster, set_as_default=False) as client:
        assert left_over(client) == ([], [], [])


def test_slots_that_are_gone_are_not_waited_for_forever(cluster, monkeypatch, left_over):
    """They were there when the run was checked."""
    monkeypatch.setattr(Pool, "require", lambda *_: None)
    with Client(cluster, set_as_default=False) as client:
        with pytest.raises(
            LidarpoolError, match=r"'LIDAR' has had 4 of the 7 slots needed for 0 s: start another"
        ):
            simulate(Scene.seed(), SURVEY, client=client, collectors=5, patience_s=0.5)
        assert left_over(client) == ([], [], [])
