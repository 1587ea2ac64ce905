"""Convert MuJoCo models to scenarios. Rangefinders become sensors on a stationary platform.

The rangefinders at all sites of a body are the beams of a sensor. The rangefinders of a camera are
the beams of another sensor. The reader follows
https://mujoco.readthedocs.io/en/latest/XMLreference.html#sensor-rangefinder
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from glob import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidarsim.errors import LidarError, explain_os_errors, unreadable_message
from lidarsim.io.input_files import read_input
from lidarsim.numerics.arrays import Floats
from lidarsim.numerics.elementary import arctan2, cos, sin
from lidarsim.numerics.vectors import norm, rotate
from lidarsim.scene.files.scene_graph import MeshFileError, ReadOptions
from lidarsim.scene.object_names import unique_names
from lidarsim.scene.transform import affine
from lidarsim.words import printable
from lidarsim.worlds.mujoco_bodies import BodySelection, names_of, visible_geoms

from ..writers.lidar_scenario import Lidar, round_value, write_scenario
from .model_file import MujocoOptions, body_matrix, body_object_names, load_model

_RANGEFINDER = 7  # mjSENS_RANGEFINDER in sensor_type
_SITE = 6  # mjOBJ_SITE in sensor_objtype
_ORTHOGRAPHIC = 1  # mjPROJ_ORTHOGRAPHIC in cam_projection
_MAX_RAYS = 65_536  # maximum number of rays of a camera
_MAX_RATE_HZ = 1e6


class _Group(NamedTuple):
    """Rangefinders that become the beams of one sensor."""

    body: int  # body that carries the rangefinders
    camera: int | None  # camera of the beams; None for beams of sites
    cutoff_m: float  # 0 if there is no cutoff
    noise_m: float  # standard deviation
    rate_hz: float


def import_model(path: Path, folder: Path, assets: Sequence[Path]) -> list[str]:
    """Write a model as a scenario, which is a `scenario.yaml` file and a data file for each sensor.

    Parameters
    ----------
    path
        A MuJoCo .xml file with rangefinders.
    folder
        Existing output folder.
    assets
        At most one additional folder whose files may be read.

    Returns
    -------
    Differences from MuJoCo, one line each.

    Raises
    ------
    LidarError
        If the model cannot be read or has no rangefinder.
    """
    if len(assets) > 1:
        raise LidarError("it is a MuJoCo model, for which only one `--assets` folder is allowed.")
    model = _loaded(path, assets)
    groups = _groups(model)
    unsupported = _differences(model, groups)
    groups = {group: sites for group, sites in groups.items() if not _unusable(model, group.camera)}
    if not groups:
        reason = "".join(f" Not supported: {line}." for line in unsupported)
        raise LidarError(
            "it has no rangefinder that can become a sensor. To use another sensor, create a "
            f"scenario with `lidarpool init --mesh {path.name}`.{reason}"
        )
    names = unique_names([_name(model, group) for group in groups])
    lidars = [
        _lidar(model, name, group, sites)
        for name, (group, sites) in zip(names, groups.items(), strict=True)
    ]
    entry: dict[str, Any] = {"file": path, **({"assets": assets[0]} if assets else {})}
    carriers = [body for body in dict.fromkeys(group.body for group in groups) if body]
    objects = body_object_names(model, _options(path, assets)) if len(carriers) > 1 else {}
    lidars = [
        lidar._replace(unseen=(escape(objects[group.body]),)) if group.body in objects else lidar
        for lidar, group in zip(lidars, groups, strict=True)
    ]
    if excluded := [body for body in carriers if body not in objects]:
        bodies = names_of(model, "body")
        entry["exclude"] = [bodies[body] for body in excluded]
    return write_scenario(folder, "MuJoCo", entry, lidars, {}, unsupported)


def _options(path: Path, assets: Sequence[Path]) -> ReadOptions:
    folders = (path.parent.resolve(), *(folder.resolve() for folder in assets))
    return ReadOptions(masks=False, colors=False, folders=folders, own=MujocoOptions())


def _loaded(path: Path, assets: Sequence[Path]) -> Any:
    """Load the arrays of a model.

    Raises LidarError if the file cannot be read.
    """
    with explain_os_errors("it cannot be read"):
        data = read_input(path)
    try:
        return load_model(data, path, _options(path, assets))
    except MeshFileError as error:
        raise LidarError(f"it {error}.") from error
    except ValueError as error:
        raise LidarError(unreadable_message("it", error)) from error


def _groups(model: Any) -> dict[_Group, list[int]]:
    """Group the rangefinders, and return the sites in each group."""
    groups: dict[_Group, list[int]] = {}
    for sensor in np.flatnonzero(model.sensor_type == _RANGEFINDER).tolist():
        number = int(model.sensor_objid[sensor])
        of_site = int(model.sensor_objtype[sensor]) == _SITE
        body = int((model.site_bodyid if of_site else model.cam_bodyid)[number])
        group = _Group(
            body,
            None if of_site else number,
            float(model.sensor_cutoff[sensor]),
            float(model.sensor_noise[sensor]),
            _rate_hz(model, sensor),
        )
        groups.setdefault(group, []).extend([number] * of_site)
    return groups


def _rate_hz(model: Any, sensor: int) -> float:
    """Return a sensor's measurement rate, which is the simulation rate by default."""
    intervals = getattr(model, "sensor_interval", None)  # since MuJoCo 4
    interval_s = 0.0 if intervals is None else float(np.atleast_1d(intervals[sensor])[0])
    interval_s = interval_s if interval_s > 0 else model.timestep_s
    return min(1 / interval_s, _MAX_RATE_HZ) if interval_s > 0 else _MAX_RATE_HZ


