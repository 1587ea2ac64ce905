"""Runs whose workers die in the moment in which they are asked what they can do."""

from __future__ import annotations

import dask
import pytest
from distributed import Client

from lidarpool import LidarpoolError, Scene, Sensor, Survey, simulate
from lidarpool.checks import common_backend
from poolpart import Pool, worker_identities

SURVEY = Survey(Sensor(rays_per_revolution=180, layers=16, step_deg=10), [(0, 0, 1)], steps=36)


@pytest.fixture
def break_off(client: Client):
    """Have a casting worker break off the n-th question from now on, once."""

    def break_off(number: int) -> str:
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
        return address

    return break_off


def test_a_worker_that_does_not_answer_is_not_in_the_pool(client, break_off):
    address = break_off(1)
    pool = Pool.from_client(client)
    everybody = worker_identities(client)
    assert {worker.address for worker in pool} == everybody.keys() - {address}


@pytest.mark.parametrize("question", [1, 2, 3], ids=["version", "machine", "backends"])
def test_a_run_starts_without_a_worker_that_breaks_off(client, break_off, question):
    break_off(question)
    result = simulate(Scene.seed(), SURVEY, client=client, backend="numpy")
    assert result.hits > 0


def test_a_cluster_that_is_lost_before_the_run_has_begun_is_named(outside, monkeypatch):
    cluster = outside()
    cluster.add("GPU")
    cluster.add("LIDAR", slots=4)
    cluster.wait()

    def lose(client, *rest):
        cluster.kill("scheduler")
        return common_backend(client, *rest)

    monkeypatch.setattr("lidarpool.run.common_backend", lose)
    lost = pytest.raises(LidarpoolError, match=f"{cluster.address} cannot be reached any more")
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "2s"}),
        Client(cluster.address, set_as_default=False) as client,
        lost,
    ):
        simulate(Scene.seed(), SURVEY, client=client, backend="numpy")
