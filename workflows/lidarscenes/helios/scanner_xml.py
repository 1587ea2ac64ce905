"""Convert HELIOS++ scanners to sensor data files and rotations on the platform.

HELIOS++ scanners look along y, with z up and x to the right. Mirrors and heads move by a step
between two pulses. This is reproduced, including the rounding to whole pulses per scan line.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from math import ceil, floor
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.transform import rotation_about

from .files import read_number, read_rotation, read_vector, round_values

_Z = np.array([0.0, 0.0, 1.0])
# Rotations from the sensor frame to the frame of HELIOS++, for a scan line to both sides, for a
# cone about the forward direction, for forward-looking prisms, and for a head.
_LINE = rotation_about(np.array([1.0, 0.0, 0.0]), 90)
_CONE = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
_PRISM = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
_HEAD = rotation_about(_Z, 90)
# Maximum rotation per scan with a head. A scan without a head is a full cycle.
_HEAD_STEP_DEG = 10.0
_MAX_WARMUP_S = 86_400.0
_FRAME_HZ = 10.0  # arbitrary, because prism patterns do not repeat
_SLACK = 1e-9  # tolerance for divisions whose exact results are integers

# A data file without name and optics, and the rotation from the sensor frame to HELIOS++'s frame.
ScannerSection = tuple[dict[str, Any], Floats]


@dataclass(frozen=True)
class Device:
    """A scanner, or one of its channels, with the settings of a leg.

    Parameters
    ----------
    data
        Content of the sensor's data file.
    rotation
        Rotation (3, 3) from the sensor frame to the mount on the platform.
    position
        Origin of the beams (3,), relative to the mount, in meters.
    head_s
        Time in seconds from the start of the leg until the head has rotated to its stop; None
        without a head. It is not positive if the head passes its stop before the leg.
    range_m
        Minimum and maximum range.
    line_s
        Duration of a scan line in seconds, or of a pulse if there are no lines.
    delay_s
        Time in seconds from the start of the leg to its first complete scan line.
    """

    data: dict[str, Any]
    rotation: Floats
    position: Floats
    head_s: float | None
    range_m: tuple[float, float]
    line_s: float
    delay_s: float

    def steps(self, seconds: float) -> tuple[float, int]:
        """Return the rotation per time step in degrees, and the number of steps in a duration."""
        turned = 360 * self.data["rate_hz"] * seconds
        count = max(ceil(turned / (360 if self.head_s is None else _HEAD_STEP_DEG) - _SLACK), 1)
        return turned / count, count


class HeliosScanner:
    """The attributes of a scanner or one of its channels.

    The attributes of a channel take precedence over those of the scanner.
    """

    def __init__(self, element: Element, channel: Element | None = None) -> None:
        self._elements = [element] if channel is None else [channel, element]
        self.name = element.get("name") or element.get("id") or "scanner"
        self.values = {**element.attrib, **({} if channel is None else channel.attrib)}

    def child(self, tag: str) -> Element | None:
        """Return the first element with a tag in the channel or else in the scanner, or None."""
        candidates = (element.find(tag) for element in self._elements)
        return next((child for child in candidates if child is not None), None)

    def number(self, name: str, default: float = 0.0) -> float:
        """Return an attribute as a number."""
        return read_number(self.values, name, default)


def read_channels(element: Element) -> dict[str, HeliosScanner]:
    """Return the channels of a scanner, keyed by ID.

    A scanner without channels is returned with an empty ID.
    """
    elements = element.findall("channels/channel")
    if not elements:
        return {"": HeliosScanner(element)}
    return {
        channel.get("id", str(index)): HeliosScanner(element, channel)
        for index, channel in enumerate(elements)
    }


def unsupported_features(scanner: HeliosScanner) -> Iterator[str]:
    """Describe features of a scanner that scenarios do not support."""
    for tag in ("rangeError", "deflectionError", "headError"):
        if scanner.child(tag) is not None:
            yield f"<{tag}> of {scanner.name}"
    if "receivedEnergyMin_W" in scanner.values:
        yield f"receivedEnergyMin_W of {scanner.name} (weak returns are kept)"
    if (max_returns := int(scanner.number("maxNOR"))) > 1:
        yield f"maxNOR={max_returns} of {scanner.name} (all returns of a pulse are kept)"
    if scanner.values.get("optics") == "oscillating":
        yield f"turning points of the oscillating mirror of {scanner.name} (its speed is constant)"


def make_device(scanner: HeliosScanner, settings: dict[str, str]) -> Device:
    """Convert a scanner to a device for the settings of one leg.

    Raises
    ------
    LidarError
        If the scanner's optics are not supported, or if the settings result in no pulses.
    """
    supported = scanner.values.get("pulseFreqs_Hz", "").split(",")[0] or "0"
    pulse_hz = read_number({"pulseFreq_hz": supported} | settings, "pulseFreq_hz", 0)
    if pulse_hz <= 0:
        raise LidarError(f"{scanner.name} must have a pulseFreq_hz above 0.")
    optics = scanner.values.get("optics", "")
    if optics not in ("rotating", *_OPTICS):
        raise LidarError(
            f"{scanner.name} has the optics {optics!r}; it must be one of rotating, "
            f"{', '.join(_OPTICS)}."
        )
    emitter = scanner.child("beamOrigin")
    line = _Line.from_settings(scanner, settings, pulse_hz) if optics == "rotating" else None
    head = _Head.from_settings(scanner, settings, line)
    if head.deg_per_s:
        data, sensor_rotation = _turning_head(scanner, head, line)
    elif line is not None:
        data, line_rotation = line.mirror_sections()
        sensor_rotation = read_rotation(emitter) @ line_rotation
    else:
        data, optics_rotation = _OPTICS[optics](scanner, settings, pulse_hz)
        sensor_rotation = read_rotation(emitter) @ optics_rotation
    warmup_s = _warmup_s(settings, pulse_hz)
    line_s = 1 / pulse_hz
    if line is not None:
        line_s *= line.pulses_per_line
    elif "mirror" in data:
        line_s = 1 / data["rate_hz"]
    # Since sensors start with a complete scan line, the rest of the current line is omitted.
    moved_s = ceil(warmup_s / line_s - _SLACK) * line_s
    return Device(
        data={
            "name": scanner.name,
            "sources": {"all": "a HELIOS++ survey and the files that it refers to"},
            **data,
            "optics": {
                name: round_values(value) for name, value in _light(scanner, settings).items()
            },
        },
        rotation=rotation_about(head.axis, head.start_deg + head.deg_per_s * moved_s)
        @ sensor_rotation,
        position=read_vector(emitter),
        head_s=abs(head.range_deg / head.deg_per_s) - warmup_s if head.deg_per_s else None,
        range_m=(scanner.number("rangeMin_m"), read_number(scanner.values, "rangeMax_m", np.inf)),
        line_s=line_s,
        delay_s=max(moved_s - warmup_s, 0.0),
    )


def _warmup_s(settings: dict[str, str], pulse_hz: float) -> float:
    """Return the time for which head and optics have already moved when a leg starts.

    As in HELIOS++, it is rounded to whole pulses, and negative values have no effect. The time is
    not part of the leg.

    Raises LidarError if the time is too long.
    """
    warmup_s = read_number(settings, "opticsWarmupPhase_s", 0)
    if warmup_s > _MAX_WARMUP_S:
        raise LidarError(
            f"opticsWarmupPhase_s is {warmup_s:g}; it must be at most {_MAX_WARMUP_S:,.0f}."
        )
    return floor(max(warmup_s, 0) * pulse_hz + 0.5) / pulse_hz


def _light(scanner: HeliosScanner, settings: dict[str, str]) -> dict[str, float]:
    """Return the `optics` fields for a scanner and the settings of one leg."""
    divergence = read_number(
        settings, "beamDivergence_rad", scanner.number("beamDivergence_rad", 3e-4)
    )
    return {
        "wavelength_nm": scanner.number("wavelength_nm", 1064),
        "divergence_mrad": 1e3 * divergence,
        "pulse_ns": scanner.number("pulseLength_ns", 4),
        "resolution_m": 0.001,
    }


class _Head(NamedTuple):
    """How a scanner's head rotates."""

    axis: Floats  # (3,)
    start_deg: float
    range_deg: float  # angle between start and stop
    deg_per_s: float  # 0 if the head does not rotate

    @classmethod
    def from_settings(
        cls, scanner: HeliosScanner, settings: dict[str, str], line: _Line | None
    ) -> _Head:
        """Return how a scanner's head rotates with the settings of one leg.

        `line` is the scan line of rotating optics, or None for other optics.
        """
        axis = read_vector(scanner.child("headRotateAxis"))
        axis = axis if np.linalg.norm(axis) > 0.1 else _Z
        start_deg = read_number(settings, "headRotateStart_deg", 0)
        range_deg = read_number(settings, "headRotateStop_deg", 0) - start_deg
        max_deg_per_s = scanner.number("headRotatePerSecMax_deg")
        deg_per_s = read_number(settings, "headRotatePerSec_deg", 0)
        if line is not None:  # a distance between scan lines takes precedence
            by_lines = read_number(settings, "horizontalResolution_deg", 0) * line.scan_hz
            deg_per_s = by_lines or deg_per_s
        limited = float(np.clip(deg_per_s, -max_deg_per_s, max_deg_per_s))
        return cls(axis, start_deg, range_deg, limited)


