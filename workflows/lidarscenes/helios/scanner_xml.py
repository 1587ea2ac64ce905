"""Scanners of HELIOS++ as sensors: data files, and rotations on their platforms.

HELIOS++ looks along y with z up and x to the right. Every pulse is one step: mirrors and heads move
by their step between two pulses, which is reproduced here, including rounded lines.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from math import ceil, floor
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.base.arrays import Floats
from lidarsim.base.errors import LidarError
from lidarsim.scene.transform import rotation_about as about

from .files import clean, number, rotation, vector

_Z = np.array([0.0, 0.0, 1.0])
# From the axes of our sensors to those of HELIOS++: of a line to both sides, of a cone about the
# way ahead, of prisms before the eye.
_LINE = about(np.array([1.0, 0.0, 0.0]), 90)
_CONE = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
_PRISM = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
_HEAD = about(_Z, 90)
_HEAD_STEP_DEG = 10.0  # of a head that turns, in one scan; of others it is a cycle at most
_FRAME_HZ = 10.0  # prisms have no cycle
_SLACK = 1e-9  # of divisions that should come out even

# A data file but for its name and light, and the rotation from our axes to those of HELIOS++.
ScannerSection = tuple[dict[str, Any], Floats]


@dataclass(frozen=True)
class Device:
    """A scanner, or one of its channels, with the settings of a leg.

    Parameters
    ----------
    data
        Its data file.
    turn, place
        Rotation (3, 3) from the sensor's axes to those of the platform's mount, and where the
        light leaves, metres beside the mount.
    head_s
        How long its head takes from start to stop, seconds; None where it does not turn.
    range_m
        The nearest and the farthest that it sees.
    """

    data: dict[str, Any]
    turn: Floats
    place: Floats
    head_s: float | None
    range_m: tuple[float, float]

    def steps(self, seconds: float) -> tuple[float, int]:
        """Degrees and number of the time steps that so many seconds are whole multiples of."""
        turned = 360 * self.data["rate_hz"] * seconds
        count = max(ceil(turned / (360 if self.head_s is None else _HEAD_STEP_DEG) - _SLACK), 1)
        return turned / count, count


class HeliosScanner:
    """Attributes of a scanner, in its channels those of the channel before its own."""

    def __init__(self, element: Element, channel: Element | None = None) -> None:
        self._elements = [element] if channel is None else [channel, element]
        self.name = element.get("name") or element.get("id") or "scanner"
        self.values = {**element.attrib, **({} if channel is None else channel.attrib)}

    def child(self, tag: str) -> Element | None:
        """Element within it."""
        found = (element.find(tag) for element in self._elements)
        return next((child for child in found if child is not None), None)

    def number(self, name: str, default: float = 0.0) -> float:
        """Attribute of it."""
        return number(self.values, name, default)


def channels(element: Element) -> dict[str, HeliosScanner]:
    """List the channels of a scanner by id; "" is the only one of a scanner without any."""
    found = element.findall("channels/channel")
    if not found:
        return {"": HeliosScanner(element)}
    return {
        channel.get("id", str(index)): HeliosScanner(element, channel)
        for index, channel in enumerate(found)
    }


def unread(scanner: HeliosScanner) -> Iterator[str]:
    """List the features of a scanner that a scenario does not support."""
    for tag in ("rangeError", "deflectionError", "headError"):
        if scanner.child(tag) is not None:
            yield f"<{tag}> of {scanner.name}: errors by a formula"
    if "receivedEnergyMin_W" in scanner.values:
        yield f"receivedEnergyMin_W of {scanner.name}: weak returns are kept"
    if (most := int(scanner.number("maxNOR"))) > 1:
        yield f"maxNOR={most} of {scanner.name}: all returns of a pulse are kept"
    if scanner.values.get("optics") == "oscillating":
        yield f"the slow turns of the mirror of {scanner.name}: it goes to and fro evenly"


def device(scanner: HeliosScanner, settings: dict[str, str]) -> Device:
    """Return a scanner with the settings of a leg.

    Raises
    ------
    LidarError
        If its optics are of a kind that there is no sensor for, or its settings make no line.
    """
    supported = scanner.values.get("pulseFreqs_Hz", "").split(",")[0] or "0"
    pulses = number({"pulseFreq_hz": supported} | settings, "pulseFreq_hz", 0)
    if pulses <= 0:
        raise LidarError(f"{scanner.name} has no pulseFreq_hz above 0.")
    optics = scanner.values.get("optics", "")
    if optics not in ("rotating", *_OPTICS):
        raise LidarError(
            f"{scanner.name} has the optics {optics!r}; there are rotating, {', '.join(_OPTICS)}."
        )
    axis = vector(scanner.child("headRotateAxis"))
    axis = axis if np.linalg.norm(axis) > 0.1 else _Z
    emitter = scanner.child("beamOrigin")
    start = number(settings, "headRotateStart_deg", 0)
    range_deg = number(settings, "headRotateStop_deg", 0) - start
    line = _Line.of(scanner, settings, pulses) if optics == "rotating" else None
    most = scanner.number("headRotatePerSecMax_deg")
    wished = number(settings, "headRotatePerSec_deg", 0)
    if line is not None:  # by the distance of its lines, where that is given
        wished = number(settings, "horizontalResolution_deg", 0) * line.scan_hz or wished
    head = float(np.clip(wished, -most, most))
    if head:
        tilt = _tilt(rotation(emitter))
        if line is None or tilt is None or abs(axis[2]) < (1 - 1e-12) * np.linalg.norm(axis):
            raise LidarError(
                f"the head of {scanner.name} turns; only one with rotating optics may, whose lines "
                "hold the axis z that it turns about."
            )
        if range_deg * head <= 0:
            raise LidarError(
                f"the head of {scanner.name} turns at {head:g} degrees a second from {start:g}, "
                f"never to {start + range_deg:g}."
            )
        head = head if axis[2] > 0 else -head
        data = line.turning(head, tilt)
        turn = _HEAD
    else:
        data, turn = line.standing() if line else _OPTICS[optics](scanner, settings, pulses)
        turn = rotation(emitter) @ turn
    divergence = number(settings, "beamDivergence_rad", scanner.number("beamDivergence_rad", 3e-4))
    light = {
        "wavelength_nm": scanner.number("wavelength_nm", 1064),
        "divergence_mrad": 1e3 * divergence,
        "pulse_ns": scanner.number("pulseLength_ns", 4),
        "resolution_m": 0.001,
    }
    return Device(
        {
            "name": scanner.name,
            "sources": {"all": "a HELIOS++ survey and what it names"},
            **data,
            "optics": {name: clean(value) for name, value in light.items()},
        },
        about(axis, start) @ turn,
        vector(emitter),
        abs(range_deg / head) if head else None,
        (scanner.number("rangeMin_m"), number(scanner.values, "rangeMax_m", np.inf)),
    )


def _tilt(emitter: Floats) -> float | None:
    """Degrees that a rotation about x turns by; None for others."""
    if not np.allclose(emitter[0], [1, 0, 0], atol=1e-12):
        return None
    return float(np.degrees(np.arctan2(emitter[2, 1], emitter[1, 1])))


def _us(pulses: int, pulse_hz: float) -> int | str:
    """Exact duration of so many pulses, microseconds."""
    exact = Fraction(pulses * 1_000_000) / Fraction(pulse_hz)
    return exact.numerator if exact.denominator == 1 else str(exact)


@dataclass(frozen=True)
class _Line:
    """Pulses of a polygon's line: those within its angles, of all that there is time for."""

    first_deg: float
    step_deg: float
    count: int
    of_all: int
    pulse_hz: float
    scan_hz: float

    @classmethod
    def of(cls, scanner: HeliosScanner, settings: dict[str, str], pulse_hz: float) -> _Line:
        most = scanner.number("scanAngleMax_deg")
        wide = scanner.number("scanAngleEffectiveMax_deg")
        fine = number(settings, "verticalResolution_deg", 0)
        least = scanner.number("scanFreqMin_Hz")
        if not (fine or least or number(settings, "scanFreq_hz", 0)):
            return cls(0.0, 0.0, 1, 1, pulse_hz, 0.0)  # the mirror stands
        scan_hz = _scan_hz(scanner, settings, pulse_hz * fine / (2 * most) if fine else None)
        half = min(wide, _half(scanner, settings))
        low = number(settings, "verticalAngleMin_deg", -half)
        high = number(settings, "verticalAngleMax_deg", half)
        if high - low > 2 * wide + _SLACK:  # HELIOS++ 1 leaves such pulses out, 2 refuses them
            low = max(low, -wide)
            high = min(high, wide)
        step = 2 * most * scan_hz / pulse_hz
        of_all = ceil(pulse_hz / scan_hz - _SLACK)
        # Angles above `low`, up to `high`; a line begins anew before it is all round.
        first = floor((low + most) / step + _SLACK) + 1
        last = min(floor((high + most) / step + _SLACK), of_all - 1)
        if last < first:
            raise LidarError(
                f"lines of {scanner.name} from {low:g} to {high:g} degrees hold no pulse."
            )
        return cls(first * step - most, step, last - first + 1, of_all, pulse_hz, scan_hz)

    def standing(self) -> ScannerSection:
        """Return a mirror whose firings are pulses."""
        if not self.scan_hz:
            raise LidarError("scanFreq_hz is 0, and no head turns.")
        width = self.count * self.step_deg
        mirror = {
            "motion": "sawtooth",
            "width_deg": clean(min(width, 360)),
            "duty": clean(self.count / self.of_all),
        }
        middle = self.first_deg + width / 2
        return _mirror(self.count, self.pulse_hz / self.of_all, mirror, middle), _LINE

    def turning(self, head: float, tilt: float) -> dict[str, Any]:
        """Return a head whose firings are lines."""
        between_us = 1e6 / self.pulse_hz
        last = clean((self.count - 1) * between_us)
        times = {"time_us": {"first": 0, "last": last, "count": self.count}}
        data = {
            "firing_us": _us(self.of_all, self.pulse_hz),
            "rate_hz": abs(head) / 360,
            "beams": self._elevations(tilt) | times,
        }
        return data if head > 0 else {"clockwise": True, **data}

    def _elevations(self, tilt: float) -> dict[str, Any]:
        """Return the angles of the pulses; those beyond the zenith go down on the other side."""
        angles = self.first_deg + tilt + self.step_deg * np.arange(self.count)
        if np.abs(angles).max() <= 90 + _SLACK:
            first, last = (clean(end) for end in angles[[0, -1]].clip(-90, 90))
            return {"elevation_deg": {"first": first, "last": last, "count": self.count}}
        angles = (angles + 180) % 360 - 180
        behind = np.abs(angles) > 90
        elevations = np.where(behind, np.copysign(180, angles) - angles, angles)
        return {
            "elevation_deg": clean(elevations),
            "azimuth_deg": clean(np.where(behind, 180.0, 0.0)),
        }


