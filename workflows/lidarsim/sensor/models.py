"""Sensor models by name: reading their data files, and making sensors."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from fractions import Fraction
from functools import cache
from importlib.resources.abc import Traversable
from pathlib import Path
from statistics import NormalDist
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from ..environment.plugins import Plugin, find_plugin
from ..errors import LidarError, converted
from ..io.input_files import read_input_text
from ..io.yamlfile import load_yaml
from ..numerics.arrays import Floats, Ints
from ..numerics.elementary import log1p, sin_cos
from ..schema.checks import check_fits
from ..schema.declared import UnitShare
from ..schema.error_sentences import convert_validation_errors
from ..schema.model_names import BUILT_IN, GROUP, full_name, maker_folder, model_names, names_in
from ..words import did_you_mean
from .beams import Beams, Duty, Mirror, MirrorMotion, Spin, Width
from .calibrations import Calibration, read_calibration
from .noise import TARGET_REFLECTANCE, THRESHOLD_SIGMAS, Noise
from .optics import LIGHT_M_NS, Mode, Optics, Returns
from .packet_settings import Identifier, PacketSettings, laser_order
from .ray_sensors import ListedSensor, Prism, PrismSensor, TurningMirror
from .sensor import LineSensor, Sensor

MODEL_FILES = (".yaml", ".yml")
Sheet = Literal["ideal", "datasheet"]


class _ModelSection(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


_MAX_BEAMS = 1_000_000


def _numbers(value: Any) -> Any:
    """Expand {first, last, count} to evenly spaced numbers, both ends included."""
    if isinstance(value, dict):
        count = value.get("count")
        if isinstance(count, int) and count > _MAX_BEAMS:
            raise ValueError(f"count must be at most {_MAX_BEAMS:,}, but is {count:,}.")
        try:
            return np.linspace(value["first"], value["last"], value["count"]).tolist()
        except (KeyError, TypeError, ValueError):
            raise ValueError(
                "Pass a list of numbers, or first, last and count, where count is a whole number."
            ) from None
    return value


Numbers = Annotated[tuple[float, ...], BeforeValidator(_numbers)]
OffsetXYZ = tuple[float, float, float]
# 55.296 is not exact in binary, nor 500/9 in decimal.
Exact = Annotated[Fraction, BeforeValidator(lambda value: Fraction(str(value)))]
Positive = Annotated[float, Field(gt=0)]


class BeamTable(_ModelSection):
    """Beams in the maker's order, as in `Beams`."""

    elevation_deg: Numbers = ()
    azimuth_deg: Numbers = ()
    time_us: Numbers = ()
    origin_m: OffsetXYZ | tuple[OffsetXYZ, ...] = ()
    crossing_m: Annotated[float, Field(ge=0, le=1)] = 0.0  # see `origins`

    def beams(self) -> Beams:
        """Return the beams, or a single beam straight ahead if the table has no elevations."""
        count = len(self.elevation_deg)
        if not count:
            return Beams(np.zeros(1))
        return Beams(
            np.radians(self.elevation_deg),
            np.radians(self.azimuth_deg),
            np.multiply(self.time_us, 1000.0),
            self.origins(count),
        )

    def origins(self, count: int) -> Floats:
        """Return the starts of `count` beams: (count, 3), meters, or (0, 3) without origins.

        Beams that cross in a point `crossing_m` ahead of the axis, at the height of the sensor's
        center, start on the axis, above or below the center.
        """
        if self.crossing_m:
            up, level = sin_cos(np.radians(self.elevation_deg))
            heights_m = -self.crossing_m * up / level
            return np.column_stack([np.zeros((count, 2)), heights_m])
        origin = np.array(self.origin_m, np.float64).reshape(-1, 3)
        return np.repeat(origin, count, axis=0) if len(origin) == 1 else origin


class MirrorPart(_ModelSection):
    """Motion of a mirror that sweeps lines, as in `Mirror`."""

    motion: MirrorMotion
    width_deg: Width
    duty: Duty = 1.0


