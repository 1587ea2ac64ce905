"""Rasters of heights, such as GeoTIFF, through rasterio and its GDAL.

Files are read from memory with the driver of their ending. So nothing that a file names is opened:
no other files, no addresses.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from ..base.allowance import LEAST, bytes_of, memory_share
from ..base.vocabulary import UNITS_M
from ..base.words import counted
from .mesh import Mesh
from .nodes import MOST_TRIANGLES, Content, MeshFileError, Raster

_DRIVERS = {
    ".tif": "GTiff", ".tiff": "GTiff", ".asc": "AAIGrid", ".hgt": "SRTMHGT", ".img": "HFA",
    ".dem": "USGSDEM", ".dt0": "DTED", ".dt1": "DTED", ".dt2": "DTED",
}  # fmt: skip
SUFFIXES = (*_DRIVERS,)

# Files beside a raster that GDAL takes the place and the coordinate system from.
_BESIDE = {".tif": ".tfw", ".tiff": ".tfw", ".asc": ".prj"}
_BESIDE_MOST = 65536  # bytes

# GDAL's own overviews may be made by any resampling, and may be other files.
_OPTIONS = {"GTiff": {"OVERVIEW_LEVEL": "NONE"}, "AAIGrid": {"DATATYPE": "Float64"}}

_PIXEL_BYTES = 100  # of a mesh of pixels: vertices, two triangles, and what makes them
_MOST_READ = 4 * 10**9  # pixels of which a coarser grid is made; GDAL reads some 10⁸ a second
_WIDEST_DEG = 12.0  # of longitude in a UTM zone, which is 6 wide

Window = tuple[float, float, float, float]  # lowest x and y, highest x and y
Span = tuple[int, int]  # half-open

_LOWEST_M, _HIGHEST_M = -12_000.0, 9_000.0  # of the Earth's surface
_FOOT_M, _US_FOOT_M = 0.3048, 1200 / 3937
_UNIT_NAMES = {  # of heights, as files have them
    **dict.fromkeys(("m", "metre", "meter", "metres", "meters"), 1.0),
    **dict.fromkeys(("ft", "foot", "feet", "international foot"), _FOOT_M),
    **dict.fromkeys(("us survey foot", "us survey feet", "us-ft", "ftus", "us_ft"), _US_FOOT_M),
    **{name: UNITS_M[name] for name in ("mm", "cm", "dm", "km")},
}


def read_raster(
    data: bytes,
    path: Path,
    *,
    unit: str | None = None,
    step_m: float | None = None,
    window: Window | None = None,
    epsg: int | None = None,
) -> Content:
    """Read the first band as a mesh: a vertex at the middle of each pixel, two triangles a cell.

    Cells with a pixel that has no height are holes. Coordinates are those of `epsg`; else the
    raster's own if they are in metres, or of the UTM zone of its middle.

    Parameters
    ----------
    unit
        Of the heights.
    step_m
        Mean heights in a grid of this step, metres, instead of the pixels.
    window
        Lowest and highest x and y of the pixels' middles, in the mesh's coordinates.
    epsg
        Code of the coordinate system, one in metres.
    """
    if find_spec("rasterio") is None:
        raise MeshFileError('is a raster, which rasterio reads: pip install "lidarpool[geo]"')
    with ExitStack() as stack:
        source = stack.enter_context(_opened(data, path))
        own, up_m = _systems(source)
        target = _target(source, own, epsg)
        grid, place, window = _grid(stack, source, own, target, step_m, window)
        columns, rows = _part(grid, place, window)
        _check_size(place, columns, rows)
        band = grid.read(1, window=(rows, columns), masked=True)
        heights = np.ma.getdata(band).astype(np.float64)
        valid = ~np.ma.getmaskarray(band) & np.isfinite(heights)
        del band
        notes = _notes(source, own)
        metre = UNITS_M[unit] if unit else _unit_m(source.units[0], own, up_m, notes)
        heights = (heights * source.scales[0] + source.offsets[0]) * metre
        code = None if target is None else _code(target)
        crs = "" if target is None else f"EPSG:{code}" if code else target.to_wkt()
        taken = Raster(crs, code, _told(source, own, target, place, step_m, valid))
    x, y = _positions(place, columns, rows)
    mesh = _mesh(path.stem, x, y, heights, valid)
    low, high = mesh.bounds[:, 2]
    if not _LOWEST_M <= low <= high <= _HIGHEST_M:
        notes.append(
            f"has heights from {low:,.6g} to {high:,.6g} m: if one of them stands for no data, say "
            "so in the file (rio edit-info --nodata VALUE FILE)"
        )
    return Content([mesh], 1.0, "z", notes=notes, raster=taken)


@contextmanager
def _opened(data: bytes, path: Path) -> Iterator[Any]:
    """Open a file in memory with the driver of its ending."""
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning
    from rasterio.io import MemoryFile

    suffix = path.suffix.lower()
    driver = _DRIVERS[suffix]
    stem = path.stem if driver == "SRTMHGT" else "raster"  # whose place is in the name
    with ExitStack() as stack:
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        stack.enter_context(rasterio.Env(GDAL_CACHEMAX=LEAST, GDAL_PAM_ENABLED=False))
        folder = uuid4().hex
        if (beside := _BESIDE.get(suffix)) and (content := _beside(path, beside)):
            stack.enter_context(MemoryFile(content, dirname=folder, filename=f"{stem}{beside}"))
        file = stack.enter_context(MemoryFile(data, dirname=folder, filename=f"{stem}{suffix}"))
        source = stack.enter_context(file.open(driver=driver, **_OPTIONS.get(driver, {})))
        _check_kind(source)
        yield source


def _beside(path: Path, suffix: str) -> bytes:
    """Content of a small file beside a raster; empty if there is none."""
    for one in (suffix, suffix.upper()):
        if (file := path.with_suffix(one)).is_file():
            with file.open("rb") as opened:
                return opened.read(_BESIDE_MOST)
    return b""


def _check_kind(source: Any) -> None:
    """Refuse what are no heights, or takes too much to unpack."""
    kind = np.dtype(source.dtypes[0])
    if kind.kind not in "iuf":
        raise MeshFileError(f"has pixels of the type {kind}, which are no heights")
    if source.width < 2 or source.height < 2:
        raise MeshFileError(f"has {source.width} x {source.height} pixels: no cell of four")
    if source.gcps[0] and source.transform.is_identity:
        raise MeshFileError("is placed by control points: rectify it first (gdalwarp -tps)")
    place = _place(source)
    if not np.isfinite(place).all() or place.determinant == 0:
        raise MeshFileError(f"places its pixels by {[*place][:6]}, which gives them no area")
    rows, columns = source.block_shapes[0]
    together = source.count if source.interleaving and source.interleaving.name == "pixel" else 1
    size = rows * columns * kind.itemsize * together
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
    described = source.crs.to_dict(projjson=True)
    described = described.get("source_crs", described)  # of one that is bound to another
    parts = described.get("components", [described])
    axes = [axis for part in parts for axis in part["coordinate_system"]["axis"]]
    units = [axis["unit"] for axis in axes if axis["direction"] == "up"]
    own = CRS.from_user_input(json.dumps(parts[0])) if len(parts) > 1 else source.crs
    if not units:
        return own, None
    return own, 1.0 if units[0] == "metre" else float(units[0]["conversion_factor"])


def _target(source: Any, own: Any, epsg: int | None) -> Any:
    """Coordinate system of the mesh."""
    from rasterio.crs import CRS
    from rasterio.warp import transform

    if epsg is not None:
        given = CRS.from_epsg(epsg)
        if not given.is_projected or given.linear_units_factor[1] != 1:
            raise MeshFileError(
                f"cannot be brought to EPSG:{epsg} ({given.to_dict(projjson=True)['name']}), which "
                "is not in metres: give cloud.epsg another code"
            )
        return given
    if own is None or (own.is_projected and own.linear_units_factor[1] == 1):
        return own
    middle = _place(source) * (source.width / 2, source.height / 2)
    (longitude,), (latitude,) = transform(own, CRS.from_epsg(4326), *([one] for one in middle))
    wide = np.ptp(_corners(source, _place(source))[:, 0])
    if own.is_geographic and wide > _WIDEST_DEG:
        raise MeshFileError(
            f"spans {wide:.4g} degrees, too wide for a UTM zone: give cloud.epsg, the code of a "
            "projection in metres"
        )
    zone = math.floor((longitude + 180) / 6) % 60 + 1
    return CRS.from_epsg((32600 if latitude >= 0 else 32700) + zone)


def _place(source: Any) -> Any:
    """Affine from columns and rows to x and y; pixels of 1 m, the first on top, if it has none."""
    from rasterio.transform import from_origin

    place = source.transform
    return from_origin(0, source.height, 1, 1) if place.is_identity else place


def _corners(grid: Any, place: Any) -> NDArray[np.float64]:
    """Corners (4, 2) of a dataset, in the order of a window's."""
    return np.array([place * (x, y) for x in (0, grid.width) for y in (0, grid.height)])


