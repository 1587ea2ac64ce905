"""Toy files: triangles, and the option that lifts them."""

import pytest

from lidarpool import LidarError
from lidarpool.scenario.build import build
from lidarpool.scenario.scenario import Scenario
from lidarpool.scenario.schema import scenario_schema
from lidarsim.scene.scene import Scene


def test_a_toy_is_lifted(tmp_path):
    (tmp_path / "a.toy").write_text("0 0 0\n1 0 0\n0 1 0\n")
    assert Scene.load(tmp_path / "a.toy", lift_m=2.0).vertices[:, 2].tolist() == [2, 2, 2]
    data = {"scene": [{"file": "a.toy", "lift_m": 3}], "poses": [[0, 0, 1]]}
    assert build(Scenario.from_data(data, folder=tmp_path)).scene.vertices[:, 2].max() == 3
    data["scene"][0]["lift_m"] = 10
    with pytest.raises(LidarError, match=r"scene.files\[0\].lift_m is 10; it must be at most 9"):
        Scenario.from_data(data)
    data["scene"] = [{"file": "a.obj", "lift_m": 1}]
    with pytest.raises(LidarError, match=r"has no lift_m, an option of \.toy: leave out lift_m"):
        Scenario.from_data(data)
    assert scenario_schema()["$defs"]["MeshFile"]["properties"]["lift_m"]["maximum"] == 9
