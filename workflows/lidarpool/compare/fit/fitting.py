"""Fits the performance of a sensor to a recording; writes a sensor file and its page.

A figure is a number of the performance, such as the noise of ranges; intervals of figures are
confidence intervals of 95 %. Arrays have the axes of `stack`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import yaml
from pydantic import Field

from lidarsim._version import __version__
from lidarsim.base.arrays import Floats
from lidarsim.base.errors import LidarError, explained
from lidarsim.base.extras import need
from lidarsim.base.signatures import ReadableSignature
from lidarsim.base.storage import Storage
from lidarsim.base.validation import checked
from lidarsim.base.words import plural
from lidarsim.columns.cloud import Cloud
from lidarsim.scene.scene import Scene
from lidarsim.sensor import Pose, Spin
from lidarsim.sensor.models import MODEL_FILES, Performance, SensorModel, read_model
from lidarsim.sensor.ray_sensors import ListedSensor
from lidarsim.simulator import Scanner

from ...columns.parts import StoredCloud
from ...recordings.recordings import Recording, open_recording
from ...report.page.rendering import rendered
from .charts import draw_charts
from .estimates import MIN_RAYS, Estimate
from .motion import read_static
from .performance import fit_performance, has_frontal_rays
from .ring_bias import ring_bias
from .stack import SweepStack, finite_median
from .surfaces import FLAT_TANGENT, SCENE_TOLERANCE_M, SmoothRays, find_surfaces, select_smooth_rays

_CURVE_POINTS = 14  # points of a curve at most
_RANGE_NOISE_FIELDS = ("range_m", "range_per_m", "range_at_threshold_m")
_MAX_RING_OFFSET_DEG = 2.0  # a ring farther from all beams of a model is not one of its beams
_MIN_SCENE_SHARE = 0.5  # share of rays that must be within `SCENE_TOLERANCE_M` of the scene
# Noise of directions before the noise is estimated, for the choice of outliers.
_INITIAL_DIRECTION_NOISE_RAD = 0.002
_MIN_REFLECTANCE = 1 / 400  # reflectance of surfaces that are reported as 0
_MIN_RANGE_ERROR_M = 0.001  # error of a ray's mean range, however often the range is measured


@dataclass(frozen=True, eq=False, repr=False)
class Fit:
    """Result of `fit`; printed as a table."""

    __signature__ = ReadableSignature()

    figures: dict[str, Any]  # numbers and texts of the page; lengths in metres
    model: SensorModel  # the sensor with the fitted performance

    def __repr__(self) -> str:
        return rendered("fit.txt", report=self.figures).rstrip("\n")

    @checked
    def save(self, file: str | Path) -> list[Path]:
        """Write the sensor file and a .html page beside the file; return both paths.

        LidarError if the file is no .yaml, or cannot be written.
        """
        model_path = Path(file)
        if model_path.suffix not in MODEL_FILES:
            raise LidarError(f"{model_path} is no sensor file: give a name such as mine.yaml.")
        model = self.model.model_dump(mode="json", exclude_defaults=True)
        text = "".join(f"# {line}\n" for line in repr(self).splitlines())
        text += yaml.safe_dump(model, sort_keys=False, allow_unicode=True, default_flow_style=None)
        pictures = {"fit": draw_charts(self.figures).svg()}
        page = rendered("fit.html", report=self.figures, pictures=pictures)
        contents = {model_path: text, model_path.with_suffix(".html"): page}
        advice = "choose a folder that exists and has room"
        with explained(f"{model_path} cannot be written", advice):
            for path, content in contents.items():
                Storage.at(path.parent, durable=False).write(path.name, content.encode())
        return [*contents]


@checked
def fit(
    recording: str | Path | Cloud | StoredCloud | Recording,
    *,
    model: str | Path | None = None,
    scene: str | Path | Scene | None = None,
    pose: Pose | Sequence[float] = (0.0, 0.0, 0.0),
    sensor: str | None = None,
    intensity: str | None = None,
    white: Annotated[float, Field(gt=0)] | None = None,
) -> Fit:
    """Fit the performance of a sensor to sweeps of the sensor at a standstill.

    Parameters
    ----------
    recording
        Sweeps in any format of `compare`, or a cloud in memory that has sweeps.
    model
        The sensor, by name or file; the model keeps its figures that the recording does not
        determine. By default a sensor with the recorded beams.
    scene, pose
        The recorded place as a scene, and the sensor's pose in the scene; by default surfaces are
        those of the recording.
    sensor, intensity
        Name of the sensor, or topic of a bag, if the recording has several; column with the
        intensities, if not ``intensity``.
    white
        Intensity that the sensor reports of a white surface, if the intensity is the same at all
        ranges. By default the value of Velodyne and Ouster for their recordings, else unknown.

    Raises
    ------
    LidarError
        If the recording cannot be read, has no sweeps or rings, is of several sensors or of a
        sensor that moves, or scipy is missing.
    """
    need("scipy", "fit", "Figures are fitted")
    if not isinstance(recording, Recording):
        recording = open_recording(recording, sensor, intensity, name="the recording")
    stack = read_static(recording)
    curves = {}
    expected = None
    if scene is not None:
        scene = scene if isinstance(scene, Scene) else Scene.load(scene)
        expected = _scene_ranges(stack, scene, pose)
        _check_pose(stack, expected, recording.name)
        curves["lost_by_range"] = _lost_by_range(stack, expected)
    measured = _measure_rays(stack, recording, white, expected)
    curves |= _noise_curves(measured, stack.sweep_count)
    base = read_model(model) if model else _recorded_sensor(stack)
    name = Path(recording.name).name
    source = f"fitted by lidarpool {__version__} to {name}, {plural(stack.sweep_count, 'sweep')}"
    estimates = measured.estimates
    notes = list(stack.notes)
    if not _has_rings(base, stack):
        notes.append(f"the recorded rings are not those of {base.name}: check --model")
    figures = {
        "versions": {"lidarpool": __version__},
        "name": name,
        "model": base.name,
        "sweeps": stack.sweep_count,
        "rays": len(measured.rays.row),
        "frontal": has_frontal_rays(measured.rays),
        "intensity": bool(np.isfinite(measured.rays.intensity).all()),
        "energy": measured.energy is not None,
        "figures": {key: estimate._asdict() for key, estimate in estimates.items()},
        "notes": notes,
        "channels": _channel_figures(stack, measured, expected),
        "curves": curves,
    }
    return Fit(figures, _with_performance(base, estimates, source) if estimates else base)


def _scene_ranges(stack: SweepStack, scene: Scene, pose: Any) -> Floats:
    """Cast a ray into each cell; return ranges of the scene (r, c), metres, NaN without a hit."""
    rays = stack.directions.reshape(-1, 3)
    sensor = ListedSensor(head=Spin(len(rays), 360), rays=rays, shot_ns=np.zeros(len(rays)))
    ranges = Scanner(scene, sensor).ranges([pose], number=0).reshape(stack.rough_sigma.shape)
    return np.where(np.isfinite(ranges), ranges, np.nan).astype(np.float64)


def _check_pose(stack: SweepStack, expected: Floats, name: str) -> None:
    """Raise LidarError unless half of the ranges are near the scene's ranges (r, c)."""
    difference = np.abs(finite_median(stack.ranges, 0) - expected)
    near_scene = (difference < SCENE_TOLERANCE_M).sum()
    if not near_scene > _MIN_SCENE_SHARE * np.isfinite(difference).sum():
        message = f"less than half of {name} is within {SCENE_TOLERANCE_M} m of the scene"
        raise LidarError(f"{message}: give the sensor's --pose in it, or no scene.")