def _turning_head(scanner: HeliosScanner, head: _Head, line: _Line | None) -> ScannerSection:
    """Return the sensor section for a rotating head.

    Raises LidarError if the settings do not describe a supported rotation.
    """
    aim = _aim(read_rotation(scanner.child("beamOrigin")))
    vertical = abs(head.axis[2]) >= (1 - 1e-12) * np.linalg.norm(head.axis)
    if line is None or aim is None or not vertical:
        raise LidarError(
            f"the head of {scanner.name} rotates. This is supported only for rotating optics "
            "whose scan lines contain the rotation axis z."
        )
    if head.range_deg * head.deg_per_s <= 0:
        raise LidarError(
            f"the head of {scanner.name} rotates from {head.start_deg:g} degrees at "
            f"{head.deg_per_s:g} degrees per second, so it never reaches "
            f"{head.start_deg + head.range_deg:g} degrees."
        )
    return line.head_sections(head.deg_per_s if head.axis[2] > 0 else -head.deg_per_s, aim), _HEAD


class _Aim(NamedTuple):
    """The rotation of an emitter, which is first about x and then about z."""

    tilt_deg: float
    azimuth_deg: float


def _aim(emitter: Floats) -> _Aim | None:
    """Decompose a rotation into two angles, or return None if it includes a roll."""
    if abs(emitter[2, 0]) > 1e-12:
        return None
    tilt = np.arctan2(emitter[2, 1], emitter[2, 2])
    azimuth = np.arctan2(emitter[1, 0], emitter[0, 0])
    return _Aim(float(np.degrees(tilt)), float(np.degrees(azimuth)))