class RangePrecision(_ModelSection):
    """Standard deviation of the ranges of a surface, at right angles."""

    sigma_m: Positive
    range_m: Positive
    reflectance: Annotated[float, Field(gt=0, le=1)]


class Detection(_ModelSection):
    """Range at which a share of the pulses on a surface, at right angles, return."""

    range_m: Positive
    reflectance: Annotated[float, Field(gt=0, le=1)] = TARGET_REFLECTANCE
    probability: Annotated[float, Field(gt=0.001, lt=0.999)]

    @property
    def threshold_m(self) -> float:
        """Range at which a surface of 10 % reflectance returns half of the pulses."""
        range_m = self.range_m * math.sqrt(TARGET_REFLECTANCE / self.reflectance)
        energy = 1 + NormalDist().inv_cdf(self.probability) / THRESHOLD_SIGMAS
        return float(range_m * math.sqrt(max(energy, 0.0)))


# Figures that a data sheet may state: {field of `Noise`: words}.
STATED = {
    "range_m": "range precision",
    "detection_range_m": "detection range at a given reflectance",
    "angle_deg": "angular accuracy",
    "false_alarm_hz": "false alarms",
}


class Performance(_ModelSection):
    """Figures of a data sheet on a sensor's noise and returns.

    `SensorModel.datasheet` makes settings of them.

    The precision of ranges is given either by the fields of `Noise`, with the same names, or for
    two surfaces, which give its dependence on energy.
    """

    range_m: Annotated[float, Field(ge=0)] | None = None
    range_per_m: Annotated[float, Field(ge=0)] = 0.0
    range_at_threshold_m: Annotated[float, Field(ge=0)] = 0.0
    precision: tuple[RangePrecision, RangePrecision] | None = None
    angle_deg: Annotated[float, Field(ge=0)] | None = None
    detection: Detection | None = None
    false_alarms: Annotated[float, Field(ge=0, lt=0.5)] | None = None  # share of pulses
    dropout: UnitShare = 0.0  # share of returns, whatever their energy
    mode: Mode = "strongest"

    @model_validator(mode="after")
    def _check_consistency(self) -> Performance:
        """Check that the figures fit together."""
        if self.precision and (self.range_m or self.range_per_m or self.range_at_threshold_m):
            raise ValueError("precision cannot be combined with other range accuracy values.")
        for name in ("precision", "false_alarms", "range_at_threshold_m"):
            if getattr(self, name) and self.detection is None:
                raise ValueError(f"{name} requires detection.")
        self.noise(1.0)  # LidarError if figures are impossible
        return self

    def noise(self, gate_s: float) -> Noise:
        """Return the noise of a sensor whose receiver waits `gate_s` seconds for returns."""
        figures = self.model_dump(
            include={field.name for field in fields(Noise)}, exclude_none=True
        )
        if self.detection is not None:
            figures["detection_range_m"] = self.detection.threshold_m
            if self.precision is not None:
                strong_m, weak_m = self._by_energy(self.detection.threshold_m)
                figures |= {"range_m": strong_m, "range_at_threshold_m": weak_m}
        if self.false_alarms is not None:
            figures["false_alarm_hz"] = -float(log1p(-self.false_alarms)) / gate_s
        return Noise(**figures)

    def _by_energy(self, threshold_m: float) -> tuple[float, float]:
        """Return the standard deviations of strong returns, and of returns at the threshold."""
        assert self.precision is not None
        # The threshold over the energy: it grows with the square of the range.
        weakness = [
            TARGET_REFLECTANCE / surface.reflectance * np.square(surface.range_m / threshold_m)
            for surface in self.precision
        ]
        x, y = np.square(weakness)
        s, t = np.square([surface.sigma_m for surface in self.precision])
        slope = (t - s) / (y - x)
        if not (slope >= 0 and s - slope * x >= 0):
            raise LidarError(
                "The standard deviation in performance.precision must decrease as the energy "
                "increases."
            )
        return float(np.sqrt(s - slope * x)), float(np.sqrt(slope))