def _mirror(
    firings: int, rate_hz: float, mirror: dict[str, Any], middle: float = 0.0
) -> dict[str, Any]:
    data: dict[str, Any] = {"axis": "x", "firings_per_turn": firings, "rate_hz": rate_hz}
    return data | ({"zero_deg": clean(middle)} if clean(middle) else {}) | {"mirror": mirror}


def _oscillating(
    scanner: HeliosScanner, settings: dict[str, str], pulse_hz: float
) -> ScannerSection:
    """Make a mirror that swings; the scan product limits its angle."""
    scan_hz = _scan_hz(scanner, settings)
    most = scanner.number("scanProduct", 1e6) / scan_hz
    half = min(number(settings, "scanAngle_deg", 0), most)
    firings = floor(pulse_hz / scan_hz + _SLACK)
    if half <= 0 or not firings:
        raise LidarError(f"{scanner.name} has no scanAngle_deg above 0, or no pulse in a line.")
    mirror = {"motion": "triangle", "width_deg": clean(2 * half)}
    return _mirror(firings, pulse_hz / firings, mirror), _LINE


def _fibers(scanner: HeliosScanner, settings: dict[str, str], pulse_hz: float) -> ScannerSection:
    """Make fibres side by side, one pulse each."""
    fibers = max(int(scanner.number("numFibers", 1)), 1)
    mirror = {"motion": "sawtooth", "width_deg": clean(2 * _half(scanner, settings))}
    return _mirror(fibers, pulse_hz / fibers, mirror), _LINE


