"""Write clouds in any format.

A file or folder is either written completely or not at all.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim.columns.cloud import Cloud, CloudLike
from lidarsim.columns.table import SCAN
from lidarsim.environment.extras import install_command
from lidarsim.errors import LidarError, MissingFileError, explain_os_errors
from lidarsim.io.storage import Storage
from lidarsim.schema.checks import check_fields
from lidarsim.schema.value_texts import one_line
from lidarsim.survey.survey import Survey
from lidarsim.sweeps.sweeps import Sweeps
from lidarsim.words import join_alternatives, join_names

from ..parts.parts import StoredCloud
from ..picture_file import PictureContent
from ..work.publishing import publishing
from .built_in_formats import FORMATS
from .cloud_format import CloudFormat
from .format_options import FormatOptions
from .format_row import FormatRow
from .format_table import format_row, load_format
from .multi_file_format import MultiFileFormat, RangeWorkers
from .point_field import OMITTED, PointField
from .return_numbers import known_columns

_ENDINGS = {Path(row.file).suffix: name for name, row in FORMATS.items() if "." in row.file}
# Columns whose omission is always noted, and columns with the strength of a return.
_ALWAYS = ("channel", "object")
_STRENGTHS = {"intensity", "reflectivity", "signal"}
# Options that only some formats support.
_OPTIONS = (
    "layout", "compensated", "compensated_actors", "pose_rate_hz", "intensity_full_scale",
    "organized",
)  # fmt: skip


@dataclass(frozen=True)
class ExportSpec(FormatOptions):
    """An export format with its options.

    In YAML, the name of the format is sufficient.
    """

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)
        for option in _OPTIONS:  # LidarError for an unknown format
            is_set = getattr(self, option) != type(self).__dataclass_fields__[option].default
            if is_set and not self.cloud_format.supports(option):
                choices = [name for name in FORMATS if load_format(name).supports(option)]
                such = " formats that store single sweeps:" * (option == "compensated_actors")
                raise LidarError(
                    f"The format {self.format} does not support `{option}`. It can only be set "
                    f"for{such} {join_names(choices)}."
                )
        self.cloud_format.check_options(self)

    @classmethod
    def from_entry(cls, entry: str | Mapping[str, Any]) -> ExportSpec:
        """Create a specification from an entry of `output.write` in a scenario."""
        try:
            return cls(entry) if isinstance(entry, str) else cls(**entry)
        except TypeError as error:
            raise LidarError(
                f"{entry!r} does not specify a format. Use a format name or a mapping such as "
                "{'format': name, 'layout': name}."
            ) from error

    @property
    def row(self) -> FormatRow:
        """Row of the format, from the table or from a plug-in."""
        return format_row(self.format)

    @property
    def cloud_format(self) -> type[CloudFormat]:
        """Class of the format."""
        return load_format(self.format)

    @property
    def has_many_files(self) -> bool:
        """Whether the format has many files, which workers can write."""
        return issubclass(self.cloud_format, MultiFileFormat)

    @property
    def title(self) -> str:
        """Proper name of the format for messages."""
        return self.cloud_format.title or self.format

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the columns that a cloud must have."""
        return self.cloud_format.required_columns(self)

    @property
    def added(self) -> tuple[str, ...]:
        """Names of the columns that a run computes for fields of the format without being asked.

        They include the columns that a cloud must have.
        """
        fields = self.cloud_format.fields_for(self)
        names = (name for field in fields if not field.on_request for name in field.columns)
        return tuple(dict.fromkeys((*self.needs, *names)))

    def columns_for(self, survey: Survey) -> tuple[str, ...]:
        """Return the names of the columns that the simulation of a survey knows for the format.

        They are `added`, without classes that no material has or that cannot be stored, and the
        columns that the sensors require in the format. Raises LidarError if the format does not
        support a sensor.
        """
        has_classes = any(material.semantic_class for material in survey.materials)
        only_named = "class" in self._only_named and not survey.classes
        unknown = {"class"} if only_named or not has_classes else set()
        names = (name for name in self.added if name in self.needs or name not in unknown)
        return (*names, *self.cloud_format.survey_columns(survey))

    @property
    def _only_named(self) -> set[str]:
        """Names of the columns that the format stores only if classes have names."""
        fields = self.cloud_format.fields_for(self)
        return {name for field in fields if field.if_named for name in field.columns}

    def configure_sweeps(self, sweeps: Sweeps) -> Sweeps:
        """Set how sweeps position their points, according to the options of the format."""
        return replace(sweeps, actors_at_start=True) if self.compensated_actors else sweeps

    def unsupported_columns(self, cloud: CloudLike, sweeps: Sweeps) -> list[str]:
        """Return the names of the columns that the format cannot store."""
        stored = self.cloud_format.stored_columns(self, sweeps)
        names = (column.name for column in cloud.table)
        if stored is None:
            return [name for name in names if name == "time" and self.compensated]
        return [name for name in names if name not in stored]

    def empty_fields(
        self, cloud: CloudLike, sweeps: Sweeps, survey: Survey | None = None
    ) -> list[PointField]:
        """Return the fields that a run would fill, but whose columns the cloud does not contain.

        Columns that the simulation of `survey` does not know, such as classes that no material has,
        are ignored.
        """
        known = known_columns([column.name for column in cloud.table], sweeps)
        if survey is not None:
            known |= {*self.added} - {*self.columns_for(survey)}
        return [
            field
            for field in self.cloud_format.fields_for(self)
            if not (field.on_request or field.is_required or known >= {*field.columns})
            and (sweeps.classes or not field.if_named)
        ]

    def describe_empty_fields(
        self,
        cloud: CloudLike,
        sweeps: Sweeps,
        survey: Survey | None = None,
        source: str = "the cloud",
    ) -> list[str]:
        """Describe what the format stores in the fields that `empty_fields` returns.

        The result contains a text such as "stores 0 as GPS time, because the cloud has no column
        time" for each stored value. `source` is the name of the cloud.
        """
        fields = self.empty_fields(cloud, sweeps, survey)
        present = {column.name for column in cloud.table}
        texts = []
        for stored in dict.fromkeys(field.missing for field in fields):
            group = [field for field in fields if field.missing == stored]
            names = (name for field in group for name in field.columns if name not in present)
            columns = dict.fromkeys(names)
            verb = "omits" if stored == OMITTED else f"stores {stored} as"
            noun = "column" if len(columns) == 1 else "columns"
            texts.append(
                f"{verb} {join_names([field.name for field in group])}, because {source} has no "
                f"{noun} {join_alternatives([*columns])}"
            )
        return texts

    def notes(
        self,
        cloud: CloudLike,
        sweeps: Sweeps,
        requested: Collection[str] | None = None,
        survey: Survey | None = None,
    ) -> list[str]:
        """Return notes for the user about differences between the cloud and the file.

        `requested` are the columns that the user requested, or None if this is unknown. There is no
        note about the omission of columns that only exist because another format requires them.
        `survey` is the survey of the cloud, or None if it is unknown.
        """
        unsupported_columns = [
            name
            for name in self.unsupported_columns(cloud, sweeps)
            if self._is_missed(name, requested)
        ]
        unnamed = [name for name in unsupported_columns if name in self._only_named]
        strengths = [name for name in self.needs if name in _STRENGTHS]
        replaced = [name for name in unsupported_columns if strengths and name in _STRENGTHS]
        unsupported = ", ".join(
            name for name in unsupported_columns if name not in unnamed + replaced
        )
        notes = [f"{self.title} cannot store {unsupported}"] if unsupported else []
        if replaced:
            notes.append(
                f"{self.title} stores {join_names(strengths)} instead of {join_names(replaced)}"
            )
        notes += [
            (
                f"{self.title} can store {name} only if classes have names. Set `classes: {{1: "
                "ground, …}`; see docs/how-to/labels.md"
            )
            for name in unnamed
        ]
        notes += [
            f"{self.title} {text}. Run the survey again with `output: {{write: [{self._entry}]}}`"
            for text in self.describe_empty_fields(cloud, sweeps, survey)
        ]
        notes += self.frame_notes(sweeps.coordinates)
        return notes + self.cloud_format.renaming_notes(sweeps.sensors)

    def _is_missed(self, name: str, requested: Collection[str] | None) -> bool:
        if name in ("scan", "sensor"):  # sweeps and sensors are separate files, scans or topics
            return False
        if requested is not None:
            return name in (*_ALWAYS, "class") or name in requested
        return name != "ray" and name not in _STRENGTHS

    def frame_notes(self, coordinates: str) -> list[str]:
        """Return a note if readers of the format expect coordinates in a different frame."""
        if coordinates != "sensor":
            return []
        frame = self.cloud_format.frame
        if frame == "world":
            return [
                (
                    f"readers of {self.format} expect all points in a single coordinate system, "
                    "but with `coordinates: sensor`, each point is in the sensor frame at its "
                    "firing. Set `cloud.coordinates: world`"
                )
            ]
        if self.compensated or frame == "sweep":
            return [
                (
                    f"{self.title} stores motion-compensated points, so all points are "
                    "transformed to the sensor frame at the start of the sweep, although "
                    "`cloud.coordinates` is `sensor`"
                )
            ]
        return []

    @property
    def is_installed(self) -> bool:
        """Whether the packages that the format requires are installed in this environment."""
        return not self.row.missing_packages

    def check_installed(self) -> None:
        """Raise LidarError if a package that the format requires is not installed."""
        if missing := self.row.missing_packages:
            needs = [f"lidarpool[{self.row.extra}]"] if self.row.extra else missing
            command = install_command(*needs)
            raise LidarError(
                f"The format {self.format} requires {join_names(missing)}. Run {command}."
            )

    def check(self, path: Path, cloud: CloudLike, *, overwrite: bool = False) -> None:
        """Raise LidarError unless `write` can write the cloud to a path."""
        self.check_installed()
        if not path.parent.is_dir():
            raise MissingFileError(f"The folder {path.parent} does not exist. Create it first.")
        if path.exists() and not overwrite:
            raise LidarError(f"{path} already exists. Use another path, or pass `--overwrite`.")
        if path.name == self.row.file:
            check_foreign_files(Storage.at(path.parent), [self.format])
        self.check_columns(cloud)

    def check_columns(self, cloud: CloudLike) -> None:
        """Raise LidarError if a cloud lacks columns that the format requires."""
        cloud_columns = {column.name for column in cloud.table}
        if missing := [name for name in self.needs if name not in cloud_columns]:
            has_layouts = self.cloud_format.supports("layout")
            with_layout = f" with the layout {self.layout}" if has_layouts else ""
            entry = f"`output: {{write: [{self._entry}]}}`"
            lacks = join_names(missing)
            columns = "column" if len(missing) == 1 else "columns"
            raise LidarError(
                f"The format {self.format}{with_layout} requires the {columns} {lacks}, which the "
                f"cloud does not contain. Run the survey again with {entry}, or add {lacks} to "
                "`cloud.columns`."
            )

    @property
    def _entry(self) -> str:
        """Entry of `output.write` that requests the columns of the format, as YAML."""
        has_layouts = self.cloud_format.supports("layout")
        options = {
            "layout": self.layout if has_layouts and self.layout != "velodyne" else "",
            "organized": self.organized,
            "compensated": self.compensated,
            "compensated_actors": self.compensated_actors,
        }
        set_options = {name: value for name, value in options.items() if value}
        words = [f"{name}: {str(value).lower()}" for name, value in set_options.items()]
        return f"{{{', '.join([f'format: {self.format}', *words])}}}" if words else self.format

    def write(
        self,
        path: Path,
        cloud: CloudLike,
        sweeps: Sweeps,
        *,
        overwrite: bool = False,
        workers: RangeWorkers | None = None,
        content: Callable[[], PictureContent | None] = lambda: None,
    ) -> float | None:
        """Write a cloud to a file or folder, completely or not at all.

        Points are read in order, one chunk at a time.

        Parameters
        ----------
        path
            File or folder to write.
        cloud, sweeps
            Points to write, and the sweeps to which they belong.
        overwrite
            Whether to replace an existing file or folder.
        workers
            Function that writes ranges of a multi-file format on workers. Ranges that it does not
            write are written by this process.
        content
            Function that returns the scene and the planned path, for formats that store them.

        Returns
        -------
        The intensity that is stored as the largest integer, or None (see `CloudFormat.write`).

        Raises
        ------
        LidarError
            If a package or column is missing, or if the file exists or cannot be written.
        """
        full_scale: float | None = None
        with explain_os_errors(f"{path} cannot be written"):
            self.check(path, cloud, overwrite=overwrite)
            with publishing(path) as folder:
                # The file has its final name, because bags contain the name of their file.
                staged = folder / path.name
                output = self.cloud_format(cloud, self.configure_sweeps(sweeps))
                if isinstance(output, MultiFileFormat):
                    output.write(staged, self, workers)
                else:
                    output.content = content
                    full_scale = output.write(staged, self)
        return full_scale

    def write_to_storage(
        self, storage: Storage, cloud: CloudLike, sweeps: Sweeps, workers: RangeWorkers | None
    ) -> None:
        """Write a multi-file format directly to storage.

        If this fails, all files that have been written are removed.
        """
        file = self.row.file
        folder = Storage(storage.path(file))
        with explain_os_errors(f"{folder} cannot be written"):
            try:
                output = self.cloud_format(cloud, self.configure_sweeps(sweeps))
                assert isinstance(output, MultiFileFormat)
                output.write_to(folder, self, workers)
            except BaseException:
                with suppress(OSError):
                    storage.discard(file)
                raise


