"""Runs with all columns and all that comes back of a pulse: the same bytes, whatever dies."""

from __future__ import annotations

import os
import signal

from lidarpool import Frame, Material, Noise, Returns, Scene, Sensor, Survey, load_sensor, simulate
from lidarpool.columns.table import TABLE
from poolpart import worker_identities

OPTIONAL = [name for name in TABLE if name not in ("scan", "x", "y", "z", "channel", "object")]
SURVEY = Survey(
    Sensor.grid(rays_per_revolution=360, layers=40, step_deg=1, max_range_m=60),
    [(0, 0, 1), (1, 0, 2)],
    steps=180,
    keep_every=1,
    columns=OPTIONAL,
    materials=[
        Material("*", 0.4, semantic_class=300),
        Material(["V*", "S*"], 0.1, transparent="pass"),
        Material("Bowl", transparent="mirror"),
    ],
    returns=Returns("dual", subrays=7, divergence_mrad=20, pulse_ns=2),
    noise=Noise(0.02, 0.001, 0.05, dropout=0.1, detection_range_m=80, seed=5),
    visibility_km=2,
)


def test_another_cluster_other_batches_and_a_killed_worker_give_the_same_bytes(
    client, cluster_client, small_batches, same_cloud
):
    """Threads and one caster; processes and two, of which one is killed."""
    killed: list[int] = []

    def kill(frame: Frame) -> None:
        if frame.scan == 50:
            workers = worker_identities(client).items()
            gpu = [address for address, worker in workers if "GPU" in worker["resources"]]
            killed.append(client.run(os.getpid, workers=gpu[:1])[gpu[0]])
            os.kill(killed[0], signal.SIGKILL)

    cloud = simulate(Scene.seed(), SURVEY, client=cluster_client).cloud
    assert cloud.columns.keys() >= {*OPTIONAL}
    assert set(cloud["returns"].tolist()) == {1, 2}
    assert set(cloud["class"].tolist()) == {0, 300}
    other = simulate(Scene.seed(), SURVEY, client=client, on_frame=kill)
    assert killed and same_cloud(other.cloud, cloud)


def test_a_sensor_says_how_finely_points_are_rounded():
    assert Survey(load_sensor("velodyne/vlp16"), [(0, 0, 1)]).precision_m == 0.002
    assert Survey(poses=[(0, 0, 1)]).precision_m == 0.01
