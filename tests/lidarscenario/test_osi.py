"""Traces of the Open Simulation Interface, written and read by betterosi, as clouds and actors."""

from __future__ import annotations

import gzip
import struct
import zlib
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from lidarfiles import save_cloud
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenario.traffic.osi_trace import iter_ground_truth
from lidarsim import Actor, LidarError, Mounted, Pose, Scene, Sensor, Survey, Track, box
from lidarsim.columns.table import SCAN
from lidarsim.io import allowance
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.sweeps import Sweeps

osi = pytest.importorskip("betterosi", reason="betterosi is an extra")

MOUNT = Pose((1, 0, 0.5), 30.0, 10.0)
START_NS = 1_790_000_000_000_000_000


@pytest.fixture(scope="module")
def drive():
    """Points of a tilted sensor on a carrier that turns, which a car passes, of two sweeps."""
    half = np.sqrt(0.5)
    track = Track([0, 1], [[0, 0, 1], [2, 1, 1]], [[0, 0, 0, 1], [0, 0, half, half]])
    car = Track([0, 1], [[6, 4, 0], [6, -4, 0]], start_s=0.0)
    scene = Scene.from_meshes([box("Floor", (60, 60, 0.01))])
    scene = scene.with_actors([Actor(box("Car 1", (4, 2, 1.5)), car)])
    survey = Survey(
        sensors=[Mounted(Sensor.grid(1440, 8), MOUNT, "front")], trajectory=track, steps=72,
        columns=["time", "intensity", "reflectance", "radial_velocity"], keep_every=1,
        start=datetime.fromtimestamp(START_NS // 10**9, UTC),
    )  # fmt: skip
    part = columns_of(list(Rig(scene, survey, "numpy").cast(0, survey.scan_count)))
    cloud = part.cloud((SCAN, *survey.stored_columns[3:]), survey.precision_m, scene.origin)
    sweeps = Sweeps.from_survey(survey, scene)
    return replace(cloud, sweeps=lambda: sweeps)


def rotation_of(angles):
    (sr, sp, sy), (cr, cp, cy) = (
        [f(angles.roll), f(angles.pitch), f(angles.yaw)] for f in (np.sin, np.cos)
    )
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return about_z @ about_y @ about_x


def vector_of(message):
    return np.array([message.x, message.y, message.z])


def in_world(sensor_data):
    """Positions of detections in the world, by the definitions of OSI."""
    truth = sensor_data.sensor_view[0].global_ground_truth
    (host,) = [o for o in truth.moving_object if o.id.value == truth.host_vehicle_id.value]
    (lidar,) = sensor_data.feature_data.lidar_sensor
    points = []
    for detection in lidar.detection:
        at = detection.position
        about = osi.Orientation3d(roll=0, pitch=at.elevation, yaw=at.azimuth)
        points.append(rotation_of(about)[:, 0] * at.distance)
    mount = lidar.header.mounting_position
    in_vehicle = np.array(points) @ rotation_of(mount.orientation).T + vector_of(mount.position)
    turn = rotation_of(host.base.orientation)
    return in_vehicle @ turn.T + vector_of(host.base.position)


@pytest.mark.parametrize("name", ["cloud_sd.osi", "cloud.mcap"])
def test_betterosi_reads_detections_moving_objects_and_poses(drive, tmp_path, name):
    path = tmp_path / name
    left_out = save_cloud(drive, path, format="osi" if path.suffix == ".osi" else "osi_mcap")
    assert {"object", "intensity", "reflectance"}.isdisjoint(left_out)
    if path.suffix == ".mcap":
        messages = list(osi.read(str(path), mcap_topics=["/front/sensor_data"]))
        assert len(list(osi.read(str(path), return_ground_truth=True))) == 2
    else:
        messages = list(osi.read(str(path), osi_message_type="SensorData"))
    sweeps = drive.sweeps()
    assert len(messages) == len(sweeps) == 2
    for sweep, message in enumerate(messages):
        (points,) = sweeps.points(drive, sweep, sweep + 1)
        stamp = message.timestamp.seconds * 10**9 + message.timestamp.nanos
        assert stamp == START_NS + sweep * 100_000_000
        # Coordinates of the world, rounded to 1 mm, survive.
        np.testing.assert_allclose(in_world(message), points.positions, atol=1e-6)
        (lidar,) = message.feature_data.lidar_sensor
        detections = lidar.detection
        assert lidar.header.number_of_valid_detections == len(points) == len(detections)
        ids = [detection.object_id.value for detection in detections]
        assert ids == points["object"].tolist()
        assert [d.beam_id.value for d in detections] == points["channel"].tolist()
        for field, expected in (
            ("intensity", 100 * np.clip(points["intensity"], 0, 1)),
            ("reflectivity", points["reflectance"]),
            ("radial_velocity", -points["radial_velocity"]),
        ):
            values = [getattr(detection, field) for detection in detections]
            np.testing.assert_allclose(values, expected, rtol=1e-6)

        (car,) = message.moving_object
        truth = message.sensor_view[0].global_ground_truth
        _, true_car = truth.moving_object
        assert car.header.tracking_id.value == true_car.id.value == 1
        assert car.candidate[0].vehicle_classification.type.name == "CAR"
        assert true_car.model_reference == "Car 1"
        size = true_car.base.dimension
        assert (size.length, size.width, size.height) == (4, 2, 1.5)
        # It drives along -y at 8 m/s, 0.75 m above the floor in the middle.
        expected_y = 4 - 8 * (stamp - START_NS) / 1e9
        np.testing.assert_allclose(
            vector_of(true_car.base.position), [6, expected_y, 0.75], atol=0.8
        )
        np.testing.assert_allclose(vector_of(true_car.base.velocity), [0, -8, 0], atol=1e-6)
        own = points.positions[points["object"] == 1]
        local = (own - vector_of(true_car.base.position)) @ rotation_of(true_car.base.orientation)
        assert (np.abs(local).max(axis=0) <= [2.8, 1.01, 0.76]).all()


def test_the_same_points_give_the_same_bytes(drive, tmp_path):
    for name, kind in (("a_sd.osi", "osi"), ("a.mcap", "osi_mcap")):
        save_cloud(drive, tmp_path / name, format=kind)
        first = (tmp_path / name).read_bytes()
        save_cloud(drive, tmp_path / name, format=kind)
        assert (tmp_path / name).read_bytes() == first


def moving(number, x, y, kind="CAR", yaw=0.0, size=(4, 2, 1.5)):
    classification = osi.MovingObject.VehicleClassification
    person = kind == "PEDESTRIAN"
    return osi.MovingObject(
        id=osi.Identifier(value=number),
        base=osi.BaseMoving(
            dimension=size and osi.Dimension3d(**dict(zip(SIDES, size, strict=True))),
            position=osi.Vector3d(x=x, y=y, z=0.75),
            orientation=osi.Orientation3d(roll=0, pitch=0, yaw=yaw),
        ),
        type=osi.MovingObject.Type.PEDESTRIAN if person else osi.MovingObject.Type.VEHICLE,
        vehicle_classification=None
        if person
        else classification(type=getattr(classification.Type, kind)),
    )


SIDES = ("length", "width", "height")


def truths():
    """A host that drives east, a bus that turns, and a pedestrian in the first two seconds."""
    for second in range(5):
        objects = [
            moving(0, 10.0 * second, 0.0),
            moving(7, 20.0, 10.0, "BUS", np.radians(30 * second), (12, 2.5, 3)),
        ]
        objects += [moving(9, 5.0, second, "PEDESTRIAN")] if second < 3 else []
        yield osi.GroundTruth(
            version=osi.InterfaceVersion(version_major=3, version_minor=8, version_patch=0),
            timestamp=osi.Timestamp(seconds=second, nanos=0),
            host_vehicle_id=osi.Identifier(value=0),
            moving_object=objects,
            stationary_object=[osi.StationaryObject(id=osi.Identifier(value=100))],
        )


def written(path, messages):
    with osi.Writer(str(path)) as writer:
        for message in messages:
            writer.add(message)
    return path


def scenario(folder, file, **traffic):
    data = {
        "scene": {"ground": {"margin_m": 60}, "copies": [{"name": "Post", "box": [1, 1, 3],
                  "at": [[0, 9, 0]]}]},
        "poses": [[10, 8, 1.5]],
        "sensor": {"model": "velodyne/vlp16"},
        "steps": 36 * 35,
        "traffic": {"file": file, **traffic},
    }  # fmt: skip
    return Scenario.from_data(data, folder=folder)


@pytest.mark.parametrize("name", ["town.osi", "town_gt.osi", "town.mcap", "view.osi"])
def test_moving_objects_of_ground_truth_are_actors(tmp_path, name):
    messages = list(truths())
    if name == "view.osi":
        messages = [
            osi.SensorView(
                timestamp=truth.timestamp,
                sensor_id=osi.Identifier(value=3),
                global_ground_truth=truth,
                mounting_position=osi.MountingPosition(),
            )
            for truth in messages
        ]
    written(tmp_path / name, messages)
    built = prepare(scenario(tmp_path, name))
    names = [actor.name for actor in built.scene.actors]
    assert names == ["car (0)", "bus (7)", "pedestrian (9)"]
    host, bus, person = built.scene.actors
    assert np.ptp(bus.mesh.vertices, axis=0).tolist() == [12, 2.5, 3]
    positions, _ = host.trajectory.poses(0, np.array([1.5e9]))
    np.testing.assert_allclose(positions + built.scene.origin, [[15, 0, 0]], atol=1e-9)
    positions, rotations = bus.trajectory.poses(0, np.array([2e9]))
    np.testing.assert_allclose(positions + built.scene.origin, [[20, 10, -0.75]], atol=1e-9)
    np.testing.assert_allclose(rotations[0, :, 0], [0.5, 0.75**0.5, 0], atol=1e-9)
    assert person.trajectory.presence_ns == (0, 2e9)
    source = built.findings.sources[name]
    assert source == "3 actors during the survey, out of 3 moving objects until its end"
    assert any("1 stationary object in" in note for note in built.findings.notes)


def test_timestamps_that_cannot_be_seconds_need_their_unit(tmp_path):
    messages = list(truths())
    for second, truth in enumerate(messages):
        truth.timestamp.seconds = 1_790_000_000_000 + 1000 * second
    written(tmp_path / "town.osi", messages)
    with pytest.raises(LidarError, match=r"They are probably milliseconds. Set `time_unit: ms`"):
        prepare(scenario(tmp_path, "town.osi"))
    timed = {"time_unit": "ms", "offset_s": -1_790_000_000}
    built = prepare(scenario(tmp_path, "town.osi", **timed))
    positions, _ = built.scene.actors[0].trajectory.poses(0, np.array([1.5e9]))
    np.testing.assert_allclose(positions + built.scene.origin, [[15, 0, 0]], atol=1e-9)


def test_shapes_of_traffic_and_the_host_are_a_choice(tmp_path):
    written(tmp_path / "town.osi", truths())
    vehicles = [{"types": "b*", "name": "Bus", "box": [10, 3, 4], "class": 13}]
    built = prepare(
        scenario(
            tmp_path, "town.osi", vehicles=vehicles, host=False, offset_s=-1,
            translation=[100, 0, 0.75],
        )
    )  # fmt: skip
    assert [actor.name for actor in built.scene.actors] == ["Bus (7)", "pedestrian (9)"]
    bus, person = built.scene.actors
    positions, _ = bus.trajectory.poses(0, np.array([0.0]))
    np.testing.assert_allclose(positions + built.scene.origin, [[120, 10, 0]], atol=1e-9)
    assert person.trajectory.presence_ns == (0, 1e9), "messages before the start are dropped"


def test_actors_of_a_survey_come_back_from_its_trace(drive, tmp_path):
    save_cloud(drive, tmp_path / "cloud.mcap", format="osi_mcap")
    read = scenario(tmp_path, "cloud.mcap", offset_s=-START_NS / 1e9)
    built = prepare(read)
    assert [actor.name for actor in built.scene.actors] == ["car (1)"]
    note = "was skipped because of missing dimensions (vehicle)"
    assert any(note in line for line in built.findings.notes)


def test_traces_that_are_no_ground_truth_are_refused_in_a_line(drive, tmp_path):
    good = written(tmp_path / "good_gt.osi", truths()).read_bytes()
    save_cloud(drive, tmp_path / "cloud_sd.osi")
    contents = {
        "cut_gt.osi": good[:-9],
        "noise_gt.osi": struct.pack("<I", 40) + bytes(range(40)),
        "long_gt.osi": struct.pack("<I", 2**32 - 1) + b"x",
        "empty_gt.osi": b"",
        "empty.mcap": b"",
        "noise.mcap": bytes(range(200)),
        "noise.osi": bytes(range(200)),
    }
    for name, data in contents.items():
        (tmp_path / name).write_bytes(data)
    with osi.Writer(str(tmp_path / "data.mcap")) as writer:
        writer.add(osi.SensorData(timestamp=osi.Timestamp(seconds=1, nanos=0)))
    backwards = list(truths())[::-1]
    written(tmp_path / "back_gt.osi", backwards)
    for name in [*contents, "cloud_sd.osi", "data.mcap", "back_gt.osi", "none_gt.osi"]:
        with pytest.raises(LidarError) as caught:
            prepare(scenario(tmp_path, name))
        assert name in str(caught.value) and "\n" not in str(caught.value), name


def test_garbled_traces_are_read_or_refused(tmp_path):
    good = written(tmp_path / "good_gt.osi", truths()).read_bytes()
    random = np.random.default_rng(4)
    for _ in range(30):
        data = bytearray(good)
        for position in random.integers(0, len(data), 3):
            data[position] = random.integers(256)
        (tmp_path / "a_gt.osi").write_bytes(data)
        try:
            prepare(scenario(tmp_path, "a_gt.osi"))
        except LidarError as error:
            assert "\n" not in str(error)


def compressed(trace):
    """Compress a trace as esmini 3.4 does with --osi_compress: flushed after each message."""
    packer = zlib.compressobj(1, wbits=31)
    packed = b""
    while trace:
        end = 4 + struct.unpack_from("<I", trace)[0]
        packed += packer.compress(trace[:end]) + packer.flush(zlib.Z_FULL_FLUSH)
        trace = trace[end:]
    return packed + packer.flush()


@pytest.mark.parametrize("name", ["ground_truth.osi", "Town_GT.OSI", "town_gt.osi.gz", "a.OSI.gz"])
@pytest.mark.parametrize("pack", [compressed, gzip.compress])
def test_compressed_traces_have_the_same_actors(tmp_path, name, pack):
    good = written(tmp_path / "plain.osi", truths()).read_bytes()
    (tmp_path / name).write_bytes(pack(good))
    plain = prepare(scenario(tmp_path, "plain.osi")).scene
    packed = prepare(scenario(tmp_path, name)).scene
    assert [actor.name for actor in packed.actors] == ["car (0)", "bus (7)", "pedestrian (9)"]
    for actor, same in zip(packed.actors, plain.actors, strict=True):
        np.testing.assert_array_equal(actor.trajectory.times_s, same.trajectory.times_s)
        np.testing.assert_array_equal(actor.trajectory.positions, same.trajectory.positions)


def test_concatenated_and_decompressed_files_are_read(tmp_path):
    good = written(tmp_path / "town_gt.osi", truths()).read_bytes()
    end = 4 + struct.unpack_from("<I", good)[0]
    members = gzip.compress(good[: end + 9]) + gzip.compress(good[end + 9 :]) + bytes(512)
    for data in (members, good):  # the name does not decide whether a trace is compressed
        (tmp_path / "town.osi.gz").write_bytes(data)
        read = list(iter_ground_truth(tmp_path / "town.osi.gz"))
        assert [truth.timestamp.seconds for truth in read] == [0, 1, 2, 3, 4]


def test_sensor_views_in_compressed_traces_have_ground_truth(tmp_path):
    views = [
        osi.SensorView(
            timestamp=truth.timestamp,
            global_ground_truth=None if second == 1 else truth,
            mounting_position=osi.MountingPosition(),
        )
        for second, truth in enumerate(truths())
    ]
    good = written(tmp_path / "view.osi", views).read_bytes()
    (tmp_path / "view.osi").write_bytes(compressed(good))
    read = list(iter_ground_truth(tmp_path / "view.osi"))
    assert [truth.timestamp.seconds for truth in read] == [0, 2, 3, 4]


@pytest.mark.parametrize("is_packed", [True, False])
def test_the_complete_messages_of_a_truncated_trace_are_used(tmp_path, is_packed):
    """A simulation that was killed leaves a trace without an end."""
    good = written(tmp_path / "town_gt.osi", truths()).read_bytes()
    end = 0
    for _ in range(3):
        end += 4 + struct.unpack_from("<I", good, end)[0]
    cut = compressed(good[:end])[:-8] if is_packed else good[: end + 20]
    (tmp_path / "town_gt.osi").write_bytes(cut)
    read = iter_ground_truth(tmp_path / "town_gt.osi")
    assert [next(read).timestamp.seconds for _ in range(3)] == [0, 1, 2]
    ending = "its gzip stream ends" if is_packed else "it ends"
    with pytest.raises(LidarError, match=rf"town_gt\.osi is truncated: {ending} in message 4\."):
        next(read)
    with pytest.raises(LidarError, match=r"is truncated"):  # the survey ends later
        prepare(scenario(tmp_path, "town_gt.osi"))
    # Here, the survey ends before the last message, 0.5 s after the start of the trace.
    car = prepare(scenario(tmp_path, "town_gt.osi", offset_s=3)).scene.actors[0]
    assert car.trajectory.times_s.tolist() == [3, 4, 5]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (gzip.compress(b"<?xml version='1.0'?>"), "is truncated or is not an OSI trace"),
        (gzip.compress(b"RIF"), "is truncated or is not an OSI trace"),
        (gzip.compress(struct.pack("<I", 2**32 - 1) + b"x"), "is truncated or is not an OSI trace"),
        (gzip.compress(b""), "contains no ground truth"),
        (
            gzip.compress(struct.pack("<I", 40) + bytes(range(40))),
            "its message 1 is not a valid GroundTruth message (",
        ),
        (b"\x1f\x8b\x08", "is truncated: its gzip stream ends in message 1."),
        (b"\x1f\x8b\x08" + bytes(range(100)), "its gzip data is corrupt after message 0."),
        (gzip.compress(b"")[:-4] + b"long", "its gzip data is corrupt after message 0."),
    ],
    # Compressed data contains the time, and ids must be the same in all processes.
    ids=["xml", "short", "huge", "empty", "invalid", "cut", "corrupt", "checksum"],
)
@pytest.mark.parametrize("name", ["town_gt.osi", "town_gt.osi.gz"])
def test_compressed_files_that_are_no_traces_are_refused_in_a_line(tmp_path, name, data, message):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(LidarError) as caught:
        prepare(scenario(tmp_path, name))
    told = str(caught.value)
    assert told.count(str(tmp_path / name)) == 1 and message in told and "\n" not in told


