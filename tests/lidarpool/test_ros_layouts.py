"""Layouts of drivers of ROS 2 in bags, as the drivers publish them, and read back."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore
from tests.drives import points_of, the_scene, the_survey
from tests.shapes import room

from lidarfiles import save_cloud
from lidarfiles.clouds.built_in_formats import LAYOUTS
from lidarfiles.clouds.ros import layouts
from lidarfiles.clouds.ros.bags import header_of
from lidarfiles.clouds.ros.livox import CUSTOM_DEFINITION, CUSTOM_MSG
from lidarfiles.clouds.ros.organized import organized_rows
from lidarfiles.clouds.writing import ExportSpec
from lidarfiles.recordings.opening import open_recording
from lidarpool.cli.result_commands import export
from lidarsim import Cloud, LidarError, Mounted, Returns, Sensor, Survey, Track, load_sensor
from lidarsim.columns.bags import POINT_CLOUD, livox_columns, message_types, point_columns
from lidarsim.columns.table import COLORS, SCAN
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.sweeps import Sweeps

COLUMNS = ("ray", "range", "time", "intensity", "reflectivity", "signal", "return_number",
           "returns")  # fmt: skip
START_NS = 1_700_000_000_123_456_000  # on 14 November 2023
SCENE = room()
# Fields and step of a point in the sources of the drivers (master of each, November 2026), and the
# step of a point without time: PointField.datatype 2 uint8, 4 uint16, 6 uint32, 7 float32,
# 8 float64.
XYZ = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7)]
XYZI = [*XYZ, ("intensity", 12, 7)]
DRIVERS = {
    "velodyne": ([*XYZI, ("ring", 16, 4), ("time", 18, 7)], 22, 18),
    "images": ([*XYZI, ("ring", 16, 4), ("time", 18, 7)], 22, 18),
    "autoware": (
        [*XYZ, ("intensity", 12, 2), ("return_type", 13, 2), ("channel", 14, 4),
         ("azimuth", 16, 7), ("elevation", 20, 7), ("distance", 24, 7), ("time_stamp", 28, 6)],
        32, 16,
    ),
    "ouster": (
        [*XYZ, ("intensity", 16, 7), ("t", 20, 6), ("reflectivity", 24, 4), ("ring", 26, 4),
         ("ambient", 28, 4), ("range", 32, 6)],
        48, 48,
    ),
    "livox": ([*XYZI, ("tag", 16, 2), ("line", 17, 2), ("timestamp", 18, 8)], 26, 18),
    "hesai": ([*XYZI, ("ring", 16, 4), ("timestamp", 18, 8)], 26, 18),
    "robosense": ([*XYZI, ("ring", 16, 4), ("timestamp", 18, 8)], 26, 18),
}  # fmt: skip
TIMES = {"time": 1e9, "time_stamp": 1, "t": 1, "timestamp": 1e9}  # nanoseconds in a unit
# Further fields: (name, datatype, column), each of 4 bytes.
FURTHER = [("rgb", 7, ""), ("radial_velocity", 7, "radial_velocity"), ("label", 6, "class"),
           ("incidence_deg", 7, "incidence_deg"), ("material", 5, "material")]  # fmt: skip


@cache
def cast(model: str, mode: str = "strongest") -> Cloud:
    """Return the cloud of two sweeps of a sensor that moves through a room, with its sweeps."""
    sensor = load_sensor(model, max_range_m=5.5)  # some rays have no return
    survey = Survey(
        sensors=[Mounted(sensor, name="roof")],
        trajectory=Track([0, 1], [[0, 0, 0], [0.5, 0, 0]]),
        steps=sensor.steps_of_revolution(1).stop,
        columns=COLUMNS,
        returns=Returns(mode=mode, subrays=7, divergence_mrad=8.0),
        start=datetime(2023, 11, 14, 22, 13, 20, 123_456, UTC),
    )
    part = columns_of(list(Rig(SCENE, survey, "tiles").cast(0, survey.scan_count)))
    cloud = part.cloud((SCAN, *survey.stored_columns[3:]), survey.precision_m, SCENE.origin)
    sweeps = Sweeps.from_survey(survey, SCENE)
    return Cloud(cloud.positions, cloud.columns, sweeps=lambda: sweeps)


@cache
def types_of_messages() -> Typestore:
    """Return the types of messages, which `AnyReader` would parse again for each bag."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(CUSTOM_DEFINITION, CUSTOM_MSG))
    return store


