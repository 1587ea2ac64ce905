"""Fields of points in files, recomputed from each other and from the drive that was simulated.

Files are read with programs that are not of this project.
"""

from __future__ import annotations

import json
import tarfile
from dataclasses import dataclass, replace
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import ClassVar

import laspy
import numpy as np
import pyarrow.parquet as pq
import pye57
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from pypcd4.pypcd4 import PointCloud
from tests.shapes import level, room

from lidarfiles import read_cloud, save_cloud
from lidarfiles.clouds.built_in_formats import FORMATS
from lidarfiles.clouds.format_table import load_format
from lidarfiles.clouds.ros.layouts import LAYOUTS
from lidarfiles.clouds.writing import ExportSpec, with_format_columns
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenes.procedural.city import city
from lidarsim import (
    Beams,
    Fault,
    LidarError,
    Material,
    Mounted,
    Pose,
    Returns,
    Scene,
    Survey,
    Track,
    load_sensor,
)
from lidarsim.columns.table import SCAN
from lidarsim.io.yamlfile import load_yaml
from lidarsim.sensor.beams import Mirror
from lidarsim.sensor.sensor import LineSensor
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.sweeps import SweepPoses, Sweeps

COLUMNS = (
    "time", "intensity", "reflectivity", "reflectance", "signal", "range", "azimuth", "elevation",
    "return_number", "returns", "ray", "class",
)  # fmt: skip
SCENE = city(4_000)
SIZES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
SPINNING = ("velodyne/vlp16", "hesai/xt32", "robosense/rs-lidar-16", "ouster/os1-32")


def drive() -> Track:
    """A drive of 1.5 s along a bend, 12 m/s and 0.8 rad/s, that nods and rolls."""
    times = np.linspace(0, 1.5, 31)
    yaw = 0.8 * times
    places = [15 * np.sin(yaw), 15 * (1 - np.cos(yaw)), 2 + 0.1 * np.sin(5 * times)]
    turns = [0.02 * np.sin(3 * times), 0.03 * np.cos(2 * times), np.sin(yaw / 2), np.cos(yaw / 2)]
    turns = np.stack(turns, axis=1)
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    return Track(times, np.stack(places, axis=1), turns, smooth=True)


def cloud_of(survey, scene=SCENE):
    rig = Rig(scene, survey, "tiles")
    part = columns_of(list(rig.cast(0, survey.scan_count)))
    cloud = part.cloud((SCAN, *survey.stored_columns[3:]), survey.precision_m, scene.origin)
    sweeps = Sweeps.from_survey(survey, scene)
    return replace(cloud, sweeps=lambda: sweeps)


@dataclass(frozen=True)
class Drive:
    """A survey with one sensor on a moving carrier, and its points in both frames."""

    model: str
    mode: str = "strongest"
    made: ClassVar[dict] = {}

    @property
    def survey(self) -> Survey:
        sensor = load_sensor(self.model, max_range_m=60)
        beam = {"subrays": 7, "divergence_mrad": 10.0} if self.mode in ("dual", "all") else {}
        return Survey(
            sensors=[Mounted(sensor, Pose((1.0, 0.2, 0.5), 20.0, 4.0), "lidar")],
            trajectory=drive(), steps=108, columns=COLUMNS, precision_m=1e-6,
            returns=Returns(self.mode, **beam),
        )  # fmt: skip

    def cloud(self, coordinates="world"):
        key = self, coordinates
        if key not in self.made:
            self.made[key] = cloud_of(replace(self.survey, coordinates=coordinates))
        return self.made[key]

    def fired(self):
        """Return the points of each sweep in the sensor's axes as simulated, and their columns."""
        cloud = self.cloud("sensor")
        return list(cloud.sweeps().points(cloud))


def rows_of(message):
    """Return the points of a PointCloud2 as rows of named fields."""
    row = np.dtype({
        "names": [field.name for field in message.fields],
        "formats": [SIZES[field.datatype] for field in message.fields],
        "offsets": [field.offset for field in message.fields],
        "itemsize": message.point_step,
    })  # fmt: skip
    return np.frombuffer(message.data, row)