class PacketPart(_ModelSection):
    """Packets of the maker, as in `PacketSettings`.

    The format defines the identifiers.
    """

    format: str
    ports: dict[str, Annotated[int, Field(ge=1, le=65_535)]] = {}
    identifiers: dict[str, Identifier] = {}


class SensorModel(_ModelSection):
    """Data file of a sensor, with the fields that `docs/how-to/sensor.md` describes."""

    name: str
    sources: dict[str, str] = {}
    axis: Literal["z", "x"] = "z"
    clockwise: bool = False
    zero_deg: float = 0.0
    firing_us: Annotated[Exact, Field(gt=0)] | None = None
    firings_per_turn: Annotated[int, Field(gt=0)] | None = None
    rate_hz: Positive = 10.0
    rates_hz: tuple[Positive, Positive] | None = None
    range_m: tuple[float, float] | None = None
    beams: BeamTable = BeamTable()
    mirror: MirrorPart | None = None
    prisms: tuple[Prism, ...] = ()
    turning_mirror: TurningMirror | None = None  # behind the prisms
    typical: bool = False  # whether units differ, so that the rays are only similar to a unit's
    optics: Optics = Optics()
    performance: Performance | None = None
    listed: bool = False
    packets: PacketPart | None = None

    @model_validator(mode="after")
    def _check_consistency(self) -> SensorModel:
        """Check that the fields fit together."""
        if (self.firing_us is None) == (self.firings_per_turn is None):
            raise ValueError("Set exactly one of firing_us and firings_per_turn.")
        if self.range_m is not None and not 0 <= self.range_m[0] < self.range_m[1]:
            raise ValueError(f"range_m must be [shortest, longest], but is {list(self.range_m)}.")
        if any(abs(angle) > 90 for angle in self.beams.elevation_deg):
            raise ValueError("beams.elevation_deg must be between -90 and 90 degrees.")
        if self.beams.crossing_m and self.beams.origin_m:
            raise ValueError("beams.crossing_m and origin_m cannot be combined.")
        head_fields = {"axis", "clockwise", "mirror", "zero_deg"}
        unused = self.model_dump(include=head_fields, exclude_defaults=True)
        if self.prisms and unused:
            raise ValueError(
                f"Prisms rotate about x, so {min(unused)} cannot be set. Rotate the sensor instead."
            )
        if self.turning_mirror and not self.prisms:
            raise ValueError(
                "turning_mirror requires prisms. For a mirror that scans lines, use mirror."
            )
        self.beams.beams()  # LidarError if beams are impossible
        return self

    @property
    def needs_calibration(self) -> bool:
        """Whether the rays of the model need a calibration file."""
        return not (self.beams.elevation_deg or self.mirror or self.prisms)

    def datasheet(self) -> Datasheet:
        """Return noise and returns by the data sheet.

        Raises LidarError if the file has no performance.
        """
        performance = self.performance
        if performance is None:
            raise LidarError(
                f"No performance values are available for {self.name}. Set noise instead."
            )
        min_range_m, max_range_m = self.range_m or (0.0, float("inf"))
        noise = performance.noise(2e-9 * (max_range_m - min_range_m) / LIGHT_M_NS)
        subrays = 1 if self.optics.divergence_mrad is None else 7
        missing = tuple(
            f"{words} (noise.{name})" for name, words in STATED.items() if not getattr(noise, name)
        )
        return Datasheet(noise, Returns(performance.mode, subrays=subrays), missing)

    def packet_settings(self, lasers: Ints) -> PacketSettings | None:
        """Return the packets of a sensor, `lasers` being the maker's number of each channel."""
        if self.packets is None:
            return None
        return PacketSettings(
            self.packets.format, self.packets.ports, self.packets.identifiers, lasers
        )

    def firing_rates(self, rate_hz: float | None, columns: int | None) -> tuple[float, float]:
        """Return the firings in a revolution, and the revolutions a second.

        `rate_hz` and `columns` (firings in a revolution) take the place of the model's figures, if
        they are not None.
        """
        rate = self.rate_hz if rate_hz is None else rate_hz
        if self.firing_us is not None:
            if columns is not None:
                raise LidarError(
                    f"{self.name} fires every {float(self.firing_us):g} µs, so rate_hz determines "
                    "the firings per turn. Remove columns."
                )
            return float(1_000_000 / (self.firing_us * Fraction(str(rate)))), rate
        assert self.firings_per_turn is not None
        return self.firings_per_turn if columns is None else columns, rate


