"""Files of trajectories: what is read, with the right values, and what is refused."""

import gzip
import re

import numpy as np
import pytest
import yaml

from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarsim import LidarError, Pose, Track, load_trajectory

# Of x 0 to 10 m, z 1 m; the values of a case are those of both rows.
HEAD = "time_s,x,y,z"
ROWS = ("0,0,0,1", "1,10,0,1")
TURN = Pose((0, 0, 1), yaw_deg=40, pitch_deg=5, roll_deg=-3)
HALF = np.radians(40) / 2
SINE = np.sin(HALF)
COSINE = np.cos(HALF)


@pytest.fixture
def load(tmp_path):
    """Write a table of a carrier that drives along x, with further columns, and read it."""

    def read(names="", values="", head=HEAD, rows=ROWS, name="drive.csv", **options):
        separator = "," if names else ""
        lines = [f"{head}{separator}{names}", *(f"{row}{separator}{values}" for row in rows)]
        (tmp_path / name).write_text("\n".join(lines))
        return load_trajectory(tmp_path / name, **options)

    return read


def angles(track):
    pose = track.pose(0)
    return np.array([pose.yaw_deg, pose.pitch_deg, pose.roll_deg])


@pytest.mark.parametrize(
    ("names", "values"),
    [
        ("yaw_deg", "40"),
        ("Yaw [deg]", "40"),
        ("YAW(deg)", "40"),
        ("yaw deg", "40"),
        ("Yaw [Degrees]", "40"),
        ("Yaw [°]", "40"),
        ("yaw_rad", f"{np.radians(40)}"),
        ("yaw (rad)", f"{np.radians(40)}"),
        ("YawDeg", "40"),
        ("roll_deg,pitch_deg,yaw_deg", "0,0,40"),
        ("heading", "50"),
        ("Heading [deg]", "50"),
        ("heading_rad", f"{np.radians(50)}"),
        ("Roll(deg),Pitch(deg),Heading(deg)", "0,0,50"),
        ("qx,qy,qz,qw", f"0,0,{SINE},{COSINE}"),
        ("qw,qx,qy,qz", f"{COSINE},0,0,{SINE}"),
        ("q_x,q_y,q_z,q_w", f"0,0,{SINE},{COSINE}"),
        ("Q_W,Q_X,Q_Y,Q_Z", f"{COSINE},0,0,{SINE}"),
        ("orientation_x,orientation_y,orientation_z,orientation_w", f"0,0,{SINE},{COSINE}"),
        ("orientation.w,orientation.x,orientation.y,orientation.z", f"{COSINE},0,0,{SINE}"),
        ("quat x,quat y,quat z,quat w", f"0,0,{SINE},{COSINE}"),
    ],
)
def test_spellings_of_an_orientation(load, names, values):
    assert np.allclose(angles(load(names, values)), [40, 0, 0], atol=1e-9)


def test_angles_turn_as_those_of_a_pose(load):
    given = load("yaw_deg,pitch_deg,roll_deg", "40,5,-3")
    assert np.allclose(given.pose(0).rotation, TURN.rotation)
    radians = ",".join(map(str, np.radians([40, 5, -3])))
    assert np.allclose(load("yaw_rad,pitch_rad,roll_rad", radians).pose(0).rotation, TURN.rotation)
    # Inertial navigation systems: clockwise from north, nose up, right side down.
    navigation = load("Heading[deg],Pitch[deg],Roll[deg]", "50,-5,-3")
    assert np.allclose(navigation.pose(0).rotation, TURN.rotation)