def _grid(
    stack: ExitStack,
    source: Any,
    own: Any,
    target: Any,
    step_m: float | None,
    window: Window | None,
) -> tuple[Any, Any, Window | None]:
    """Dataset in the mesh's coordinates, its affine, and the window to be cut out of it."""
    from rasterio.crs import CRS
    from rasterio.enums import Resampling
    from rasterio.transform import from_origin
    from rasterio.vrt import WarpedVRT

    grid, place = source, _place(source)
    plane = target or CRS.from_epsg(32631)  # any: GDAL wants one, the same on both sides
    options: dict[str, Any] = {"src_crs": own or plane, "crs": plane, "src_transform": place}
    options |= {"dtype": "float64", "nodata": np.nan}
    if source.nodata is None and np.dtype(source.dtypes[0]).kind == "f":
        options["src_nodata"] = np.nan
    if own is not None and own != target:
        grid = WarpedVRT(source, resampling=Resampling.bilinear, **options)
        stack.enter_context(grid)
        place = grid.transform
    if step_m is None:
        return grid, place, window
    finest = math.sqrt(abs(place.determinant))
    if step_m < finest * (1 - 1e-6):
        raise MeshFileError(f"has pixels of {finest:.6g} m: step_m must not be less")
    corners = _corners(grid, place)
    low, high = corners.min(axis=0), corners.max(axis=0)
    if window is not None:
        _part(grid, place, window)  # that there is something in it
        low, high = np.maximum(low, window[:2]), np.minimum(high, window[2:])
    if (count := float(np.prod((high - low) / finest))) > _MOST_READ:
        raise MeshFileError(
            f"would be made coarser from {count:,.0f} pixels, of at most {_MOST_READ:,}: give a "
            "window too, or make it coarser first (gdal_translate -tr)"
        )
    columns, rows = np.maximum(np.ceil((high - low) / step_m - 1e-6), 1).astype(int).tolist()
    place = from_origin(low[0], high[1], step_m, step_m)
    grid = WarpedVRT(
        source,
        resampling=Resampling.average,
        transform=place,
        width=columns,
        height=rows,
        **options,
    )
    return stack.enter_context(grid), place, None