@pytest.mark.parametrize(
    ("sizes", "letters", "told"),
    [
        # While it is decoded, a byte counts 16 times, or 215 times if it compresses too well. In
        # total, it counts 4 times, and there are 100 additional bytes for each message.
        ([70_000], b"0123456789abcdef", "would unpack to at least 1.07 MiB"),
        ([7_000], b"0", "would unpack to at least 1.44 MiB"),
        ([2**31], b"0", "would unpack to at least 430.00 GiB"),
        ([0] * 2622, b"", "would unpack to at least 1.00 MiB"),
        ([60_000] * 5, b"0123456789abcdef", "would unpack to at least 1.15 MiB"),
    ],
)
def test_compressed_traces_that_unpack_to_far_more_are_refused(
    tmp_path, monkeypatch, sizes, letters, told
):
    monkeypatch.setattr(allowance, "MIN_LIMIT_BYTES", 2**20)
    monkeypatch.setattr(allowance, "UNPACKED_TIMES", 1)
    random = np.random.default_rng(2)
    trace = b""
    for size in sizes:
        content = bytes(min(size, 2**17))
        if 0 < size < 2**20:
            text = random.choice([*letters], size - 3 - (size > 16_384)).astype(np.uint8).tobytes()
            content = osi.GroundTruth(proj_string=text.decode()).to_binary()
        assert len(content) in (size, 2**17)
        trace += struct.pack("<I", size) + content
    (tmp_path / "town_gt.osi").write_bytes(gzip.compress(trace))
    with pytest.raises(LidarError) as caught:
        list(iter_ground_truth(tmp_path / "town_gt.osi"))
    message = str(caught.value)
    assert "town_gt.osi" in message and told in message and "\n" not in message
    assert message.endswith("and the limit is 1.00 MiB. Decompress it with gunzip first.")


