"""Range images: every ray that was fired, with or without a return."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from tests.shapes import Cart

from lidarfiles.clouds.writing import ExportSpec
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenes.procedural.city import city
from lidarsim import (
    Beams,
    LidarError,
    Mounted,
    Noise,
    Pose,
    Returns,
    Sensor,
    Spin,
    Survey,
    load_sensor,
)
from lidarsim.columns.table import SCAN
from lidarsim.io.yamlfile import load_yaml
from lidarsim.schema.model_names import model_names
from lidarsim.sensor.beams import Mirror
from lidarsim.sensor.models import read_model
from lidarsim.sensor.plain_data import from_plain_data, to_plain_data
from lidarsim.sensor.ray_sensors import ListedSensor
from lidarsim.sensor.sensor import LineSensor
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.sweeps import Sweeps

COLUMNS = ("ray", "range", "time", "azimuth", "elevation", "intensity", "class", "return_number")
SCENE = city(4_000)
GRID = Sensor.grid(250, 8, 40.0, step_deg=7.0, max_range_m=60)  # steps have 4 or 5 firings
NOISE = Noise(range_m=0.02, angle_deg=0.05, dropout=0.1, detection_range_m=40)
DUAL = Returns(mode="dual", subrays=7, divergence_mrad=8.0)
MOVING = Cart(stations=2, height=2.0)
ANGLES = np.linspace(0, 20, 700)
LISTED = ListedSensor(
    head=Spin(700, 36.0),
    rays=np.stack(
        [np.cos(ANGLES) * 0.8, np.sin(ANGLES) * 0.8, np.resize([-0.6, 0.6], 700)], axis=1
    ),
    shot_ns=np.arange(700) * 1e5,
    max_range_m=60,
)
LINE = LineSensor(Beams.even(2, 4.0), Mirror(200, 36.0, width_deg=150.0), max_range_m=60)


def short(name, range_m):
    """A sensor of a model, most of whose rays return nothing."""
    return load_sensor(name, max_range_m=range_m)


SURVEYS = {
    "still": Survey(GRID, poses=[(0, 0, 2), (5, 0, 2)], steps=60, columns=COLUMNS),
    "moving": Survey(GRID, trajectory=MOVING, steps=120, columns=COLUMNS),
    "noise": Survey(GRID, poses=[(0, 0, 2)], steps=60, columns=COLUMNS, noise=NOISE),
    "dual": Survey(GRID, poses=[(0, 0, 2)], steps=60, columns=COLUMNS, returns=DUAL),
    "all, noise, moving, two sensors": Survey(
        sensors=[
            Mounted(GRID, Pose((1, 0, 0.5), 30.0), "left/front"),
            Mounted(replace(GRID, start_ns=1e7), name="rear", steps=40),
        ],
        trajectory=MOVING, steps=100, columns=COLUMNS, noise=NOISE, coordinates="sensor",
        returns=replace(DUAL, mode="all"),
    ),
    "turns of 1808.6 firings": Survey(
        short("velodyne/vlp16", 8), poses=[(0, 0, 2)], steps=73, columns=COLUMNS
    ),
    "prisms": Survey(short("livox/mid40", 60), poses=[(0, 0, 2)], steps=3, columns=COLUMNS),
    "list": Survey(LISTED, trajectory=MOVING, steps=25, columns=COLUMNS),
    "line": Survey(LINE, poses=[(0, 0, 30)], steps=25, columns=COLUMNS),
}  # fmt: skip


def cloud_of(survey, scene=SCENE):
    rig = Rig(scene, survey, "tiles")
    part = columns_of(list(rig.cast(0, survey.scan_count)))
    return part.cloud((SCAN, *survey.stored_columns[3:]), survey.precision_m, scene.origin)


def images_of(folder):
    """{file: its arrays}, read with NumPy alone."""
    return {
        str(path.relative_to(folder)): dict(np.load(path).items())
        for path in sorted(folder.rglob("*.npz"))
    }


def planes_of(image, name="range"):
    return [image[key] for key in (name, *(f"{name}{n}" for n in range(2, 99))) if key in image]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Clouds, sweeps and images of the surveys."""
    kept = {}

    def make(name):
        if name not in kept:
            survey = SURVEYS[name]
            folder = tmp_path_factory.mktemp("images") / "images"
            cloud = cloud_of(survey)
            sweeps = Sweeps.from_survey(survey, SCENE)
            ExportSpec("images").write(folder, cloud, sweeps)
            kept[name] = cloud, sweeps, images_of(folder)
        return kept[name]

    return make


