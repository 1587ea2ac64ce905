"""A scanner and a run over a cluster: the same survey, the same bytes."""

import numpy as np
import pytest

from lidarpool import (
    Actor,
    Material,
    Noise,
    Returns,
    Scanner,
    Scene,
    Survey,
    Track,
    box,
    load_sensor,
    simulate,
)
from lidarsim.columns.table import OPTIONAL

OPTIONS = {
    "columns": [column.name for column in OPTIONAL if not column.name.startswith("flow")],
    "materials": [Material("Bowl", specular_reflectance=1), Material("*", 0.4, semantic_class=3)],
    "returns": Returns("dual", subrays=7, divergence_mrad=10),
    "noise": Noise(0.02, angle_deg=0.05, dropout=0.1, seed=5),
    "visibility_km": 2.0,
}
CAR = Actor(box("Car", (4.5, 1.8, 1.5)), Track([0, 1], [[-5, 3, 0], [5, 3, 0]]))


@pytest.mark.slow
def test_sweeps_of_a_moving_sensor_are_those_of_a_run(cluster_client, same_cloud):
    scene = Scene.seed().with_actors([CAR])
    sensor = load_sensor("velodyne/vlp16")
    track = Track([0, 0.5], [[-4, -1, 1], [4, -1, 1]])
    survey = Survey(sensor, trajectory=track, steps=72, **OPTIONS)
    cloud = simulate(scene, survey, client=cluster_client).cloud
    assert (cloud["object"] == 6).any() and (cloud["returns"] == 2).any()
    scanner = Scanner(scene, sensor, **OPTIONS)
    for number in range(2):
        rows = np.flatnonzero(cloud["scan"] // 36 == number)
        assert len(rows) > 500 and same_cloud(scanner.sweep(track, number=number), cloud[rows])