def _exact_us(pulses: int, pulse_hz: float) -> int | str:
    """Return the exact duration of `pulses` in microseconds, as text if it is not an integer."""
    exact = Fraction(pulses * 1_000_000) / Fraction(pulse_hz)
    return exact.numerator if exact.denominator == 1 else str(exact)


@dataclass(frozen=True)
class _Line:
    """The pulses in a scan line of a rotating polygon mirror.

    A scan line takes the time of `pulses_per_line` pulses, of which `count` are within its angles.
    """

    first_deg: float
    step_deg: float
    count: int
    pulses_per_line: int
    pulse_hz: float
    scan_hz: float  # 0 if the mirror does not move

    @classmethod
    def from_settings(
        cls, scanner: HeliosScanner, settings: dict[str, str], pulse_hz: float
    ) -> _Line:
        """Return a scanner's scan line with the settings of one leg.

        Raises LidarError if the scan line contains no pulse.
        """
        max_deg = scanner.number("scanAngleMax_deg")
        effective_deg = scanner.number("scanAngleEffectiveMax_deg")
        resolution_deg = read_number(settings, "verticalResolution_deg", 0)
        min_hz = scanner.number("scanFreqMin_Hz")
        if not (resolution_deg or min_hz or read_number(settings, "scanFreq_hz", 0)):
            return cls(0.0, 0.0, 1, 1, pulse_hz, 0.0)  # the mirror does not move
        scan_hz = _scan_hz(
            scanner, settings, pulse_hz * resolution_deg / (2 * max_deg) if resolution_deg else None
        )
        half_deg = min(effective_deg, _half_angle_deg(scanner, settings))
        lowest_deg = read_number(settings, "verticalAngleMin_deg", -half_deg)
        highest_deg = read_number(settings, "verticalAngleMax_deg", half_deg)
        if (
            highest_deg - lowest_deg > 2 * effective_deg + _SLACK
        ):  # HELIOS++ 1 omits such pulses, and HELIOS++ 2 refuses them
            lowest_deg = max(lowest_deg, -effective_deg)
            highest_deg = min(highest_deg, effective_deg)
        step_deg = 2 * max_deg * scan_hz / pulse_hz
        pulses_per_line = ceil(pulse_hz / scan_hz - _SLACK)
        # The lowest angle is exclusive and the highest inclusive. The next scan line starts before
        # a full revolution.
        first = floor((lowest_deg + max_deg) / step_deg + _SLACK) + 1
        last = min(floor((highest_deg + max_deg) / step_deg + _SLACK), pulses_per_line - 1)
        if last < first:
            raise LidarError(
                f"scan lines of {scanner.name} from {lowest_deg:g} to {highest_deg:g} degrees "
                "contain no pulse."
            )
        return cls(
            first * step_deg - max_deg,
            step_deg,
            last - first + 1,
            pulses_per_line,
            pulse_hz,
            scan_hz,
        )

    def mirror_sections(self) -> ScannerSection:
        """Return the sensor section for a mirror without a head. Each pulse becomes a firing.

        Raises
        ------
        LidarError
            If the mirror does not move.
        """
        if not self.scan_hz:
            raise LidarError("scanFreq_hz is 0, and the head does not rotate.")
        width = self.count * self.step_deg
        mirror = {
            "motion": "sawtooth",
            "width_deg": round_values(min(width, 360)),
            "duty": round_values(self.count / self.pulses_per_line),
        }
        middle = self.first_deg + width / 2
        return _mirror(self.count, self.pulse_hz / self.pulses_per_line, mirror, middle), _LINE

    def head_sections(self, deg_per_s: float, aim: _Aim) -> dict[str, Any]:
        """Return the sensor section for a rotating head. Each scan line becomes a firing."""
        between_us = 1e6 / self.pulse_hz
        last = round_values((self.count - 1) * between_us)
        times = {"time_us": {"first": 0, "last": last, "count": self.count}}
        data = {
            "firing_us": _exact_us(self.pulses_per_line, self.pulse_hz),
            "rate_hz": abs(deg_per_s) / 360,
            "beams": self._angles(aim) | times,
        }
        return data if deg_per_s > 0 else {"clockwise": True, **data}

    def _angles(self, aim: _Aim) -> dict[str, Any]:
        """Return the beam angles of the pulses.

        Pulses beyond the zenith have the opposite azimuth.
        """
        angles = self.first_deg + aim.tilt_deg + self.step_deg * np.arange(self.count)
        if np.abs(angles).max() <= 90 + _SLACK:
            first, last = (round_values(end) for end in angles[[0, -1]].clip(-90, 90))
            elevations_deg = {"first": first, "last": last, "count": self.count}
            if not round_values(aim.azimuth_deg):
                return {"elevation_deg": elevations_deg}
            azimuths_deg = round_values(np.full(self.count, aim.azimuth_deg))
            return {"elevation_deg": elevations_deg, "azimuth_deg": azimuths_deg}
        angles = (angles + 180) % 360 - 180
        behind = np.abs(angles) > 90
        elevations = np.where(behind, np.copysign(180, angles) - angles, angles)
        return {
            "elevation_deg": round_values(elevations),
            "azimuth_deg": round_values(np.where(behind, 180.0, 0.0) + aim.azimuth_deg),
        }


