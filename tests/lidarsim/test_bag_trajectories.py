"""Trajectories in bags of ROS 2, written by rosbags."""

import numpy as np
import pytest

from lidarsim import LidarError, Pose, Track, load_trajectory

rosbag2 = pytest.importorskip("rosbags.rosbag2")
typesys = pytest.importorskip("rosbags.typesys")

STORE = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
START_NS = 1_700_000_000_000_000_000
# A carrier that turns to the left on a circle, at 10 Hz.
TIMES = np.arange(21) / 10
YAW = 0.2 * TIMES
TRACK = Track(
    TIMES,
    np.stack([20 * np.sin(YAW), 20 - 20 * np.cos(YAW), 1 + 0.1 * TIMES], axis=1),
    np.stack([0 * YAW, 0 * YAW, np.sin(YAW / 2), np.cos(YAW / 2)], axis=1),
)


def of(name, *values):
    return STORE.types[name](*values)


def header(seconds, frame="map"):
    time_ns = START_NS + round(seconds * 1e9)
    stamp = of("builtin_interfaces/msg/Time", *divmod(time_ns, 1_000_000_000))
    return of("std_msgs/msg/Header", stamp, frame)


def pose(row):
    point = of("geometry_msgs/msg/Point", *TRACK.positions[row].tolist())
    turn = of("geometry_msgs/msg/Quaternion", *TRACK.quaternions[row].tolist())
    return of("geometry_msgs/msg/Pose", point, turn)


def with_covariance(row):
    return of("geometry_msgs/msg/PoseWithCovariance", pose(row), np.zeros(36))


