"""Read elevation rasters, such as GeoTIFF files, with rasterio and its GDAL.

Each file is opened with the driver for its extension, without access to other files. Formats that
can refer to other files are read from memory. A raster can therefore not cause other files to be
opened or downloaded.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any
from uuid import uuid4

import numpy as np

from lidarsim.environment.extras import install_command
from lidarsim.errors import ArgumentError, CutShortError
from lidarsim.io.allowance import MIN_LIMIT_BYTES, bytes_of, memory_share
from lidarsim.io.input_files import input_size, read_input
from lidarsim.numerics.arrays import AnyArray, Bools, Floats
from lidarsim.numerics.elementary import decade
from lidarsim.scene.files.coordinate_systems import (
    MAX_SCALE_ERROR,
    POLAR_EPSG,
    crs_from_code,
    crs_from_text,
    crs_key,
    crs_name,
    ground_scale,
    horizontal_part,
    is_local,
    linear_unit,
    longitude_latitude,
    missed_area,
    projjson,
    target_problem,
    transform_coordinates,
    utm_code,
    vertical_datum,
)
from lidarsim.scene.files.las_units import unit_by_name
from lidarsim.scene.files.scene_graph import (
    MAX_TRIANGLES,
    Content,
    MeshFileError,
    Raster,
    ReadOptions,
)
from lidarsim.scene.scene_instances import MAX_COORDINATE_M
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.schema.checks import check_fields
from lidarsim.schema.declared import Rectangle, about
from lidarsim.schema.vocabulary import UNITS_M
from lidarsim.survey.survey import EpsgCode
from lidarsim.words import plural

DRIVERS = {  # {extension: GDAL driver}
    ".tif": "GTiff", ".tiff": "GTiff", ".asc": "AAIGrid", ".hgt": "SRTMHGT", ".img": "HFA",
    ".dem": "USGSDEM", ".dt0": "DTED", ".dt1": "DTED", ".dt2": "DTED",
}  # fmt: skip

_MAX_BESIDE_BYTES = 65536  # maximum size of a file beside a raster

# By default, a file that begins with integers is read as integers.
_OPEN_OPTIONS = {"AAIGrid": {"DATATYPE": "Float64"}}

_BLOCK_VERTICES = 100_000  # vertices that are reprojected at a time, because this creates lists
_PIXEL_BYTES = 100  # memory per pixel for vertices, two triangles, and temporary arrays
MAX_UNASKED_PIXELS = 5_000_000  # limit without a window or step, because more pixels take long
_MAX_READ = 1_000_000_000  # maximum number of pixels to average, which takes two minutes
_WIDEST_DEG = 12.0  # maximum width in degrees of longitude; a UTM zone is 6 degrees wide

Window = tuple[float, float, float, float]  # minimum x and y, maximum x and y
PixelRange = tuple[int, int]  # half-open

# Range of the Earth's surface.
_LOWEST_M = -12_000.0
_HIGHEST_M = 9_000.0
_NO_DATA = -9999.0  # many programs use this value without declaring it


@dataclass(frozen=True)
class RasterOptions:
    """Options for reading elevation rasters."""

    step_m: Annotated[
        float | None,
        about("grid step in meters to which heights are averaged (rasters only)", gt=0, le=1e6),
    ] = None
    window: Annotated[
        Rectangle | None,
        about("part of a raster to read, as [x0, y0, x1, y1] with the minimum and maximum x and y"),
    ] = None
    # Coordinate system of the mesh (`world.epsg` in scenarios), or None to choose a suitable one.
    epsg: EpsgCode | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        if self.window is not None:
            x0, y0, x1, y1 = self.window
            if not (x0 < x1 and y0 < y1):
                raise ArgumentError(
                    "window must be [x0, y0, x1, y1] with the lower corner first, but is "
                    f"{list(self.window)}."
                )


def read_raster(_data: bytes, path: Path, options: ReadOptions) -> Content:
    """Read the first band as a mesh with a vertex at each pixel center and two triangles per cell.

    Cells are omitted if one of their pixels has no height. The coordinate system is `epsg` in
    `options.own`. By default, it is the raster's own system if this uses meters that are true to
    scale at the raster's center. Otherwise, it is the UTM zone of the center. A window includes the
    pixels whose centers are inside.
    """
    if find_spec("rasterio") is None:
        raise MeshFileError(
            "is a raster, which requires rasterio. Install it with "
            f"`{install_command('lidarpool[geo]')}`"
        )
    if options.up_axis is not None:
        raise MeshFileError(
            "is a raster, whose heights are always along z. Remove the option `up_axis`"
        )
    request: RasterOptions = options.own
    with _open_raster(path) as file:
        source = _source(file, path)
        notes = _notes(source, path)
        target_crs = _target_crs(source, request.epsg, notes)
        mesh, summary = _raster_mesh(source, target_crs, path, options, notes)
    raster = Raster(*crs_key(target_crs), summary)
    content = Content([mesh], unit_m=1.0, up_axis="z", notes=notes, raster=raster)
    content.is_landscape = True
    content.vertical_datum = source.vertical_datum
    return content


def _raster_mesh(
    source: _Source, target_crs: Any, path: Path, options: ReadOptions, notes: list[str]
) -> tuple[SceneMesh, str]:
    """Convert a raster to a mesh in a coordinate system, and summarize it.

    Notes are appended to `notes`.
    """
    request: RasterOptions = options.own
    window = request.window
    chosen = request.step_m is not None or window is not None
    pixels = _RasterGrid(source.file, source.affine, source.crs, target_crs)
    with ExitStack() as stack:
        grid = pixels
        if request.step_m is not None:
            grid = stack.enter_context(_coarser_grid(grid, request.step_m, window))
            window = None
        columns, rows = grid.pixels_in(window)
        _check_size(grid, columns, rows, path.name, chosen=chosen)
        values, valid = _read_values(grid, columns, rows)
        unit_m = UNITS_M[options.unit] if options.unit else _height_unit_m(source, notes)
        heights = source.heights_m(values, unit_m)
        mesh = _grid_mesh(path.stem, grid, columns, rows, heights, valid)
        no_data_m = float(source.heights_m(np.array(_NO_DATA), unit_m))
        notes += _height_notes(pixels, grid, path, mesh, no_data_m)
        return mesh, _summary(source, grid, request.step_m, valid)


def _read_values(
    grid: _RasterGrid, column_range: PixelRange, row_range: PixelRange
) -> tuple[Floats, Bools]:
    """Read the values in the first band, and a mask of the valid ones."""
    band = grid.file.read(1, window=(row_range, column_range), masked=True)
    values = np.ma.getdata(band).astype(np.float64)
    return values, ~np.ma.getmaskarray(band) & np.isfinite(values)


def _height_notes(
    pixels: _RasterGrid, grid: _RasterGrid, path: Path, mesh: SceneMesh, no_data_m: float
) -> list[str]:
    """Return a note if the heights are implausible for the Earth's surface.

    Parameters
    ----------
    pixels, grid
        The raster, and the grid of the mesh, which may be coarser.
    path
        Path of the file.
    mesh
        Mesh of the grid.
    no_data_m
        Height of the value with which many programs mark missing data.

    Raises
    ------
    MeshFileError
        If heights exceed `MAX_COORDINATE_M`, which is not allowed in scenes.
    """
    lowest_m, highest_m = mesh.bounds[:, 2]
    if _LOWEST_M <= lowest_m <= highest_m <= _HIGHEST_M and lowest_m != no_data_m:
        return []
    is_low = lowest_m < _LOWEST_M or lowest_m == no_data_m
    heights = mesh.vertices[:, 2]
    extreme = mesh.vertices[heights.argmin() if is_low else heights.argmax()]
    value = _value_near(pixels, grid, extreme)
    command = f"gdal_translate -a_nodata {value!r} {path.name} NEW.tif"
    if DRIVERS[path.suffix.lower()] == "GTiff":
        command = f"rio edit-info --nodata {value!r} {path.name}"
    stated = pixels.file.nodata
    state = "as nodata" if stated is None else f"as nodata instead of {float(stated)!r}"
    if max(-lowest_m, highest_m) > MAX_COORDINATE_M:
        raise MeshFileError(
            f"contains the value {value!r}, which is not a valid height. If it marks missing "
            f"data, declare it {state} with `{command}`"
        )
    return [
        f"has heights from {lowest_m:,.6g} to {highest_m:,.6g} m. If {value!r} marks missing "
        f"data, declare it {state} with `{command}`"
    ]


def _value_near(pixels: _RasterGrid, grid: _RasterGrid, vertex: Floats) -> float:
    """Return the value with the largest magnitude among the pixels that determine a vertex."""
    reach = 0.75 * grid.pixel_m + 2 * pixels.pixel_m
    x, y, _ = vertex.tolist()
    columns, rows = pixels.pixels_in((x - reach, y - reach, x + reach, y + reach))
    values, valid = _read_values(pixels, columns, rows)
    values = values[valid]
    return float(values[np.abs(values).argmax()])


@dataclass(frozen=True)
class _Source:
    """An open raster, and the coordinates of its pixels."""

    file: Any
    affine: Any  # transform from columns and rows to x and y, in meters in a local system
    crs: Any  # horizontal coordinate system of x and y, or None without a position on Earth
    up_m: float | None  # unit of the vertical coordinate system in meters
    vertical_datum: str = ""  # empty if the raster does not state it
    local: _LocalSystem | None = None  # stated system without a position on Earth

    def heights_m(self, values: Floats, unit_m: float) -> Floats:
        """Convert values in the first band, whose unit is `unit_m`, to heights in meters."""
        return (values * self.file.scales[0] + self.file.offsets[0]) * unit_m


@dataclass(frozen=True)
class _LocalSystem:
    """A coordinate system that has no position on Earth, such as a site grid."""

    name: str
    unit: str
    unit_m: float

    @property
    def conversion_note(self) -> str:
        """Note on the conversion to meters, or an empty string if the unit is the meter."""
        if self.unit_m == 1:
            return ""
        return (
            f"uses the local coordinate system {self.name!r} with the unit {self.unit}. Its "
            "coordinates were converted to meters"
        )


def _source(file: Any, path: Path) -> _Source:
    """Determine the pixel coordinates of an open raster."""
    from rasterio.transform import Affine

    affine = _affine(file, path)
    stated = _stated_crs(file, path)
    if stated is None:
        return _Source(file, affine, None, None)
    crs, up_m = horizontal_part(stated)
    if crs.is_projected or crs.is_geographic:
        return _Source(file, affine, crs, up_m, vertical_datum(stated))
    unit = linear_unit(crs) if is_local(crs) else None
    if unit is None:
        raise MeshFileError(
            f"uses {crs_name(crs)}, which has no horizontal axes. Reproject it to meters "
            "first, for example with `gdalwarp -t_srs SYSTEM IN OUT`"
        )
    name, unit_m = unit
    local = _LocalSystem(str(projjson(crs)["name"])[:80], name, unit_m)
    scaled = Affine(*(unit_m * number for number in [*affine][:6]))
    return _Source(file, scaled, None, up_m, vertical_datum(stated), local)


def _stated_crs(file: Any, path: Path) -> Any:
    """Return the coordinate system that a raster states, or None.

    An ASCII grid may have it in a `.prj` file. GDAL itself reads `.prj` files in WKT 1 only, and
    ignores others.
    """
    if file.crs is not None or file.driver != "AAIGrid":
        return file.crs
    text = _read_beside(path, ".prj").decode("utf-8", "replace").strip()
    crs = crs_from_text(text) if text else None
    if text and crs is None:
        raise MeshFileError(
            f"has a coordinate system in {path.stem}.prj that PROJ cannot parse. Correct it, or "
            "delete the file to read the coordinates in meters"
        )
    return crs


@contextmanager
def _open_raster(path: Path) -> Iterator[Any]:
    """Open a file with the GDAL driver for its extension, and yield the rasterio dataset."""
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioError
    from rasterio.io import MemoryFile

    driver = DRIVERS[path.suffix.lower()]
    folder = f"{path.parent.absolute()}/"
    with ExitStack() as stack:
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        settings = {"GDAL_PAM_ENABLED": False, "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR"}
        settings["GTIFF_REPORT_COMPD_CS"] = True  # also for GeoTIFF 1.0
        stack.enter_context(rasterio.Env(GDAL_CACHEMAX=MIN_LIMIT_BYTES, **settings))
        try:
            if driver == "GTiff":  # may exceed the memory, because only a window is read
                input_size(path)
                source = rasterio.open(path.absolute(), driver=driver)
            else:
                name = uuid4().hex
                folder = f"/vsimem/{name}/"
                # SRTMHGT encodes the position in the file name.
                stem = path.stem if driver == "SRTMHGT" else "raster"
                for ending, content in (
                    (".prj", _read_beside(path, ".prj")),
                    (path.suffix.lower(), read_input(path)),
                ):
                    memory = MemoryFile(content, dirname=name, filename=f"{stem}{ending}")
                    stack.enter_context(memory)
                source = memory.open(driver=driver, **_OPEN_OPTIONS.get(driver, {}))
            stack.enter_context(source)
            _check_kind(source)
            yield source
        except RasterioError as error:
            raise _failure(str(error.__cause__ or error).replace(folder, ""), driver) from error


def _failure(reason: str, driver: str) -> ValueError:
    """Return an error for a file that a GDAL driver cannot read."""
    if "File short" in reason:
        return CutShortError("it contains fewer heights than its header declares")
    if "not recognized as being in a supported file format" in reason:
        return ValueError(
            f"its content is not in the {driver} format that GDAL expects for its extension"
        )
    return ValueError(reason)


def _read_beside(path: Path, suffix: str) -> bytes:
    """Return the content of a small file beside a raster, or b"" if it does not exist."""
    for ending in (suffix, suffix.upper()):
        if (file := path.with_suffix(ending)).is_file():
            return read_input(file, _MAX_BESIDE_BYTES)
    return b""


def _check_kind(source: Any) -> None:
    """Raise MeshFileError if a band has no heights, or if its blocks do not fit into memory."""
    if not source.dtypes[0].startswith(("int", "uint", "float")):
        raise MeshFileError(
            f"has pixels of type {source.dtypes[0]}, which cannot be read as heights"
        )
    if source.width < 2 or source.height < 2:
        raise MeshFileError(
            f"has {source.width} x {source.height} pixels, but at least 2 x 2 are required"
        )
    if source.gcps[0] and source.transform.is_identity:
        raise MeshFileError(
            "is georeferenced by ground control points only. Rectify it first, for example with "
            "`gdalwarp -tps`"
        )
    rows, columns = source.block_shapes[0]
    interleaved = source.count if source.interleaving and source.interleaving.name == "pixel" else 1
    size = rows * columns * np.dtype(source.dtypes[0]).itemsize * interleaved
    if size > memory_share():
        raise MeshFileError(
            f"has blocks of {columns:,} x {rows:,} pixels, each {bytes_of(size)}. The limit is "
            f"{bytes_of(memory_share())}. Rewrite it with tiles, for example with "
            "`gdal_translate -co TILED=YES`"
        )


def _target_crs(source: _Source, epsg: int | None, notes: list[str]) -> Any:
    """Choose the coordinate system of the mesh. It must be in meters that are true to scale.

    A note is appended if the raster is reprojected, or if lengths have errors at the edges of the
    mesh. Raises MeshFileError if there is no suitable coordinate system.
    """
    crs = source.crs
    middle = _corners(source.file, source.affine).mean(axis=0)
    if epsg is not None:
        target = _chosen_crs(crs, epsg, middle)
    elif crs is None:
        return None
    elif crs.is_projected and crs.linear_units_factor[1] == 1:
        scale = ground_scale(crs, *middle.tolist())
        target = crs
        if scale is not None and not scale.is_true:
            if (area := missed_area(crs, *middle.tolist())) is not None:
                raise MeshFileError(
                    f"specifies {crs_name(crs)}, whose area of use ({area}) does not include its "
                    f"center, x {middle[0]:,.9g}, y {middle[1]:,.9g}. Assign the correct "
                    "coordinate system with `gdal_edit.py -a_srs EPSG:CODE FILE`"
                )
            target = _zone_crs(source, middle)
            notes.append(
                f"uses {crs_name(crs)}, in which one meter is {scale} on the ground here. It was "
                f"reprojected to {crs_name(target)}"
            )
    else:
        target = _zone_crs(source, middle)
    if error := _scale_error_at_edges(source, target):
        notes.append(
            f"is so wide that lengths in {crs_name(target)} have an error of {error:.1%} at its "
            "edges"
        )
    return target


def _chosen_crs(crs: Any, epsg: int, middle: Floats) -> Any:
    """Return the coordinate system with the given EPSG code.

    Raises MeshFileError if it is not in meters that are true to scale.
    """
    target = crs_from_code(epsg)
    place = middle
    if target is not None and crs is not None:
        with suppress(Exception):  # the classes of GDAL errors are private in rasterio
            place = transform_coordinates(crs, horizontal_part(target)[0], middle[None])[0]
    if problem := target_problem(epsg, *place.tolist()):
        raise MeshFileError(f"cannot be reprojected to world.epsg {problem}")
    return target


def _zone_crs(source: _Source, middle: Floats) -> Any:
    """Return the UTM zone for a position in a raster's coordinate system.

    Raises MeshFileError if the raster is too wide.
    """
    place = longitude_latitude(source.crs, *middle.tolist())
    if place is None:
        raise MeshFileError(
            f"uses {crs_name(source.crs)}, but its coordinates cannot be converted to longitude "
            "and latitude. Reproject it to meters first, for example with `gdalwarp -t_srs "
            "SYSTEM IN OUT`"
        )
    code = utm_code(*place)
    width_deg = _width_deg(source)
    if width_deg > _WIDEST_DEG and code not in POLAR_EPSG:
        raise MeshFileError(
            f"spans {width_deg:.4g} degrees, which is too wide for a UTM zone. Set world.epsg to "
            "the code of a projection in meters"
        )
    return crs_from_code(code)


def _width_deg(source: _Source) -> float:
    """Return a raster's width in degrees of longitude, or infinity if it cannot be determined."""
    corners = _corners(source.file, source.affine)
    if source.crs.is_geographic:
        return float(np.ptp(corners[:, 0]))
    places = [longitude_latitude(source.crs, x, y) for x, y in corners.tolist()]
    longitudes = sorted(place[0] for place in places if place is not None)
    if len(longitudes) < len(places):
        return math.inf
    gaps = np.diff([*longitudes, longitudes[0] + 360])  # a raster may cross the antimeridian
    return 360 - float(gaps.max())