def test_without_an_orientation_the_carrier_faces_its_direction_of_travel(load):
    assert angles(load()).tolist() == [0, 0, 0]
    assert angles(load("yaw_deg", "40", ignore=["yaw_deg"])).tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    ("names", "values", "words"),
    [
        (
            "roll,yaw",
            "0,40",
            r"'roll' and 'yaw' have no unit. Rename them to roll_deg \(degrees\) and yaw_deg "
            r"\(degrees\), or set `columns: \{roll_deg: roll, yaw_deg: yaw\}`",
        ),
        (
            "stamp,yaw,speed,latitude,roll [mrad]",
            "0,40,1,48,2",
            r"'stamp' and 'yaw' have no unit. .* Its column 'latitude' is a geodetic .* Its column "
            r"'roll \[mrad\]' has the unit 'mrad', .* Unknown column 'speed'\. Rename it, "
            r"or ignore it with `\{file: …, ignore: \[speed\]\}`\. The known columns are ",
        ),
        ("yaw_dge,ptch_deg", "40,2", "mean 'yaw_deg' for 'yaw_dge', 'pitch_deg' for 'ptch_deg'"),
        ("yaw", "40", r"or yaw_rad, or set `columns: \{yaw_deg: yaw\}`"),
        ("heading", "0.5", "'heading' is ambiguous, because its values do not exceed 0.5"),
        ("yaw [mrad]", "40", (r"has the unit 'mrad', which is not supported. Convert it to deg "
                              r"or rad")),
        ("omega,phi,kappa", "0,0,40", "'omega' is a photogrammetric angle"),
        ("Kappa [deg]", "40", "Convert the angles to yaw_deg"),
        ("yaw_deg,yaw_deg", "40,50", "its column 'yaw_deg' occurs twice"),
        ("yaw_deg,yaw_rad", "40,0.7", "'yaw_deg' and 'yaw_rad' both correspond to yaw_deg"),
        ("yaw_deg,heading_deg", "40,50", "both a yaw and a heading"),
        ("pitch_deg", "3", "pitch_deg but neither yaw_deg nor heading_deg"),
        ("pitch_deg,yaw", "3,40", "'yaw' has no unit"),
        ("qx,qy,qz,qw,yaw_deg", "0,0,0,1,40", "both a quaternion and yaw_deg"),
        ("qx,qy,qz,qw,q_w", "0,0,0,1,1", "'qw' and 'q_w' both correspond to qw"),
        ("qz,qw", "0,1", "no columns 'qx' and 'qy'. Its columns are "),
        ("yaw_dge", "40", r"unknown column 'yaw_dge'\. Did you mean 'yaw_deg'\?"),
        ("speed", "40", (r"unknown column 'speed'\. .*ignore it with `\{file: …, ignore: "
                         r"\[speed\]\}")),
        ("speed,course", "40,1", r"'speed', 'course'\. .*ignore them with .*\[speed, course\]"),
        ("q0,q1,q2,q3", "1,0,0,0", "unknown columns 'q0', 'q1', 'q2', 'q3'"),
        ("latitude", "48", "'latitude' is a geodetic coordinate"),
        ("pos_x", "4", "'x' and 'pos_x' both correspond to x"),
        ("timestamp_ns", "4", "'time_s' and 'timestamp_ns' both correspond to time_s"),
        ("", "40", "line 2 has 5 cells, but the header has 4"),
    ],
)  # fmt: skip
def test_a_column_that_is_not_understood_is_refused(load, names, values, words):
    rows = ROWS if names else [f"{row},{values}" for row in ROWS]
    with pytest.raises(LidarError, match=words) as raised:
        load(names, values if names else "", rows=rows)
    assert len(str(raised.value).splitlines()) == 1


def test_the_mapping_that_a_message_gives_leaves_the_columns_out(load):
    columns = "vel_x [m/s],num sats,on,07,fix: rtk"
    with pytest.raises(LidarError) as raised:
        load(columns, "1,2,3,4,5")
    advice = re.search(r"\{file: .*?\}", str(raised.value))[0]
    ignored = yaml.safe_load(advice)["ignore"]
    assert ignored == columns.split(",")
    assert len(load(columns, "1,2,3,4,5", ignore=ignored).times_s) == len(ROWS)


