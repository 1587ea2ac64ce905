"""Export of sensors to HELIOS++ scanner files (.xml), which describe optics instead of rays.

A file contains a <scanner> and <scannerSettings>, which the legs of a survey use as a template. A
HELIOS++ scanner faces along y, with z up and x to the right. All its channels fire at each pulse,
mirrors and heads rotate by a constant step between pulses, and the pulse rate is an integer. If the
pulse rate of a sensor is not an integer, the steps keep their angles and the times are stretched.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from math import isfinite
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from ..errors import LidarError
from ..numerics.arrays import Floats
from ..sensor_files.complete_files import write_complete_text, xml_comment
from ..words import format_rounded
from .beams import Beams, Mirror, Spin
from .noise import Noise
from .ray_sensors import ListedSensor, PrismSensor
from .sensor import LineSensor, Sensor

AXES = "x right, y forward, z up"
MAX_CHANNELS = 1000
MAX_PRISMS = 3
# Rotation from the sensor frame (x forward) to the HELIOS++ frame.
_FRAME = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
# Rotation to the frame of HELIOS++ optics, from a frame in which x is the beam at angle 0 and z is
# the rotation axis of the mirror or prisms.
_OPTICS = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
_REVERSED = np.diag([-1.0, 1, -1])  # rotation for a mirror that turns in the opposite direction
_EVEN_DEG = 1e-6  # tolerance for the angles of an evenly spaced line
_EVEN_NS = 10.0  # tolerance for the times of an evenly spaced line
_MIN_LINE = 3  # minimum number of beams in a line
_ADVICE = "The formats npz and csv support any rays."


@dataclass
class _Channel:
    """A single channel of a HELIOS++ scanner.

    Attributes
    ----------
    rotation
        Rotation matrix of the emitter.
    height_m
        Height of the beam origin in meters.
    incident
        Direction of the light that enters the prisms, or None for other optics. Shape (3,).
    """

    rotation: Floats
    height_m: float = 0.0
    incident: Floats | None = None


@dataclass
class _Scanner:
    """Description of a HELIOS++ scanner.

    Attributes
    ----------
    optics
        Type of the optics.
    pulse_hz
        Pulse rate in the file, which is an integer.
    exact_hz
        Pulse rate of the sensor.
    channels
        Channels of the scanner.
    limits
        Attributes of the <scanner> element, by name.
    settings
        Attributes of the <scannerSettings> element, by name.
    left_out
        Phrases for the properties of the sensor that the file does not store.
    """

    optics: str
    pulse_hz: int
    exact_hz: float
    channels: list[_Channel]
    limits: dict[str, float] = field(default_factory=dict)
    settings: dict[str, float] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)


def write(path: Path, sensor: Sensor, duration_s: float, left_out: Sequence[str]) -> Sequence[str]:
    """Write a sensor as a HELIOS++ scanner, with settings for a scan of `duration_s` seconds.

    Return `left_out`, followed by phrases for further properties that the file does not store.

    Raises
    ------
    LidarError
        If HELIOS++ has no optics that correspond to the sensor. The message states the reason.
    """
    scanner = _create_scanner(sensor, duration_s)
    lost = [*left_out, *scanner.left_out, *_lost_light(sensor), *_lost_rate(scanner)]
    name = re.sub(r"[^\w.-]+", "_", sensor.model).strip("_.").lower() or "lidar"
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f"<!-- {xml_comment(sensor.model)}. Axes of the platform: {AXES}. -->",
        *(f"<!-- Not in this file: {xml_comment(clause)}. -->" for clause in lost),
        f'<!-- In a survey, set scanner="{xml_comment(path.name)}#{name}", and in each leg',
        f'     <scannerSettings template="{xml_comment(path.name)}#{name}"/>. -->',
        "<document>",
        *_scanner_lines(name, sensor, scanner),
        f'  <scannerSettings id="{name}" active="true" pulseFreq_hz="{scanner.pulse_hz}"'
        f"{_format_attributes(scanner.settings)}/>",
        "</document>",
    ]
    write_complete_text(path, "\n".join(lines) + "\n")
    return lost


def _scanner_lines(name: str, sensor: Sensor, scanner: _Scanner) -> list[str]:
    optics = sensor.optics
    numbers: dict[str, float] = {
        "pulseFreqs_Hz": scanner.pulse_hz,
        "pulseLength_ns": optics.pulse_ns,
        "wavelength_nm": round(optics.simulated_nm),
        "beamDivergence_rad": 1e-3 * _divergence_mrad(sensor),
        "accuracy_m": 0.0 if sensor.noise is None else sensor.noise.range_m,
        "rangeMin_m": sensor.min_range_m,
        **({"rangeMax_m": sensor.max_range_m} if isfinite(sensor.max_range_m) else {}),
        **scanner.limits,
    }
    head = f'  <scanner id="{name}" name={quoteattr(sensor.model)} optics="{scanner.optics}"'
    lines = [f"{head}{_format_attributes(numbers)}>"]
    if "headRotatePerSecMax_deg" in scanner.limits:
        lines.append('    <headRotateAxis x="0" y="0" z="1"/>')
    if len(scanner.channels) == 1:
        return [*lines, *_emitter_lines("    ", scanner.channels[0]), "  </scanner>"]
    lines += ['    <beamOrigin x="0" y="0" z="0"/>', "    <channels>"]
    for number, channel in enumerate(scanner.channels):
        lines += [
            f'      <channel id="{number}">',
            *_emitter_lines("        ", channel),
            "      </channel>",
        ]
    return [*lines, "    </channels>", "  </scanner>"]


def _emitter_lines(indent: str, channel: _Channel) -> Iterable[str]:
    """Yield the lines that describe the emitter of a channel."""
    yield f'{indent}<beamOrigin x="0" y="0" z="{_format_number(channel.height_m)}">'
    for axis, angle_deg in _fixed_axis_angles(channel.rotation):
        yield f'{indent}  <rot axis="{axis}" angle_deg="{_format_number(angle_deg)}"/>'
    yield f"{indent}</beamOrigin>"
    if channel.incident is not None:
        x, y, z = channel.incident.tolist()
        yield f'{indent}<incidentBeam x="{x!r}" y="{y!r}" z="{z!r}"/>'


def _fixed_axis_angles(rotation: Floats) -> list[tuple[str, float]]:
    """Decompose a rotation into successive rotations about the fixed x, y and z axes.

    The result contains an axis and an angle in degrees for each rotation that is not zero.
    """
    y_deg = np.degrees(np.arctan2(-rotation[2, 0], np.hypot(rotation[2, 1], rotation[2, 2])))
    if np.hypot(rotation[2, 1], rotation[2, 2]) < 1e-9:  # gimbal lock
        x_deg = np.degrees(np.arctan2(-rotation[1, 2], rotation[1, 1]))
        z_deg = 0.0
    else:
        x_deg = np.degrees(np.arctan2(rotation[2, 1], rotation[2, 2]))
        z_deg = np.degrees(np.arctan2(rotation[1, 0], rotation[0, 0]))
    angles = (("x", float(x_deg)), ("y", float(y_deg)), ("z", float(z_deg)))
    return [(axis, angle_deg) for axis, angle_deg in angles if abs(angle_deg) > 1e-12]


def _format_attributes(numbers: dict[str, float]) -> str:
    """Format numbers as XML attributes, each preceded by a space."""
    return "".join(f' {name}="{_format_number(value)}"' for name, value in numbers.items())


def _format_number(value: float) -> str:
    """Format a number. Integers have no decimal point, because HELIOS++ rejects 1.0."""
    return str(int(value)) if value == int(value) else repr(float(value))


def _divergence_mrad(sensor: Sensor) -> float:
    """Return the divergence of a round beam of equal area, or 0 if the divergence is unknown.

    HELIOS++ only supports round beams.
    """
    if sensor.optics.divergence_mrad is None:
        return 0.0
    across, up = np.broadcast_to(sensor.optics.divergence_mrad, 2).tolist()
    return across if across == up else float(np.sqrt(across * up))


def _lost_light(sensor: Sensor) -> Iterable[str]:
    """Yield the properties of light and noise that HELIOS++ cannot represent, as phrases."""
    divergence_mrad = sensor.optics.divergence_mrad
    if divergence_mrad is not None and np.ptp(divergence_mrad):
        yield (
            "the two divergences of an elliptical beam (written as a round beam with "
            "their geometric mean)"
        )
    if sensor.optics.wavelength_nm is None:
        yield f"an unknown wavelength (written as {sensor.optics.simulated_nm:g} nm)"
    if sensor.optics.simulated_nm % 1:
        yield "fractions of a nanometer of the wavelength"
    if sensor.noise is not None and replace(sensor.noise, range_m=0.0, seed=0) != Noise():
        yield "noise other than range noise"


def _lost_rate(scanner: _Scanner) -> Iterable[str]:
    """Yield a phrase if the pulse rate was rounded to an integer."""
    if abs(scanner.exact_hz - scanner.pulse_hz) > 1e-6 * scanner.exact_hz / 1e3:
        yield (
            f"the exact pulse rate of {scanner.exact_hz:,.2f} Hz (rounded to {scanner.pulse_hz:,} "
            "Hz, with the same angles)"
        )


def _create_scanner(sensor: Sensor, duration_s: float) -> _Scanner:
    """Create the HELIOS++ scanner that corresponds to a sensor.

    Raise LidarError if HELIOS++ has no such optics.
    """
    if isinstance(sensor, PrismSensor):
        return _prism_scanner(sensor, duration_s)
    kind = type(sensor)
    if isinstance(sensor, ListedSensor):
        raise _unsupported(
            sensor, "the sensor is a list of rays, but HELIOS++ scanners have deflecting optics"
        )
    if kind not in (Sensor, LineSensor) or type(sensor.head) not in (Spin, Mirror):
        part = sensor if kind not in (Sensor, LineSensor) else sensor.head
        raise _unsupported(
            sensor, f"HELIOS++ has no optics that correspond to {type(part).__name__}"
        )
    if isinstance(sensor.head, Mirror):
        return _mirror_scanner(sensor, sensor.head, duration_s)
    assert isinstance(sensor.head, Spin)
    if kind is LineSensor:
        raise _unsupported(sensor, "its head rotates about x, but HELIOS++ heads rotate about z")
    line = _line_scanner(sensor, sensor.head, duration_s)
    return line or _multichannel_scanner(sensor, sensor.head, duration_s)


def _unsupported(sensor: Sensor, reason: str) -> LidarError:
    """Create an error that explains why HELIOS++ cannot represent a sensor."""
    return LidarError(
        f"{sensor.model} cannot be written as a HELIOS++ scanner: {reason}. {_ADVICE}"
    )


def _whole_hz(sensor: Sensor, exact_hz: float) -> int:
    """Round a pulse rate to an integer. Raises LidarError if the result is 0."""
    if exact_hz < 0.5:
        raise _unsupported(
            sensor,
            f"it fires {format_rounded(exact_hz)} times per second, but pulseFreq_hz must be a "
            "whole number",
        )
    return round(exact_hz)


def _rotating_scanner(
    head: Spin, pulse_hz: float, pulses_per_firing: int, duration_s: float
) -> _Scanner:
    """Create a scanner that rotates like a sensor's head and that has no channels yet."""
    speed = 360 / head.firings_per_turn * pulse_hz / pulses_per_firing
    total_deg = 360 * head.rate_hz * duration_s
    sign = -1 if head.clockwise else 1
    return _Scanner(
        "rotating",
        round(pulse_hz),
        pulse_hz,
        [],
        {"headRotatePerSecMax_deg": speed},
        {
            "headRotatePerSec_deg": sign * speed,
            "headRotateStart_deg": float(head.zero_deg),
            "headRotateStop_deg": float(head.zero_deg + sign * total_deg),
        },
    )


