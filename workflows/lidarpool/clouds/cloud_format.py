"""What all cloud formats have in common: what a format can store, how it is written and read."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from lidarsim.base.arrays import AnyArray, Floats32
from lidarsim.base.errors import LidarError
from lidarsim.base.storage import Storage
from lidarsim.columns.cloud import CloudLike
from lidarsim.survey.survey import Survey
from lidarsim.sweeps.sweeps import Sweeps
from lidarview.picture_file import PictureContent

from .format_table import FormatRow
from .recording import Recording, RecordingSource

if TYPE_CHECKING:
    from .job_reader import JobReader
    from .writing import ExportSpec

# Frame in which a format stores points:
# - cloud: the frame of the cloud
# - world: the frame of the cloud, and readers expect all points in a single coordinate system
# - sweep: the sensor frame at the start of the sweep, with motion compensated
# - firing: the sensor frame at the firing of each point, or as sweep with the option `compensated`
# - none: the format stores measurements, such as ranges, instead of positions
Frame = Literal["cloud", "world", "sweep", "firing", "none"]
# Points, float32 (n, 3), meters in the sensor's axes, and {column: (n,)}, as the format holds them.
PointColumns = tuple[Floats32, dict[str, AnyArray]]


@dataclass(frozen=True)
class Entry:
    """A job in a data set.

    Number and name distinguish its files from files of further jobs.

    `values` are the varied values, by name.
    """

    number: int
    name: str
    split: str = ""
    values: Mapping[str, Any] = field(default_factory=dict)


class CloudFormat(ABC):
    """A point cloud in a format. Each format is a subclass.

    Class attributes state what the format can store. They can be read without the packages of the
    format, which are imported when they are used.

    Parameters
    ----------
    cloud
        Points to write.
    sweeps
        Sweeps of the points.
    entry
        The job of the points in a data set. By default, the cloud is not part of a data set.
    """

    row: ClassVar[FormatRow] = FormatRow("")  # files of the format, if it is a plug-in
    title: ClassVar[str] = ""  # proper name in sentences; by default, the name of the format
    by_sweep: ClassVar[bool] = False  # whether the points of each sweep are stored separately
    frame: ClassVar[Frame] = "cloud"  # frame in which points are stored
    # Columns that a cloud must have, in addition to `scan` of formats by sweep.
    required: ClassVar[tuple[str, ...]] = ()
    stored: ClassVar[tuple[str, ...] | None] = None  # columns that can be stored; None for all
    named: ClassVar[tuple[str, ...]] = ()  # columns that are also stored if classes have names
    options: ClassVar[tuple[str, ...]] = ()  # options of `ExportSpec` that few formats support
    actor_boxes: ClassVar[bool] = False  # whether the boxes of actors are stored
    for_scenes: ClassVar[bool] = False  # whether scenes can be made of its files
    file_pattern: ClassVar[str] = ""  # pattern of the names of the files in the format's folder
    # In data sets: path of a job's file or folder, with fields of `Entry`; whether a sweep is read
    # without opening a file of the whole job; and whether each sweep has files of rows of numbers.
    job_path: ClassVar[str] = ""
    separate_sweeps: ClassVar[bool] = False
    raw_sweeps: ClassVar[bool] = False
    # Returns scene and planned path, for formats that store these.
    content: Callable[[], PictureContent | None] = staticmethod(lambda: None)

    def __init__(self, cloud: CloudLike, sweeps: Sweeps, entry: Entry | None = None) -> None:
        self.cloud = cloud
        self.sweeps = sweeps
        self.entry = entry

    @abstractmethod
    def write(self, path: Path, spec: ExportSpec) -> float | None:
        """Write the cloud to a new file or folder.

        LidarError if the format cannot store the cloud; OSError if the file cannot be written.

        Returns
        -------
        The intensity that is stored as the highest integer, or None if the format has real numbers
        or the cloud has no intensities.
        """

    @classmethod
    def supports(cls, option: str) -> bool:
        """Return True if the format supports an option of `ExportSpec`."""
        if option == "compensated_actors":
            return cls.by_sweep and cls.frame != "none"
        return option in cls.options

    @classmethod
    def check_options(cls, spec: ExportSpec) -> None:
        """Raise LidarError if options that the format supports cannot be combined."""
        del spec

    @classmethod
    def option_columns(cls, spec: ExportSpec) -> tuple[str, ...]:
        """Return the columns that the options require and store in addition."""
        return ()

    @classmethod
    def required_columns(cls, spec: ExportSpec) -> tuple[str, ...]:
        """Return the columns that a cloud must have."""
        scan = ("scan",) if cls.by_sweep else ()
        required = (*scan, *cls.required, *cls.option_columns(spec))
        time = ("time",) if spec.compensated_actors and "time" not in required else ()
        return required + time

    @classmethod
    def optional_columns(cls, spec: ExportSpec, sweeps: Sweeps) -> tuple[str, ...]:
        """Return the columns that can be stored in addition to `stored`."""
        return cls.option_columns(spec) + (cls.named if sweeps.classes else ())

    @classmethod
    def survey_columns(cls, survey: Survey) -> tuple[str, ...]:
        """Return the columns that the survey's sensors require, or raise LidarError."""
        return ()

    @classmethod
    def survey_notes(cls, survey: Survey) -> list[str]:
        """Return notes for the user on what cannot be stored of a survey."""
        return []

    @classmethod
    def renamed(cls, sensors: Sequence[str]) -> list[str]:
        """Return a note if sensors of these names, "" without one, have others in the format."""
        return []

    @classmethod
    def path_of_job(cls, entry: Entry) -> str:
        """Return the path of a job's file or folder in a data set."""
        return cls.job_path.format(number=entry.number, name=entry.name)

    @classmethod
    def sweep_files(cls, job: JobReader, sweep: int) -> list[str]:
        """Return the names of the files of a sweep in a data set, the file of its points first."""
        return [cls.path_of_job(job.entry)]

    @classmethod
    def read_sweep(cls, job: JobReader, sweep: int) -> PointColumns:
        """Return the points of a sweep in a data set.

        Raises any exception if the points cannot be read.
        """
        raise NotImplementedError

    @classmethod
    def class_files(cls, classes: Mapping[int, str]) -> Mapping[str, bytes]:
        """Return the files of a data set that contain the names of the classes of all jobs."""
        return {}

    @classmethod
    def merge_jobs(
        cls, storage: Storage, manifests: Iterable[Mapping[str, Any]]
    ) -> dict[str, list[int]]:
        """Write further files that the jobs of a data set share, from the manifests of the jobs.

        Returns
        -------
        Class list to which the labels of a job must be renumbered (`renumbered`), by the name of
        the job. Jobs can have different classes.
        """
        deque(manifests, maxlen=0)
        return {}

    @classmethod
    def renumbered(
        cls, name: str, read: Callable[[str], bytes], before: Sequence[int], after: Sequence[int]
    ) -> bytes | None:
        """Return the content of a file with labels for other classes, or None for other files.

        `before` and `after` are the classes that the labels number.
        """
        return None

    @classmethod
    def open(cls, source: RecordingSource) -> Recording:
        """Open a file or folder as a recording.

        Raises LidarError if it is damaged, or if a choice is missing, for example of the sensor.
        """
        raise LidarError(f"{cls.title} files can be written, but not read.")
