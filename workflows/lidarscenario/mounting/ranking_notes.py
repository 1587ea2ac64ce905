"""Notes about ranked candidates, such as mounts inside the vehicle body."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from lidarsim.motion.trajectory import CENTER, Pose
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.sensor.models import read_model
from lidarsim.words import join_names, list_names, plural
from raybeam import RayCaster

from ..mount_sections import DEFAULT_HEIGHT_M, VehicleFile
from .evaluation import MountResult
from .placements import Placements
from .ranking import CandidateResult

_MANY_BLOCKED = 0.5  # share of blocked beams that causes a note about the best candidate
_INSIDE = 0.95  # share of blocked beams that causes a note about any mount
_TOUCH_M = 0.005  # distance from the body up to which a mount is on its surface


def ranking_notes(
    ranked: Sequence[CandidateResult],
    vehicle: VehicleFile,
    placements: Placements,
    body: SceneMesh,
) -> list[str]:
    """Return notes about candidates that are sorted by rank, best first."""
    notes = [*_body_notes(ranked, vehicle, body), *_best_notes(ranked[0])]
    notes += _range_notes(vehicle)
    if vehicle.rank.height_m is None and vehicle.ranked_height_m != DEFAULT_HEIGHT_M:
        notes.append(
            f"the score uses the blind area at {vehicle.ranked_height_m:g} m, because "
            f"`map.heights_m` does not contain the default of {DEFAULT_HEIGHT_M:g} m. To use "
            "another height, set `rank.height_m`"
        )
    missing = [
        target.name
        for number, target in enumerate(placements.targets)
        if not (placements.target == number).any()
    ]
    if missing:
        notes.append(f"all positions of {', '.join(missing)} overlap the vehicle")
    return notes


def _body_notes(
    ranked: Sequence[CandidateResult], vehicle: VehicleFile, body: SceneMesh
) -> Iterator[str]:
    """Yield a note for each sensor with mounts inside the body or on its surface."""
    mounts = {
        (name, pose): one.sensors[name]
        for one in ranked
        for name, pose in one.candidate.mounts.items()
    }
    for name, sensor in vehicle.sensors.items():
        poses = [pose for owner, pose in mounts if owner == name]
        touching = [pose for pose in poses if _is_on_surface(pose, body)]
        if touching:
            yield (
                f"at {_mount_names(touching, sensor.mounts)}, {name} is on the surface of the "
                "body, so many of its beams start inside the "
                "body. The position is the origin of the sensor, which is above its base"
            )
        inside = [
            pose
            for pose in poses
            if pose not in touching and _is_blocked(mounts[name, pose], _INSIDE)
        ]
        if inside:
            yield (
                f"the vehicle blocks more than {_INSIDE:.0%} of the beams of {name} at "
                f"{_mount_names(inside, sensor.mounts)}. Check whether the position is inside the "
                "body"
            )


def _mount_names(poses: Sequence[Pose], mounts: dict[str, Pose]) -> str:
    """Describe mounts of a sensor by their names or, in a search, by their count."""
    if not mounts:
        return f"{plural(len(poses), 'mount')} of the search"
    names = [key for key, pose in mounts.items() if pose in poses]
    if len(mounts) == 1:
        return "its mount"
    return f"the {'mount' if len(names) == 1 else 'mounts'} {list_names(names)}"


def _is_blocked(sensor: MountResult, share: float) -> bool:
    """Return whether the vehicle blocks more than a share of the beams."""
    return sensor.blocked > share * sensor.beams


def _is_on_surface(pose: Pose, body: SceneMesh) -> bool:
    """Return whether a surface is close to a mount along an axis of the vehicle."""
    directions = np.concatenate([np.eye(3), -np.eye(3)])
    origins = np.array(pose.position) - _TOUCH_M * directions
    hits = RayCaster(body.vertices, body.faces).cast(origins, directions)
    return bool((hits.distance <= 2 * _TOUCH_M).any())


def _best_notes(best: CandidateResult) -> Iterator[str]:
    """Yield a note for each sensor of the best candidate whose beams the vehicle blocks."""
    for name, sensor in best.sensors.items():
        if _is_blocked(sensor, _INSIDE):
            continue
        if _is_blocked(sensor, _MANY_BLOCKED):
            yield (
                f"the vehicle blocks {sensor.blocked / sensor.beams:.0%} of the beams of {name} in "
                "the best candidate. Check whether the mount is inside the body"
            )
        elif sensor.blocked_near:
            yield (
                f"the vehicle blocks {plural(sensor.blocked_near, 'beam')} of {name} in the best "
                "candidate within the minimum range of the sensor"
            )


def _range_notes(vehicle: VehicleFile) -> Iterator[str]:
    """Yield a note about the sensors without a detection range, which would limit their range."""
    without = [name for name in vehicle.sensors if not _has_range_limit(vehicle, name)]
    if not without:
        return
    with_sheet = [name for name in without if _sheet_has_range(vehicle, name)]
    others = [name for name in without if name not in with_sheet]
    advice = []
    if with_sheet:
        advice.append(f"Set `performance: datasheet` for {join_names(with_sheet)}")
    if others:
        advice.append(
            f"No data sheet range is known for {join_names(others)}. Set "
            "`noise.detection_range_m` next to `sensors` to the range at 10 % reflectance. It "
            "applies to all sensors, and overrides their data sheets"
        )
    yield (
        f"reflectance and weather do not limit the range of {join_names(without)}, because no "
        f"detection range is set. {'. '.join(advice)}"
    )


def _has_range_limit(vehicle: VehicleFile, name: str) -> bool:
    """Return whether a sensor has a detection range, which depends on the reflectance."""
    noise = vehicle.mounted_sensor(name, CENTER).noise or vehicle.noise
    return noise.detection_range_m is not None


def _sheet_has_range(vehicle: VehicleFile, name: str) -> bool:
    """Return whether the model of a sensor states a detection range."""
    sensor = vehicle.sensors[name]
    if sensor.model is None:
        return False
    path = vehicle.files.path(sensor.model) if sensor.has_custom_model else sensor.model
    model = read_model(path)
    return model.performance is not None and model.performance.detection is not None
