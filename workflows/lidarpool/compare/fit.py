"""Fits the performance of a sensor to a recording; writes a sensor file and its page.

A figure is a number of the performance, such as the noise of ranges; intervals of figures are
confidence intervals of 95 %. A cell is a ring and a column, which is a step of azimuth of a
revolution. All pulses that the sweeps send into a cell are pulses of the same ray. Arrays have s
sweeps, r rings (rows), c columns and k rays; positions and directions are in the sensor frame.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import yaml
from matplotlib.axes import Axes
from pydantic import Field

from lidarsim._version import __version__
from lidarsim.base.arrays import Bools, Floats, Floats32, Indices, Ints
from lidarsim.base.errors import LidarError, explained, prefixed
from lidarsim.base.extras import need
from lidarsim.base.sampling import even_indices
from lidarsim.base.signatures import ReadableSignature
from lidarsim.base.storage import Storage
from lidarsim.base.validation import checked
from lidarsim.base.words import plural
from lidarsim.columns.cloud import Cloud
from lidarsim.scene.scene import Scene
from lidarsim.sensor import Pose, Spin
from lidarsim.sensor.models import MODEL_FILES, Performance, SensorModel, read_model
from lidarsim.sensor.noise import TARGET_REFLECTANCE, THRESHOLD_SIGMAS
from lidarsim.sensor.ray_sensors import ListedSensor
from lidarsim.simulator import Scanner
from lidarview.render import theme
from lidarview.render.picture_page import Page, label_logarithms

from ..base.open3d_module import load_open3d
from ..columns.parts import StoredCloud
from ..recordings.recordings import RecordedPoints, Recording, open_recording
from ..report.page.rendering import rendered
from .range_image import RangeImages, range_images


class _Chart(NamedTuple):
    """Labels of a chart, and the factor from the values of figures to the unit of the y axis."""

    x_label: str
    y_label: str
    factor: float


# {curve, or column of channels: chart}, three charts a row
_CHARTS = {
    "noise_by_range": _Chart("range, m", "noise, mm", 1000),
    "noise_by_light": _Chart("intensity, or energy", "noise, mm", 1000),
    "noise_by_tilt": _Chart("incidence, °", "noise with that of directions, mm", 1000),
    "returned_by_light": _Chart("intensity, or energy", "pulses that return, %", 100),
    "lost_by_range": _Chart("range of the scene, m", "pulses lost, %", 100),
    "light_by_range": _Chart("range, m", "mean intensity", 1),
    "noise_m": _Chart("elevation, °", "noise, mm", 1000),
    "bias_m": _Chart("elevation, °", "bias, mm", 1000),
    "uneven_deg": _Chart("elevation, °", "spread of azimuths, 0.001°", 1000),
}
_CURVE_POINTS = 14  # points of a curve at most
_RANGE_NOISE_FIELDS = ("range_m", "range_per_m", "range_at_threshold_m")
_MIN_RAYS = 30  # rays that a figure or a point of a curve needs
MAX_RETURNS = 1 << 24  # returns in memory; of a longer recording, sweeps are chosen evenly
_CONFIDENCE = 0.95  # probability of intervals
_CONFIDENCE_SIGMAS = 1.959964  # half of the interval of a normal distribution

# Range images of sweeps
_MAX_FOREIGN_SHARE = 0.1  # share of a sweep's points in rings that the reference does not have
_MAX_RING_OFFSET_DEG = 2.0  # a ring farther from all beams of a model is not one of its beams
_NEIGHBOUR_RAYS = 5  # rays on either side whose scatter counts
_MIN_CELL_SHARE = 0.3  # a cell that returns in a smaller share of sweeps shows no gap
_MAX_LOG_CHANCE = -16.0  # logarithm of the chance of a run of lost pulses that is a gap instead

# Surfaces
_MIN_RANGE_M = 0.1  # nearer points are on the sensor's cover
_MAX_BEAM_ORIGIN_M = 0.1  # how far from zero the beams of a head may meet
_MAX_TANGENT = 5.7  # tangent of incidence: beyond, a beam meets several surfaces
_FLAT_TANGENT = 1.7  # tangent of incidence: beyond, noise of directions makes mean ranges longer
# by how much a surface may leave its plane within four columns
_MAX_KINK_M = 0.01
_MAX_KINK_PER_M = 0.001
# how far surfaces may be from the scene's, and the share of rays that must be nearer
_SCENE_TOLERANCE_M = 0.3
_MIN_SCENE_SHARE = 0.5

# Sensors that move
_MIN_SHIFT_M = 0.02  # shift from which on a sensor moves
_MIN_YAW_RAD = 0.003  # yaw from which on a sensor moves
_MAX_CHANGE_M = 0.1  # median change of ranges, from sweep to sweep, of a static scene
# growth of changes over many sweeps from which on ranges drift
_DRIFT_FACTOR = 1.5
_DRIFT_M = 0.002
_CALM_SHARE = 0.8  # share of the changes, the smallest, whose mean is the scatter
_MIN_EXPLAINED_SHARE = 0.5  # of the rays that a motion changes
_SWEEP_PAIRS = 8  # pairs of sweeps whose motion is fitted
_YAW_ARM_M = 10.0  # distance at which yaw is expressed in metres
# noise of ranges, and motion, for which rays are weighted, metres
_ASSUMED_NOISE_M = 0.02
_ASSUMED_SHIFT_M = 0.5

# Noise of ranges and directions
# noise of directions before the noise is estimated, for the choice of outliers
_INITIAL_DIRECTION_NOISE_RAD = 0.002
_MAX_SIGMAS = 6.0  # a return beyond is of something that moves
_MIN_RETURN_SHARE = 0.8  # share of a ray's returns that belong to one surface
_MIN_REFLECTANCE = 1 / 400  # reflectance of surfaces that are reported as 0
# chances of a variance above which a ray is left out: outliers only, and the upper tail
_OUTLIER_CHANCE = 1e-4
_TAIL_CHANCE = 0.1
# rings of a patch of rays; patches of a revolution
_PATCH_ROWS = 4
_PATCHES = 36
_FRONTAL_TANGENT = 1.0  # tangent of incidence: below, noise is hardly that of directions
_MIN_FRONTAL_RAYS = 100
_MIN_FRONTAL_SHARE = 0.05
_MAX_HALF_INTERVAL = 0.75  # half of the interval of a figure of noise, over its value
_VARIANCE_ERROR = 0.03  # relative error of the variances of steep or distant rays
_MAX_VARIANCE_RATIO = 3.0  # quotient of a variance and the expected variance that counts at most
# quotient of ranges, and tangent of incidence, that determine noise by range and by direction
_MIN_RANGE_RATIO = 2.0
_MIN_TILT_TANGENT = 0.3

# Lost pulses and false alarms
_MIN_WEAK_RAYS = 30  # rays with losses that a threshold needs
_LOG_STEP = 1e-3  # of logarithms, for derivatives
# Rings and degrees of azimuth around a ray into the sky of which no ray returns twice: in smaller
# gaps between leaves, leaves return once.
_SKY_RINGS = 7
_SKY_DEG = 36.0
_MIN_SKY_PULSES = 1000  # pulses into the sky that a share of false alarms needs

# Bias of rings on planes
_MIN_RANGE_ERROR_M = 0.001  # error of a ray's mean range, however often the range is measured
_MAX_PLANES = 8
_PLANE_TOLERANCE_M = 0.05
_MIN_PLANE_RAYS = 300
_MAX_PLANE_POINTS = 20_000
_MIN_RING_RAYS = 20  # rays of a ring on a plane that its bias needs
_MAX_MEDIAN_OFFSET = 0.4  # of points from their plane, over the tolerance
_MAX_DIRECTION_GAP = 0.1  # distance of neighbouring directions of one piece of a plane
_OUTLIER_SIGMAS = 4.0  # beyond, points are not of their planes
_STRICT_SIGMAS = 2.0  # the limit of a second solution, whose change is an error of the planes


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
        pictures = {"fit": _draw_charts(self.figures).svg()}
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
    stack = SweepStack.read(recording)
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
    difference = np.abs(_median(stack.ranges, 0) - expected)
    near_scene = (difference < _SCENE_TOLERANCE_M).sum()
    if not near_scene > _MIN_SCENE_SHARE * np.isfinite(difference).sum():
        message = f"less than half of {name} is within {_SCENE_TOLERANCE_M} m of the scene"
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
        if len(rays.row) < _MIN_RAYS:
            message = f"{recording.name} has {len(rays.row)} rays on smooth surfaces"
            raise LidarError(
                f"{message}, not {_MIN_RAYS}: record walls or a floor, in the sensor's axes."
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


class Estimate(NamedTuple):
    """A figure with its confidence interval."""

    value: float
    low: float
    high: float

    @classmethod
    def from_variance(cls, value: Any, variance: Any) -> Estimate:
        """Build the estimate of a normally distributed value with a variance."""
        half = _CONFIDENCE_SIGMAS
        return cls(*(float(value + sigmas * np.sqrt(variance)) for sigmas in (0, -half, half)))

    @classmethod
    def from_values(cls, values: Floats) -> Estimate:
        """Estimate the mean of values (n,)."""
        return cls.from_variance(values.mean(), values.var() / len(values))

    @classmethod
    def from_shares(cls, parts: Floats, totals: Ints) -> Estimate:
        """Estimate a share: the sum of parts (n,) over the sum of totals (n,), as of lost pulses.

        The interval is that of Clopper and Pearson for the number of independent pulses whose
        binomial variance is the variance of the share by the n parts, at most the sum of totals.
        The interval is not empty if the share is 0.
        """
        from scipy.stats import beta

        total = float(totals.sum())
        share = float(parts.sum()) / total
        share_variance = float(((parts - share * totals) ** 2).sum()) / total**2
        binomial_variance = share * (1 - share) / total
        pulses = (
            total * binomial_variance / share_variance
            if share_variance > binomial_variance > 0
            else total
        )
        tail = (1 - _CONFIDENCE) / 2
        lower = beta.ppf(tail, share * pulses, (1 - share) * pulses + 1) if share > 0 else 0.0
        upper = beta.isf(tail, share * pulses + 1, (1 - share) * pulses) if share < 1 else 1.0
        return cls(share, float(lower), float(upper))

    def is_within(self, share: float) -> bool:
        """Return True if half of the interval is at most a share of the value."""
        return self.high - self.low <= 2 * share * abs(self.value)

    def power(self, exponent: float, scale: float = 1.0) -> Estimate:
        """Return the estimate of `scale` times a power; negative numbers count as 0."""
        value, *limits = (round(float(scale * max(number, 0.0) ** exponent), 9) for number in self)
        return Estimate(value, min(limits), max(limits))


@dataclass(frozen=True, eq=False)
class SweepStack:
    """Returns of all sweeps in the same cells, the highest ring first; NaN without a return."""

    rings: Ints  # (r,): numbers of the rings
    elevation_deg: Floats  # (r,): of the rings
    directions: Floats  # (r, c, 3): mean unit directions of the cells
    ranges: Floats32  # (s, r, c): metres
    intensities: Floats32  # (s, r, c)
    azimuth_offsets: Floats32  # (s, r, c): azimuths of pulses less those of `directions`, radians
    rough_sigma: Floats  # (r, c): rough standard deviation of ranges over the sweeps, metres
    trials: Ints  # (r, c): number of sweeps that cover the cell, with a return or a lost pulse
    notes: tuple[str, ...]

    @property
    def sweep_count(self) -> int:
        """Number of sweeps."""
        return len(self.ranges)

    @classmethod
    def read(cls, recording: Recording) -> SweepStack:
        """Read the sweeps of a recording into the same cells.

        LidarError if the recording has no sweeps with points and rings, or is of several sensors
        or of a sensor that moves.
        """
        name = recording.name
        notes = list(recording.notes)
        if recording.thinned:
            raise LidarError(f"{notes[0]}.")
        if recording.is_cloud or not recording.count:
            raise LidarError(f"{name} has no sweeps: give a recording of sweeps.")
        cells = _CommonCells.read(recording)
        if len(cells.numbers) < recording.count:
            notes.append(
                f"{len(cells.numbers):,} of {recording.count:,} sweeps are used, evenly chosen"
            )
        for index in range(len(cells.numbers)):
            cells.read_sweep(recording, index)
        elevation_deg, values = cells.sorted_by_elevation()
        covered = covered_cells(np.isfinite(values[0]))
        has_return = np.isfinite(values[0]).any(axis=0)
        if (gaps := 1 - covered[:, has_return].mean()) > 0.5 / covered.size:
            notes.append(
                f"{100 * gaps:.2g} % of the sweeps are gaps, of lost packets or sweeps cut short, "
                "and count as no lost pulses"
            )
        directions, azimuth_offsets = _mean_directions(values, elevation_deg, cells.step_deg)
        stack = cls(
            rings=cells.sorted_rings(),
            elevation_deg=elevation_deg,
            directions=directions,
            ranges=values[0],
            intensities=values[1],
            azimuth_offsets=azimuth_offsets,
            rough_sigma=rough_scatter(values[0]),
            trials=covered.sum(axis=0),
            notes=tuple(notes),
        )
        period_ns = None
        if recording.times is not None:
            times = np.array([*recording.times()])[cells.numbers]
            period_ns = float(np.median(np.diff(times)))
        check_static(stack, name, period_ns)
        return stack


@dataclass(eq=False)
class _CommonCells:
    """Cells of a sensor that are filled sweep by sweep; a ring is added with its first return."""

    numbers: Ints  # (s,): numbers of the sweeps of the recording that are read
    reference: RecordedPoints  # the sweep whose rings and steps of azimuth define the cells
    images: RangeImages  # of the reference
    rings: Ints  # (r,)
    elevation_deg: Floats  # (r,)
    values: Floats32  # (4, s, r, c): range, metres; intensity; azimuth and elevation, degrees

    @classmethod
    def read(cls, recording: Recording) -> _CommonCells:
        """Define empty cells by the largest of the first three sweeps."""
        sweeps = (recording.read_points(k) for k in range(min(3, recording.count)))
        reference = max(sweeps, key=len)
        if not len(reference):
            raise LidarError(f"{recording.name} has no points: there is nothing to fit.")
        with prefixed(recording.name):
            images = range_images(reference, reference, ("a sweep", "a sweep"))
        shape = len(images.rings), round(360 / images.step_deg)
        max_sweeps = max(MAX_RETURNS // (shape[0] * shape[1]), 2)
        numbers = even_indices(recording.count, max_sweeps)
        values = np.full((4, len(numbers), *shape), np.nan, np.float32)
        return cls(numbers, reference, images, images.rings, images.elevation_deg, values)

    @property
    def step_deg(self) -> float:
        """Width of a column, degrees."""
        return self.images.step_deg

    def read_sweep(self, recording: Recording, index: int) -> None:
        """Read the sweep `numbers[index]` into the cells; LidarError if of another sensor."""
        number = int(self.numbers[index])
        points = recording.read_points(number)
        if not len(points):
            return
        with prefixed(recording.name):
            names = (f"sweep {number}", "another")
            sweep = range_images(points, self.reference, names, self.step_deg)
            returned = np.isfinite(sweep.images[0, 0])
            # Rings of false alarms alone may have no return in the first sweeps.
            foreign = returned[~np.isin(sweep.rings, self.images.rings)].sum()
            is_foreign = foreign > _MAX_FOREIGN_SHARE * returned.sum()
            # With other steps of azimuth, more points lie behind others of their cell.
            if is_foreign or sweep.hidden_shares[0] > self.images.hidden_shares[0] + 0.25:
                raise LidarError(f"sweep {number} is of another sensor, or another mode.")
        self._add_rings(sweep)
        _, sweep_rows, rows = np.intersect1d(sweep.rings, self.rings, return_indices=True)
        first_column = round(sweep.start_deg / sweep.step_deg)
        columns = first_column + np.arange(sweep.images.shape[-1])
        columns %= self.values.shape[-1]
        self.values[:, index, rows[:, None], columns] = sweep.images[0][:, sweep_rows]

    def _add_rings(self, sweep: RangeImages) -> None:
        """Append rows for the rings of a sweep that no earlier sweep had."""
        is_new = ~np.isin(sweep.rings, self.rings)
        if not is_new.any():
            return
        _, sweep_count, _, column_count = self.values.shape
        self.rings = np.append(self.rings, sweep.rings[is_new])
        self.elevation_deg = np.append(self.elevation_deg, sweep.elevation_deg[is_new])
        blank = np.full((4, sweep_count, is_new.sum(), column_count), np.nan, np.float32)
        self.values = np.concatenate([self.values, blank], axis=2)

    def _order(self) -> Ints:
        """Order of the rows by elevation, the highest first."""
        return np.argsort(-self.elevation_deg, kind="stable")

    def sorted_rings(self) -> Ints:
        """Return the rings, the highest first."""
        return np.asarray(self.rings[self._order()])

    def sorted_by_elevation(self) -> tuple[Floats, Floats32]:
        """Return elevations (r,) and values (4, s, r, c), the highest ring first.

        Sweeps without points are left out.
        """
        order = self._order()
        has_points = np.isfinite(self.values[0]).any(axis=(1, 2))
        return self.elevation_deg[order], self.values[:, has_points][:, :, order]


def _mean_directions(
    values: Floats32, elevation_deg: Floats, step_deg: float
) -> tuple[Floats, Floats32]:
    """Return the mean directions of cells (r, c, 3), and offsets of azimuths (s, r, c), radians.

    `values` (4, s, r, c) are those of `_CommonCells`, `elevation_deg` (r,) the elevations of rings.
    """
    grid_azimuth = np.radians(step_deg * np.arange(values.shape[-1]))
    grid_elevation = elevation_deg[:, None]
    azimuth_offset = (np.radians(values[2]) - grid_azimuth + np.pi) % (2 * np.pi) - np.pi
    elevation_offset = np.radians(values[3] - grid_elevation)
    mean_azimuth_offset, mean_elevation_offset = (
        np.nansum(offset, axis=0) / np.maximum(np.isfinite(offset).sum(axis=0), 1)
        for offset in (azimuth_offset, elevation_offset)
    )
    azimuth = grid_azimuth + mean_azimuth_offset
    elevation = np.radians(grid_elevation) + mean_elevation_offset
    directions = [
        np.cos(elevation) * np.cos(azimuth),
        np.cos(elevation) * np.sin(azimuth),
        np.sin(elevation),
    ]
    return np.stack(directions, axis=-1), azimuth_offset - mean_azimuth_offset


def _median(values: Floats32, axis: int | tuple[int, ...]) -> Any:
    """Return medians of the finite values along axes, float64; NaN without finite values."""
    with warnings.catch_warnings(action="ignore"):
        return np.nanmedian(values, axis=axis).astype(np.float64)


def rough_scatter(ranges: Floats32) -> Floats:
    """Estimate the standard deviation (r, c) over the sweeps of ranges (s, r, c), metres.

    The estimate is a median over neighbouring rays, and at least the median of the ring. Ranges of
    weak or steep surfaces scatter more than ranges of other surfaces of the ring.
    """
    changes = np.abs(np.diff(ranges, axis=0)) / (0.6745 * np.sqrt(2))
    ring_scatter = _median(changes, (0, 2))[:, None]
    ray_scatter = _median(changes, 0)
    shifts = range(-_NEIGHBOUR_RAYS, _NEIGHBOUR_RAYS + 1)
    neighbourhood = _median(np.stack([np.roll(ray_scatter, shift, axis=1) for shift in shifts]), 0)
    ring_scatter = np.where(np.isnan(ring_scatter), _MAX_KINK_M, np.maximum(ring_scatter, 1e-4))
    return np.fmax(neighbourhood, ring_scatter)


class Surfaces(NamedTuple):
    """Surfaces of a range image, (r, c) each."""

    azimuth_slope: Floats  # growth of the range with the azimuth, metres in a radian
    slope: Floats  # growth of the range with the direction of steepest growth, metres in a radian
    smooth: Bools  # whether the neighbours lie in one plane with the cell
    scaled_normal: Floats  # (r, c, 3): normal n of the plane, as n / (n · d) for the direction d


class _Neighbours(NamedTuple):
    """Points (r, c, 3) of the cells beside each cell of a range image, metres."""

    next_1: Floats
    previous_1: Floats
    next_2: Floats  # two columns away
    previous_2: Floats
    above: Floats
    below: Floats

    @classmethod
    def from_points(cls, points: Floats) -> _Neighbours:
        """Shift points (r, c, 3) along columns, which are a revolution, and rows."""
        rows = np.arange(len(points))
        columns = (np.roll(points, shift, axis=1) for shift in (-1, 1, -2, 2))
        rings = (points[np.clip(rows + shift, 0, rows[-1])] for shift in (-1, 1))
        return cls(*columns, *rings)

    def normals(self) -> Floats:
        """Return the normals (r, c, 3) of surfaces, of any length."""
        rise = self.above - self.below if len(self.above) > 2 else np.array([0, 0, 1.0])
        run = 2 * (self.next_2 - self.previous_2) + self.next_1 - self.previous_1
        return np.cross(run, rise)

    def are_coplanar(self, points: Floats, normal: Floats, tolerance_m: Floats) -> Bools:
        """Mark points (r, c, 3) whose neighbours lie in the plane of the point and its normal.

        Tolerances (r, c) are for neighbours in the next column; for others they are doubled.
        """
        means_1 = (self.next_1 + self.previous_1) / 2
        means_2 = (self.next_2 + self.previous_2) / 2
        coplanar = np.ones(points.shape[:2], bool)
        pairs = ((means_1, 1), (means_2, 2), (self.above, 2), (self.below, 2))
        for neighbours, tolerance_factor in pairs:
            offset = np.abs(((neighbours - points) * normal).sum(axis=-1))
            coplanar &= offset < tolerance_factor * tolerance_m
        return coplanar


def find_surfaces(stack: SweepStack, distance: Floats, error_m: Floats) -> Surfaces:
    """Find slopes and edges of a range image `distance` (r, c) with errors (r, c), metres."""
    points = distance[..., None] * stack.directions
    with np.errstate(invalid="ignore", divide="ignore"):
        beams = points - _beam_origins(points)
        length = np.linalg.norm(beams, axis=-1, keepdims=True)
        directions = beams / length
        neighbours = _Neighbours.from_points(points)
        normal = neighbours.normals()
        # The range of a plane n · x = c in the direction d is c / (n · d).
        normal /= (normal * directions).sum(axis=-1, keepdims=True)
        gradient = length * (directions - normal)
        slope = np.linalg.norm(gradient, axis=-1)
        tolerance_m = _MAX_KINK_M + _MAX_KINK_PER_M * distance + 5 * error_m
        smooth = (slope < _MAX_TANGENT * distance) & (distance > _MIN_RANGE_M)
        smooth &= neighbours.are_coplanar(points, normal, tolerance_m)
    azimuth_slope = gradient[..., 1] * directions[..., 0] - gradient[..., 0] * directions[..., 1]
    return Surfaces(azimuth_slope, slope, smooth, normal)


def _beam_origins(points: Floats) -> Floats:
    """Return the origins (r, 1, 3) of the beams of each row of points (r, c, 3), metres.

    Beams of a row meet on the z axis, near zero: heights grow linearly with the distance from the
    axis, and the height at distance 0 is the origin.
    """
    with warnings.catch_warnings(action="ignore"):
        distance = np.hypot(points[..., 0], points[..., 1])
        height = points[..., 2]
        mean_distance = np.nanmean(distance, axis=1)
        offset = distance - np.nanmean(distance, axis=1, keepdims=True)
        tangent = np.nansum(offset * height, axis=1) / np.nansum(offset**2, axis=1)
        origin = np.nanmean(height, axis=1) - tangent * mean_distance
    plausible = np.abs(origin) < _MAX_BEAM_ORIGIN_M  # also false of NaN
    return np.where(plausible, origin, 0)[:, None, None] * np.array([0, 0, 1.0])


def covered_cells(returned: Bools) -> Bools:
    """Return a mask of the cells (s, r, c) into which a sweep sent a pulse: no gaps.

    Lost packets and sweeps cut short make gaps. `returned` (s, r, c) marks the cells with a return.
    A run of cells without a return, in all rings or in one ring, is a gap if pulses that are lost
    independently would hardly ever make such a run.
    """
    share = (returned.sum(axis=0) + 0.5) / (len(returned) + 1)
    log_chance = np.where(share > _MIN_CELL_SHARE, np.log1p(-share), 0.0)
    # Columns without a return in any ring are gaps also where few sweeps return at all.
    sparse_log_chance = np.log1p(-returned.sum(axis=0) / (len(returned) + 1)).sum(axis=0)
    columns = _improbable_runs(np.asarray(~returned.any(axis=1)), sparse_log_chance)
    rings = _improbable_runs(~returned, log_chance)
    return ~(columns[:, None] | rings)


def _improbable_runs(empty: Bools, log_chance: Floats) -> Bools:
    """Mark runs of empty cells along the last axis, a revolution, that are too long for chance.

    `log_chance` are the logarithms of the chances that cells are empty; the last axis is columns.
    """
    count = empty.shape[-1]
    edge = np.zeros((*empty.shape[:-1], 1), bool)
    twice = np.concatenate([edge, empty, empty, edge], axis=-1)
    changes = np.diff(twice.ravel().astype(np.int8))
    starts = np.flatnonzero(changes == 1)
    stops = np.flatnonzero(changes == -1)
    weights = np.zeros(twice.shape)
    weights[..., 1:-1] = np.concatenate([log_chance, log_chance], axis=-1)
    total = np.cumsum(weights.ravel())
    gaps = total[stops] - total[starts] < _MAX_LOG_CHANCE
    marks = np.zeros(twice.size, np.int64)
    marks[starts[gaps] + 1] += 1
    marks[stops[gaps] + 1] -= 1
    inside = np.cumsum(marks).reshape(twice.shape) > 0
    return np.asarray(inside[..., 1 : count + 1] | inside[..., count + 1 : -1])


def check_static(stack: SweepStack, name: str, period_ns: float | None) -> None:
    """Raise LidarError if the sensor or the recorded scene moves.

    One rigid motion, a shift and a yaw, has to explain the ranges of most of the rays that the
    motion changes. `period_ns` is the time from sweep to sweep, if known.
    """
    if stack.sweep_count < 2:
        return
    _check_motion(stack, name, period_ns)
    _check_drift(stack, name)
    changes = np.abs(np.diff(stack.ranges, axis=0))
    if (change := _median(changes, (0, 1, 2))) > _MAX_CHANGE_M:
        raise LidarError(
            f"{name} has ranges that change by {change:.2g} m from sweep to sweep, in the median, "
            "and no motion of the sensor explains that: give points in metres, of a place that "
            "stands still."
        )


def _check_motion(stack: SweepStack, name: str, period_ns: float | None) -> None:
    """Raise LidarError if a sensor moves from sweep to sweep, or over the recording."""
    count = stack.sweep_count
    starts = even_indices(count - 1, _SWEEP_PAIRS).tolist()
    steps = [sensor_motion(stack, k, k + 1) for k in starts]
    overall = [sensor_motion(stack, 0, k) for k in sorted({count // 2, count - 1})]
    motions = [step for step in steps if step.moves]
    sweeps = 1
    if len(motions) <= len(steps) / 2:
        if not all(motion.moves for motion in overall):
            return
        motions = [overall[-1]]
        sweeps = count - 1
    shift_m = float(np.median([motion.shift_m for motion in motions])) / sweeps
    yaw_deg = float(np.degrees(np.median([motion.yaw_rad for motion in motions]))) / sweeps
    speeds = []
    if shift_m > 0:
        speed = f" ({1e9 * shift_m / period_ns:.2g} m/s)" if period_ns else ""
        speeds.append(f"{shift_m:.2g} m{speed}")
    if yaw_deg > 0:
        speeds.append(f"{yaw_deg:.2g}°")
    raise LidarError(
        f"{name} is of a sensor that moves, by {' and '.join(speeds)} from sweep to sweep: give "
        "sweeps of a sensor that stands, or one sweep for the bias of its rings."
    )


def _check_drift(stack: SweepStack, name: str) -> None:
    """Raise LidarError if ranges change more over many sweeps than from sweep to sweep."""
    lag = stack.sweep_count // 2
    step_m = range_scatter(stack, 1)
    drift_m = range_scatter(stack, lag)
    if drift_m > _DRIFT_FACTOR * step_m + _DRIFT_M:
        raise LidarError(
            f"{name} has ranges that drift: smooth surfaces change by {step_m:.2g} m from sweep to "
            f"sweep, but by {drift_m:.2g} m in {lag} sweeps, so the sensor or the place moves, "
            "or the sensor warms up: give sweeps of a warm sensor that stands."
        )


class SensorMotion(NamedTuple):
    """Motion of a sensor between two sweeps; 0 if noise may explain the changes of ranges."""

    shift_m: float  # length
    yaw_rad: float  # magnitude

    @property
    def moves(self) -> bool:
        """True if the sensor moves."""
        return self.shift_m > _MIN_SHIFT_M or self.yaw_rad > _MIN_YAW_RAD


class RangeChanges(NamedTuple):
    """Changes of the ranges of smooth surfaces between two sweeps."""

    surfaces: Surfaces  # of the first sweep
    # (r, c): rays that meet smooth surfaces, not steeply, in the first sweep and return in both
    chosen: Bools
    change: Floats  # (r, c): metres, second less first, without the change by shifted azimuths


def range_changes(stack: SweepStack, first: int, second: int) -> RangeChanges:
    """Compare the ranges of two sweeps where the first sweep meets smooth surfaces."""
    distance = stack.ranges[first].astype(np.float64)
    # Changes of ranges from sweep to sweep are no noise if the sensor moves.
    surfaces = find_surfaces(stack, distance, np.full_like(distance, _ASSUMED_NOISE_M))
    with np.errstate(invalid="ignore"):
        azimuth_change = stack.azimuth_offsets[second] - stack.azimuth_offsets[first]
        change = stack.ranges[second] - distance - surfaces.azimuth_slope * azimuth_change
        chosen = surfaces.smooth & np.isfinite(change) & (surfaces.slope < _FLAT_TANGENT * distance)
    return RangeChanges(surfaces, chosen, change)


def range_scatter(stack: SweepStack, lag: int) -> float:
    """Return the typical change of the range of a smooth surface in `lag` sweeps, metres.

    The result is a mean without the largest changes: ranges may be rounded to more than their
    noise.
    """
    scatter = []
    for first in even_indices(stack.sweep_count - lag, _SWEEP_PAIRS).tolist():
        changes = range_changes(stack, first, first + lag)
        sizes = np.sort(np.abs(changes.change[changes.chosen]))
        if len(sizes) >= _MIN_RAYS:
            scatter.append(sizes[: round(_CALM_SHARE * len(sizes))].mean())
    return float(np.median(scatter)) if scatter else 0.0


def sensor_motion(stack: SweepStack, first: int, second: int) -> SensorMotion:
    """Fit the shift and the yaw of the sensor between two sweeps to the changes of ranges.

    In the direction d, the plane n · x = c is nearer by n · s / (n · d) after a shift s of the
    sensor.
    """
    surfaces, chosen, changes = range_changes(stack, first, second)
    if chosen.sum() < _MIN_RAYS:
        return SensorMotion(0.0, 0.0)
    change = changes[chosen]
    distance = stack.ranges[first].astype(np.float64)[chosen]
    # Normals are of points two columns away on either side: normals of close points are inexact.
    column_count = stack.ranges.shape[2]
    normal_error = _ASSUMED_NOISE_M / (np.sqrt(10) * distance * 2 * np.pi / column_count)
    noise = np.hypot(_ASSUMED_NOISE_M + _MAX_KINK_PER_M * distance, _ASSUMED_SHIFT_M * normal_error)
    # Yaw as metres at a distance of 10 m, so that the unknowns are of about the same size.
    design = np.column_stack(
        [-surfaces.scaled_normal[chosen], surfaces.azimuth_slope[chosen] / _YAW_ARM_M]
    )
    changed = np.abs(change) > 5 * noise  # in a street, few rays show how far the sensor moves
    for rays in (slice(None), changed):
        motion = _rigid_motion(design[rays], change[rays], noise[rays])
        if _explains(motion, design, change, noise, normal_error):
            shift_m = float(np.linalg.norm(motion[:3]))
            yaw_rad = float(abs(motion[3])) / _YAW_ARM_M
            return SensorMotion(
                shift_m if shift_m > _MIN_SHIFT_M else 0.0,
                yaw_rad if yaw_rad > _MIN_YAW_RAD else 0.0,
            )
    return SensorMotion(0.0, 0.0)


def _explains(
    motion: Floats, design: Floats, change: Floats, noise: Floats, normal_error: Floats
) -> bool:
    """Return True if a motion (4,) explains most of the large changes that the motion predicts.

    `motion` and `design` (k, 4) are those of `_rigid_motion`. `change` (k,) has the changes of
    ranges and `noise` (k,) their noise, metres; `normal_error` (k,) the errors of normals, radians.
    """
    predicted = design @ motion
    residual = np.abs(change - predicted)
    scale = 1.4826 * np.median(residual / noise)
    limit = np.hypot(3 * scale * noise, 3 * normal_error * np.linalg.norm(motion[:3]))
    large = np.abs(predicted) > limit
    if large.sum() < _MIN_RAYS:
        return False
    return bool((residual < np.abs(predicted) / 2)[large].mean() >= _MIN_EXPLAINED_SHARE)


def _rigid_motion(design: Floats, change: Floats, noise: Floats) -> Floats:
    """Fit a motion (4,) to changes of ranges (k,): shift x, y, z and yaw at `_YAW_ARM_M`, metres.

    A row of `design` (k, 4) is the change of the range with the motion; `noise` (k,) is the noise
    of `change`, metres. Components along principal axes of the covariance that are not significant
    are 0. Huber's estimate: few rays of things that move count little.
    """
    motion: Floats = np.zeros(4)
    if len(change) < _MIN_RAYS:
        return motion
    for _ in range(30):
        residual = np.abs(change - design @ motion) / noise
        weight = np.sqrt(np.minimum(1, 2 / np.maximum(residual, 1e-9))) / noise
        weighted = design * weight[:, None]
        motion = np.asarray(np.linalg.lstsq(weighted, change * weight, rcond=1e-6)[0], np.float64)
    covariance = _sandwich(weighted, (change - design @ motion) * weight)
    variance, axes = np.linalg.eigh(covariance)
    components = axes.T @ motion
    significant = np.abs(components) > 5 * np.sqrt(np.maximum(variance, 0)) + 1e-9
    motion = axes @ np.where(significant, components, 0.0)
    return np.asarray(motion)


class SmoothRays(NamedTuple):
    """Rays that meet smooth surfaces, (k,) each."""

    row: Ints
    column: Ints
    distance: Floats  # mean of the ranges, metres
    slope: Floats  # growth of the range with the direction, as `Surfaces.slope`, metres in a radian
    intensity: Floats  # mean; NaN if unknown
    returns: Ints  # number of sweeps with a return
    trials: Ints  # number of sweeps that cover the ray, as in `SweepStack`
    variance: Floats  # of the range over the sweeps, square metres
    freedom: Ints  # degrees of freedom of the variance: its returns, less 1

    def select(self, chosen: Bools | Indices) -> SmoothRays:
        """Select rays by mask or index."""
        return SmoothRays._make(values[chosen] for values in self)


class _RayStatistics(NamedTuple):
    """Statistics of the returns of rays, without returns that are outliers, (k,) each."""

    mean_range: Floats  # metres
    mean_intensity: Floats
    variance: Floats  # of the range, square metres
    return_count: Ints


def select_smooth_rays(
    stack: SweepStack, sigma: Floats, direction_noise_rad: float, expected: Floats | None = None
) -> SmoothRays:
    """Choose rays away from edges, and compute the statistics of their returns.

    A return is an outlier if the range is more than `_MAX_SIGMAS` standard deviations from the
    median of the ray, by the noise of ranges `sigma` (r, c), metres, and of directions. Outliers
    are left out, and rays with many outliers. Slopes are those of a scene's ranges `expected`
    (r, c), metres, if known.
    """
    median = _median(stack.ranges, 0)
    return_count = np.isfinite(stack.ranges).sum(axis=0)
    error_m = stack.rough_sigma / np.sqrt(np.maximum(return_count, 1))
    surfaces = find_surfaces(stack, median, error_m)
    slopes = surfaces.slope
    smooth = surfaces.smooth
    if expected is not None:
        slopes = find_surfaces(stack, expected, 0 * error_m).slope
        smooth &= np.abs(median - expected) < _SCENE_TOLERANCE_M
    # A cell that is smooth by chance, as in leaves, has no smooth cells beside it.
    neighbours = np.sum([np.roll(smooth, shift, axis=1) for shift in (-2, -1, 1, 2)], axis=0)
    cell = np.nonzero(smooth & (neighbours >= 3))
    slope = slopes[cell]
    returns = return_count[cell]
    limit_m = _MAX_SIGMAS * np.hypot(sigma[cell], direction_noise_rad * slope)
    limit_m = np.where(returns > 1, limit_m, np.inf)
    statistics = _ray_statistics(stack, cell, surfaces.azimuth_slope[cell], median[cell], limit_m)
    rays = SmoothRays(
        row=cell[0],
        column=cell[1],
        distance=statistics.mean_range,
        slope=slope,
        intensity=statistics.mean_intensity,
        returns=returns,
        trials=stack.trials[cell],
        variance=statistics.variance,
        freedom=statistics.return_count - 1,
    )
    count = statistics.return_count
    return rays.select(np.flatnonzero((count > 0) & (count >= _MIN_RETURN_SHARE * returns)))


def _ray_statistics(
    stack: SweepStack,
    cell: tuple[Indices, ...],
    azimuth_slope: Floats,
    median: Floats,
    limit_m: Floats,
) -> _RayStatistics:
    """Compute the statistics of returns within a distance (k,) from the median range (k,).

    `cell` has the rows and columns (k,) of the rays. Ranges are corrected for the azimuths of
    their pulses by `azimuth_slope` (k,), as of `Surfaces`; all distances are in metres.
    """
    row, column = cell
    ranges = stack.ranges[:, row, column].astype(np.float64)
    ranges -= azimuth_slope * stack.azimuth_offsets[:, row, column].astype(np.float64)
    intensities = stack.intensities[:, row, column].astype(np.float64)
    inliers = np.abs(ranges - median) <= limit_m
    inlier_count = inliers.sum(axis=0)
    divisor = np.maximum(inlier_count, 1)
    mean_range = np.where(inliers, ranges, 0).sum(axis=0) / divisor
    mean_intensity = np.where(inliers, intensities, 0).sum(axis=0) / divisor
    squares = np.where(inliers, (ranges - mean_range) ** 2, 0).sum(axis=0)
    return _RayStatistics(
        mean_range, mean_intensity, squares / np.maximum(inlier_count - 1, 1), inlier_count
    )


def has_frontal_rays(rays: SmoothRays) -> bool:
    """Return True if enough frontal rays separate noise of ranges from noise of directions."""
    frontal = (rays.slope < _FRONTAL_TANGENT * rays.distance).sum()
    return bool(frontal >= max(_MIN_FRONTAL_RAYS, _MIN_FRONTAL_SHARE * len(rays.row)))


def fit_performance(
    stack: SweepStack, rays: SmoothRays, energy: Floats | None
) -> tuple[dict[str, Estimate], Floats]:
    """Estimate the performance of a sensor from repeated sweeps.

    `energy` (k,) is that of the returns of rays, if known. Returns estimates by the field names of
    `Noise`; and the standard deviations of rays (k,), metres, by range or by energy, whichever is
    likelier.
    """
    threshold, dropout = _fit_detection(rays, energy)
    scatter = fit_scatter(rays, "range_per_m", rays.distance, 1)
    if energy is not None and threshold is not None:
        by_energy = fit_scatter(rays, "range_at_threshold_m", threshold.value / energy, 2)
        if "range_at_threshold_m" in by_energy.estimates and by_energy.deviance < scatter.deviance:
            scatter = by_energy
    figures = {}
    if has_frontal_rays(rays):
        figures = {
            name: estimate
            for name, estimate in scatter.estimates.items()
            if estimate.is_within(_MAX_HALF_INTERVAL)
        }
    if threshold is not None:
        figures["detection_range_m"] = threshold.power(-0.5, 10 * np.sqrt(TARGET_REFLECTANCE))
    if alarms := alarm_share(stack):
        figures["false_alarms"] = alarms
    if dropout is not None:
        figures["dropout"] = dropout
    return figures, scatter.sigma


def _fit_detection(
    rays: SmoothRays, energy: Floats | None
) -> tuple[Estimate | None, Estimate | None]:
    """Estimate the energy of which half of the pulses return, and the share lost at any energy.

    Either is None if undetermined; `energy` (k,) is None if unknown.
    """
    light = np.nan_to_num(rays.intensity) if energy is None else energy
    strong = light >= np.median(light)
    threshold = None
    dropout = lost_share(rays, strong)
    for _ in range(3):
        if energy is None:
            break
        lost = dropout.value if dropout else 0.0
        threshold = fit_threshold(energy, rays.returns, rays.trials, lost)
        if threshold is None:
            break
        strong = energy > 2 * threshold.value  # no pulse of these is lost for want of energy
        dropout = lost_share(rays, strong) or dropout
    return threshold, dropout


def lost_share(rays: SmoothRays, chosen: Bools) -> Estimate | None:
    """Estimate the share of pulses that chosen rays (k,) lose; None for too few rays.

    A ray without any return is unknown, so the rays that are known lose fewer pulses than others.
    For each return of a ray, the share is that of the other `trials - 1` pulses: the mean of
    (trials - returns) / (trials - 1) over all returns is unbiased.
    """
    chosen = chosen & (rays.trials > 1)
    if chosen.sum() < _MIN_RAYS:
        return None
    returns = rays.returns[chosen]
    trials = rays.trials[chosen]
    return Estimate.from_shares((trials - returns) * returns / (trials - 1), returns)


class ScatterFit(NamedTuple):
    """Noise of ranges and directions that was fitted to the variances of rays."""

    estimates: dict[str, Estimate]  # {field of `Noise`: estimate}
    sigma: Floats  # (k,): fitted standard deviation of the range of each ray, metres
    deviance: float  # of the fit to all rays; a smaller deviance is likelier


class _VarianceSamples(NamedTuple):
    """Variances of the ranges of rays that lose few pulses, (k,) each."""

    variance: Floats  # square metres
    freedom: Ints  # degrees of freedom of the variance
    growth: Floats  # the quantity with which noise of ranges grows, such as the range
    slope: Floats  # metres in a radian
    distance: Floats  # metres
    patch: Ints  # number of the patch of neighbouring rays, whose errors may be alike


@dataclass(frozen=True, eq=False)
class _VarianceModel:
    """Variance of ranges: noise that grows with a quantity, plus noise of directions.

    The three parameters are relative to the usual variance v: for noise of ranges σ at growth 0,
    (σ / √v) to the power `power`; the increase of that power at `growth_scale`; and the variance
    by noise of directions at `slope_scale` over v. Methods take the parameters (p,) that `fitted`
    marks; the others are 0.
    """

    power: int  # of σ and the growth: 1 if noise adds, 2 if variances add
    fitted: Bools  # (3,): which parameters are fitted
    variance_scale: float  # usual variance v, square metres
    growth_scale: float  # usual growth, in its unit
    slope_scale: float  # usual slope, metres in a radian

    def variance(self, parameters: Floats, growth: Floats, slope: Floats) -> Floats:
        """Return the variances (k,) of the ranges of rays, square metres."""
        theta = np.zeros(3)
        theta[self.fitted] = parameters
        range_term = theta[0] + theta[1] * (growth / self.growth_scale) ** self.power
        direction_term = theta[2] * (slope / self.slope_scale) ** 2
        return np.asarray(self.variance_scale * (range_term ** (2 / self.power) + direction_term))

    def expected(self, parameters: Floats, samples: _VarianceSamples) -> Floats:
        """Return the variances (k,) that the model gives samples, square metres."""
        return self.variance(parameters, samples.growth, samples.slope)


def fit_scatter(rays: SmoothRays, increase_name: str, growth: Floats, power: int) -> ScatterFit:
    """Fit noise of ranges and directions to the variances of rays, by their likelihood.

    The noise of ranges is a + b g for power 1 and √(a² + b² g²) for power 2, with the `growth` g
    (k,); a is the figure `range_m`, and b the figure `increase_name`. Figures that the rays do not
    determine, for want of different growths or inclined surfaces, are left out. Intervals are of
    sandwich estimators, for patches of rays that may be alike, and of errors of the model: edges,
    slopes, and growth.
    """
    lower, middle, upper = np.quantile(growth, (0.05, 0.5, 0.95))
    samples = _variance_samples(rays, growth)
    is_tilted = np.quantile(rays.slope / rays.distance, 0.9) > _MIN_TILT_TANGENT
    model = _VarianceModel(
        power=power,
        # Growth is fitted even if undetermined: it widens the interval of range_m rightly.
        fitted=np.array([True, True, is_tilted]),
        variance_scale=max(float(np.median(samples.variance)), 1e-12),
        growth_scale=middle,
        slope_scale=np.median(rays.slope),
    )
    exponents = (1 / power, 1 / power, 0.5)
    scales = np.sqrt(model.variance_scale) / np.array([1, middle, np.radians(model.slope_scale)])
    theta, theta_variance = _fit_variances(model, samples)
    names = ("range_m", increase_name, "angle_deg")
    estimates = {
        names[k]: Estimate.from_variance(value, variance).power(exponents[k], scales[k])
        for k, value, variance in zip(
            np.flatnonzero(model.fitted), theta, theta_variance, strict=True
        )
        if k != 1 or upper > _MIN_RANGE_RATIO * lower
    }
    expected = model.expected(theta, samples)
    ratios = np.minimum(samples.variance / expected, _MAX_VARIANCE_RATIO)
    deviance = float(samples.freedom @ (np.log(expected) + ratios))
    return ScatterFit(estimates, np.sqrt(model.variance(theta, growth, rays.slope)), deviance)


def _variance_samples(rays: SmoothRays, growth: Floats) -> _VarianceSamples:
    """Choose the rays whose variances are fitted; `growth` (k,) is of all rays.

    Rays that lose many pulses are left out: only their nearer or brighter pulses return.
    """
    repeated = (rays.freedom > 0) & (rays.returns >= _MIN_RETURN_SHARE * rays.trials)
    patch_columns = max(int(rays.column.max()) // _PATCHES, 1)
    patch = rays.row // _PATCH_ROWS * (_PATCHES + 2) + rays.column // patch_columns
    return _VarianceSamples(
        variance=rays.variance[repeated],
        freedom=rays.freedom[repeated],
        growth=growth[repeated],
        slope=rays.slope[repeated],
        distance=rays.distance[repeated],
        patch=patch[repeated],
    )


def _fit_variances(model: _VarianceModel, samples: _VarianceSamples) -> tuple[Floats, Floats]:
    """Fit the parameters of a model (p,) to samples, and estimate the variances (p,) of the fit."""
    start = np.array([1.0, 0.1, 0.1])[model.fitted]
    theta, covariance = _fit_trimmed(model, start, samples, _TAIL_CHANCE)
    # Edges that are finer than the rays make the variances of some rays larger: the change of the
    # figures if fewer rays are left out is an error of the model.
    untrimmed, _ = _fit_trimmed(model, theta, samples, _OUTLIER_CHANCE)
    variances = np.diag(covariance) + (theta - untrimmed) ** 2
    # Slopes are not exact: variances of steep or distant rays may be wrong against the others.
    for quantity in (samples.slope / samples.distance, samples.growth):
        error = _VARIANCE_ERROR * np.where(quantity > np.median(quantity), 1.0, -1.0)
        changed = samples._replace(variance=samples.variance * (1 + error))
        biased, _ = _fit_trimmed(model, theta, changed, _TAIL_CHANCE)
        variances += (biased - theta) ** 2
    return theta, variances


def _fit_trimmed(
    model: _VarianceModel, start: Floats, samples: _VarianceSamples, chance: float
) -> tuple[Floats, Floats]:
    """Fit a model to variances, and estimate the covariance (p, p) of its parameters (p,).

    Samples whose variance is above a quantile, which a share `chance` of the expected distribution
    exceeds, are left out; the expected mean of the others is that of the truncated distribution.
    `start` (p,) has initial parameters.
    """
    from scipy.optimize import least_squares
    from scipy.stats import chi2

    freedom = samples.freedom
    limit = chi2.isf(chance, freedom)
    inliers = np.ones(len(samples.variance), bool)
    truncated_mean = chi2.cdf(limit, freedom + 2) / (1 - chance)
    theta = start
    for step in range(12):
        expected = model.expected(theta, samples)
        if step:
            inliers = freedom * samples.variance / expected < limit
        scale = truncated_mean if step else 1.0
        weight = np.sqrt(freedom / 2) / expected

        def residuals(
            parameters: Floats, rows: Bools = inliers, weight: Floats = weight, scale: Any = scale
        ) -> Any:
            variance = scale * model.expected(parameters, samples)
            return ((samples.variance - variance) * weight)[rows]

        x_scale = np.maximum(theta, 0.01)
        solved = least_squares(residuals, theta, bounds=(0, np.inf), x_scale=x_scale)
        theta = solved.x
    return theta, _sandwich(solved.jac, solved.fun, samples.patch[inliers])


def _sandwich(design: Floats, residuals: Floats, patch: Ints | None = None) -> Floats:
    """Estimate the covariance of a least-squares fit whose residuals (k,) are of unequal size.

    Residuals of one patch (k,), such as of a surface, may be alike.
    """
    inverse = np.linalg.pinv(design.T @ design, hermitian=True)
    score = design * residuals[:, None]
    if patch is not None:
        _, patch = np.unique(patch, return_inverse=True)
        sums = np.zeros((patch.max() + 1, score.shape[1]))
        np.add.at(sums, patch, score)
        score = sums * np.sqrt(len(sums) / max(len(sums) - 1, 1))
    covariance: Floats = inverse @ (score.T @ score) @ inverse
    return covariance


def fit_threshold(energy: Floats, count: Ints, trials: Ints, dropout: float) -> Estimate | None:
    """Estimate the energy of which half of the pulses return, by the curve of `Noise.detected`.

    `energy` (n,) is that of rays, which return `count` (n,) of `trials` (n,) pulses; `dropout` is
    the share that is lost at any energy. A ray is recorded only if a pulse returns: the likelihood
    is that of a truncated binomial distribution. None if too few rays lose some of their pulses.
    """
    from scipy.optimize import brute
    from scipy.special import ndtr
    from scipy.stats import binom

    def detection(log_threshold: Any) -> Floats:
        share = ndtr(THRESHOLD_SIGMAS * (energy / np.exp(log_threshold) - 1))
        return np.clip((1 - dropout) * share, 1e-9, 1 - 1e-9)

    def deviance(log_threshold: Any) -> Floats:
        p: Floats = detection(log_threshold)
        return np.log1p(-((1 - p) ** trials)) - binom.logpmf(count, trials, p)

    lower, upper = np.log(np.quantile(energy, (0.001, 0.999)))
    (fitted,) = brute(lambda guess: deviance(guess).sum(), [(lower - 2, upper)], Ns=60)
    if (detection(fitted) < 0.9 * (1 - dropout)).sum() < _MIN_WEAK_RAYS:
        return None
    below, centre, above = (deviance(fitted + step) for step in (-_LOG_STEP, 0, _LOG_STEP))
    information = (above - 2 * centre + below).sum() / _LOG_STEP**2
    score = (((above - below) / (2 * _LOG_STEP)) ** 2).sum()
    return Estimate(*np.exp(Estimate.from_variance(fitted, score / information**2)).tolist())


def alarm_share(stack: SweepStack) -> Estimate | None:
    """Estimate the share of pulses into the sky that return.

    A pulse counts as a pulse into the sky if no other pulse of its ray returns, and no ray in its
    neighbourhood returns twice; rays of fewer than three pulses do not count. None with little sky,
    or with two sweeps.
    """
    from scipy.ndimage import maximum_filter
    from scipy.stats import binomtest

    count = np.isfinite(stack.ranges).sum(axis=0)
    # Weak surfaces, which return seldom, are beside surfaces that return more often.
    size = _SKY_RINGS, round(_SKY_DEG / 360 * count.shape[1])
    repeated = maximum_filter(count, size=size, mode=("nearest", "wrap")) > 1
    sky = ~repeated & (stack.trials > 2)
    alarms = int((count[sky] == 1).sum())
    trials = int(stack.trials[sky & (count == 0)].sum()) + alarms
    if trials < _MIN_SKY_PULSES:
        return None
    return Estimate(alarms / trials, *map(float, binomtest(alarms, trials).proportion_ci()))


class _PlaneRays(NamedTuple):
    """Rays on large planes that several rings cross, (n,) each; a plane is a flat surface."""

    rays: Indices  # indices into the rays
    plane: Ints  # numbers of the planes


def ring_bias(rays: SmoothRays, directions: Floats, error_m: Floats) -> dict[int, Estimate]:
    """Estimate by how much the ranges of rows differ from the mean of all: {row: metres}.

    Large planes u · x = 1 and offsets b of the rows are fitted at once to the ranges r of rays with
    `directions` d (k, 3): 1 / r = u · d − b / r², times r². Ranges have standard deviations
    `error_m` (k,), metres. A row that meets a single plane has no offset. Surfaces are not quite
    plane: intervals hold noise, and the changes of the offsets if points far from their planes, or
    any of the planes, are left out (jackknife; Efron, 1982).
    """
    if not len(rays.row):
        return {}
    chosen = _plane_rays(rays, directions)
    rows, row_index = np.unique(rays.row[chosen.rays], return_inverse=True)
    if len(rows) < 3:
        return {}
    _, plane = np.unique(chosen.plane, return_inverse=True)
    plane_count = plane.max() + 1
    error_m = error_m[chosen.rays]
    distance = rays.distance[chosen.rays]
    normals = np.eye(plane_count)[plane][:, :, None] * directions[chosen.rays][:, None]
    normals = normals.reshape(len(distance), -1) * distance[:, None] ** 2
    design = np.hstack([normals, -np.eye(len(rows))[row_index]]) / error_m[:, None]
    offsets, variances = _solve_offsets(design, distance / error_m, plane)
    estimates = zip(rows.tolist(), offsets, variances, strict=True)
    return {row: Estimate.from_variance(offset, variance) for row, offset, variance in estimates}


def _plane_rays(rays: SmoothRays, directions: Floats) -> _PlaneRays:
    """Choose rays, with directions (k, 3), of rings that cross at least two large planes."""
    indices = even_indices(len(rays.row), _MAX_PLANE_POINTS)
    plane = _segment_planes(rays.distance[indices, None] * directions[indices])
    count = np.zeros((rays.row.max() + 1, plane.max() + 2), np.int64)
    np.add.at(count, (rays.row[indices], plane), 1)  # the last column is of points in no plane
    crosses_planes = (count[:, :-1] >= _MIN_RING_RAYS).sum(axis=1) > 1
    chosen = (plane >= 0) & crosses_planes[rays.row[indices]]
    return _PlaneRays(indices[chosen], plane[chosen])


def _solve_offsets(design: Floats, values: Floats, plane: Ints) -> tuple[Floats, Floats]:
    """Return the offsets of rows (r,), whose mean is 0, and the variances (r,) of the offsets.

    The unknowns of `design` (n, 3 p + r) are the vectors u of p planes, then the offsets, see
    `ring_bias`; `plane` (n,) is the plane of each equation, and `values` (n,) the right sides.
    """
    plane_count = plane.max() + 1
    first = 3 * plane_count
    row_count = design.shape[1] - first
    # One offset of all rows is nearly the same as other planes: the mean of the rows is 0.
    centred = np.eye(row_count) - 1 / row_count
    solution, inliers = _solve_without_outliers(design, values, _OUTLIER_SIGMAS)
    offsets = centred @ solution[first:]
    strict_solution, _ = _solve_without_outliers(design, values, _STRICT_SIGMAS)
    used = design[inliers]
    covariance = _sandwich(used, values[inliers] - used @ solution)[first:, first:]
    shift = centred @ strict_solution[first:] - offsets
    replicates = [
        centred @ np.linalg.lstsq(design[chosen], values[chosen], rcond=None)[0][first:]
        for chosen in (inliers & (plane != number) for number in range(plane_count))
    ]
    variances = np.diag(centred @ covariance @ centred) + shift**2
    variances += (plane_count - 1) * np.var(replicates, axis=0)
    return offsets, variances


def _solve_without_outliers(
    design: Floats, values: Floats, max_sigmas: float
) -> tuple[Floats, Bools]:
    """Solve least squares without residuals beyond a number of standard deviations.

    Returns the solution, and a mask of the equations (k,) that are used.
    """
    residuals = np.zeros(len(values))
    for _ in range(4):
        sizes = np.abs(residuals)
        inliers = sizes <= max_sigmas * 1.4826 * np.median(sizes)
        solution = np.linalg.lstsq(design[inliers], values[inliers], rcond=None)[0]
        residuals = values - design @ solution
    return solution, inliers


def _segment_planes(points: Floats) -> Ints:
    """Return the number of the large plane that each point (n, 3) lies in; -1 for no plane."""
    o3d = load_open3d()
    o3d.utility.random.seed(0)
    plane = np.full(len(points), -1)
    remaining = np.arange(len(points))
    for _ in range(_MAX_PLANES):
        if len(remaining) < _MIN_PLANE_RAYS:
            break
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points[remaining]))
        (*normal, constant), _ = cloud.segment_plane(_PLANE_TOLERANCE_M, 3, 400)
        offset = np.abs(points[remaining] @ normal + constant)  # from the plane of all inliers
        inliers = np.flatnonzero(offset < _PLANE_TOLERANCE_M)
        inlier_points = points[remaining[inliers]]
        directions = inlier_points / np.linalg.norm(inlier_points, axis=1)[:, None]
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(directions))
        # Walls in a line are not quite one plane: the largest piece is.
        piece = np.asarray(cloud.cluster_dbscan(_MAX_DIRECTION_GAP, 3))
        inliers = inliers[piece == np.bincount(piece + 1)[1:].argmax()]
        # What fills the slab evenly is cut out of other surfaces.
        is_large = len(inliers) >= _MIN_PLANE_RAYS
        if is_large and np.median(offset[inliers]) < _MAX_MEDIAN_OFFSET * _PLANE_TOLERANCE_M:
            plane[remaining[inliers]] = plane.max() + 1
        remaining = np.delete(remaining, inliers)
    return plane


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
    flat = rays.select(rays.slope < _FLAT_TANGENT * rays.distance)
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
    if len(finite) < _MIN_RAYS:
        return None
    return Estimate.from_values(finite).power(0.5)._asdict()


def _curve(x: Floats, values: Floats, power: float = 1.0) -> list[dict[str, float]]:
    """Compute a curve: a power of the mean of values (k,) in parts of x (k,), of equal numbers."""
    finite = np.flatnonzero(np.isfinite(values) & np.isfinite(x))
    order = finite[np.argsort(x[finite], kind="stable")]
    parts = np.array_split(order, min(_CURVE_POINTS, len(order) // _MIN_RAYS) or 1)
    return [
        {"x": float(np.median(x[part]))} | Estimate.from_values(values[part]).power(power)._asdict()
        for part in parts
        if len(part) >= _MIN_RAYS
    ]


def _draw_charts(figures: Mapping[str, Any]) -> Page:
    """Draw the curves and rings, with their intervals."""
    channels = figures["channels"]
    curves = dict(figures["curves"])
    for name in ("noise_m", "bias_m", "uneven_deg"):
        curves[name] = [
            {"x": channel["elevation_deg"], **channel[name]}
            for channel in channels
            if channel[name]
        ]
    names = [name for name in _CHARTS if curves.get(name)]
    height = 140 + 500 * -(-len(names) // 3)  # pixels
    page = Page((1600, height))
    page.title(figures["model"], f"fitted to {figures['name']}; bars are intervals of 95 %")
    for number, name in enumerate(names):
        row, column = divmod(number, 3)
        bottom = 1 - (530 + 500 * row) / height
        axes = page.chart((0.075 + 0.32 * column, bottom, 0.235, 360 / height))
        _draw_curve(page, axes, name, curves[name])
    return page


def _draw_curve(page: Page, axes: Axes, name: str, points: Sequence[Mapping[str, float]]) -> None:
    """Draw the points of a curve of `_CHARTS`, and their intervals."""
    chart = _CHARTS[name]
    x = np.array([point["x"] for point in points])
    value, lower, upper = (
        chart.factor * np.array([point[field] for point in points]) for field in Estimate._fields
    )
    axes.set(xlabel=chart.x_label, ylabel=chart.y_label)
    if name.endswith("light") and x[0] > 0:
        axes.set_xscale("log")
        label_logarithms(axes.xaxis, x[-1] < 1000 * x[0])
    is_share = chart.y_label.endswith("%")
    if is_share:
        lower, upper = np.clip((lower, upper), 0, 100)
    axes.vlines(x, lower, upper, color=theme.UNSEEN, lw=1.8 * page.unit)
    axes.plot(x, value, "o", color=theme.OBJECT_COLOURS[0], ms=3.2 * page.unit, mew=0)
    if is_share:
        axes.set_ylim(*np.clip(axes.get_ylim(), -1, 101))
