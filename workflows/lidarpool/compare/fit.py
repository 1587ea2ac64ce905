"""Fits a sensor's performance to a recording of a unit: a sensor file, and a page about it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml
from pydantic import Field

from .._version import __version__
from ..base.arrays import Floats
from ..base.errors import LidarpoolError, explained
from ..base.storage import Storage
from ..base.validation import checked
from ..base.words import plural
from ..columns.cloud import Cloud
from ..columns.parts import StoredCloud
from ..render import theme
from ..render.picture_page import Page
from ..report.page.rendering import rendered
from ..scene.scene import Scene
from ..sensor import Pose, Spin
from ..sensor.models import SensorModel, read_model
from ..sensor.ray_sensors import ListedSensor
from ..simulator import Scanner
from .estimates import Estimate, Rays, Repeats, fit_performance, ring_bias, smooth_rays, surfaces
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
    "uneven_deg": ("elevation, °", "spread of azimuths, °", 1),
}
_FEW = 30  # rays that a figure or a point of a curve needs
_POINTS = 14  # of a curve
_AIM = 0.002  # scatter of directions that does not make outliers before it is known, radians
_LEAST_M = 0.001  # error of the mean range of a ray, however often it is measured
_FLAT = 1.7  # tangent of incidence: beyond, noise of directions makes mean ranges longer
_DARKEST = 1 / 400  # reflectance of what is reported as 0


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

        LidarpoolError if the file is no .yaml, or cannot be written.
        """
        place = Path(file)
        if place.suffix not in (".yaml", ".yml"):
            raise LidarpoolError(f"{place} is no sensor file: give a name such as mine.yaml.")
        told = self.model.model_dump(mode="json", exclude_defaults=True)
        text = "".join(f"# {line}\n" for line in repr(self).splitlines())
        text += yaml.safe_dump(told, sort_keys=False, allow_unicode=True, default_flow_style=None)
        picture = {"fit": _drawn(self.figures).svg()}
        page = rendered("fit.html", report=self.figures, pictures=picture)
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
    sensor
        Of a recording of several: name of the sensor, or topic of a bag.
    intensity
        Column of the intensity, if not ``intensity``.
    white
        Intensity of a white surface, if it is the same at all ranges; known of Velodyne and Ouster.

    Raises
    ------
    LidarpoolError
        If it cannot be read, has no sweeps or rings, is of several sensors, or scipy is missing.
    """
    if find_spec("scipy") is None:
        raise LidarpoolError('Figures are fitted by scipy: pip install "lidarpool[fit]".')
    if not isinstance(recording, Recording):
        recording = open_recording(recording, sensor, intensity, name="the recording")
    repeats = Repeats.read(recording)
    sigma, count, curves, expected = repeats.sigma.copy(), len(repeats.ranges), {}, None
    if scene is not None:
        expected = _cast(repeats, scene if isinstance(scene, Scene) else Scene.load(scene), pose)
        *_, known = surfaces(repeats, expected, 0 * sigma)
        lost = np.isnan(repeats.ranges).mean(axis=0)
        curves["lost_by_range"] = _curve(expected[known], lost[known])
    found = dict[str, Estimate]()
    for _ in range(2):  # the first finds what the second leaves out
        rays = smooth_rays(repeats, sigma, 0.0 if found else _AIM, expected)
        if len(rays.row) < _FEW:
            raise LidarpoolError(
                f"{recording.name} has {len(rays.row)} rays on smooth surfaces, not {_FEW}: "
                "record a place with walls or a floor."
            )
        energy = rays.light if recording.energies else None
        if white := white or recording.white:
            energy = np.maximum(rays.light / white, _DARKEST) * (10 / rays.distance) ** 2
        if energy is not None and not np.isfinite(energy).all():
            energy = None
        if count > 1:
            found, sigma[rays.row, rays.column] = fit_performance(repeats, rays, energy)
    aim = np.radians(found["angle_deg"].value) if "angle_deg" in found else 0.0
    tilted = np.where(rays.freedom > 0, rays.variance, np.nan)
    own, light = tilted - (aim * rays.slope) ** 2, rays.light if energy is None else energy
    curves["noise_by_range"] = _curve(rays.distance, own, 0.5)
    curves["noise_by_light"] = _curve(light, own, 0.5)
    tilt = np.degrees(np.arctan(rays.slope / rays.distance))
    curves["noise_by_tilt"] = _curve(tilt, tilted, 0.5)
    curves["returned_by_light"] = _curve(light, rays.returns / count)
    curves["light_by_range"] = _curve(rays.distance, rays.light)
    base, name = read_model(model) if model else _recorded(repeats), Path(recording.name).name
    figures = {
        "versions": {"lidarpool": __version__}, "name": name, "model": base.name,
        "sweeps": repeats.sweeps, "moves": repeats.moves, "rays": len(rays.row),
        "figures": {key: one._asdict() for key, one in found.items()}, "notes": repeats.notes,
        "channels": _channels(repeats, rays, own, sigma, expected), "curves": curves,
    }  # fmt: skip
    source = f"fitted by lidarpool {__version__} to {name}, {plural(repeats.sweeps, 'sweep')}"
    return Fit(figures, _with(base, found, source) if found else base)


def _with(base: SensorModel, known: Mapping[str, Estimate], source: str) -> SensorModel:
    """Return a sensor with what was fitted in its performance; the rest stays."""
    found = {name: round(float(f"{one.value:.4g}"), 9) for name, one in known.items()}
    fitted = {"precision", "range_m", "range_per_m"}  # one excludes the others
    old = base.performance
    stated = old.model_dump(exclude_defaults=True, exclude=fitted) if old else {}
    far, weak = (found.get(name, 0.0) for name in ("detection_range_m", "range_at_threshold_m"))
    if far:
        stated["detection"] = {"range_m": far, "reflectance": 0.1, "probability": 0.5}
    if weak:
        stated["precision"] = [
            {"sigma_m": float(sigma), "range_m": share * far, "reflectance": 0.1}
            for share, sigma in ((k, np.hypot(found["range_m"], weak * k**2)) for k in (0.5, 1))
        ]
    else:
        stated |= {name: found[name] for name in ("range_m", "range_per_m") if name in found}
    for name in ("angle_deg", *["false_alarms"] * ("detection" in stated)):
        if name in known and known[name].low > 0:
            stated[name] = found[name]
    sources = {**base.sources, "performance": source}
    return SensorModel.model_validate(
        base.model_dump() | {"performance": stated, "sources": sources}
    )


def _recorded(repeats: Repeats) -> SensorModel:
    """Return a sensor with the beams of a recording."""
    return SensorModel(
        name="Recorded sensor",
        sources={"angles": "medians of the recorded points"},
        firings_per_turn=repeats.ranges.shape[2],
        range_m=(0.0, float(np.ceil(1.1 * np.nanmax(repeats.ranges)))),
        beams={"elevation_deg": np.sort(repeats.elevation_deg).round(3).tolist()},
    )


def _cast(repeats: Repeats, scene: Scene, pose: Pose | Sequence[float]) -> Floats:
    """Ranges of a scene in the cells, (r, c); NaN where it has nothing."""
    ways = repeats.directions.reshape(-1, 3)
    sensor = ListedSensor(head=Spin(len(ways), 360), rays=ways, shot_ns=np.zeros(len(ways)))
    hits = Scanner(scene, sensor, columns=("ray", "range")).sweep(pose, number=0)
    found = np.full(len(ways), np.nan)
    found[hits["ray"]] = hits["range"]
    return found.reshape(repeats.sigma.shape)


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
            "uneven_deg": _noise(uneven[:, row]),
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
    page = Page((1600, 1750))
    page.title(figures["model"], f"fitted to {figures['name']}; bars are intervals of 95 %")
    for number, (name, (x, y, unit)) in enumerate(_CHARTS.items()):
        row, column = divmod(number, 3)
        axes = page.chart((0.075 + 0.32 * column, 0.67 - 0.305 * row, 0.235, 0.205))
        axes.set(xlabel=x, ylabel=y)
        points = figures["curves"].get(name) or [
            {"x": one["elevation_deg"], **one[name]} for one in figures["channels"] if one.get(name)
        ]
        page.heading(axes, "" if points else "not known")
        at, *values = (np.array([one[key] for one in points]) for key in ("x", *Estimate._fields))
        value, low, high = (unit * one for one in values)
        axes.vlines(at, low, high, color=theme.UNSEEN, lw=1.8 * page.unit)
        axes.plot(at, value, "o", color=theme.OBJECT_COLOURS[0], ms=3.2 * page.unit, mew=0)
        if points and name.endswith("light") and at[0] > 0:
            axes.set_xscale("log")
    return page
