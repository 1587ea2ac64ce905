"""Rasters of heights, such as GeoTIFF, through rasterio and its GDAL.

Files are opened with the driver of their ending, which sees no files beside them; those that could
name others themselves are read from memory. So nothing that a file names is opened, nor fetched.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from lidarsim.base.allowance import MIN_LIMIT_BYTES, bytes_of, memory_share
from lidarsim.base.arrays import AnyArray, Bools, Floats
from lidarsim.base.elementary import decade
from lidarsim.base.input_files import input_size, read_input
from lidarsim.base.vocabulary import UNITS_M
from lidarsim.base.words import plural
from lidarsim.scene.files.scene_graph import (
    MAX_TRIANGLES,
    Content,
    MeshFileError,
    Raster,
    ReadOptions,
    Window,
)
from lidarsim.scene.scene_mesh import SceneMesh

DRIVERS = {  # {ending: GDAL's name of the driver}
    ".tif": "GTiff", ".tiff": "GTiff", ".asc": "AAIGrid", ".hgt": "SRTMHGT", ".img": "HFA",
    ".dem": "USGSDEM", ".dt0": "DTED", ".dt1": "DTED", ".dt2": "DTED",
}  # fmt: skip

_BESIDE_MOST = 65536  # bytes of a file beside a raster

_OPTIONS = {"AAIGrid": {"DATATYPE": "Float64"}}  # or a file that begins with integers has no others

_AT_ONCE = 100_000  # vertices that are reprojected, through lists
_PIXEL_BYTES = 100  # of a mesh of pixels: vertices, two triangles, and what makes them
_UNASKED = 5_000_000  # pixels that are taken without a window and a step; more take long
_MOST_READ = 1_000_000_000  # pixels of which a coarser grid is made, which takes two minutes
_WIDEST_DEG = 12.0  # of longitude in a UTM zone, which is 6 wide

PixelRange = tuple[int, int]  # half-open

# of the Earth's surface
_LOWEST_M = -12_000.0
_HIGHEST_M = 9_000.0
_NO_DATA = -9999.0  # which many programs write without saying so in the file
_FOOT_M = 0.3048
_US_FOOT_M = 1200 / 3937
_UNIT_NAMES = {  # of heights, as files have them
    **dict.fromkeys(("m", "metre", "meter", "metres", "meters"), 1.0),
    **dict.fromkeys(("ft", "foot", "feet", "international foot"), _FOOT_M),
    **dict.fromkeys(("us survey foot", "us survey feet", "us-ft", "ftus", "us_ft"), _US_FOOT_M),
    **{name: UNITS_M[name] for name in ("mm", "cm", "dm", "km")},
}


def read_raster(_data: bytes, path: Path, wanted: ReadOptions) -> Content:
    """Read the first band as a mesh: a vertex at the middle of each pixel, two triangles a cell.

    Cells with a pixel that has no height are holes. Coordinates are those of `epsg` in
    `wanted.raster`; else the raster's own if they are in metres, or of the UTM zone of its middle.
    The window has the pixels whose middles are in it.
    """
    unit, step_m, window, epsg = wanted.raster
    if find_spec("rasterio") is None:
        raise MeshFileError('is a raster, which rasterio reads: pip install "lidarpool[geo]"')
    with ExitStack() as stack:
        source = stack.enter_context(_opened(path))
        own, up_m = _systems(source)
        place = _place(source, path)
        grid = _RasterGrid(source, place, own, _target(source, place, own, epsg))
        chosen = step_m is not None or window is not None
        if step_m is not None:
            grid = stack.enter_context(_coarser(grid, step_m, window))
            window = None
        columns, rows = grid.part(window)
        _check_size(grid, columns, rows, path.name, chosen=chosen)
        band = grid.file.read(1, window=(rows, columns), masked=True)
        heights = np.ma.getdata(band).astype(np.float64)
        valid = ~np.ma.getmaskarray(band) & np.isfinite(heights)
        del band
        notes = _notes(source, place, own, path)
        metre = UNITS_M[unit] if unit else _unit_m(source.units[0], own, up_m, notes)
        heights = (heights * source.scales[0] + source.offsets[0]) * metre
        mesh = _mesh(path.stem, grid, columns, rows, heights, valid)
        told = _raster_summary(source, own, grid, step_m, valid)
    low, high = mesh.bounds[:, 2]
    if not _LOWEST_M <= low <= high <= _HIGHEST_M or low == _NO_DATA * metre:
        notes.append(
            f"has heights from {low:,.6g} to {high:,.6g} m: if one of them stands for no data, say "
            "so in the file (rio edit-info --nodata VALUE FILE)"
        )
    raster = Raster(*_key(grid.target), told)
    return Content([mesh], unit_m=1.0, up_axis="z", notes=notes, raster=raster)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a file with the driver of its ending."""
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioError
    from rasterio.io import MemoryFile

    driver = DRIVERS[path.suffix.lower()]
    folder = f"{path.parent.absolute()}/"
    with ExitStack() as stack:
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        alone = {"GDAL_PAM_ENABLED": False, "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR"}
        stack.enter_context(rasterio.Env(GDAL_CACHEMAX=MIN_LIMIT_BYTES, **alone))
        try:
            if driver == "GTiff":  # which may be larger than the memory, and reads a window
                input_size(path)
                source = rasterio.open(path.absolute(), driver=driver)
            else:
                name = uuid4().hex
                folder = f"/vsimem/{name}/"
                stem = path.stem if driver == "SRTMHGT" else "raster"  # whose place is in the name
                for one, content in (
                    (".prj", _beside(path, ".prj")),
                    (path.suffix.lower(), read_input(path)),
                ):
                    memory = MemoryFile(content, dirname=name, filename=f"{stem}{one}")
                    stack.enter_context(memory)
                source = memory.open(driver=driver, **_OPTIONS.get(driver, {}))
            stack.enter_context(source)
            _check_kind(source)
            yield source
        except RasterioError as error:
            raise ValueError(str(error.__cause__ or error).replace(folder, "")) from error