def _mirror(
    firings: int, rate_hz: float, mirror: dict[str, Any], middle: float = 0.0
) -> dict[str, Any]:
    """Return the sensor section for a mirror.

    The center of the scan lines is at `middle` degrees.
    """
    data: dict[str, Any] = {"axis": "x", "firings_per_turn": firings, "rate_hz": rate_hz}
    return (
        data
        | ({"zero_deg": round_values(middle)} if round_values(middle) else {})
        | {"mirror": mirror}
    )


def _oscillating(
    scanner: HeliosScanner, settings: dict[str, str], pulse_hz: float
) -> ScannerSection:
    """Return the sensor section for an oscillating mirror.

    The angle of the mirror is limited by the scan product.
    """
    scan_hz = _scan_hz(scanner, settings)
    max_deg = scanner.number("scanProduct", 1e6) / scan_hz
    half_deg = min(read_number(settings, "scanAngle_deg", 0), max_deg)
    firings = floor(pulse_hz / scan_hz + _SLACK)
    if half_deg <= 0 or not firings:
        raise LidarError(
            f"{scanner.name} must have a scanAngle_deg above 0 and at least one pulse per scan "
            "line."
        )
    mirror = {"motion": "triangle", "width_deg": round_values(2 * half_deg)}
    return _mirror(firings, pulse_hz / firings, mirror), _LINE