def _multichannel_scanner(sensor: Sensor, head: Spin, duration_s: float) -> _Scanner:
    """Create a scanner with a rotating head, a stationary mirror and one channel per beam.

    HELIOS++ defines its Velodyne VLP-16 in the same way. A stationary mirror is at angle 0, but its
    scan angle must be greater than 0, because otherwise no pulses leave the device.
    """
    if sensor.channels > MAX_CHANNELS:
        raise _unsupported(
            sensor,
            f"its {sensor.channels:,} beams are not evenly spaced, and more than {MAX_CHANNELS:,} "
            "channels cannot be written",
        )
    exact_hz = head.firings_per_turn * head.rate_hz
    pulse_hz = _whole_hz(sensor, exact_hz)
    scanner = _rotating_scanner(head, pulse_hz, 1, duration_s)
    scanner.exact_hz = exact_hz
    scan_angles = {"scanAngleMax_deg": 1, "scanAngleEffectiveMax_deg": 1}
    scanner.limits |= scan_angles | {"scanFreqMin_Hz": 0, "scanFreqMax_Hz": 0}
    scanner.settings |= {"scanFreq_hz": 0, "scanAngle_deg": 1}
    beams = sensor.beams
    if np.ptp(beams.time_ns):
        scanner.left_out.append("time offsets of the rays in a firing (all channels fire at once)")
    if beams.origin[:, :2].any():
        scanner.left_out.append("ray origins outside the rotation axis of the head")
    scanner.channels = [
        _Channel(_about_z(azimuth) @ _about_x(elevation), height_m)
        for elevation, azimuth, height_m in zip(
            beams.elevation.tolist(),
            beams.azimuth.tolist(),
            beams.origin[:, 2].tolist(),
            strict=True,
        )
    ]
    return scanner