def _lost_by_range(stack: SweepStack, expected: Floats) -> list[dict[str, float]]:
    """Compute the curve of the share of lost pulses by the range of the scene, (r, c)."""
    surfaces = find_surfaces(stack, expected, 0 * stack.rough_sigma)
    cells = surfaces.smooth & (stack.trials > 0)
    returned = np.isfinite(stack.ranges).sum(axis=0)
    lost = 1 - returned[cells] / stack.trials[cells]
    return _curve(expected[cells], lost)


class _MeasuredRays(NamedTuple):
    """Rays on smooth surfaces, and the performance that was fitted to their returns."""

    rays: SmoothRays
    energy: Floats | None  # (k,): as of `_pulse_energies`; None if unknown
    estimates: dict[str, Estimate]  # {field of `Noise`: estimate}; empty for a single sweep
    sigma: Floats  # (r, c): standard deviation of the ranges of a cell, metres


def _measure_rays(
    stack: SweepStack, recording: Recording, white: float | None, expected: Floats | None
) -> _MeasuredRays:
    """Choose rays on smooth surfaces and fit the performance of the sensor to their returns.

    `white` is the intensity of a white surface, and `expected` are the scene's ranges (r, c).
    LidarError if too few rays meet smooth surfaces.
    """
    white = white or recording.white
    sigma = stack.rough_sigma.copy()
    estimates: dict[str, Estimate] = {}
    for _ in range(2):  # the second pass leaves returns out by the noise that the first pass fits
        direction_noise_rad = 0.0 if estimates else _INITIAL_DIRECTION_NOISE_RAD
        rays = select_smooth_rays(stack, sigma, direction_noise_rad, expected)
        if len(rays.row) < MIN_RAYS:
            message = f"{recording.name} has {len(rays.row)} rays on smooth surfaces"
            raise LidarError(
                f"{message}, not {MIN_RAYS}: record walls or a floor, in the sensor's axes."
            )
        energy = _pulse_energies(rays, white, recording.energies)
        if stack.sweep_count > 1:
            estimates, sigma[rays.row, rays.column] = fit_performance(stack, rays, energy)
    return _MeasuredRays(rays, energy, estimates, sigma)


