"""Spellings, units and conventions of the columns in pose tables."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..io.tables import DEGREES, METERS, NUMBERS, Quantity, TableFormat
from ..io.time_units import SECONDS
from ..numerics.arrays import Floats

# Prefixes of the position components x, y and z, and of the quaternion components.
_POSITIONS = (
    "", "p", "t", "pos", "position", "translation", "pose_position", "pose_pose_position",
    "transform_translation", "p_RS_R",
)  # fmt: skip
_QUATERNIONS = (
    "q", "quat", "quaternion", "orientation", "pose_orientation", "pose_pose_orientation",
    "transform_rotation", "q_RS",
)  # fmt: skip


def _spelled(prefixes: tuple[str, ...], axis: str, *spellings: str) -> tuple[str, ...]:
    """Return column names such as pos_x, one for each prefix, followed by `spellings`."""
    return *(f"{prefix}_{axis}" for prefix in prefixes), *spellings


# Spellings are compared without case, spaces, underscores, hyphens and dots. The first unit is that
# of the returned values. The last argument is the default unit, or None if a unit is required.
TIME = Quantity("time_s", ("time", "t", "timestamp", "stamp"), SECONDS, None)
# World coordinates with x to the east, y to the north and z up.
POSITION = (
    Quantity("x", _spelled(_POSITIONS, "x", "easting", "east"), METERS, "m"),
    Quantity("y", _spelled(_POSITIONS, "y", "northing", "north"), METERS, "m"),
    Quantity("z", _spelled(_POSITIONS, "z", "height", "up"), METERS, "m"),
)
# Rotation from the platform frame (x forward, y left, z up) to the world frame.
QUATERNION = tuple(
    Quantity(f"q{axis}", _spelled(_QUATERNIONS, axis), NUMBERS, "") for axis in "xyzw"
)
# As in `Pose`, yaw is counterclockwise from x about z, pitch is about the new y and positive with
# the nose down, and roll is about the new x and positive with the right side down. The rotations
# are applied in this order.
YAW = Quantity("yaw_deg", ("yaw",), DEGREES, None)
PITCH = Quantity("pitch_deg", ("pitch",), DEGREES, None)
ROLL = Quantity("roll_deg", ("roll",), DEGREES, None)
# A compass heading is clockwise from north (y), so that yaw is 90 degrees minus the heading. In a
# table with a heading, pitch is positive with the nose up, as in the output of inertial navigation
# systems. If the header has no unit, the heading is in degrees, and at least one value must be too
# large for radians.
HEADING = Quantity("heading_deg", ("heading",), DEGREES, "deg", evident_above=2 * np.pi)
ANGLES = (YAW, PITCH, ROLL, HEADING)

POSE_TABLES = (
    # Ground truth of the EuRoC MAV and TUM VI data sets, whose velocities and biases are ignored.
    TableFormat("EuRoC", "p_RS_R_x", {"time_s": "ns"}, ("v_RS_R_?", "b_w_RS_S_?", "b_a_RS_S_?")),
    # Header of the TUM RGB-D benchmark: # timestamp tx ty tz qx qy qz qw
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


def convert_heading(columns: Mapping[str, Floats]) -> dict[str, Floats]:
    """Return the columns of a table, with a heading converted to yaw in degrees.

    Raises
    ------
    ValueError
        If the table has both a heading and a yaw.
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


def stack_angles(columns: Mapping[str, Floats], count: int) -> Floats:
    """Return yaw, pitch and roll in degrees. Missing columns are filled with zeros.

    The result has shape (count, 3).
    """
    zero = np.zeros(count)
    return np.stack([columns.get(quantity.name, zero) for quantity in (YAW, PITCH, ROLL)], axis=1)
