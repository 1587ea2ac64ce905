"""Runs with all columns and all that comes back of a pulse: the same bytes, whatever dies."""

import os
import signal
from dataclasses import replace

import numpy as np
import pytest

from lidarpool import (
    Material,
    Mounted,
    Noise,
    Pose,
    Returns,
    ScanFrame,
    Scene,
    Sensor,
    Survey,
    Track,
    simulate,
)
from lidarsim.columns.table import TABLE
from poolpart.workers import worker_identities

OPTIONAL = [name for name in TABLE if name not in ("scan", "x", "y", "z", "channel", "object")]
SURVEY = Survey(
    Sensor.grid(rays_per_revolution=360, layers=40, step_deg=1, max_range_m=60),
    [(0, 0, 1), (1, 0, 2)],
    steps=180,
    keep_every=1,
    columns=OPTIONAL,
    materials=[
        Material("Bowl", specular_reflectance=1),
        Material(["V*", "S*"], 0.1, transparent="pass"),
        Material("*", 0.4, semantic_class=300),
    ],
    returns=Returns("dual", subrays=7, divergence_mrad=20, pulse_ns=2),
    noise=Noise(0.02, 0.001, 0.05, dropout=0.1, detection_range_m=80, seed=5),
    visibility_km=2,
)
_GRID = Sensor.grid(rays_per_revolution=720, layers=20, step_deg=2, max_range_m=60)
_WAY = Track([0, 1, 2], [[0, 0, 1], [2, 0, 1.5], [2, 2, 2]], smooth=True)
EVERY_EFFECT = Survey(
    sensors=[
        Mounted(_GRID, name="one"),
        Mounted(
            replace(_GRID, beams=replace(_GRID.beams, time_ns=np.full(20, 50.0))),
            Pose((0, 0, 0.05)),
            "two",
            noise=Noise(detection_range_m=30, crosstalk=True, seed=9),
        ),
    ],
    trajectory=_WAY,
    steps=120,
    keep_every=1,
    columns=OPTIONAL,
    materials=[
        Material("Bowl", 0.5, retro=True, specular_reflectance=0.3),
        Material("Sphere", 0.1, transparent="pass", refractive_index=1.33, attenuation_per_m=0.1),
        Material("Vase", 0.5, leaf_area_density=0.5),
        Material("*", 0.4, semantic_class=300),
    ],
    returns=Returns(
        "all",
        subrays=7,
        divergence_mrad=(20, 10),
        pulse_ns=2,
        beam_profile="gaussian",
        exit_diameter_m=0.01,
        waveform="gaussian",
        sample_ns=0.5,
    ),
    noise=Noise(
        0.02,
        0.001,
        0.05,
        dropout=0.1,
        detection_range_m=60,
        seed=5,
        range_at_threshold_m=0.05,
        walk_m=0.02,
        false_alarm_hz=2e4,
        stray_light=1e-4,
        crosstalk=True,
        velocity_m_s=0.05,
    ),
    visibility_km=0.5,
    fog_lidar_ratio_sr=65,
    rain_mm_h=20,
    snow_mm_h=1,
    dust_mg_m3=20,
    wet=0.5,
    waveform_samples=32,
)


@pytest.mark.slow
@pytest.mark.parametrize(
    "survey",
    [SURVEY, pytest.param(EVERY_EFFECT, marks=pytest.mark.slow)],
    ids=["returns", "every effect"],
)
def test_another_cluster_other_batches_and_a_killed_worker_give_the_same_bytes(
    survey, client, cluster_client, small_batches, same_cloud
):
    """Threads and one caster; processes and two, of which one is killed."""
    killed: list[int] = []

    def kill(frame: ScanFrame) -> None:
        if frame.scan == 50:
            workers = worker_identities(client).items()
            gpu = [address for address, worker in workers if "GPU" in worker["resources"]]
            killed.append(client.run(os.getpid, workers=gpu[:1])[gpu[0]])
            os.kill(killed[0], signal.SIGKILL)

    cloud = simulate(Scene.seed(), survey, client=cluster_client).cloud
    assert cloud.columns.keys() >= {*OPTIONAL}
    assert {*cloud["returns"].tolist()} >= {1, 2}
    assert {*cloud["class"].tolist()} == {0, 300}
    causes = {*cloud["cause"].tolist()}
    assert causes == ({0, 5} if survey is SURVEY else {0, 1, 2, 3, 4, 5})
    other = simulate(Scene.seed(), survey, client=client, on_frame=kill)
    assert killed and same_cloud(other.cloud, cloud)