def plugin_of_model(name: str | None) -> Plugin | None:
    """Return the plug-in with a model of a name, or None.

    Raises
    ------
    LidarError
        If two plug-ins have models of the maker.
    """
    if not name or name.endswith(MODEL_FILES) or full_name(name) in model_names():
        return None
    return find_plugin(GROUP, name.partition("/")[0])


def plugin_model_file(name: str | None) -> Path | None:
    """Return the data file of a plug-in's model, or None for a model of the package or of a file.

    Raises
    ------
    LidarError
        If the plug-in cannot be used.
    """
    plugin = plugin_of_model(name)
    if plugin is None or name is None:
        return None
    file = maker_folder(plugin) / f"{name.partition('/')[2]}.yaml"
    return file if isinstance(file, Path) else None  # the package may be in an archive


def read_model(name: str | Path) -> SensorModel:
    """Read a model by its name, from the package or a plug-in, or by the path of its file (.yaml).

    The maker may be left out of the name of a model that comes with the package.

    Raises
    ------
    LidarError
        If no model has that name, its plug-in cannot be used, or the file is not of a sensor.
    """
    if str(name).endswith(MODEL_FILES):
        return _read(Path(name))
    models = model_names()
    name = full_name(str(name))
    if name in models:
        return _built_in(name)
    plugin = plugin_of_model(name)
    if plugin is not None:
        folder = maker_folder(plugin)
        models = (*models, *names_in(folder))
        if name in models:
            return _read(folder / f"{name.partition('/')[2]}.yaml")
    similar = [model for model in models if _plain(name) in _plain(model)][:3]
    hint = f" Did you mean {' or '.join(map(repr, similar))}?" if similar else ""
    names = [*models, *(model.partition("/")[2] for model in models)]
    raise LidarError(
        f"Unknown sensor model {name!r}.{hint or did_you_mean(name, names)} To list the models, "
        "run `lidarpool sensors`. A model can also be a file, such as mine.yaml."
    )


def _plain(name: str) -> str:
    """Return the lower-case letters and digits of a name, such as vlp16 of «VLP-16»."""
    return "".join(filter(str.isalnum, name.lower()))


@cache
def _built_in(name: str) -> SensorModel:
    """Read a model that comes with the package."""
    return _read(BUILT_IN / f"{name}.yaml")


def _read(path: Path | Traversable) -> SensorModel:
    """Read the data file of a model.

    Raises LidarError if the file cannot be used.
    """
    with converted(f"{path} is not a valid sensor model"):
        text = read_input_text(path) if isinstance(path, Path) else path.read_text("utf-8")
        content = load_yaml(text)
        with convert_validation_errors(SensorModel, path, content):
            return SensorModel.model_validate(content)


class Datasheet(NamedTuple):
    """Noise and returns of a sensor by its data sheet."""

    noise: Noise
    returns: Returns
    missing: tuple[str, ...]  # figures that the sheet does not state, with the fields for them


def shown_noise(noise: Noise) -> str:
    """Return the fields of noise that differ from their defaults, as in a scenario."""
    shown = (
        f"{field.name}: {value:.4g}"
        for field in fields(noise)
        if (value := getattr(noise, field.name)) != field.default
    )
    return ", ".join(shown)