def _scale_error_at_edges(source: _Source, target: Any) -> float:
    """Return the largest scale error at a raster's corners, or 0 if it is negligible."""
    corners = _corners(source.file, source.affine)
    if source.crs is not None and source.crs != target:
        try:
            corners = transform_coordinates(source.crs, horizontal_part(target)[0], corners)
        except Exception:  # the classes of GDAL errors are private in rasterio
            return 0.0
    horizontal, _ = horizontal_part(target)
    scales = [ground_scale(horizontal, x, y) for x, y in corners.tolist()]
    error = max((scale.error for scale in scales if scale is not None), default=0.0)
    return error if error > MAX_SCALE_ERROR else 0.0


def _affine(file: Any, path: Path) -> Any:
    """Return the affine transform from columns and rows to x and y.

    By default, pixels have a size of 1 m.
    """
    from rasterio.transform import Affine

    affine = file.transform
    if affine.is_identity:
        affine = Affine(1, 0, 0, 0, -1, file.height)
        if numbers := _read_beside(path, ".tfw").split():  # refers to the first pixel's center
            a, d, b, e, c, f = map(float, numbers)
            affine = Affine(a, b, c - (a + b) / 2, d, e, f - (d + e) / 2)
    if not np.isfinite(affine).all() or affine.determinant == 0:
        raise MeshFileError(f"has the geotransform {[*affine][:6]}, whose pixels have no area")
    return affine