def test_columns_that_are_named_or_ignored(load):
    both = "heading,speed,speed_up", "40,3,4"
    track = load(*both, columns={"yaw_deg": "heading"}, ignore=["Speed*"])
    assert np.isclose(angles(track)[0], 40)
    assert np.isclose(angles(load("psi", "0.7", columns={"yaw_rad": "psi"}))[0], np.degrees(0.7))
    for options, words in (
        ({"ignore": ["speed"]}, "unknown column 'speed_up'"),
        ({"ignore": ["Spede"]}, "ignore contains the unknown column 'Spede'"),
        ({"columns": {"yaw_deg": "Speeed"}}, "no column 'Speeed'"),
        (
            {"columns": {"yaw": "heading"}, "ignore": ["sp*"]},
            "'heading' has no unit. Rename it to yaw",
        ),
        (
            {"columns": {"jaw": "speed"}},
            "columns contains the unknown name 'jaw'. Possible names are time_s",
        ),
    ):
        with pytest.raises(LidarError, match=words):
            load(*both, **options)
    with pytest.raises(
        LidarError,
        match=(
            r"'yaw_rad' as yaw_deg, but the header states the "
            r"unit rad"
        ),
    ):
        load("yaw_rad", "1", columns={"yaw_deg": "yaw_rad"})


def test_times_have_a_unit(load):
    for name, times in (("timestamp [ns]", (0, 1e9)), ("t_ms", (0, 1e3)), ("Time(us)", (0, 1e6))):
        rows = [f"{time:.0f},{x},0,1" for time, x in zip(times, (0, 10), strict=True)]
        assert load(head=f"{name},x,y,z", rows=rows).times_s.tolist() == [0, 1]
    with pytest.raises(LidarError, match=r"'time' has no unit. Rename it to time_s .seconds"):
        load(head="time,x,y,z")
    rows = ["0;0;0;1000", "1;10000;0;1000"]
    track = load(head="time_s;x [mm];y [mm];z [mm]", rows=rows)
    assert track.positions.tolist() == [[0, 0, 1], [10, 0, 1]]


ROW = "0 0 1 0 0 0 1"  # of TUM, without its time
EPOCH_S = 1403636580


@pytest.mark.parametrize(
    ("times", "name", "unit"),
    [
        ((1403636580838555648, 1403636581338555648, 1403636582838555648), "nanoseconds", "ns"),
        ((1403636580838555, 1403636581338555, 1403636582838555), "microseconds", "us"),
        ((1403636580838, 1403636581338, 1403636582838), "milliseconds", "ms"),
        ((0, 500_000_000, 2_000_000_000), "nanoseconds", "ns"),  # since the start of a recording
        ((1_000_000_000_000, 1_000_500_000_000, 1_002_000_000_000), "nanoseconds", "ns"),
        ((1403636580000000, 1403636580000000 + 10_000_000, 1403636600000000), "microseconds", "us"),
    ],
)
@pytest.mark.parametrize("form", ["tum", "csv", "kitti"])
def test_times_that_are_too_large_for_seconds_need_their_unit(tmp_path, form, times, name, unit):
    options = {}
    path = tmp_path / f"drive.{form}"
    if form == "kitti":
        np.savetxt(path, [np.eye(4)[:3].ravel()] * 3)
        (tmp_path / "times.txt").write_text("\n".join(map(str, times)))
        options["times"] = tmp_path / "times.txt"
    elif form == "tum":
        path.write_text("\n".join(f"{time} {ROW}" for time in times))
    else:
        path.write_text("\n".join(["time_s,x,y,z", *(f"{time},0,0,1" for time in times)]))
    words = (
        rf"They are probably {name}. Set `time_unit: {unit}`, or `time_unit: s` if they are correct"
    )
    with pytest.raises(LidarError, match=words) as raised:
        load_trajectory(path, **options)
    assert len(str(raised.value).splitlines()) == 1
    track = load_trajectory(path, time_unit=unit, **options)
    count = {"ns": 1e9, "us": 1e6, "ms": 1e3}[unit]
    assert np.allclose(track.times_s, np.array(times) / count, rtol=0, atol=1e-6)
    seconds = load_trajectory(path, time_unit="s", **options)
    assert seconds.times_s.tolist() == [float(time) for time in times]