def _pulse_energies(rays: SmoothRays, white: float | None, are_energies: bool) -> Floats | None:
    """Return the mean energies of the returns of rays (k,), or None if unknown.

    The energy is 1 for a white surface at 10 m; or the energy is the intensity, if the intensities
    of the recording `are_energies`. `white` is the intensity of a white surface, None if unknown.
    """
    if not np.isfinite(rays.intensity).all():
        return None
    if white:
        reflectance = np.maximum(rays.intensity / white, _MIN_REFLECTANCE)
        return np.asarray(reflectance * (10 / rays.distance) ** 2)
    return rays.intensity if are_energies else None


def _noise_curves(measured: _MeasuredRays, sweep_count: int) -> dict[str, list[dict[str, float]]]:
    """Compute the curves of noise, returns and intensity: {name in `_CHARTS`: points}."""
    rays = measured.rays
    light = rays.intensity if measured.energy is None else measured.energy
    variance = np.where(rays.freedom > 0, rays.variance, np.nan)
    range_variance = _range_variances(measured)
    incidence_deg = np.degrees(np.arctan(rays.slope / rays.distance))
    returned = _curve(light, rays.returns / rays.trials) if sweep_count > 1 else []
    return {
        "noise_by_range": _curve(rays.distance, range_variance, 0.5),
        "noise_by_light": _curve(light, range_variance, 0.5),
        "noise_by_tilt": _curve(incidence_deg, variance, 0.5),
        "returned_by_light": returned,
        "light_by_range": _curve(rays.distance, rays.intensity),
    }


def _range_variances(measured: _MeasuredRays) -> Floats:
    """Return variances (k,) of ranges, m², less those by directions; NaN of single returns."""
    rays = measured.rays
    estimate = measured.estimates.get("angle_deg")
    direction_noise_rad = 0.0 if estimate is None else np.radians(estimate.value)
    variance = np.where(rays.freedom > 0, rays.variance, np.nan)
    return np.asarray(variance - (direction_noise_rad * rays.slope) ** 2)


def _has_rings(model: SensorModel, stack: SweepStack) -> bool:
    """Return True if each ring is near a beam of a model, or a calibration file has the beams."""
    offset_deg = np.abs(stack.elevation_deg[:, None] - (model.beams.elevation_deg or np.inf))
    is_near = not offset_deg.min(axis=1).max() > _MAX_RING_OFFSET_DEG
    return model.needs_calibration or is_near