def odometry(row):
    zero = of("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
    twist = of("geometry_msgs/msg/Twist", zero, zero)
    moved = of("geometry_msgs/msg/TwistWithCovariance", twist, np.zeros(36))
    return of("nav_msgs/msg/Odometry", header(TIMES[row]), "base_link", with_covariance(row), moved)


def pose_stamped(row):
    return of("geometry_msgs/msg/PoseStamped", header(TIMES[row]), pose(row))


def covariant(row):
    return of(
        "geometry_msgs/msg/PoseWithCovarianceStamped", header(TIMES[row]), with_covariance(row)
    )


def transform(seconds, parent, child, position, quaternion):
    vector = of("geometry_msgs/msg/Vector3", *map(float, position))
    turn = of("geometry_msgs/msg/Quaternion", *map(float, quaternion))
    moved = of("geometry_msgs/msg/Transform", vector, turn)
    return of("geometry_msgs/msg/TransformStamped", header(seconds, parent), child, moved)


def frames(*transforms):
    return of("tf2_msgs/msg/TFMessage", list(transforms))


def carrier(row, parent="map"):
    at = TRACK.positions[row], TRACK.quaternions[row]
    return frames(transform(TIMES[row], parent, "base_link", *at))


def fix(row, origin, status=0):
    # One degree of latitude and longitude, of the ellipsoid of WGS 84.
    a = 6378137.0
    e2 = 0.00669437999014
    sine = np.sin(np.radians(origin[0]))
    north_m = a * (1 - e2) / (1 - e2 * sine**2) ** 1.5
    east_m = a / np.sqrt(1 - e2 * sine**2) * np.cos(np.radians(origin[0]))
    x, y, z = TRACK.positions[row]
    return of(
        "sensor_msgs/msg/NavSatFix",
        header(TIMES[row]),
        of("sensor_msgs/msg/NavSatStatus", status, 1),
        origin[0] + np.degrees(y / north_m),
        origin[1] + np.degrees(x / east_m),
        origin[2] + z,
        np.zeros(9),
        0,
    )


def imu(row, known=True):
    zero = of("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
    turn = of("geometry_msgs/msg/Quaternion", *TRACK.quaternions[row].tolist())
    covariance = np.zeros(9)
    covariance[0] = 0 if known else -1
    return of(
        "sensor_msgs/msg/Imu",
        *(header(TIMES[row]), turn, covariance, zero, np.zeros(9), zero, np.zeros(9)),
    )


@pytest.fixture(params=["folder", "mcap", "db3"])
def bag(request, tmp_path):
    """Return a function that writes {topic: messages} into a bag, and returns its path."""

    def write(**topics):
        plugins = rosbag2.StoragePlugin
        plugin = plugins.SQLITE3 if request.param == "db3" else plugins.MCAP
        with rosbag2.Writer(tmp_path / "bag", version=8, storage_plugin=plugin) as file:
            for topic, messages in topics.items():
                kind = messages[0].__msgtype__
                connection = file.add_connection(f"/{topic}", kind, typestore=STORE)
                for number, message in enumerate(messages):
                    data = STORE.serialize_cdr(message, kind)
                    file.write(connection, START_NS + number, data)
        if request.param == "folder":
            return tmp_path / "bag"
        return next((tmp_path / "bag").glob(f"*.{request.param}"))

    return write


def assert_same(track, *, atol=1e-6, turned=True):
    start = track.times_s[0] - START_NS / 1e9
    times = np.linspace(0, min(track.duration_ns, 2e9 - start * 1e9) * 0.999, 30)
    found = track.poses(0, times)
    expected = TRACK.poses(0, times + start * 1e9)
    assert np.allclose(found[0], expected[0], atol=atol)
    assert not turned or np.allclose(found[1], expected[1], atol=1e-5)


ROWS = range(len(TIMES))


@pytest.mark.extended(every=4)
@pytest.mark.parametrize("message", [odometry, pose_stamped, covariant])
def test_topics_of_poses(bag, message):
    path = bag(state=[message(row) for row in ROWS])
    assert_same(load_trajectory(path))
    assert_same(load_trajectory(path, topic="/state"))


def test_stamps_of_several_clocks_are_refused(bag):
    messages = [pose_stamped(row) for row in ROWS]
    messages[3].header.stamp.sec = 12  # since the start of a program
    path = bag(state=messages)
    words = r"range from 12\.3 to 1\.7e\+09 s, a span of 53\.8 years. Correct the outliers"
    with pytest.raises(LidarError, match=words):
        load_trajectory(path)
    assert load_trajectory(path, time_unit="s").times_s[0] == 12.3


def test_several_topics_have_to_be_chosen(bag):
    path = bag(
        odom=[odometry(row) for row in ROWS],
        slam=[pose_stamped(row) for row in ROWS[5:]],
        tf=[carrier(row) for row in ROWS],
    )
    with pytest.raises(
        LidarError, match=r"poses are /odom, /slam and /tf:base_link. Set topic to one"
    ):
        load_trajectory(path)
    with pytest.raises(LidarError, match=r"has no topic '/odmo' with poses\. Did you mean '/odom'"):
        load_trajectory(path, topic="/odmo")
    track = load_trajectory(path, topic="/slam")
    assert len(track.times_s) == 16
    assert_same(track)
    assert_same(load_trajectory(path, topic="/tf"))


def test_frames_above_each_other(bag):
    """A sensor on the carrier, in a frame of odometry that has its own place and clock."""
    mount = Pose((1, 0, 2), yaw_deg=90)
    turn = (0, 0, np.sqrt(0.5), np.sqrt(0.5))
    path = bag(
        tf=[
            message
            for row in ROWS
            for message in (
                carrier(row, "odom"),
                frames(transform(TIMES[row] + 0.05, "map", "odom", (100 + TIMES[row], 0, 0), turn)),
            )
        ],
        tf_static=[frames(transform(0, "base_link", "lidar", mount.position, turn))],
    )
    with pytest.raises(LidarError, match=r"/tf:base_link and /tf:odom. Set topic to one"):
        load_trajectory(path)
    track = load_trajectory(path, topic="/tf:lidar")
    assert np.isclose(track.times_s[0] - START_NS / 1e9, 0.1)
    expected = Pose((100.05, 0, 0), yaw_deg=90).compose(TRACK.pose(0, 0.1e9)).compose(mount)
    assert np.allclose(track.pose(0).position, expected.position, atol=1e-6)
    assert np.allclose(track.pose(0).rotation, expected.rotation, atol=1e-6)


def test_gnss_with_an_imu(bag):
    origin = (48.7758, 9.1829, 290.0)
    path = bag(
        fix=[fix(row, origin, status=-1 if row == 3 else 0) for row in ROWS],
        imu=[imu(row) for row in ROWS],
    )
    track = load_trajectory(path, origin=origin)
    assert len(track.times_s) == 20
    assert_same(track, atol=0.01)  # positions between fixes are on a chord
    first = load_trajectory(path, topic="/fix /imu")
    assert np.allclose(first.positions[0], 0)
    assert np.allclose(first.positions, track.positions - TRACK.positions[0], atol=1e-3)


def test_gnss_without_orientations_faces_its_direction_of_travel(bag):
    origin = (48.7758, 9.1829, 290.0)
    path = bag(fix=[fix(row, origin) for row in ROWS], imu=[imu(row, known=False) for row in ROWS])
    track = load_trajectory(path, origin=origin)
    assert_same(track, atol=1e-3, turned=False)
    assert np.isclose(track.pose(0, 1e9).yaw_deg, np.degrees(0.2), atol=0.1)
    with pytest.raises(LidarError, match="/imu has no orientations"):
        load_trajectory(path, topic="/fix /imu")


def test_bags_without_poses(bag):
    path = bag(imu=[imu(0), imu(1)])
    with pytest.raises(
        LidarError,
        match=(
            r"it has no poses. Supported topics are "
            r"nav_msgs/msg/Odometry"
        ),
    ):
        load_trajectory(path)
    with pytest.raises(LidarError, match="no poses"):
        load_trajectory(path, ignore=["x"])


def test_a_cut_bag_and_a_zero_quaternion(bag, tmp_path):
    path = bag(state=[pose_stamped(row) for row in ROWS])
    file = path if path.is_file() else next(path.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 3])
    with pytest.raises(LidarError, match="not a valid trajectory") as raised:
        load_trajectory(path)
    assert len(str(raised.value).splitlines()) == 1