def _apply(affine: Any, x: Any, y: Any) -> tuple[Any, Any]:
    """Apply an affine transform to x and y.

    Its operators are not used, because they differ between versions.
    """
    a, b, c, d, e, f = [*affine][:6]
    return a * x + b * y + c, d * x + e * y + f


def _corners(file: Any, affine: Any) -> Floats:
    """Return the corners of a raster in its own coordinate system."""
    return np.array([_apply(affine, x, y) for x in (0, file.width) for y in (0, file.height)])


@dataclass(frozen=True)
class _RasterGrid:
    """The pixels of a raster, with coordinates both in the file and in the mesh."""

    file: Any
    affine: Any  # transform from columns and rows to x and y
    crs: Any  # coordinate system of x and y
    target_crs: Any  # coordinate system of the mesh

    @property
    def keeps_crs(self) -> bool:
        """Whether mesh coordinates are the same as file coordinates."""
        return self.crs is None or bool(self.crs == self.target_crs)

    def coordinates(self, column: AnyArray, row: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Return x and y in mesh coordinates."""
        from rasterio.warp import transform

        x, y = _apply(self.affine, column, row)
        for first in range(0, 0 if self.keeps_crs else len(x), _BLOCK_VERTICES):
            block = slice(first, first + _BLOCK_VERTICES)
            x[block], y[block] = transform(self.crs, self.target_crs, x[block], y[block])
        return x, y

    @cached_property
    def extent(self) -> Floats:
        """Minimum and maximum x and y in mesh coordinates. Shape (2, 2)."""
        from rasterio.warp import transform_bounds

        corners = _corners(self.file, self.affine)
        extent = np.array([corners.min(axis=0), corners.max(axis=0)])
        if not self.keeps_crs:
            extent = np.reshape(
                transform_bounds(self.crs, self.target_crs, *extent.ravel()), (2, 2)
            )
        return extent

    @cached_property
    def pixel_m(self) -> float:
        """Side length of a square that has the same area as the central pixel, in meters."""
        column = np.array([0.0, 1.0, 0.0])
        row = np.array([0.0, 0.0, 1.0])
        x, y = self.coordinates(column + self.file.width // 2, row + self.file.height // 2)
        return math.sqrt(abs((x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])))

    def pixels_in(self, window: Window | None) -> tuple[PixelRange, PixelRange]:
        """Return half-open ranges of the columns and rows whose pixel centers are in a window.

        If the raster is rotated or reprojected, the ranges enclose the window.
        """
        from rasterio.warp import transform_bounds

        size = np.array([self.file.width, self.file.height])
        if window is None:
            return (0, int(size[0])), (0, int(size[1]))
        self.check_overlap(window)
        if not self.keeps_crs:
            window = transform_bounds(self.target_crs, self.crs, *window)
        x, y = np.meshgrid(window[::2], window[1::2])
        corners = np.stack(_apply(~self.affine, x.ravel(), y.ravel()))
        first = np.maximum(np.ceil(corners.min(axis=1) - 0.5 - 1e-6), 0)
        stop = np.minimum(np.floor(corners.max(axis=1) + 0.5 + 1e-6), size)
        if (stop - first < 2).any():
            raise MeshFileError("has fewer than 2 x 2 pixels in the window. Choose a larger window")
        first_column, first_row = first.astype(int).tolist()
        stop_column, stop_row = stop.astype(int).tolist()
        return (first_column, stop_column), (first_row, stop_row)

    def check_overlap(self, window: Window) -> None:
        """Raise MeshFileError if a window does not overlap the raster."""
        lower, upper = self.extent
        if (np.maximum(lower, window[:2]) >= np.minimum(upper, window[2:])).any():
            (x_min, x_max), (y_min, y_max) = self.extent.T.tolist()
            raise MeshFileError(
                f"does not overlap the window {[*window]}. It extends from x {x_min:,.10g} to "
                f"{x_max:,.10g} and from y {y_min:,.10g} to {y_max:,.10g}"
            )


@contextmanager
def _coarser_grid(grid: _RasterGrid, step_m: float, window: Window | None) -> Iterator[_RasterGrid]:
    """Yield a grid of mean heights that is aligned with the axes of the mesh."""
    from rasterio.crs import CRS
    from rasterio.enums import Resampling
    from rasterio.transform import Affine
    from rasterio.vrt import WarpedVRT

    if step_m < grid.pixel_m * (1 - 1e-6):
        raise MeshFileError(
            f"has a pixel size of {grid.pixel_m:.6g} m. Set step_m to at least this value"
        )
    lower, upper = grid.extent
    if window is not None:
        grid.check_overlap(window)
        lower = np.maximum(lower, window[:2])
        upper = np.minimum(upper, window[2:])
    if (count := float(np.prod((upper - lower) / grid.pixel_m))) > _MAX_READ:
        raise MeshFileError(
            f"has {count:,.0f} pixels to average, but the limit is {_MAX_READ:,}. Set a window "
            "as well, or reduce the resolution first, for example with `gdal_translate -tr`"
        )
    columns, rows = np.ceil((upper - lower) / step_m - 1e-6).astype(int).tolist()
    if min(columns, rows) < 2:
        raise MeshFileError("covers fewer than 2 x 2 grid cells. Choose a smaller value for step_m")
    # Use complete cells only, so that their mean heights are valid at their centers.
    width_m, height_m = (upper - lower) / (columns, rows)
    affine = Affine(width_m, 0, lower[0], 0, -height_m, upper[1])
    # GDAL requires coordinate systems. Any will do if both sides are equal.
    plane = grid.target_crs or CRS.from_epsg(32631)
    options: dict[str, Any] = {"src_crs": grid.crs or plane, "crs": plane}
    if grid.file.nodata is None and grid.file.dtypes[0].startswith("float"):
        options["src_nodata"] = np.nan
    with WarpedVRT(
        grid.file,
        src_transform=grid.affine,
        transform=affine,
        width=columns,
        height=rows,
        resampling=Resampling.average,
        dtype="float64",
        nodata=np.nan,
        tolerance=0.01,  # pixels
        **options,
    ) as warped:
        yield _RasterGrid(warped, affine, grid.target_crs, grid.target_crs)


def _check_size(
    grid: _RasterGrid, column_range: PixelRange, row_range: PixelRange, name: str, *, chosen: bool
) -> None:
    """Raise MeshFileError for too many pixels, and suggest a window and a step that fit.

    Unless a window or step is `chosen`, the limit is lower, so that the mesh is quick to read and
    display.
    """
    sides = np.array([column_range[1] - column_range[0], row_range[1] - row_range[0]])
    count = int(np.prod(sides.astype(object)))
    max_read = max_pixels = min(memory_share() // _PIXEL_BYTES, MAX_TRIANGLES // 2)
    if not chosen:
        max_pixels = min(max_pixels, MAX_UNASKED_PIXELS)
    if count <= max_pixels:
        return
    lower, upper = grid.extent
    x, y = grid.coordinates(np.array([sum(column_range) / 2]), np.array([sum(row_range) / 2]))
    # Reduce the window by a tenth, because pixels may be rotated.
    half = np.minimum(0.9 * math.sqrt(max_pixels), sides) * grid.pixel_m / 2
    window = [round(float(side), 1) for side in (x[0] - half[0], y[0] - half[1])]
    window += [round(float(side), 1) for side in (x[0] + half[0], y[0] + half[1])]
    step = grid.pixel_m
    while np.prod(np.ceil((upper - lower) / step) + 1) > 0.9 * max_pixels:
        step *= 1.1
    scale = float(f"1e{2 - decade(step)}")
    step = math.ceil(step * scale) / scale
    if count <= max_read:
        extent = [*np.floor(lower).tolist(), *np.ceil(upper).tolist()]
        raise MeshFileError(
            f"has {sides[0]:,} x {sides[1]:,} pixels, which would produce {2 * count / 1e6:.0f} "
            f"million triangles. To average them, write\nscene: [{{file: {name}, step_m: "
            f"{step:g}}}] in a scenario. Instead of step_m, window: {window} selects the center, "
            f"and window: {extent} selects all pixels"
        )
    raise MeshFileError(
        f"has {sides[0]:,} x {sides[1]:,} pixels, which would produce a mesh of "
        f"{bytes_of(count * _PIXEL_BYTES)}. The limit is {bytes_of(memory_share())}, a quarter "
        f"of the memory. Set window: {window}{f' or step_m: {step:g}' * (count <= _MAX_READ)} in "
        "scene.files"
    )


def _grid_mesh(
    name: str,
    grid: _RasterGrid,
    column_range: PixelRange,
    row_range: PixelRange,
    heights: Floats,
    valid: Bools,
) -> SceneMesh:
    """Create a mesh with a vertex at each pixel center, and two triangles for each complete cell.

    Pixel centers are transformed and keep their heights. GDAL's bilinear warp is not used, because
    it widens its kernel where pixels grow along an axis, and rasterio does not support XSCALE.
    """
    cells = valid[:-1, :-1] & valid[:-1, 1:] & valid[1:, :-1] & valid[1:, 1:]
    if not cells.any():
        raise MeshFileError("contains no 2 x 2 block of pixels with heights")
    used = np.zeros_like(valid)
    for part in (used[:-1, :-1], used[:-1, 1:], used[1:, :-1], used[1:, 1:]):
        part |= cells
    row, column = np.nonzero(used)
    vertices = np.empty((len(row), 3))
    x, y = grid.coordinates(column + (column_range[0] + 0.5), row + (row_range[0] + 0.5))
    vertices[:, 0] = x
    vertices[:, 1] = y
    vertices[:, 2] = heights[used]
    number = np.cumsum(used).reshape(used.shape) - 1
    faces = np.empty((np.count_nonzero(cells), 2, 3), np.int64)
    down, right = (1, 2) if grid.affine.determinant < 0 else (2, 1)  # rows run down or up
    faces[:, :, 0] = number[:-1, :-1][cells][:, None]
    faces[:, 0, down] = number[1:, :-1][cells]
    faces[:, 1, right] = number[:-1, 1:][cells]
    faces[:, 0, right] = faces[:, 1, down] = number[1:, 1:][cells]
    return SceneMesh(name, vertices, faces.reshape(-1, 3))


def _height_unit_m(source: _Source, notes: list[str]) -> float:
    """Return the length of the height unit, in meters.

    The unit is that of the band, of the vertical coordinate system, or of the coordinates.
    """
    stated = source.file.units[0]
    if stated:
        if (unit_m := unit_by_name(stated)) is not None:
            return unit_m
        notes.append(
            f"has heights in {stated[:40]!r}, which is not a known unit. Meters are assumed"
        )
        return 1.0
    if source.up_m is not None:
        return source.up_m
    name = ""
    factor = 1.0
    if source.local is not None:
        name = source.local.unit
        factor = source.local.unit_m
    elif source.crs is not None and source.crs.is_projected:
        name, factor = source.crs.linear_units_factor
    if factor != 1:
        notes.append(
            f"does not specify a height unit. The unit of its coordinates, {name}, is assumed. "
            'To read heights in meters, use <file.unit="m">'
        )
    return float(factor)


def _notes(source: _Source, path: Path) -> list[str]:
    """Return notes on missing coordinate systems, additional bands, and unread files."""
    file = source.file
    notes = []
    unit_m = 1.0 if source.local is None else source.local.unit_m
    if file.transform.is_identity and source.affine.f == file.height * unit_m:
        notes.append(
            f"is not georeferenced. A pixel size of {unit_m:.6g} m and an origin at x = 0, y = 0 "
            "are assumed"
        )
    if source.local is not None:
        notes += [source.local.conversion_note] if source.local.conversion_note else []
    elif source.crs is None:
        notes.append(
            "does not specify a coordinate system. Coordinates in meters are assumed. To add a "
            "coordinate system, use `gdal_translate -a_srs EPSG:CODE`"
        )
    if file.count > 1:
        notes.append(f"has {file.count} bands. Heights are read from the first band")
    endings = (".msk", ".aux.xml") if source.crs is None else (".msk",)
    neglected = [path.name + ending for ending in endings if Path(f"{path}{ending}").is_file()]
    if neglected:
        listed = " and ".join(neglected)
        notes.append(
            f"was read without {listed}. To include this content, convert the raster with "
            "`gdal_translate`"
        )
    return notes


def _crs_label(crs: Any) -> str:
    """Return a coordinate system's code or name for summaries."""
    key, code = crs_key(crs)
    return key if code else f"{projjson(crs)['name'][:80]} (no EPSG code)"


def _summary(source: _Source, grid: _RasterGrid, step_m: float | None, valid: Bools) -> str:
    """Describe a mesh's size and coordinate systems."""
    rows, columns = valid.shape
    words = f"{columns:,} x {rows:,} {'means' if step_m else 'pixels'} of {grid.pixel_m:.6g} m"
    if (rows, columns) != source.file.shape:
        words += f" out of {source.file.width:,} x {source.file.height:,} pixels"
    if grid.target_crs is not None:
        words += f", {_crs_label(grid.target_crs)}"
    if source.local is not None:
        words += f", from the local system {source.local.name!r}"
    if source.crs is not None and source.crs != grid.target_crs:
        words += f" from {_crs_label(source.crs)}"
    holes = valid.size - int(np.count_nonzero(valid))
    return words + (f", {plural(holes, 'pixel')} without height" if holes else "")
