"""Fits a sensor's performance to a recording of a unit: a sensor file, and a page about it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
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
from ..report.page.rendering import rendered
from ..scene.scene import Scene
from ..sensor import Pose, Spin
from ..sensor.models import SensorModel, read_model
from ..sensor.ray_sensors import ListedSensor
from ..simulator import Scanner
from .estimates import Estimate, channel_bias, fit_performance, root
from .fit_picture import draw_fit
from .recordings import Recording, open_recording
from .repeats import Rays, Repeats, Surroundings

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
        picture = {"fit": draw_fit(self.figures).svg()}
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
    middle, sigma = repeats.middle(), repeats.rough_sigma()
    there = np.isfinite(repeats.ranges).sum(axis=0)
    around = Surroundings.of(repeats, middle, sigma / np.sqrt(np.maximum(there, 1)))
    curves, expected = {}, None
    if scene is not None:
        expected = _cast(repeats, scene if isinstance(scene, Scene) else Scene.load(scene), pose)
        known = Surroundings.of(repeats, expected, 0 * sigma)
        near = around.smooth & (np.abs(middle - expected) < _BESIDE_M)
        around = Surroundings(middle, around.turn, known.slope, near)
        lost = 1 - there[known.smooth] / repeats.sweeps
        curves["lost_by_range"] = _curve(expected[known.smooth], lost)
    estimates, unknown, aim = dict[str, Estimate](), list[str](), 0.0
    for _ in range(2):  # the first finds what the second leaves out
        rays = Rays.of(repeats, around, sigma, 0.0 if estimates else _AIM)
        if len(rays) < _FEW:
            raise LidarpoolError(
                f"{recording.name} has {len(rays)} rays on smooth surfaces, and {_FEW} are needed: "
                "record a place with walls or a floor."
            )
        energy = _energies(rays, recording, white or recording.white)
        if repeats.sweeps > 1:
            estimates, unknown, scatter = fit_performance(repeats, rays, energy)
            sigma[rays.row, rays.column] = scatter.sigma
            aim = scatter.aim.value if scatter.aim else 0.0
    if repeats.sweeps < 2:
        why = "the sensor moves, or most around it" if whole.moves else "there is a single sweep"
        unknown = [f"noise, lost returns and false alarms: {why}"]
    own = np.where(rays.freedom > 0, rays.variance - (aim * rays.slope) ** 2, np.nan)
    light = rays.light if energy is None else energy
    tilt = np.degrees(np.arctan(rays.slope / rays.distance))
    curves["noise_by_range"] = _curve(rays.distance, own, root)
    curves["noise_by_light"] = _curve(light, own, root)
    curves["noise_by_tilt"] = _curve(tilt, own + (aim * rays.slope) ** 2, root)
    curves["returned_by_light"] = _curve(light, rays.count / repeats.sweeps)
    curves["light_by_range"] = _curve(rays.distance, rays.light)
    base = _recorded(repeats) if model is None else read_model(model)
    name, sweeps = Path(recording.name).name, plural(whole.sweeps, "sweep")
    if estimates:
        base = _with(base, estimates, f"fitted by lidarpool {__version__} to {name}, {sweeps}")
    figures = {
        "versions": {"lidarpool": __version__}, "name": name, "model": base.name,
        "sweeps": whole.sweeps, "rays": len(rays), "by_energy": energy is not None,
        "figures": {key: one._asdict() for key, one in estimates.items()}, "unknown": unknown,
        "channels": _channels(repeats, rays, own, sigma, expected), "curves": curves,
        "notes": whole.notes,
    }  # fmt: skip
    return Fit(figures, base)


def _energies(rays: Rays, recording: Recording, white: float | None) -> Floats | None:
    """Energies of the returns of rays, (k,); None if unknown."""
    if not np.isfinite(rays.light).all() or (white is None and not recording.energies):
        return None
    if recording.energies:
        return rays.light
    return np.maximum(rays.light / white, _DARKEST) * (10 / rays.distance) ** 2


def _with(base: SensorModel, known: Mapping[str, Estimate], source: str) -> SensorModel:
    """Return a sensor with what was fitted in its performance; the rest stays."""
    found = {name: float(f"{one.value:.4g}") for name, one in known.items()}
    stated = base.performance.model_dump(exclude_defaults=True) if base.performance else {}
    for name in ("precision", "range_m", "range_per_m"):  # one excludes the others
        stated.pop(name, None)
    if "detection_range_m" in found:
        far = found["detection_range_m"]
        stated["detection"] = {"range_m": far, "reflectance": 0.1, "probability": 0.5}
    if "range_at_threshold_m" in found:
        stated["precision"] = [
            {"sigma_m": float(np.hypot(found["range_m"], found["range_at_threshold_m"] * x * x)),
             "range_m": x * far, "reflectance": 0.1} for x in (0.5, 1.0)
        ]  # fmt: skip
    names = {"range_m", "range_per_m"} if "precision" not in stated else set()
    names |= {"angle_deg"}
    if "detection" in stated and "false_alarms" in known and known["false_alarms"].low > 0:
        names |= {"false_alarms"}
    stated |= {name: found[name] for name in sorted(names & found.keys())}
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
    cell = flat.row, flat.column
    if expected is not None:
        off = flat.distance - expected[cell]
        bias = {row: Estimate.mean(off[flat.row == row]) for row in set(flat.row.tolist())}
    else:
        blur = sigma[cell] / np.sqrt(flat.count) + _LEAST_M
        bias = channel_bias(flat, repeats.directions()[cell], blur)
    rows = []
    for row, ring in enumerate(repeats.rings.tolist()):
        noise = own[(rays.row == row) & np.isfinite(own)]
        steps = np.diff(repeats.aside[:, row], axis=1) / np.sqrt(2)
        rows.append({
            "ring": ring, "elevation_deg": float(np.degrees(repeats.elevation[row])),
            "rays": len(noise),
            "noise_m": Estimate.mean(noise).mapped(root)._asdict() if len(noise) >= _FEW else None,
            "bias_m": bias[row]._asdict() if row in bias else None,
            "uneven_deg": float(np.degrees(np.nan_to_num(steps).std())),
        })  # fmt: skip
    return rows


def _curve(
    x: Floats, values: Floats, function: Callable[[float], float] = float
) -> list[dict[str, float]]:
    """Functions of the means of values (k,) in parts of x that have about as many each."""
    known = np.isfinite(values) & np.isfinite(x)
    x, values = x[known], values[known]
    if not len(x):
        return []
    place = np.digitize(x, np.unique(np.quantile(x, np.linspace(0, 1, _POINTS + 1)[1:-1])))
    parts = [place == k for k in range(place.max() + 1) if (place == k).sum() >= _FEW]
    means = [Estimate.mean(values[part]).mapped(function)._asdict() for part in parts]
    return [{"x": float(np.median(x[part])), **one} for part, one in zip(parts, means, strict=True)]
