"""Read point cloud files from which scenes are created."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidarfiles.clouds.format_table import format_of_path, point_suffixes
from lidarfiles.clouds.recording import METERS, PointCloud, Recording
from lidarfiles.clouds.recording_ref import RecordingRef
from lidarsim.columns.column_names import COLORS, NORMALS, ORIGINS, STRENGTHS, columns_for
from lidarsim.columns.sweep import Columns, Sweep
from lidarsim.environment.extras import reading
from lidarsim.errors import LidarError, as_sentence, explain_os_errors, prefix_errors
from lidarsim.io.allowance import bytes_of, memory
from lidarsim.io.input_files import check_input
from lidarsim.numerics.arrays import AnyArray, Bools, Floats, Floats32, Ints
from lidarsim.scene.files.intensity_scales import from_zero
from lidarsim.scene.files.mesh_formats import advice_on
from lidarsim.scene.files.noise_points import OmittedPoints, usable_points
from lidarsim.scene.files.pcd import split_rgb
from lidarsim.scene.files.stated_system import Reprojection, check_metric_format, stated_meters
from lidarsim.scene.scene_instances import MAX_COORDINATE_M
from lidarsim.words import plural, printable

MIN_POINTS = 12  # number of points to which each surfel is fitted
POINT_BYTES = 700  # peak memory per point while surfels are computed and written
NO_CLASS = np.iinfo(np.int64).min  # class of a point without a class
_SAMPLE = 1000  # points at which the lengths in another coordinate system are checked
_CLASS = ("class",)
_INTENSITIES = tuple((name,) for name in STRENGTHS)
_QUANTITIES = (_CLASS, *_INTENSITIES, COLORS, NORMALS, ORIGINS)  # standard names of components


class PlacedPoints(NamedTuple):
    """Points in true meters, and their coordinate system.

    Attributes
    ----------
    points
        The points and their columns.
    epsg
        EPSG code of the coordinate system, or None if it is unknown.
    vertical_datum
        Name of the datum of heights, or an empty string if it is unknown.
    """

    points: Sweep
    epsg: int | None
    vertical_datum: str


def read_points(
    path: Path,
    unit: str | None,
    report: Callable[[str], None],
    *,
    epsg: int | None = None,
    keep_noise: bool = False,
) -> PlacedPoints:
    """Read the finite points of a file in true meters, with their coordinate system if it is known.

    Scans are merged in the frame of the file. The sweep contains the following columns if the file
    has them:

    - `class`: int64, `NO_CLASS` for points without a class.
    - `intensity`: float64, not negative, on the scale of the file.
    - `red`, `green` and `blue`: float32, sRGB from 0 to 255.
    - `origin_x`, `origin_y` and `origin_z`: float64, position of the scanner for each point in
      meters.
    - `normal_x`, `normal_y` and `normal_z`: float64, only if the scanner positions are unknown.

    Unknown values are NaN, except normals, which are zero.

    Parameters
    ----------
    path
        A file with an extension in `point_suffixes()`.
    unit
        Unit of x, y and z, which overrides the unit that the file states.
    report
        Function that is called with notes on converted units, and on skipped points and columns.
    epsg
        Code of the coordinate system to which the points are transformed. By default, the
        coordinates are not transformed.
    keep_noise
        Whether to include points that the file withholds or classifies as noise.

    Raises
    ------
    LidarError
        If the file cannot be read, is too large, or has fewer than `MIN_POINTS` points, or if its
        coordinate system distorts lengths (`stated_meters`, `Reprojection`).
    """
    if path.is_dir() and path.suffix.lower() in point_suffixes():
        raise LidarError(f"{path} cannot be read: Is a directory.")
    cloud_format = None if path.is_dir() else format_of_path(path, str(path))
    if cloud_format is None or not cloud_format.for_scenes:
        if advice := advice_on(path):
            raise LidarError(f"{path} cannot be read. {as_sentence(advice)}")
        raise LidarError(
            f"{path} has the extension {path.suffix or '(none)'}, but point clouds must have one "
            f"of these extensions: {' '.join(point_suffixes())}."
        )
    with explain_os_errors(f"{path} cannot be read"), prefix_errors(path):
        if not check_input(path):
            raise LidarError("it is empty (0 bytes).")
    recording = cloud_format.open(RecordingRef(path, as_stored=True))
    with reading(str(path)):
        content = _read_scans(recording, keep_noise)
        if note := content.omitted.omission_note():
            report(f"{path}: {note}")
        to_meters, placed_epsg = _to_meters(path, recording, content.points, unit, epsg, report)
        points = _convert_points(content.points, to_meters)
    _check_points(path, points, content.omitted)
    for line in (*recording.notes, *(f"{path} {note}" for note in points.notes)):
        report(line)
    if content.no_returns:
        report(
            f"{plural(content.no_returns, 'point')} of {path} at the origin "
            f"{'was' if content.no_returns == 1 else 'were'} skipped as pulses without a return"
        )
    if points.skipped:
        names = ", ".join(map(printable, points.skipped))
        report(f"{path} has data that surfels cannot store, which were skipped: {names}")
    system = None if unit is not None else recording.info.system
    datum = "" if system is None else system.vertical_datum
    return PlacedPoints(points, placed_epsg, datum)


def vectors(points: Sweep, names: Sequence[str]) -> AnyArray | None:
    """Stack columns into an array of vectors, or return None if the first column is missing.

    The result has shape (n, k), where k is the number of columns.
    """
    if names[0] not in points.columns:
        return None
    return np.stack([points.columns[name] for name in names], axis=1)


def _check_points(path: Path, points: Sweep, omitted: OmittedPoints) -> None:
    """Raise LidarError if there are too few points or a coordinate is implausibly large."""
    if len(points) < MIN_POINTS and (note := omitted.omission_note()):
        raise LidarError(
            f"{path} must have at least {MIN_POINTS} usable points, but has {len(points)}: {note}."
        )
    if len(points) < MIN_POINTS:
        raise LidarError(f"{path} must have at least {MIN_POINTS} points, but has {len(points)}.")
    if (reach := np.abs(points.points).max()) > MAX_COORDINATE_M:
        raise LidarError(
            f"{path} extends {reach:.3g} m from the origin, which is farther than anything on "
            "Earth. If the file is not damaged, set its unit with `--unit` (`unit` in Python)."
        )


class _Content(NamedTuple):
    """Content of a point cloud file."""

    # Points in the units and the frame of the file. The columns have the same names as in the file,
    # and `skipped` lists all columns with values other than zero.
    points: Sweep
    omitted: OmittedPoints  # withheld points and noise
    no_returns: int  # number of points at the origin that were skipped


def _read_scans(recording: Recording | PointCloud, keep_noise: bool) -> _Content:
    """Read the scans or parts of a file, and merge them in file coordinates.

    Raise LidarError if there is not enough memory for the points.
    """
    if not len(recording) and not isinstance(recording, PointCloud):
        raise ValueError("it contains no scans")
    _check_count(recording.info.point_count or 0)
    missing_if_zero: list[Sequence[str]] = [ORIGINS]
    if len(recording) > 1 and not isinstance(recording, PointCloud):
        # Some programs write zeros for quantities that were not measured in a scan.
        missing_if_zero += [*_INTENSITIES, COLORS]
    scans = []
    omitted = OmittedPoints()
    no_returns = 0
    for number in range(len(recording)):
        scan = recording.load(number)
        if not isinstance(recording, PointCloud):
            _check_count(len(scan))
            count = len(scan)
            scan = _without_zeros(scan)
            no_returns += count - len(scan)
        if recording.info.noise_classes is not None and not keep_noise:
            usable, omitted_here = usable_points(scan.columns, recording.info.noise_classes)
            scan = scan if usable is None else scan.select(usable)
            omitted = OmittedPoints(*np.add(omitted, omitted_here).tolist())
        scans.append(_to_file_frame(_with_used_columns(scan, missing_if_zero)))
    joined = scans[0] if len(scans) == 1 else Sweep.concatenate(scans)
    joined = joined.replace(
        units_m=scans[0].units_m if scans else None,
        skipped=[*dict.fromkeys(name for scan in scans for name in scan.skipped)],
        notes=[*dict.fromkeys(note for scan in scans for note in scan.notes)],
    )
    return _Content(joined, omitted, no_returns)


def _check_count(count: int) -> None:
    """Raise LidarError if the memory is insufficient for a number of points."""
    if (size := count * POINT_BYTES) > memory():
        raise LidarError(
            f"it has {count:,} points, which require {bytes_of(size)} of memory. Downsample "
            "it first."
        )


def _without_zeros(scan: Sweep) -> Sweep:
    """Remove points at the origin, which drivers write for lost pulses.

    If there are fewer than `MIN_POINTS` points at the origin, they are kept, because they may have
    been measured.
    """
    is_return: Bools = np.asarray(scan.points.any(axis=1))
    zero_count = len(scan) - int(is_return.sum())
    return scan if zero_count < MIN_POINTS else scan.select(is_return)


def _with_used_columns(scan: Sweep, missing_if_zero: Iterable[Sequence[str]]) -> Sweep:
    """Return a scan with only the columns of `_QUANTITIES`, whose names are preserved.

    The quantities in `missing_if_zero` are removed if all of their values are zero.
    """
    stored = {name: values for name, values in scan.columns.items() if values.ndim == 1}
    columns = split_rgb(stored)
    used = {
        name: values
        for names in _QUANTITIES
        for component in names
        for name, values in columns_for(columns, component).items()
    }
    for names in missing_if_zero:
        for group in _column_groups(used, names):
            if not any(map(_has_values, group.values())):
                used = {name: values for name, values in used.items() if name not in group}
    skipped = [name for name in columns if name in used or _has_values(columns[name])]
    return scan.replace(columns=used, skipped=[*skipped, *scan.skipped])


def _to_file_frame(scan: Sweep) -> Sweep:
    """Transform a scan to file coordinates, and add the scanner position as ray origins."""
    points = np.asarray(scan.points, np.float64)
    columns = dict(scan.columns)
    if scan.pose is not None:
        rotation = scan.pose[:3, :3]
        offset = scan.pose[:3, 3]
        points = points @ rotation.T + offset
        for names, shift in ((NORMALS, np.zeros(3)), (ORIGINS, offset)):
            for group in _column_groups(columns, names):
                placed = _stack(group).astype(np.float64) @ rotation.T + shift
                columns |= zip(group, placed.T, strict=True)
    if scan.scanner is not None and not _column_groups(columns, ORIGINS):
        # Ray origins in the file are more accurate than the position of the scanner.
        columns |= {
            name: np.full(len(scan), position)
            for name, position in zip(ORIGINS, scan.scanner, strict=True)
        }
    return scan.replace(points=points, columns=columns)


def _to_meters(
    path: Path,
    recording: Recording | PointCloud,
    points: Sweep,
    unit: str | None,
    epsg: int | None,
    report: Callable[[str], None],
) -> tuple[Callable[[Floats], Floats], int | None]:
    """Return a function that converts positions to true meters, and the resulting EPSG code.

    The code is None if the coordinate system of the converted positions is unknown. `report` is
    called with notes on the conversion. Positions have shape (n, 3).
    """
    finite = points.points[np.isfinite(points.points).all(axis=1)]
    if epsg is not None:
        if unit is not None:
            raise LidarError("`epsg` and `unit` cannot be combined.")
        reprojection = Reprojection(recording.info.system, epsg)
        reprojection.check(finite[:: len(finite) // _SAMPLE + 1])
        notes = reprojection.notes
        convert = reprojection.apply
        placed_epsg = epsg
    else:
        if recording.info.is_metric and unit is None:
            notes = check_metric_format(recording.info.system, finite)
            meters = METERS
        elif points.units_m is not None and unit is None:
            meters = points.units_m
            lengths = ", ".join(f"{length:g}" for length in meters)
            notes = [f"was converted to meters, because its header states units of {lengths} m"]
        elif recording.info.meters != METERS and unit is None:
            meters = recording.info.meters
            notes = []
        else:
            meters, notes = stated_meters(recording.info.system, finite, unit)
        convert = partial(np.multiply, meters)
        placed_epsg = None
        if recording.info.system is not None and unit is None and meters == METERS:
            placed_epsg = recording.info.system.epsg_in_meters
    for note in notes:
        report(f"{path} {note}")
    return convert, placed_epsg


def _convert_points(stored: Sweep, to_meters: Callable[[Floats], Floats]) -> Sweep:
    """Convert stored points to finite points in meters, with the columns of `read_points`.

    `notes` are clauses that follow the name of the file, and `skipped` lists unused columns.
    """
    points = to_meters(stored.points)
    classes = _first_with_values(stored.columns, _CLASS)
    intensities = _first_with_values(stored.columns, *_INTENSITIES)
    colors = _first_with_values(stored.columns, COLORS)
    normals = _first_with_values(stored.columns, NORMALS)
    origins = next(iter(_column_groups(stored.columns, ORIGINS)), {})
    skipped = _unused_columns(stored, {*classes, *intensities, *colors, *normals, *origins})
    notes = [*stored.notes]
    columns: dict[str, AnyArray] = {}
    for values in classes.values():
        columns["class"] = _as_integers(values)
    for values in intensities.values():
        numbers = values.astype(np.float64)
        columns["intensity"], note = from_zero(np.where(np.isfinite(numbers), numbers, np.nan))
        notes += [note] if note else []
    if colors:
        columns |= zip(COLORS, _as_srgb(_stack(colors)).T, strict=True)
    if origins:
        try:
            scanners = to_meters(_stack(origins).astype(np.float64))
            columns |= zip(ORIGINS, scanners.T, strict=True)
        except LidarError:  # E57 poses may be zero, which some coordinate systems do not contain
            skipped.append("scanner positions that cannot be converted to that system")
    elif normals:
        columns |= zip(NORMALS, np.nan_to_num(_stack(normals).astype(np.float64)).T, strict=True)
    converted = stored.replace(points=points, columns=columns, notes=notes, skipped=skipped)
    # Depth cameras write NaN for pixels without a return.
    finite = np.isfinite(points).all(axis=1)
    return converted if finite.all() else converted.select(np.flatnonzero(finite))


def _unused_columns(stored: Sweep, used: Collection[str]) -> list[str]:
    """Return the names in `skipped` that are not used.

    Columns that contain only zeros are omitted.
    """
    names = [name for name in stored.skipped if name not in used]
    columns = stored.columns
    return [name for name in names if name not in columns or _has_values(columns[name])]


def _column_groups(columns: Columns, names: Sequence[str]) -> list[Columns]:
    """Group the columns that store the components of the same quantity.

    If there are several groups, the group with the standard names is the first.
    """
    found = [columns_for(columns, name).items() for name in names]
    return [dict(group) for group in zip(*found, strict=False)]


def _first_with_values(columns: Columns, *quantities: Sequence[str]) -> Columns:
    """Return the columns of the first quantity that has any values other than zero.

    LAS files contain columns of zeros for quantities that were not measured.
    """
    groups = (group for names in quantities for group in _column_groups(columns, names))
    return next((group for group in groups if any(map(_has_values, group.values()))), {})


def _stack(group: Columns) -> AnyArray:
    return np.stack([*group.values()], axis=1)


def _has_values(values: AnyArray) -> bool:
    return bool(np.any((values != 0) & (values == values)))


def _as_integers(classes: AnyArray) -> Ints:
    """Convert classes to integers, and NaN to `NO_CLASS`.

    Raise ValueError if a class is not an integer.
    """
    if classes.dtype.kind == "f":
        classes = np.where(np.isnan(classes), float(NO_CLASS), classes)
    numbers = classes.astype(np.int64)
    if not np.array_equal(numbers, classes):
        raise ValueError("the classes of its points must be integers")
    return numbers


def _as_srgb(colors: AnyArray) -> Floats32:
    """Convert colors to sRGB values between 0 and 255.

    The result has shape (n, 3). The input has 8 or 16 bits, or consists of floats from 0 to 1 or
    from 0 to 255.
    """
    if colors.dtype == np.uint8:
        return colors.astype(np.float32)
    values = colors.astype(np.float64)
    values[~np.isfinite(values).all(axis=1)] = np.nan
    highest = np.nanmax(values, initial=0)
    if highest <= 1 and colors.dtype.kind == "f":
        values = 255 * values
    elif highest > 255:
        values = values / 257  # 16 bits, unless a program wrote 8-bit colors to a LAS file
    return np.rint(np.clip(values, 0, 255)).astype(np.float32)
