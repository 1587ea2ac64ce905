"""Columns of tables of poses: their spellings, units and conventions."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..io.tables import DEGREES, METERS, NUMBERS, Quantity, TableFormat
from ..io.time_units import SECONDS
from ..numerics.arrays import Floats

# Prefixes that programs write before x, y and z of a position, and before the letters of a
# quaternion.
_POSITIONS = (
    "", "p", "t", "pos", "position", "translation", "pose_position", "pose_pose_position",
    "transform_translation", "p_RS_R",
)  # fmt: skip
_QUATERNIONS = (
    "q", "quat", "quaternion", "orientation", "pose_orientation", "pose_pose_orientation",
    "transform_rotation", "q_RS",
)  # fmt: skip


def _spelled(prefixes: tuple[str, ...], axis: str, *spellings: str) -> tuple[str, ...]:
    """Return the spellings of an axis: with each prefix, and further `spellings`."""
    return *(f"{prefix}_{axis}" for prefix in prefixes), *spellings


# Quantity; its spellings (case, spaces, underscores, hyphens and dots do not count); units that a
# header may state, the first of them for returned values; the unit of a header without unit.
TIME = Quantity("time_s", ("time", "t", "timestamp", "stamp"), SECONDS, None)
# World coordinates of the scene: z is up. Of compass directions, x is east and y north.
POSITION = (
    Quantity("x", _spelled(_POSITIONS, "x", "easting", "east"), METERS, "m"),
    Quantity("y", _spelled(_POSITIONS, "y", "northing", "north"), METERS, "m"),
    Quantity("z", _spelled(_POSITIONS, "z", "height", "up"), METERS, "m"),
)
# Rotation from the carrier frame (x ahead, y left, z up) to the world frame.
QUATERNION = tuple(
    Quantity(f"q{axis}", _spelled(_QUATERNIONS, axis), NUMBERS, "") for axis in "xyzw"
)
# yaw: counter-clockwise from x, about z; pitch: about the new y, positive nose down; roll: about
# the new x, positive right side down. In this order, as of `Pose`.
YAW = Quantity("yaw_deg", ("yaw",), DEGREES, None)
PITCH = Quantity("pitch_deg", ("pitch",), DEGREES, None)
ROLL = Quantity("roll_deg", ("roll",), DEGREES, None)
# Of a compass: clockwise from north (y), so that yaw is 90 degrees less heading. Pitch beside it is
# positive nose up, as inertial navigation systems report both. A compass has degrees; without a
# stated unit, one value has to be too large for radians.
HEADING = Quantity("heading_deg", ("heading",), DEGREES, "deg", evident_above=2 * np.pi)
ANGLES = (YAW, PITCH, ROLL, HEADING)

POSE_TABLES = (
    # Ground truth of the EuRoC MAV and TUM VI data sets; velocities, and biases of the IMU.
    TableFormat("EuRoC", "p_RS_R_x", {"time_s": "ns"}, ("v_RS_R_?", "b_w_RS_S_?", "b_a_RS_S_?")),
    # The TUM RGB-D benchmark: # timestamp tx ty tz qx qy qz qw
    TableFormat("TUM", "tx", {"time_s": "s"}),
)

_NO_PHOTOGRAMMETRY = (
    "is a photogrammetric angle (omega, phi, kappa) with different axes. "
    "Convert the angles to yaw_deg, pitch_deg and roll_deg, or to qx, qy, "
    "qz and qw"
)
_NO_GEODETIC = (
    "is a geodetic coordinate. Convert positions to x, y and z in meters in world coordinates"
)
REFUSED_COLUMNS = {
    **dict.fromkeys(("omega", "phi", "kappa"), _NO_PHOTOGRAMMETRY),
    **dict.fromkeys(("lat", "latitude", "lon", "long", "lng", "longitude"), _NO_GEODETIC),
}


def with_yaw(columns: Mapping[str, Floats]) -> dict[str, Floats]:
    """Return the columns of a table with yaw in place of a heading, degrees.

    Raises
    ------
    ValueError
        If the table has both.
    """
    angles = dict(columns)
    if "heading_deg" not in angles:
        return angles
    if "yaw_deg" in angles:
        raise ValueError("it has both a yaw and a heading. Ignore one of them with `ignore`")
    angles["yaw_deg"] = 90.0 - angles.pop("heading_deg")
    if "pitch_deg" in angles:
        angles["pitch_deg"] = -angles["pitch_deg"]
    return angles


def angles_of(columns: Mapping[str, Floats], count: int) -> Floats:
    """Return yaw, pitch and roll in degrees (count, 3), zero where a table lacks them."""
    zero = np.zeros(count)
    return np.stack([columns.get(quantity.name, zero) for quantity in (YAW, PITCH, ROLL)], axis=1)