def _beside(path: Path, suffix: str) -> bytes:
    """Content of a small file beside a raster; empty if there is none."""
    for one in (suffix, suffix.upper()):
        if (file := path.with_suffix(one)).is_file():
            return read_input(file, _BESIDE_MOST)
    return b""


def _check_kind(source: Any) -> None:
    """Refuse what are no heights, or takes too much to unpack."""
    if not source.dtypes[0].startswith(("int", "uint", "float")):
        raise MeshFileError(f"has pixels of the type {source.dtypes[0]}, which are no heights")
    if source.width < 2 or source.height < 2:
        raise MeshFileError(f"has {source.width} x {source.height} pixels: no cell of four")
    if source.gcps[0] and source.transform.is_identity:
        raise MeshFileError("is placed by control points: rectify it first (gdalwarp -tps)")
    rows, columns = source.block_shapes[0]
    together = source.count if source.interleaving and source.interleaving.name == "pixel" else 1
    size = rows * columns * np.dtype(source.dtypes[0]).itemsize * together
    if size > memory_share():
        raise MeshFileError(
            f"has blocks of {columns:,} x {rows:,} pixels, each {bytes_of(size)}, of at most "
            f"{bytes_of(memory_share())}: write it in tiles (gdal_translate -co TILED=YES)"
        )


def _systems(source: Any) -> tuple[Any, float | None]:
    """Horizontal coordinate system, None for none on Earth, and metres in its unit of heights."""
    from rasterio.crs import CRS

    if source.crs is None or not (source.crs.is_projected or source.crs.is_geographic):
        return None, None
    described = _described(source.crs)
    parts = described.get("components", [described])
    axes = [axis for part in parts for axis in part["coordinate_system"]["axis"]]
    units = [axis["unit"] for axis in axes if axis["direction"] == "up"]
    own = CRS.from_user_input(json.dumps(parts[0])) if len(parts) > 1 else source.crs
    if not units:
        return own, None
    return own, 1.0 if units[0] == "metre" else float(units[0]["conversion_factor"])


def _described(crs: Any) -> dict[str, Any]:
    """PROJJSON of a coordinate system, without the datum that it may be bound to."""
    found: dict[str, Any] = crs.to_dict(projjson=True)
    return found.get("source_crs", found)


def _target(source: Any, place: Any, own: Any, epsg: int | None) -> Any:
    """Coordinate system of the mesh."""
    from rasterio.crs import CRS
    from rasterio.errors import CRSError
    from rasterio.warp import transform

    if epsg is not None:
        try:
            given = CRS.from_epsg(epsg)
        except CRSError as error:
            raise MeshFileError(
                f"cannot be brought to EPSG:{epsg}, a code that rasterio does not know: check "
                "cloud.epsg"
            ) from error
        if not given.is_projected or given.linear_units_factor[1] != 1:
            raise MeshFileError(
                f"cannot be brought to EPSG:{epsg} ({_described(given)['name']}), which "
                "is not in metres: give cloud.epsg another code"
            )
        return given
    if own is None or (own.is_projected and own.linear_units_factor[1] == 1):
        return own
    corners = _corners(source, place)
    if own.is_geographic and (wide := np.ptp(corners[:, 0])) > _WIDEST_DEG:
        raise MeshFileError(
            f"spans {wide:.4g} degrees, too wide for a UTM zone: give cloud.epsg, the code of a "
            "projection in metres"
        )
    x, y = corners.mean(axis=0)
    (longitude,), (latitude,) = transform(own, CRS.from_epsg(4326), [x], [y])
    zone = math.floor((longitude + 180) / 6) % 60 + 1
    return CRS.from_epsg((32600 if latitude >= 0 else 32700) + zone)