@pytest.mark.extended
@pytest.mark.parametrize("name", SURVEYS)
def test_each_ray_that_was_fired_is_there_once(made, name):
    cloud, sweeps, images = made(name)
    survey = SURVEYS[name]
    assert len(images) == len(sweeps)
    assert sum(image["range"].size for image in images.values()) == survey.ray_count
    points = sum(
        np.isfinite(plane).sum() for image in images.values() for plane in planes_of(image)
    )
    assert points == len(cloud)
    pulses = {*zip(cloud.scan.tolist(), cloud.ray.tolist(), strict=True)}
    silent = sum(int(np.isnan(image["range"]).sum()) for image in images.values())
    assert 0 < silent == survey.ray_count - len(pulses) < survey.ray_count


@pytest.mark.extended
@pytest.mark.parametrize("name", SURVEYS)
def test_images_have_the_values_of_the_cloud(made, name):
    """Each value is found by the scan, the firing and the channel of its ray."""
    cloud, sweeps, images = made(name)
    survey = SURVEYS[name]
    channels = {k: one.sensor.channels for k, one in enumerate(survey.mounted_sensors)}
    left = Counter(zip(cloud.scan.tolist(), cloud.ray.tolist(), cloud.range.tolist(), strict=True))
    rows = {}
    for row, key in enumerate(zip(cloud.scan.tolist(), cloud.ray.tolist(), strict=True)):
        rows.setdefault(key, []).append(row)
    order = [
        f"{'lidar' if not n else n.replace('/', '_')}/{k:06}.npz"
        for n, k in zip(
            (sweeps.sensors[s] for s in sweeps.sensor), sweeps.numbers.tolist(), strict=True
        )
    ]
    assert {*order} == {*images}
    for sweep, file in enumerate(order):
        image = images[file]
        width = channels[int(sweeps.sensor[sweep])]
        firsts = {scan: int(np.flatnonzero(image["scan"] == scan)[0]) for scan in image["scan"]}
        for plane, ranges in enumerate(planes_of(image)):
            for channel, column in np.argwhere(np.isfinite(ranges)).tolist():
                scan = int(image["scan"][column])
                ray = (column - firsts[scan]) * width + channel
                left[scan, ray, float(ranges[channel, column])] -= 1
                row = rows[scan, ray][plane]
                ending = str(plane + 1) if plane else ""
                for own in ("intensity", "object", "class", "return_number"):
                    assert image[own + ending][channel, column] == cloud[own][row]
                assert image["time"][channel, column] == cloud.time[row]
                for angle in ("azimuth", "elevation"):
                    turn = image[angle][channel, column] - cloud[angle][row]
                    assert abs((turn + 180) % 360 - 180) < 1e-4
                place = [image[axis + ending][channel, column] for axis in "xyz"]
                inside = sweeps.in_sensor(sweep, cloud.positions[row, None])[0]
                np.testing.assert_array_equal(np.array(place), inside.astype(np.float32))
    assert not +left, "each point is in an image"
    assert not -left


def test_what_has_no_return_has_no_values(made):
    _, _, images = made("dual")
    for image in images.values():
        silent = np.isnan(image["range"])
        for name in ("x", "y", "z", "intensity"):
            np.testing.assert_array_equal(np.isnan(image[name]), silent)
        assert (image["object"][silent] == -1).all() and (image["object"][~silent] >= 0).all()
        assert (image["return_number"][silent] == 0).all()
        assert np.isnan(image["range2"][silent]).all(), "a second return follows a first"
        for name in ("time", "azimuth", "elevation"):
            assert np.isfinite(image[name]).all()


@pytest.mark.extended
@pytest.mark.parametrize("name", SURVEYS)
def test_a_saved_survey_gives_the_same_images(made, tmp_path, name):
    cloud, sweeps, images = made(name)
    sweeps.save(tmp_path / "sweeps.npz")
    ExportSpec("images").write(tmp_path / "images", cloud, Sweeps.load(tmp_path / "sweeps.npz"))
    again = images_of(tmp_path / "images")
    assert {*again} == {*images}
    for file, arrays in again.items():
        for array in arrays:
            np.testing.assert_array_equal(arrays[array], images[file][array])


SENSORS = [name for name in model_names() if not read_model(name).needs_calibration]