def _name(model: Any, group: _Group) -> str:
    """Return the name of a sensor's camera or, without a camera, of its body."""
    if group.camera is not None:
        return printable(names_of(model, "cam")[group.camera])
    return printable(names_of(model, "body")[group.body])


def _lidar(model: Any, name: str, group: _Group, sites: list[int]) -> Lidar:
    """Convert a group of rangefinders to a sensor."""
    matrix, origins, directions = _beams(model, group, sites)
    x, y, z = directions.T
    elevations_deg = np.array(_degrees(arctan2(z, norm(directions[:, :2]))))
    order = np.argsort(elevations_deg, kind="stable")  # channels are ordered by elevation
    origins = origins[order]
    beams: dict[str, Any] = {
        "elevation_deg": elevations_deg[order].tolist(),
        "azimuth_deg": _degrees(arctan2(y, x)[order]),
    }
    site_names = names_of(model, "site")
    channels = ", ".join(printable(site_names[sites[row]]) for row in order) if sites else ""
    if origins.any():
        beams["origin_m"] = [
            [round_value(value) for value in origin] for origin in origins.tolist()
        ]
    data: dict[str, Any] = {
        "name": f"{name} of MuJoCo",
        "sources": {"channels": f"rangefinders of {channels or 'the pixels, lowest first'}"},
        "rate_hz": round_value(group.rate_hz),
        "firings_per_turn": 1,
        "beams": beams,
    }
    if group.noise_m > 0:
        data["performance"] = {"range_m": round_value(group.noise_m)}
    root = int(model.body_rootid[group.body])
    return Lidar(
        name=name,
        sensor=name,
        model=names_of(model, "body")[root],
        data=data,
        range_m=(0.0, group.cutoff_m or math.inf),
        matrix=matrix,
        model_matrix=body_matrix(model, root),
    )


def _beams(model: Any, group: _Group, sites: list[int]) -> tuple[Floats, Floats, Floats]:
    """Return a sensor's frame in the world, and its beam origins and directions.

    For sites, the frame has the axes of the body, and its origin is the mean position of the sites.
    For a camera, the frame looks along x, with z pointing up in the image.
    """
    if group.camera is not None:
        axes = model.cam_xmat[group.camera].reshape(3, 3)
        axes = np.stack([-axes[:, 2], -axes[:, 0], axes[:, 1]], axis=1)
        directions = _pixel_directions(model, group.camera)
        matrix = affine(axes, model.cam_xpos[group.camera])
        return matrix, np.zeros_like(directions), directions
    axes = model.xmat[group.body].reshape(3, 3)
    positions = model.site_xpos[sites]
    center = positions.mean(axis=0)
    directions = model.site_xmat[sites].reshape(-1, 3, 3)[:, :, 2]
    return (
        affine(axes, center),
        rotate(positions - center, axes.T),
        rotate(directions, axes.T),
    )


def _pixel_directions(model: Any, camera: int) -> Floats:
    """Return a camera's ray directions, row by row, with x forward and z up."""
    width, height = model.cam_resolution[camera].tolist()
    sensor_m = np.asarray(model.cam_sensorsize[camera], np.float64)
    row, column = np.divmod(np.arange(width * height), width)
    if sensor_m[1] > 0:
        # MuJoCo 4.0 measures the principal point from the upper left corner.
        focal_x, focal_y, principal_x, principal_y = model.cam_intrinsic[camera].tolist()
        right = ((column + 0.5) / width * sensor_m[0] - principal_x) / focal_x
        down = ((row + 0.5) / height * sensor_m[1] - principal_y) / focal_y
    else:
        half_angle = np.radians(float(model.cam_fovy[camera]) / 2)
        focal = height / 2 * float(cos(half_angle) / sin(half_angle))  # pixels
        right = (column + 0.5 - width / 2) / focal
        down = (row + 0.5 - height / 2) / focal
    directions = np.stack([np.ones(len(row)), -right, -down], axis=1)
    return np.asarray(directions / norm(directions)[:, None])


def _degrees(angles: Floats) -> list[float]:
    return [round_value(angle) for angle in np.degrees(angles).tolist()]


def _unusable(model: Any, camera: int | None) -> str:
    """Return why a camera cannot become a sensor, or an empty string if it can."""
    if camera is None:
        return ""
    projections = getattr(model, "cam_projection", None)
    if projections is not None and int(projections[camera]) == _ORTHOGRAPHIC:
        return "its rays are parallel"
    rays = math.prod(model.cam_resolution[camera].tolist())
    return f"it has {rays:,} rays, and the limit is {_MAX_RAYS:,}" if rays > _MAX_RAYS else ""


def _differences(model: Any, groups: dict[_Group, list[int]]) -> list[str]:
    """Describe the differences from MuJoCo, with one clause each."""
    lines = [
        f"the rangefinder of {_name(model, group)!r} ({reason})"
        for group in groups
        if (reason := _unusable(model, group.camera))
    ]
    all_groups = np.unique(model.geom_group)
    further = sorted({*all_groups.tolist()} - {*MujocoOptions().groups})
    if further and visible_geoms(model, BodySelection(further, (), (), "body")):
        numbers = ", ".join(map(str, further))
        lines.append(
            f"rangefinder hits on geoms of {'groups' if len(further) > 1 else 'group'} {numbers} "
            "(to include them, set groups in scene.files)"
        )
    return lines