def test_the_unit_of_a_header_is_doubted_as_well(load):
    nanoseconds = [f"{EPOCH_S + k}000000000,{x},0,1" for k, x in ((0, 0), (1, 10))]
    for column in ("timestamp [ms]", "time_us", "t_s"):
        with pytest.raises(LidarError, match=r"They are probably nanoseconds. Set `time_unit: ns`"):
            load(head=f"{column},x,y,z", rows=nanoseconds)
        track = load(head=f"{column},x,y,z", rows=nanoseconds, time_unit="ns")
        assert track.times_s.tolist() == [EPOCH_S, EPOCH_S + 1]
    for head, options in (("time,x,y,z", {}), ("stamp_s,x,y,z", {"columns": {"time": "stamp_s"}})):
        track = load(head=head, rows=nanoseconds, time_unit="ns", **options)
        assert track.times_s.tolist() == [EPOCH_S, EPOCH_S + 1]
    with pytest.raises(LidarError, match=r"'time' has no unit.* or set time_unit"):
        load(head="time,x,y,z", rows=nanoseconds)
    with pytest.raises(
        LidarError, match="'time' as time_s, which cannot be combined with time_unit: ns"
    ):
        load(head="time,x,y,z", rows=nanoseconds, columns={"time_s": "time"}, time_unit="ns")


def test_a_span_of_a_year_is_doubted(load):
    year = 366 * 86400
    for first, last in ((0, year), (-year, 0), (1.7e9, 1.7e9 + year), (-9e10, -9e10 + 1)):
        track = load(rows=[f"{first},0,0,1", f"{last},1,0,1"])
        assert track.times_s.tolist() == [first, last]
    for first, last in ((0, year + 1), (-1e11, -1e11 + 1), (1e11, 1e11 + 1)):
        rows = [f"{first},0,0,1", f"{last},1,0,1"]
        with pytest.raises(LidarError, match="its times range from"):
            load(rows=rows)
        assert load(rows=rows, time_unit="s").times_s.tolist() == [first, last]
    stray = [f"{time},{k},0,1" for k, time in enumerate((0, 1.7e9, 1.7e9 + 0.1, 1.7e9 + 0.2))]
    with pytest.raises(LidarError, match=r"a span of 53\.8 years. Correct the outliers"):
        load(rows=stray)


def test_times_of_kitti_may_be_dates(tmp_path):
    np.savetxt(tmp_path / "poses.txt", [np.eye(4)[:3].ravel()] * 2)
    dates = ["2011-09-26 13:02:25.964389445", "2011-09-26 13:02:26.067690100"]
    (tmp_path / "timestamps.txt").write_text("\n".join(dates))
    options = {"times": tmp_path / "timestamps.txt"}
    track = load_trajectory(tmp_path / "poses.txt", **options)
    assert np.allclose(track.times_s, [1317042145.964389445, 1317042146.0676901], atol=1e-6)
    with pytest.raises(LidarError, match="its times are dates, so time_unit cannot be set"):
        load_trajectory(tmp_path / "poses.txt", time_unit="s", **options)


EUROC = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], "
    "q_RS_z [], v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], "
    "b_w_RS_S_y [rad s^-1], b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], "
    "b_a_RS_S_z [m s^-2]"
)


@pytest.mark.parametrize("first", ["#timestamp", "#timestamp [ns]", "# timestamp_ns"])
def test_ground_truth_of_euroc(tmp_path, first):
    rows = [
        f"{time},{x},2,3,{COSINE},0,0,{SINE},1,2,3,4,5,6,7,8,9"
        for time, x in ((1403636580838555648, 1), (1403636581838555648, 2))
    ]
    (tmp_path / "data.csv").write_text("\r\n".join([EUROC.replace("#timestamp", first), *rows]))
    track = load_trajectory(tmp_path / "data.csv")
    assert np.allclose(track.times_s, [1403636580.838555648, 1403636581.838555648], atol=1e-6)
    assert track.positions.tolist() == [[1, 2, 3], [2, 2, 3]]
    assert np.allclose(angles(track), [40, 0, 0])


