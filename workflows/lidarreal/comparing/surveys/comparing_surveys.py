"""Compare survey clouds by pairs of points, planes, M3C2, a mesh, or overlapping strips."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from lidarsim._version import __version__
from lidarsim.errors import LidarError
from lidarsim.io.writing_progress import WritingProgress
from lidarsim.schema.checks import check_choice, check_number
from lidarsim.words import join_names

from .deviations import Deviations, statistics
from .m3c2 import m3c2_deviations
from .mesh import is_mesh, mesh_deviations
from .pairs import UnpairedError, pair_deviations
from .planes import neighborhood_radius, plane_deviations
from .strips import StripSettings, strip_deviations
from .survey_clouds import (
    CloudSource,
    SurveyCloud,
    add_world_origin,
    check_overlap,
    check_same_frame,
)
from .survey_comparison import SurveyComparison

METHODS = ("auto", "pairs", "planes", "m3c2", "mesh")
MAX_DISTANCE_M = 1.0
MAX_POINTS = 10_000_000
_MAX_COMPARED = 4_000_000  # points of A for which planes or triangles are searched
# Options that only some methods use.
_OPTIONS = {
    "radius_m": ("planes", "m3c2"),
    "max_distance_m": ("planes", "m3c2", "mesh"),
    "up_axis": ("mesh",),
}


def compare_surveys(
    a: CloudSource,
    b: CloudSource,
    *,
    method: Literal["auto", "pairs", "planes", "m3c2", "mesh"] = "auto",
    sensor_a: str | None = None,
    sensor_b: str | None = None,
    unit_a: str | None = None,
    unit_b: str | None = None,
    up_axis: str | None = None,
    keep_noise: bool = False,
    radius_m: float | None = None,
    max_distance_m: float | None = None,
    max_points: int = MAX_POINTS,
    on_progress: WritingProgress = lambda *_: None,
) -> SurveyComparison:
    """Compare two survey clouds, or a cloud and a mesh, in world coordinates.

    B is the reference, and deviations are A - B. The clouds are not aligned with each other.

    Parameters
    ----------
    a
        Cloud in any format that `compare` reads. All sensors of a result are compared.
    b
        Cloud, or mesh file.
    method
        ``pairs`` compares points of the same ray and the same return, which requires the
        column `time` or `gps_time`, or the columns `scan` and `ray`, in both clouds. ``planes``
        computes distances of the points of A from planes through the points of B, ``m3c2`` computes
        M3C2 distances and their level of detection with py4dgeo, and ``mesh`` computes signed
        distances from a mesh. ``auto`` selects ``mesh`` if B is a mesh, otherwise ``pairs`` if
        points can be paired, otherwise ``planes``.
    sensor_a, sensor_b
        Name of the sensor to compare (default: all sensors).
    unit_a, unit_b
        Length unit of a mesh, or of a file that does not state its unit.
    up_axis
        Up axis of the mesh: x, y or z.
    keep_noise
        Whether to include points that are withheld or classified as noise.
    radius_m
        Radius of the neighborhoods that determine planes, and of the cylinders of M3C2, in meters.
        The default is a radius within which half of the points of B have at least 20 neighbors.
    max_distance_m
        Maximum distance from B in meters (default: 1). Points that are farther away have no
        counterpart.
    max_points
        Maximum number of points of each cloud in memory. Larger clouds are sampled.
    on_progress
        Function that is called with the name of an activity, the number of completed items, the
        total number of items, and their unit, such as ("reading flown", 7, 80, "sweeps").

    Returns
    -------
    SurveyComparison
        Statistics of the deviations, with maps.

    Raises
    ------
    LidarError
        If A or B cannot be read, if their coordinate systems or units differ, or if they have
        nothing in common that the method can compare.

    Examples
    --------
    >>> import numpy as np
    >>> from lidarpool import Cloud, compare_surveys
    >>> points = np.random.default_rng(1).uniform(0, 9, (900, 3))
    >>> times = {"time": np.arange(900)}
    >>> found = compare_surveys(Cloud(points + (0, 0, 0.02), times), Cloud(points, times))
    >>> round(found.figures["components"]["delta_h"]["mean_m"], 6)
    0.02
    """
    check_choice("method", method, METHODS)
    check_number("max_points", max_points, whole=True, ge=1000)
    for name, value in (("radius_m", radius_m), ("max_distance_m", max_distance_m)):
        if value is not None:
            check_number(name, value, gt=0)
    b_is_mesh = isinstance(b, str | Path) and is_mesh(Path(b))
    if method == "mesh" and not b_is_mesh:
        raise LidarError(f"{b} is not a mesh. Specify a mesh file as B, such as a .glb file.")
    if method == "auto" and b_is_mesh:
        method = "mesh"
    given = {"radius_m": radius_m, "max_distance_m": max_distance_m, "up_axis": up_axis}
    common: dict[str, Any] = {"keep_noise": keep_noise, "show": on_progress}
    first = SurveyCloud.open(a, "cloud A", sensor=sensor_a, unit=unit_a, **common)
    if method == "mesh":
        _check_options(method, given | {"sensor_b": sensor_b}, {"sensor_b": ()})
        assert isinstance(b, str | Path)
        reach_m = max_distance_m or MAX_DISTANCE_M
        return _compare_with_mesh(first, Path(b), reach_m, unit=unit_b, up_axis=up_axis)
    second = SurveyCloud.open(b, "cloud B", sensor=sensor_b, unit=unit_b, **common)
    notes = check_same_frame([first, second])
    (first, second), more = add_world_origin([first, second])
    notes += more
    if method in {"auto", "pairs"}:
        try:
            found = pair_deviations(first, second, max_points)
        except UnpairedError as error:
            if method == "pairs":
                raise
            notes.append(
                f"points cannot be paired, because {error.reason}, so distances from planes are "
                "compared"
            )
            method = "planes"
        else:
            _check_options("pairs", given)
            return _summarize("pairs", [first, second], found, notes)
    _check_options(method, given)
    found, more = _distances(method, first, second, radius_m, max_distance_m, max_points)
    return _summarize(method, [first, second], found, notes + more)


def compare_strips(
    *clouds: CloudSource,
    cell_m: float = 1.0,
    max_roughness_m: float = 0.1,
    keep_noise: bool = False,
    on_progress: WritingProgress = lambda *_: None,
) -> SurveyComparison:
    """Compare the heights of overlapping strips.

    In each cell of a horizontal grid, a plane is fitted to the points of each strip, and the
    heights of the planes are compared. Points of pulses with several returns are not used.

    Parameters
    ----------
    clouds
        Clouds in any format that `compare` reads. Points of the same file belong to different
        strips if their point source IDs differ. The sweeps of a result are divided into strips by
        sensor and flight line.
    cell_m
        Width of the cells in meters.
    max_roughness_m
        Maximum standard deviation, in meters, of the points of a strip from their plane. Cells with
        a higher value, such as those with vegetation or edges, are not compared.
    keep_noise
        Whether to include points that are withheld or classified as noise.
    on_progress
        Function that is called with the progress, as by `compare_surveys`.

    Returns
    -------
    SurveyComparison
        Statistics of the height differences for each pair of strips, with maps.

    Raises
    ------
    LidarError
        If a cloud cannot be read, if coordinate systems or units differ, if there are fewer than
        two strips, or if no strips overlap.
    """
    check_number("cell_m", cell_m, gt=0)
    check_number("max_roughness_m", max_roughness_m, gt=0)
    opened = [
        SurveyCloud.open(cloud, f"cloud {number}", keep_noise=keep_noise, show=on_progress)
        for number, cloud in enumerate(clouds, 1)
    ]
    if not opened:
        raise LidarError("There is no cloud to compare. Specify at least one.")
    notes = check_same_frame(opened)
    opened, more = add_world_origin(opened)
    notes += more
    found = strip_deviations(opened, StripSettings(cell_m, max_roughness_m))
    return _summarize("strips", opened, found, notes)


def _check_options(
    method: str, given: Mapping[str, Any], only_for: Mapping[str, tuple[str, ...]] | None = None
) -> None:
    """Raise LidarError if an option was given that the method does not use."""
    for name, methods in {**_OPTIONS, **(only_for or {})}.items():
        if given.get(name) is not None and method not in methods:
            hint = f" Use it with {join_names(methods)}." if methods else ""
            raise LidarError(
                f"The option `{name.removesuffix('_m').replace('_', '-')}` does not apply to the "
                f"method {method}.{hint}"
            )


def _distances(
    method: str,
    a: SurveyCloud,
    b: SurveyCloud,
    radius_m: float | None,
    max_distance_m: float | None,
    max_points: int,
) -> tuple[Deviations, list[str]]:
    """Return distances of A from the points of B, and notes for the user."""
    points, notes_a = a.sample(max_points if method == "m3c2" else min(max_points, _MAX_COMPARED))
    reference, notes_b = b.sample(max_points)
    reach_m = max_distance_m or MAX_DISTANCE_M
    check_overlap(points.positions, reference.positions, (a.name, b.name), reach_m)
    if radius_m is None:
        radius_m = neighborhood_radius(reference.positions)
    if method == "m3c2":
        found = m3c2_deviations(points, reference, radius_m, reach_m)
    else:
        found = plane_deviations(points, reference, radius_m, reach_m, a.show)
    found.figures["points"] = {"a": len(points), "b": len(reference)}
    has_scanners = points.has_scanners or reference.has_scanners
    found.figures["positive_side"] = "scanners" if has_scanners else "surfaces"
    return found, notes_a + notes_b


def _compare_with_mesh(
    a: SurveyCloud, mesh: Path, reach_m: float, **options: str | None
) -> SurveyComparison:
    points, notes = a.sample(_MAX_COMPARED)
    chosen = {name: value for name, value in options.items() if value is not None}
    found = mesh_deviations(
        points.positions, mesh, reach_m, a.frame, a.world_origin, a.show, **chosen
    )
    found.figures["points"] = {"a": len(points)}
    return _summarize("mesh", [a], found, notes, str(mesh))


def _summarize(
    method: str,
    clouds: list[SurveyCloud],
    found: Deviations,
    notes: list[str],
    mesh: str | None = None,
) -> SurveyComparison:
    names = [cloud.name for cloud in clouds] + ([] if mesh is None else [mesh])
    systems = [name for cloud in clouds if (name := cloud.frame.system_name)]
    own = [note for cloud in clouds for note in cloud.notes]
    figures: dict[str, Any] = {
        "versions": {"lidarpool": __version__},
        "method": method,
        "inputs": names,
        "coordinate_system": systems[0] if systems else None,
        "components": {name: statistics(values) for name, values in found.components.items()},
        **found.figures,
        "notes": list(dict.fromkeys([*own, *notes, *found.notes])),
    }
    return SurveyComparison(figures, found.points, found.components, found.columns)