def messages_of(path, topic="/lidar/points"):
    """Return the messages of a topic of an MCAP file, through Foxglove's reader."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [read for _, _, _, read in reader.iter_decoded_messages([topic])]


def xyz_of(rows):
    return np.stack([rows[axis] for axis in "xyz"], axis=1).astype(float)


@pytest.mark.extended
@pytest.mark.slow(every=3)
@pytest.mark.parametrize("model", SPINNING)
@pytest.mark.parametrize("layout", ["velodyne", "images", "autoware", "ouster"])
def test_bags_hold_what_a_driver_publishes(tmp_path, layout, model):
    made = Drive(model)
    save_cloud(made.cloud(), tmp_path / "a.mcap", layout=layout)
    sensor = made.survey.mounted_sensors[0].sensor
    begins = made.cloud().sweeps().begins_ns
    messages = messages_of(tmp_path / "a.mcap")
    assert len(messages) == len(begins) == 3
    for message, points, begin in zip(messages, made.fired(), begins, strict=True):
        rows = rows_of(message)
        np.testing.assert_allclose(xyz_of(rows), points.positions, atol=5e-5)
        name, unit_ns = {"autoware": ("time_stamp", 1), "ouster": ("t", 1)}.get(
            layout, ("time", 1e9)
        )
        np.testing.assert_allclose(rows[name] * unit_ns, points.time - begin, atol=10)
        if layout == "ouster":
            check_ouster(rows, sensor)
        elif layout == "autoware":
            check_autoware(rows, model)
        else:
            check_rings(rows["ring"], xyz_of(rows), sensor)


def check_rings(ring, xyz, sensor):
    """Ring 0 is the lowest beam, and each point lies on the cone of its beam."""
    elevation = sensor.beams.elevation[ring]
    assert (np.diff(sensor.beams.elevation) > 0).all()
    seen = np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))
    far = np.linalg.norm(xyz, axis=1) > 10
    np.testing.assert_allclose(seen[far], elevation[far], atol=0.01)


def check_autoware(rows, model):
    """As nebula's decoders: azimuths clockwise from x, of Hesai from y; distances from zero."""
    x, y, z = xyz_of(rows).T
    azimuth = rows["azimuth"].astype(float)
    elevation = rows["elevation"].astype(float)
    assert azimuth.min() >= 0 and azimuth.max() <= np.float32(2 * np.pi)
    level = rows["distance"] * np.cos(elevation)
    if model.startswith("hesai"):
        expected = level * np.sin(azimuth), level * np.cos(azimuth)
    elif model.startswith("ouster"):
        expected = -level * np.cos(azimuth), level * np.sin(azimuth)
    else:
        expected = level * np.cos(azimuth), -level * np.sin(azimuth)
    np.testing.assert_allclose(expected, (x, y), atol=1e-4)
    np.testing.assert_allclose(rows["distance"] * np.sin(elevation), z, atol=1e-4)
    np.testing.assert_array_equal(rows["return_type"], 3)  # STRONGEST
    # Messages are in the order of firing: the head turns clockwise, all azimuths grow.
    turned = np.unwrap(azimuth[rows["channel"] == rows["channel"][0]])
    assert (np.diff(turned) > -1e-3).all()


def check_ouster(rows, sensor):
    """As of ouster_ros: row 0 is the top beam; ranges by the look-up table of the SDK.

    x = (r - n) cos(encoder + beam) cos(altitude) + n cos(encoder), and so y; z likewise, raised.
    """
    beams = sensor.beams
    beam = len(beams) - 1 - rows["ring"].astype(int)
    offset = 0.0
    height = 0.0
    if "ouster" in sensor.name.lower():
        offset = np.hypot(*beams.origin[0, :2])
        height = beams.origin[0, 2]
    x, y, z = xyz_of(rows).T
    slant = rows["range"] / 1000 - offset
    if not beams.origin.any() or offset:
        level = slant * np.cos(beams.elevation[beam])
        expected = level**2 + offset**2 + 2 * level * offset * np.cos(beams.azimuth[beam])
        np.testing.assert_allclose(np.hypot(x, y), np.sqrt(expected), atol=1e-3)
        np.testing.assert_allclose(z, slant * np.sin(beams.elevation[beam]) + height, atol=1e-3)
    assert z[rows["ring"] == 0].mean() > z[rows["ring"] == rows["ring"].max()].mean()


@pytest.mark.parametrize(
    ("layout", "step", "fields"),
    [
        ("velodyne", 18, "x y z intensity ring"),
        ("autoware", 16, "x y z intensity return_type channel"),
        ("ouster", 48, "x y z intensity reflectivity ring ambient range"),
    ],
)
def test_compensated_points_are_at_the_start_of_the_sweep_without_times(
    tmp_path, layout, step, fields
):
    made = Drive("velodyne/vlp16")
    cloud = made.cloud()
    save_cloud(cloud, tmp_path / "a.mcap", layout=layout, compensated=True)
    sweeps = cloud.sweeps()
    for sweep, message in enumerate(messages_of(tmp_path / "a.mcap")):
        rows = rows_of(message)
        assert (message.point_step, " ".join(rows.dtype.names)) == (step, fields)
        points = cloud[(cloud.scan >= 36 * sweep) & (cloud.scan < 36 * sweep + 36)]
        start = made.survey.pose(36 * sweep)
        inside = (points.positions - start.position) @ start.rotation
        np.testing.assert_allclose(xyz_of(rows), inside, atol=5e-5)
    assert sweeps.coordinates == "world"


@pytest.mark.parametrize("compensated", [False, True])
def test_pcd_and_bags_say_which_frame_their_points_have(tmp_path, compensated):
    made = Drive("velodyne/vlp16")
    words = "sensor frame at the " + ("start of the sweep" if compensated else "time of firing")
    save_cloud(made.cloud(), tmp_path / "bag", format="rosbag2", compensated=compensated)
    written = load_yaml((tmp_path / "bag/metadata.yaml").read_text())
    assert words in written["rosbag2_bagfile_information"]["custom_data"]["lidarpool"]
    save_cloud(made.cloud(), tmp_path / "pcd", format="pcd", compensated=compensated)
    for sweep, fired in enumerate(made.fired()):
        path = tmp_path / f"pcd/{sweep:06}.pcd"
        assert words in path.read_bytes()[:200].decode(errors="replace")
        file = PointCloud.from_path(path)
        assert ("time" in file.fields) is not compensated
        positions = file.numpy(("x", "y", "z"))
        alike = np.allclose(positions, fired.positions, atol=5e-5)
        assert alike is not compensated
        if not compensated:
            since = (fired.time - made.cloud().sweeps().begins_ns[sweep]) / 1e9
            np.testing.assert_allclose(file.numpy(("time",))[:, 0], since, atol=1e-8)