class _EvenLine(NamedTuple):
    """Beams fired upward one after another, evenly spaced in angle and time."""

    lowest_deg: float
    azimuth_deg: float
    step_deg: float
    step_ns: float


def _even_line(beams: Beams, radians_per_ns: float) -> _EvenLine | None:
    """Return the evenly spaced line that the beams form, or None if they do not form one.

    `radians_per_ns` is the angular velocity of the head, which rotates while the beams are fired.
    """
    if len(beams) < _MIN_LINE or beams.origin.any():
        return None
    order = np.argsort(beams.time_ns, kind="stable")
    times_ns = beams.time_ns[order]
    elevations_deg = np.degrees(beams.elevation[order])
    azimuths_deg = np.degrees(beams.azimuth[order] - radians_per_ns * times_ns)
    steps_ns = np.diff(times_ns)
    steps_deg = np.diff(elevations_deg)
    step_ns = float(steps_ns.mean())
    step_deg = float(steps_deg.mean())
    is_even = (
        step_ns > 0
        and step_deg > 0
        and np.abs(steps_ns - step_ns).max() < _EVEN_NS
        and np.abs(steps_deg - step_deg).max() < _EVEN_DEG
        and np.ptp(azimuths_deg) < _EVEN_DEG
    )
    if not is_even:
        return None
    return _EvenLine(float(elevations_deg[0]), float(azimuths_deg[0]), step_deg, step_ns)


