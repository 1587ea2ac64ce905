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
from .estimates import Estimate, channel_bias, fit_performance
from .recordings import Recording, open_recording
from .repeats import Rays, Repeats, smooth_rays, surroundings

# {curve, or column of channels: (title, label of x, label of y, factor)}
_CHARTS = {
    "noise_by_range": ("Noise of ranges", "range, m", "noise, mm", 1000),
    "noise_by_light": ("", "intensity, or energy", "noise, mm", 1000),
    "noise_by_tilt": ("", "incidence, °", "noise with that of directions, mm", 1000),
    "returned_by_light": ("Returns", "intensity, or energy", "pulses that return, %", 100),
    "lost_by_range": ("", "range of the scene, m", "pulses lost, %", 100),
    "light_by_range": ("", "range, m", "mean intensity", 1),
    "noise_m": ("Rings", "elevation, °", "noise, mm", 1000),
    "bias_m": ("", "elevation, °", "bias, mm", 1000),
    "uneven_deg": ("", "elevation, °", "spread of azimuths, °", 1),
}
_FEW = 30  # rays that a figure or a point of a curve needs
_POINTS = 14  # of a curve
_AIM = 0.002  # scatter of directions that does not make outliers before it is known, radians
_LEAST_M = 0.001  # error of the mean range of a ray, however often it is measured
_FLAT = 1.7  # tangent of incidence: beyond, noise of directions makes mean ranges longer
_BESIDE_M = 0.3  # how far a recorded surface may be from the scene's
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
    whole = Repeats.read(recording)
    repeats = whole.first() if whole.moves else whole
    middle, sigma, count = repeats.middle(), repeats.rough_sigma(), len(repeats.ranges)
    there = np.isfinite(repeats.ranges).sum(axis=0)
    around = surroundings(repeats, middle, sigma / np.sqrt(np.maximum(there, 1)))
    curves, expected = {}, None
    if scene is not None:
        expected = _cast(repeats, scene if isinstance(scene, Scene) else Scene.load(scene), pose)
        known = surroundings(repeats, expected, 0 * sigma)
        near = around.smooth & (np.abs(middle - expected) < _BESIDE_M)
        around = around._replace(slope=known.slope, smooth=near)
        curves["lost_by_range"] = _curve(expected[known.smooth], 1 - there[known.smooth] / count)
    estimates, aim = dict[str, Estimate | None](), 0.0
    for _ in range(2):  # the first finds what the second leaves out
        rays = smooth_rays(repeats, around, sigma, 0.0 if estimates else _AIM)
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
            estimates, scatter = fit_performance(repeats, rays, energy)
            sigma[rays.row, rays.column] = scatter.sigma
            aim = scatter.aim.value if scatter.aim else 0.0
    own = np.where(rays.freedom > 0, rays.variance - (aim * rays.slope) ** 2, np.nan)
    light = rays.light if energy is None else energy
    tilt = np.degrees(np.arctan(rays.slope / rays.distance))
    curves["noise_by_range"] = _curve(rays.distance, own, 0.5)
    curves["noise_by_light"] = _curve(light, own, 0.5)
    curves["noise_by_tilt"] = _curve(tilt, own + (aim * rays.slope) ** 2, 0.5)
    curves["returned_by_light"] = _curve(light, rays.returns / count)
    curves["light_by_range"] = _curve(rays.distance, rays.light)
    found = {key: one for key, one in estimates.items() if one}
    base, name = read_model(model) if model else _recorded(repeats), Path(recording.name).name
    figures = {
        "versions": {"lidarpool": __version__}, "name": name, "model": base.name,
        "sweeps": len(whole.ranges), "moves": whole.moves, "rays": len(rays.row),
        "figures": {key: one._asdict() for key, one in found.items()}, "notes": whole.notes,
        "channels": _channels(repeats, rays, own, sigma, expected), "curves": curves,
    }  # fmt: skip
    source = f"fitted by lidarpool {__version__} to {name}, {plural(len(whole.ranges), 'sweep')}"
    return Fit(figures, _with(base, found, source) if found else base)


def _with(base: SensorModel, known: Mapping[str, Estimate], source: str) -> SensorModel:
    """Return a sensor with what was fitted in its performance; the rest stays."""
    found = {name: round(float(f"{one.value:.4g}"), 9) for name, one in known.items()}
    stated = base.performance.model_dump(exclude_defaults=True) if base.performance else {}
    for name in ("precision", "range_m", "range_per_m"):  # one excludes the others
        stated.pop(name, None)
    far = found.get("detection_range_m", 0.0)
    if far:
        stated["detection"] = {"range_m": far, "reflectance": 0.1, "probability": 0.5}
    if weak := found.get("range_at_threshold_m"):
        sigma = {part: float(np.hypot(found["range_m"], weak * part**2)) for part in (0.5, 1)}
        stated["precision"] = [
            {"sigma_m": one, "range_m": part * far, "reflectance": 0.1}
            for part, one in sigma.items()
        ]
    else:
        stated |= {"range_m": found["range_m"], "range_per_m": found.get("range_per_m", 0.0)}
    for name, needed in (("angle_deg", True), ("false_alarms", "detection" in stated)):
        if needed and name in known and known[name].low > 0:
            stated[name] = found[name]
    data = base.model_dump() | {"performance": stated}
    return SensorModel.model_validate(data | {"sources": {**base.sources, "performance": source}})