def _place(source: Any, path: Path) -> Any:
    """Affine from columns and rows to x and y; pixels of 1 m, the first on top, if it has none."""
    from rasterio.transform import Affine

    place = source.transform
    if place.is_identity:
        place = Affine(1, 0, 0, 0, -1, source.height)
        if numbers := _beside(path, ".tfw").split():  # of the middle of the first pixel
            a, d, b, e, c, f = map(float, numbers)
            place = Affine(a, b, c - (a + b) / 2, d, e, f - (d + e) / 2)
    if not np.isfinite(place).all() or place.determinant == 0:
        raise MeshFileError(f"places its pixels by {[*place][:6]}, which gives them no area")
    return place


def _at(affine: Any, x: Any, y: Any) -> tuple[Any, Any]:
    """Apply an affine; its own operators differ from version to version."""
    a, b, c, d, e, f = [*affine][:6]
    return a * x + b * y + c, d * x + e * y + f


def _corners(file: Any, place: Any) -> Floats:
    """Corners (4, 2) of a file, in its own coordinates."""
    return np.array([_at(place, x, y) for x in (0, file.width) for y in (0, file.height)])


@dataclass(frozen=True)
class _RasterGrid:
    """Pixels, and where they are."""

    file: Any
    place: Any  # affine from columns and rows to x and y
    own: Any  # coordinate system of these
    target: Any  # and that of the mesh

    @property
    def same(self) -> bool:
        """Whether the mesh has the coordinates of the file."""
        return self.own is None or bool(self.own == self.target)

    def at(self, column: AnyArray, row: AnyArray) -> tuple[AnyArray, AnyArray]:
        """X and y in the mesh's coordinates."""
        from rasterio.warp import transform

        x, y = _at(self.place, column, row)
        for first in range(0, 0 if self.same else len(x), _AT_ONCE):
            some = slice(first, first + _AT_ONCE)
            x[some], y[some] = transform(self.own, self.target, x[some], y[some])
        return x, y

    @cached_property
    def reach(self) -> Floats:
        """Lowest and highest x and y in the mesh's coordinates, (2, 2)."""
        from rasterio.warp import transform_bounds

        corners = _corners(self.file, self.place)
        ends = np.array([corners.min(axis=0), corners.max(axis=0)])
        if not self.same:
            ends = np.reshape(transform_bounds(self.own, self.target, *ends.ravel()), (2, 2))
        return ends

    @cached_property
    def pixel_m(self) -> float:
        """Side of a square as large as the pixel in the middle, metres."""
        column = np.array([0.0, 1.0, 0.0])
        row = np.array([0.0, 0.0, 1.0])
        x, y = self.at(column + self.file.width // 2, row + self.file.height // 2)
        return math.sqrt(abs((x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])))

    def part(self, window: Window | None) -> tuple[PixelRange, PixelRange]:
        """Columns and rows whose middles are in a window, or in a box around it, half-open."""
        from rasterio.warp import transform_bounds

        sides = np.array([self.file.width, self.file.height])
        if window is None:
            return (0, int(sides[0])), (0, int(sides[1]))
        self.check_overlap(window)
        if not self.same:
            window = transform_bounds(self.target, self.own, *window)
        x, y = np.meshgrid(window[::2], window[1::2])
        corners = np.stack(_at(~self.place, x.ravel(), y.ravel()))
        first = np.maximum(np.ceil(corners.min(axis=1) - 0.5 - 1e-6), 0)
        end = np.minimum(np.floor(corners.max(axis=1) + 0.5 + 1e-6), sides)
        if (end - first < 2).any():
            raise MeshFileError("has fewer than 2 x 2 pixels in the window: give a larger one")
        (c0, r0), (c1, r1) = first.astype(int).tolist(), end.astype(int).tolist()
        return (c0, c1), (r0, r1)

    def check_overlap(self, window: Window) -> None:
        """Refuse a window beside all pixels."""
        low, high = self.reach
        if (np.maximum(low, window[:2]) >= np.minimum(high, window[2:])).any():
            (left, right), (bottom, top) = self.reach.T.tolist()
            raise MeshFileError(
                f"has nothing in the window {[*window]}: it reaches from x {left:,.10g} to "
                f"{right:,.10g} and from y {bottom:,.10g} to {top:,.10g}"
            )


