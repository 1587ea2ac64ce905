"""Convert OmniLidar prims from Isaac Sim and Omniverse to rays.

`omnilidar_child.py` reads the files. The attributes are defined by the extension
omni.sensors.nv.lidar, "Setting Lidar Attributes". Azimuths are counterclockwise from x, with x
forward, y left, and z up. Attributes that are not supported are reported unless they have no
effect.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import closing
from importlib.util import find_spec
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidarsim.environment.extras import install_command
from lidarsim.errors import LidarError, convert_errors
from lidarsim.io.allowance import Allowance, memory_share
from lidarsim.io.input_files import check_input
from lidarsim.numerics.arrays import AnyArray, Floats, Ints
from lidarsim.sensor.optics import Optics
from lidarsim.sensor_files.fired_rays import RayList, directions_of
from lidarsim.words import list_names, printable

from ..files.child_process import ReaderProcess
from ..files.usd import USD_CORE_BYTES

_SENSOR = "omni:sensor:"
CORE = f"{_SENSOR}Core:"
_STATE = f"{CORE}emitterState:"
_MAX_RAYS = 20_000_000
# Supported attributes of a state, and attributes that do not affect rays.
_READ = ("azimuthDeg", "elevationDeg", "fireTimeNs")
_OF_NO_RAY = ("channelId", "bank", "rangeId", "roi", "isROIState", "reportRateDiv")
# Supported attributes of the model, for all lidars and for rotary lidars only.
_MODEL_READ = ("scanType", "scanRateBaseHz", "nearRangeM", "farRangeM")
_ROTARY_READ = (
    "patternFiringRateHz", "reportRateBaseHz", "rotationDirection", "stateResolutionStep",
    "startAzimuthOffsetDeg", "validStartAzimuthDeg", "validEndAzimuthDeg",
)  # fmt: skip
# Attributes that repeat information in the emitter states and rates, or name the sensor.
_REDUNDANT = (
    "emitterStateCount", "numberOfEmitters", "numberOfChannels", "numLines", "numRaysPerLine",
)  # fmt: skip
_NAMES = ("marketName", "modelName", "modelVendor", "modelVersion", "tickRate")
# Attributes that have no effect at these values, in addition to zero. None means any value.
_WITHOUT_EFFECT = {
    "patternFiringRateHz": None,  # scans of a solid-state lidar have their own rate
    "reportRateBaseHz": None,
    "rotationDirection": None,
    "stateResolutionStep": 1,
    "validEndAzimuthDeg": 360,
    "waveLengthNm": Optics().simulated_nm,  # default of scenarios
}
_AZIMUTH_TOLERANCE_DEG = 1e-4  # angles are float32


class ImportedSensor(NamedTuple):
    """A sensor from another program.

    Attributes
    ----------
    rays
        Rays of the sensor.
    unsupported
        Differences from the other program, one clause each.
    """

    rays: RayList
    unsupported: list[str]


def read_omnilidar(path: Path) -> ImportedSensor:
    """Read the first OmniLidar prim in an OpenUSD file as rays.

    Raises
    ------
    LidarError
        If usd-core is not installed, the file cannot be read, or the prim has no usable emitter
        states.
    """
    if find_spec("pxr") is None:
        command = install_command("lidarpool[usd]")
        raise LidarError(
            f"{path} is an OpenUSD file, which requires usd-core. Install it with `{command}`."
        )
    if sys.platform == "win32":  # memory limits of processes are not supported
        raise LidarError(f"{path} is an OpenUSD file, which is not supported on Windows.")
    with convert_errors(f"{path} cannot be used as an OmniLidar"):
        return _sensor(_read_prim(path))


class _Prim(NamedTuple):
    """The attributes of an OmniLidar prim."""

    paths: list[str]  # paths of all OmniLidar prims of the file
    values: dict[str, Any]  # {name: plain value}
    arrays: dict[str, AnyArray]

    def number(self, name: str, default: float) -> float:
        """Return a model attribute as a number."""
        return float(self.values.get(CORE + name, default))


def _read_prim(path: Path) -> _Prim:
    """Read the first OmniLidar prim in a file.

    Raises ValueError if the file has no such prim.
    """
    allowance = Allowance(check_input(path), "export it with fewer rays")
    child = ReaderProcess(
        Path(__file__).with_name("omnilidar_child.py"),
        "usd-core",
        memory_share() + USD_CORE_BYTES,
        path.absolute().parent,
        hidden=("PXR_",),
        environment={"PXR_WORK_THREAD_LIMIT": "1"},
    )
    with closing(child.frames(path, {}, lambda frame, size: allowance.reserve(size))) as frames:
        frame, arrays = next(frames)
    if not frame["prims"]:
        raise ValueError("it has no OmniLidar prim")
    return _Prim(frame["prims"], frame["values"], dict(zip(frame["names"], arrays, strict=True)))


def _sensor(prim: _Prim) -> ImportedSensor:
    """Convert a prim to a sensor.

    Raises ValueError if its attributes do not describe a pattern.
    """
    states = _states(prim)
    rate_hz = prim.number("scanRateBaseHz", 10)
    if not rate_hz > 0:
        raise ValueError(f"scanRateBaseHz is {rate_hz:g}, but it must be above 0")
    kind = str(prim.values.get(f"{CORE}scanType", "ROTARY"))
    fires = {"SOLID_STATE": _solid_state, "ROTARY": _rotary}
    if kind not in fires:
        raise ValueError(f"scanType is {kind!r}, but only SOLID_STATE and ROTARY are supported")
    pattern = fires[kind](prim, states, rate_hz)
    order = np.argsort(pattern.times_ns, kind="stable")
    rays = RayList(
        directions_of(pattern.azimuths_deg[order], pattern.elevations_deg[order]),
        pattern.times_ns[order],
        cycle_ns=max(pattern.cycle_ns, float(pattern.times_ns.max()) + 1),
        rate_hz=rate_hz,
        range_m=(prim.number("nearRangeM", 0.0), prim.number("farRangeM", np.inf)),
        name=str(prim.values.get("omni:sensor:modelName", "")) or "OmniLidar",
    )
    return ImportedSensor(rays, [*_left_out(prim, states, kind)])


class _State(NamedTuple):
    """The emitters that fire in the same tick."""

    azimuths_deg: Floats  # (n,)
    elevations_deg: Floats  # (n,)
    times_ns: Ints  # (n,) relative to the tick


class _Pattern(NamedTuple):
    """The rays of one or more scans."""

    azimuths_deg: Floats  # (n,)
    elevations_deg: Floats  # (n,)
    times_ns: Ints  # (n,)
    cycle_ns: float


def _states(prim: _Prim) -> list[_State]:
    """Return the emitter states in order.

    Raises ValueError if a state is invalid.
    """
    names = sorted(
        {name[len(_STATE) :].partition(":")[0] for name in prim.arrays if name.startswith(_STATE)}
    )
    if not names:
        raise ValueError("it defines no emitter states such as emitterState:s001:azimuthDeg")
    states = []
    for name in names:
        fields = {field: prim.arrays.get(f"{_STATE}{name}:{field}") for field in _READ}
        if missing := [field for field, values in fields.items() if values is None]:
            raise ValueError(f"emitterState:{name} has no {list_names(missing)}")
        columns = [np.asarray(values, np.float64) for values in fields.values()]
        if len({column.shape for column in columns}) > 1 or not len(columns[0]):
            raise ValueError(
                f"the arrays of emitterState:{name} are empty or have different lengths"
            )
        if not all(np.isfinite(column).all() for column in columns):
            raise ValueError(f"emitterState:{name} has values that are not finite")
        states.append(_State(columns[0], columns[1], np.rint(columns[2]).astype(np.int64)))
    return states


def _solid_state(prim: _Prim, states: list[_State], rate_hz: float) -> _Pattern:
    """Return the rays of a solid-state lidar, with one scan for each emitter state."""
    del prim
    starts_ns = np.rint(np.arange(len(states)) * (1e9 / rate_hz)).astype(np.int64)
    return _Pattern(
        np.concatenate([state.azimuths_deg for state in states]),
        np.concatenate([state.elevations_deg for state in states]),
        np.concatenate(
            [start + state.times_ns for start, state in zip(starts_ns, states, strict=True)]
        ),
        len(states) * 1e9 / rate_hz,
    )


def _rotary(prim: _Prim, states: list[_State], rate_hz: float) -> _Pattern:
    """Return a rotary lidar's rays during one scan, restricted to its azimuth window.

    Raises ValueError if the tick rate is missing, or if no ray is within the window.
    """
    tick_hz = prim.number("patternFiringRateHz", 0) or prim.number("reportRateBaseHz", 0)
    if not tick_hz > 0:
        raise ValueError("it has neither a patternFiringRateHz nor a reportRateBaseHz above 0")
    ticks = max(round(tick_hz / rate_hz), 1)
    if ticks * max(len(state.azimuths_deg) for state in states) > _MAX_RAYS:
        raise ValueError(f"a scan has more than {_MAX_RAYS:,} rays")
    clockwise = prim.values.get(f"{CORE}rotationDirection", "CW") == "CW"
    step_deg = 360 * rate_hz / tick_hz * (-1 if clockwise else 1)
    hold = max(int(prim.number("stateResolutionStep", 1)), 1)
    start_deg = prim.number("startAzimuthOffsetDeg", 0.0)
    chosen = [states[tick // hold % len(states)] for tick in range(ticks)]
    pattern = _Pattern(
        np.concatenate(
            [start_deg + tick * step_deg + state.azimuths_deg for tick, state in enumerate(chosen)]
        ),
        np.concatenate([state.elevations_deg for state in chosen]),
        np.concatenate(
            [round(tick * 1e9 / tick_hz) + state.times_ns for tick, state in enumerate(chosen)]
        ),
        1e9 / rate_hz,
    )
    return _within_window(prim, pattern)


def _within_window(prim: _Prim, pattern: _Pattern) -> _Pattern:
    """Return those rays at whose azimuths a rotary lidar accepts returns.

    If the end of the window is below its start, for example from 300 to 60 degrees, the window
    contains azimuth 0. Raises ValueError if no ray is within the window.
    """
    start_deg = prim.number("validStartAzimuthDeg", 0.0)
    end_deg = prim.number("validEndAzimuthDeg", 360.0)
    if not isfinite(start_deg) or not isfinite(end_deg):
        raise ValueError("validStartAzimuthDeg or validEndAzimuthDeg is not finite")
    width_deg = end_deg - start_deg
    if width_deg >= 360:
        return pattern
    width_deg %= 360
    past_start_deg = (pattern.azimuths_deg - start_deg + _AZIMUTH_TOLERANCE_DEG) % 360
    inside = past_start_deg <= width_deg + 2 * _AZIMUTH_TOLERANCE_DEG
    if not inside.any():
        raise ValueError(f"no ray has an azimuth from {start_deg:g} to {end_deg:g} degrees")
    return _Pattern(
        pattern.azimuths_deg[inside],
        pattern.elevations_deg[inside],
        pattern.times_ns[inside],
        pattern.cycle_ns,
    )


def _left_out(prim: _Prim, states: list[_State], kind: str) -> list[str]:
    """Describe the differences from the other program, with one clause each."""
    clauses = []
    if prim.paths[1:]:
        clauses.append(f"several OmniLidar prims (only {prim.paths[0]} is read)")
    fields = {name.rpartition(":")[2] for name in _used_arrays(prim.arrays)}
    if others := sorted(fields - {*_READ, *_OF_NO_RAY}):
        clauses.append(f"the emitter attributes {list_names(others)}")
    if len(states[0].azimuths_deg) > 1:
        clauses.append("channels (a ray list has one channel)")
    clauses += [f"{name} = {value}" for name, value in _unread(prim, kind)]
    return clauses


def _unread(prim: _Prim, kind: str) -> Iterator[tuple[str, str]]:
    """Yield those unsupported attributes that may change the points, with their values.

    Attributes that are zero or have another value without an effect are skipped.
    """
    rotary = kind == "ROTARY"
    read = {
        *(f"{CORE}{name}" for name in (*_MODEL_READ, *_REDUNDANT, *_ROTARY_READ * rotary)),
        *(f"{_SENSOR}{name}" for name in _NAMES),
    }
    for name, value in prim.values.items():
        own = name.removeprefix(_SENSOR).removeprefix("Core:")
        neutral = _WITHOUT_EFFECT.get(own, 0)
        if name not in read and value and neutral is not None and value != neutral:
            yield own, f"{value:g}" if isinstance(value, float) else printable(str(value))
    for name, array in prim.arrays.items():
        if name not in read and not name.startswith(_STATE) and (array != 0).any():
            yield name.removeprefix(_SENSOR).removeprefix("Core:"), f"{array.size} values"


def _used_arrays(arrays: Mapping[str, AnyArray]) -> list[str]:
    """Return the names of the emitter state arrays that contain a nonzero value."""
    return [name for name, values in arrays.items() if name.startswith(_STATE) and values.any()]
