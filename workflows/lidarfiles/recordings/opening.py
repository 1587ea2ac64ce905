"""Open clouds and recordings in any supported format, and read them sweep by sweep."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from lidarsim.columns.cloud import Cloud
from lidarsim.errors import LidarError, MissingFileError
from lidarsim.io.input_files import read_input
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.files.cloud_formats import SCAN_READERS
from lidarsim.schema.checks import check_choice
from lidarsim.schema.vocabulary import UNITS_M
from lidarsim.words import join_names

from ..clouds.format_table import format_of_path, formats_of_endings
from ..clouds.recording import Recording, RecordingSource, SeveralSensorsError, open_cloud
from ..datasets.dataset import INDEX_FILE
from ..datasets.loader import sweeps
from ..parts.parts import StoredCloud

KINDS = (
    "the folder of a result or data set, a .ply, .pcd, .las, .laz, .e57, .parquet, .xyz, .txt, "
    ".asc, .csv, .pts, .ptx, .npy, .bin (KITTI, nuScenes), .pcap, .pcapng (Velodyne, Ouster) or "
    ".osf file, a ROS 2 bag, or a folder in KITTI, nuScenes, WebDataset or range image format"
)
_CONVERSIONS = {  # {ending of an unsupported format: advice}
    ".bag": "It is a ROS 1 bag. Convert it with rosbags-convert --src IN.bag --dst OUT.",
    ".db3": "It is part of a ROS 2 bag. Specify the folder that contains it.",
    **dict.fromkeys(
        (".mcap.zstd", ".mcap.zst", ".db3.zstd", ".db3.zst"),
        "It is a compressed file of a ROS 2 bag. Specify the folder that contains it and the file "
        "metadata.yaml.",
    ),
    ".rrd": "It is a Rerun recording. Open it with the `rerun` command.",
    **dict.fromkeys(
        (".osi", ".osi.gz"), "It is an OSI trace. Use it as the traffic of a scenario."
    ),
    **dict.fromkeys(
        (".glb", ".gltf", ".obj", ".stl"),
        "It is a mesh. Run a survey of it first, "
        "or use `lidarpool compare CLOUD MESH --survey mesh` to compare a cloud with it.",
    ),
}
# Extensions of files for which the user can set the unit.
_UNIT_SUFFIXES = (".las", ".laz", ".ply", *(ending for ending in SCAN_READERS if ending != ".bin"))


class UnknownFormatError(LidarError):
    """Raised when the format of a file or folder is not supported.

    `advice` contains sentences that suggest a remedy. It may be empty.
    """

    def __init__(self, name: str, advice: str) -> None:
        super().__init__(f"The format of {name} is not supported. {advice or f'Specify {KINDS}.'}")
        self.advice = advice


def open_sensors(source: str | Path, *, keep_noise: bool = False) -> dict[str, Recording]:
    """Open the recordings of all sensors or topics as {name: recording}.

    The name is empty if a single sensor has no name. If the source contains several sequences,
    which have different world frames, only the first sequence is opened.

    Raises the same errors as `open_recording`.
    """
    opened = partial(open_recording, source, keep_noise=keep_noise)
    try:
        recording = opened()
        return {recording.sensor: recording}
    except SeveralSensorsError as error:
        recordings = {name: opened(sensor=name) for name in error.names}
    sequences = list(dict.fromkeys(recording.sequence for recording in recordings.values()))
    if len(sequences) == 1:
        return recordings
    note = f"Only {sequences[0]}, the first of {len(sequences):,} sequences, is shown."
    return {
        name: replace(recording, notes=(*recording.notes, note))
        for name, recording in recordings.items()
        if recording.sequence == sequences[0]
    }


def open_recording(
    source: str | Path | Cloud | StoredCloud,
    sensor: str | None = None,
    intensity: str | None = None,
    *,
    name: str = "the cloud",
    unit: str | None = None,
    keep_noise: bool = False,
) -> Recording:
    """Open a recording or cloud in any format, and read it sweep by sweep.

    Parameters
    ----------
    source
        File or folder of a recording, a result or a data set, or a cloud in memory. A cloud in
        memory has sweeps only if it belongs to a result.
    sensor
        Name of the sensor, or topic in a bag. Required if there are several.
    intensity
        Column that contains the intensities. The default is ``intensity``.
    name
        Name used in messages if the source is a cloud in memory.
    unit
        Length unit of a .las, .laz, .ply, .pcd, .ptx, .pts, .npy or text file. Overrides the unit
        stated in the file. By default, files without a unit are read as meters.
    keep_noise
        Whether to include points that the file marks as withheld or classifies as noise.

    Returns
    -------
    Recording
        A sequence of `Sweep` objects, which are read when they are accessed. Large clouds without
        sweeps are divided into parts.

    Raises
    ------
    LidarError
        If the source does not exist or is not supported, if it contains several sensors and none is
        selected, or if its coordinate system distorts lengths.
    """
    if unit is not None:
        check_choice("unit", unit, UNITS_M)
    if isinstance(source, Cloud | StoredCloud):
        if unit is not None:
            raise LidarError(f"{name} is always in meters. Remove the unit {unit!r}.")
        return open_cloud(name, source, source.sweeps, sensor, intensity)
    path = Path(source)
    name = str(source)
    if unit is not None and path.suffix.lower() not in _UNIT_SUFFIXES:
        raise LidarError(
            f"{name} is always in meters. Remove the unit {unit!r}, which can only be set for "
            f"{join_names(_UNIT_SUFFIXES)} files."
        )
    opened = RecordingSource(path, name, sensor, intensity, unit)
    recording = replace(_open_path(opened), world_origin=_world_origin(path))
    if sensor and not opened.selected:
        raise LidarError(
            f"{name} does not name its sensor, so no sensor can be selected. Remove the sensor "
            f"{sensor!r}."
        )
    return replace(recording, noise_classes=None) if keep_noise else recording


def as_recording(
    recording: str | Path | Cloud | StoredCloud | Recording,
    sensor: str | None = None,
    intensity: str | None = None,
) -> Recording:
    """Return a recording, or open a source like `open_recording`.

    Raises
    ------
    LidarError
        In the same cases as `open_recording`, or if the recording is open, so that its sensor and
        its intensity column can no longer be chosen.
    """
    if not isinstance(recording, Recording):
        return open_recording(recording, sensor, intensity, name="the recording")
    for name, value in (("sensor", sensor), ("intensity", intensity)):
        if value is not None:
            raise LidarError(
                f"{recording.name} is already open. Pass `{name}` to `open_recording` instead."
            )
    return recording


def _world_origin(path: Path) -> Floats | None:
    """Return the origin that was added to the points of a result, or None if nothing was added."""
    folder = path if path.is_dir() else path.parent
    try:
        report = json.loads(read_input(folder / "report.json"))
        origin = np.array(report["parameters"]["world_origin"], np.float64)
    except (OSError, ValueError, TypeError, LookupError, LidarError):
        return None
    return origin if origin.shape == (3,) and origin.any() else None


def _open_path(source: RecordingSource) -> Recording:
    path = source.path
    if not path.exists():
        raise MissingFileError(f"{source.name} does not exist. Specify {KINDS}.")
    if path.is_file() and not path.stat().st_size:
        raise LidarError(f"{source.name} is empty (0 bytes). Specify {KINDS}.")
    if (path / INDEX_FILE).exists():
        return _open_data_set(source)
    if (cloud_format := format_of_path(path, source.name)) is not None:
        return cloud_format.open(source)
    if path.is_dir() and any(_is_bag_file(file) for file in path.iterdir()):
        raise UnknownFormatError(
            source.name,
            "It contains files of a ROS 2 bag, but not the file metadata.yaml. Create it with "
            "`ros2 bag reindex`, or specify one of the .mcap files.",
        )
    if path.is_dir() and (endings := sorted({file.suffix.lower() for file in _point_files(path)})):
        raise UnknownFormatError(
            source.name,
            f"It contains {join_names(endings)} files, which are not read as the sweeps of a "
            "recording. Specify one of the files, or store the sweeps as .pcd files in a folder.",
        )
    file_name = path.name.lower()
    advice = (text for ending, text in _CONVERSIONS.items() if file_name.endswith(ending))
    raise UnknownFormatError(source.name, next(advice, ""))


def _is_bag_file(file: Path) -> bool:
    return bool({".mcap", ".db3"} & {suffix.lower() for suffix in file.suffixes[-2:]})


def _point_files(folder: Path) -> list[Path]:
    """Return the files in a folder that can be opened one by one."""
    endings = {ending for ending in formats_of_endings() if ending}
    return [file for file in folder.iterdir() if file.suffix.lower() in endings and file.is_file()]


def _open_data_set(source: RecordingSource) -> Recording:
    saved = sweeps(source.path, sensors=None if source.sensor is None else [source.sensor])
    source.selected.add(source.sensor or "")
    return source.recording(
        len(saved),
        saved.__getitem__,
        compensated=saved.are_compensated(),
        fired=saved.read_fired if saved.have_firing_poses() else None,
        noise_classes=None,
    )