def _cone(scanner: HeliosScanner, settings: dict[str, str], pulse_hz: float) -> ScannerSection:
    """Make a wedge that turns (Palmer); always at its greatest rate, as in HELIOS++."""
    rate_hz = scanner.number("scanFreqMax_Hz")
    if rate_hz <= 0:
        raise LidarError(f"{scanner.name} has no scanFreqMax_Hz above 0.")
    beams = {"elevation_deg": [clean(90 - _half(scanner, settings))]}
    return {"firing_us": _us(1, pulse_hz), "rate_hz": rate_hz, "beams": beams}, _CONE


def _prisms(scanner: HeliosScanner, settings: dict[str, str], pulse_hz: float) -> ScannerSection:
    """Make Risley prisms."""
    air = scanner.number("refrIndex_air", 1)
    prisms = [
        {
            "wedge_deg": clean(abs(angle)),
            "index": clean(scanner.number(f"refrIndex{i}", 1) / air),
            "rpm": clean(60 * scanner.number(f"rotorFreq{i}_Hz")),
            "inclined_first": angle > 0,
        }
        for i in (1, 2, 3)
        if abs(angle := scanner.number(f"angle{i}_deg")) > 1e-6
    ]
    if not prisms:
        raise LidarError(f"{scanner.name} has no prisms.")
    made: dict[str, Any] = {"firing_us": _us(1, pulse_hz), "rate_hz": _FRAME_HZ, "prisms": prisms}
    if (incident := scanner.child("incidentBeam")) is not None:
        x, y, z = _PRISM.T @ vector(incident)
        elevation = np.arctan2(z, np.hypot(x, y))
        azimuth = np.arctan2(y, x)
        made["beams"] = {
            "elevation_deg": [clean(np.degrees(elevation))],
            "azimuth_deg": [clean(np.degrees(azimuth))],
        }
    return made, _PRISM


_OPTICS: dict[str, Callable[[HeliosScanner, dict[str, str], float], ScannerSection]] = {
    "oscillating": _oscillating,
    "conic": _cone,
    "line": _fibers,
    "risley": _prisms,
}


def _half(scanner: HeliosScanner, settings: dict[str, str]) -> float:
    """Scan angle to either side: at most the scanner's, which is also that of 0."""
    most = scanner.number("scanAngleMax_deg")
    half = min(max(number(settings, "scanAngle_deg", 0), 0), most) or most
    if half <= 0:
        raise LidarError(f"{scanner.name} has no scanAngleMax_deg above 0.")
    return half


def _scan_hz(
    scanner: HeliosScanner, settings: dict[str, str], wished: float | None = None
) -> float:
    """Lines a second, within the scanner's limits."""
    rate_hz = number(settings, "scanFreq_hz", 0) if wished is None else wished
    least = scanner.number("scanFreqMin_Hz")
    most = scanner.number("scanFreqMax_Hz") or np.inf
    if not least <= rate_hz <= most or rate_hz <= 0:
        raise LidarError(
            f"{scanner.name} cannot scan at scanFreq_hz {rate_hz:g}: {least:g} to {most:g}, above "
            "0."
        )
    return rate_hz
