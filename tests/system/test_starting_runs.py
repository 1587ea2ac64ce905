"""Runs whose workers die in the moment in which they are asked what they can do."""

import os
import signal
import threading
from collections.abc import Callable

import dask
import pytest
from distributed import Client
from tests.clusters import import_jobqueue

import lidarpool.run.cluster.checks
import poolpart.deploy.clusters
from lidarpool import LidarError, ScanFrame, Scene, Sensor, Survey, simulate
from lidarpool.run.cluster.checks import common_backend
from lidarpool.run.pipeline.casting_workers import CastingWorkers
from lidarpool.run.pipeline.stage_names import GPU, LIDAR
from poolpart import Pool
from poolpart.deploy import start_partitions
from poolpart.workers import worker_identities

SURVEY = Survey(Sensor.grid(rays_per_revolution=180, layers=16, step_deg=10), [(0, 0, 1)], steps=36)


@pytest.fixture
def break_off(client: Client):
    """Have a casting worker break off the n-th question from now on, once."""

    def break_off(number: int) -> None:
        def arm(dask_worker):
            answer = dask_worker.handlers["run"]
            left = [number]

            async def run(comm, **question):
                left[0] -= 1
                if left[0] > 0:
                    return await answer(comm=comm, **question)
                dask_worker.handlers["run"] = answer
                comm.abort()
                return "dont-reply"

            dask_worker.handlers["run"] = run

        workers = worker_identities(client)
        address = next(a for a, worker in workers.items() if "GPU" in worker["resources"])
        client.run(arm, workers=[address])

    return break_off


@pytest.mark.parametrize(
    "question",
    [1, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 3))],  # version, machine, backends
)
def test_a_run_starts_without_a_worker_that_breaks_off(client, break_off, question):
    break_off(question)
    result = simulate(Scene.seed(), SURVEY, client=client, backend="numpy")
    assert result.hit_count > 0


@pytest.fixture
def lose_gpu(monkeypatch) -> Callable[[Callable[[], object]], None]:
    """Do something, once, when the casting workers are about to be asked for their backends."""

    def lose_gpu(act: Callable[[], object]) -> None:
        acts = [act]

        def ask(*arguments):
            if acts:
                acts.pop()()
            return common_backend(*arguments)

        monkeypatch.setattr(lidarpool.run.cluster.checks, "common_backend", ask)

    return lose_gpu


@pytest.mark.extended
def test_workers_that_die_when_a_run_starts_are_waited_for(client, lose_gpu):
    def kill_all() -> None:
        for worker in Pool.from_client(client).partitions()["GPU"].workers:
            pid = client.run(os.getpid, workers=[worker.address])[worker.address]
            os.kill(pid, signal.SIGKILL)

    lose_gpu(kill_all)
    result = simulate(Scene.seed(), SURVEY, client=client, backend="numpy")
    assert result.hit_count > 0


@pytest.mark.slow
def test_a_worker_that_stops_when_it_has_prepared_itself_is_done_without(client, monkeypatch):
    """Its answer cannot be had for longer than Dask's own calls wait for one."""
    stopped: list[int] = []
    ready: list[str] = []  # the first has the scene, so that it need not ask the second for it
    take = CastingWorkers._take  # private: the step after an answer, at which the fault must strike

    def stop_and_take(workers: CastingWorkers, address: str, *answer: object) -> None:
        ready.append(address)
        if len(ready) == 2:
            stopped.append(client.run(os.getpid, workers=[address])[address])
            os.kill(stopped[0], signal.SIGSTOP)
        take(workers, address, *answer)

    def go_on(frame: ScanFrame) -> None:
        os.kill(stopped[0], signal.SIGCONT)

    monkeypatch.setattr(CastingWorkers, "_take", stop_and_take)
    try:
        assert simulate(Scene.seed(), SURVEY, client=client, on_frame=go_on).hit_count > 0
    finally:
        os.kill(stopped[0], signal.SIGCONT)


@pytest.mark.slow
def test_what_a_starting_run_waits_for_and_what_not(outside, lose_gpu):
    """Workers that come late, and not a scheduler that is gone."""
    soon = "2s"  # for others to notice what is lost
    cluster = outside(DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT=soon)
    cluster.add(("LIDAR", 4))
    cluster.wait()
    with (
        dask.config.set({"distributed.comm.timeouts.connect": soon}),
        Client(cluster.address, set_as_default=False) as client,
    ):

        def run(**options: float) -> int:
            return simulate(
                Scene.seed(), SURVEY, client=client, backend="numpy", **options
            ).hit_count

        comes = threading.Timer(0.5, cluster.add, [("GPU", 1)])
        comes.start()
        assert run(startup_timeout_s=300) > 0
        comes.join()
        lose_gpu(lambda: cluster.kill("scheduler"))
        with pytest.raises(LidarError, match=f"{cluster.address} is no longer reachable"):
            run()


@pytest.mark.slow
def test_jobs_that_die_before_their_workers_connect_end_a_run(monkeypatch, tmp_path):
    jobs = import_jobqueue().slurm.SLURMJob
    submitted = []

    async def submit(job: object, path: str) -> str:
        submitted.append(path)
        (tmp_path / "gpu-1.err").write_text("no module named lidarpool\n")
        return "Submitted batch job 1"

    async def close(job: object, number: str, command: str) -> None: ...

    monkeypatch.setattr(jobs, "_submit_job", submit)
    monkeypatch.setattr(jobs, "_close_job", close)
    monkeypatch.setattr(poolpart.deploy.clusters, "CHECK_EVERY_S", 0.1)
    options = {"host": "127.0.0.1", "port": 0, "dashboard_address": "127.0.0.1:0"}
    told: list[str] = []
    with import_jobqueue().SLURMCluster(
        cores=1, memory="1GB", log_directory=str(tmp_path), scheduler_options=options
    ) as cluster:
        kinds = {GPU: {"adapt": [0, 1]}, LIDAR: {"adapt": [0, 1], "slots": 4}}
        start_partitions(cluster, kinds, told.append)
        with Client(cluster) as client, pytest.raises(LidarError) as caught:
            simulate(Scene.seed(), SURVEY, client=client, startup_timeout_s=5.0)
    assert len(submitted) == 2  # they may wait in the queue: no others in their place
    assert "has no workers" in str(caught.value)
    assert caught.value.__notes__ == [
        "2 jobs are in the queue or starting. If they are only waiting in the queue, increase "
        "`--startup-timeout`."
    ]
    assert told == [f"The last line of the log {tmp_path}/gpu-1.err is: no module named lidarpool"]
