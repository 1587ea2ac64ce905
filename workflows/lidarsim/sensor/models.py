"""Sensor models, which are read from data files, and the creation of sensors from them."""

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
from ..errors import LidarError, convert_errors
from ..io.input_files import read_input_text
from ..io.yamlfile import load_yaml
from ..numerics.arrays import Floats, Ints
from ..numerics.elementary import log1p, sin_cos
from ..schema.checks import check_fits
from ..schema.declared import Several, UnitShare
from ..schema.error_sentences import convert_validation_errors
from ..schema.model_names import BUILT_IN, GROUP, full_name, maker_folder, model_names, names_in
from ..words import did_you_mean
from .beams import Beams, Duty, Mirror, MirrorMotion, Spin, Width
from .calibrations import Calibration, read_calibration
from .noise import TARGET_REFLECTANCE, THRESHOLD_SIGMAS, Bias, Meters, Noise
from .optics import LIGHT_M_NS, Mode, Optics, Returns
from .packet_settings import Identifier, PacketSettings, laser_order
from .ray_sensors import ListedSensor, Prism, PrismSensor, TurningMirror
from .sensor import LineSensor, Sensor

MODEL_FILES = (".yaml", ".yml")
Sheet = Literal["ideal", "datasheet"]


class _ModelSection(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


_MAX_BEAMS = 1_000_000
_MAX_RING_OFFSET_DEG = 2.0  # a ring farther from all beams is not one of them
_MAX_BEAMS_PER_RING = 4  # more beams than this per recorded ring belong to another sensor


def _expand_numbers(value: Any) -> Any:
    """Expand a mapping with `first`, `last` and `count` to evenly spaced numbers.

    Both ends are included.
    """
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


Numbers = Annotated[tuple[float, ...], BeforeValidator(_expand_numbers)]
OffsetXYZ = tuple[float, float, float]
_Azimuth = Annotated[float, Field(ge=-360, le=360)]
# Index of a beam, and the azimuths between which it is blocked, in degrees.
BlockedSector = tuple[Annotated[int, Field(ge=0)], _Azimuth, _Azimuth]
# Fractions are exact, whereas a float cannot represent 55.296 exactly, and a decimal number cannot
# represent 500/9.
Exact = Annotated[Fraction, BeforeValidator(lambda value: Fraction(str(value)))]
Positive = Annotated[float, Field(gt=0)]


class BeamTable(_ModelSection):
    """Beams of a sensor model, in the manufacturer's order.

    Except for their units, the fields are those of `Beams`. All beams cross in a point at a
    distance of `crossing_m` from the axis, if it is set. The beams in `blocked_deg` are numbered
    from 0 in the order of the table.
    """

    elevation_deg: Numbers = ()
    azimuth_deg: Numbers = ()
    time_us: Numbers = ()
    origin_m: OffsetXYZ | tuple[OffsetXYZ, ...] = ()
    crossing_m: Annotated[float, Field(ge=0, le=1)] = 0.0
    blocked_deg: tuple[BlockedSector, ...] = ()
    intensity_factor: Numbers | tuple[Numbers, ...] = ()
    intensity_range_m: Numbers = ()

    @model_validator(mode="after")
    def _check_blocked(self) -> BeamTable:
        for beam, start, stop in self.blocked_deg:
            if start == stop:
                raise ValueError(
                    f"The sector [{beam}, {start:g}, {stop:g}] in blocked_deg is empty. To block a "
                    f"beam in all directions, use [{beam}, 0, 360]."
                )
        return self

    @model_validator(mode="after")
    def _check_factors(self) -> BeamTable:
        if self.intensity_factor and not self.elevation_deg:
            raise ValueError("beams.intensity_factor requires beams.elevation_deg.")
        by_range = any(isinstance(factor, tuple) for factor in self.intensity_factor)
        if by_range != bool(self.intensity_range_m):
            raise ValueError(
                "beams.intensity_range_m requires a list of intensity factors for each beam, and "
                "such lists require beams.intensity_range_m."
            )
        return self

    def beams(self) -> Beams:
        """Create the beams, or a single forward beam if the table has no elevations."""
        count = len(self.elevation_deg)
        if not count:
            return Beams(np.zeros(1), blocked=self.blocked())
        return Beams(
            np.radians(self.elevation_deg),
            np.radians(self.azimuth_deg),
            np.multiply(self.time_us, 1000.0),
            self.origins(count),
            self.blocked(),
            *self.intensity_factors(),
        )

    def intensity_factors(self) -> tuple[Floats, Floats]:
        """Return the fields `intensity_factor` and `intensity_range_m` of `Beams`.

        Raises
        ------
        LidarError
            If a beam does not have a factor for each range.
        """
        counts = {len(factor) for factor in self.intensity_factor if isinstance(factor, tuple)}
        if counts - {len(self.intensity_range_m)}:
            raise LidarError(
                "Each list in beams.intensity_factor must have one factor for each of the "
                f"{len(self.intensity_range_m)} ranges in beams.intensity_range_m."
            )
        return (
            np.array(self.intensity_factor, np.float64),
            np.array(self.intensity_range_m, np.float64),
        )

    def blocked(self) -> Floats:
        """Return the blocked directions as `Beams.blocked`, of shape (k, 3)."""
        blocked = np.array(self.blocked_deg, np.float64).reshape(-1, 3)
        blocked[:, 1:] = np.radians(blocked[:, 1:])
        return blocked

    def origins(self, count: int) -> Floats:
        """Return the origins of `count` beams in meters.

        The result has shape (count, 3), or shape (0, 3) if the table has no origins. If
        `crossing_m` is set, the beams start on the axis and cross in a point `crossing_m` in front
        of the sensor origin.
        """
        if self.crossing_m:
            up, level = sin_cos(np.radians(self.elevation_deg))
            heights_m = -self.crossing_m * up / level
            return np.column_stack([np.zeros((count, 2)), heights_m])
        origin = np.array(self.origin_m, np.float64).reshape(-1, 3)
        return np.repeat(origin, count, axis=0) if len(origin) == 1 else origin


class MirrorSpec(_ModelSection):
    """Motion of a mirror that sweeps lines, with the fields of `Mirror`."""

    motion: MirrorMotion
    width_deg: Width
    duty: Duty = 1.0


class RangePrecision(_ModelSection):
    """Standard deviation of the ranges to a surface at normal incidence."""

    sigma_m: Positive
    range_m: Positive
    reflectance: Annotated[float, Field(gt=0, le=1)]


class Detection(_ModelSection):
    """Range at which a given fraction of the pulses is detected, at normal incidence."""

    range_m: Positive
    reflectance: Annotated[float, Field(gt=0, le=1)] = TARGET_REFLECTANCE
    probability: Annotated[float, Field(gt=0.001, lt=0.999)]

    @property
    def threshold_m(self) -> float:
        """Range at which half of the pulses are detected on a surface with 10 % reflectance."""
        range_m = self.range_m * math.sqrt(TARGET_REFLECTANCE / self.reflectance)
        energy = 1 + NormalDist().inv_cdf(self.probability) / THRESHOLD_SIGMAS
        return float(range_m * math.sqrt(max(energy, 0.0)))


# Values that a data sheet may specify. {field of `Noise`: phrase}
STATED = {
    "range_m": "range precision",
    "detection_range_m": "detection range at a given reflectance",
    "angle_deg": "angular accuracy",
    "false_alarm_hz": "false alarms",
}


class Performance(_ModelSection):
    """Data sheet values that describe a sensor's noise and returns.

    `SensorModel.datasheet` converts them to settings.

    The range precision is specified either by fields with the same names as those of `Noise`, or by
    `precision` for two surfaces, from which its dependence on energy is derived.
    """

    range_m: Annotated[float, Field(ge=0)] | None = None
    range_per_m: Annotated[float, Field(ge=0)] = 0.0
    range_at_threshold_m: Annotated[float, Field(ge=0)] = 0.0
    precision: tuple[RangePrecision, RangePrecision] | None = None
    # Constant range errors of the beams, as a standard deviation or in the order of the beams.
    channel_bias_m: Meters | Several[Bias] = 0.0
    angle_deg: Annotated[float, Field(ge=0)] | None = None
    detection: Detection | None = None
    # Fraction of pulses with a false alarm.
    false_alarms: Annotated[float, Field(ge=0, lt=0.5)] | None = None
    dropout: UnitShare = 0.0  # fraction of returns that are lost, regardless of their energy
    mode: Mode = "strongest"

    @model_validator(mode="after")
    def _check_consistency(self) -> Performance:
        if self.precision and (self.range_m or self.range_per_m or self.range_at_threshold_m):
            raise ValueError("precision cannot be combined with other range accuracy values.")
        for name in ("precision", "false_alarms", "range_at_threshold_m"):
            if getattr(self, name) and self.detection is None:
                raise ValueError(f"{name} requires detection.")
        self.noise(1.0)  # raises LidarError for impossible values
        return self

    def noise(self, gate_s: float) -> Noise:
        """Return the noise of a sensor whose receiver waits `gate_s` seconds for each return."""
        values = self.model_dump(include={field.name for field in fields(Noise)}, exclude_none=True)
        if self.detection is not None:
            values["detection_range_m"] = self.detection.threshold_m
            if self.precision is not None:
                strong_m, weak_m = self._range_sigmas_m(self.detection.threshold_m)
                values |= {"range_m": strong_m, "range_at_threshold_m": weak_m}
        if self.false_alarms is not None:
            values["false_alarm_hz"] = -float(log1p(-self.false_alarms)) / gate_s
        return Noise(**values)

    def _range_sigmas_m(self, threshold_m: float) -> tuple[float, float]:
        """Return the range noise of strong returns, and of returns at the detection threshold.

        Both are standard deviations in meters. `threshold_m` is `Detection.threshold_m`.
        """
        assert self.precision is not None
        # Ratio of the threshold to the energy, which increases with the square of the range.
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


class PacketSpec(_ModelSection):
    """Packet format of the manufacturer, with the fields of `PacketSettings`."""

    format: str
    ports: dict[str, Annotated[int, Field(ge=1, le=65_535)]] = {}
    identifiers: dict[str, Identifier] = {}


class SensorModel(_ModelSection):
    """Content of a sensor data file. docs/how-to/sensor.md describes the fields."""

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
    mirror: MirrorSpec | None = None
    prisms: tuple[Prism, ...] = ()
    turning_mirror: TurningMirror | None = None  # behind the prisms
    typical: bool = False  # whether the ray pattern differs between units
    optics: Optics = Optics()
    performance: Performance | None = None
    listed: bool = False
    packets: PacketSpec | None = None

    @model_validator(mode="after")
    def _check_consistency(self) -> SensorModel:
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
        if self.beams.blocked_deg and (self.prisms or self.listed):
            raise ValueError("beams.blocked_deg requires beams that rotate with a head.")
        if self.turning_mirror and not self.prisms:
            raise ValueError(
                "turning_mirror requires prisms. For a mirror that scans lines, use mirror."
            )
        # A calibration may provide more beams.
        count = 0 if self.needs_calibration else len(self.beams.beams())  # checks the beams
        biases = () if self.performance is None else self.performance.channel_bias_m
        biases = biases if isinstance(biases, tuple) else ()
        if count and self.beams.elevation_deg and len(biases) not in (0, count):
            raise ValueError(
                f"performance.channel_bias_m must have one value for each of the {count} beams, "
                f"but has {len(biases)} values."
            )
        return self

    @property
    def needs_calibration(self) -> bool:
        """Whether the model requires a calibration file because it does not define its own rays."""
        return not (self.beams.elevation_deg or self.mirror or self.prisms)

    def matches_rings(self, elevation_deg: Floats) -> bool:
        """Return whether recorded rings with the given elevations can be those of the model.

        The elevations in degrees have shape (n,). Beams without returns have no ring, but at least
        a quarter of the beams must have one.
        """
        if not len(elevation_deg) or self.needs_calibration:
            return True
        beams_deg = np.array(self.beams.elevation_deg or [np.inf])
        offset_deg = np.abs(elevation_deg[:, None] - beams_deg).min(axis=1)
        is_near = bool(offset_deg.max() <= _MAX_RING_OFFSET_DEG)
        return is_near and len(beams_deg) <= _MAX_BEAMS_PER_RING * len(elevation_deg)

    def datasheet(self) -> Datasheet:
        """Return the noise and the settings of returns that the data sheet specifies.

        A list of range errors is in the order of the beams in the file.

        Raises
        ------
        LidarError
            If the data file does not specify the performance.
        """
        performance = self.performance
        if performance is None:
            raise LidarError(
                f"No performance values are available for {self.name}. Omit `performance`, and set "
                "`noise` instead, which is a top-level section in files."
            )
        min_range_m, max_range_m = self.range_m or (0.0, float("inf"))
        noise = performance.noise(2e-9 * (max_range_m - min_range_m) / LIGHT_M_NS)
        subrays = 1 if self.optics.divergence_mrad is None else 7
        missing = tuple(
            f"{words} (noise.{name})" for name, words in STATED.items() if not getattr(noise, name)
        )
        return Datasheet(noise, Returns(performance.mode, subrays=subrays), missing)

    def packet_settings(self, lasers: Ints) -> PacketSettings | None:
        """Return the packet settings of a sensor, or None if the model has no packet format.

        For each channel, `lasers` contains the index of its laser in the manufacturer's order.
        """
        if self.packets is None:
            return None
        return PacketSettings(
            self.packets.format, self.packets.ports, self.packets.identifiers, lasers
        )

    def firing_rates(self, rate_hz: float | None, columns: int | None) -> tuple[float, float]:
        """Return the number of firings per revolution and the number of revolutions per second.

        Parameters
        ----------
        rate_hz
            Revolutions per second. None selects the rate of the model.
        columns
            Number of firings per revolution. None selects the number of the model.

        Raises
        ------
        LidarError
            If `columns` is set, but the model has a constant firing interval.
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


def find_model_plugin(name: str | None) -> Plugin | None:
    """Find the plug-in that provides a sensor model. Return None if there is none.

    Raises
    ------
    LidarError
        If two plug-ins provide models from the same manufacturer.
    """
    if not name or name.endswith(MODEL_FILES) or full_name(name) in model_names():
        return None
    return find_plugin(GROUP, name.partition("/")[0])


def plugin_model_file(name: str | None) -> Path | None:
    """Return a plug-in model's data file, or None if the model does not come from a plug-in.

    Raises
    ------
    LidarError
        If the plug-in cannot be used.
    """
    plugin = find_model_plugin(name)
    if plugin is None or name is None:
        return None
    file = maker_folder(plugin) / f"{name.partition('/')[2]}.yaml"
    return file if isinstance(file, Path) else None  # the package may be in an archive


def read_model(name: str | Path) -> SensorModel:
    """Read a sensor model from its data file.

    Parameters
    ----------
    name
        Name of a model from the package or from a plug-in, or path of a data file (.yaml). The name
        of a model from the package may omit the manufacturer.

    Raises
    ------
    LidarError
        If the model does not exist, its plug-in cannot be used, or the file is not a valid sensor
        model.
    """
    if str(name).endswith(MODEL_FILES):
        return _read(Path(name))
    models = model_names()
    name = full_name(str(name))
    if name in models:
        return _read_built_in(name)
    plugin = find_model_plugin(name)
    if plugin is not None:
        folder = maker_folder(plugin)
        models = (*models, *names_in(folder))
        if name in models:
            return _read(folder / f"{name.partition('/')[2]}.yaml")
    similar = [model for model in models if _normalize(name) in _normalize(model)][:3]
    hint = f" Did you mean {' or '.join(map(repr, similar))}?" if similar else ""
    names = [*models, *(model.partition("/")[2] for model in models)]
    raise LidarError(
        f"Unknown sensor model {name!r}.{hint or did_you_mean(name, names)} To list the models, "
        "run `lidarpool sensors`. A model can also be a file, such as mine.yaml."
    )


def _normalize(name: str) -> str:
    """Keep the letters and digits of a name in lower case, for example vlp16 for VLP-16."""
    return "".join(filter(str.isalnum, name.lower()))


@cache
def _read_built_in(name: str) -> SensorModel:
    return _read(BUILT_IN / f"{name}.yaml")


def _read(path: Path | Traversable) -> SensorModel:
    """Read the data file of a model. Raises LidarError if it is invalid."""
    with convert_errors(f"{path} is not a valid sensor model"):
        text = read_input_text(path) if isinstance(path, Path) else path.read_text("utf-8")
        content = load_yaml(text)
        with convert_validation_errors(SensorModel, path, content):
            return SensorModel.model_validate(content)


class Datasheet(NamedTuple):
    """Noise and settings of returns that a sensor's data sheet specifies."""

    noise: Noise
    returns: Returns
    missing: tuple[str, ...]  # values that the data sheet lacks, with their fields


def format_noise(noise: Noise) -> str:
    """Format the noise fields that differ from their defaults, in the syntax of a scenario."""
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
    """Load a sensor from a sensor model, the calibration of an individual sensor, or both.

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
        sensor_model = _match_model(unit, columns)
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
        head = head.restrict_to(*unit.window)
    if unit is not None and (unit.rays is not None or sensor_model.listed or sensor_model.prisms):
        common_fields["packets"] = sensor_model.packet_settings(np.arange(1))
        return _create_listed_sensor(sensor_model, unit, head, common_fields)
    beams = sensor_model.beams.beams() if unit is None else _calibrate_beams(sensor_model, unit)
    if sensor_model.prisms:
        common_fields["packets"] = sensor_model.packet_settings(np.arange(len(beams)))
        mirror = sensor_model.turning_mirror
        return PrismSensor(beams, head, prisms=sensor_model.prisms, mirror=mirror, **common_fields)
    if sensor_model.mirror is not None:
        mirror_fields = sensor_model.mirror.model_dump()
        head = Mirror(firings, step_deg, rate, head.clockwise, head.zero_deg, **mirror_fields)
    else:
        beams = beams.with_rotation(head.radians_per_ns)
    kind = LineSensor if sensor_model.axis == "x" else Sensor
    common_fields["packets"] = sensor_model.packet_settings(laser_order(beams.elevation))
    common_fields["noise"] = _sort_biases(common_fields.get("noise"), beams)
    return kind(beams.sort_by_elevation(), head, **common_fields)


def _sort_biases(noise: Noise | None, beams: Beams) -> Noise | None:
    """Return noise whose range errors are in the order of the channels, not of the beams."""
    if noise is None or np.shape(noise.channel_bias_m) != (len(beams),):
        return noise
    biases_m = np.array(noise.channel_bias_m)[laser_order(beams.elevation)]
    return replace(noise, channel_bias_m=tuple(biases_m.tolist()))


def _sensor_name(sensor_model: SensorModel, unit: Calibration | None) -> str:
    """Return the name of a sensor in reports, including the origin of its ray pattern."""
    if unit is not None:
        return f"{sensor_model.name}, {unit.file}"
    return f"{sensor_model.name}, typical pattern" if sensor_model.typical else sensor_model.name


def _match_model(unit: Calibration, columns: int | None) -> SensorModel:
    """Return the model whose beams best match a calibration.

    If no model matches, create a model from the calibration alone. Raise LidarError if the
    calibration has no firing times.
    """
    deviations_deg = {}  # {model: maximum difference from the calibrated elevations}
    for name in model_names():
        if unit.beams is None or not name.startswith(f"{unit.maker}/"):
            continue
        model_deg = read_model(name).beams.elevation_deg
        if len(model_deg) == len(unit.beams):
            unit_deg = np.degrees(unit.beams.elevation)
            deviations_deg[name] = float(np.abs(np.sort(unit_deg) - np.sort(model_deg)).max())
    if deviations_deg and min(deviations_deg.values()) < 5:  # units of a model differ far less
        return read_model(min(deviations_deg, key=deviations_deg.__getitem__))
    head = {"firings_per_turn": columns} if columns and unit.maker is None else unit.head
    if not head:
        raise LidarError(
            f"{unit.file} does not match a known model and has no firing times. Set "
            f"`model`{'' if unit.maker else ' or `columns` (firings per turn)'}."
        )
    return SensorModel(name=unit.sensor or (unit.maker or "beams").title(), sources={}, **head)


def _create_listed_sensor(
    sensor_model: SensorModel, unit: Calibration, head: Spin, common_fields: dict[str, Any]
) -> ListedSensor:
    """Create a sensor from a calibrated ray list.

    If the list has no times, the rays are fired at the rate of the model.
    """
    if unit.rays is None or (sensor_model.beams.elevation_deg and not sensor_model.prisms):
        raise LidarError(
            f"{unit.file} does not match {sensor_model.name}. One describes rays and the other "
            "describes beams."
        )
    if sensor_model.beams.blocked_deg:
        raise LidarError(
            f"{unit.file} lists rays, but beams.blocked_deg of {sensor_model.name} requires beams. "
            "Remove blocked_deg."
        )
    if not unit.head:  # a firing of the model comprises all beams, and one of the list a single ray
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


def _calibrate_beams(sensor_model: SensorModel, unit: Calibration) -> Beams:
    """Return calibrated beams, with missing times and origins taken from the model."""
    beams = unit.beams
    table = sensor_model.beams
    assert beams is not None  # a calibration has beams or rays
    expected = len(table.elevation_deg) or len(table.time_us)
    if expected not in (0, len(beams)):
        raise LidarError(
            f"{unit.file} has {len(beams)} beams, but {sensor_model.name} has {expected}."
        )
    times = beams.time_ns if beams.time_ns.any() else np.multiply(table.time_us, 1000.0)
    origin = beams.origin if beams.origin.any() else table.origins(len(beams))
    factors = table.intensity_factors()
    return Beams(beams.elevation, beams.azimuth, times, origin, table.blocked(), *factors)