def _part(grid: Any, place: Any, window: Window | None) -> tuple[Span, Span]:
    """Columns and rows of the pixels whose middles are in a window, as half-open ranges."""
    if window is None:
        return (0, grid.width), (0, grid.height)
    x0, y0, x1, y1 = window
    corners = np.array([~place * (x, y) for x in (x0, x1) for y in (y0, y1)])
    first = np.maximum(np.ceil(corners.min(axis=0) - 0.5 - 1e-6), 0)
    end = np.minimum(np.floor(corners.max(axis=0) + 0.5 + 1e-6), (grid.width, grid.height))
    if (end - first < 2).any():
        (left, bottom), (right, top) = _bounds(grid, place)
        raise MeshFileError(
            f"has fewer than 2 x 2 pixels in the window {[*window]}; it reaches from x "
            f"{left:,.10g} to {right:,.10g} and from y {bottom:,.10g} to {top:,.10g}"
        )
    (c0, r0), (c1, r1) = first.astype(int).tolist(), end.astype(int).tolist()
    return (c0, c1), (r0, r1)


def _bounds(grid: Any, place: Any) -> tuple[list[float], list[float]]:
    corners = _corners(grid, place)
    return corners.min(axis=0).tolist(), corners.max(axis=0).tolist()


def _check_size(place: Any, columns: Span, rows: Span) -> None:
    """Refuse more pixels than the memory has room for, with a step and a window that fit."""
    sides = np.array([columns[1] - columns[0], rows[1] - rows[0]])
    count, most = int(np.prod(sides.astype(object))), memory_share() // _PIXEL_BYTES
    most = min(most, MOST_TRIANGLES // 2)
    if count <= most:
        return
    pixel = math.sqrt(abs(place.determinant))
    step = pixel * math.sqrt(count / most)
    while np.prod(np.ceil(sides * pixel / step) + 1) > most:
        step *= 1.05
    digits = 2 - math.floor(math.log10(step))
    step = math.ceil(step * 10**digits) / 10**digits
    middle = np.array(place * (sum(columns) / 2, sum(rows) / 2))
    half = np.minimum(math.floor(math.sqrt(most)) - 1, sides) * pixel / 2
    window = [round(float(side), 1) for side in (*(middle - half), *(middle + half))]
    raise MeshFileError(
        f"has {sides[0]:,} x {sides[1]:,} pixels, a mesh of {bytes_of(count * _PIXEL_BYTES)}, of "
        f"at most {bytes_of(memory_share())}, a quarter of the memory: take a part or less detail "
        f"in scene.files, such as window: {window} or step_m: {step:g}"
    )


def _positions(place: Any, columns: Span, rows: Span) -> tuple[Any, Any]:
    """X and y of the pixels' middles, arrays that together have a raster's shape."""
    a, b, c, d, e, f = [*place][:6]
    column, row = np.arange(*columns) + 0.5, np.arange(*rows)[:, None] + 0.5
    return a * column + b * row + c, d * column + e * row + f


def _mesh(name: str, x: Any, y: Any, heights: NDArray[Any], valid: NDArray[np.bool_]) -> Mesh:
    """Two triangles for each cell of four valid pixels, seen from above."""
    cells = valid[:-1, :-1] & valid[:-1, 1:] & valid[1:, :-1] & valid[1:, 1:]
    if not cells.any():
        raise MeshFileError("has no cell of four pixels with heights, only of those without")
    used = np.zeros_like(valid)
    for part in (used[:-1, :-1], used[:-1, 1:], used[1:, :-1], used[1:, 1:]):
        part |= cells
    vertices = np.stack([one[used] for one in (*np.broadcast_arrays(x, y), heights)], axis=1)
    number = np.cumsum(used).reshape(used.shape) - 1
    first, right = number[:-1, :-1][cells], number[:-1, 1:][cells]
    below, across = number[1:, :-1][cells], number[1:, 1:][cells]
    faces = np.stack([first, below, across, first, across, right], axis=1).reshape(-1, 3)
    (x0, y0), (x1, y1), (x2, y2) = vertices[faces[0], :2]
    if (x1 - x0) * (y2 - y0) < (x2 - x0) * (y1 - y0):
        faces = faces[:, ::-1]
    return Mesh(name, vertices, faces)


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
            f"states no unit of heights: taken in {name}, as its coordinates are; unit: m in "
            "scene.files takes them in metres"
        )
        return float(metre)
    return 1.0


