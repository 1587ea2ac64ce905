"""Coordinate systems as well-known text, which LAS 1.4 names them by."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec

from ..base.errors import LidarpoolError

# Of systems with UTM zones: name, datum, ellipsoid, 1 / flattening, and their EPSG codes.
_WGS84 = ("WGS 84", "WGS_1984", "WGS 84", 298.257223563, (4326, 6326, 7030))
_ETRS89 = (
    "ETRS89", "European_Terrestrial_Reference_System_1989", "GRS 1980", 298.257222101,
    (4258, 6258, 7019),
)  # fmt: skip


def wkt(epsg: int) -> str:
    """Return the WKT 1 of an EPSG code: of UTM zones of WGS 84 and ETRS89, or through pyproj.

    Raises
    ------
    LidarpoolError
        If pyproj is missing, or knows no such system.
    """
    zone = epsg % 100
    if epsg // 100 in (326, 327) and 1 <= zone <= 60:
        return _utm(epsg, zone, epsg // 100 == 327, *_WGS84)
    if 25828 <= epsg <= 25838:
        return _utm(epsg, zone, False, *_ETRS89)
    if find_spec("pyproj") is None:
        raise LidarpoolError(
            f"EPSG:{epsg} is not a UTM zone of WGS 84 or ETRS89, and others need pyproj: "
            "pip install pyproj."
        )
    pyproj = import_module("pyproj")
    try:
        return str(pyproj.CRS.from_epsg(epsg).to_wkt("WKT1_GDAL"))
    except pyproj.exceptions.CRSError as error:
        raise LidarpoolError(f"pyproj cannot write EPSG:{epsg} as WKT 1: {error}.") from error


def _utm(
    epsg: int, zone: int, south: bool, name: str, datum: str, ellipsoid: str, flattening: float,
    codes: tuple[int, int, int],
) -> str:  # fmt: skip
    def code(number: int) -> str:
        return f'AUTHORITY["EPSG","{number}"]'

    geographic, of_datum, of_ellipsoid = map(code, codes)
    spheroid = f'SPHEROID["{ellipsoid}",6378137,{flattening},{of_ellipsoid}]'
    values = {
        "latitude_of_origin": 0,
        "central_meridian": zone * 6 - 183,
        "scale_factor": 0.9996,
        "false_easting": 500_000,
        "false_northing": 10_000_000 if south else 0,
    }
    parameters = ",".join(f'PARAMETER["{key}",{value}]' for key, value in values.items())
    return (
        f'PROJCS["{name} / UTM zone {zone}{"S" if south else "N"}",'
        f'GEOGCS["{name}",DATUM["{datum}",{spheroid},{of_datum}],'
        f'PRIMEM["Greenwich",0,{code(8901)}],UNIT["degree",0.0174532925199433,{code(9122)}],'
        f'{geographic}],PROJECTION["Transverse_Mercator"],{parameters},'
        f'UNIT["metre",1,{code(9001)}],AXIS["Easting",EAST],AXIS["Northing",NORTH],{code(epsg)}]'
    )