@pytest.mark.extended
@pytest.mark.parametrize("coordinates", ["world", "sensor"])
def test_ply_and_parquet_say_which_frame_their_points_have(tmp_path, coordinates):
    cloud = Drive("velodyne/vlp16").cloud(coordinates)
    save_cloud(cloud, tmp_path / "cloud.ply", precision_m=1e-6)
    head = (tmp_path / "cloud.ply").read_bytes().split(b"end_header")[0]
    assert (b"comment points in the sensor frame at the time of firing" in head) == (
        coordinates == "sensor"
    )
    assert len(read_cloud(tmp_path / "cloud.ply")) == len(cloud)
    save_cloud(cloud, tmp_path / "cloud.parquet")
    metadata = pq.read_schema(tmp_path / "cloud.parquet/part-00000.parquet").metadata
    assert metadata[b"coordinates"].decode() == coordinates


@pytest.mark.extended
@pytest.mark.parametrize("coordinates", ["world", "sensor"])
def test_samples_for_training_are_in_the_sensors_axes_and_say_so(tmp_path, coordinates):
    """Their pose takes compensated points to the world, whatever the frame of the cloud."""
    made = Drive("velodyne/vlp16")
    world = made.cloud()
    cloud = made.cloud(coordinates)
    words = "start of the sweep" if coordinates == "world" else "time of firing"
    save_cloud(cloud, tmp_path / "tars", format="webdataset")
    save_cloud(cloud, tmp_path / "images", format="images")
    (shard,) = (tmp_path / "tars").rglob("*.tar")
    with tarfile.open(shard) as tar:
        files = {member.name: tar.extractfile(member).read() for member in tar}
    for sweep, points in enumerate(world.sweeps().points(world)):
        said = json.loads(files[f"lidar-{sweep:06}.json"])["frame"]
        arrays = {
            name: np.load(BytesIO(files[f"lidar-{sweep:06}.{name}.npy"]))
            for name in ("points", "pose")
        }
        with np.load(tmp_path / f"images/lidar/{sweep:06}.npz") as image:
            assert str(image["frame"]) == said
            returned = np.isfinite(image["range"].T)
            placed = np.stack([image[axis].T[returned] for axis in "xyz"], axis=1)
            np.testing.assert_array_equal(image["pose"], arrays["pose"])
        np.testing.assert_array_equal(placed, arrays["points"])
        assert f"sensor frame at the {words}" in said
        pose = arrays["pose"]
        in_world = placed @ pose[:3, :3].T + pose[:3, 3]
        alike = np.allclose(in_world, points.positions, atol=5e-5)
        assert alike is (coordinates == "world")


@pytest.mark.parametrize("format_name", ["pcd", "mcap"])
def test_compensated_files_are_said_to_lack_time(tmp_path, format_name):
    cloud = Drive("velodyne/vlp16").cloud()
    lost = save_cloud(cloud, tmp_path / "a", format=format_name, compensated=True)
    assert "time" in lost
    assert "time" not in save_cloud(cloud, tmp_path / "b", format=format_name)


def test_a_clock_that_jumps_and_a_frozen_sensor_do_not_move_points():
    faults = [Fault("frozen", 0.12, 0.22), Fault("time_jump", 0.05, 0.26, by_s=-0.04)]
    survey = replace(Drive("velodyne/vlp16").survey, faults=faults)
    world = cloud_of(survey)
    sensor = cloud_of(replace(survey, coordinates="sensor"))
    sweeps = world.sweeps()
    pairs = zip(sweeps.points(world), sensor.sweeps().points(sensor), strict=True)
    for sweep, (points, fired) in enumerate(pairs):
        np.testing.assert_allclose(sweeps.as_fired(sweep, points), fired.positions, atol=5e-5)
        back = sensor.sweeps().compensate_motion(sweep, fired)
        np.testing.assert_allclose(back, sweeps.compensate_motion(sweep, points), atol=5e-5)


def test_autoware_has_the_types_of_two_returns(tmp_path):
    made = Drive("velodyne/vlp16", "dual")
    save_cloud(made.cloud(), tmp_path / "a.mcap", layout="autoware")
    rows = np.concatenate([rows_of(message) for message in messages_of(tmp_path / "a.mcap")])
    types = dict(zip(*np.unique(rows["return_type"], return_counts=True), strict=True))
    # IDENTICAL; FIRST_WEAK and LAST_STRONGEST, FIRST_STRONGEST and LAST_WEAK are pairs.
    assert set(types) == {4, 5, 6, 9, 10}
    assert types[4] == types[10] and types[9] == types[5]
    alone = made.cloud().returns == 1
    np.testing.assert_array_equal(rows["return_type"] == 6, alone)
    first = np.flatnonzero(np.isin(rows["return_type"], (4, 9)))
    assert (rows["distance"][first] < rows["distance"][first + 1]).all()
    light = made.cloud().intensity
    strong = rows["return_type"][first] == 9
    np.testing.assert_array_equal(light[first] > light[first + 1], strong)


def test_autoware_has_the_types_of_all_returns(tmp_path):
    cloud = Drive("velodyne/vlp16", "all").cloud()
    assert cloud.returns.max() > 2
    save_cloud(cloud, tmp_path / "a.mcap", layout="autoware")
    rows = np.concatenate([rows_of(message) for message in messages_of(tmp_path / "a.mcap")])
    expected = []
    for number, count in zip(cloud.return_number, cloud.returns, strict=True):
        if count == 1:
            expected.append(6)  # IDENTICAL
        elif number == count:
            expected.append(1)  # LAST
        else:
            expected.append({1: 2, 2: 7}.get(number, 0))  # FIRST, SECOND, UNKNOWN
    assert {1, 2, 7} <= set(expected)
    np.testing.assert_array_equal(rows["return_type"], expected)


