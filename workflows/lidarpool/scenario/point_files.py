"""Point clouds in files: positions, where they were seen from, classes, intensities and colors."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from lidarsim.base.arrays import AnyArray, Floats, Floats32, Indices, Ints
from lidarsim.base.errors import LidarError, as_sentence, explained, prefixed, unreadable
from lidarsim.base.input_files import check_input
from lidarsim.base.words import plural, printable
from lidarsim.scene.files.intensity_scales import from_zero
from lidarsim.scene.files.mesh_formats import advice_on
from lidarsim.scene.files.noise_points import LeftOut, usable_points
from lidarsim.scene.files.stated_system import (
    Reprojection,
    check_metric_format,
    stated_meters,
)
from lidarsim.scene.scene_instances import MAX_COORDINATE_M

from ..clouds.file_points import (
    COLORS,
    INTENSITIES,
    MIN_POINTS,
    NORMALS,
    ORIGINS,
    Columns,
    FilePoints,
    Vectors,
)
from ..clouds.format_table import point_suffixes, points_reader

_SAMPLE = 1000  # points that tell whether another system has true meters there
NO_CLASS = np.iinfo(np.int64).min  # class of a point without a class
# Names of columns in files of various programs; the first name that a file has is read.
CLASSES = (
    "class", "classification", "scalar_Classification", "scalar_classification", "label",
    "scalar_Label", "scalar_label",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class ScannedPoints:
    """Points of a file, in meters, and the quantities that surfels keep.

    A quantity that the file does not have is None.

    Attributes
    ----------
    positions
        float64 (n, 3), finite, meters.
    outward
        float64 (n, 3): direction to the scanner, or the normal of the file; zero if unknown.
    classes
        int64 (n,); `NO_CLASS` for points without a class.
    intensities
        float64 (n,), from 0, in the scale of the file; NaN for points without an intensity.
    colors
        float32 (n, 3), sRGB from 0 to 255; NaN for points without a color.
    scanners
        float64 (n, 3): position of the scanner of each point, meters; NaN where unknown.
    epsg
        EPSG code of the coordinate system of the positions, or None if it is not known.
    """

    positions: Floats
    outward: Floats | None = None
    classes: Ints | None = None
    intensities: Floats | None = None
    colors: Floats32 | None = None
    scanners: Floats | None = None
    epsg: int | None = None

    def __len__(self) -> int:
        return len(self.positions)

    def take(self, row_indices: Indices) -> ScannedPoints:
        """Return selected points."""
        return ScannedPoints(
            self.positions[row_indices],
            None if self.outward is None else self.outward[row_indices],
            None if self.classes is None else self.classes[row_indices],
            None if self.intensities is None else self.intensities[row_indices],
            None if self.colors is None else self.colors[row_indices],
            None if self.scanners is None else self.scanners[row_indices],
            self.epsg,
        )


def read_points(
    path: Path,
    unit: str | None,
    tell: Callable[[str], None],
    *,
    epsg: int | None = None,
    keep_noise: bool = False,
) -> ScannedPoints:
    """Return the finite points of a file, in true meters.

    Parameters
    ----------
    path
        A file with one of `point_suffixes()`.
    unit
        Unit of x, y and z, in place of meters or of the units that a .las or .laz states.
    tell
        Called with lines on converted units, and on points and columns that are left out.
    epsg
        Code of the system that points are brought to; by default coordinates are kept.
    keep_noise
        Whether points are kept that the file withholds or classifies as noise.

    Raises
    ------
    LidarError
        If the file cannot be read, is too large, has fewer than `MIN_POINTS` points, or lengths
        that are not true; see `stated_meters` and `Reprojection`.
    """
    reader = points_reader(path)
    if reader is None:
        if advice := advice_on(path):
            raise LidarError(f"{path} cannot be read. {as_sentence(advice)}")
        raise LidarError(
            f"{path} has the extension {path.suffix or '(none)'}, but point clouds must have one "
            f"of these extensions: {' '.join(point_suffixes())}."
        )
    try:
        with explained(f"{path} cannot be read"), prefixed(path):
            if not check_input(path):
                raise LidarError("it is empty (0 bytes).")
            content = reader(path)
            if not keep_noise:
                content = _without_noise(path, content, tell)
            to_meters, placed_epsg = _to_meters(path, content, unit, epsg, tell)
            points, notes = _scanned_points(content, to_meters)
            points = replace(points, epsg=placed_epsg)
    except LidarError:
        raise
    except Exception as error:  # readers raise whatever they stumble over
        raise LidarError(unreadable(path, error)) from error
    _check_points(path, points, content.left_out)
    for note in (*content.notes, *notes):
        tell(f"{path} {note}")
    if content.no_returns:
        tell(
            f"{plural(content.no_returns, 'point')} of {path} at the origin "
            f"{'was' if content.no_returns == 1 else 'were'} skipped as pulses without a return"
        )
    if names := _left_out(content):
        tell(f"{path} has data that surfels cannot store, which were skipped: {', '.join(names)}")
    return points


def _check_points(path: Path, points: ScannedPoints, left_out: LeftOut) -> None:
    """Raise LidarError if there are too few points, or a point is farther than any on Earth."""
    if len(points) < MIN_POINTS and (note := left_out.note()):
        raise LidarError(
            f"{path} must have at least {MIN_POINTS} usable points, but has {len(points)}: {note}."
        )
    if len(points) < MIN_POINTS:
        raise LidarError(f"{path} must have at least {MIN_POINTS} points, but has {len(points)}.")
    if (reach := np.abs(points.positions).max()) > MAX_COORDINATE_M:
        raise LidarError(
            f"{path} extends {reach:.3g} m from the origin, which is farther than anything on "
            "Earth. If the file is not damaged, set its unit with `--unit` (`unit` in Python)."
        )


def _without_noise(path: Path, content: FilePoints, tell: Callable[[str], None]) -> FilePoints:
    """Return content without withheld points and noise, and call `tell` with their number."""
    usable, left_out = usable_points(content.columns, content.noise_classes)
    if usable is None:
        return content
    tell(f"{path}: {left_out.note()}")
    return replace(
        content,
        positions=content.positions[usable],
        columns={name: values[usable] for name, values in content.columns.items()},
        scanners=None if content.scanners is None else content.scanners[usable],
        left_out=left_out,
    )


def _to_meters(
    path: Path,
    content: FilePoints,
    unit: str | None,
    epsg: int | None,
    tell: Callable[[str], None],
) -> tuple[Callable[[Floats], Floats], int | None]:
    """Return a function from positions (n, 3) of a file to true meters, and their EPSG code.

    The code is None if the coordinates are in no known system afterwards. `tell` gets a message
    that says how positions are converted.
    """
    finite = content.positions[np.isfinite(content.positions).all(axis=1)]
    if epsg is not None:
        if unit is not None:
            raise LidarError("`epsg` and `unit` cannot be combined.")
        reprojection = Reprojection(content.system, epsg)
        reprojection.check(finite[:: len(finite) // _SAMPLE + 1])
        notes = reprojection.notes
        convert = reprojection.apply
        placed_epsg = epsg
    else:
        if content.in_meters and unit is None:
            notes = check_metric_format(content.system, finite)
            meters = (1.0, 1.0, 1.0)
        elif content.units_m is not None and unit is None:
            meters = content.units_m
            lengths = ", ".join(f"{length:g}" for length in meters)
            notes = [f"was converted to meters, because its header states units of {lengths} m"]
        else:
            meters, notes = stated_meters(content.system, finite, unit)
        convert = partial(np.multiply, meters)
        placed_epsg = None
        if content.system is not None and unit is None and meters == (1.0, 1.0, 1.0):
            placed_epsg = content.system.epsg_in_meters
    for note in notes:
        tell(f"{path} {note}")
    return convert, placed_epsg


def _scanned_points(
    content: FilePoints, to_meters: Callable[[Floats], Floats]
) -> tuple[ScannedPoints, list[str]]:
    """Return the finite points of a file's content in meters, and notes on them.

    Notes are clauses that follow the name of the file.
    """
    columns = content.columns
    notes = []
    positions = to_meters(content.positions)
    colors = _first_vectors(columns, COLORS)
    outward = _first_vectors(columns, NORMALS)
    scanners = content.scanners
    if scanners is None:
        scanners = _first_vectors(columns, ORIGINS)
    if scanners is not None:
        try:
            scanners = to_meters(scanners.astype(np.float64))
            outward = scanners - positions
        except LidarError:  # an E57 may have a pose of zeros, which has no place in some systems
            scanners = outward = None
            content.ignored.append("scanner positions that cannot be converted to that system")
    classes = _first(columns, CLASSES)
    intensities = _first(columns, INTENSITIES)
    if intensities is not None:
        values = intensities.astype(np.float64)
        intensities, note = from_zero(np.where(np.isfinite(values), values, np.nan))
        notes += [note] if note else []
    points = ScannedPoints(
        positions,
        None if outward is None else np.nan_to_num(outward.astype(np.float64)),
        None if classes is None else _as_integers(classes),
        intensities,
        None if colors is None else _as_srgb(colors),
        scanners,
    )
    # Depth cameras write NaN for pixels without a return.
    finite = np.isfinite(positions).all(axis=1)
    return points if finite.all() else points.take(np.flatnonzero(finite)), notes


def _first(columns: Columns, names: Iterable[str]) -> AnyArray | None:
    """Return the first column that a file has and that is not zero throughout, or None.

    LAS has a column for each quantity, zero where the quantity was not measured.
    """
    present = (columns[name] for name in names if name in columns)
    return next((values for values in present if _has_values(values)), None)


def _first_vectors(columns: Columns, names: Iterable[Vectors]) -> AnyArray | None:
    """Return the first three columns of vectors that a file has, (n, 3), or None."""
    for axes in names:
        if all(name in columns for name in axes):
            vectors = np.stack([columns[name] for name in axes], axis=1)
            if _has_values(vectors):
                return vectors
    return None


def _has_values(values: AnyArray) -> bool:
    """Return True if a value is neither 0 nor NaN."""
    return bool((values[values == values] != 0).any())


def _as_integers(classes: AnyArray) -> Ints:
    """Return classes as integers, `NO_CLASS` for NaN.

    ValueError if a class is not a whole number.
    """
    if classes.dtype.kind == "f":
        classes = np.where(np.isnan(classes), float(NO_CLASS), classes)
    numbers = classes.astype(np.int64)
    if not np.array_equal(numbers, classes):
        raise ValueError("the classes of its points must be integers")
    return numbers


def _as_srgb(colors: AnyArray) -> Floats32:
    """Return colors (n, 3) from 0 to 255: of 8 or 16 bits, or real numbers from 0 to 1 or 255."""
    if colors.dtype == np.uint8:
        return colors.astype(np.float32)
    values = colors.astype(np.float64)
    values[~np.isfinite(values).all(axis=1)] = np.nan
    highest = np.nanmax(values, initial=0)
    if highest <= 1 and colors.dtype.kind == "f":
        values = 255 * values
    elif highest > 255:
        values = values / 257  # 16 bits; several programs write 8 bits into the 16 of LAS
    return np.rint(np.clip(values, 0, 255)).astype(np.float32)


def _left_out(content: FilePoints) -> list[str]:
    """Return the names of the columns that surfels do not keep and that are not zero."""
    columns = content.columns
    used: set[str] = set()
    for names in (CLASSES, INTENSITIES):
        used.update([name for name in names if name in columns][:1])
    for axes in (*COLORS, *NORMALS, *ORIGINS):
        used.update(axes)
    remaining = [
        name for name, values in columns.items() if name not in used and _has_values(values)
    ]
    return [printable(name) for name in [*remaining, *content.ignored]]
