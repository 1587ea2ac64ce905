"""Fits a sensor to a recording of a unit: a sensor file and its page; intervals are of 95 %."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import yaml
from pydantic import Field

from lidarsim._version import __version__
from lidarsim.base.arrays import Bools, Floats, Floats32, Ints
from lidarsim.base.errors import LidarError, explained, prefixed
from lidarsim.base.extras import need
from lidarsim.base.sampling import even_indices
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
from ..report.page.rendering import rendered
from .range_image import range_images
from .recordings import Recording, open_recording

# {curve, or column of channels: (label of x, label of y, factor)}, three a row
_CHARTS = {
    "noise_by_range": ("range, m", "noise, mm", 1000),
    "noise_by_light": ("intensity, or energy", "noise, mm", 1000),
    "noise_by_tilt": ("incidence, °", "noise with that of directions, mm", 1000),
    "returned_by_light": ("intensity, or energy", "pulses that return, %", 100),
    "lost_by_range": ("range of the scene, m", "pulses lost, %", 100),
    "light_by_range": ("range, m", "mean intensity", 1),
    "noise_m": ("elevation, °", "noise, mm", 1000),
    "bias_m": ("elevation, °", "bias, mm", 1000),
    "uneven_deg": ("elevation, °", "spread of azimuths, 0.001°", 1000),
}
_RANGES = ("range_m", "range_per_m", "range_at_threshold_m")  # noise of ranges
# rays that a figure or a point of a curve needs; points of a curve
_FEW = 30
_POINTS = 14
_AIM = 0.002  # scatter of directions that does not make outliers before it is known, radians
_LEAST_M = 0.001  # error of the mean range of a ray, however often it is measured
_HEAD_M = 0.1  # how far from zero the beams of a head may meet
_NEAREST_M = 0.1  # nearer points are of the sensor's cover, or of what lies on it
_FLAT = 1.7  # tangent of incidence: beyond, noise of directions makes mean ranges longer
_DARKEST = 1 / 400  # reflectance of what is reported as 0
MOST_VALUES = 1 << 24  # returns in memory; of more sweeps than these make, some are read
_REPEATED = 0.8  # least share of a ray's returns that belong to one surface
_STILL_M = 0.02  # shift of a sensor, metres, from which on it moves
_STILL_RAD = 0.003  # the same of its yaw
_CHANGED_M = 0.1  # median change of ranges, from sweep to sweep, of a place that changes
# growth of changes over many sweeps from which on ranges drift
_DRIFT = 1.5
_DRIFT_M = 0.002
_CALM = 0.8  # share of the changes, the smallest ones, that tell the scatter
_AGREEING = 0.5  # least share of the rays that a motion changes and explains
# pairs of sweeps for the motion; distance at which yaw counts, metres
_PAIRS = 8
_YAW_M = 10.0
# noise of ranges, and motion, for which rays are weighted, metres
_ROUGH_M = 0.02
_SHIFT_M = 0.5
_AROUND = 5  # rays on either side whose scatter counts
_SELDOM = 0.3  # a cell that returns in fewer sweeps tells no gap
_CHANCE = -16.0  # logarithm of the chance of a run of lost pulses that is a gap instead
# by how much a surface may leave its plane within four columns
_KINK_M = 0.01
_KINK = 0.001
_SIGMAS = 6.0  # a return beyond these is of something that moves
_STEEPEST = 5.7  # tangent of incidence: beyond, a beam meets several surfaces
# how far surfaces may be from the scene's, and share of these
_BESIDE_M = 0.3
_BESIDE = 0.5
_FOREIGN = 0.1  # share of a sweep's points in rings of no other sweep, of another sensor
_OTHER_DEG = 2.0  # a ring that is farther from all beams of a model is not one of them
# probability of intervals, and its quantile
_CERTAIN = 0.95
_Z = 1.959964
_STEP = 1e-3  # of logarithms, for derivatives
# Chances of a variance above which a ray is left out: certainly, and at most.
_REJECTED = 1e-4
_TRIMMED = 0.1
# rings of a patch of rays; patches of a turn
_PATCH_ROWS = 4
_PATCHES = 36
_FRONTAL = 1.0  # tangent of incidence: below, noise is hardly that of directions
# least number, and share, of such rays
_FRONTAL_RAYS = 100
_FRONTAL_SHARE = 0.05
_KNOWN = 0.75  # half of the interval of a figure of noise, over its value, at most
_WRONG = 0.03  # relative error of the variances of steep or far rays
_OUTLIER = 3.0  # quotient of a variance and the expected one that counts at most
# least quotient of ranges, and tangent of incidence, that tell noise
_SPAN = 2.0
_TILT = 0.3
# rays with losses that a threshold needs; that of a ring's bias
_WEAK_RAYS = 30
_RING_RAYS = 20
# Rings and degrees of azimuth around a ray into the sky of which no ray returns twice: in smaller
# gaps between leaves, leaves return once.
_SKY_RINGS = 7
_SKY_DEG = 36.0
_SKY_PULSES = 1000  # pulses into the sky that a share of false alarms needs
_PLANES = 8
_PLANE_M = 0.05
_PLANE_RAYS = 300
_PLANE_POINTS = 20_000
_EVEN = 0.4
_GAP = 0.1
# beyond, points are not of their planes
_FAR_SIGMAS = 4.0
_NEAR_SIGMAS = 2.0


@dataclass(frozen=True, eq=False, repr=False)
class Fit:
    """What `fit` has found; printed as a table."""

    figures: dict[str, Any]  # all that the page shows; lengths in metres
    model: SensorModel  # the sensor with what was fitted

    def __repr__(self) -> str:
        return rendered("fit.txt", report=self.figures).rstrip("\n")

    @checked
    def save(self, file: str | Path) -> list[Path]:
        """Write the sensor file and its page, a .html beside it, and return their paths.

        LidarError if the file is no .yaml, or cannot be written.
        """
        place = Path(file)
        if place.suffix not in MODEL_FILES:
            raise LidarError(f"{place} is no sensor file: give a name such as mine.yaml.")
        told = self.model.model_dump(mode="json", exclude_defaults=True)
        text = "".join(f"# {line}\n" for line in repr(self).splitlines())
        text += yaml.safe_dump(told, sort_keys=False, allow_unicode=True, default_flow_style=None)
        drawn = {"fit": _drawn(self.figures).svg()}
        page = rendered("fit.html", report=self.figures, pictures=drawn)
        written = {place: text, place.with_suffix(".html"): page}
        with explained(f"{place} cannot be written", "choose a folder that exists and has room"):
            for path, content in written.items():
                Storage.at(path.parent, durable=False).write(path.name, content.encode())
        return [*written]


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
    """Fit the performance of a sensor to sweeps of a unit that stands.

    Parameters
    ----------
    recording
        Sweeps in any format of `compare`, or a cloud in memory that has sweeps.
    model
        The sensor, by name or file; what the recording does not tell keeps its figures. By default
        a sensor with the recorded beams.
    scene, pose
        The place as a scene, and the sensor's pose in it; by default surfaces are the recording's.
    sensor, intensity
        Of several, name of the sensor or topic of a bag; column, if not ``intensity``.
    white
        Intensity of a white surface, if it is the same at all ranges; known of Velodyne and Ouster.

    Raises
    ------
    LidarError
        If it cannot be read, has no sweeps or rings, is of several sensors or of one that moves,
        or scipy is missing.
    """
    need("scipy", "fit", "Figures are fitted")
    if not isinstance(recording, Recording):
        recording = open_recording(recording, sensor, intensity, name="the recording")
    repeats = Repeats.read(recording)
    sigma = repeats.sigma.copy()
    count = len(repeats.ranges)
    curves = {}
    expected = None
    if scene is not None:
        expected = _cast(repeats, scene if isinstance(scene, Scene) else Scene.load(scene), pose)
        off = np.abs(_median(repeats.ranges, 0) - expected)
        if not (off < _BESIDE_M).sum() > _BESIDE * np.isfinite(off).sum():
            told = f"less than half of {recording.name} is within {_BESIDE_M} m of the scene"
            raise LidarError(f"{told}: give the sensor's --pose in it, or no scene.")
        smooth = surfaces(repeats, expected, 0 * sigma).smooth & (repeats.trials > 0)
        returned = np.isfinite(repeats.ranges).sum(axis=0)
        lost = 1 - returned[smooth] / repeats.trials[smooth]
        curves["lost_by_range"] = _curve(expected[smooth], lost)
    found = dict[str, Estimate]()
    for _ in range(2):  # the first finds what the second leaves out
        rays = smooth_rays(repeats, sigma, 0.0 if found else _AIM, expected)
        if len(rays.row) < _FEW:
            told = f"{recording.name} has {len(rays.row)} rays on smooth surfaces, not {_FEW}"
            raise LidarError(f"{told}: record walls or a floor, in the sensor's axes.")
        known = np.isfinite(rays.light).all()
        energy = rays.light if known and recording.energies else None
        if known and (white := white or recording.white):
            energy = np.maximum(rays.light / white, _DARKEST) * (10 / rays.distance) ** 2
        if count > 1:
            found, sigma[rays.row, rays.column] = fit_performance(repeats, rays, energy)
    aim = np.radians(found["angle_deg"].value) if "angle_deg" in found else 0.0
    tilted = np.where(rays.freedom > 0, rays.variance, np.nan)
    own = tilted - (aim * rays.slope) ** 2
    light = rays.light if energy is None else energy
    curves["noise_by_range"] = _curve(rays.distance, own, 0.5)
    curves["noise_by_light"] = _curve(light, own, 0.5)
    curves["noise_by_tilt"] = _curve(np.degrees(np.arctan(rays.slope / rays.distance)), tilted, 0.5)
    curves["returned_by_light"] = _curve(light, rays.returns / rays.trials) if count > 1 else []
    curves["light_by_range"] = _curve(rays.distance, rays.light)
    base = read_model(model) if model else _recorded(repeats)
    name = Path(recording.name).name
    source = f"fitted by lidarpool {__version__} to {name}, {plural(repeats.sweeps, 'sweep')}"
    fitted = _with(base, found, source) if found else base
    notes = list(repeats.notes)
    off = np.abs(repeats.elevation_deg[:, None] - (base.beams.elevation_deg or np.inf))
    if not base.needs_calibration and off.min(axis=1).max() > _OTHER_DEG:
        notes.append(f"the recorded rings are not those of {base.name}: check --model")
    figures = {
        "versions": {"lidarpool": __version__}, "name": name, "model": base.name,
        "sweeps": repeats.sweeps, "rays": len(rays.row),
        "frontal": meet_frontally(rays),
        "intensity": bool(known), "energy": energy is not None,
        "figures": {key: one._asdict() for key, one in found.items()}, "notes": notes,
        "channels": _channels(repeats, rays, own, sigma, expected), "curves": curves,
    }  # fmt: skip
    return Fit(figures, fitted)


def _with(base: SensorModel, known: Mapping[str, Estimate], source: str) -> SensorModel:
    """Return a sensor with what was fitted in its performance; the rest stays."""
    found = {name: float(f"{one.value:.4g}") for name, one in known.items()}
    old = base.performance or Performance()
    stated = old.model_dump(exclude_defaults=True, exclude={"precision", *_RANGES})
    if far := found.get("detection_range_m"):
        stated["detection"] = {"range_m": far, "reflectance": 0.1, "probability": 0.5}
    names = *_RANGES, "angle_deg", "dropout", *["false_alarms"] * ("detection" in stated)
    stated |= {name: found[name] for name in names if name in found}
    own = {"performance": stated, "sources": {**base.sources, "performance": source}}
    return SensorModel.model_validate(base.model_dump() | own)


def _recorded(repeats: Repeats) -> SensorModel:
    """Return a sensor with the beams of a recording."""
    return SensorModel(
        name="Recorded sensor",
        sources={"angles": "medians of the recorded points"},
        firings_per_turn=repeats.ranges.shape[2],
        range_m=(0.0, float(np.ceil(1.1 * np.nanmax(repeats.ranges)))),
        beams={"elevation_deg": np.sort(repeats.elevation_deg).round(3).tolist()},
    )


def _cast(repeats: Repeats, scene: Scene, pose: Any) -> Floats:
    """Ranges of a scene in the cells, (r, c); NaN where it has nothing."""
    ways = repeats.directions.reshape(-1, 3)
    sensor = ListedSensor(head=Spin(len(ways), 360), rays=ways, shot_ns=np.zeros(len(ways)))
    found = Scanner(scene, sensor).ranges([pose], number=0).reshape(repeats.sigma.shape)
    return np.where(np.isfinite(found), found, np.nan).astype(np.float64)


class Estimate(NamedTuple):
    """A figure with its interval."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, value: Any, variance: Any) -> Estimate:
        """Make one of a normally distributed estimate."""
        return cls(*(float(value + sigmas * np.sqrt(variance)) for sigmas in (0, -_Z, _Z)))

    @classmethod
    def mean(cls, values: Floats) -> Estimate:
        """Make one of the mean of values (n,)."""
        return cls.of(values.mean(), values.var() / len(values))

    @classmethod
    def share(cls, parts: Floats, wholes: Ints) -> Estimate:
        """Estimate the sum of parts (n,) over that of wholes (n,), such as pulses lost of pulses.

        The interval is that of Clopper and Pearson for as many independent pulses as explain the
        scatter of the n shares; it is not empty if the share is 0.
        """
        from scipy.stats import beta

        total = float(wholes.sum())
        share = float(parts.sum()) / total
        square = float(((parts - share * wholes) ** 2).sum()) / total**2
        binomial = share * (1 - share) / total
        count = total * binomial / square if square > binomial > 0 else total
        tail = (1 - _CERTAIN) / 2
        low = beta.ppf(tail, share * count, (1 - share) * count + 1) if share > 0 else 0.0
        high = beta.isf(tail, share * count + 1, (1 - share) * count) if share < 1 else 1.0
        return cls(share, float(low), float(high))

    def known_within(self, share: float) -> bool:
        """Whether the half of the interval is at most this share of the value."""
        return self.high - self.low <= 2 * share * abs(self.value)

    def power(self, exponent: float, scale: float = 1.0) -> Estimate:
        """Return the estimate of a power, times a scale; what is below 0 counts as 0."""
        value, *ends = (round(float(scale * max(one, 0.0) ** exponent), 9) for one in self)
        return Estimate(value, min(ends), max(ends))


