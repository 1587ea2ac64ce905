"""A scanner and a run over a cluster: the same survey, the same bytes."""

import numpy as np

from lidarpool import (
    Actor,
    Material,
    Noise,
    Pose,
    Returns,
    Scanner,
    Scene,
    Survey,
    Track,
    load_sensor,
    simulate,
)
from lidarpool.columns.table import OPTIONAL
from lidarpool.scenario.build import build
from lidarpool.scenario.scenario import Scenario
from lidarpool.scene.actors import box

OPTIONS = {
    "columns": [column.name for column in OPTIONAL],
    "materials": [Material("*", 0.4, semantic_class=3), Material("Bowl", transparent="mirror")],
    "returns": Returns("dual", subrays=7, divergence_mrad=10),
    "noise": Noise(0.02, angle_deg=0.05, dropout=0.1, seed=5),
    "visibility_km": 2.0,
}
CAR = Actor(box("Car", (4.5, 1.8, 1.5)), Track([0, 1], [[-5, 3, 0], [5, 3, 0]]))


def test_sweeps_of_a_moving_sensor_are_those_of_a_run(cluster_client, same_cloud):
    scene = Scene.seed().with_actors([CAR])
    sensor, track = load_sensor("velodyne/vlp16"), Track([0, 0.5], [[-4, -1, 1], [4, -1, 1]])
    survey = Survey(sensor, trajectory=track, steps=72, **OPTIONS)
    cloud = simulate(scene, survey, client=cluster_client).cloud
    assert (cloud["object"] == 6).any() and (cloud["returns"] == 2).any()
    scanner = Scanner(scene, sensor, **OPTIONS)
    for number in range(2):
        rows = np.flatnonzero(cloud["scan"] // 36 == number)
        assert len(rows) > 500 and same_cloud(scanner.sweep(track, number=number), cloud.part(rows))


def test_copies_of_a_scenario_are_those_of_a_run(cluster_client, same_cloud):
    """Made once by the driver, and moved in a scanner to where another scenario has one."""
    crate = {"name": "Crate", "box": [1, 1, 1], "scatter": {"count": 200, "scale": [0.5, 2]}}
    bin_ = {"name": "Bin", "box": [1, 2, 1], "at": [{"position": [3, 4, 0], "yaw_deg": 30}]}
    data = {
        "scene": {"ground": {}, "copies": [crate | {"class": 4}, bin_]},
        "sensor": {"model": "velodyne/vlp16"},
        "poses": [[0, 0, 2.5]],
        "steps": 36,
        "cloud": {"columns": ["range", "class", "intensity", "triangle"], "keep_every": 1},
    }
    data["scene"]["copies"][0]["scatter"] |= {"within": [-20, -20, 20, 20]}
    built = build(Scenario.from_data(data))
    scene, survey = built.scene, built.survey
    cloud = simulate(scene, survey, client=cluster_client).cloud
    assert len({*cloud["object"].tolist()}) > 50 and {*cloud["class"].tolist()} == {0, 4}
    bin_["at"][0]["position"] = [9, 9, 0]
    options = {"columns": survey.columns, "materials": survey.materials}
    scanner = Scanner(build(Scenario.from_data(data)).scene, survey.sensor, **options)
    assert not same_cloud(scanner.sweep((0, 0, 2.5)), cloud)
    scanner.move("Bin", Pose((3, 4, 0), 30))
    assert same_cloud(scanner.sweep((0, 0, 2.5)), cloud)