def with_format_columns(survey: Survey, specs: Iterable[ExportSpec]) -> Survey:
    """Return a survey with the columns that the simulation knows for these formats.

    Raises LidarError if a format does not support a sensor.
    """
    names = dict.fromkeys(name for spec in specs for name in spec.columns_for(survey))
    has_all = names.keys() <= {SCAN.name, *(column.name for column in survey.stored_columns)}
    return survey if has_all else replace(survey, columns=(*survey.columns, *names))


def check_foreign_files(storage: Storage, formats: Iterable[str]) -> None:
    """Raise LidarError if folders that would be replaced contain files from other programs."""
    for format_name in formats:
        file = format_row(format_name).file
        pattern = load_format(format_name).file_pattern
        if not pattern:
            continue
        own_names = re.compile(rf"{file}/(?:{pattern}|(?:.*/)?\.(?:lidarpool-|writing).*)")
        for name in storage.tree(file):
            if not own_names.fullmatch(name):
                raise LidarError(
                    f"{storage.path(name)} was not written by lidarpool and would be lost, "
                    f"because {file} is replaced. Move it elsewhere, or specify another "
                    "folder with `--out`."
                )


def save_cloud(
    cloud: Cloud | StoredCloud,
    path: str | Path,
    *,
    format: str | None = None,  # noqa: A002 - its name in scenarios and in the command
    layout: str = "velodyne",
    compensated: bool = False,
    compensated_actors: bool = False,
    pose_rate_hz: float | None = None,
    organized: bool = False,
    intensity_full_scale: float | None = None,
    precision_m: float | None = None,
) -> list[str]:
    """Save a point cloud in the format of the file extension, or in a specified format.

    The file is written completely or not at all. The same points produce the same bytes, except in
    .rrd files. At most about one million points are held in memory at a time, or all points of the
    largest sweep if it has more. Fields of the format whose columns the cloud does not have are 0
    or omitted, for example the return numbers in .las files.

    Parameters
    ----------
    cloud
        Points in memory, or the stored points of a result.
    path
        File or folder to write. Without `format`, its extension must be .ply, .las, .laz, .e57,
        .osi, .mcap, .rrd or .parquet. Its parent folder must exist. An existing file is replaced,
        but an existing folder is not.
    format
        Name of the format, such as "laz". The formats "parquet", "pcd", "images", "kitti",
        "nuscenes", "webdataset" and "rosbag2" create a folder of files. Formats of plug-ins are
        also supported.
    layout
        Layout of the points in mcap and rosbag2: that of a manufacturer's driver (velodyne, ouster,
        hesai, robosense or livox), autoware, or images, which is velodyne with additional range
        images.
    compensated
        Whether points in mcap, rosbag2 and pcd are compensated for motion, which means that they
        are in the sensor frame at the start of the sweep and have no times. By default, each point
        is in the sensor frame at the time of its firing, as in the output of drivers.
    compensated_actors
        Whether the points of each actor are moved to the pose of the actor at the start of the
        sweep, so that they are inside its box, in formats with one file or message per sweep. The
        cloud must have the column `time`.
    pose_rate_hz
        Number of poses per second on `/tf` in mcap and rosbag2. By default, there is one pose at
        the start of each sweep, and one at the end of the last sweep.
    organized
        Whether mcap and rosbag2 contain a point for each ray, in the row order of the layout's
        driver. Rays without a return are NaN. This option is available for the layouts velodyne,
        ouster, images and robosense.
    intensity_full_scale
        Intensity that .las and .laz files store as 65,535. By default, it is the smallest power of
        two for which at most 1 % of the points are stored as 65,535.
    precision_m
        Resolution of the stored positions in meters. By default, it is the precision of the survey,
        or 0.001.

    Returns
    -------
    Names of the columns that the format cannot store.

    Raises
    ------
    LidarError
        If the format is unknown or requires a missing column or package, if it stores individual
        sweeps but the cloud does not come from a result, or if the file cannot be written.
    """
    path = Path(path)
    name = format or _ENDINGS.get(path.suffix)
    if name is None:
        raise LidarError(
            f"{path} has the extension {path.suffix!r}, which does not belong to any supported "
            f"format. Use {join_alternatives([*_ENDINGS])}, or set `format`."
        )
    if precision_m is not None and not 0 < precision_m < np.inf:
        raise LidarError(f"`precision_m` is {precision_m}; it must be a positive length in meters.")
    spec = ExportSpec(
        name,
        layout,
        compensated,
        compensated_actors=compensated_actors,
        pose_rate_hz=pose_rate_hz,
        organized=organized,
        intensity_full_scale=intensity_full_scale,
    )
    sweeps = Sweeps.unknown() if cloud.sweeps is None else cloud.sweeps()
    sweeps = replace(sweeps, precision_m=precision_m or sweeps.precision_m)
    with explain_os_errors(f"{path} cannot be written"):
        if path.is_dir():
            raise LidarError(f"{path} is a folder. Remove it, or use another path.")
    if cloud.sweeps is None and spec.cloud_format.by_sweep:
        raise LidarError(
            f"{name} stores single sweeps, but the cloud has no sweeps. Save the cloud of a "
            "`Result`, or a cloud that was read from a result folder."
        )
    spec.write(path, cloud, sweeps, overwrite=True)
    return spec.unsupported_columns(cloud, sweeps)