def _notes(source: Any, own: Any) -> list[str]:
    """Clauses on what is missing or left."""
    notes = []
    if source.transform.is_identity:
        notes.append("states no place: its pixels are taken as 1 m, from x and y 0")
    if own is None:
        notes.append("states no coordinate system: its coordinates are taken in metres")
    if source.count > 1:
        notes.append(f"has {source.count} bands: the first is taken for heights")
    return notes


def _code(crs: Any) -> int | None:
    """EPSG code of a coordinate system; None if it has none for certain."""
    code: int | None = crs.to_epsg(confidence_threshold=90)  # with 70 it guesses unknown datums
    return code


def _name(crs: Any) -> str:
    code = _code(crs)
    return f"EPSG:{code}" if code else f"{crs.to_dict(projjson=True)['name'][:80]} (no EPSG code)"


def _told(
    source: Any, own: Any, target: Any, place: Any, step_m: float | None, valid: NDArray[np.bool_]
) -> str:
    """Say what was taken."""
    rows, columns = valid.shape
    words = f"{columns:,} x {rows:,} pixels of {math.sqrt(abs(place.determinant)):.6g} m"
    if step_m is not None:
        words += f", means of {source.width:,} x {source.height:,}"
    if target is not None:
        words += f", {_name(target)}"
    if own is not None and own != target:
        words += f" (reprojected from {_name(own)})"
    holes = valid.size - int(np.count_nonzero(valid))
    return words + (f", {counted(holes, 'pixel')} without height" if holes else "")
