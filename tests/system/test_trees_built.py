"""Each casting worker builds its tree once, whatever Dask's memory manager drops meanwhile."""

from lidarpool import Scene, Sensor, Survey, simulate
from poolpart import worker_identities


def _count_builds(dask_worker=None) -> None:
    from lidarpool.base.tracing import trace_to  # these functions travel by value

    dask_worker.builds = builds = []
    trace_to(lambda point, fields: builds.append(point) if point == "intersect.built" else None)


def _builds(dask_worker=None) -> int:
    from lidarpool.base.tracing import trace_to

    trace_to(None)
    return len(dask_worker.builds)


def test_a_tree_for_each_casting_worker(client):
    assert client.amm.running()
    casting = [a for a, w in worker_identities(client).items()
               if w["resources"].get("GPU")]  # fmt: skip

    def look(frame) -> None:
        if frame.scan == 10:
            client.amm.run_once()

    client.run(_count_builds, workers=casting)
    survey = Survey(Sensor.grid(), [(0, 0, 1), (0, 0, 2)])
    result = simulate(Scene.seed(), survey, client=client, on_frame=look)
    assert client.run(_builds, workers=casting) == dict.fromkeys(casting, 1)
    assert len(casting) == 2 and result.hits > 0