@contextmanager
def _coarser(grid: _RasterGrid, step_m: float, window: Window | None) -> Iterator[_RasterGrid]:
    """Make a grid of mean heights, along the axes of the mesh's coordinates."""
    from rasterio.crs import CRS
    from rasterio.enums import Resampling
    from rasterio.transform import Affine
    from rasterio.vrt import WarpedVRT

    if step_m < grid.pixel_m * (1 - 1e-6):
        raise MeshFileError(f"has pixels of {grid.pixel_m:.6g} m: step_m must not be less")
    low, high = grid.reach
    if window is not None:
        grid.check_overlap(window)
        low = np.maximum(low, window[:2])
        high = np.minimum(high, window[2:])
    if (count := float(np.prod((high - low) / grid.pixel_m))) > _MOST_READ:
        raise MeshFileError(
            f"would be made coarser from {count:,.0f} pixels, of at most {_MOST_READ:,}: give a "
            "window too, or make it coarser first (gdal_translate -tr)"
        )
    columns, rows = np.ceil((high - low) / step_m - 1e-6).astype(int).tolist()
    if min(columns, rows) < 2:
        raise MeshFileError("has fewer than 2 x 2 steps of step_m: give a smaller one")
    wide, deep = (high - low) / (columns, rows)  # whole cells have their middle at their mean
    place = Affine(wide, 0, low[0], 0, -deep, high[1])
    plane = grid.target or CRS.from_epsg(32631)  # any: GDAL wants one, the same on both sides
    options: dict[str, Any] = {"src_crs": grid.own or plane, "crs": plane}
    if grid.file.nodata is None and grid.file.dtypes[0].startswith("float"):
        options["src_nodata"] = np.nan
    with WarpedVRT(
        grid.file,
        src_transform=grid.place,
        transform=place,
        width=columns,
        height=rows,
        resampling=Resampling.average,
        dtype="float64",
        nodata=np.nan,
        tolerance=0.01,  # pixels
        **options,
    ) as made:
        yield _RasterGrid(made, place, grid.target, grid.target)


