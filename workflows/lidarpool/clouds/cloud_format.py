"""What all cloud formats have in common: what a format can store, how it is written and read."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from lidarsim.base.arrays import AnyArray, Floats32
from lidarsim.columns.cloud import CloudLike
from lidarsim.survey.survey import Survey
from lidarsim.sweeps.sweeps import Sweeps
from lidarview.picture_file import PictureContent

from .format_table import FormatRow

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

    The class attributes state what the format can store. They can be read without the packages
    that write the format, which are imported when they are used.

    Parameters
    ----------
    cloud
        Points to write.
    sweeps
        Sweeps of the points.
    entry
        The job of the points in a data set. By default, the cloud is not part of a data set.

    Attributes
    ----------
    row
        File and extensions of the format. Only plug-ins state them in the class.
    title
        Proper name of the format in sentences. By default, the name of the format.
    by_sweep
        Whether the points of each sweep are stored separately.
    frame
        Frame in which points are stored.
    required
        Names of the columns that a cloud must have, in addition to `scan` of formats by sweep.
    stored
        Names of the columns that can be stored, or None for all columns.
    named
        Names of the columns that can only be stored if classes have names.
    options
        Names of the options of `ExportSpec` that only some formats support, without
        `compensated_actors`, which all formats support that store positions by sweep.
    actor_boxes
        Whether the boxes of actors are stored.
    file_pattern
        Pattern of the names of the files in the folder of the format.
    job_path
        Path of a job's file or folder in a data set, as a format string with fields of `Entry`.
    separate_sweeps
        Whether a sweep in a data set is read without opening a file of the whole job.
    raw_sweeps
        Whether each sweep in a data set has separate files, which contain rows of numbers.
    content
        Returns the scene and the planned path, for formats that can store these.
    """

    row: ClassVar[FormatRow] = FormatRow("")
    title: ClassVar[str] = ""
    by_sweep: ClassVar[bool] = False
    frame: ClassVar[Frame] = "cloud"
    required: ClassVar[tuple[str, ...]] = ()
    stored: ClassVar[tuple[str, ...] | None] = None
    named: ClassVar[tuple[str, ...]] = ()
    options: ClassVar[tuple[str, ...]] = ()
    actor_boxes: ClassVar[bool] = False
    file_pattern: ClassVar[str] = ""
    job_path: ClassVar[str] = ""
    separate_sweeps: ClassVar[bool] = False
    raw_sweeps: ClassVar[bool] = False
    content: Callable[[], PictureContent | None] = staticmethod(lambda: None)

    def __init__(self, cloud: CloudLike, sweeps: Sweeps, entry: Entry | None = None) -> None:
        self.cloud = cloud
        self.sweeps = sweeps
        self.entry = entry

    @abstractmethod
    def write(self, path: Path, spec: ExportSpec) -> float | None:
        """Write the cloud to a new file or folder.

        Returns
        -------
        The intensity that is stored as the highest integer, or None if the format has real numbers
        or the cloud has no intensities.

        Raises
        ------
        LidarError
            If the format cannot store the cloud.
        OSError
            If the file cannot be written.
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
        """Return the names of the columns that the options require and store in addition."""
        return ()

    @classmethod
    def required_columns(cls, spec: ExportSpec) -> tuple[str, ...]:
        """Return the names of the columns that a cloud must have."""
        scan = ("scan",) if cls.by_sweep else ()
        required = (*scan, *cls.required, *cls.option_columns(spec))
        return (
            (*required, "time") if spec.compensated_actors and "time" not in required else required
        )

    @classmethod
    def optional_columns(cls, spec: ExportSpec, sweeps: Sweeps) -> tuple[str, ...]:
        """Return the names of the columns that can be stored in addition for a survey's sweeps."""
        return cls.option_columns(spec) + (cls.named if sweeps.classes else ())

    @classmethod
    def survey_columns(cls, survey: Survey) -> tuple[str, ...]:
        """Return the names of the columns that the format requires from a survey's sensors.

        Raises LidarError if the format cannot store the data of a sensor.
        """
        return ()

    @classmethod
    def survey_notes(cls, survey: Survey) -> list[str]:
        """Return notes for the user on what the format cannot store of a survey."""
        return []

    @classmethod
    def renamed(cls, sensors: Sequence[str]) -> list[str]:
        """Return a note if sensors with these names, "" without a name, have other names."""
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
    def open(cls, source: Any) -> Any:
        """Open the file or folder of a `RecordingSource` as a `Recording`."""
        raise NotImplementedError

    @classmethod
    def read_points(cls, path: Path) -> Any:
        """Return the points of a file as `FilePoints`.

        Raises ValueError for a damaged file.
        """
        raise NotImplementedError
