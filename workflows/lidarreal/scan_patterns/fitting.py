"""Estimate the scan pattern of a sensor from a recording, and save it as a sensor file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from lidarfiles.clouds.recording import PointCloud, Recording
from lidarfiles.parts.parts import StoredCloud
from lidarfiles.recordings.opening import as_recording
from lidarsim._version import __version__
from lidarsim.columns.cloud import Cloud
from lidarsim.errors import LidarError, explain_os_errors
from lidarsim.io.storage import replace_file
from lidarsim.numerics.arrays import Floats
from lidarsim.sensor.models import MODEL_FILES, SensorModel
from lidarsim.sensor_files.fired_rays import RayList
from lidarsim.sensor_files.format_table import format_of
from lidarsim.words import plural

from .listed_rays import ListedRays
from .pattern_returns import CloudSweep, PatternReturns
from .spinning_head import SpinningHead
from .stationary import check_stationary

RAY_FILES = (".npz", ".csv", ".parquet")


@dataclass(frozen=True, eq=False, repr=False)
class PatternFit:
    """Result of `fit_pattern`, whose text representation is a table.

    Attributes
    ----------
    figures
        Numbers and texts of the table. Angles are in degrees and times in microseconds.
    model
        Sensor model of a spinning sensor, or None if the pattern is a list of rays.
    rays
        List of rays, or None if the pattern is a sensor model.
    """

    figures: dict[str, Any]
    model: SensorModel | None
    rays: RayList | None

    def __repr__(self) -> str:
        lines = [f"{name:<9} {text}" for name, text in self.figures["table"].items()]
        return "\n".join([*lines, *(f"note: {note}" for note in self.figures["notes"])])

    def save(self, file: str | Path) -> list[Path]:
        """Write the sensor file, and return its path in a list.

        A sensor model is written as a `.yaml` file, and a list of rays as a `.npz`, `.csv` or
        `.parquet` file. The file contains the table, as comments or in its header.

        Raises
        ------
        LidarError
            If the file name extension does not match, or if the file cannot be written.
        """
        path = Path(file)
        check_pattern_file(path, as_rays=self.model is None)
        with explain_os_errors(f"{path} cannot be written", _DISK_ADVICE):
            if self.model is None:
                assert self.rays is not None
                format_of(path, None).function("write")(path, self.rays, _NOT_RECORDED)
            else:
                text = _model_text(self.model, repr(self))
                replace_file(path, text.encode())
        return [path]


_DISK_ADVICE = "choose an existing folder with enough free space"
_NOT_RECORDED = ("beam divergence", "returns per pulse", "noise")


def check_pattern_file(path: Path, *, as_rays: bool | None = None) -> None:
    """Raise LidarError unless a file name extension matches the type of a pattern.

    If `as_rays` is None, the pattern may be a sensor model or a list of rays.
    """
    model = f"{' or '.join(MODEL_FILES)} for a sensor model"
    rays = f"{' or '.join(RAY_FILES)} for a list of rays"
    allowed: dict[bool | None, tuple[tuple[str, ...], str]] = {
        None: ((*MODEL_FILES, *RAY_FILES), f"{model}, or {rays}"),
        False: (MODEL_FILES, model),
        True: (RAY_FILES, rays),
    }
    endings, advice = allowed[as_rays]
    if path.suffix.lower() not in endings:
        raise LidarError(
            f"{path} cannot contain the scan pattern. Use a file name with the extension {advice}."
        )


def fit_pattern(
    recording: str | Path | Cloud | StoredCloud | Recording | PointCloud,
    *,
    as_rays: bool = False,
    sensor: str | None = None,
) -> PatternFit:
    """Estimate the scan pattern of an unknown sensor from a recording.

    The sensor must be stationary. The pattern of a spinning sensor consists of the elevation,
    azimuth offset and firing time of each ring, the firing rate, and the rotation rate and
    direction. Any other pattern can be estimated as a list of rays.

    Parameters
    ----------
    recording
        Recording in any format that `open_recording` supports, or a cloud in memory. Points should
        have rings or channels and times.
    as_rays
        Whether to estimate a list of rays instead of a spinning sensor.
    sensor
        Name of the sensor, or topic of a bag, if the recording contains several.

    Returns
    -------
    PatternFit
        The pattern, with the standard deviations of the recorded directions from it.

    Raises
    ------
    LidarError
        If the recording cannot be read or has too few returns, if the sensor moves, or if the
        returns do not come from a spinning sensor and `as_rays` is false.

    Examples
    --------
    >>> from lidarpool import Scanner, Scene, load_sensor
    >>> sensor = load_sensor("velodyne/vlp16")
    >>> scanner = Scanner(Scene.seed(), sensor, columns=["time"], coordinates="sensor")
    >>> fitted = fit_pattern(scanner.sweep((0, 0, 2)))
    >>> fitted.model.clockwise, round(fitted.model.rate_hz)
    (True, 10)
    >>> np.round(fitted.model.beams.elevation_deg[:3])
    array([-15., -13., -11.])
    """
    opened = as_recording(recording, sensor)
    swept = CloudSweep(opened) if isinstance(opened, PointCloud) else opened
    returns = PatternReturns.read(swept)
    notes = [*returns.notes, *check_stationary(swept, returns)]
    if swept.info.compensated and not swept.info.has_firing_poses:
        notes.append("the recording states that its points are motion-compensated")
    if "channel" not in _columns(swept) and len(swept.rings):
        notes.append(swept.rings.note.removesuffix("."))
    found = _rays_fit(returns) if as_rays else _head_fit(returns)
    figures = {**found.figures, "notes": [*notes, *found.figures["notes"]]}
    figures["versions"] = {"lidarpool": __version__}
    table = {"recording": _summary(swept, returns), **figures["table"]}
    rays = found.rays and replace(found.rays, notes=(*table.values(), *figures["notes"]))
    return replace(found, figures={**figures, "table": table}, rays=rays)


def _columns(recording: Recording) -> Sequence[str]:
    return [*recording[0].columns] if len(recording) else []


def _summary(recording: Recording, returns: PatternReturns) -> str:
    name = Path(recording.info.name).name
    return f"{name}: {plural(returns.sweep_count, 'sweep')}, {len(returns):,} returns"


def _head_fit(returns: PatternReturns) -> PatternFit:
    """Return the fit of a spinning sensor."""
    head = SpinningHead.from_returns(returns)
    direction = "clockwise" if head.is_clockwise else "counterclockwise"
    elevation = _spread_words(head.elevation_spread_rad)
    azimuth = _spread_words(head.azimuth_spread_rad)
    table = {
        "sensor": f"spinning, {plural(len(head.lasers), 'ring')}, {direction} at "
        f"{head.rate_hz:.4f} Hz, {head.firings_per_turn:.3f} firings per revolution",
        "elevation": f"{elevation} from the rings",
        "azimuth": f"{azimuth} from the rotation",
    }
    if head.time_s is not None and head.time_s.any():
        table["times"] = f"rings are fired within {1e6 * head.time_s.max():.3f} µs"
    if not head.lasers.is_at_origin:
        table["origins"] = "the lasers are not at the origin of the points"
    notes = list(head.notes)
    if head.empty_rad is not None:
        start, stop = np.degrees(head.empty_rad)
        notes.append(
            f"there are no returns between the azimuths {start:.1f}° and {stop:.1f}°. These "
            "directions are written as blocked"
        )
    model = head.model(Path(returns.name).name)
    return PatternFit({"table": table, "notes": notes, **_head_figures(head)}, model, None)


def _head_figures(head: SpinningHead) -> dict[str, Any]:
    return {
        "firings_per_turn": head.firings_per_turn,
        "rate_hz": head.rate_hz,
        "clockwise": head.is_clockwise,
        "elevation_deg": np.degrees(head.lasers.elevation_rad).tolist(),
        "azimuth_deg": np.degrees(head.azimuth_rad).tolist(),
        "time_us": None if head.time_s is None else (1e6 * head.time_s).tolist(),
        "elevation_spread_deg": np.degrees(head.elevation_spread_rad).tolist(),
        "azimuth_spread_deg": np.degrees(head.azimuth_spread_rad).tolist(),
    }


def _spread_words(spread_rad: Floats) -> str:
    """Return the typical and the largest standard deviation of the rings."""
    spread_deg = np.degrees(spread_rad[np.isfinite(spread_rad)])
    return f"standard deviation {np.median(spread_deg):.4f}° (at most {spread_deg.max():.4f}°)"


def _rays_fit(returns: PatternReturns) -> PatternFit:
    """Return the fit of a list of rays."""
    listed = ListedRays.from_returns(returns)
    assert listed.rays.cycle_ns is not None
    channels = plural(len(np.unique(listed.rays.channels)), "channel")
    of = "repetitions" if listed.repetitions else "smooth curves"
    table = {
        "sensor": f"{len(listed.rays):,} rays in {1e-9 * listed.rays.cycle_ns:.6g} s, {channels}",
        "direction": f"standard deviation {np.degrees(listed.spread_rad):.4f}° from {of}",
    }
    figures = {
        "table": table,
        "notes": list(listed.notes),
        "rays": len(listed.rays),
        "cycle_ns": listed.rays.cycle_ns,
        "spread_deg": float(np.degrees(listed.spread_rad)),
        "repetitions": listed.repetitions,
        "missing": listed.missing,
        "filled": listed.filled,
    }
    return PatternFit(figures, None, listed.rays)


def _model_text(model: SensorModel, comments: str) -> str:
    """Return the content of the data file of a sensor model."""
    stated = model.model_dump(mode="json", exclude_defaults=True)
    if model.firing_us is not None:
        stated["firing_us"] = float(model.firing_us)
    text = "".join(f"# {line}\n" for line in comments.splitlines())
    dump = partial(yaml.safe_dump, sort_keys=False, allow_unicode=True, default_flow_style=None)
    return text + str(dump(stated))