def _fibers(scanner: HeliosScanner, settings: dict[str, str], pulse_hz: float) -> ScannerSection:
    """Return the sensor section for adjacent fibers, each of which fires once per scan line."""
    fibers = max(int(scanner.number("numFibers", 1)), 1)
    mirror = {
        "motion": "sawtooth",
        "width_deg": round_values(2 * _half_angle_deg(scanner, settings)),
    }
    return _mirror(fibers, pulse_hz / fibers, mirror), _LINE


def _cone(scanner: HeliosScanner, settings: dict[str, str], pulse_hz: float) -> ScannerSection:
    """Return the sensor section for a rotating wedge (Palmer scanner).

    As in HELIOS++, the wedge rotates at its maximum rate.
    """
    rate_hz = scanner.number("scanFreqMax_Hz")
    if rate_hz <= 0:
        raise LidarError(f"{scanner.name} must have a scanFreqMax_Hz above 0.")
    beams = {"elevation_deg": [round_values(90 - _half_angle_deg(scanner, settings))]}
    start_deg = round_values(360 * rate_hz * _warmup_s(settings, pulse_hz) % 360)
    return {
        **({"zero_deg": start_deg} if start_deg else {}),
        "firing_us": _exact_us(1, pulse_hz),
        "rate_hz": rate_hz,
        "beams": beams,
    }, _CONE


def _prisms(scanner: HeliosScanner, settings: dict[str, str], pulse_hz: float) -> ScannerSection:
    """Return the sensor section for Risley prisms."""
    air = scanner.number("refrIndex_air", 1)
    warmup_s = _warmup_s(settings, pulse_hz)
    prisms = [
        {
            "wedge_deg": round_values(abs(angle)),
            "index": round_values(scanner.number(f"refrIndex{i}", 1) / air),
            "rpm": round_values(60 * (rotor_hz := scanner.number(f"rotorFreq{i}_Hz"))),
            **({"phase_deg": round_values(360 * rotor_hz * warmup_s % 360)} if warmup_s else {}),
            "inclined_first": angle > 0,
        }
        for i in (1, 2, 3)
        if abs(angle := scanner.number(f"angle{i}_deg")) > 1e-6
    ]
    if not prisms:
        raise LidarError(f"{scanner.name} has no prisms.")
    section: dict[str, Any] = {
        "firing_us": _exact_us(1, pulse_hz),
        "rate_hz": _FRAME_HZ,
        "prisms": prisms,
    }
    if (incident := scanner.child("incidentBeam")) is not None:
        x, y, z = _PRISM.T @ read_vector(incident)
        elevation = np.arctan2(z, np.hypot(x, y))
        azimuth = np.arctan2(y, x)
        section["beams"] = {
            "elevation_deg": [round_values(np.degrees(elevation))],
            "azimuth_deg": [round_values(np.degrees(azimuth))],
        }
    return section, _PRISM


_OPTICS: dict[str, Callable[[HeliosScanner, dict[str, str], float], ScannerSection]] = {
    "oscillating": _oscillating,
    "conic": _cone,
    "line": _fibers,
    "risley": _prisms,
}


def _half_angle_deg(scanner: HeliosScanner, settings: dict[str, str]) -> float:
    """Return the scan angle to either side, up to the scanner's maximum.

    The maximum is also the default.
    """
    max_deg = scanner.number("scanAngleMax_deg")
    half_deg = min(max(read_number(settings, "scanAngle_deg", 0), 0), max_deg) or max_deg
    if half_deg <= 0:
        raise LidarError(f"{scanner.name} must have a scanAngleMax_deg above 0.")
    return half_deg


def _scan_hz(
    scanner: HeliosScanner, settings: dict[str, str], requested_hz: float | None = None
) -> float:
    """Return the scan frequency in lines per second.

    Raises LidarError if it is outside the scanner's limits.
    """
    rate_hz = read_number(settings, "scanFreq_hz", 0) if requested_hz is None else requested_hz
    min_hz = scanner.number("scanFreqMin_Hz")
    max_hz = scanner.number("scanFreqMax_Hz") or np.inf
    if not min_hz <= rate_hz <= max_hz or rate_hz <= 0:
        raise LidarError(
            f"{scanner.name} has a scanFreq_hz of {rate_hz:g}; it must be above 0 and from "
            f"{min_hz:g} to {max_hz:g}."
        )
    return rate_hz
