"""Well-known text (WKT 1) for the coordinate systems in files."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import NamedTuple

from lidarsim.environment.extras import install_command
from lidarsim.errors import LidarError


class _Geodetic(NamedTuple):
    """A geodetic coordinate system on which UTM zones are based."""

    name: str
    datum: str
    ellipsoid: str
    inverse_flattening: float
    codes: tuple[int, int, int]  # EPSG codes of system, datum and ellipsoid


_WGS84 = _Geodetic("WGS 84", "WGS_1984", "WGS 84", 298.257223563, (4326, 6326, 7030))
_ETRS89 = _Geodetic(
    "ETRS89",
    "European_Terrestrial_Reference_System_1989",
    "GRS 1980",
    298.257222101,
    (4258, 6258, 7019),
)


def wkt(epsg: int) -> str:
    """Return the WKT 1 string for an EPSG code.

    UTM zones of WGS 84 and ETRS89 are supported directly. Other systems require rasterio.

    Raises
    ------
    LidarError
        If rasterio is required but not installed, or if it does not know the code.
    """
    zone = epsg % 100
    if epsg // 100 in (326, 327) and 1 <= zone <= 60:
        return _utm(epsg, zone, epsg // 100 == 327, _WGS84)
    if 25828 <= epsg <= 25838:
        return _utm(epsg, zone, False, _ETRS89)
    if find_spec("rasterio") is None:
        raise LidarError(
            f"EPSG:{epsg} is not a UTM zone of WGS 84 or ETRS89. Other coordinate systems "
            f"require rasterio. Run {install_command('lidarpool[geo]')}."
        )
    crs = import_module("rasterio.crs")
    try:
        return str(crs.CRS.from_epsg(epsg).to_wkt(version="WKT1_GDAL"))
    except crs.CRSError as error:
        raise LidarError(f"rasterio cannot convert EPSG:{epsg} to WKT 1: {error}.") from error


def _utm(epsg: int, zone: int, south: bool, system: _Geodetic) -> str:
    def code(number: int) -> str:
        return f'AUTHORITY["EPSG","{number}"]'

    geographic_code, datum_code, ellipsoid_code = map(code, system.codes)
    flattening = system.inverse_flattening
    spheroid = f'SPHEROID["{system.ellipsoid}",6378137,{flattening},{ellipsoid_code}]'
    values = {
        "latitude_of_origin": 0,
        "central_meridian": zone * 6 - 183,
        "scale_factor": 0.9996,
        "false_easting": 500_000,
        "false_northing": 10_000_000 if south else 0,
    }
    parameters = ",".join(f'PARAMETER["{key}",{value}]' for key, value in values.items())
    return (
        f'PROJCS["{system.name} / UTM zone {zone}{"S" if south else "N"}",'
        f'GEOGCS["{system.name}",DATUM["{system.datum}",{spheroid},{datum_code}],'
        f'PRIMEM["Greenwich",0,{code(8901)}],UNIT["degree",0.0174532925199433,{code(9122)}],'
        f'{geographic_code}],PROJECTION["Transverse_Mercator"],{parameters},'
        f'UNIT["metre",1,{code(9001)}],AXIS["Easting",EAST],AXIS["Northing",NORTH],{code(epsg)}]'
    )
