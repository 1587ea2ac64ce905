"""Convert Gazebo lidars, such as <sensor type="gpu_lidar">, to sensor data files."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.errors import LidarError, prefix_errors
from lidarsim.numerics.vectors import matmul
from lidarsim.words import did_you_mean, list_names, printable

from ..writers.lidar_scenario import Lidar, round_value
from .bodies import scoped_name
from .frames import child_numbers, parse_numbers, read_pose
from .notes import unknown_children
from .visibility_flags import LIDARS, lidar_elements, lidar_settings, read_mask
from .world import GazeboWorld, PlacedLink

_COLLISION_LIDARS = ("ray", "lidar")  # their rays hit collision shapes
# Sensor types in SDFormat 1.0 to 1.12 that are not lidars.
_OTHER_SENSORS = (
    *("air_pressure", "air_speed", "altimeter", "contact", "custom", "force_torque", "gps", "imu"),
    *("magnetometer", "navsat", "rfid", "rfidtag", "sonar"),
    *("wireless_receiver", "wireless_transmitter"),
    *("boundingbox", "boundingbox_camera", "camera", "depth", "depth_camera", "logical_camera"),
    *("multicamera", "rgbd", "rgbd_camera", "segmentation", "segmentation_camera", "thermal"),
    *("thermal_camera", "wide_angle_camera", "wideanglecamera"),
)
_SCANS = ("horizontal", "vertical")
_NOISE_UNSUPPORTED = {
    "mean": "the mean of the noise",
    "bias_mean": "the mean of the noise bias",
    "bias_stddev": "the standard deviation of the noise bias",
    "dynamic_bias_stddev": "the dynamic bias of the noise",
    "precision": "the precision of the noise",
}
_MAX_NAMES = 12  # maximum number of names in a line
_RATE_HZ = 10.0  # default update rate
_FULL_TURN = 360.0
_SLACK_DEG = 1e-3
_MAX_SAMPLES = 1_000_000


class GazeboLidar(NamedTuple):
    """A lidar, together with its <visibility_mask>."""

    lidar: Lidar
    mask: int


def find_lidars(world: GazeboWorld) -> Iterator[GazeboLidar]:
    """Yield all lidars in a world.

    Raises LidarError if a lidar has invalid values.
    """
    for link in world.links:
        for element in lidar_elements(link.link.element):
            name = printable(element.get("name", "")) or "lidar"
            full_name = scoped_name((*link.path, name))
            with prefix_errors(f"sensor {full_name!r}"):
                yield GazeboLidar(_lidar(element, link, name, full_name), read_mask(element))


def unknown_sensors(world: GazeboWorld) -> Iterator[str]:
    """Yield a clause for each sensor whose type SDFormat does not define."""
    for link in world.links:
        for element in link.link.element.findall("sensor"):
            kind = element.get("type") or ""
            if kind not in (*LIDARS, *_OTHER_SENSORS):
                name = scoped_name((*link.path, printable(element.get("name", ""))))
                hint = did_you_mean(kind, LIDARS)
                yield f"sensor {name!r} has the unknown type {printable(kind)[:40]!r}.{hint}"


def _unknown_elements(element: Element, figures: Element) -> Iterator[str]:
    """Yield a clause if a lidar has elements that SDFormat does not define."""
    scans = figures.findall("scan")
    parents = [element, figures, *scans]
    parents += [child for scan in scans for name in _SCANS for child in scan.findall(name)]
    parents += [*figures.findall("range"), *figures.findall("noise"), *element.findall("noise")]
    if unknown := dict.fromkeys(tag for parent in parents for tag in unknown_children(parent)):
        yield f"elements that SDFormat does not define ({list_names([*unknown], _MAX_NAMES)})"


def _lidar(element: Element, link: PlacedLink, name: str, full_name: str) -> Lidar:
    """Convert a <sensor> to a lidar."""
    figures = lidar_settings(element)
    if figures is None:
        hint = did_you_mean("lidar", [printable(child.tag) for child in element])
        raise LidarError(f"it has neither <lidar> nor <ray>.{hint}")
    pose = read_pose(element)
    matrix = pose.matrix
    if pose.frame and pose.frame != link.link.name:
        matrix = matmul(link.body.frames.transform_between(pose.frame, link.link.name), matrix)
    unsupported = [*_unknown_elements(element, figures)]
    rate_hz = child_numbers(element, "update_rate", 1, "0").item()
    if rate_hz <= 0:
        rate_hz = _RATE_HZ
        unsupported.append(f"sensors without an update_rate ({_RATE_HZ:g} Hz is used)")
    data: dict[str, Any] = {
        "name": f"{full_name} of Gazebo",
        "sources": {"all": "the world's <sensor>"},
        "rate_hz": round_value(rate_hz),
        **_directions(figures),
    }
    ranges = figures.find("range")
    resolution_m = 0.0 if ranges is None else child_numbers(ranges, "resolution", 1, "0").item()
    if resolution_m > 0:
        data["optics"] = {"resolution_m": round_value(resolution_m)}
    data |= _noise(element, figures, unsupported)
    if element.get("type") in _COLLISION_LIDARS:
        unsupported.append(
            "rays that hit collision shapes (to include them, set geometry: collision in "
            "scene.files)"
        )
    return Lidar(
        name=full_name,
        sensor=name,
        model=link.path[0],
        data=data,
        range_m=_range_m(ranges),
        matrix=matmul(link.matrix, matrix),
        model_matrix=link.model,
        unsupported=tuple(unsupported),
    )


class _Scan(NamedTuple):
    """Evenly spaced angles, including the first and the last one."""

    first_deg: float
    last_deg: float
    samples: int

    @property
    def step_deg(self) -> float:
        """Angle between successive samples, or 0 for a single sample."""
        return (self.last_deg - self.first_deg) / (self.samples - 1) if self.samples > 1 else 0.0


def _scan(figures: Element, name: str, samples: str) -> _Scan:
    """Read the angles in <horizontal> or <vertical>.

    `samples` is the default number.
    """
    scan = figures.find(f"scan/{name}")
    scan = Element(name) if scan is None else scan
    stated = child_numbers(scan, "samples", 1, samples, at_least=1).item()
    count = round(stated * child_numbers(scan, "resolution", 1, "1", at_least=0).item())
    if count > _MAX_SAMPLES:
        raise LidarError(f"<{name}> has {count:,} samples; at most {_MAX_SAMPLES:,} are allowed.")
    angles = [child_numbers(scan, limit, 1, "0").item() for limit in ("min_angle", "max_angle")]
    first_deg, last_deg = np.degrees(angles).tolist()
    if last_deg < first_deg:
        raise LidarError(f"<{name}> has a <max_angle> below its <min_angle>.")
    return _Scan(first_deg, last_deg, max(count, 1) if last_deg > first_deg else 1)


def _directions(figures: Element) -> dict[str, Any]:
    """Return the fields of a data file that describe the ray directions."""
    vertical = _scan(figures, "vertical", "1")
    elevations: Any = [round_value(vertical.first_deg)]
    if vertical.samples > 1:
        limits = {"first": round_value(vertical.first_deg), "last": round_value(vertical.last_deg)}
        elevations = {**limits, "count": vertical.samples}
    horizontal = _scan(figures, "horizontal", "640")
    step_deg = horizontal.step_deg
    count = horizontal.samples
    while count > 1 and count * step_deg > _FULL_TURN + _SLACK_DEG:
        count -= 1  # the last sample repeats the first
    fields: dict[str, Any] = {"firings_per_turn": count}
    if count == 1 or count * step_deg > _FULL_TURN - _SLACK_DEG:
        fields["zero_deg"] = round_value(horizontal.first_deg)
    else:  # the last firing is one step before the end of the scan line
        width_deg = count * step_deg
        fields["zero_deg"] = round_value(horizontal.first_deg + width_deg / 2)
        fields["mirror"] = {"motion": "sawtooth", "width_deg": round_value(width_deg)}
    return {**fields, "beams": {"elevation_deg": elevations}}


def _range_m(ranges: Element | None) -> tuple[float, float]:
    """Return the minimum and maximum range in meters."""
    if ranges is None:
        return 0.0, math.inf
    longest = (ranges.findtext("max") or "inf").strip()
    is_infinite = longest.lower().lstrip("+").startswith("inf")
    max_range_m = math.inf if is_infinite else parse_numbers(longest, "<max>", 1).item()
    return child_numbers(ranges, "min", 1, "0", at_least=0).item(), max_range_m


def _noise(element: Element, figures: Element, unsupported: list[str]) -> dict[str, Any]:
    """Return the fields of a data file that describe noise, and note differences from Gazebo."""
    noise = figures.find("noise")
    noise = element.find("noise") if noise is None else noise
    if noise is None:
        return {}
    kind = (noise.findtext("type") or noise.get("type") or "gaussian").strip()
    if kind not in ("gaussian", "gaussian_quantized", "none"):
        unsupported.append(f"noise of type {printable(kind)[:30]!r}")
        return {}
    for name, words in _NOISE_UNSUPPORTED.items():
        is_used = name != "precision" or kind == "gaussian_quantized"
        if is_used and child_numbers(noise, name, 1, "0").item():
            unsupported.append(words)
    sigma_m = child_numbers(noise, "stddev", 1, "0", at_least=0).item()
    return {"performance": {"range_m": round_value(sigma_m)}} if sigma_m and kind != "none" else {}