@pytest.mark.extended
@pytest.mark.parametrize(
    ("remarks", "columns"),
    [
        ((), "xyzw"),
        (("# ground truth trajectory", "# timestamp tx ty tz qx qy qz qw"), "xyzw"),
        (("# timestamp tx ty tz qw qx qy qz",), "wxyz"),
        (("# time x y z qw qx qy qz", "# made by hand"), "wxyz"),
        (("#timestamp [s] tx [m] ty [m] tz [m] qw [] qx [] qy [] qz []",), "wxyz"),
        (("#timestamp, tx, ty, tz, qw, qx, qy, qz",), "wxyz"),
        (("# timestamp,tx,ty,tz,qx,qy,qz,qw",), "xyzw"),
        (("% timestamp tx ty tz qw qx qy qz",), "wxyz"),
        (("# eight words that are no names of anything",), "xyzw"),
        (("timestamp tx ty tz qw qx qy qz",), "wxyz"),
    ],
)
@pytest.mark.parametrize("name", ["drive.tum", "drive.txt", "drive.csv"])
def test_tum_honors_the_order_of_its_header(tmp_path, remarks, columns, name):
    turn = dict(zip("xyzw", (0, 0, SINE, COSINE), strict=True))
    numbers = " ".join(str(turn[axis]) for axis in columns)
    (tmp_path / name).write_text("\n".join([*remarks, f"5 1 2 3 {numbers}", f"6 2 2 3 {numbers}"]))
    track = load_trajectory(tmp_path / name)
    assert track.times_s.tolist() == [5, 6] and track.positions[0].tolist() == [1, 2, 3]
    assert np.allclose(angles(track), [40, 0, 0])


def test_a_header_of_tum_with_unknown_names(tmp_path):
    (tmp_path / "a.tum").write_text("# timestamp tx ty tz a b c d\n0 0 0 0 0 0 0 1\n")
    with pytest.raises(LidarError, match="unknown columns 'a', 'b', 'c', 'd'"):
        load_trajectory(tmp_path / "a.tum")


OXTS = [49.0, 8.4, 112.8, 0.02, -0.01, 0.7, *[0.0] * 24]


