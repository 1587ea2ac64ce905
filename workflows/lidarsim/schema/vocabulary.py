"""Names and figures shared by scenario files, commands and functions, quick to import.

Help and completion of the command import no other module.
"""

from __future__ import annotations

BACKENDS = ("auto", "cuda", "tiles", "numpy")
PICTURES = ("scene", "hits", "intensity", "cloud", "path")  # drawn pictures

# Names of the columns of `lidarsim.columns.table.TABLE`, in its order; a test compares both.
ALWAYS_COLUMNS = ("scan", "x", "y", "z", "channel", "object")
OPTIONAL_COLUMNS = (
    "ray",
    "time",
    "azimuth",
    "elevation",
    "range",
    "intensity",
    "reflectance",
    "reflectivity",
    "signal",
    "radial_velocity",
    "amplitude",
    "pulse_width",
    "return_number",
    "returns",
    "class",
    "material",
    "cause",
    "sensor",
    "triangle",
    "normal_x",
    "normal_y",
    "normal_z",
    "incidence_deg",
    "origin_x",
    "origin_y",
    "origin_z",
    "red",
    "green",
    "blue",
)
COMPOSED_COLUMNS = ("rgb", "normals")  # colors that pictures make of several columns

# Meters in each unit.
UNITS_M = {
    "um": 1e-6,
    "mm": 1e-3,
    "cm": 1e-2,
    "dm": 1e-1,
    "m": 1.0,
    "km": 1e3,
    "in": 0.0254,
    "ft": 0.3048,
    "yd": 0.9144,
    "mi": 1609.344,
}

WAIT_S = 10.0  # wait for partitions that are empty at the start of a run
QUEUE_S = 3600.0  # limit for both waits, if workers are jobs in a queue
PATIENCE_S = 60.0  # wait for partitions that become empty; a nanny needs a few seconds

# EPSG codes of systems for maps of the whole Earth, whose meters are true along a line at most:
# Mercator and cylindrical projections, such as Web Mercator, EPSG:3857.
WORLD_EPSG = frozenset({3395, 3410, 3785, 3832, 3857, 3975, 4087, 4088, 6933, 32662, 54004})
OF_THE_WORLD = (
    "a world map projection that does not preserve distances. Use a UTM zone or a national grid"
)
