"""Rays as an OmniLidar prim of Isaac Sim and Omniverse (.usda).

Attributes by the extension omni.sensors.nv.lidar ("Setting Lidar Attributes") and the schemas
OmniSensorGenericLidarCoreAPI and OmniSensorGenericLidarCoreEmitterStateAPI. The pattern suits a
solid-state lidar: each scan fires one emitter state, a list of azimuths, elevations and times.
Several states follow each other scan by scan, so that a pattern need not repeat with each scan. A
rotary pattern would round times and azimuths to ticks of a whole number of hertz.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import isfinite
from pathlib import Path

import numpy as np

from ..base.arrays import AnyArray, Ints
from ..base.errors import LidarError
from .complete_files import write_text_of
from .fired_rays import AXES, FiredRays

CORE = "omni:sensor:Core:"
STATE = f"{CORE}emitterState:"
MAX_STATES = 999  # whose names have three digits
MIN_RATE_HZ = 1  # scanRateBaseHz is a whole number
_PER_LINE = 500  # characters of a line of an array


def write(path: Path, rays: FiredRays, left_out: Sequence[str]) -> Sequence[str]:
    """Write a stage with an OmniLidar prim.

    Raises
    ------
    LidarError
        If the frames have different numbers of rays, or the rate is not a whole number of hertz.
    """
    if rays.rate_hz != round(rays.rate_hz) or rays.rate_hz < MIN_RATE_HZ:
        raise LidarError(
            f"{rays.name} has {rays.rate_hz:.6g} scans per second, but scanRateBaseHz of OmniLidar "
            "must be a whole number. Use a different rate."
        )
    frames = _frames(rays)
    lines = [
        "#usda 1.0",
        "(",
        '    defaultPrim = "Lidar"',
        f'    doc = "{_text(_remark(rays, left_out))}"',
        "    metersPerUnit = 1",
        '    upAxis = "Z"',
        ")",
        "",
        'def OmniLidar "Lidar" (',
        f"    prepend apiSchemas = [{', '.join(_schemas(len(frames)))}]",
        ")",
        "{",
        *(f"    {line}" for line in _settings(rays, frames)),
        *(line for number, frame in enumerate(frames, 1) for line in _state(rays, number, frame)),
        "}",
    ]
    write_text_of(path, "\n".join(lines) + "\n")
    return left_out


def _remark(rays: FiredRays, left_out: Sequence[str]) -> str:
    """Return the remark of the file: the sensor, its axes, and what the file does not hold."""
    lacks = f" Not in this file: {'; '.join(left_out)}." if left_out else ""
    return f"{rays.name}. Axes: {AXES}; azimuths from x, counter-clockwise.{lacks}"


def _schemas(states: int) -> Iterator[str]:
    """Yield the schemas of a prim with some emitter states."""
    yield '"OmniSensorGenericLidarCoreAPI"'
    for number in range(1, states + 1):
        yield f'"OmniSensorGenericLidarCoreEmitterStateAPI:{_state_name(number)}"'


def _state_name(number: int) -> str:
    """Return the name of an emitter state, counted from 1."""
    return f"s{number:03d}"


def _frames(rays: FiredRays) -> list[Ints]:
    """Return the indices of the rays of each scan.

    Raises
    ------
    LidarError
        If the scans have different numbers of rays, or are more than `MAX_STATES`.
    """
    rays = rays.timed()
    assert rays.times_ns is not None and rays.cycle_ns is not None  # of timed rays
    count = max(round(rays.cycle_ns * rays.rate_hz / 1e9), 1)
    if count > MAX_STATES:
        raise LidarError(
            f"OmniLidar supports at most {MAX_STATES} emitter states, but the pattern requires "
            f"{count:,}."
        )
    starts_ns = np.rint(np.arange(1, count) * (1e9 / rays.rate_hz))
    frames = np.split(np.arange(len(rays)), np.searchsorted(rays.times_ns, starts_ns))
    sizes = [len(frame) for frame in frames]
    if len(set(sizes)) > 1:
        raise LidarError(
            f"{rays.name} fires {min(sizes):,} to {max(sizes):,} rays per scan, but all emitter "
            "states of OmniLidar must have the same number. Write a single revolution."
        )
    return frames


def _settings(rays: FiredRays, frames: Sequence[Ints]) -> Iterator[str]:
    """Yield the attributes of the sensor as a whole."""
    rate = f"{rays.rate_hz:.0f}"
    min_range_m, max_range_m = rays.range_m
    channels = int(rays.channels.max()) + 1
    per_line = np.bincount(rays.channels[frames[0]], minlength=channels)
    emitters = len(frames[0])
    yield f'string omni:sensor:modelName = "{_text(rays.name)}"'
    yield f"float omni:sensor:tickRate = {rate}"
    yield f'token {CORE}scanType = "SOLID_STATE"'
    yield f"uint {CORE}scanRateBaseHz = {rate}"
    yield f"uint {CORE}reportRateBaseHz = {rate}"  # of Isaac Sim 5
    yield f"uint {CORE}patternFiringRateHz = {rate}"  # its name in Isaac Sim 6
    yield f"uint {CORE}numberOfEmitters = {emitters}"
    # A detector for each emitter: detectors of several emitters would merge their returns.
    yield f"uint {CORE}numberOfChannels = {emitters}"
    yield f"uint {CORE}emitterStateCount = {len(frames)}"
    yield f"uint {CORE}stateResolutionStep = 1"
    yield f"uint {CORE}numLines = {channels}"
    yield f"uint[] {CORE}numRaysPerLine = [{', '.join(map(str, per_line.tolist()))}]"
    yield f"float {CORE}nearRangeM = {min_range_m:.9g}"
    if isfinite(max_range_m):
        yield f"float {CORE}farRangeM = {max_range_m:.9g}"
    if rays.light is not None:
        yield f"float {CORE}waveLengthNm = {rays.light.wavelength_nm:.9g}"


def _state(rays: FiredRays, number: int, frame: Ints) -> Iterator[str]:
    """Yield the attributes of an emitter state: the rays of a scan."""
    timed = rays.timed()
    assert timed.times_ns is not None  # of timed rays
    start_ns = round((number - 1) * 1e9 / rays.rate_hz)
    yield from _array(number, "float[]", "azimuthDeg", rays.azimuths_deg[frame])
    yield from _array(number, "float[]", "elevationDeg", rays.elevations_deg[frame])
    yield from _array(number, "uint[]", "fireTimeNs", timed.times_ns[frame] - start_ns)
    yield from _array(number, "uint[]", "channelId", np.arange(1, len(frame) + 1))
    yield from _array(number, "uint[]", "bank", rays.channels[frame])


def _array(number: int, kind: str, name: str, values: AnyArray) -> Iterator[str]:
    """Yield the lines of an attribute with an array.

    Angles have the digits of float32.
    """
    yield f"    {kind} {STATE}{_state_name(number)}:{name} = ["
    if kind == "float[]":
        words = [f"{value:.9g}" for value in values.astype(np.float32).tolist()]
    else:
        words = [str(value) for value in values.tolist()]
    line = ""
    for word in words:
        line += f"{word}, "
        if len(line) > _PER_LINE:
            yield f"        {line.rstrip()}"
            line = ""
    yield f"        {line.rstrip(', ')}"
    yield "    ]"


def _text(text: str) -> str:
    """Return a text as a string of USD holds it, between quotes."""
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ")
