"""Fit a sensor's performance parameters to a recording, and save a sensor file and a report.

Confidence intervals have a level of 95 %. The axes of arrays are described in `stack`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from lidarfiles.clouds.recording import PointCloud, Recording
from lidarfiles.parts.parts import StoredCloud
from lidarfiles.recordings.opening import as_recording, with_sweeps
from lidarfiles.work.publishing import publishing
from lidarsim._version import __version__
from lidarsim.columns.cloud import Cloud
from lidarsim.errors import LidarError, explain_os_errors
from lidarsim.motion.trajectory import Pose
from lidarsim.scene.scene import Scene
from lidarsim.schema.checks import check_number
from lidarsim.sensor.models import MODEL_FILES, Performance, SensorModel, read_model
from lidarsim.words import plural
from lidarview.page_templates import render_template

from .estimates import Estimate
from .known_poses import KnownPoses
from .measured import SensorMeasurement, measure_moving, measure_standing
from .performance import has_frontal_rays
from .stack import SweepStack, check_sweeps
from .standstill import moving_message

_RANGE_NOISE_FIELDS = ("range_m", "range_per_m", "range_at_threshold_m")


@dataclass(frozen=True, eq=False, repr=False)
class Fit:
    """Result of `fit`, whose text representation is a table."""

    figures: dict[str, Any]  # numbers and texts of the page; lengths in meters
    model: SensorModel  # the sensor with the fitted performance

    def __repr__(self) -> str:
        return render_template("fit.txt", __name__, report=self.figures).rstrip("\n")

    def save(self, file: str | Path) -> list[Path]:
        """Write the sensor file and an HTML report next to it, and return both paths.

        Raises
        ------
        LidarError
            If the file is not a .yaml file, or if it cannot be written.
        """
        model_path = Path(file)
        if model_path.suffix not in MODEL_FILES:
            raise LidarError(
                f"{model_path} is not a sensor file. Use a file name with the extension .yaml, "
                "such as mine.yaml."
            )
        from .charts import draw_charts  # imports Matplotlib

        model = self.model.model_dump(mode="json", exclude_defaults=True)
        text = "".join(f"# {line}\n" for line in repr(self).splitlines())
        text += yaml.safe_dump(model, sort_keys=False, allow_unicode=True, default_flow_style=None)
        pictures = {"fit": draw_charts(self.figures).svg()}
        page = render_template("fit.html", __name__, report=self.figures, pictures=pictures)
        page_path = model_path.with_suffix(".html")
        advice = "choose an existing folder with enough free space"
        with (
            explain_os_errors(f"{model_path} cannot be written", advice),
            publishing(model_path) as staged,
        ):
            (staged / model_path.name).write_bytes(text.encode())
            (staged / page_path.name).write_bytes(page.encode())
        return [model_path, page_path]


def fit(
    recording: str | Path | Cloud | StoredCloud | Recording | PointCloud,
    *,
    model: str | Path | None = None,
    scene: str | Path | Scene | None = None,
    pose: Pose | Sequence[Any] | np.ndarray | None = None,
    sensor: str | None = None,
    intensity: str | None = None,
    white: float | None = None,
) -> Fit:
    """Fit a sensor's performance parameters to recorded sweeps.

    The sensor must be stationary, unless a scene of the recorded place and the poses are available.

    Parameters
    ----------
    recording
        Sweeps in any format that `compare` supports, or a cloud in memory that has sweeps.
    model
        Name or file of a sensor model. Values that cannot be determined from the recording are
        taken from this model. By default, a model with the recorded beams is used.
    scene
        Scene of the recorded place. By default, the surfaces are estimated from the recording,
        which requires a stationary sensor.
    pose
        Pose of the sensor in the scene: a single pose, one pose for each sweep, or matrices of
        shape (n, 4, 4). By default, the poses are taken from the recording. If it has no poses, the
        sensor is placed at the origin of the scene. A result has a pose for each pulse. In other
        recordings, a pose applies to a whole sweep.
    sensor, intensity
        Name of the sensor (or topic of a bag) if the recording contains several sensors, and name
        of the column that contains the intensities. The default column is ``intensity``.
    white
        Intensity that the sensor reports for a white surface, if the intensity does not depend on
        the range. By default, recordings of Velodyne and Ouster sensors use the value of these
        sensors, and the value is unknown for other recordings.

    Returns
    -------
    Fit
        The fitted sensor and the statistics of the fit.

    Raises
    ------
    LidarError
        If the recording cannot be read, has no sweeps or rings, or contains several sensors, or if
        the sensor moves, but the scene or the poses are unknown.
    """
    if white is not None:
        check_number("white", white, gt=0)
    named = None if model is None else read_model(model)  # before the recording, which takes long
    opened = with_sweeps(as_recording(recording, sensor, intensity))
    check_sweeps(opened)
    loaded = Scene.load(scene) if isinstance(scene, str | Path) else scene
    poses = KnownPoses.from_recording(opened, pose, loaded)
    speed = None if poses is None else poses.speed(opened)
    if poses is None or speed is None:
        measured = measure_standing(opened, white, loaded, poses)
    elif loaded is None:
        raise LidarError(
            moving_message(
                opened.info.name,
                speed,
                "Pass a mesh of the scene to which its poses refer with `--scene`",
            )
        )
    else:
        measured = measure_moving(opened, white, loaded, poses)
    base = recorded_sensor(measured.stack) if named is None else named
    return _fit_of(opened, measured, base)


def _fit_of(recording: Recording, measured: SensorMeasurement, base: SensorModel) -> Fit:
    stack = measured.stack
    name = Path(recording.info.name).name
    source = f"fitted by lidarpool {__version__} to {name}, {plural(stack.sweep_count, 'sweep')}"
    estimates = measured.estimates
    notes = list(stack.notes)
    if not base.matches_rings(stack.elevation_deg):
        notes.append(f"the recorded rings do not match the rings of {base.name}. Check `--model`")
    figures = {
        "versions": {"lidarpool": __version__},
        "name": name,
        "model": base.name,
        "sweeps": stack.sweep_count,
        "moves": measured.moves,
        "rays": len(measured.rays.row),
        "frontal": has_frontal_rays(measured.rays),
        "intensity": bool(np.isfinite(measured.rays.intensity).all()),
        "energy": measured.energy is not None,
        "figures": {key: estimate._asdict() for key, estimate in estimates.items()},
        "notes": notes,
        "channels": measured.channels(),
        "curves": measured.curves(),
    }
    return Fit(figures, _with_performance(base, estimates, source) if estimates else base)


def _with_performance(
    base: SensorModel, estimates: Mapping[str, Estimate], source: str
) -> SensorModel:
    """Return a sensor model whose performance parameters are replaced with the estimates.

    Parameters without an estimate keep their values. The parameters of range noise belong together:
    an estimate of one of them replaces all of them, and also `precision`.
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


def recorded_sensor(stack: SweepStack) -> SensorModel:
    """Return a sensor model whose beams are those of the recording."""
    return SensorModel(
        name="Recorded sensor",
        sources={"angles": "median angles of the recorded points"},
        firings_per_turn=stack.ranges.shape[2],
        range_m=(0.0, float(np.ceil(1.1 * np.nanmax(stack.ranges)))),
        beams={"elevation_deg": np.sort(stack.elevation_deg).round(3).tolist()},
    )