def _line_scanner(sensor: Sensor, head: Spin, duration_s: float) -> _Scanner | None:
    """Create a scanner whose mirror sweeps one line per firing.

    The result is None if the beams do not form an evenly spaced line.
    """
    line = _even_line(sensor.beams, head.radians_per_ns)
    if line is None:
        return None
    count = sensor.channels
    firing_hz = head.firings_per_turn * head.rate_hz
    pulses_per_line = max(round(1e9 / (firing_hz * line.step_ns)), count)
    if line.step_deg * pulses_per_line > 360:
        return None  # the mirror would rotate more than once per line
    exact_hz = pulses_per_line * firing_hz
    pulse_hz = _whole_hz(sensor, exact_hz)
    scanner = _rotating_scanner(head, pulse_hz, pulses_per_line, duration_s)
    scanner.exact_hz = exact_hz
    middle_deg = _set_line(scanner, line.step_deg, count, pulses_per_line, pulse_hz)
    tilt_deg = line.lowest_deg + line.step_deg * (count - 1) / 2 - middle_deg
    rotation = _about_z(np.radians(line.azimuth_deg)) @ _about_x(np.radians(tilt_deg))
    scanner.channels = [_Channel(rotation)]
    return scanner


def _set_line(
    scanner: _Scanner, step_deg: float, count: int, pulses_per_line: int, pulse_hz: int
) -> float:
    """Set the mirror of a scanner to sweep lines of `count` pulses.

    The mirror starts at -scanAngleMax_deg and rotates by `step_deg` per pulse. Only pulses between
    verticalAngleMin_deg and verticalAngleMax_deg leave the device. Return the mirror angle at the
    center of the lines, in degrees.
    """
    half_turn_deg = step_deg * pulses_per_line / 2
    first_deg = (pulses_per_line - count) // 2 * step_deg - half_turn_deg
    last_deg = first_deg + (count - 1) * step_deg
    scan_hz = pulse_hz / pulses_per_line
    half_line_deg = (count / 2 + 0.25) * step_deg  # with a margin for rounding errors
    scanner.limits |= {
        "scanAngleMax_deg": half_turn_deg,
        "scanAngleEffectiveMax_deg": half_line_deg,
        "scanFreqMin_Hz": 0,
        "scanFreqMax_Hz": scan_hz,
    }
    scanner.settings |= {
        "scanFreq_hz": scan_hz,
        "scanAngle_deg": half_turn_deg,
        "verticalAngleMin_deg": first_deg - step_deg / 2,
        "verticalAngleMax_deg": last_deg + step_deg / 2,
    }
    return (first_deg + last_deg) / 2


