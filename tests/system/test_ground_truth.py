"""Scene flow and the visibility of actors from a cluster, against one process."""

from __future__ import annotations

import pytest
from tests.lidarscenes.test_actor_visibility import MOUNT, SENSOR, records_of, street
from tests.lidarscenes.test_scene_flow import turning
from tests.shapes import made

from lidarpool import Mounted, Survey, read_cloud, simulate
from lidarsim.columns.table import FLOW, FLOW_EGO


@pytest.mark.extended
def test_a_cluster_gives_the_same_bytes_as_one_process(cluster_client, tmp_path):
    scene = street()
    survey = Survey(
        sensors=[Mounted(SENSOR, MOUNT)], trajectory=turning(2.0, 1.5), steps=10,
        columns=("time", *FLOW, *FLOW_EGO), actor_visibility=True,
    )  # fmt: skip
    result = simulate(scene, survey, client=cluster_client)
    expected = made(survey, scene)
    for name in (*FLOW, *FLOW_EGO):
        assert result.cloud[name].tobytes() == expected[name].tobytes(), name
    records = records_of(scene, survey)
    assert result.points.sweeps().actor_rays.tobytes() == records.tobytes()
    result.report(tmp_path / "out")
    saved = read_cloud(tmp_path / "out/cloud.ply")
    assert saved.sweeps().actor_rays.tobytes() == records.tobytes()
