"""Tables with a header: how their columns are found, and what is refused."""

import numpy as np
import pytest

from lidarsim.io.tables import DEGREES, METERS, SECONDS, Quantity, column_name, read_table

TIME = Quantity("time_s", ("time", "t"), SECONDS, None)
RANGE = Quantity("range_m", ("range", "distance"), METERS, "m")
JOINT = Quantity("Arm_1", (), DEGREES, "deg", exact=True)


@pytest.mark.parametrize(
    ("cell", "words", "unit"),
    [
        ("Yaw [deg]", "yaw", "deg"),
        ("yaw(Radians)", "yaw", "rad"),
        ("yaw_rad", "yaw", "rad"),
        ("YawDeg", "yaw", "deg"),
        ("Azimuth/deg", "azimuth", "deg"),
        ("timeStamp", "timestamp", None),
        ("pose.position.x", "posepositionx", None),
        ("q_RS_w []", "qrsw", ""),
        ("v_RS_R_x [m s^-1]", "vrsrx", "m s^-1"),
        ("m", "m", None),
        ("q_1", "q1", None),
    ],
)
def test_names_and_units(cell, words, unit):
    assert column_name(cell)[1:] == (words, unit)


@pytest.mark.parametrize(
    "text",
    [
        "time_s,range\n0,1\n1,2\n",
        "# by hand, 2026\n\ntime_s,range\n# first\n0,1\n\n1,2\n",
        "#time_s,range\n0,1\n1,2\n",
        "T [ns];Distance [mm]\n0;1000\n1e9;2000\n",
        "t_ms\trange_km\n0\t0.001\n1000\t0.002\n",
        'time_s, "range"\n"0", 1\n1 , 2\n',
        "time_s range\n 0 1\n1  2\n",
        "time_s [s] range [m]\n0 1\n1 2\n",
        "# time [s] range [m]\n0 1\n1 2\n",
        "Unnamed: 0,time_s,range,\n0,0,1,\n1,1,2,\n",
    ],
)
def test_tables_as_programs_write_them(text):
    if "time_s [s]" in text:
        text = text.replace("time_s [s]", "time[s]")
    columns = read_table(text, (TIME, RANGE), required=lambda columns: ("time_s", "range_m"))
    assert columns["time_s"].tolist() == [0, 1] and columns["range_m"].tolist() == [1, 2]


def test_exact_names_are_not_spelled_otherwise():
    columns = read_table("time_s,ARM_1,Arm1\n0,2,x\n", (TIME, JOINT), ignore=["arm1"])
    assert columns["Arm_1"].tolist() == [2]
    radians = read_table("time_s,arm_1 [rad]\n0,1\n", (TIME, JOINT))["Arm_1"]
    assert np.isclose(radians[0], np.degrees(1))
    with pytest.raises(ValueError, match="unknown column 'Arm1'"):
        read_table("time_s,Arm1\n0,2\n", (TIME, JOINT))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "0,1\n1,2\n",
            "it has no header. Name its columns in the first line, for example time_s,range_m",
        ),
        ("", "it has no header"),
        ("time_s,range\n", "it has no rows of numbers"),
        ("time,range\n0,1\n", "'time' has no unit. Rename it to time_s .seconds., time_ms"),
        (
            "time_s,range [ft]\n0,1\n",
            "'range \\[ft\\]' has the unit 'ft', which is not supported. Convert it to m, cm",
        ),
        ("time_s,range,range\n0,1,1\n", "its column 'range' occurs twice"),
        ("time_s,range,distance\n0,1,1\n", "'range' and 'distance' both correspond to range_m"),
        ("time_s,rnage\n0,1\n", "unknown column 'rnage'"),
        ("time_s,\n0,car\n", "column 2 has no name, but contains 'car'"),
        ("time_s,range\n0,1\n1,2,3\n", "line 3 has 3 cells, but the header has 2"),
        ("time_s,range\n0,1\n\n1\n", "line 4 has 1 cells"),
        ("time_s,range\n0,1\n1,x\n", "column 'range' contains 'x' in line 3"),
        ("time_s,range\n0,1\n1,inf\n", "column 'range' contains 'inf' in line 3"),
        ("range\n1\n", "it has no column 'time_s'. Its columns are range"),
    ],
)
def test_what_is_not_understood_is_refused(text, words):
    with pytest.raises(ValueError, match=words):
        read_table(text, (TIME, RANGE), required=lambda columns: ("time_s",))
