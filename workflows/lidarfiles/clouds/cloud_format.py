"""Base class for cloud formats, which declares what a format can store and how to access it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

from lidarsim.columns.cloud import CloudLike
from lidarsim.errors import LidarError
from lidarsim.io.storage import Storage
from lidarsim.survey.survey import Survey
from lidarsim.sweeps.sweeps import Sweeps

from ..picture_file import PictureContent
from .format_options import FormatOptions
from .format_row import FormatRow
from .job_reader import Entry, JobReader, PointColumns
from .point_field import PointField
from .recording import PointCloud, Recording
from .recording_ref import RecordingRef

# Frame in which a format stores points:
# - cloud: same frame as the cloud
# - world: same frame as the cloud, but readers expect all points in a single coordinate system
# - sweep: sensor frame at the start of the sweep, with motion compensation
# - firing: sensor frame at the firing of each point, or like sweep with the option `compensated`
# - none: the format stores measurements such as ranges instead of positions
Frame = Literal["cloud", "world", "sweep", "firing", "none"]


class CloudFormat(ABC):
    """A point cloud that can be written in the format that a subclass defines.

    Class attributes and class methods state what the format can store, and class methods read its
    files. The attributes are available even if the packages that the format requires are not
    installed.

    Parameters
    ----------
    cloud
        Points to write.
    sweeps
        Sweeps to which the points belong.
    entry
        Job of a data set to which the points belong. None if they are not part of a data set.
    """

    row: ClassVar[FormatRow] = FormatRow("")  # files and packages of the format, in plug-ins
    title: ClassVar[str] = ""  # proper name for messages (default: name of the format)
    by_sweep: ClassVar[bool] = False  # whether the points of each sweep are stored separately
    frame: ClassVar[Frame] = "cloud"  # frame in which points are stored
    # Fields of a point, and the columns from which they are filled. A run adds these columns.
    fields: ClassVar[tuple[PointField, ...]] = ()
    other_columns: ClassVar[bool] = True  # whether columns without a field are stored as well
    # Columns that a cloud must have in addition to those of required fields. If `by_sweep` is true,
    # `scan` is required, too.
    required: ClassVar[tuple[str, ...]] = ()
    options: ClassVar[tuple[str, ...]] = ()  # supported options of `FormatOptions`
    actor_boxes: ClassVar[bool] = False  # whether bounding boxes of actors are stored
    for_scenes: ClassVar[bool] = False  # whether scenes can be created from files of the format
    file_pattern: ClassVar[str] = ""  # regular expression for the files in the format's folder
    # The following attributes only apply to data sets.
    job_path: ClassVar[str] = ""  # path of a job's file or folder, with fields of `Entry`
    separate_sweeps: ClassVar[bool] = False  # whether sweeps are read without opening a whole job
    raw_sweeps: ClassVar[bool] = False  # whether each sweep has its own files of binary rows
    # Function that returns the scene and the planned path, for formats that store them.
    content: Callable[[], PictureContent | None] = staticmethod(lambda: None)

    def __init__(self, cloud: CloudLike, sweeps: Sweeps, entry: Entry | None = None) -> None:
        self.cloud = cloud
        self.sweeps = sweeps
        self.entry = entry

    @abstractmethod
    def write(self, path: Path, spec: FormatOptions) -> float | None:
        """Write the cloud to a new file or folder.

        Returns
        -------
        The intensity that is stored as the largest integer, or None if intensities are stored as
        floats or the cloud has no intensities.

        Raises
        ------
        LidarError
            If the format cannot store the cloud.
        OSError
            If the file cannot be written.
        """

    @classmethod
    def supports(cls, option: str) -> bool:
        """Return whether the format supports an option of `FormatOptions`."""
        if option == "compensated_actors":
            return cls.by_sweep and cls.frame != "none"
        return option in cls.options

    @classmethod
    def check_options(cls, spec: FormatOptions) -> None:
        """Raise LidarError if options that the format supports cannot be combined."""
        del spec

    @classmethod
    def fields_for(cls, spec: FormatOptions) -> tuple[PointField, ...]:
        """Return the fields of a point with the options in `spec`."""
        return cls.fields

    @classmethod
    def required_columns(cls, spec: FormatOptions) -> tuple[str, ...]:
        """Return the columns that a cloud must have."""
        fields = [field for field in cls.fields_for(spec) if field.is_required]
        required = [*cls.required, *(name for field in fields for name in field.columns)]
        scan = ["scan"] if cls.by_sweep else []
        time = ["time"] if spec.compensated_actors else []
        return tuple(dict.fromkeys([*scan, *required, *time]))

    @classmethod
    def stored_columns(cls, spec: FormatOptions, sweeps: Sweeps) -> set[str] | None:
        """Return the columns that the format can store, or None if it can store all columns."""
        if cls.other_columns:
            return None
        return {
            name
            for field in cls.fields_for(spec)
            if sweeps.classes or not field.if_named
            for name in field.columns
        }

    @classmethod
    def survey_columns(cls, survey: Survey) -> tuple[str, ...]:
        """Return the columns that the sensors of a survey require in this format.

        Raises LidarError if the format does not support a sensor.
        """
        return ()

    @classmethod
    def survey_notes(cls, survey: Survey) -> list[str]:
        """Return notes for the user on survey data that the format cannot store."""
        return []

    @classmethod
    def renaming_notes(cls, sensors: Sequence[str]) -> list[str]:
        """Return notes for the user about sensors that the format stores under different names.

        The name of an unnamed sensor is an empty string.
        """
        return []

    @classmethod
    def path_of_job(cls, entry: Entry) -> str:
        """Return the path of a job's file or folder in a data set."""
        return cls.job_path.format(number=entry.number, name=entry.name)

    @classmethod
    def sweep_files(cls, job: JobReader, sweep: int) -> list[str]:
        """Return the names of a sweep's files in a data set, starting with the point file."""
        return [cls.path_of_job(job.entry)]

    @classmethod
    def read_sweep(cls, job: JobReader, sweep: int) -> PointColumns:
        """Read the points of a sweep in a data set.

        Exceptions of any type are reported as unreadable files.
        """
        raise NotImplementedError

    @classmethod
    def class_files(cls, classes: Mapping[int, str]) -> Mapping[str, bytes]:
        """Return the files of a data set that contain class names.

        `classes` are the classes of all jobs. Returns {file name: content}.
        """
        return {}

    @classmethod
    def merge_jobs(
        cls, storage: Storage, manifests: Iterable[Mapping[str, Any]]
    ) -> dict[str, list[int]]:
        """Write the files that all jobs of a data set share, given the manifests of the jobs.

        Implementations must iterate over all manifests, because the iteration writes the index of
        the data set.

        Returns
        -------
        The jobs whose labels must be renumbered (see `renumber_labels`), because jobs can have
        different classes. Maps the name of a job to the new list of classes.
        """
        deque(manifests, maxlen=0)
        return {}

    @classmethod
    def renumber_labels(
        cls, name: str, read: Callable[[str], bytes], before: Sequence[int], after: Sequence[int]
    ) -> bytes | None:
        """Renumber the labels in a label file.

        Returns the new content, or None if the file is not a label file. Labels are positions in a
        list of classes. This list is `before` in the file and `after` in the returned content.
        """
        return None

    @classmethod
    def open(cls, ref: RecordingRef) -> Recording | PointCloud:
        """Open a file or folder as a recording, or as a cloud if it has no sweeps.

        Raises
        ------
        LidarError
            If it is damaged, or if the user must make a choice, for example of a sensor.
        """
        raise LidarError(f"{ref.name} is in a format that can be written, but not read.")