def _with_performance(
    base: SensorModel, estimates: Mapping[str, Estimate], source: str
) -> SensorModel:
    """Return a sensor with estimates in its performance; figures without estimates stay.

    The figures of range noise go together: an estimate of one replaces all of these, and
    `precision`.
    """
    values = {name: float(f"{estimate.value:.4g}") for name, estimate in estimates.items()}
    performance = base.performance or Performance()
    has_range_noise = any(name in values for name in _RANGE_NOISE_FIELDS)
    replaced = {"precision", *_RANGE_NOISE_FIELDS} if has_range_noise else set()
    stated = performance.model_dump(exclude_defaults=True, exclude=replaced)
    if range_m := values.get("detection_range_m"):
        stated["detection"] = {"range_m": range_m, "reflectance": 0.1, "probability": 0.5}
    names = [*_RANGE_NOISE_FIELDS, "angle_deg", "dropout"]
    if "detection" in stated:
        names.append("false_alarms")
    stated |= {name: values[name] for name in names if name in values}
    changes = {"performance": stated, "sources": {**base.sources, "performance": source}}
    return SensorModel.model_validate(base.model_dump() | changes)


def _recorded_sensor(stack: SweepStack) -> SensorModel:
    """Return a sensor with the beams of a recording."""
    return SensorModel(
        name="Recorded sensor",
        sources={"angles": "medians of the recorded points"},
        firings_per_turn=stack.ranges.shape[2],
        range_m=(0.0, float(np.ceil(1.1 * np.nanmax(stack.ranges)))),
        beams={"elevation_deg": np.sort(stack.elevation_deg).round(3).tolist()},
    )


def _channel_figures(
    stack: SweepStack, measured: _MeasuredRays, expected: Floats | None
) -> list[dict[str, Any]]:
    """Return the noise, bias and spread of azimuths of each ring, as dictionaries.

    Bias is the difference from the scene's ranges `expected` (r, c), or from large planes.
    """
    rays = measured.rays
    range_variance = _range_variances(measured)
    bias = _bias(stack, measured, expected)
    azimuth_variance = np.degrees(np.diff(stack.azimuth_offsets, axis=2)) ** 2 / 2
    has_pairs = len(azimuth_variance) > 1
    return [
        {
            "ring": int(ring),
            "elevation_deg": float(stack.elevation_deg[row]),
            "rays": int(np.isfinite(range_variance[rays.row == row]).sum()),
            "noise_m": _root_mean(range_variance[rays.row == row]),
            "bias_m": bias[row]._asdict() if row in bias else None,
            "uneven_deg": _root_mean(azimuth_variance[:, row]) if has_pairs else None,
        }
        for row, ring in enumerate(stack.rings)
    ]


def _bias(
    stack: SweepStack, measured: _MeasuredRays, expected: Floats | None
) -> dict[int, Estimate]:
    """Estimate the bias of each row of the stack, {row: metres}, by rays that are not steep."""
    rays = measured.rays
    flat = rays.select(rays.slope < FLAT_TANGENT * rays.distance)
    cell = flat.row, flat.column
    if expected is not None:
        errors = flat.distance - expected[cell]
        rows = set(flat.row.tolist())
        return {row: Estimate.from_values(errors[flat.row == row]) for row in rows}
    error_m = measured.sigma[cell] / np.sqrt(flat.returns) + _MIN_RANGE_ERROR_M
    return ring_bias(flat, stack.directions[cell], error_m)


def _root_mean(variances: Floats) -> dict[str, float] | None:
    """Estimate the root of the mean of finite variances (n,); None for too few variances."""
    finite = variances[np.isfinite(variances)]
    if len(finite) < MIN_RAYS:
        return None
    return Estimate.from_values(finite).power(0.5)._asdict()


def _curve(x: Floats, values: Floats, power: float = 1.0) -> list[dict[str, float]]:
    """Compute a curve: a power of the mean of values (k,) in parts of x (k,), of equal numbers."""
    finite = np.flatnonzero(np.isfinite(values) & np.isfinite(x))
    order = finite[np.argsort(x[finite], kind="stable")]
    parts = np.array_split(order, min(_CURVE_POINTS, len(order) // MIN_RAYS) or 1)
    return [
        {"x": float(np.median(x[part]))} | Estimate.from_values(values[part]).power(power)._asdict()
        for part in parts
        if len(part) >= MIN_RAYS
    ]