@pytest.fixture
def oxts(tmp_path):
    """A drive of KITTI: 0.00001 degrees east and 0.00002 degrees north, 0.1 m up."""
    folder = tmp_path / "2011_09_26_drive_0001_sync" / "oxts"
    (folder / "data").mkdir(parents=True)
    for number, row in enumerate(
        (OXTS, [49.00002, 8.40001, 112.9, *OXTS[3:]], [49.00004, 8.40002, 113.0, *OXTS[3:]])
    ):
        (folder / "data" / f"{number:010}.txt").write_text(" ".join(map(str, row)))
    stamps = [f"2011-09-26 13:02:2{second}.500000000" for second in (5, 6, 7)]
    (folder / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    return folder


def test_oxts_of_kitti(oxts):
    radius = 6378137.0
    scale = np.cos(np.radians(49))

    def mercator(latitude, longitude):
        north = np.log(np.tan((90 + latitude) * np.pi / 360))
        return scale * radius * np.array([np.radians(longitude), north])

    expected = mercator(49.00002, 8.40001) - mercator(49, 8.4)
    for path in (oxts, oxts.parent, oxts / "data"):
        track = load_trajectory(path)
        assert track.times_s[0] == 1317042145.5 and track.duration_ns == 2e9
        assert np.allclose(track.positions[0], 0)
        assert np.allclose(track.positions[1], [*expected, 0.1], atol=1e-6)
        assert np.allclose(angles(track), np.degrees([0.7, -0.01, 0.02]))
    world = load_trajectory(oxts, origin=(49.0, 8.4, 100.0))
    assert np.allclose(world.positions - track.positions, [0, 0, 12.8])
    rows = [OXTS, [*OXTS[:2], 114.0, *OXTS[3:]]]
    np.savetxt(oxts / "0000.txt", rows)
    np.savetxt(oxts / "times.txt", [0, 1])
    track = load_trajectory(oxts / "0000.txt", times=oxts / "times.txt")
    assert np.allclose(track.positions, [[0, 0, 0], [0, 0, 1.2]])


def test_rows_of_oxts_belong_to_the_files_with_their_numbers(oxts):
    (oxts / "data" / "0000000001.txt").unlink()
    track = load_trajectory(oxts)
    assert np.allclose(track.times_s - track.times_s[0], [0, 2])
    assert np.allclose(track.positions[1, 2], 0.2)


def test_oxts_that_are_not_whole(oxts):
    (oxts / "data" / "0000000001.txt").write_text("1 2 3")
    with pytest.raises(LidarError, match=r"0000000001\.txt has 3 numbers instead of 30"):
        load_trajectory(oxts)
    (oxts / "data" / "0000000001.txt").write_text(" ".join(map(str, OXTS)))
    with pytest.raises(LidarError, match="its times are dates, so time_unit cannot be set"):
        load_trajectory(oxts, time_unit="s")
    (oxts / "data" / "0000000001.txt").rename(oxts / "data" / "0000000003.txt")
    with pytest.raises(LidarError, match=r"timestamps\.txt has no row for frame 3. It has 3 rows"):
        load_trajectory(oxts)
    (oxts / "data" / "0000000003.txt").rename(oxts / "data" / "0000000001.txt")
    (oxts / "data" / "0000000002.txt").unlink()
    with pytest.raises(
        LidarError, match=r"timestamps\.txt has rows for frame 2, but the 2 files in data do not"
    ):
        load_trajectory(oxts)
    (oxts / "timestamps.txt").unlink()
    with pytest.raises(LidarError, match=r"a folder must be a KITTI folder with timestamps\.txt"):
        load_trajectory(oxts)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"#ROSBAG V2.0\n\x00\xff", "a ROS 1 bag. Convert it with rosbags-convert"),
        (b"\x89MCAP0\r\n\x00\xff", "must end with .mcap"),
        (b"SQLite format 3\x00\xff", "must end with .db3"),
        (b"TSCANTRJ\x00\xff", "a TerraScan trajectory. Export it as text"),
        (gzip.compress(b"0 0 0 0 0 0 0 1"), "compressed with gzip. Decompress it"),
        (np.arange(34.0).tobytes(), "a binary file in an unknown format"),
        ("time_s,x,y,z".encode("utf-16"), "encoded in UTF-16. Save it as UTF-8"),
        ("# \xe4\n0 0 0 0 0 0 0 1".encode("latin-1"), "not encoded in UTF-8"),
        (b"0,0,0,0,1,0,0,0\n1,1,0,0,1,0,0,0\n", "it has no header. Name its columns"),
        (b"0 0 0 0 0 0 0\n1 1 0 0 0 0 0\n", "7 numbers and no header. TUM rows have 8"),
        (b"1 0 0 0 0 1 0 0 0 0 1 0\n", "KITTI poses have no times"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",  # gzip's bytes have a time
)
@pytest.mark.parametrize("name", ["a.bag", "a.csv"])
def test_other_files_are_named(tmp_path, content, words, name):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(LidarError, match=words) as raised:
        load_trajectory(tmp_path / name)
    assert "codec" not in str(raised.value)