def load_sensor(
    model: str | Path | None = None,
    *,
    calibration: str | Path | None = None,
    columns: int | None = None,
    rate_hz: float | None = None,
    step_deg: float = 10.0,
    min_range_m: float | None = None,
    max_range_m: float | None = None,
    performance: Sheet | None = None,
) -> Sensor:
    """Load a sensor from a sensor model, from the calibration of a unit, or from both.

    Parameters
    ----------
    model
        Name of the model, such as "velodyne/vlp16", or path of a sensor file (.yaml). The default
        is the model whose beams are closest to the calibration.
    calibration
        Calibration file of a unit: Velodyne YAML, Ouster metadata, Hesai angle corrections,
        RoboSense angle.csv, a Livox ray list, a beam table, or rays that were written by
        `export_sensor`.
    columns
        Number of firings per revolution, if the model or the beam table offers a choice.
    rate_hz
        Revolutions, lines or frames per second.
    step_deg
        Rotation per scan in degrees. With the default of 10 degrees, a scan contains 800 rays of a
        VLP-16 or 3,600 rays of an OS1-128. The overhead per scan is then low, because consecutive
        scans are combined into batches, and several workers can share a revolution.
    min_range_m, max_range_m
        Minimum and maximum range in meters. The defaults are those of the model.
    performance
        With "datasheet", the sensor has the noise and returns of its data sheet, unless they are
        overridden by a survey. The default is "datasheet" for a sensor file that specifies the
        performance, and "ideal" otherwise.

    Raises
    ------
    LidarError
        If the model does not exist, a file cannot be used, or the model and the calibration do not
        match.

    Examples
    --------
    >>> sensor = load_sensor("velodyne/vlp16")
    >>> sensor.name, sensor.channels, round(sensor.head.firings_per_turn, 3)
    ('Velodyne VLP-16', 16, 1808.449)
    """
    check_fits("performance", performance, Sheet | None)
    unit = None if calibration is None else read_calibration(Path(calibration))
    if model is not None:
        sensor_model = read_model(model)
    elif unit is not None:
        sensor_model = _model_of(unit, columns)
    else:
        raise LidarError("A sensor requires a model, a calibration or both.")
    if unit is not None:
        sensor_model = sensor_model.model_copy(update=unit.head)
    elif sensor_model.needs_calibration:
        raise LidarError(
            f"{sensor_model.name} has no ray pattern of its own. Set `calibration` to a file "
            f"({next(iter(sensor_model.sources.values()), 'of the unit')})."
        )
    firings, rate = sensor_model.firing_rates(rate_hz, columns)
    unit_range_m = None if unit is None else unit.range_m
    shortest_m, longest_m = unit_range_m or sensor_model.range_m or (0.0, float("inf"))
    common_fields: dict[str, Any] = {
        "min_range_m": shortest_m if min_range_m is None else min_range_m,
        "max_range_m": longest_m if max_range_m is None else max_range_m,
        "name": _sensor_name(sensor_model, unit),
        "optics": sensor_model.optics,
    }
    user_sheet = sensor_model.performance is not None and str(model).endswith(MODEL_FILES)
    if performance == "datasheet" or (performance is None and user_sheet):
        sheet = sensor_model.datasheet()
        common_fields |= {"noise": sheet.noise, "returns": sheet.returns}
    head = Spin(firings, step_deg, rate, sensor_model.clockwise, sensor_model.zero_deg)
    if unit is not None and unit.window is not None:
        head = head.within(*unit.window)
    if unit is not None and (unit.rays is not None or sensor_model.listed or sensor_model.prisms):
        common_fields["packets"] = sensor_model.packet_settings(np.arange(1))
        return _listed(sensor_model, unit, head, common_fields)
    beams = sensor_model.beams.beams() if unit is None else _calibrated(sensor_model, unit)
    if sensor_model.prisms:
        common_fields["packets"] = sensor_model.packet_settings(np.arange(len(beams)))
        mirror = sensor_model.turning_mirror
        return PrismSensor(beams, head, prisms=sensor_model.prisms, mirror=mirror, **common_fields)
    if sensor_model.mirror is not None:
        mirror_fields = sensor_model.mirror.model_dump()
        head = Mirror(firings, step_deg, rate, head.clockwise, head.zero_deg, **mirror_fields)
    else:
        beams = beams.turning(head.radians_per_ns)
    kind = LineSensor if sensor_model.axis == "x" else Sensor
    common_fields["packets"] = sensor_model.packet_settings(laser_order(beams.elevation))
    return kind(beams.lowest_first(), head, **common_fields)


