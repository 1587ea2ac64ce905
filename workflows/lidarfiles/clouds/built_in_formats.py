"""Table of the built-in cloud formats, with their files, required packages and classes.

The module is fast to import because the command line reads it for help and completion. Only
`FormatRow.load` imports the class of a format.
"""

from __future__ import annotations

from typing import Any

from .format_row import FormatRow

_LAS: dict[str, Any] = {"packages": ("laspy", "lazrs"), "extra": "las"}
_OSI: dict[str, Any] = {"packages": ("betterosi",), "extra": "osi"}
_ROS: dict[str, Any] = {"packages": ("rosbags",), "extra": "ros"}
FORMATS = {
    "ply": FormatRow("cloud.ply", "lidarfiles.clouds.ply:PLY", (".ply",), ("cloud.ply",)),
    "las": FormatRow("cloud.las", "lidarfiles.clouds.las:LAS", (".las",), **_LAS),
    "laz": FormatRow("cloud.laz", "lidarfiles.clouds.las:LAZ", (".laz",), **_LAS),
    "parquet": FormatRow(
        "cloud.parquet",
        "lidarfiles.clouds.parquet:Parquet",
        (".parquet",),
        ("**/*.parquet",),
        packages=("pyarrow",),
        extra="parquet",
    ),
    "pcd": FormatRow("pcd", "lidarfiles.clouds.pcd:PCD", (".pcd",), ("*.[pP][cC][dD]",)),
    "e57": FormatRow(
        "cloud.e57",
        "lidarfiles.clouds.e57:E57",
        (".e57",),
        packages=("pye57",),
        extra="e57",
    ),
    "kitti": FormatRow(
        "kitti",
        "lidarfiles.clouds.kitti:KITTI",
        (".bin",),
        ("sequences/*/velodyne", "velodyne/*.bin", "velodyne_points/data/*.bin", "*.bin"),
    ),
    "nuscenes": FormatRow(
        "nuscenes",
        "lidarfiles.clouds.nuscenes:NuScenes",
        folders=("v1.0-*/sample_data.json", "sample_data.json"),
    ),
    "webdataset": FormatRow(
        "webdataset", "lidarfiles.clouds.webdataset:WebDataset", (".tar",), ("**/*.tar",)
    ),
    "images": FormatRow("images", "lidarfiles.clouds.images:ImageFolder", folders=("*/*.npz",)),
    "pcap": FormatRow(
        "packets", "lidarfiles.clouds.packets:PacketCapture", (".pcap", ".pcapng", ".osf")
    ),
    "rrd": FormatRow("cloud.rrd", "lidarfiles.clouds.rrd:RRD", packages=("rerun",), extra="rerun"),
    # Readers derive the message type from the suffix "_sd" in the file name.
    "osi": FormatRow("cloud_sd.osi", "lidarfiles.clouds.osi:OSI", **_OSI),
    "osi_mcap": FormatRow("cloud_osi.mcap", "lidarfiles.clouds.osi:OSIInMCAP", **_OSI),
    "mcap": FormatRow("cloud.mcap", "lidarfiles.clouds.ros.bags:MCAP", (".mcap",), **_ROS),
    "rosbag2": FormatRow(
        "rosbag2", "lidarfiles.clouds.ros.bags:Rosbag2", folders=("metadata.yaml",), **_ROS
    ),
}
READ_ONLY = FormatRow(
    "",
    "lidarfiles.clouds.text_and_arrays:TextFormats",
    suffixes=(".xyz", ".txt", ".asc", ".csv", ".pts", ".ptx", ".npy"),
)
DATA_SETS = {  # {format of a data set: format of its jobs}
    "folder": "ply",
    "parquet": "parquet",
    "kitti": "kitti",
    "nuscenes": "nuscenes",
    "webdataset": "webdataset",
    "images": "images",
    "mcap": "mcap",
}
EXPORTS = tuple(name for name in FORMATS if name != "ply")  # results always contain a .ply file
# Point layouts in mcap and rosbag2 (`ros/layouts.py`).
LAYOUTS = ("velodyne", "autoware", "ouster", "images", "livox", "hesai", "robosense")
