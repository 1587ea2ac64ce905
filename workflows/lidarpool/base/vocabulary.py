"""Names and figures shared by scenario files, commands and functions; quick to import.

Help and completion of the command import no other module.
"""

from __future__ import annotations

BACKENDS = ("auto", "cuda", "embree", "numpy")
PICTURES = ("scene", "intensity", "cloud", "path")  # drawn pictures

# Metres in one of each unit.
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

WAIT_S = 10.0  # for partitions that are empty at the start of a run
QUEUE_S = 3600.0  # for either, where workers are jobs in a queue
PATIENCE_S = 60.0  # for partitions that become empty; a nanny needs a few seconds

# Formats that a cloud is exported to: the file or folder of each in that of a result, and the
# columns that it needs. Those that need `scan` store single sweeps.
FORMATS: dict[str, tuple[str, tuple[str, ...]]] = {
    "las": ("cloud.las", ()),
    "laz": ("cloud.laz", ()),
    "parquet": ("cloud.parquet", ()),
    "pcd": ("pcd", ("scan",)),
    "e57": ("cloud.e57", ("scan",)),
    "kitti": ("kitti", ("scan", "object", "intensity", "class")),
    "nuscenes": ("nuscenes", ("scan", "object", "channel", "intensity")),
    "mcap": ("cloud.mcap", ("scan", "object", "channel")),
    "rosbag2": ("rosbag2", ("scan", "object", "channel")),
}
# Point layouts of mcap and rosbag2, and the further columns that each needs.
LAYOUTS: dict[str, tuple[str, ...]] = {
    "velodyne": ("intensity", "time"),
    "autoware": ("intensity", "time", "azimuth", "elevation", "range"),
    "ouster": ("intensity", "time", "reflectivity", "range"),
}


def columns_needed(name: str, layout: str) -> tuple[str, ...]:
    """Names of the columns that a format needs, with a layout if it has layouts."""
    return FORMATS[name][1] + (LAYOUTS[layout] if name in ("mcap", "rosbag2") else ())