def carried(folder, file, vehicle, **traffic):
    """A scenario whose sensors are on a moving object of a trace."""
    data = {
        "scene": {"ground": {"margin_m": 60}, "copies": [{"name": "Post", "box": [1, 1, 3],
                  "at": [[0, 9, 0]]}]},
        "trajectory": {"vehicle": vehicle},
        "sensor": {"model": "velodyne/vlp16"},
        "mount": [0, 0, 2],
        "traffic": {"file": file, **traffic},
    }  # fmt: skip
    return prepare(Scenario.from_data(data, folder=folder))


@pytest.mark.parametrize("vehicle", ["host", 0])
@pytest.mark.parametrize("host", [True, False])
def test_the_host_vehicle_carries_the_sensors(tmp_path, vehicle, host):
    written(tmp_path / "town_gt.osi", truths())
    built = carried(tmp_path, "town_gt.osi", vehicle, host=host)
    assert [actor.name for actor in built.scene.actors] == ["bus (7)", "pedestrian (9)"]
    position, rotation = built.survey.trajectory.poses(0, np.array([1.5e9]))
    # The bottom of a box of 1.5 m, whose middle is at height 0.75.
    np.testing.assert_allclose(position + built.scene.origin, [[15, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(rotation[0], np.eye(3), atol=1e-12)

    on_bus = carried(tmp_path, "town_gt.osi", 7, host=host)
    names = ["car (0)"] if host else []
    assert [actor.name for actor in on_bus.scene.actors] == [*names, "pedestrian (9)"]
    with pytest.raises(
        LidarError, match=r"vehicle` is '8', but .* Available names: 0, 7, 9, host\."
    ):
        carried(tmp_path, "town_gt.osi", 8)
    for truth in (nobody := list(truths())):
        truth.host_vehicle_id = None
    written(tmp_path / "nobody_gt.osi", nobody)
    with pytest.raises(
        LidarError,
        match=(
            r"does not state its host vehicle, set `trajectory.vehicle` to an identity\. Available "
            r"names: 0, 7, 9\."
        ),
    ):
        carried(tmp_path, "nobody_gt.osi", "host")


def test_the_carrier_of_a_survey_comes_back_from_its_trace(drive, tmp_path):
    save_cloud(drive, tmp_path / "cloud.mcap", format="osi_mcap")
    built = carried(tmp_path, "cloud.mcap", "host", offset_s=-START_NS / 1e9)
    assert [actor.name for actor in built.scene.actors] == ["car (1)"]
    position, rotation = built.survey.trajectory.poses(0, np.zeros(1))
    np.testing.assert_allclose(position + built.scene.origin, [[0, 0, 1]], atol=1e-6)
    np.testing.assert_allclose(rotation[0], np.eye(3), atol=1e-6)
