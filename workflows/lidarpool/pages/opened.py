"""Open files that lidarpool reads or writes in the viewer, and provide them for download.

Results, clouds, recordings, exports, meshes and scenarios are opened as one view each. A data set
is opened as a list of jobs with one view each (see `job_list`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from lidarfiles.datasets.dataset import INDEX_FILE
from lidarscenes.files.formats import ROBOTS
from lidarsim.errors import LidarError, MissingFileError, explain_os_errors
from lidarsim.io.input_files import open_input
from lidarsim.io.storage import Storage
from lidarsim.scene.files.mesh_formats import format_of
from lidarsim.scene.files.text_cloud import is_text_raster
from lidarview.viewer.result_views import join_views, open_result
from lidarview.viewer.view import CLOUD, ProgressiveView, View

from .downloads import downloads

if TYPE_CHECKING:  # The modules of recordings are only imported when a recording is opened.
    from .recorded import OnPart

_TRAJECTORIES = (".csv", ".tum", ".txt")  # suffixes of files that may be trajectories
_TRAJECTORY_ADVICE = "set `trajectory: FILE` in a scenario"
_HEADER_BYTES = 1 << 16  # maximum size of a .ply header, which names the elements


def is_data_set(place: Path | Storage) -> bool:
    """Return whether a folder or URL contains a complete or incomplete data set of jobs."""
    if isinstance(place, Storage):
        with explain_os_errors(f"{place.url} cannot be read"):
            return INDEX_FILE in place.entries()
    return not (place / CLOUD).exists() and (
        (place / INDEX_FILE).exists() or (place / ".jobs").is_dir()
    )


def open_views(paths: Sequence[Path], **options: Any) -> View:
    """Open several files and folders in a single view.

    Parameters
    ----------
    paths
        Files and folders, whose coordinates must refer to the same frame.
    **options
        Options of `open_view`.

    Raises
    ------
    LidarError
        If a path cannot be opened, or if its points are in sensor coordinates and there are other
        paths.
    """
    return join_views(paths, [open_view(path, **options) for path in paths])


def open_view(
    path: Path,
    *,
    keep_noise: bool = False,
    of_mesh: Mapping[str, Any] = MappingProxyType({}),
    report: Callable[[str], None] = lambda note: None,
    on_part: OnPart = lambda *_: None,
) -> View:
    """Open a result, cloud, recording, exported file or folder, mesh or scenario.

    Parameters
    ----------
    path
        File or folder.
    keep_noise
        Whether to include points that a cloud marks as withheld or classifies as noise.
    of_mesh
        Unit and up axis of a mesh.
    report
        Function that is called with each note on a scene.
    on_part
        Function that is called with each part of a cloud from another program.

    Raises
    ------
    LidarError
        If the path contains an unfinished run, or if its format is not supported.
    """
    if not path.exists():
        raise MissingFileError(
            f"{path} does not exist. Specify a result, a cloud, a mesh or a scenario."
        )
    title = f"{path.resolve().name} - lidarpool"
    if _is_previewed(path):
        return _preview(path, of_mesh, report)
    if of_mesh:
        raise LidarError(
            f"{path} is not a mesh. Remove `--{next(iter(of_mesh)).replace('_', '-')}`, which "
            "can only be used with meshes."
        )
    if path.is_dir():
        if (path / CLOUD).exists():
            return open_result(path, downloads())
        refuse_unfinished(path)
        return _open_recorded(path, title, keep_noise, on_part)
    suffix = path.suffix.lower()
    if suffix == ".ply":
        try:
            view = open_result(path, downloads())
        except LidarError:  # a text file, or written by another program
            return _open_recorded(path, title, keep_noise, on_part)
        if not len(view.points):
            raise LidarError(f"{path} contains no points.")
        return view
    return _open_recorded(path, title, keep_noise, on_part)


def _is_previewed(path: Path) -> bool:
    """Return whether the path is that of a scenario or a mesh.

    Raise LidarError if the file cannot be read.
    """
    suffix = path.suffix.lower()
    if path.is_dir():
        return False
    if suffix in (".yaml", ".yml", *ROBOTS):
        return True
    if suffix == ".ply":
        return _has_faces(path)
    with explain_os_errors(f"{path} cannot be read"):
        if suffix == ".asc" and not is_text_raster(path):
            return False
    mesh_format = format_of(path)
    return mesh_format is not None and not mesh_format.advice


# The modules of recordings, scenarios and runs are imported lazily, which shows the first points of
# a result two seconds earlier.


def _open_recorded(path: Path, title: str, keep_noise: bool, on_part: OnPart) -> View:
    from lidarfiles.recordings.opening import UnknownFormatError, open_sensors

    from .recorded import recorded_view

    may_be_trajectory = path.suffix.lower() in _TRAJECTORIES
    try:
        sensors = open_sensors(path, keep_noise=keep_noise)
        return recorded_view(sensors, title, downloads(), on_part)
    except UnknownFormatError as error:
        advice = f"{error.advice} " if error.advice else ""
        if may_be_trajectory:
            advice = f"If it is a trajectory, {_TRAJECTORY_ADVICE}. "
        raise LidarError(
            f"The format of {path} is not supported. {advice}Specify a result, data set, "
            "cloud, recording, scenario or mesh in a format that `lidarpool view --help` "
            "lists."
        ) from error
    except LidarError as error:
        if not may_be_trajectory:
            raise
        raise LidarError(f"{error} If it is a trajectory, {_TRAJECTORY_ADVICE}.") from error


def growing_view(path: Path, *, keep_noise: bool = False) -> ProgressiveView | None:
    """Return a view of a large .las or .laz file, to which points are added as they are read.

    Return None for other files and folders.

    Raises
    ------
    LidarError
        If the file cannot be read.
    """
    if path.suffix.lower() not in (".las", ".laz") or not path.is_file():
        return None
    from lidarfiles.clouds.recording import PointCloud
    from lidarfiles.recordings.opening import open_recording

    from . import recorded

    recording = open_recording(path, keep_noise=keep_noise)
    is_large = (recording.info.point_count or 0) >= recorded.LARGE_POINTS
    if not isinstance(recording, PointCloud) or not is_large:
        return None
    title = f"{path.resolve().name} - lidarpool"
    return recorded.growing_view(
        recording, title, lambda on_part: open_view(path, keep_noise=keep_noise, on_part=on_part)
    )


def _preview(path: Path, of_mesh: Mapping[str, Any], report: Callable[[str], None]) -> View:
    from .preview import scenario_view

    return scenario_view(path, of_mesh, report)


def _has_faces(path: Path) -> bool:
    with open_input(path) as file:
        header = file.read(_HEADER_BYTES).partition(b"end_header")[0]
    lines = (line.split() for line in header.splitlines())
    return any(line[:2] == [b"element", b"face"] and line[2:] != [b"0"] for line in lines)


def refuse_unfinished(path: Path) -> None:
    """Raise LidarError if a folder contains an unfinished run but no cloud."""
    from ..run.store.database import FILE
    from ..run.store.run_store import RUN_FOLDER

    if not (path / CLOUD).exists() and (path / RUN_FOLDER / FILE).exists():
        raise LidarError(
            f"{path} contains an unfinished run. Continue it with `lidarpool run --resume`, "
            "and use `--live` to show its points."
        )