def test_a_trj_of_helios_is_read_with_its_units(tmp_path):
    text = '#HEADER: "t", "roll", "pitch", "yaw", "x", "y", "z"\n0,0,0,0.5,0,0,9\n1,0,0,0.5,5,0,9\n'
    (tmp_path / "a.trj").write_text(text)
    with pytest.raises(
        LidarError,
        match=r"'t', 'roll', .* have no unit.*run `lidarpool import`",
    ):
        load_trajectory(tmp_path / "a.trj")
    columns = {"time_s": "t", "yaw_rad": "yaw", "pitch_rad": "pitch", "roll_rad": "roll"}
    track = load_trajectory(tmp_path / "a.trj", columns=columns)
    assert np.isclose(track.pose(0).yaw_deg, np.degrees(0.5))


def test_options_of_other_formats_are_refused(load, tmp_path):
    for options, words in (
        ({"topic": "/odom"}, "topic requires a bag"),
        ({"origin": (49.0, 8.4, 0.0)}, "origin requires latitudes"),
        ({"format": "bag"}, "a folder must be a KITTI folder|metadata.yaml"),
    ):
        with pytest.raises(LidarError, match=words):
            load("yaw_deg", "40", **options)
    np.savetxt(tmp_path / "a.tum", np.eye(8)[[7, 7]] + np.arange(2)[:, None] * np.eye(8)[0])
    assert isinstance(load_trajectory(tmp_path / "a.tum"), Track)
    with pytest.raises(LidarError, match="columns and ignore require a table"):
        load_trajectory(tmp_path / "a.tum", ignore=["a"])


def test_binary_files_of_times_are_named(tmp_path):
    np.savetxt(tmp_path / "poses.txt", [np.eye(4)[:3].ravel()] * 2)
    (tmp_path / "times.txt").write_bytes(gzip.compress(b"0\n1\n"))
    with pytest.raises(
        LidarError,
        match=r"times\.txt has no times: expected a text file, but it is compressed with gzip",
    ):
        load_trajectory(tmp_path / "poses.txt", times=tmp_path / "times.txt")


def test_a_scenario_depends_on_the_files_of_a_folder(oxts, tmp_path):
    path = tmp_path / "drive.yaml"
    path.write_text(
        f"scene: seed\ntrajectory: {{file: {oxts.parent.name}, origin: [49, 8.4, 100]}}\n"
    )
    names = [file.name for file in Scenario.load(path).files]
    assert names == [f"{number:010}.txt" for number in range(3)] + ["timestamps.txt"]
    assert np.isclose(prepare(Scenario.load(path)).job.survey.pose(0).position[2], 12.8)


def test_a_scenario_states_the_unit_of_its_times(tmp_path):
    for name, start in (("drive.tum", 1403636580), ("car.tum", 1403636580)):
        rows = [f"{(start + k) * 10**9} {k} 0 0 0 0 0 1" for k in range(3)]
        (tmp_path / name).write_text("\n".join(rows))
    unit = {"time_unit": "ns"}
    points = [{"time_s": (1403636580 + k) * 10**9, "position": [k, 9, 0]} for k in range(3)]
    data = {
        "scene": {"ground": {}},
        "sensor": "velodyne/vlp16",
        "trajectory": {"file": "drive.tum", **unit},
        "actors": [
            {"name": "Car", "box": [4, 2, 1], "trajectory": {"file": "car.tum", **unit}},
            {"name": "Van", "box": [4, 2, 1], "trajectory": {"points": points, **unit}},
        ],
    }
    built = prepare(Scenario.from_data(data, folder=tmp_path))
    assert built.job.survey.path.duration_ns == 2e9
    for actor in built.scene.actors:
        assert actor.trajectory.pose(0, 1.5e9).position[0] + built.scene.origin[0] == 1.5
    del data["actors"][1]["trajectory"]["time_unit"]
    with pytest.raises(LidarError, match=r"actor 'Van': points: .* probably nanoseconds"):
        prepare(Scenario.from_data(data, folder=tmp_path))
    del data["actors"][0]["trajectory"]["time_unit"]
    with pytest.raises(LidarError, match=r"actor 'Car': .*car\.tum .* probably nanoseconds"):
        prepare(Scenario.from_data(data, folder=tmp_path))