def _check_size(
    grid: _RasterGrid, columns: PixelRange, rows: PixelRange, name: str, *, chosen: bool
) -> None:
    """Refuse more pixels than the memory has room for, with a window and a step that fit.

    Fewer are refused if no window or step is `chosen`, for they take long to read and to show.
    """
    sides = np.array([columns[1] - columns[0], rows[1] - rows[0]])
    count = int(np.prod(sides.astype(object)))
    room = most = min(memory_share() // _PIXEL_BYTES, MAX_TRIANGLES // 2)
    if not chosen:
        most = min(most, _UNASKED)
    if count <= most:
        return
    low, high = grid.reach
    x, y = grid.at(np.array([sum(columns) / 2]), np.array([sum(rows) / 2]))
    # Less by a tenth, for what is askew.
    half = np.minimum(0.9 * math.sqrt(most), sides) * grid.pixel_m / 2
    window = [round(float(side), 1) for side in (x[0] - half[0], y[0] - half[1])]
    window += [round(float(side), 1) for side in (x[0] + half[0], y[0] + half[1])]
    step = grid.pixel_m
    while np.prod(np.ceil((high - low) / step) + 1) > 0.9 * most:
        step *= 1.1
    scale = float(f"1e{2 - decade(step)}")
    step = math.ceil(step * scale) / scale
    if count <= room:
        whole = [*np.floor(low).tolist(), *np.ceil(high).tolist()]
        raise MeshFileError(
            f"has {sides[0]:,} x {sides[1]:,} pixels, {2 * count / 1e6:.0f} million triangles. In "
            f"a scenario, scene: [{{file: {name}, step_m: {step:g}}}] takes means\nof them; not "
            f"step_m but window: {window} takes the middle, and window: {whole} all"
        )
    raise MeshFileError(
        f"has {sides[0]:,} x {sides[1]:,} pixels, a mesh of {bytes_of(count * _PIXEL_BYTES)}, of "
        f"at most {bytes_of(memory_share())}, a quarter of the memory: give window: {window}"
        f"{f' or step_m: {step:g}' * (count <= _MOST_READ)} in scene.files"
    )


def _mesh(
    name: str,
    grid: _RasterGrid,
    columns: PixelRange,
    rows: PixelRange,
    heights: Floats,
    valid: Bools,
) -> SceneMesh:
    """Vertices at the middles of pixels, and two triangles, seen from above, for each full cell.

    Middles of pixels are transformed and keep their heights: GDAL's bilinear warp widens its kernel
    where pixels grow along an axis, and rasterio does not pass XSCALE on.
    """
    cells = valid[:-1, :-1] & valid[:-1, 1:] & valid[1:, :-1] & valid[1:, 1:]
    if not cells.any():
        raise MeshFileError("has no cell of four pixels with heights, only of those without")
    used = np.zeros_like(valid)
    for part in (used[:-1, :-1], used[:-1, 1:], used[1:, :-1], used[1:, 1:]):
        part |= cells
    row, column = np.nonzero(used)
    vertices = np.empty((len(row), 3))
    vertices[:, 0], vertices[:, 1] = grid.at(column + (columns[0] + 0.5), row + (rows[0] + 0.5))
    vertices[:, 2] = heights[used]
    number = np.cumsum(used).reshape(used.shape) - 1
    faces = np.empty((np.count_nonzero(cells), 2, 3), np.int64)
    below, right = (1, 2) if grid.place.determinant < 0 else (2, 1)  # rows go down, or up
    faces[:, :, 0] = number[:-1, :-1][cells][:, None]
    faces[:, 0, below] = number[1:, :-1][cells]
    faces[:, 1, right] = number[:-1, 1:][cells]
    faces[:, 0, right] = faces[:, 1, below] = number[1:, 1:][cells]
    return SceneMesh(name, vertices, faces.reshape(-1, 3))


def _unit_m(stated: str | None, own: Any, up_m: float | None, notes: list[str]) -> float:
    """Metres in the unit of heights: the band's, else that of the vertical system."""
    if stated:
        if (metre := _UNIT_NAMES.get(stated.strip().lower())) is not None:
            return metre
        notes.append(f"has heights in {stated[:40]!r}, which is no known unit: taken in metres")
        return 1.0
    if up_m is not None:
        return up_m
    if own is not None and own.is_projected and own.linear_units_factor[1] != 1:
        name, metre = own.linear_units_factor
        notes.append(
            f"states no unit of heights: taken in {name}, as its coordinates are; "
            '<file.unit="m"> takes them in metres'
        )
        return float(metre)
    return 1.0


def _notes(source: Any, place: Any, own: Any, path: Path) -> list[str]:
    """Clauses on what is missing or left."""
    notes = []
    if source.transform.is_identity and place.f == source.height:
        notes.append("states no place: its pixels are taken as 1 m, from x and y 0")
    if own is None:
        notes.append(
            "states no coordinate system: its coordinates are taken in metres (gdal_translate "
            "-a_srs EPSG:CODE gives it one)"
        )
    if source.count > 1:
        notes.append(f"has {source.count} bands: the first is taken for heights")
    endings = (".msk", ".aux.xml") if own is None else (".msk",)
    beside = [path.name + ending for ending in endings if Path(f"{path}{ending}").is_file()]
    if beside:
        notes.append(f"is read without {' and '.join(beside)}: gdal_translate makes one file of it")
    return notes


def _key(crs: Any) -> tuple[str, int | None]:
    """Text that tells a coordinate system from others, and its EPSG code if that is certain."""
    if crs is None:
        return "", None
    code = crs.to_epsg(confidence_threshold=90)  # with 70 it guesses the datum of an unknown one
    return f"EPSG:{code}" if code else crs.to_wkt(), code


def _name(crs: Any) -> str:
    key, code = _key(crs)
    return key if code else f"{_described(crs)['name'][:80]} (no EPSG code)"


def _raster_summary(
    source: Any, own: Any, grid: _RasterGrid, step_m: float | None, valid: Bools
) -> str:
    """Say what was taken."""
    rows, columns = valid.shape
    words = f"{columns:,} x {rows:,} {'means' if step_m else 'pixels'} of {grid.pixel_m:.6g} m"
    if (rows, columns) != source.shape:
        words += f" out of {source.width:,} x {source.height:,} pixels"
    if grid.target is not None:
        words += f", {_name(grid.target)}"
    if own is not None and own != grid.target:
        words += f" from {_name(own)}"
    holes = valid.size - int(np.count_nonzero(valid))
    return words + (f", {plural(holes, 'pixel')} without height" if holes else "")
