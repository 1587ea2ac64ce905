"""Names and constants that scenario files, commands and functions share.

This module is quick to import. Command-line help and shell completion import no other module.
"""

from __future__ import annotations

BACKENDS = ("auto", "cuda", "tiles", "numpy")
# Objects that `lidarpool augment` can insert without a file.
INSERTIONS = ("car", "pedestrian")
# Built-in bodies and targets of `lidarpool mount`.
BODIES = ("saloon", "estate", "van")
TARGETS = ("pedestrian", "child", "car", "cyclist", "curb", "cone")
# Values of `lidarsim.sensor.optics.Mode`. A test compares them.
RETURN_MODES = ("strongest", "first", "last", "dual", "two_strongest", "all")
PICTURES = ("scene", "hits", "intensity", "cloud", "path")

# Names of the columns in `lidarsim.columns.table.TABLE`, in the same order. A test compares them.
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
    "flow_x",
    "flow_y",
    "flow_z",
    "flow_ego_x",
    "flow_ego_y",
    "flow_ego_z",
    "true_x",
    "true_y",
    "true_z",
    "red",
    "green",
    "blue",
)
COMPOSED_COLUMNS = ("rgb", "normals")  # colors in pictures that combine several columns

# Length of each unit in meters.
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

WAIT_S = 10.0  # time to wait for partitions without workers at the start of a run
QUEUE_S = 3600.0  # time to wait in both cases if the workers are jobs in a batch queue
PATIENCE_S = 60.0  # time to wait if a partition loses its workers; a nanny takes a few seconds

# EPSG codes of projections for world maps, such as Web Mercator (EPSG:3857). These Mercator and
# cylindrical projections preserve distances only along certain lines.
WORLD_EPSG = frozenset({3395, 3410, 3785, 3832, 3857, 3975, 4087, 4088, 6933, 32662, 54004})
OF_THE_WORLD = (
    "a world map projection that does not preserve distances. Use a UTM zone or a national grid"
)