def _recorded(repeats: Repeats) -> SensorModel:
    """Return a sensor with the beams of a recording."""
    return SensorModel(
        name="Recorded sensor",
        sources={"angles": "medians of the recorded points"},
        firings_per_turn=repeats.azimuth.shape[1],
        range_m=(0.0, float(np.ceil(1.1 * np.nanmax(repeats.ranges)))),
        beams={"elevation_deg": np.degrees(np.sort(repeats.elevation)).round(3).tolist()},
    )


def _cast(repeats: Repeats, scene: Scene, pose: Pose | Sequence[float]) -> Floats:
    """Ranges of a scene in the cells, (r, c); NaN where it has nothing."""
    ways = repeats.directions().reshape(-1, 3)
    sensor = ListedSensor(head=Spin(len(ways), 360), rays=ways, shot_ns=np.zeros(len(ways)))
    hits = Scanner(scene, sensor, columns=("ray", "range")).sweep(pose, number=0)
    found = np.full(len(ways), np.nan)
    found[hits["ray"]] = hits["range"]
    return found.reshape(repeats.azimuth.shape)


def _channels(
    repeats: Repeats, rays: Rays, own: Floats, sigma: Floats, expected: Floats | None
) -> list[dict[str, Any]]:
    """Noise, bias and spread of azimuths of each ring."""
    flat = rays.take(rays.slope < _FLAT * rays.distance)
    cell, elevations = (flat.row, flat.column), np.degrees(repeats.elevation)
    if expected is not None:
        off = flat.distance - expected[cell]
        bias = {row: Estimate.mean(off[flat.row == row]) for row in set(flat.row.tolist())}
    else:
        blur = sigma[cell] / np.sqrt(flat.returns) + _LEAST_M
        bias = channel_bias(flat, repeats.directions()[cell], blur)
    rows = []
    for row, ring in enumerate(repeats.rings.tolist()):
        noise = own[(rays.row == row) & np.isfinite(own)]
        steps = np.degrees(np.diff(repeats.aside[:, row], axis=1) / np.sqrt(2))
        uneven = np.square(steps[np.isfinite(steps)])
        found = {
            "noise_m": Estimate.mean(noise, 0.5) if len(noise) >= _FEW else None,
            "bias_m": bias.get(row),
            "uneven_deg": Estimate.mean(uneven, 0.5) if len(uneven) >= _FEW else None,
        }
        shown = {name: one and one._asdict() for name, one in found.items()}
        rows.append(
            {"ring": ring, "elevation_deg": float(elevations[row]), "rays": len(noise)} | shown
        )
    return rows


def _curve(x: Floats, values: Floats, power: float = 1.0) -> list[dict[str, float]]:
    """Means of values (k,), or their roots, in parts of x that have about as many each."""
    known = np.isfinite(values) & np.isfinite(x)
    x, values = x[known], values[known]
    if not len(x):
        return []
    place = np.digitize(x, np.unique(np.quantile(x, np.linspace(0, 1, _POINTS + 1)[1:-1])))
    parts = [place == k for k in range(place.max() + 1) if (place == k).sum() >= _FEW]
    return [
        {"x": float(np.median(x[part]))} | Estimate.mean(values[part], power)._asdict()
        for part in parts
    ]


def _drawn(figures: Mapping[str, Any]) -> Page:
    """Draw the curves and rings, with their intervals."""
    page = Page((1600, 1750))
    page.title(figures["model"], f"fitted to {figures['name']}; bars are intervals of 95 %")
    for number, (name, (title, x, y, unit)) in enumerate(_CHARTS.items()):
        row, column = divmod(number, 3)
        axes = page.chart((0.075 + 0.32 * column, 0.67 - 0.305 * row, 0.235, 0.205))
        axes.set(xlabel=x, ylabel=y)
        points = figures["curves"].get(name, [])
        if row == 2:
            rings = (one for one in figures["channels"] if one[name])
            points = [{"x": one["elevation_deg"], **one[name]} for one in rings]
        at, *values = (np.array([one[key] for one in points]) for key in ("x", *Estimate._fields))
        value, low, high = (unit * one for one in values)
        axes.vlines(at, low, high, color=theme.UNSEEN, lw=1.8 * page.unit)
        axes.plot(at, value, "o", color=theme.OBJECT_COLOURS[0], ms=3.2 * page.unit, mew=0)
        page.heading(axes, title if points else f"{title}  not known".strip(), fontweight="bold")
        if points and name.endswith("light") and at[0] > 0:
            axes.set_xscale("log")
    return page
