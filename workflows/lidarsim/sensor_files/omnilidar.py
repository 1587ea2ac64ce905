"""OmniLidar prims for Isaac Sim and Omniverse (.usda).

The attributes are those of the extension omni.sensors.nv.lidar ("Setting Lidar Attributes") and of
the schemas OmniSensorGenericLidarCoreAPI and OmniSensorGenericLidarCoreEmitterStateAPI. The prim is
a solid-state lidar, in which each scan fires one emitter state, a list of azimuths, elevations and
times. Successive scans use successive states, so a pattern does not have to repeat with each scan.
A rotary lidar would round times and azimuths to the ticks of an integer frequency.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import isfinite
from pathlib import Path

import numpy as np

from ..errors import LidarError
from ..numerics.arrays import AnyArray, Ints
from .complete_files import write_complete_text
from .fired_rays import AXES, RayList

CORE = "omni:sensor:Core:"
STATE = f"{CORE}emitterState:"
MAX_STATES = 999  # state names have three digits
MIN_RATE_HZ = 1  # scanRateBaseHz is an integer
_PER_LINE = 500  # characters per line of an array


def write(path: Path, rays: RayList, left_out: Sequence[str]) -> Sequence[str]:
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
    write_complete_text(path, "\n".join(lines) + "\n")
    return left_out


def _remark(rays: RayList, left_out: Sequence[str]) -> str:
    """Return the comment in the file, which states the sensor, the axes and missing properties."""
    lacks = f" Not in this file: {'; '.join(left_out)}." if left_out else ""
    return f"{rays.name}. Axes: {AXES}; azimuths from x, counter-clockwise.{lacks}"


def _schemas(states: int) -> Iterator[str]:
    yield '"OmniSensorGenericLidarCoreAPI"'
    for number in range(1, states + 1):
        yield f'"OmniSensorGenericLidarCoreEmitterStateAPI:{_state_name(number)}"'


def _state_name(number: int) -> str:
    return f"s{number:03d}"


def _frames(rays: RayList) -> list[Ints]:
    """Return the indices of the rays in each scan.

    Raises
    ------
    LidarError
        If scans have different numbers of rays, or there are more than `MAX_STATES` scans.
    """
    rays = rays.with_times()
    assert rays.times_ns is not None and rays.cycle_ns is not None  # `with_times` sets both
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


def _settings(rays: RayList, frames: Sequence[Ints]) -> Iterator[str]:
    """Yield the attributes that apply to the whole sensor."""
    rate = f"{rays.rate_hz:.0f}"
    min_range_m, max_range_m = rays.range_m
    channels = int(rays.channels.max()) + 1
    per_line = np.bincount(rays.channels[frames[0]], minlength=channels)
    emitters = len(frames[0])
    yield f'string omni:sensor:modelName = "{_text(rays.name)}"'
    yield f"float omni:sensor:tickRate = {rate}"
    yield f'token {CORE}scanType = "SOLID_STATE"'
    yield f"uint {CORE}scanRateBaseHz = {rate}"
    yield f"uint {CORE}reportRateBaseHz = {rate}"  # name in Isaac Sim 5
    yield f"uint {CORE}patternFiringRateHz = {rate}"  # name in Isaac Sim 6
    yield f"uint {CORE}numberOfEmitters = {emitters}"
    # One detector per emitter, because a shared detector would merge the returns of its emitters.
    yield f"uint {CORE}numberOfChannels = {emitters}"
    yield f"uint {CORE}emitterStateCount = {len(frames)}"
    yield f"uint {CORE}stateResolutionStep = 1"
    yield f"uint {CORE}numLines = {channels}"
    yield f"uint[] {CORE}numRaysPerLine = [{', '.join(map(str, per_line.tolist()))}]"
    yield f"float {CORE}nearRangeM = {min_range_m:.9g}"
    if isfinite(max_range_m):
        yield f"float {CORE}farRangeM = {max_range_m:.9g}"
    if rays.light is not None and rays.light.wavelength_nm is not None:
        yield f"float {CORE}waveLengthNm = {rays.light.wavelength_nm:.9g}"


def _state(rays: RayList, number: int, frame: Ints) -> Iterator[str]:
    """Yield the attributes of an emitter state, which contains the rays of one scan."""
    timed = rays.with_times()
    assert timed.times_ns is not None  # `with_times` sets the times
    start_ns = round((number - 1) * 1e9 / rays.rate_hz)
    yield from _array(number, "float[]", "azimuthDeg", rays.azimuths_deg[frame])
    yield from _array(number, "float[]", "elevationDeg", rays.elevations_deg[frame])
    yield from _array(number, "uint[]", "fireTimeNs", timed.times_ns[frame] - start_ns)
    yield from _array(number, "uint[]", "channelId", np.arange(1, len(frame) + 1))
    yield from _array(number, "uint[]", "bank", rays.channels[frame])


def _array(number: int, kind: str, name: str, values: AnyArray) -> Iterator[str]:
    """Yield the lines that define an array attribute.

    Angles are written with the digits of float32.
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
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ")