@dataclass(frozen=True, eq=False)
class Repeats:
    """Returns in the same cells of a sensor, the highest ring first; NaN without a return."""

    rings: Ints  # (r,): numbers
    elevation_deg: Floats  # (r,)
    directions: Floats  # (r, c, 3): unit vectors
    ranges: Floats32  # (s, r, c): metres
    light: Floats32  # (s, r, c): intensities
    aside: Floats32  # (s, r, c): azimuths beside those of the directions, radians
    sigma: Floats  # (r, c): rough scatter of ranges from sweep to sweep, metres
    trials: Ints  # (r, c): sweeps that cover the cell; the others have a gap there
    notes: tuple[str, ...]

    @property
    def sweeps(self) -> int:
        """Number of sweeps."""
        return len(self.ranges)

    @classmethod
    def read(cls, recording: Recording) -> Repeats:
        """Put the sweeps of a recording into the same cells, one after the other.

        LidarError if it has no sweeps with points and rings, or they are of several sensors.
        """
        name = recording.name
        notes = list(recording.notes)
        if recording.thinned:
            raise LidarError(f"{notes[0]}.")
        if recording.whole or not recording.count:
            raise LidarError(f"{name} has no sweeps: give a recording of sweeps.")
        own = max((recording.turn(k) for k in range(min(3, recording.count))), key=len)
        if not len(own):
            raise LidarError(f"{name} has no points: there is nothing to fit.")
        with prefixed(name):
            cells = range_images(own, own, ("a sweep", "a sweep"))
        shape = len(cells.rings), round(360 / cells.step_deg)
        numbers = even_indices(recording.count, max(MOST_VALUES // (shape[0] * shape[1]), 2))
        if len(numbers) < recording.count:
            notes.append(f"{len(numbers):,} of {recording.count:,} sweeps are used, evenly chosen")
        values = np.full((4, len(numbers), *shape), np.nan, np.float32)
        rings = cells.rings
        elevation = cells.elevation_deg
        for k, number in enumerate(numbers.tolist()):
            if not len(turn := recording.turn(number)):
                continue
            with prefixed(name):
                found = range_images(turn, own, (f"sweep {number}", "another"), cells.step_deg)
                returned = np.isfinite(found.images[0, 0])
                # Rings of false alarms alone may have no return in the first sweeps.
                foreign = returned[~np.isin(found.rings, cells.rings)].sum()
                other = foreign > _FOREIGN * returned.sum()
                if other or found.hidden[0] > cells.hidden[0] + 0.25:
                    raise LidarError(f"sweep {number} is of another sensor, or another mode.")
            unseen = ~np.isin(found.rings, rings)
            rings = np.append(rings, found.rings[unseen])
            elevation = np.append(elevation, found.elevation_deg[unseen])
            blank = np.full((4, len(numbers), unseen.sum(), shape[1]), np.nan, np.float32)
            values = np.concatenate([values, blank], axis=2) if unseen.any() else values
            _, rows, there = np.intersect1d(found.rings, rings, return_indices=True)
            columns = round(found.begin_deg / found.step_deg) + np.arange(found.images.shape[-1])
            values[:, k, there[:, None], columns % shape[1]] = found.images[0][:, rows]
        order = np.argsort(-elevation, kind="stable")
        rings = rings[order]
        elevation = elevation[order]
        values = values[:, np.isfinite(values[0]).any(axis=(1, 2))][:, :, order]
        covered = covered_cells(np.isfinite(values[0]))
        if (gaps := 1 - covered[:, np.isfinite(values[0]).any(axis=0)].mean()) > 0.5 / covered.size:
            notes.append(
                f"{100 * gaps:.2g} % of the sweeps are gaps, of lost packets or sweeps cut short, "
                "and count as no lost pulses"
            )
        level = elevation[:, None]
        first = np.radians(cells.step_deg * np.arange(shape[1]))
        aside = (np.radians(values[2]) - first + np.pi) % (2 * np.pi) - np.pi
        risen = np.radians(values[3] - level)
        mean, rise = (
            np.nansum(one, axis=0) / np.maximum(np.isfinite(one).sum(axis=0), 1)
            for one in (aside, risen)
        )
        turned = first + mean
        up = np.radians(level) + rise
        ways = [np.cos(up) * np.cos(turned), np.cos(up) * np.sin(turned), np.sin(up)]
        sigma = rough_scatter(values[0])
        repeats = cls(
            rings, elevation, np.stack(ways, axis=-1),
            values[0], values[1], aside - mean, sigma,
            covered.sum(axis=0), tuple(notes),
        )  # fmt: skip
        times = None if recording.times is None else np.array([*recording.times()])[numbers]
        check_stands(repeats, name, None if times is None else float(np.median(np.diff(times))))
        return repeats


def _median(values: Floats32, axis: int | tuple[int, ...]) -> Any:
    """Return medians over what is there, float64; of nothing NaN."""
    with warnings.catch_warnings(action="ignore"):
        return np.nanmedian(values, axis=axis).astype(np.float64)


def rough_scatter(ranges: Floats32) -> Floats:
    """Scatter of ranges (s, r, c) of the rays around each, metres: that of the ring at least.

    Surfaces that are weak or steep scatter more than others of a ring.
    """
    changes = np.abs(np.diff(ranges, axis=0)) / (0.6745 * np.sqrt(2))
    ring = _median(changes, (0, 2))[:, None]
    ray = _median(changes, 0)
    reach = range(-_AROUND, _AROUND + 1)
    around = _median(np.stack([np.roll(ray, by, axis=1) for by in reach]), 0)
    ring = np.where(np.isnan(ring), _KINK_M, np.maximum(ring, 1e-4))
    return np.fmax(around, ring)


class Surfaces(NamedTuple):
    """Surfaces of a range image, (r, c) each."""

    turn: Floats  # change of the range with the azimuth, metres in a radian
    slope: Floats  # change of the range with the direction where it changes most, likewise
    smooth: Bools  # whether the neighbours lie in one plane with the cell
    normal: Floats  # (r, c, 3): normal of the plane, over its product with the ray's direction


def surfaces(repeats: Repeats, distance: Floats, blur: Floats) -> Surfaces:
    """Find slopes and edges of a range image (r, c), whose ranges have errors of `blur` metres."""
    points = distance[..., None] * repeats.directions
    rows = np.arange(len(distance))
    with np.errstate(invalid="ignore", divide="ignore"):
        beams = points - _meeting(points)
        length = np.linalg.norm(beams, axis=-1, keepdims=True)
        ways = beams / length
        ahead, back, far, rear = (np.roll(points, by, axis=1) for by in (-1, 1, -2, 2))
        above, below = (points[np.clip(rows + by, 0, rows[-1])] for by in (-1, 1))
        rise = above - below if len(rows) > 2 else np.array([0, 0, 1.0])
        normal = np.cross(2 * (far - rear) + ahead - back, rise)
        # The range of a plane n · x = c in the direction d is c / (n · d).
        normal /= (normal * ways).sum(axis=-1, keepdims=True)
        change = length * (ways - normal)
        slope = np.linalg.norm(change, axis=-1)
        allowed = _KINK_M + _KINK * distance + 5 * blur
        smooth = (slope < _STEEPEST * distance) & (distance > _NEAREST_M)
        near = (ahead + back) / 2
        wide = (far + rear) / 2
        for beside, times in ((near, 1), (wide, 2), (above, 2), (below, 2)):
            smooth &= np.abs(((beside - points) * normal).sum(axis=-1)) < times * allowed
    turn = change[..., 1] * ways[..., 0] - change[..., 0] * ways[..., 1]
    return Surfaces(turn, slope, smooth, normal)


def covered_cells(returned: Bools) -> Bools:
    """Tell the cells (s, r, c) that sweeps cover from gaps: lost packets, and sweeps cut short.

    `returned` (s, r, c) are the cells with a return. A run of cells without any, in all rings or in
    one, is a gap if pulses that are lost independently would hardly ever make such a run.
    """
    share = (returned.sum(axis=0) + 0.5) / (len(returned) + 1)
    chance = np.where(share > _SELDOM, np.log1p(-share), 0.0)
    # Columns without a return in any ring are gaps also where few sweeps return at all.
    sparse = np.log1p(-returned.sum(axis=0) / (len(returned) + 1))
    columns = _long_runs(np.asarray(~returned.any(axis=1)), sparse.sum(axis=0))
    rings = _long_runs(~returned, chance)
    return ~(columns[:, None] | rings)


def _long_runs(empty: Bools, chance: Floats) -> Bools:
    """Mark the runs along the last axis, which is a turn, that are too long for chance.

    `chance` are the logarithms of the chances that a cell is empty.
    """
    count = empty.shape[-1]
    edge = np.zeros((*empty.shape[:-1], 1), bool)
    twice = np.concatenate([edge, empty, empty, edge], axis=-1)
    first, last = (np.flatnonzero(np.diff(twice.ravel().astype(np.int8)) == by) for by in (1, -1))
    weights = np.zeros(twice.shape)
    weights[..., 1:-1] = np.concatenate([chance, chance], axis=-1)
    total = np.cumsum(weights.ravel())
    gaps = total[last] - total[first] < _CHANCE
    marks = np.zeros(twice.size, np.int64)
    marks[first[gaps] + 1] += 1
    marks[last[gaps] + 1] -= 1
    inside = np.cumsum(marks).reshape(twice.shape) > 0
    return np.asarray(inside[..., 1 : count + 1] | inside[..., count + 1 : -1])


def check_stands(repeats: Repeats, name: str, period_ns: float | None) -> None:
    """Refuse sweeps of a sensor that moves, or of a place that does.

    One rigid motion, a shift and a yaw, has to explain the ranges of most of the rays that it
    changes. `period_ns` is the time from sweep to sweep, if it is known.
    """
    if (count := repeats.sweeps) < 2:
        return
    starts = even_indices(count - 1, _PAIRS).tolist()
    steps = [sensor_motion(repeats, k, k + 1) for k in starts]
    overall = [sensor_motion(repeats, 0, k) for k in {count // 2, count - 1}]
    moving = [step for step in steps if step.moves]
    if len(moving) > len(steps) / 2 or all(motion.moves for motion in overall):
        motion = moving if len(moving) > len(steps) / 2 else [overall[-1]]
        sweeps = 1 if len(moving) > len(steps) / 2 else count - 1
        shift_m = float(np.median([one.shift_m for one in motion])) / sweeps
        yaw_deg = float(np.degrees(np.median([one.yaw_rad for one in motion]))) / sweeps
        speeds = [f"{shift_m:.2g} m", f"{yaw_deg:.2g}°"]
        if period_ns:
            speeds[0] += f" ({1e9 * shift_m / period_ns:.2g} m/s)"
        told = " and ".join(
            speed for speed, some in zip(speeds, (shift_m > 0, yaw_deg > 0), strict=True) if some
        )
        raise LidarError(
            f"{name} is of a sensor that moves, by {told} from sweep to sweep: give sweeps of a "
            "sensor that stands, or one sweep for the bias of its rings."
        )
    lag = count // 2
    step_m = range_scatter(repeats, 1)
    drift_m = range_scatter(repeats, lag)
    if drift_m > _DRIFT * step_m + _DRIFT_M:
        raise LidarError(
            f"{name} has ranges that drift: smooth surfaces change by {step_m:.2g} m from sweep to "
            f"sweep, but by {drift_m:.2g} m in {lag} sweeps, so the sensor or the place moves, "
            "or the sensor warms up: give sweeps of a warm sensor that stands."
        )
    changes = np.abs(np.diff(repeats.ranges, axis=0))
    if (change := _median(changes, (0, 1, 2))) > _CHANGED_M:
        raise LidarError(
            f"{name} has ranges that change by {change:.2g} m from sweep to sweep, in the median, "
            "and no motion of the sensor explains that: give points in metres, of a place that "
            "stands still."
        )


class SensorMotion(NamedTuple):
    """Motion of a sensor from a sweep to another; 0 where none can be told from noise."""

    shift_m: float
    yaw_rad: float

    @property
    def moves(self) -> bool:
        """Whether the sensor moves."""
        return self.shift_m > _STILL_M or self.yaw_rad > _STILL_RAD


class RangeChanges(NamedTuple):
    """Changes of the ranges of smooth surfaces from a sweep to another."""

    plane: Surfaces  # of the first sweep
    chosen: Bools  # (r, c): rays that meet smooth surfaces, not steeply, in both sweeps
    change: Floats  # (r, c): metres, without that of shifted azimuths


def range_changes(repeats: Repeats, first: int, second: int) -> RangeChanges:
    """Compare the ranges of two sweeps where the first meets smooth surfaces."""
    distance = repeats.ranges[first].astype(np.float64)
    # Changes of ranges from sweep to sweep tell no noise if the sensor moves.
    plane = surfaces(repeats, distance, np.full_like(distance, _ROUGH_M))
    with np.errstate(invalid="ignore"):
        turned = repeats.aside[second] - repeats.aside[first]
        change = repeats.ranges[second] - distance - plane.turn * turned
        chosen = plane.smooth & np.isfinite(change) & (plane.slope < _FLAT * distance)
    return RangeChanges(plane, chosen, change)


def range_scatter(repeats: Repeats, lag: int) -> float:
    """Return the typical change of the range of a smooth surface in `lag` sweeps, metres.

    It is a mean without the largest changes: ranges may be rounded to more than their noise.
    """
    scatter = []
    for first in even_indices(repeats.sweeps - lag, _PAIRS).tolist():
        changes = range_changes(repeats, first, first + lag)
        sizes = np.sort(np.abs(changes.change[changes.chosen]))
        if len(sizes) >= _FEW:
            scatter.append(sizes[: round(_CALM * len(sizes))].mean())
    return float(np.median(scatter)) if scatter else 0.0


def sensor_motion(repeats: Repeats, first: int, second: int) -> SensorMotion:
    """Fit the shift and the yaw of the sensor between two sweeps to the changes of ranges.

    A plane n · x = c is nearer by n · s / (n · d) in the direction d after a shift s.
    """
    distance = repeats.ranges[first].astype(np.float64)
    plane, chosen, change = range_changes(repeats, first, second)
    if chosen.sum() < _FEW:
        return SensorMotion(0.0, 0.0)
    change = change[chosen]
    far = distance[chosen]
    # Normals are of points two columns away on either side: those of near points are inexact.
    inexact = _ROUGH_M / (np.sqrt(10) * far * 2 * np.pi / distance.shape[1])
    noise = np.hypot(_ROUGH_M + _KINK * far, _SHIFT_M * inexact)
    # Yaw as metres at a distance of 10 m, so that the unknowns are of about the same size.
    design = np.column_stack([-plane.normal[chosen], plane.turn[chosen] / _YAW_M])
    changed = np.abs(change) > 5 * noise  # in a street, few rays tell how far the sensor goes
    for rays in (slice(None), changed):
        motion = _rigid_motion(design[rays], change[rays], noise[rays])
        explained = design @ motion
        off = np.abs(change - explained)
        scale = 1.4826 * np.median(off / noise)
        limit = np.hypot(3 * scale * noise, 3 * inexact * np.linalg.norm(motion[:3]))
        told = np.abs(explained) > limit
        if told.sum() < _FEW or (off < np.abs(explained) / 2)[told].mean() < _AGREEING:
            continue
        shift_m = float(np.linalg.norm(motion[:3]))
        yaw_rad = float(abs(motion[3])) / _YAW_M
        return SensorMotion(
            shift_m if shift_m > _STILL_M else 0.0, yaw_rad if yaw_rad > _STILL_RAD else 0.0
        )
    return SensorMotion(0.0, 0.0)


def _rigid_motion(design: Floats, change: Floats, noise: Floats) -> Floats:
    """Fit a shift and a yaw (4,) to changes of ranges (k,); 0 where the changes do not tell them.

    Huber's estimate: few rays of things that move count little.
    """
    motion: Floats = np.zeros(4)
    if len(change) < _FEW:
        return motion
    for _ in range(30):
        size = np.abs(change - design @ motion) / noise
        weight = np.sqrt(np.minimum(1, 2 / np.maximum(size, 1e-9))) / noise
        weighted = design * weight[:, None]
        motion = np.asarray(np.linalg.lstsq(weighted, change * weight, rcond=1e-6)[0], np.float64)
    spread, axes = np.linalg.eigh(_sandwich(weighted, (change - design @ motion) * weight))
    along = axes.T @ motion
    known = np.abs(along) > 5 * np.sqrt(np.maximum(spread, 0)) + 1e-9
    motion = axes @ np.where(known, along, 0.0)
    return np.asarray(motion)


def _meeting(points: Floats) -> Floats:
    """Where the beams of each row of points (r, c, 3) meet, (r, 1, 3): on the axis, near zero."""
    with warnings.catch_warnings(action="ignore"):
        far = np.hypot(points[..., 0], points[..., 1])
        up = points[..., 2]
        middle = np.nanmean(far, axis=1)
        off = far - np.nanmean(far, axis=1, keepdims=True)
        tangent = np.nansum(off * up, axis=1) / np.nansum(off**2, axis=1)
        height = np.nanmean(up, axis=1) - tangent * middle
    known = np.abs(height) < _HEAD_M  # also false of NaN
    return np.where(known, height, 0)[:, None, None] * np.array([0, 0, 1.0])


class Rays(NamedTuple):
    """Rays that meet smooth surfaces, (k,) each."""

    row: Ints
    column: Ints
    distance: Floats  # mean of the ranges, metres
    slope: Floats  # by how much the range changes with the direction, metres in a radian
    light: Floats  # mean intensity; NaN if unknown
    returns: Ints  # sweeps with a return
    trials: Ints  # sweeps that cover the ray
    variance: Floats  # of the range over the sweeps, square metres
    freedom: Ints  # returns of which it is, less one


def smooth_rays(
    repeats: Repeats, sigma: Floats, aim: float, expected: Floats | None = None
) -> Rays:
    """Choose rays without edges beside them, with the scatter of their ranges over the sweeps.

    Returns that noise of `sigma` (r, c) and directions that scatter by `aim` radians do not
    explain are left out, and rays with many of them. Slopes are those of a scene's ranges
    `expected` (r, c), if they are known.
    """
    middle = _median(repeats.ranges, 0)
    there = np.isfinite(repeats.ranges).sum(axis=0)
    blur = repeats.sigma / np.sqrt(np.maximum(there, 1))
    turn, slope, smooth, _ = surfaces(repeats, middle, blur)
    if expected is not None:
        slope = surfaces(repeats, expected, 0 * blur).slope
        smooth &= np.abs(middle - expected) < _BESIDE_M
    # A cell that is smooth by chance, as in leaves, has no smooth ones beside it.
    beside = np.sum([np.roll(smooth, by, axis=1) for by in (-2, -1, 1, 2)], axis=0)
    row, column = cell = np.nonzero(smooth & (beside >= 3))
    images = repeats.ranges, repeats.light, repeats.aside
    ranges, light, aside = (one[:, row, column].astype(np.float64) for one in images)
    ranges -= turn[cell] * aside
    slope = slope[cell]
    returns = there[cell]
    limit = np.where(returns > 1, _SIGMAS * np.hypot(sigma[cell], aim * slope), np.inf)
    kept = np.abs(ranges - middle[cell]) <= limit
    used = kept.sum(axis=0)
    count = np.maximum(used, 1)
    mean, bright = (np.where(kept, one, 0).sum(axis=0) / count for one in (ranges, light))
    variance = np.where(kept, (ranges - mean) ** 2, 0).sum(axis=0) / np.maximum(used - 1, 1)
    some = np.flatnonzero((used > 0) & (used >= _REPEATED * returns))
    trials = repeats.trials[cell]
    rays = row, column, mean, slope, bright, returns, trials, variance, used - 1
    return Rays._make(one[some] for one in rays)


def meet_frontally(rays: Rays) -> bool:
    """Whether enough rays meet surfaces so that noise of ranges is not taken for directions'."""
    frontal = (rays.slope < _FRONTAL * rays.distance).sum()
    return bool(frontal >= max(_FRONTAL_RAYS, _FRONTAL_SHARE * len(rays.row)))


def fit_performance(
    repeats: Repeats, rays: Rays, energy: Floats | None
) -> tuple[dict[str, Estimate], Floats]:
    """Estimate what repeated sweeps tell, with the energies of rays (k,) if they are known.

    Returns what is known by the names of `Noise`; and the standard deviations of rays (k,), metres,
    by range or by energy, whichever is likelier.
    """
    light = np.nan_to_num(rays.light) if energy is None else energy
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
        strong = energy > 2 * threshold.value  # what loses nothing by energy
        dropout = lost_share(rays, strong) or dropout
    figures, sigma, deviance = fit_scatter(rays, "range_per_m", rays.distance, 1)
    if energy is not None and threshold is not None:
        other = fit_scatter(rays, "range_at_threshold_m", threshold.value / energy, 2)
        if "range_at_threshold_m" in other[0] and other[2] < deviance:
            figures, sigma, _ = other
    if not meet_frontally(rays):
        figures = {}
    figures = {name: one for name, one in figures.items() if one.known_within(_KNOWN)}
    if threshold is not None:
        figures["detection_range_m"] = threshold.power(-0.5, 10 * np.sqrt(TARGET_REFLECTANCE))
    if alarms := alarm_share(repeats):
        figures["false_alarms"] = alarms
    if dropout is not None:
        figures["dropout"] = dropout
    return figures, sigma


def lost_share(rays: Rays, chosen: Bools) -> Estimate | None:
    """Estimate the share of pulses that chosen rays (k,) lose; None if these are too few.

    A ray is known only by its returns, which therefore tell no share. The other sweeps do: each
    return in turn is the one that makes the ray known.
    """
    chosen = chosen & (rays.trials > 1)
    if chosen.sum() < _FEW:
        return None
    returns = rays.returns[chosen]
    trials = rays.trials[chosen]
    return Estimate.share((trials - returns) * returns / (trials - 1), returns)


def fit_scatter(
    rays: Rays, growth: str, spread: Floats, power: int
) -> tuple[dict[str, Estimate], Floats, float]:
    """Fit noise of ranges and directions to the variances of rays, by their likelihood.

    Noise of ranges grows with a power of `spread` (k,). What rays do not tell, for want of spreads
    or inclined surfaces, is left out. Intervals are of sandwich estimators, for patches of rays
    that may be alike, and of errors of the model: edges, slopes, and growth. Returns figures, noise
    of ranges (k,) in metres, and the deviance.
    """
    low, unit, high = np.quantile(spread, (0.05, 0.5, 0.95))
    tilted = np.quantile(rays.slope / rays.distance, 0.9) > _TILT
    # Growth is fitted even where it is not told: it makes the interval of range_m as wide as it is.
    known = np.array([True, True, tilted])
    # Rays that lose some of their pulses are known by the nearer or brighter ones of these.
    repeated = (rays.freedom > 0) & (rays.returns >= _REPEATED * rays.trials)
    variance = rays.variance[repeated]
    slope = rays.slope[repeated]
    freedom = rays.freedom[repeated]
    steep = np.median(rays.slope)
    usual = max(float(np.median(variance)), 1e-12)

    def model(some: Floats, spread: Floats, slope: Floats) -> Floats:
        theta = np.zeros(3)
        theta[known] = some
        ranges = theta[0] + theta[1] * (spread / unit) ** power
        return np.asarray(usual * (ranges ** (2 / power) + theta[2] * (slope / steep) ** 2))

    def expected(some: Floats) -> Floats:
        return model(some, spread[repeated], slope)

    start = np.array([1.0, 0.1, 0.1])[known]
    wide = max(int(rays.column.max()) // _PATCHES, 1)  # columns of a patch
    patch = (rays.row // _PATCH_ROWS * (_PATCHES + 2) + rays.column // wide)[repeated]
    theta, covariance = _trimmed(expected, start, variance, freedom, _TRIMMED, patch)
    # Edges that are finer than the rays make the variances of some rays larger: what the figures
    # change if fewer of these are left out is an error of the model.
    others, _ = _trimmed(expected, theta, variance, freedom, _REJECTED, patch)
    spreads = np.diag(covariance) + (theta - others) ** 2
    # Nor are slopes exact: variances of steep rays, or far ones, may be wrong against the others.
    for quantity in (slope / rays.distance[repeated], spread[repeated]):
        wrong = _WRONG * np.where(quantity > np.median(quantity), 1.0, -1.0)
        biased, _ = _trimmed(expected, theta, variance * (1 + wrong), freedom, _TRIMMED, patch)
        spreads += (biased - theta) ** 2
    names = ("range_m", growth, "angle_deg")
    roots = (1 / power, 1 / power, 0.5)
    scales = np.sqrt(usual) / np.array([1, unit, np.radians(steep)])
    figures = {
        names[k]: Estimate.of(value, square).power(roots[k], scales[k])
        for k, value, square in zip(np.flatnonzero(known), theta, spreads, strict=True)
        if k != 1 or high > _SPAN * low
    }
    sizes = np.minimum(variance / expected(theta), _OUTLIER)
    deviance = freedom @ (np.log(expected(theta)) + sizes)
    return figures, np.sqrt(model(theta, spread, rays.slope)), float(deviance)


def _trimmed(
    expected: Callable[[Floats], Floats],
    start: Floats,
    variance: Floats,
    freedom: Ints,
    chance: float,
    patch: Ints,
) -> tuple[Floats, Floats]:
    """Fit a model to variances (k,), and estimate the covariance of its parameters.

    Variances above a quantile of their distribution, which they exceed with a `chance`, are left
    out, and the mean of the others is that of the truncated distribution.
    """
    from scipy.optimize import least_squares
    from scipy.stats import chi2

    limit = chi2.isf(chance, freedom)
    kept = np.ones(len(variance), bool)
    truncated = chi2.cdf(limit, freedom + 2) / (1 - chance)
    theta = start
    for step in range(12):
        if step:
            kept = freedom * variance / expected(theta) < limit
        scale = truncated if step else 1.0
        weight = np.sqrt(freedom / 2) / expected(theta)

        def off(
            some: Floats, kept: Bools = kept, weight: Floats = weight, scale: Any = scale
        ) -> Any:
            return ((variance - scale * expected(some)) * weight)[kept]

        solved = least_squares(off, theta, bounds=(0, np.inf), x_scale=np.maximum(theta, 0.01))
        theta = solved.x
    return theta, _sandwich(solved.jac, solved.fun, patch[kept])


def _sandwich(design: Floats, off: Floats, patch: Ints | None = None) -> Floats:
    """Estimate the covariance of a least-squares fit whose residuals are of unequal size.

    Residuals of one patch (k,), such as of a surface, may be alike.
    """
    inverse = np.linalg.pinv(design.T @ design, hermitian=True)
    score = design * off[:, None]
    if patch is not None:
        _, patch = np.unique(patch, return_inverse=True)
        sums = np.zeros((patch.max() + 1, score.shape[1]))
        np.add.at(sums, patch, score)
        score = sums * np.sqrt(len(sums) / max(len(sums) - 1, 1))
    covariance: Floats = inverse @ (score.T @ score) @ inverse
    return covariance


def fit_threshold(energy: Floats, count: Ints, trials: Ints, dropout: float) -> Estimate | None:
    """Energy of which half of the pulses return, by the curve of `Noise.detected`.

    A ray is there only if a pulse returned: the likelihood is that of a truncated binomial
    distribution. None if too few rays lose some of their pulses.
    """
    from scipy.optimize import brute
    from scipy.special import ndtr
    from scipy.stats import binom

    def seen(log_threshold: Any) -> Floats:
        share = ndtr(THRESHOLD_SIGMAS * (energy / np.exp(log_threshold) - 1))
        return np.clip((1 - dropout) * share, 1e-9, 1 - 1e-9)

    def unlikely(log_threshold: Any) -> Floats:
        p: Floats = seen(log_threshold)
        return np.log1p(-((1 - p) ** trials)) - binom.logpmf(count, trials, p)

    low, high = np.log(np.quantile(energy, (0.001, 0.999)))
    (found,) = brute(lambda one: unlikely(one).sum(), [(low - 2, high)], Ns=60)
    if (seen(found) < 0.9 * (1 - dropout)).sum() < _WEAK_RAYS:
        return None
    before, at, after = (unlikely(found + by) for by in (-_STEP, 0, _STEP))
    information = (after - 2 * at + before).sum() / _STEP**2
    score = (((after - before) / (2 * _STEP)) ** 2).sum()
    return Estimate(*np.exp(Estimate.of(found, score / information**2)).tolist())


def alarm_share(repeats: Repeats) -> Estimate | None:
    """Share of pulses into the sky that return; None with little sky, or with two sweeps.

    A pulse is one into the sky if no other of its ray returns, and no ray beside it repeats, of
    three pulses or more.
    """
    from scipy.ndimage import maximum_filter
    from scipy.stats import binomtest

    count = np.isfinite(repeats.ranges).sum(axis=0)
    # Weak surfaces, which return seldom, are beside those that return more often.
    size = _SKY_RINGS, round(_SKY_DEG / 360 * count.shape[1])
    repeated = maximum_filter(count, size=size, mode=("nearest", "wrap")) > 1
    sky = ~repeated & (repeats.trials > 2)
    alarms = int((count[sky] == 1).sum())
    trials = int(repeats.trials[sky & (count == 0)].sum()) + alarms
    if trials < _SKY_PULSES:
        return None
    return Estimate(alarms / trials, *map(float, binomtest(alarms, trials).proportion_ci()))


def ring_bias(rays: Rays, directions: Floats, blur: Floats) -> dict[int, Estimate]:
    """Estimate by how much the ranges of rows differ from the mean of all: {row: metres}.

    Large planes u · x = 1 and offsets b of the rows are fitted at once: 1 / r = u · d − b / r²,
    times r². Ranges have standard deviations `blur` (k,), metres. A row that lies in a single plane
    has no offset. Intervals hold noise and errors of the planes, which are not quite plane: by what
    offsets change without the farther points, and without each plane (jackknife; Efron, 1982).
    """
    if not len(rays.row):
        return {}
    some = even_indices(len(rays.row), _PLANE_POINTS)
    plane = _planes(rays.distance[some, None] * directions[some])
    count = np.zeros((rays.row.max() + 1, plane.max() + 2), np.int64)
    np.add.at(count, (rays.row[some], plane), 1)  # the last column is of points in no plane
    crossing = (count[:, :-1] >= _RING_RAYS).sum(axis=1) > 1
    chosen = (plane >= 0) & crossing[rays.row[some]]
    some = some[chosen]
    plane = plane[chosen]
    rows, place = np.unique(rays.row[some], return_inverse=True)
    if len(rows) < 3:
        return {}
    _, plane = np.unique(plane, return_inverse=True)
    planes = plane.max() + 1
    distance = rays.distance[some] / blur[some]
    normals = np.eye(planes)[plane][:, :, None] * directions[some][:, None]
    normals = normals.reshape(len(some), -1) * rays.distance[some, None] ** 2
    design = np.hstack([normals, -np.eye(len(rows))[place]]) / blur[some, None]
    # One offset of all is nearly the same as other planes: the mean of the rows is 0.
    centred = np.eye(len(rows)) - 1 / len(rows)
    solution, kept = _without_outliers(design, distance, _FAR_SIGMAS)
    offsets = centred @ solution[3 * planes :]
    nearer, _ = _without_outliers(design, distance, _NEAR_SIGMAS)
    used = design[kept]
    covariance = _sandwich(used, distance[kept] - used @ solution)[3 * planes :, 3 * planes :]
    moved = centred @ nearer[3 * planes :] - offsets
    replicates = [
        centred @ np.linalg.lstsq(design[rest], distance[rest], rcond=None)[0][3 * planes :]
        for rest in (kept & (plane != number) for number in range(planes))
    ]
    spread = np.diag(centred @ covariance @ centred) + moved**2
    spread += (planes - 1) * np.var(replicates, axis=0)
    estimates = zip(rows.tolist(), offsets, spread, strict=True)
    return {row: Estimate.of(*estimate) for row, *estimate in estimates}


def _without_outliers(design: Floats, values: Floats, sigmas: float) -> tuple[Floats, Bools]:
    """Solve least squares without residuals beyond some standard deviations.

    Returns the solution, and which equations (k,) are used.
    """
    off = np.zeros(len(values))
    for _ in range(4):
        kept = np.abs(off) <= sigmas * 1.4826 * np.median(np.abs(off))
        solution = np.linalg.lstsq(design[kept], values[kept], rcond=None)[0]
        off = values - design @ solution
    return solution, kept


def _planes(points: Floats) -> Ints:
    """Tell the number of the large plane that each point (n, 3) lies in; -1 for none."""
    o3d = load_open3d()
    o3d.utility.random.seed(0)
    number = np.full(len(points), -1)
    left = np.arange(len(points))
    for _ in range(_PLANES):
        if len(left) < _PLANE_RAYS:
            break
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points[left]))
        (*normal, above), _ = cloud.segment_plane(_PLANE_M, 3, 400)
        off = np.abs(points[left] @ normal + above)  # from the plane of all inliers
        inside = np.flatnonzero(off < _PLANE_M)
        ways = points[left[inside]] / np.linalg.norm(points[left[inside]], axis=1)[:, None]
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(ways))
        # Walls in a line are not quite one plane: the largest piece is.
        piece = np.asarray(cloud.cluster_dbscan(_GAP, 3))
        inside = inside[piece == np.bincount(piece + 1)[1:].argmax()]
        # What fills the slab evenly is cut out of other surfaces.
        if len(inside) >= _PLANE_RAYS and np.median(off[inside]) < _EVEN * _PLANE_M:
            number[left[inside]] = number.max() + 1
        left = np.delete(left, inside)
    return number


def _channels(
    repeats: Repeats, rays: Rays, own: Floats, sigma: Floats, expected: Floats | None
) -> list[dict[str, Any]]:
    """Noise, bias and spread of azimuths of each ring."""
    flat = Rays._make(one[rays.slope < _FLAT * rays.distance] for one in rays)
    cell = flat.row, flat.column
    if expected is not None:
        off = flat.distance - expected[cell]
        bias = {row: Estimate.mean(off[flat.row == row]) for row in set(flat.row.tolist())}
    else:
        blur = sigma[cell] / np.sqrt(flat.returns) + _LEAST_M
        bias = ring_bias(flat, repeats.directions[cell], blur)
    uneven = np.degrees(np.diff(repeats.aside, axis=2)) ** 2 / 2
    return [
        {
            "ring": int(ring),
            "elevation_deg": float(repeats.elevation_deg[row]),
            "rays": int(np.isfinite(own[rays.row == row]).sum()),
            "noise_m": _noise(own[rays.row == row]),
            "bias_m": bias[row]._asdict() if row in bias else None,
            "uneven_deg": _noise(uneven[:, row]) if len(uneven) > 1 else None,
        }
        for row, ring in enumerate(repeats.rings)
    ]


def _noise(variances: Floats) -> dict[str, float] | None:
    """Root of the mean of the variances that are known, if they are enough."""
    known = variances[np.isfinite(variances)]
    return Estimate.mean(known).power(0.5)._asdict() if len(known) >= _FEW else None


def _curve(x: Floats, values: Floats, power: float = 1.0) -> list[dict[str, float]]:
    """Means of values (k,), or their roots, in parts of x of the same size."""
    known = np.flatnonzero(np.isfinite(values) & np.isfinite(x))
    order = known[np.argsort(x[known], kind="stable")]
    parts = np.array_split(order, min(_POINTS, len(order) // _FEW) or 1)
    return [
        {"x": float(np.median(x[part]))} | Estimate.mean(values[part]).power(power)._asdict()
        for part in parts
        if len(part) >= _FEW
    ]


def _drawn(figures: Mapping[str, Any]) -> Page:
    """Draw the curves and rings, with their intervals."""
    rows = figures["channels"]
    curves = dict(figures["curves"])
    for name in ("noise_m", "bias_m", "uneven_deg"):
        curves[name] = [{"x": one["elevation_deg"], **one[name]} for one in rows if one[name]]
    shown = [name for name in _CHARTS if curves.get(name)]
    tall = 140 + 500 * -(-len(shown) // 3)  # pixels
    page = Page((1600, tall))
    page.title(figures["model"], f"fitted to {figures['name']}; bars are intervals of 95 %")
    for number, name in enumerate(shown):
        (row, column), points, (x, y, unit) = divmod(number, 3), curves[name], _CHARTS[name]
        at, *values = (np.array([one[key] for one in points]) for key in ("x", *Estimate._fields))
        value, low, high = (unit * one for one in values)
        axes = page.chart((0.075 + 0.32 * column, 1 - (530 + 500 * row) / tall, 0.235, 360 / tall))
        axes.set(xlabel=x, ylabel=y)
        if name.endswith("light") and at[0] > 0:
            axes.set_xscale("log")
            label_logarithms(axes.xaxis, at[-1] < 1000 * at[0])
        if share := y.endswith("%"):
            low, high = np.clip((low, high), 0, 100)
        axes.vlines(at, low, high, color=theme.UNSEEN, lw=1.8 * page.unit)
        axes.plot(at, value, "o", color=theme.OBJECT_COLOURS[0], ms=3.2 * page.unit, mew=0)
        if share:
            axes.set_ylim(*np.clip(axes.get_ylim(), -1, 101))
    return page