def _mirror_scanner(sensor: Sensor, head: Mirror, duration_s: float) -> _Scanner:
    """Create a scanner whose mirror sweeps a single beam along lines.

    Raise LidarError if HELIOS++ has no corresponding mirror.
    """
    beams = sensor.beams
    if len(beams) > 1 or abs(beams.elevation[0]) > 1e-9 or beams.origin.any():
        raise _unsupported(
            sensor,
            "its mirror must deflect a single beam, centered and perpendicular to the mirror axis",
        )
    if head.motion == "sine":
        raise _unsupported(
            sensor,
            "its mirror oscillates sinusoidally, but a HELIOS++ mirror oscillates at constant "
            "speed",
        )
    count = head.period
    if count is None or count < _MIN_LINE:
        raise _unsupported(
            sensor,
            f"it fires {head.firings_per_turn:g} times per line, which is not a whole number",
        )
    pulses_per_line = count if head.motion == "triangle" else round(count / head.duty)
    exact_hz = pulses_per_line * head.rate_hz
    pulse_hz = _whole_hz(sensor, exact_hz)
    optics = "oscillating" if head.motion == "triangle" else "rotating"
    scanner = _Scanner(optics, pulse_hz, exact_hz, [])
    middle = np.radians(head.zero_deg) + float(beams.azimuth[0])
    sign = -1 if head.clockwise else 1
    if head.motion == "triangle":
        if head.duty != 1:
            raise _unsupported(
                sensor,
                f"its mirror has a duty cycle of {head.duty:g}, but HELIOS++ mirrors do not pause",
            )
        half_deg = head.width_deg / 2
        scan_hz = pulse_hz / count
        scanner.limits |= {
            "scanAngleMax_deg": half_deg,
            "scanFreqMin_Hz": 0,
            "scanFreqMax_Hz": scan_hz,
        }
        scanner.settings |= {"scanFreq_hz": scan_hz, "scanAngle_deg": half_deg}
        scanner.left_out.append(
            "the constant speed of the mirror (HELIOS++ slows it down at the ends of lines)"
        )
    else:
        step_deg = head.width_deg / count
        line_deg = _set_line(scanner, step_deg, count, pulses_per_line, pulse_hz)
        # A line in this package starts at half its width and ends one step before the other half.
        middle -= sign * np.radians(line_deg + step_deg / 2)
    scanner.settings["maxDuration_s"] = duration_s
    axes = np.eye(3) if sensor.axes is None else sensor.axes
    rotation = _FRAME @ axes @ _about_z(middle) @ _OPTICS.T
    scanner.channels = [_Channel(rotation if sign > 0 else rotation @ _REVERSED)]
    return scanner


def _prism_scanner(sensor: PrismSensor, duration_s: float) -> _Scanner:
    """Create a scanner with Risley prisms.

    Raise LidarError if HELIOS++ does not support the prisms.
    """
    if sensor.mirror is not None:
        raise _unsupported(
            sensor, "it has a mirror behind its prisms, which HELIOS++ does not support"
        )
    if len(sensor.prisms) > MAX_PRISMS:
        raise _unsupported(
            sensor, f"it has {len(sensor.prisms)} prisms, but HELIOS++ supports {MAX_PRISMS}"
        )
    if not isinstance(sensor.head, Spin):
        raise _unsupported(
            sensor, f"HELIOS++ has no timing that corresponds to {type(sensor.head).__name__}"
        )
    exact_hz = sensor.head.firings_per_turn * sensor.head.rate_hz
    pulse_hz = _whole_hz(sensor, exact_hz)
    scanner = _Scanner("risley", pulse_hz, exact_hz, [], {"refrIndex_air": 1.0})
    for number, prism in enumerate(sensor.prisms, start=1):
        scanner.limits |= {
            f"refrIndex{number}": prism.index,
            f"angle{number}_deg": prism.wedge_deg if prism.inclined_first else -prism.wedge_deg,
            f"rotorFreq{number}_Hz": prism.rpm / 60 * pulse_hz / exact_hz,
        }
    scanner.settings |= {"maxDuration_s": duration_s}
    phases_deg = [prism.phase_deg % 360 for prism in sensor.prisms]
    if np.ptp(phases_deg):
        listed = ", ".join(f"{phase_deg:g}" for phase_deg in phases_deg)
        scanner.left_out.append(
            f"the starting angles of the prisms, {listed} degrees (the pattern is the same but "
            "starts elsewhere)"
        )
    if np.ptp(sensor.beams.time_ns):
        scanner.left_out.append("time offsets of the rays in a firing (all channels fire at once)")
    # HELIOS++ prisms start at angle 0, so the whole device is rotated to the first prism's phase.
    device = _about_x(np.radians(phases_deg[0]))
    rotation = _FRAME @ device @ _OPTICS.T
    incident = sensor.beam_directions @ (_OPTICS @ device.T).T
    scanner.channels = [_Channel(rotation, incident=vector) for vector in incident]
    return scanner


def _about_x(radians: float) -> Floats:
    sine, cosine = np.sin(radians), np.cos(radians)
    return np.array([[1.0, 0, 0], [0, cosine, -sine], [0, sine, cosine]])


def _about_z(radians: float) -> Floats:
    sine, cosine = np.sin(radians), np.cos(radians)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0.0, 0, 1]])