@pytest.mark.parametrize(("mode", "kind"), [("strongest", 3), ("first", 2), ("last", 1)])
def test_autoware_has_the_type_of_a_single_return(tmp_path, mode, kind):
    save_cloud(Drive("velodyne/vlp16", mode).cloud(), tmp_path / "a.mcap", layout="autoware")
    for message in messages_of(tmp_path / "a.mcap"):
        np.testing.assert_array_equal(rows_of(message)["return_type"], kind)


def test_kitti_has_reflectivity_from_0_to_1_at_every_range(tmp_path):
    survey = Survey(load_sensor("velodyne/vlp16"), poses=[(2, 1, 0)], steps=36, columns=COLUMNS)
    cloud = cloud_of(survey, room())
    assert cloud.intensity.max() > 1 and np.ptp(cloud.range) > 4  # energy, near the sensor
    save_cloud(cloud, tmp_path / "kitti", format="kitti")
    for sweep, points in enumerate(cloud.sweeps().points(cloud)):
        path = tmp_path / f"kitti/sequences/00/velodyne/{sweep:06}.bin"
        light = np.fromfile(path, "<f4").reshape(-1, 4)[:, 3]
        assert light.min() >= 0 and light.max() <= 1
        # Velodyne's scale: 100 of 255 is a white surface at right angles, at any range.
        dark = points.reflectance < 0.9
        np.testing.assert_allclose(light[dark], points.reflectance[dark] * 100 / 255, atol=0.003)


