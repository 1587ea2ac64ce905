"""The format pcap: a file of packets for each sensor, written completely or not at all."""

from __future__ import annotations

import struct
import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tests.shapes import room

from lidarfiles import save_cloud
from lidarfiles.clouds.writing import ExportSpec, with_format_columns
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarsim import Cloud, LidarError, Mounted, Pose, Scene, Sensor, Survey, load_sensor
from lidarsim.columns.table import SCAN, TABLE
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.sweeps import Sweeps

COLUMNS = ("ray", "range", "reflectivity")


@cache
def two_sensors():
    """Return the cloud and the sweeps of a VLP-16 and a VLP-32C in a room, of a revolution."""
    survey = Survey(
        sensors=[
            Mounted(load_sensor("vlp16"), name="roof"),
            Mounted(load_sensor("vlp32c"), Pose((1, 0, 0)), "front left"),
        ],
        poses=[Pose((0, 0, 0))], steps=36, columns=COLUMNS, keep_every=1,
    )  # fmt: skip
    rig = Rig(room(), survey, "tiles")
    part = columns_of(list(rig.cast(0, survey.scan_count)))
    cloud = part.cloud((SCAN, *survey.stored_columns[3:]), survey.precision_m, np.zeros(3))
    sweeps = Sweeps.from_survey(survey, Scene.seed())
    return replace(cloud, sweeps=lambda: sweeps), sweeps


def ports_of(path):
    """Return the numbers of frames of a pcap file by port, {port: frames}."""
    content = path.read_bytes()
    counts = {}
    offset = 24
    while offset < len(content):
        (size,) = struct.unpack_from("<I", content, offset + 8)
        (port,) = struct.unpack_from(">H", content, offset + 16 + 36)
        counts[port] = counts.get(port, 0) + 1
        offset += 16 + size
    return counts


def test_each_sensor_has_a_file_and_the_same_cloud_the_same_bytes(tmp_path):
    cloud, _ = two_sensors()
    for name in "ab":
        assert save_cloud(cloud, tmp_path / name, format="pcap") == ["object"]
    files = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert files == ["front_left.pcap", "roof.pcap"]
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    # 1,809 firings of 16 lasers, 24 of them in a packet, and of 32 lasers, 12 in a packet.
    assert ports_of(tmp_path / "a/roof.pcap") == {2368: 75, 8308: 5}
    assert ports_of(tmp_path / "a/front_left.pcap") == {2368: 150, 8308: 10}


def test_an_empty_cloud_has_packets_without_returns(tmp_path):
    _, sweeps = two_sensors()
    names = ("scan", "channel", "object", *COLUMNS)
    empty = Cloud(np.empty((0, 3)), {name: np.empty(0, TABLE[name].dtype) for name in names})
    ExportSpec("pcap").write(tmp_path / "packets", empty, sweeps)
    assert ports_of(tmp_path / "packets/roof.pcap") == {2368: 75, 8308: 5}


@pytest.mark.skipif(sys.platform == "win32", reason="has no limits of files")
def test_a_file_that_cannot_grow_is_one_line_and_leaves_nothing(tmp_path):
    import resource

    cloud, sweeps = two_sensors()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, before[1]))  # as a full disk does
    try:
        with pytest.raises(LidarError, match="cannot be written") as raised:
            ExportSpec("pcap").write(tmp_path / "packets", cloud, sweeps)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert "\n" not in str(raised.value) and not list(tmp_path.iterdir())


def test_what_cannot_be_packets_is_refused_before_a_file_is_written(tmp_path):
    cloud, sweeps = two_sensors()
    columns = {name: cloud[name] for name in ("scan", "channel", "object", "ray", "range")}
    lacking = Cloud(cloud.positions, columns)
    unknown = replace(sweeps, fired=None)
    grids = replace(sweeps.fired, sensors=(Sensor.grid(), Sensor.grid()))
    for points, of_survey, says in (
        (lacking, sweeps, "Packets require reflectivity, but the cloud does"),
        (cloud, unknown, r"all rays and returns of a survey. Run the survey with keep_every 1"),
        (cloud, replace(sweeps, fired=grids), r"has no packet format.* vlp16"),
    ):
        with pytest.raises(LidarError, match=says) as raised:
            ExportSpec("pcap").write(tmp_path / "packets", points, of_survey)
        assert len(str(raised.value).splitlines()) == 1 and not list(tmp_path.iterdir())


def scenario_of(**sections):
    return Scenario.model_validate(
        {"scene": "seed", "poses": [{"position": [0, 0, 1]}], "steps": 2, **sections}
    )


def test_a_scenario_that_writes_packets_keeps_what_they_hold():
    write = {"write": ["pcap"]}
    survey = prepare(scenario_of(sensor="velodyne/vlp16", output=write)).survey
    assert {"ray", "range", "reflectivity"} <= {column.name for column in survey.stored_columns}
    assert survey.keep_every == 1
    for sections, says in (
        ({}, r"Use one of these models: .*ot128, .* vls128"),
        (
            {"sensor": "velodyne/vlp16", "returns": {"mode": "first"}},
            r"not first. Set returns.mode",
        ),
    ):
        with pytest.raises(LidarError, match=says):
            prepare(scenario_of(output=write, **sections))
    assert with_format_columns(survey, [ExportSpec("parquet")]) is survey