def _sensor_name(sensor_model: SensorModel, unit: Calibration | None) -> str:
    """Return the name of a sensor for reports, with the source of its rays."""
    if unit is not None:
        return f"{sensor_model.name}, {unit.file}"
    return f"{sensor_model.name}, typical pattern" if sensor_model.typical else sensor_model.name


def _model_of(unit: Calibration, columns: int | None) -> SensorModel:
    """Return the model whose beams are nearest to a unit's, else a model of the file alone."""
    deviations_deg = {}  # {model: greatest difference between its elevations and the unit's}
    for name in model_names():
        if unit.beams is None or not name.startswith(f"{unit.maker}/"):
            continue
        model_deg = read_model(name).beams.elevation_deg
        if len(model_deg) == len(unit.beams):
            unit_deg = np.degrees(unit.beams.elevation)
            deviations_deg[name] = float(np.abs(np.sort(unit_deg) - np.sort(model_deg)).max())
    if deviations_deg and min(deviations_deg.values()) < 5:  # units of one model differ by far less
        return read_model(min(deviations_deg, key=deviations_deg.__getitem__))
    head = {"firings_per_turn": columns} if columns and unit.maker is None else unit.head
    if not head:
        raise LidarError(
            f"{unit.file} does not match a known model and has no firing times. Set "
            f"`model`{'' if unit.maker else ' or `columns` (firings per turn)'}."
        )
    return SensorModel(name=unit.sensor or (unit.maker or "beams").title(), sources={}, **head)


def _listed(
    sensor_model: SensorModel, unit: Calibration, head: Spin, common_fields: dict[str, Any]
) -> ListedSensor:
    """Return a sensor with a unit's list of rays, at the model's rate if the list has no times."""
    if unit.rays is None or (sensor_model.beams.elevation_deg and not sensor_model.prisms):
        raise LidarError(
            f"{unit.file} does not match {sensor_model.name}. One describes rays and the other "
            "describes beams."
        )
    if not unit.head:  # a firing of the model has all beams, a firing of the list has one ray
        firings = head.firings_per_turn * len(sensor_model.beams.beams())
        head = replace(head, firings_per_turn=firings)
    interval_ns = 1e9 / (head.firings_per_turn * head.rate_hz)
    times = unit.shot_ns
    if times is None:
        times = interval_ns * np.arange(len(unit.rays), dtype=np.float64)
    cycle_ns = unit.cycle_ns or float(times[-1]) + interval_ns
    return ListedSensor(
        head=head,
        rays=unit.rays,
        shot_ns=times,
        cycle_ns=cycle_ns,
        starts=unit.starts,
        **common_fields,
    )


def _calibrated(sensor_model: SensorModel, unit: Calibration) -> Beams:
    """Return the beams of a unit, fired at the times of its model."""
    beams = unit.beams
    table = sensor_model.beams
    assert beams is not None  # a file has beams or rays
    expected = len(table.elevation_deg) or len(table.time_us)
    if expected not in (0, len(beams)):
        raise LidarError(
            f"{unit.file} has {len(beams)} beams, but {sensor_model.name} has {expected}."
        )
    times = beams.time_ns if beams.time_ns.any() else np.multiply(table.time_us, 1000.0)
    origin = beams.origin if beams.origin.any() else table.origins(len(beams))
    return Beams(beams.elevation, beams.azimuth, times, origin)