def messages(path: Path, suffix: str) -> list[Any]:
    """Return the messages of the topics that end with `suffix`, by rosbags."""
    with Reader(path) as bag:
        topics = [topic for topic in bag.connections if topic.topic.endswith(suffix)]
        return [
            types_of_messages().deserialize_cdr(data, topic.msgtype)
            for topic, _, data in (bag.messages(topics) if topics else ())  # else those of all
        ]


def rows_of(message: Any) -> np.ndarray:
    """Return the points of a PointCloud2, (height, width)."""
    kinds = {2: "u1", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
    row = np.dtype({
        "names": [field.name for field in message.fields],
        "formats": [kinds[field.datatype] for field in message.fields],
        "offsets": [field.offset for field in message.fields],
        "itemsize": message.point_step,
    })  # fmt: skip
    return message.data.view(row).reshape(message.height, message.width)


def sweep_of(cloud: Cloud, sweep: int) -> Cloud:
    return list(cloud.sweeps().points(cloud))[sweep]


@cache
def driven() -> tuple[Survey, Cloud]:
    """Return a survey of two sensors on a vehicle that moves and turns, and random points of it."""
    scene = the_scene()
    start = datetime(2023, 11, 14, 22, 13, 20, 123_456, UTC)
    survey = replace(the_survey(), start=start, classes={3: "road"})
    sweeps = Sweeps.from_survey(survey, scene)
    points = points_of(scene, 0)
    rng = np.random.default_rng(2)
    count = len(points)
    columns = {
        **points.columns,
        "intensity": rng.uniform(0, 1.3, count).astype(np.float32),
        "range": rng.uniform(1, 100, count).astype(np.float32),
        "radial_velocity": rng.normal(0, 9, count).astype(np.float32),
        "incidence_deg": rng.uniform(0, 90, count).astype(np.float32),
        "material": rng.integers(-1, 9, count).astype(np.int32),
        **{name: rng.integers(0, 256, count).astype(np.uint8) for name in COLORS},
    }
    return survey, Cloud(points.positions, columns, sweeps=lambda: sweeps)


def in_the_sensor(survey: Survey, points: Cloud, sensor: int, times_ns: np.ndarray) -> np.ndarray:
    """Return points (n, 3) in the frame of a sensor at times (n,)."""
    places, turns = survey.path.poses(0, times_ns.astype(float))
    mount = survey.mounted_sensors[sensor].mount
    on_vehicle = np.einsum("nji,nj->ni", turns, points.positions - the_scene().origin - places)
    return (on_vehicle - mount.position) @ (np.eye(3) if mount.rotation is None else mount.rotation)


@pytest.mark.extended(every=2)
@pytest.mark.parametrize("compensated", [False, True])
@pytest.mark.parametrize("layout", DRIVERS)
def test_each_field_of_a_point_is_that_of_the_driver(layout, compensated, tmp_path):
    survey, cloud = driven()
    sweeps = cloud.sweeps()
    save_cloud(cloud, tmp_path / "c.mcap", layout=layout, compensated=compensated)
    fields, step, compensated_step = DRIVERS[layout]
    if compensated:
        names = {"autoware": {"azimuth", "elevation", "distance"}}.get(layout, set()) | {*TIMES}
        fields = [field for field in fields if field[0] not in names]
        step = compensated_step
    end = 36 if layout == "ouster" else step
    fields = fields + [(name, end + 4 * k, kind) for k, (name, kind, _) in enumerate(FURTHER)]
    found = messages(tmp_path / "c.mcap", "/points")
    assert len(found) == len(sweeps) == 6
    for sensor, name in enumerate(("front", "rear_left")):
        own = [message for message in found if message.header.frame_id == name]
        assert len(own) == 3
        for sweep, message in enumerate(own, 3 * sensor):
            assert [(f.name, f.offset, f.datatype) for f in message.fields] == fields
            assert all(field.count == 1 for field in message.fields)
            assert message.point_step == max(step, end + 20)
            assert (message.height, message.is_dense, message.is_bigendian) == (1, True, False)
            assert message.row_step == message.width * message.point_step
            begin_ns = 100_000_000 * (sweep % 3)
            stamp = message.header.stamp
            assert stamp.sec * 10**9 + stamp.nanosec == START_NS + begin_ns
            (rows,) = rows_of(message)
            points = sweep_of(cloud, sweep)
            times = np.full(len(points), begin_ns) if compensated else points.time
            inside = in_the_sensor(survey, points, sensor, times)
            check_row(rows, points, inside, layout)
            for name_of_time, unit_ns in TIMES.items() if not compensated else ():
                if name_of_time not in rows.dtype.names:
                    continue
                unit = 1 if layout == "livox" else unit_ns
                first = START_NS if name_of_time == "timestamp" else -begin_ns
                since = rows[name_of_time].astype(float) * unit - first
                np.testing.assert_allclose(since, points.time, atol=300)


def check_row(rows: np.ndarray, points: Cloud, inside: np.ndarray, layout: str) -> None:
    """Compare the fields besides time with the columns and positions of points."""
    placed = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(float)
    np.testing.assert_allclose(placed, inside, atol=3e-5)
    reversed_rings = layout in ("hesai", "ouster")
    ring = {"livox": "line", "autoware": "channel"}.get(layout, "ring")
    channels = 3 - points.channel.astype(int) if reversed_rings else points.channel
    np.testing.assert_array_equal(rows[ring], channels)
    energy = {"autoware": np.rint(255 * np.minimum(points.intensity, 1)), "ouster": points.signal}
    energy |= {"velodyne": points.intensity, "images": points.intensity}
    intensity = energy.get(layout, points.reflectivity)
    np.testing.assert_array_equal(rows["intensity"], intensity)
    names = rows.dtype.names
    if layout == "ouster":
        np.testing.assert_array_equal(rows["reflectivity"], points.reflectivity)
        np.testing.assert_array_equal(rows["range"], np.rint(1000 * points.range.astype(float)))
        assert not rows["ambient"].any()
    if layout == "livox":
        assert not rows["tag"].any()
    if layout == "autoware":
        assert (rows["return_type"] == 3).all()  # STRONGEST
    if "azimuth" in names and len(rows):
        x, y, z = inside.T
        clockwise = np.arctan2(-y, x)
        turn = (rows["azimuth"] - clockwise + np.pi) % (2 * np.pi) - np.pi
        assert np.abs(turn).max() < 1e-5, np.degrees(turn)[:5]
        assert rows["azimuth"].min() >= 0 and rows["azimuth"].max() <= np.float32(2 * np.pi)
        np.testing.assert_allclose(
            rows["elevation"], np.arcsin(z / np.hypot(np.hypot(x, y), z)), atol=1e-5
        )
        np.testing.assert_allclose(rows["distance"], np.linalg.norm(inside, axis=1), atol=3e-5)
    for name, _, column in FURTHER[1:]:
        np.testing.assert_array_equal(rows[name], points[column])
    packed = np.ascontiguousarray(rows["rgb"]).view("<u4")
    red, green, blue = (points[name].astype(np.uint32) for name in COLORS)
    np.testing.assert_array_equal(packed, red << 16 | green << 8 | blue)


@pytest.mark.parametrize(("layout", "field"), [("autoware", "time_stamp"), ("ouster", "t")])
def test_times_that_do_not_fit_in_32_bits_are_clipped(layout, field, tmp_path):
    """A sensor without rotation has sweeps of any length; noise may come before a sweep."""
    _, cloud = driven()
    times = cloud.time.copy()
    times[:3] = [-5, 4_294_967_295, 5_000_000_000]
    late = Cloud(cloud.positions, {**cloud.columns, "time": times}, sweeps=cloud.sweeps)
    save_cloud(late, tmp_path / "c.mcap", layout=layout)
    (rows,) = rows_of(messages(tmp_path / "c.mcap", "/points")[0])
    assert rows[field][:3].tolist() == [0, 2**32 - 1, 2**32 - 1]
    np.testing.assert_array_equal(rows[field][3:], sweep_of(cloud, 0).time[3:])


@pytest.mark.extended
def test_a_custom_message_of_livox_has_the_same_points(tmp_path):
    cloud = cast("livox/mid360")
    save_cloud(cloud, tmp_path / "c.mcap", layout="livox")
    clouds = messages(tmp_path / "c.mcap", "/roof/points")
    customs = messages(tmp_path / "c.mcap", "/roof/livox")
    assert len(clouds) == len(customs) == 2
    for sweep, (cloud_message, custom) in enumerate(zip(clouds, customs, strict=True)):
        (rows,) = rows_of(cloud_message)
        points = sweep_of(cloud, sweep)
        assert custom.point_num == len(custom.points) == len(rows) > 1000
        assert custom.timebase == START_NS + 100_000_000 * sweep
        assert (custom.lidar_id, custom.rsvd.tolist()) == (0, [0, 0, 0])
        for number in (0, 1, len(rows) - 1):
            point = custom.points[number]
            row = rows[number]
            assert (point.x, point.y, point.z) == (row["x"], row["y"], row["z"])
            assert (point.reflectivity, point.tag) == (row["intensity"], 0)
            assert point.line == row["line"]
            assert point.offset_time == points.time[number] - 100_000_000 * sweep


def test_foxglove_reads_the_custom_message(tmp_path):
    decoder = pytest.importorskip("mcap_ros2.decoder").DecoderFactory()
    cloud = cast("livox/mid360")
    save_cloud(cloud, tmp_path / "c.mcap", layout="livox")
    with (tmp_path / "c.mcap").open("rb") as file:
        reader = pytest.importorskip("mcap.reader").make_reader(file, decoder_factories=[decoder])
        _, _, _, custom = next(reader.iter_decoded_messages(topics="/roof/livox"))
    points = sweep_of(cloud, 0)
    assert [point.offset_time for point in custom.points] == points.time.tolist()
    assert [point.reflectivity for point in custom.points] == points.reflectivity.tolist()


def test_a_custom_message_without_points_or_in_pieces(tmp_path):
    cloud = cast("livox/mid360")
    save_cloud(cloud[:0], tmp_path / "c.mcap", layout="livox")
    with AnyReader([tmp_path / "c.mcap"]) as bag:
        (data, _) = (data for found, _, data in bag.messages() if found.topic == "/roof/livox")
    assert not len(livox_columns(data)["x"])
    with pytest.raises(ValueError, match=r"5 points were expected"):
        livox_columns(data[:-4] + b"\5\0\0\0")


def point_cloud(rows, fields):
    """Return a PointCloud2 of rows, with fields (name, offset, datatype, count)."""
    types = message_types().types
    stamp = types["builtin_interfaces/msg/Time"](0, 0)
    field = types["sensor_msgs/msg/PointField"]
    message = types[POINT_CLOUD](
        types["std_msgs/msg/Header"](stamp, "lidar"), 1, len(rows), [field(*f) for f in fields],
        False, rows.itemsize, rows.nbytes, rows.view(np.uint8).reshape(-1), True,
    )  # fmt: skip
    return bytes(message_types().serialize_cdr(message, POINT_CLOUD))


def test_fields_of_several_numbers_and_of_the_same_name():
    rows = np.zeros(2, [("xyz", "<f4", 3), ("n", "<f4", 3), ("a", "<u2"), ("b", "<u2")])
    rows["xyz"] = [[1, 2, 3], [4, 5, 6]]
    rows["n"] = [[7, 8, 9], [10, 11, 12]]
    rows["b"] = 5
    axes = [(axis, 4 * k, 7, 1) for k, axis in enumerate("xyz")]
    fields = [*axes, ("n", 12, 7, 3), ("ring", 24, 4, 1), ("ring", 26, 4, 1)]
    columns = point_columns(point_cloud(rows, fields))
    assert [*columns] == ["x", "y", "z", "n_0", "n_1", "n_2", "ring", "ring_2"]
    assert columns["z"].tolist() == [3, 6] and columns["n_1"].tolist() == [8, 11]
    assert columns["ring"].tolist() == [0, 0] and columns["ring_2"].tolist() == [5, 5]
    for datatype, count, numbers in (
        (7, 4_000_000_000, "4,000,000,000 numbers of 4 bytes starting at byte 12"),
        (7, 5, "5 numbers of 4 bytes starting at byte 12"),
        (8, 3, "3 numbers of 8 bytes starting at byte 12"),
    ):
        with pytest.raises(ValueError, match=f"'n' has {numbers}, but a point has only 28 bytes"):
            point_columns(point_cloud(rows, [*axes, ("n", 12, datatype, count)]))
    with pytest.raises(ValueError, match="'ring' has 1 number of 4 bytes starting at byte 26, but"):
        point_columns(point_cloud(rows, [*axes, ("ring", 26, 6, 1)]))
    whole = point_columns(point_cloud(rows, [*axes, ("n", 12, 8, 2)]))  # ends with the point
    assert [*whole] == ["x", "y", "z", "n_0", "n_1"] and whole["n_1"].dtype.itemsize == 8
    for datatype, count in ((0, 1), (9, 1), (7, 0)):
        says = f"its field 'n' has datatype {datatype} and count {count}, but a PointField has"
        with pytest.raises(ValueError, match=says):
            point_columns(point_cloud(rows, [*axes, ("n", 12, datatype, count)]))


@pytest.mark.parametrize(
    ("width", "row_step", "says"),
    [
        (1_000_000, 24, "a row of 1,000,000 points of 12 bytes is stated, but a row has only 24"),
        (2, 48, "its data have 24 bytes, but 1 rows of 48 bytes are stated"),
    ],
)
def test_the_size_of_a_message_is_that_of_its_data(width, row_step, says):
    rows = np.zeros((2, 3), np.float32).view([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])[:, 0]
    data = point_cloud(rows, [(axis, 4 * k, 7, 1) for k, axis in enumerate("xyz")])
    message = message_types().deserialize_cdr(data, POINT_CLOUD)
    stated = replace(message, width=width, row_step=row_step)
    with pytest.raises(ValueError, match=says):
        point_columns(bytes(message_types().serialize_cdr(stated, POINT_CLOUD)))


def test_stamps_before_1970_are_negative():
    data = bytearray(point_cloud(np.zeros(1, [("x", "<f4")]), [("x", 0, 7, 1)]))
    data[4:8] = (-5).to_bytes(4, "little", signed=True)
    assert header_of(bytes(data)) == (-5_000_000_000, "lidar")


@pytest.mark.extended
@pytest.mark.parametrize(
    ("layout", "model", "mode"),
    [
        ("velodyne", "velodyne/vlp16", "strongest"),
        ("images", "velodyne/vlp16", "dual"),
        ("robosense", "robosense/rs-lidar-16", "strongest"),
        ("ouster", "ouster/os1-32", "strongest"),
        ("ouster", "ouster/os1-32", "two_strongest"),
    ],
)
def test_organized_clouds_have_a_point_for_each_ray(layout, model, mode, tmp_path):
    cloud = cast(model, mode)
    save_cloud(cloud, tmp_path / "plain.mcap", layout=layout)
    save_cloud(cloud, tmp_path / "c.mcap", layout=layout, organized=True)
    planes = 2 if mode in ("dual", "two_strongest") else 1
    channels = load_sensor(model).channels
    clouds = messages(tmp_path / "c.mcap", "/points")
    plain = messages(tmp_path / "plain.mcap", "/points")
    further = messages(tmp_path / "c.mcap", "/points2")
    assert len(further) == (len(clouds) if layout == "ouster" and planes == 2 else 0)
    for sweep, message in enumerate(clouds):
        assert not message.is_dense and message.row_step == message.width * message.point_step
        rows = rows_of(message)
        if further:
            rows = np.concatenate([rows, rows_of(further[sweep])])
        (flat,) = rows_of(plain[sweep])
        returned = ~np.isnan(rows["x"])
        assert 0 < returned.sum() < rows.size
        np.testing.assert_array_equal(np.sort(rows[returned]), np.sort(flat))
        empty = rows[~returned]
        assert np.isnan(empty["y"]).all() and np.isnan(empty["z"]).all()
        if layout == "ouster":
            assert (message.height, message.width) == (channels, 1024)
            assert (rows["ring"] == np.arange(planes * channels)[:, None] % channels).all()
            assert not empty["range"].any() and not empty["intensity"].any()
        else:
            assert message.width == channels
            assert message.height // planes in (1801, 1802, 1808, 1809)  # 1808.6 a turn
            assert (rows["ring"] == np.arange(channels)).all()
            times = rows["timestamp" if layout == "robosense" else "time"][::planes]
            assert (np.diff(times.mean(axis=1)) > 0).all()
            lost = empty["intensity"]
            assert not lost.any() if layout == "robosense" else np.isnan(lost).all()


def test_a_column_of_an_organized_ouster_looks_in_one_direction(tmp_path):
    cloud = cast("ouster/os1-64")
    save_cloud(cloud, tmp_path / "c.mcap", layout="ouster", organized=True)
    rows = rows_of(messages(tmp_path / "c.mcap", "/points")[0])
    azimuths = np.degrees(np.arctan2(rows["y"], rows["x"]))
    column = np.round((180 - azimuths) * 1024 / 360) % 1024  # it turns clockwise
    returned = ~np.isnan(column)
    assert returned.sum() > 10_000
    assert (column[returned] == np.broadcast_to(np.arange(1024), column.shape)[returned]).all()


def test_the_padding_of_organized_points_is_zero(tmp_path):
    """NumPy copies the fields of a point, and leaves what is between them as it finds it."""
    survey = Survey(
        sensors=[Mounted(Sensor.grid(36, 4), name="roof")],
        trajectory=Track([0, 1], [[0, 0, 0], [0.5, 0, 0]]),
        steps=36,
        columns=COLUMNS,
    )
    part = columns_of(list(Rig(SCENE, survey, "tiles").cast(0, survey.scan_count)))
    points = part.cloud((SCAN, *survey.stored_columns[3:]), survey.precision_m, SCENE.origin)
    row = layouts.LAYOUTS["ouster"].fields
    used = {b for kind, at, *_ in row.fields.values() for b in range(at, at + kind.itemsize)}
    dirty = [np.full(size, 255, np.uint8) for size in range(1000, 20_000, 100) for _ in range(4)]
    del dirty
    message_layout = layouts.MessageLayout("ouster", organized=True)
    sweeps = Sweeps.from_survey(survey, SCENE)
    rows = layouts.encode_points(message_layout, row, points, sweeps, 0)
    (organized,) = organized_rows(message_layout, rows, points, sweeps, 0)
    stored = np.frombuffer(organized.tobytes(), np.uint8).reshape(-1, row.itemsize)
    assert not stored[:, sorted({*range(row.itemsize)} - used)].any()


@pytest.mark.extended(every=2)
@pytest.mark.parametrize(
    ("layout", "organized"),
    [
        *((layout, False) for layout in LAYOUTS),
        *((layout, True) for layout in LAYOUTS if layouts.LAYOUTS[layout].lines),
    ],
)
def test_recordings_of_each_layout_are_read_back(layout, organized, tmp_path):
    cloud = cast("hesai/xt32" if layout == "hesai" else "velodyne/vlp16")
    save_cloud(cloud, tmp_path / "c.mcap", layout=layout, organized=organized)
    recording = open_recording(tmp_path / "c.mcap")
    assert len(recording) == 2
    points = sweep_of(cloud, 1)
    positions = cloud.sweeps().as_fired(1, points)
    read = recording[1].returns()
    order, read_order = (np.lexsort(np.round(p, 4).T) for p in (positions, read.points))
    np.testing.assert_allclose(read.points[read_order], positions[order], atol=2e-4)
    highest = {"ouster": 15, "hesai": 31}.get(layout)
    rings = read.rings if highest is None else highest - read.rings
    np.testing.assert_array_equal(rings[read_order], points.channel[order])
    assert read.intensity is not None


def test_a_recording_of_livox_may_have_its_own_messages_only(tmp_path):
    cloud = cast("livox/mid360")
    save_cloud(cloud, tmp_path / "c.mcap", layout="livox")
    plain = open_recording(tmp_path / "c.mcap")[1]
    custom = open_recording(tmp_path / "c.mcap", sensor="/roof/livox")[1]
    np.testing.assert_array_equal(custom.points, plain.points)
    np.testing.assert_array_equal(custom.rings, plain.rings)
    np.testing.assert_array_equal(custom.intensity, plain.intensity)


def test_a_bag_of_an_older_driver_of_livox_has_no_point_cloud(tmp_path):
    cloud = cast("livox/mid360")
    save_cloud(cloud, tmp_path / "c.mcap", layout="livox")
    kind = "livox_interfaces/msg/CustomMsg"  # of livox_ros2_driver, for the Avia
    store = get_typestore(Stores.ROS2_HUMBLE)
    definition = CUSTOM_DEFINITION.replace("livox_ros_driver2", "livox_interfaces")
    store.register(get_types_from_msg(definition, kind))
    with (
        AnyReader([tmp_path / "c.mcap"]) as bag,
        Writer(tmp_path / "old", version=8) as writer,
    ):
        topic = writer.add_connection("/livox/lidar", kind, typestore=store)
        for connection, time_ns, data in bag.messages():
            if connection.topic == "/roof/livox":
                writer.write(topic, time_ns, data)
    old = open_recording(tmp_path / "old")
    points = old[1].points
    assert len(old) == 2
    expected = open_recording(tmp_path / "c.mcap")[1].points
    np.testing.assert_array_equal(points, expected)


def test_layouts_of_the_table_are_those_of_the_module():
    assert tuple(layouts.LAYOUTS) == LAYOUTS


def test_what_cannot_be_organized_is_one_line(tmp_path):
    with pytest.raises(LidarError, match="The layout hesai does not support `organized`"):
        ExportSpec("mcap", "hesai", organized=True)
    with pytest.raises(LidarError, match="laz does not support `organized`"):
        ExportSpec("laz", organized=True)
    cloud = cast("velodyne/vlp16")
    without = Cloud(
        cloud.positions,
        {name: column for name, column in cloud.columns.items() if name != "ray"},
        sweeps=cloud.sweeps,
    )
    with pytest.raises(LidarError, match=r"requires the column ray, which the cloud does not"):
        save_cloud(without, tmp_path / "c.mcap", organized=True)
    unknown = Cloud(
        cloud.positions, cloud.columns, sweeps=lambda: replace(cloud.sweeps(), fired=None)
    )
    with pytest.raises(LidarError, match=r"organized clouds require all returns"):
        save_cloud(unknown, tmp_path / "c.mcap", organized=True)


def test_livox_has_a_line_in_a_byte(tmp_path):
    survey = Survey(
        Sensor.grid(36, 300, 80.0), poses=[(0, 0, 0)], steps=1, columns=("time", "reflectivity")
    )
    columns = {name: np.zeros(0, int) for name in ("scan", "object", "channel", "time")}
    columns["reflectivity"] = np.zeros(0, np.uint8)
    sweeps = Sweeps.from_survey(survey, SCENE)
    cloud = Cloud(np.zeros((0, 3)), columns, sweeps=lambda: sweeps)
    with pytest.raises(LidarError, match=r"has 300 channels. Use another layout"):
        save_cloud(cloud, tmp_path / "c.mcap", layout="livox")


def test_the_command_names_the_layouts():
    wrong = CliRunner().invoke(export, ["out", "-f", "mcap", "--layout", "sick"])
    assert wrong.exit_code and "'robosense'" in wrong.output