@pytest.mark.extended
@pytest.mark.parametrize("name", [*SENSORS, "listed"])
def test_a_described_sensor_fires_the_same_rays(name):
    sensor = LISTED if name == "listed" else load_sensor(name)
    arrays = {}
    told = json.loads(json.dumps(to_plain_data((sensor,), arrays)))
    (again,) = from_plain_data(told, arrays)
    firings = np.arange(*sensor.firings(3))
    assert [again.firings(k) for k in range(5)] == [sensor.firings(k) for k in range(5)]
    np.testing.assert_array_equal(again.directions(firings), sensor.directions(firings))
    np.testing.assert_array_equal(again.times_ns(firings), sensor.times_ns(firings))


@dataclass(frozen=True, eq=False)
class Upward(Sensor):
    """A sensor of a user's own."""

    def directions(self, firings):
        return super().directions(firings) * [1, 1, -1]


def test_what_cannot_be_an_image_says_so(tmp_path):
    thinned = replace(SURVEYS["still"], keep_every=2)
    cloud = cloud_of(thinned)
    with pytest.raises(LidarError, match="keep_every 1 and the column ray"):
        ExportSpec("images").write(tmp_path / "i", cloud, Sweeps.from_survey(thinned, SCENE))
    own = replace(SURVEYS["still"], sensor=Upward(GRID.beams, GRID.head), trajectory=None)
    cloud = cloud_of(own)
    sweeps = Sweeps.from_survey(own, SCENE)
    ExportSpec("images").write(tmp_path / "own", cloud, sweeps)
    sweeps.save(tmp_path / "sweeps.npz")
    with pytest.raises(LidarError, match="they can only be written during the run"):
        ExportSpec("images").write(tmp_path / "i", cloud, Sweeps.load(tmp_path / "sweeps.npz"))
    with pytest.raises(
        LidarError, match="requires the columns ray and range, which the cloud does"
    ):
        Cloud = type(cloud)  # noqa: N806
        bare = Cloud(cloud.positions, {"scan": cloud.scan, "channel": cloud.channel})
        ExportSpec("images").write(tmp_path / "i", bare, sweeps)
    assert not (tmp_path / "i").exists()


@pytest.mark.parametrize("entry", ["images", "{format: mcap, layout: images}"])
def test_a_scenario_keeps_every_return(entry):
    survey = prepare(
        Scenario.from_data(load_yaml(f"scene: seed\noutput: {{write: [{entry}]}}"))
    ).survey
    assert survey.keep_every == 1
    assert {"ray", "range"} <= {column.name for column in survey.stored_columns}
    thinned = Scenario.from_data(
        load_yaml(f"{{scene: seed, output: {{write: [{entry}]}}, cloud: {{keep_every: 5}}}}")
    )
    with pytest.raises(LidarError, match=r"Set `cloud\.keep_every"):
        prepare(thinned)


@pytest.mark.parametrize("name", ["dual", "all, noise, moving, two sensors"])
def test_bags_have_images_beside_the_points(made, tmp_path, name):
    """By two readers: that of rosbags, and the one of the MCAP project."""
    cloud, sweeps, images = made(name)
    ExportSpec("mcap", "images").write(tmp_path / "a.mcap", cloud, sweeps)
    store = get_typestore(Stores.ROS2_HUMBLE)
    with AnyReader([tmp_path / "a.mcap"], default_typestore=store) as bag:
        found = [
            (connection.topic, time, bag.deserialize(data, connection.msgtype))
            for connection, time, data in bag.messages()
            if "range_image" in connection.topic
        ]
        clouds = sum(m[0].topic.endswith("points") for m in bag.messages())
    assert clouds == len(sweeps)
    by_time = {}
    for topic, time, message in found:
        assert (message.encoding, message.is_bigendian) == ("32FC1", 0)
        assert message.step == 4 * message.width == len(message.data) // message.height
        values = message.data.view("<f4").reshape(message.height, message.width)
        values = np.where(np.isposinf(values), np.nan, values)
        assert not np.isnan(message.data.view("<f4")).any(), "REP 117: that would be an error"
        by_time.setdefault((topic.split("/")[-2] or "lidar", time), []).append(values[::-1])
        assert message.header.frame_id == (topic.split("/")[-2] or "lidar")
    assert len(by_time) == len(images)
    for key, planes in zip(sorted(by_time), sorted(images), strict=True):
        assert key[0] == planes.split("/")[0]
        np.testing.assert_array_equal(by_time[key], planes_of(images[planes]))
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        others = [
            (channel.topic, message)
            for _, channel, _, message in reader.iter_decoded_messages()
            if "range_image" in channel.topic
        ]
    assert len(others) == len(found)
    for (topic, _, message), (other_topic, other) in zip(found, others, strict=True):
        assert topic == other_topic and bytes(other.data) == message.data.tobytes()