@pytest.mark.parametrize("name", ["kitti", "nuscenes", "e57"])
@pytest.mark.parametrize("coordinates", ["world", "sensor"])
def test_compensated_formats_are_so_whatever_the_clouds_frame(tmp_path, name, coordinates):
    made = Drive("velodyne/vlp16")
    world = made.cloud()
    cloud = made.cloud(coordinates)
    save_cloud(cloud, tmp_path / "out", format=name)
    for sweep, points in enumerate(world.sweeps().points(world)):
        start = made.survey.pose(36 * sweep)
        inside = (points.positions - start.position) @ start.rotation
        if name == "kitti":
            path = tmp_path / f"out/sequences/00/velodyne/{sweep:06}.bin"
            placed = np.fromfile(path, "<f4").reshape(-1, 4)[:, :3]
        elif name == "nuscenes":
            (path,) = (tmp_path / "out").glob(f"samples/LIDAR_TOP/{sweep:06}.pcd.bin")
            placed = np.fromfile(path, "<f4").reshape(-1, 5)[:, :3]
        else:
            with pye57.E57(str(tmp_path / "out")) as file:
                raw = file.read_scan_raw(sweep, ignore_unsupported_fields=True)
                name = f"sweep {sweep + 1}, motion compensated"
                assert file.get_header(sweep)["name"].value() == name
            placed = np.stack([raw[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
        np.testing.assert_allclose(placed, inside, atol=5e-5)


@pytest.mark.parametrize(
    ("poses", "turns", "names"),
    [
        (2, 1, ["station 1", "station 2"]),
        (2, 2, [f"station {k}, sweep {n}" for k in (1, 2) for n in (1, 2)]),
        (1, 1, ["station 1"]),
        (1, 2, ["station 1, sweep 1", "station 1, sweep 2"]),
    ],
)
def test_scans_of_an_e57_are_named_by_their_stations(tmp_path, poses, turns, names):
    sensor = load_sensor("velodyne/vlp16")
    survey = Survey(sensor, [(k, 0, 2) for k in range(poses)], steps=36 * turns)
    save_cloud(cloud_of(survey, room()), tmp_path / "out.e57")
    with pye57.E57(str(tmp_path / "out.e57")) as file:
        found = [file.get_header(k)["name"].value() for k in range(file.scan_count)]
    assert found == names


def test_what_contradicts_a_frame_is_noted():
    assert ExportSpec("kitti").frame_notes("world") == []
    assert ExportSpec("mcap").frame_notes("sensor") == []
    for one in (ExportSpec("laz"), ExportSpec("kitti"), ExportSpec("mcap", compensated=True)):
        (note,) = one.frame_notes("sensor")
        assert "cloud.coordinates" in note
    with pytest.raises(LidarError, match="kitti does not support `compensated`"):
        ExportSpec("kitti", compensated=True)


# -- normals and origins of rays -------------------------------------------------------------------

SURFACES = (
    "normal_x", "normal_y", "normal_z", "incidence_deg", "origin_x", "origin_y", "origin_z",
)  # fmt: skip
HALF_ROOM_M = np.array([5.0, 4.0, 3.0])


@cache
def cloud_of_room(model, coordinates):
    """Return a survey of 3 sweeps and its cloud.

    The sensor crosses a room at 6 m/s, turns at 2 rad/s, nods and rolls.
    """
    times = np.linspace(0, 0.5, 26)
    yaw = 2 * times
    places = [6 * times - 1.5, 1.5 * np.sin(yaw), 0.2 * np.sin(9 * times)]
    turns = [0.05 * np.sin(7 * times), 0.06 * np.cos(5 * times), np.sin(yaw / 2), np.cos(yaw / 2)]
    turns = np.stack(turns, axis=1)
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    sensor = load_sensor(model, min_range_m=0.1)
    survey = Survey(
        sensors=[Mounted(sensor, Pose((0.6, 0.2, 0.3), 30.0, 8.0), "lidar")],
        trajectory=Track(times, np.stack(places, axis=1), turns, smooth=True), steps=108,
        columns=(*COLUMNS, *SURFACES), precision_m=1e-6, coordinates=coordinates,
    )  # fmt: skip
    return survey, cloud_of(survey, room())


def sweeps_in_file(path, format_name):
    """Return the fields of the points of each sweep, {name: (n,)}."""
    if format_name == "pcd":
        files = [PointCloud.from_path(file) for file in sorted(path.iterdir())]
        return [{name: file.numpy((name,))[:, 0] for name in file.fields} for file in files]
    return [
        {name: rows[name] for name in rows.dtype.names} for rows in map(rows_of, messages_of(path))
    ]


def vectors_of(fields, prefix=""):
    return np.stack([fields[f"{prefix}{axis}"] for axis in "xyz"], axis=1).astype(float)


@pytest.mark.slow
@pytest.mark.slow(every=3)
@pytest.mark.parametrize("coordinates", ["world", "sensor"])
@pytest.mark.parametrize("compensated", [False, True])
@pytest.mark.parametrize("format_name", ["pcd", "mcap"])
@pytest.mark.parametrize("model", ["velodyne/vlp16", "ouster/os1-32"])
def test_normals_and_origins_are_in_the_axes_of_the_points(
    tmp_path, model, format_name, compensated, coordinates
):
    survey, cloud = cloud_of_room(model, coordinates)
    path = tmp_path / "out"
    lost = save_cloud(cloud, path, format=format_name, compensated=compensated)
    assert not {*lost} & {*SURFACES}
    sweeps = sweeps_in_file(path, format_name)
    assert len(sweeps) == 3
    for sweep, fields in enumerate(sweeps):
        points = cloud[(cloud.scan >= 36 * sweep) & (cloud.scan < 36 * sweep + 36)]
        place, origin, normal = (vectors_of(fields, of) for of in ("", "origin_", "normal_"))
        ray = place - origin
        np.testing.assert_allclose(np.linalg.norm(ray, axis=1), points.range, atol=5e-5)
        cosine = -(ray * normal).sum(axis=1) / points.range
        np.testing.assert_allclose(cosine, np.cos(np.radians(points.incidence_deg)), atol=5e-5)
        for row in range(0, len(points), 211):
            fired = survey.path.pose(0, float(points.time[row])).compose(
                survey.mounted_sensors[0].mount
            )
            pose = survey.pose(36 * sweep) if compensated else fired
            # In the world normals are those of the sides of the room, on which the points lie.
            upright = pose.rotation @ normal[row]
            side = np.rint(upright)
            np.testing.assert_allclose(upright, side, atol=2e-5)
            on_side = pose.rotation @ place[row] + pose.position
            assert abs(on_side @ side + HALF_ROOM_M @ np.abs(side)) < 1e-4
            # Rays begin within the sensor: Ouster's 16 mm from the axis of its head.
            began = pose.rotation @ origin[row] + pose.position
            lever = (began - fired.position) @ fired.rotation
            beams = survey.mounted_sensors[0].sensor.beams
            assert (
                abs(np.hypot(*lever[:2]) - np.hypot(*beams.origin[points.channel[row], :2])) < 5e-5
            )


# -- LAS ---------------------------------------------------------------------------------------

AIRBORNE = {
    "sine": LineSensor(Beams.even(1, 1.0), Mirror(600, 36.0, 40.0, motion="sine", width_deg=28.0)),
    "polygon": LineSensor(
        Beams.even(1, 1.0), Mirror(300, 36.0, 50.0, motion="sawtooth", width_deg=28.0, duty=0.6)
    ),
}
GROUND = Scene.from_meshes([level("ground", 0, 3_000)])


def flight(duration_s=7.0) -> Track:
    """Two lines, there and back, 500 m high, 60 m/s, with 8° of roll and 3° of pitch."""
    times = np.linspace(0, duration_s, 141)
    half = duration_s / 2
    turned = np.clip((times - half + 1.5) / 3, 0, 1) * np.pi
    speeds = 60 * np.stack([np.cos(turned), np.sin(turned), 0 * turned], axis=1)
    places = np.cumsum(speeds, axis=0) * (times[1] - times[0]) + (0, 0, 500)
    roll = np.radians(8 * np.sin(2 * times))
    pitch = np.radians(3 * np.cos(times))
    quaternions = [
        product(product(about(2, yaw), about(1, down)), about(0, lean))
        for yaw, down, lean in zip(turned, pitch, roll, strict=True)
    ]
    return Track(times, places, quaternions, smooth=True)


def about(axis, angle):
    out = np.zeros(4)
    out[axis] = np.sin(angle / 2)
    out[3] = np.cos(angle / 2)
    return out


def product(a, b):
    vector = a[3] * b[:3] + b[3] * a[:3] + np.cross(a[:3], b[:3])
    return np.append(vector, a[3] * b[3] - a[:3] @ b[:3])


def flown(head, carried=None, **options):
    """Return a survey of two flight lines, and its points."""
    mounts = carried or [Mounted(AIRBORNE[head], Pose((0.5, 0, 0)), "scanner")]
    survey = Survey(
        sensors=mounts, trajectory=flight(), precision_m=1e-4,
        columns=("time", "azimuth", "ray", "return_number", "returns"), **options,
    )  # fmt: skip
    return survey, cloud_of(survey, GROUND)


@cache
def flown_alone(head):
    """Return a survey of two flight lines by one scanner, and its points."""
    return flown(head)


def read_las(cloud, path):
    save_cloud(cloud, path)
    return laspy.read(path)


def across_deg(survey, positions, time_ns):
    """Return angles from nadir across the direction of flight, negative to the left."""
    path = survey.path
    places, turns = path.poses(0, time_ns.astype(float))
    velocities, _ = path.velocities(0, time_ns.astype(float))
    rays = positions - (places + turns @ np.array(survey.mounted_sensors[0].mount.position))
    ahead = velocities * (1, 1, 0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    right = np.cross(ahead, (0, 0, 1))
    return np.degrees(np.arctan2((rays * right).sum(axis=1), -rays[:, 2]))


@pytest.mark.extended(every=4)
@pytest.mark.parametrize("head", AIRBORNE)
@pytest.mark.parametrize("coordinates", ["world", "sensor"])
def test_scan_angles_are_from_nadir_across_the_flight_with_roll(tmp_path, head, coordinates):
    survey, cloud = flown_alone(head)
    exact = read_las(cloud, tmp_path / "a.laz")
    time = np.asarray(exact["time"])
    angles = across_deg(survey, np.asarray(exact.xyz), time)
    if coordinates == "sensor":
        fired = cloud_of(replace(survey, coordinates="sensor"), GROUND)
        exact = read_las(fired, tmp_path / "b.laz")
    scan_angle = exact.scan_angle * 0.006
    np.testing.assert_allclose(scan_angle, angles, atol=0.1)
    assert 20 < np.abs(scan_angle).max() < 24  # 14 of the mirror and 8 of roll
    np.testing.assert_array_equal(exact["azimuth"], cloud.azimuth)
    (frame,) = (vlr for vlr in exact.header.vlrs if vlr.record_id == 3)
    assert ("world" if coordinates == "world" else "time of firing") in str(frame.record_data)


@pytest.mark.extended
@pytest.mark.parametrize("chunk", [700, 1_000_000])
@pytest.mark.parametrize(("head", "lines_s"), [("sine", 80), ("polygon", 50)])
def test_lines_of_mirrors_have_directions_and_ends(tmp_path, monkeypatch, head, lines_s, chunk):
    _, cloud = flown_alone(head)
    chunks = type(cloud).chunks
    monkeypatch.setattr(type(cloud), "chunks", lambda self, *_: chunks(self, chunk))
    las = read_las(cloud, tmp_path / "a.laz")
    time = np.asarray(las["time"])
    line = np.floor((time + 1) * lines_s / 1e9).astype(int)
    ends = np.append(np.flatnonzero(np.diff(line)), len(line) - 1)
    np.testing.assert_array_equal(np.flatnonzero(las.edge_of_flight_line), ends)
    # Along a line, in the mirror's own angles: the carrier rolls by less than it sweeps.
    steps = np.diff(las.scan_angle.astype(int))
    within = (np.diff(line) == 0) & (np.abs(steps) > 20)
    np.testing.assert_array_equal(las.scan_direction_flag[:-1][within], steps[within] > 0)
    shares = np.bincount(las.scan_direction_flag, minlength=2) / len(las)
    if head == "sine":
        assert shares.min() > 0.45
    else:
        assert shares[0] == 1  # all lines of this polygon run from right to left


@pytest.mark.extended
def test_flight_lines_and_sensors_are_sources(tmp_path):
    _, cloud = flown_alone("sine")
    las = read_las(cloud, tmp_path / "a.laz")
    time = np.asarray(las["time"])
    assert set(las.point_source_id) == {1, 2}
    turned = time[np.argmax(las.point_source_id == 2)] / 1e9
    assert 4.8 < turned < 5.1  # where the turn ends
    assert (np.diff(las.point_source_id.astype(int)) >= 0).all()
    back = Mounted(AIRBORNE["sine"], Pose((0, 0, 0), 180.0), "back")
    _, cloud = flown("sine", [Mounted(AIRBORNE["polygon"], name="front"), back])
    las = read_las(cloud, tmp_path / "b.laz")
    assert set(las.point_source_id) == {1, 2, 3, 4}
    np.testing.assert_array_equal(las.scanner_channel, cloud.sensor)
    # A scanner with an entry for each flight line is one scanner.
    entries = [Mounted(AIRBORNE["sine"], Pose((0.5, 0, 0)), name) for name in ("1", "2")]
    _, cloud = flown("sine", entries)
    las = read_las(cloud, tmp_path / "c.laz")
    assert set(cloud.sensor) == {0, 1} and set(las.scanner_channel) == {0}
    of_back = las[las.sensor == 1]
    assert set(of_back.point_source_id) == {2, 4}
    # Its x axis points backwards, and still the left is negative and directions are as they say.
    time = np.asarray(of_back["time"])
    steps = np.diff(of_back.scan_angle.astype(int))
    within = (np.diff(np.floor((time + 1) * 80 / 1e9)) == 0) & (np.abs(steps) > 20)
    np.testing.assert_array_equal(of_back.scan_direction_flag[:-1][within], steps[within] > 0)


def test_stations_are_sources(tmp_path):
    poses = [
        (0, 0, 2),
        (
            5,
            0,
            2,
        ),
        (9, 3, 2),
    ]
    survey = Survey(load_sensor("velodyne/vlp16"), poses, steps=40, columns=("time",))
    cloud = cloud_of(survey)
    las = read_las(cloud, tmp_path / "a.laz")
    np.testing.assert_array_equal(las.point_source_id, cloud.scan // 40 + 1)
    # From straight down, about the sensor's x axis: a point straight to the left is at -90°.
    offsets = np.asarray(las.xyz) - np.array(poses)[cloud.scan // 40]
    angles = np.degrees(np.arctan2(-offsets[:, 1], -offsets[:, 2]))
    np.testing.assert_allclose(las.scan_angle * 0.006, angles, atol=0.01)
    assert not np.any(las.edge_of_flight_line) and not np.any(las.scan_direction_flag)


# -- formats in the frame of the cloud ----------------------------------------------------------


def test_parquet_and_ply_are_in_the_world_and_their_columns_fit(tmp_path):
    """Positions from the pose at each time, range and angles; and back from every file."""
    made = Drive("velodyne/vlp16")
    cloud = made.cloud()
    save_cloud(cloud, tmp_path / "cloud.ply", precision_m=1e-6)
    save_cloud(cloud, tmp_path / "cloud.parquet")
    table = pq.read_table(tmp_path / "cloud.parquet")
    assert table.schema.metadata[b"coordinates"] == b"world"
    columns = {name: table[name].to_numpy() for name in table.column_names}
    azimuth = np.radians(columns["azimuth"])
    elevation = np.radians(columns["elevation"])
    rays = [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation),
            np.sin(elevation)]  # fmt: skip
    inside = np.stack(rays, axis=1) * columns["range"][:, None]
    inside += made.survey.mounted_sensors[0].sensor.beams.origin[
        columns["ring"]
    ]  # on the head's axis
    places, turns = made.survey.path.poses(0, columns["time"].astype(float))
    mount = made.survey.mounted_sensors[0].mount
    placed = inside @ mount.rotation.T + mount.position
    expected = np.einsum("nij,nj->ni", turns, placed) + places
    np.testing.assert_allclose(np.stack([columns[a] for a in "xyz"], axis=1), expected, atol=2e-4)
    np.testing.assert_allclose(read_cloud(tmp_path / "cloud.ply").positions, expected, atol=2e-4)
    np.testing.assert_allclose(
        columns["signal"], np.minimum(np.rint(columns["intensity"] * 10_000), 65_535), atol=1
    )
    white = (10 / np.maximum(columns["range"], 1e-9)) ** 2
    np.testing.assert_allclose(columns["reflectance"] * white, columns["intensity"], rtol=2e-3)


@pytest.mark.extended
@pytest.mark.parametrize(("scanners", "channel"), [(4, 3), (5, 0)])
def test_the_fifth_scanner_has_no_channel(tmp_path, scanners, channel):
    _, cloud = flown_alone("sine")
    sweeps = cloud.sweeps()
    sides = np.tile([0.0, 0, 0, 1], (scanners, 1))
    many = replace(
        sweeps,
        mounts=SweepPoses(np.arange(3.0 * scanners).reshape(-1, 3), sides),
        lidars=sweeps.lidars * scanners,
        sensors=tuple("abcde"[:scanners]),
        sensor=np.full_like(sweeps.sensor, 3),
    )
    las = read_las(replace(cloud, sweeps=lambda: many), tmp_path / "a.laz")
    assert set(las.scanner_channel) == {channel}


def field_rows():
    """Rows of the table of fields: format, field, source, and what a file has without it."""
    described = {}
    for name in FORMATS:
        described.setdefault(load_format(name).fields, []).append(f"`{name}`")
    for name, layout in LAYOUTS.items():
        described.setdefault(layout.point_fields, []).append(f"layout `{name}`")
    for fields, names in described.items():
        for field in fields:
            source = ", ".join(f"`{name}`" for name in field.columns) or field.source
            source += ", if classes have names" * field.if_named + ", on request" * field.on_request
            missing = field.missing or ("refused" if field.columns else "always known")
            yield [", ".join(names), field.name, source, missing]


def test_the_table_of_fields_is_that_of_the_formats():
    page = (Path(__file__).parents[2] / "docs/how-to/formats.md").read_text("utf-8")
    section = page.partition("## Fields and columns\n")[2].partition("\n## ")[0]
    table = [line.strip("| ").split(" | ") for line in section.splitlines() if line[:1] == "|"]
    rows = [*field_rows()]
    assert table[2:] == rows, "\n".join(f"| {' | '.join(row)} |" for row in rows)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("ply", ""),
        ("parquet", ""),
        ("las", "intensity return_number returns time [class]"),
        ("laz", "intensity return_number returns time [class]"),
        ("e57", "intensity return_number returns time ray"),
        ("pcd", "intensity time"),
        ("kitti", "reflectivity class"),
        ("nuscenes", "intensity"),
        ("webdataset", "intensity class"),
        ("images", "ray range"),
        ("osi", "intensity reflectance"),
        ("mcap", "intensity time"),
        ("rrd", "intensity"),
        ("pcap", "ray range reflectivity"),
    ],
)
def test_a_run_computes_the_columns_of_its_formats(name, expected):
    data = {"scene": "seed", "poses": [[0, 0, 1]], "output": {"write": [name]}}
    data["sensor"] = {"model": "velodyne/vlp16"}

    def computed(**fields):
        survey = prepare(Scenario.from_data(data | fields)).survey
        return {column.name for column in survey.stored_columns[5:]}

    always = {word for word in expected.split() if word[0] != "["}
    assert computed() == always
    classed = [{"objects": "*", "class": 4}]
    assert computed(materials=classed) == {word.strip("[]") for word in expected.split()}
    named = computed(materials=classed, classes={4: "thing"})  # names bring the column
    assert named == always | {"class"}
    assert computed(cloud={"columns": ["range"]}) == always | {"range"}


def posts(mode, columns=(), formats=("las", "e57")):
    """A cloud of posts before a wall, with the columns that formats bring, as a run has them."""
    beam = {"subrays": 7, "divergence_mrad": 10.0}
    survey = Survey(
        load_sensor("velodyne/vlp16"), poses=[(2, 1, 0)], steps=72, columns=columns,
        returns=Returns(mode, **beam), materials=[Material("*", semantic_class=7)],
    )  # fmt: skip
    survey = with_format_columns(survey, [ExportSpec(name) for name in formats])
    return survey, cloud_of(survey)


def test_las_and_e57_have_times_returns_and_intensities_without_being_asked(tmp_path):
    survey, cloud = posts("dual")
    sweeps = cloud.sweeps()
    assert set(cloud.returns) == {1, 2}
    las = read_las(cloud, tmp_path / "a.las")
    np.testing.assert_array_equal(las.return_number, cloud.return_number)
    np.testing.assert_array_equal(las.number_of_returns, cloud.returns)
    np.testing.assert_allclose(las.gps_time, cloud.time / 1e9, atol=1e-9)
    np.testing.assert_array_equal(las.classification, 7)
    assert np.corrcoef(las.intensity, np.minimum(cloud.intensity, las.energy.max()))[0, 1] > 0.9
    assert set(las.scanner_channel) == {0}
    save_cloud(cloud, tmp_path / "a.e57")
    names = ("returnIndex", "returnCount", "timeStamp", "rowIndex", "columnIndex")
    with pye57.E57(str(tmp_path / "a.e57")) as file:
        for sweep, points in enumerate(sweeps.points(cloud)):
            header = file.get_header(sweep)
            found = {}
            buffers = pye57.libe57.VectorSourceDestBuffer()
            for name in names:
                found[name] = np.zeros(len(points))
                buffer = (file.image_file, name, found[name], len(points), True, True)
                buffers.append(pye57.libe57.SourceDestBuffer(*buffer))
            header.points.reader(buffers).read()
            np.testing.assert_array_equal(found["returnIndex"] + 1, points.return_number)
            np.testing.assert_array_equal(found["returnCount"], points.returns)
            begin_s = header["acquisitionStart"]["dateTimeValue"].value()
            np.testing.assert_allclose(begin_s + found["timeStamp"], points.time / 1e9, atol=1e-9)
            np.testing.assert_array_equal(found["rowIndex"], points.channel)
            firing = (points.time - sweeps.begins_ns[sweep]) // 55_296  # of the data sheet
            np.testing.assert_array_equal(found["columnIndex"], firing)
            limits = header["indexBounds"]
            assert limits["returnMaximum"].value() == 1 and limits["rowMaximum"].value() == 15
            assert limits["columnMaximum"].value() == firing.max() > 800
    for name in ("las", "e57"):
        assert not ExportSpec(name).describe_empty_fields(cloud, sweeps, survey)


def test_what_las_and_e57_do_not_know_is_zero_or_left_out_and_noted(tmp_path):
    survey, cloud = posts("dual", formats=())
    las = read_las(cloud, tmp_path / "a.las")
    for name in ("return_number", "number_of_returns", "gps_time", "intensity", "classification"):
        assert not np.asarray(las[name]).any(), name
    save_cloud(cloud, tmp_path / "a.e57")
    with pye57.E57(str(tmp_path / "a.e57")) as file:
        header = file.get_header(0)
        assert header.point_fields == ["cartesianX", "cartesianY", "cartesianZ"]
        assert not header.node.isDefined("indexBounds")
    notes = ExportSpec("las").notes(cloud, cloud.sweeps())
    unknown = "intensity, return number, number of returns, classification and GPS time"
    columns = "intensity, return_number, returns, class or time"
    again = "Run the survey again with `output: {write: [las]}`"
    assert notes == [
        f"LAS stores 0 as {unknown}, because the cloud has no columns {columns}. {again}"
    ]
    classless = replace(survey, materials=[])
    (note,) = ExportSpec("las").notes(cloud, cloud.sweeps(), (), classless)
    assert "GPS time" in note and "class" not in note
    lost, note = ExportSpec("e57").notes(cloud, cloud.sweeps(), ())
    assert lost == "E57 cannot store object"
    assert note.startswith(
        "E57 omits intensity, returnIndex, returnCount, timeStamp, rowIndex and columnIndex, "
        "because the cloud has no columns intensity, return_number, returns, time or ray. "
    )


@pytest.mark.parametrize("mode", ["strongest", "first", "last"])
def test_the_return_mode_tells_single_returns(tmp_path, mode):
    _, cloud = posts(mode, columns=["returns"], formats=())
    assert set(cloud.returns) == {1}
    bare = replace(cloud, columns={k: v for k, v in cloud.columns.items() if k != "returns"})
    las = read_las(bare, tmp_path / "a.las")
    assert set(las.return_number) == set(las.number_of_returns) == {1}
    notes = ExportSpec("las").notes(bare, bare.sweeps())
    assert notes and not any("return" in note.partition(" Run ")[0] for note in notes)
