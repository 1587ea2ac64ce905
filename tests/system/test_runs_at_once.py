"""Several runs at once on a cluster that has slots for one."""

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
from distributed import Client, Queue
from tests.chaos.traces import scheduler_state, settled_differences
from tests.clusters import thread_cluster

from lidarpool import LidarError, Planning, Result, ScanFrame, Scene, Sensor, Survey, simulate
from lidarpool.run.pipeline.task_records import placement_violations
from lidarpool.run.progress import Progress
from poolpart import Pool

SURVEY = Survey(Sensor.grid(rays_per_revolution=180, layers=4, step_deg=5), [(0, 0, 1)], steps=72)


@pytest.mark.slow
def test_they_run_one_after_the_other(cluster, left_over, same_cloud):
    """If each had some of the slots, all would wait for each other for ever."""
    results: list[Result] = []
    waited: set[str] = set()
    refused = threading.Event()

    def told(progress: Progress) -> None:
        waited.add(progress.waits_for)
        if progress.waits_for:
            refused.set()

    def hold(_: ScanFrame) -> None:
        """Do not end before another has found the slots taken."""
        assert refused.wait(300)

    def run(go: threading.Barrier) -> None:
        with Client(cluster, set_as_default=False) as client:
            go.wait()
            results.append(
                simulate(
                    Scene.seed(), SURVEY, client=client,
                    on_frame=hold, on_progress=told,
                )
            )  # fmt: skip

    go = threading.Barrier(3)
    threads = [threading.Thread(target=run, args=[go], daemon=True) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(300)
        assert not thread.is_alive(), "it waits for slots"
    assert len(results) == 3
    assert all(same_cloud(results[0].cloud, other.cloud) for other in results)
    assert waited == {"", "LIDAR"}
    assert any("for other runs to release 4 slots" in n for r in results for n in r.notes)
    with Client(cluster, set_as_default=False) as client:
        assert left_over(client) == ([], [], [])


def test_slots_that_are_gone_are_not_waited_for_forever(cluster, monkeypatch, left_over):
    """They were there when the run was checked."""
    monkeypatch.setattr(Pool, "require", lambda *_: None)
    with Client(cluster, set_as_default=False) as client:
        with pytest.raises(
            LidarError,
            match=r"'LIDAR' has had 4 slots for 0 s, but the run needs 7\. Start another",
        ):
            simulate(Scene.seed(), SURVEY, client=client, collectors=5, worker_timeout_s=0.5)
        assert left_over(client) == ([], [], [])


@pytest.mark.slow
def test_two_surveys_and_a_foreign_user_do_not_see_each_other(same_cloud):
    """Of what a run has used nothing stays either, but what is the cluster's own."""
    planning = Planning((25, 25), (-30, -20), trials=3, particles=50, iterations=20)
    all_there = threading.Barrier(3)

    def run(survey: Survey) -> Result:
        met: list[int] = []

        def meet(_: ScanFrame) -> None:
            if not met:  # none is done before all have begun
                met.append(all_there.wait(300))

        with Client(address, set_as_default=False) as client:
            return simulate(Scene.seed(), survey, planning, client=client, on_frame=meet)

    def be_foreign() -> tuple[list[int], list[int]]:
        """Know nothing of partitions: an own client, own tasks, an own queue."""
        results = []
        taken = []
        with Client(address, set_as_default=False) as client:
            queue = Queue("foreign", client=client)
            for count in range(20):
                if count == 10:
                    all_there.wait(300)
                queue.put(count)
                results.append(client.submit(pow, count, 2, pure=False).result(300))
                taken.append(queue.get(timeout=300))
            queue.close()
        return results, taken

    surveys = [SURVEY, replace(SURVEY, keep_every=7)]
    slots = ({"GPU": 2}, {"LIDAR": 8}, {"OTHER": 1})
    with thread_cluster(*slots) as cluster, Client(cluster) as client:
        address = cluster.scheduler_address
        alone = [simulate(Scene.seed(), survey, planning, client=client) for survey in surveys]
        before = scheduler_state(client)
        with ThreadPoolExecutor() as pool:
            foreign = pool.submit(be_foreign)
            together = list(pool.map(run, surveys))
        assert foreign.result() == ([count**2 for count in range(20)], list(range(20)))
        assert settled_differences(client, before) == []
    for one, other in zip(together, alone, strict=True):
        assert same_cloud(one.cloud, other.cloud)
        assert (one.plan.path == other.plan.path).all()
        assert placement_violations(one.records) == []
        assert one.replayed == 0
