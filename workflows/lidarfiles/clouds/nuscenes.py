"""Read and write nuScenes data sets, with point files and the tables of nuscenes-devkit."""

from __future__ import annotations

import io
import json
from bisect import bisect_right
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from hashlib import md5
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from lidarsim.columns.actor_rays import NO_ACTOR_RAYS
from lidarsim.columns.cloud import Cloud, CloudLike
from lidarsim.columns.sweep import Sweep
from lidarsim.environment.extras import reading
from lidarsim.errors import LidarError
from lidarsim.io.input_files import read_input
from lidarsim.io.named_files import check_name, file_below
from lidarsim.io.storage import Storage
from lidarsim.motion.rotations import recorded_rotation
from lidarsim.numerics.arrays import Bools, Bytes, Floats, Ints
from lidarsim.scene.files.float_rows import NUSCENES, read_float_columns
from lidarsim.scene.transform import affine
from lidarsim.sweeps.sweeps import Sweeps, make_identifiers, states_compensation
from lidarsim.words import plural

from ..identity.fingerprint import fingerprint
from .boxes import Boxes, json_number
from .job_reader import Entry, JobReader, PointColumns
from .multi_file_format import FileContent, MultiFileFormat, as_bytes
from .point_field import OMITTED, PointField
from .recorded_boxes import RecordedBoxes
from .recording import Recording, RecordingInfo, sweep_from_columns
from .recording_ref import RecordingRef

VERSION = "v1.0-lidarpool"
FIRST_SENSOR = "LIDAR_TOP"
_SCENE = "scene-0001"
_LOG = "survey"
_DATE = "1980-01-06"  # date of the log, because timestamps start at 0
_DAY_US = 86_400_000_000
_MAP = "maps/none.png"
_TABLES = (
    "attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map", "sample",
    "sample_annotation", "sample_data", "scene", "sensor", "visibility",
)  # fmt: skip
LABELS = f"lidarseg/{VERSION}/"
_FILE_PATTERN = (
    r"(samples|sweeps)/[^/]+/([^/]+/)?\d+\.pcd\.bin|v1\.0-lidarpool/\w+\.json|maps/none\.png|"
    r"lidarseg/v1\.0-lidarpool/[^/]+\.pcd\.bin"
)
_MAX_CLASSES = 255  # labels are bytes, and 0 represents points without a class
_NO_CLASS = "none"
_SWEEP_TABLE = "sample_data.json"
_Row = Mapping[str, Any]  # row of a table
# Limits of the visibility levels, whose tokens are 1 to 4.
_VISIBILITIES = (0.4, 0.6, 0.8)
_SHARED = (
    "category",
    "log",
    "map",
    "sensor",
    "visibility",
)  # tables whose rows are shared by all jobs


class NuScenes(MultiFileFormat):
    """A data set that nuscenes-devkit opens with `NuScenes("v1.0-lidarpool", path)`.

    - Points: each sweep is stored in `samples/NAME/000000.pcd.bin` as float32 x, y and z in the
      sensor frame at the start of the sweep, intensity (0 to 255), and ring. NAME is LIDAR_TOP for
      the first sensor, because the devkit expects this name, and otherwise the name of the sensor.
    - Samples: each sweep of the first sensor is a sample. The first sweep of another sensor that
      starts during a sample is a key frame of this sample. All other sweeps are stored in
      `sweeps/NAME`.
    - Poses: the ego pose of a sweep is the pose of its sensor.
    - Annotations: each sample contains the boxes of the actors at the time of the sample.
    - Labels: named classes are stored as nuScenes-lidarseg labels, which are row indices in
      `category.json`. The devkit requires indices without gaps, so the classes are numbered from 1
      in ascending order. Points without a named class have the label 0.

    In a data set, each job is a scene with the name of the job. Scenes are dated to different days.
    The files of a job are in subfolders of `samples/NAME` and `sweeps/NAME` with the same name, and
    `merge_jobs` writes the tables.

    Caesar et al., nuScenes, 2020.
    """

    title = "nuScenes"
    by_sweep = True
    frame = "sweep"
    fields = (
        PointField("intensity", ("intensity",)),
        PointField("ring", ("channel",)),
        PointField("lidarseg", ("class",), OMITTED, if_named=True),
    )
    other_columns = False
    required = ("object",)
    actor_boxes = True
    file_pattern = _FILE_PATTERN
    separate_sweeps = True
    raw_sweeps = True

    def __init__(self, cloud: CloudLike, sweeps: Sweeps, entry: Entry | None = None) -> None:
        super().__init__(cloud, sweeps, entry)
        self.channels = _channels(sweeps)
        self.sample, self.first = _samples(sweeps)
        self.names = _files(sweeps, self.channels, self.first, entry)
        self.folders = [name.rpartition("/")[0] for name in self.names]
        named = sweeps.classes and any(column.name == "class" for column in cloud.table)
        self.labels = [LABELS + name.replace("/", "-") for name in self.names] if named else []
        self.folders += [LABELS] if named else []
        self.label_of_class = _labels_of_classes(sweeps.classes)

    def files(self, number: int, points: Cloud) -> tuple[dict[str, FileContent], Boxes]:
        """Return the point file and the label file of a sweep, and the sweep's boxes."""
        inside = self.sweeps.compensate_motion(number, points)
        intensity = np.clip(points["intensity"], 0, 1) * 255
        rows = np.empty((len(points), 5), "<f4")
        rows[:, :3] = inside
        rows[:, 3] = intensity
        rows[:, 4] = points["channel"]
        files = {self.names[number]: as_bytes(rows)}
        if self.labels:
            files[self.labels[number]] = as_bytes(self.label_of_class[points["class"]])
        return files, Boxes.from_points(self.sweeps, number, points)

    def shared_files(self, boxes: Sequence[Boxes]) -> dict[str, bytes]:
        """Return the tables and the map of a survey that is not part of a data set."""
        if self.entry is not None:
            return {}
        files = {
            f"{VERSION}/{name}.json": json.dumps(rows, indent=1).encode()
            for name, rows in self._tables(boxes).items()
        }
        return files | {_MAP: _no_map()}

    def summary(self, boxes: Sequence[Boxes]) -> dict[str, Any]:
        """Return the summary of a job that `merge_jobs` requires.

        It contains the tables of the job and, if points have labels, the class numbers.
        """
        labeled = {"lidarseg": sorted(self.sweeps.classes)} if self.labels else {}
        return {"tables": self._tables(boxes), **labeled}

    def _tables(self, boxes: Sequence[Boxes]) -> dict[str, list[dict[str, Any]]]:
        tables = _Tables(self.sweeps, self.entry)
        tables.add_frames(self.channels, self.sample, self.names)
        keys: list[list[Boxes]] = [[] for _ in range(int((self.sweeps.sensor == 0).sum()))]
        for sweep in np.flatnonzero(self.first):
            keys[self.sample[sweep]].append(boxes[int(sweep)])
        tables.add_actors(keys)
        if self.labels:
            tokens = [row["token"] for row in tables.rows["sample_data"]]
            tables.rows["lidarseg"] = [
                {"token": token, "sample_data_token": token, "filename": file}
                for token, file in zip(tokens, self.labels, strict=True)
            ]
        if self.labels and self.entry is None:  # `merge_jobs` adds the classes of all jobs
            tables.rows["category"] = _categories(tables.rows["category"], self.sweeps.classes)
        return tables.rows

    @classmethod
    def renaming_notes(cls, sensors: Sequence[str]) -> list[str]:
        """Return a note if the first sensor is renamed.

        Readers expect a certain name.
        """
        if not sensors or sensors[0] in ("", FIRST_SENSOR):
            return []
        note = (
            f"{cls.title} expects the first sensor to be named {FIRST_SENSOR!r}, so "
            f"{sensors[0]!r} is renamed to {FIRST_SENSOR!r}"
        )
        if FIRST_SENSOR in sensors[1:]:
            note += f" and {FIRST_SENSOR!r} to '{FIRST_SENSOR}_2'"
        return [note]

    @classmethod
    def sweep_files(cls, job: JobReader, sweep: int) -> list[str]:
        """Return the name of the point file and, if classes have names, of the label file."""
        sweeps = job.sweeps
        names = job.get_or_compute(
            "names",
            lambda: _files(sweeps, _channels(sweeps), _samples(sweeps)[1], job.entry),
        )
        file = names[sweep]
        return [file, LABELS + file.replace("/", "-")] if sweeps.classes else [file]

    @classmethod
    def read_sweep(cls, job: JobReader, sweep: int) -> PointColumns:
        """Read points with intensity, channel and, if classes have names, class."""
        file, *labels = cls.sweep_files(job, sweep)
        rows = job.read_rows(file, np.dtype("<f4")).reshape(-1, 5)
        intensity, channel = np.ascontiguousarray(rows[:, 3:].T)
        intensity /= 255
        columns = {"intensity": intensity, "channel": channel.astype("u2")}
        if labels:
            labels_of_points = job.read_rows(labels[0], np.dtype("u1"), len(rows))
            columns["class"] = np.array([0, *sorted(job.classes)], "u2")[labels_of_points]
        return rows[:, :3], columns

    @classmethod
    def open(cls, ref: RecordingRef) -> Recording:
        """Open the sweeps of a lidar in a nuScenes data set."""
        folder = tables_folder(ref)
        with reading(ref.name):
            tables = NuScenesTables(folder)
            lidars = tables.lidar_rows()
        name, rows = ref.choose_sensor(lidars)
        notes = []
        if omitted := tables.omitted[name]:
            notes.append(
                f"contains only the {plural(len(rows), 'key frame')} of this lidar. The files of "
                f"{plural(omitted, 'sweep')} between them, in the folder sweeps, are missing"
            )
        info = ref.info(
            sensor=name,
            sequence=tables.scene_name(rows[0]) if tables.scene_count > 1 else "",
            compensated=states_compensation(str(tables.scene(rows[0]).get("description"))),
            notes=ref.prefix_notes(notes),
        )
        return _NuScenesRecording(info, tables, rows)

    @classmethod
    def merge_jobs(
        cls, storage: Storage, manifests: Iterable[Mapping[str, Any]]
    ) -> dict[str, list[int]]:
        """Write the tables of a data set.

        Returns the jobs whose labels must be renumbered.
        """
        shared: set[str] = set()  # tokens of rows that are shared by several jobs
        with ExitStack() as stack:
            files = {
                name: stack.enter_context(storage.writing(f"{VERSION}/{name}.json"))
                for name in _TABLES
            }
            separators: dict[str, bytes] = {}  # {table: bytes before its next row}
            kinds = dict[str, dict[str, Any]]()
            classes = _JobClasses()

            def write(tables: Mapping[str, Iterable[dict[str, Any]]]) -> None:
                for name, rows in tables.items():
                    for row in rows:
                        if name in _SHARED:
                            if row["token"] in shared:
                                continue
                            shared.add(row["token"])
                        if name not in files:  # lidarseg
                            files[name] = stack.enter_context(
                                storage.writing(f"{VERSION}/{name}.json")
                            )
                        files[name].write(separators.get(name, b"[\n") + json.dumps(row).encode())
                        separators[name] = b",\n"

            for job in manifests:
                kinds |= {row["token"]: row for row in job["tables"].pop("category")}
                classes.add(job)
                write(job["tables"])
            rows = kinds.values()
            write({"category": _categories(rows, classes.names) if "lidarseg" in files else rows})
            for name, file in files.items():
                file.write(b"\n]\n" if name in separators else b"[]\n")
        with storage.writing(_MAP) as file:
            file.write(_no_map())
        return classes.relabeled_jobs()

    @classmethod
    def renumber_labels(
        cls, name: str, read: Callable[[str], bytes], before: Sequence[int], after: Sequence[int]
    ) -> bytes | None:
        """Renumber the labels in a nuScenes-lidarseg file.

        Returns None for other files.
        """
        if not name.startswith(LABELS):
            return None
        table = _labels_of_classes(after)[[0, *before]]
        return table[np.frombuffer(read(name), np.uint8)].tobytes()


def sample_tokens(sweeps: Sweeps, entry: Entry | None = None) -> tuple[str, list[str]]:
    """Return the name of the scene, and the token of each sample, as in the written tables."""
    tables = _Tables(sweeps, entry)
    count = int((sweeps.sensor == 0).sum())
    return tables.scene, [tables.token("sample", number) for number in range(count)]


def _channels(sweeps: Sweeps) -> list[str]:
    """Return the nuScenes channel name of each sensor."""
    return make_identifiers([FIRST_SENSOR, *(name or FIRST_SENSOR for name in sweeps.sensors[1:])])


def _samples(sweeps: Sweeps) -> tuple[Ints, Bools]:
    """Return the sample of each sweep and a mask of key frames.

    A key frame is the first sweep of a sensor in a sample.
    """
    sample_starts = sweeps.begins_ns[sweeps.sensor == 0]
    sample = np.clip(np.searchsorted(sample_starts, sweeps.begins_ns, "right") - 1, 0, None)
    return sample, np.diff(sample, prepend=-1).astype(bool) | (sweeps.numbers == 0)


def _files(sweeps: Sweeps, channels: Sequence[str], first: Bools, entry: Entry | None) -> list[str]:
    below = "" if entry is None else f"{entry.name}/"
    return [
        f"{'samples' if key else 'sweeps'}/{channels[sensor]}/{below}{number:06}.pcd.bin"
        for key, sensor, number in zip(first, sweeps.sensor, sweeps.numbers, strict=True)
    ]


def _labels_of_classes(classes: Collection[int]) -> Bytes:
    """Return the label of each class number, or 0 for classes without a name.

    Parameters
    ----------
    classes
        Numbers of the classes that have names.

    Returns
    -------
    A uint8 array with shape (65536,).

    Raises
    ------
    LidarError
        If there are more classes with names than labels.
    """
    if len(classes) > _MAX_CLASSES:
        raise LidarError(
            f"nuScenes-lidarseg supports at most {_MAX_CLASSES} classes, but {len(classes)} "
            "classes have names. Remove names from `classes`, or write another format, such "
            "as kitti."
        )
    labels = np.zeros(1 << 16, np.uint8)
    labels[sorted(classes)] = np.arange(1, len(classes) + 1)
    return labels


def _categories(kinds: Iterable[Any], classes: Mapping[int, str]) -> list[dict[str, Any]]:
    """Return the rows of `category.json`, which contains named classes and actor categories.

    The rows of the classes come first, sorted by label. Names are unique: if jobs use the same name
    for several classes, the class number is appended to the name. Rows of classes have an
    additional field `class` with the class number, which is not part of nuScenes.
    """
    rows_by_name = {row["name"]: row for row in kinds}
    numbers: dict[str, int | None] = {_NO_CLASS: 0}
    for number in sorted(classes):
        name = classes[number]
        numbers[f"{name} ({number})" if name in numbers else name] = number
    names = numbers | {name: None for name in rows_by_name if name not in numbers}
    return [
        {"token": name, "name": name, "description": ""}
        | rows_by_name.get(name, {})
        | {"index": index}
        | ({} if number is None else {"class": number})
        for index, (name, number) in enumerate(names.items())
    ]


def _actor_categories(sweeps: Sweeps) -> list[str]:
    """Return the category of each actor, which is its type.

    If a class has the same name except for spelling, its spelling is used, because points and boxes
    share the categories. The actor "Car 1", for example, is a `car` if there is a class `car`.
    """
    spellings = {_spelled_alike(name): name for name in sweeps.classes.values()}
    return [spellings.get(_spelled_alike(kind), kind) for kind in sweeps.actor_types]


def _spelled_alike(name: str) -> str:
    """Normalize a name so that names are equal if they differ only in case or underscores."""
    return name.casefold().replace("_", " ")


class _JobClasses:
    """Collection of the classes of all jobs in a data set."""

    def __init__(self) -> None:
        self._names: dict[int, dict[str, None]] = {}  # {class: its names in the jobs, in order}
        self._labeled: dict[tuple[int, ...], list[str]] = {}  # {labeled classes: jobs}

    def add(self, job: Mapping[str, Any]) -> None:
        """Add the classes of a job, given its manifest."""
        for number, name in job.get("classes", {}).items():
            self._names.setdefault(int(number), {})[name] = None
        if "lidarseg" in job:
            self._labeled.setdefault(tuple(job["lidarseg"]), []).append(job["row"]["name"])

    @property
    def names(self) -> dict[int, str]:
        """Class names, keyed by number.

        Different names for the same number are joined by semicolons.
        """
        return {number: "; ".join(names) for number, names in self._names.items()}

    def relabeled_jobs(self) -> dict[str, list[int]]:
        """Return the jobs whose labels must be renumbered.

        The result maps the name of each of these jobs to all classes of the data set. Each of these
        jobs has only some of the classes.
        """
        numbers = sorted(self._names)
        _labels_of_classes(numbers)  # raises LidarError if there are too many
        others = (jobs for labeled, jobs in self._labeled.items() if [*labeled] != numbers)
        return dict.fromkeys(chain.from_iterable(others), numbers)


def _no_map() -> bytes:
    """Return an empty image in PNG format, because the devkit requires a map."""
    image = io.BytesIO()
    Image.new("L", (1, 1)).save(image, "png")
    return image.getvalue()


class _Tables:
    """Builder of the nuScenes tables of a survey.

    The tokens of the rows are derived from the survey and the job, so they are reproducible.
    """

    def __init__(self, sweeps: Sweeps, entry: Entry | None) -> None:
        self.sweeps = sweeps
        self._entry = entry
        self.scene = _SCENE if entry is None else entry.name
        # Actor rays are only counted in a run, but tokens are also required without a run.
        planned = fingerprint(replace(sweeps, actor_rays=NO_ACTOR_RAYS))
        self._salt = f"{'' if entry is None else f'{entry.name} '}{planned}"
        self.rows: dict[str, list[dict[str, Any]]] = {"attribute": [], "visibility": []}
        self._add("log", _LOG, logfile="", vehicle="", date_captured=_DATE, location="")
        logs = [self.token("log", _LOG)]
        self._add("map", _MAP, category="semantic_prior", filename=_MAP, log_tokens=logs)

    def token(self, table: str, key: object) -> str:
        """Return the token of a row."""
        salt = self._salt if self._entry is None or table not in _SHARED else ""
        return md5(f"{salt} {table} {key}".encode(), usedforsecurity=False).hexdigest()

    def _add(self, table: str, key: object, **fields: Any) -> None:
        self.rows.setdefault(table, []).append({"token": self.token(table, key), **fields})

    def _chain(self, table: str, keys: list[Any]) -> list[dict[str, str]]:
        """Return the fields `prev` and `next` for each row in a sequence."""
        tokens = ["", *(self.token(table, key) for key in keys), ""]
        return [{"prev": a, "next": b} for a, b in zip(tokens, tokens[2:], strict=False)]

    def add_frames(self, channels: list[str], sample: Any, names: list[str]) -> None:
        """Add the rows for the scene, its samples and sensors, and all sweeps."""
        sweeps = self.sweeps
        count = int((sweeps.sensor == 0).sum())
        self._add(
            "scene",
            self.scene,
            name=self.scene,
            description=sweeps.frame_text(compensated=True),
            nbr_samples=count,
            log_token=self.token("log", _LOG),
            first_sample_token=self.token("sample", 0),
            last_sample_token=self.token("sample", count - 1),
        )
        # nuscenes-devkit sorts scenes by time, and fails if two scenes have the same time.
        day = 0 if self._entry is None else self._entry.number
        times = [day * _DAY_US + round(begin / 1000) for begin in sweeps.begins_ns]
        for number, neighbors in enumerate(self._chain("sample", list(range(count)))):
            scene = self.token("scene", self.scene)
            self._add("sample", number, timestamp=times[number], scene_token=scene, **neighbors)
        for sensor, channel in enumerate(channels):
            self._add("sensor", channel, channel=channel, modality="lidar")
            self._add(
                "calibrated_sensor",
                channel,
                sensor_token=self.token("sensor", channel),
                translation=[0.0] * 3,
                rotation=[1.0, 0.0, 0.0, 0.0],
                camera_intrinsic=[],
            )
            sweeps_of_sensor = np.flatnonzero(sweeps.sensor == sensor).tolist()
            for sweep, neighbors in zip(
                sweeps_of_sensor, self._chain("sample_data", sweeps_of_sensor), strict=True
            ):
                x, y, z, w = sweeps.pose.quaternions[sweep].tolist()
                position = sweeps.pose.positions[sweep].tolist()
                timestamp = times[sweep]
                is_key_frame = names[sweep].startswith("samples/")
                # A sweep between samples refers to the following sample. nuscenes-devkit
                # interpolates between the boxes of this sample and of the previous sample.
                number = min(sample[sweep] + (not is_key_frame), count - 1)
                self._add(
                    "ego_pose",
                    sweep,
                    timestamp=timestamp,
                    rotation=[w, x, y, z],
                    translation=position,
                )
                self._add(
                    "sample_data",
                    sweep,
                    sample_token=self.token("sample", number),
                    ego_pose_token=self.token("ego_pose", sweep),
                    calibrated_sensor_token=self.token("calibrated_sensor", channel),
                    timestamp=timestamp,
                    fileformat="pcd",
                    height=0,
                    width=0,
                    filename=names[sweep],
                    is_key_frame=is_key_frame,
                    **neighbors,
                )

    def add_actors(self, boxes: list[list[Boxes]]) -> None:
        """Add the rows for the actors and their boxes.

        `boxes` are the boxes in all key frames of each sample, starting with the first sensor.
        """
        kinds = _actor_categories(self.sweeps)
        self.rows |= {"category": [], "instance": [], "sample_annotation": []}
        if self.sweeps.actor_rays.size:
            self.rows["visibility"] = _visibility_rows()
        for kind in dict.fromkeys(kinds):
            self._add("category", kind, name=kind, description="")
        for actor, kind in enumerate(kinds):
            samples = [k for k, keys in enumerate(boxes) if any(box.present[actor] for box in keys)]
            if not samples:
                continue
            annotation_keys = [(actor, number) for number in samples]
            self._add(
                "instance",
                actor,
                category_token=self.token("category", kind),
                nbr_annotations=len(samples),
                first_annotation_token=self.token("sample_annotation", annotation_keys[0]),
                last_annotation_token=self.token("sample_annotation", annotation_keys[-1]),
            )
            chain = self._chain("sample_annotation", annotation_keys)
            for number, beside in zip(samples, chain, strict=True):
                visibility = _visibility(boxes[number], actor)
                at_stamp = boxes[number][0]  # the sweeps of the first sensor are the samples
                x, y, z, w = at_stamp.quaternions[actor].tolist()
                length, width, height = at_stamp.sizes[actor].tolist()
                self._add(
                    "sample_annotation",
                    (actor, number),
                    sample_token=self.token("sample", number),
                    instance_token=self.token("instance", actor),
                    visibility_token=_visibility_token(visibility),
                    attribute_tokens=[],
                    translation=at_stamp.centers[actor].tolist(),
                    size=[width, length, height],
                    rotation=[w, x, y, z],
                    num_lidar_pts=int(sum(keys.points[actor] for keys in boxes[number])),
                    num_radar_pts=0,
                    **visibility,
                    **beside,
                )


def _visibility_rows() -> list[dict[str, Any]]:
    """Return the table of visibility levels, which is the same as in nuScenes."""
    percent = [0, *(round(100 * limit) for limit in _VISIBILITIES), 100]
    return [
        {
            "token": str(number),
            "level": f"v{lower}-{upper}",
            "description": f"visibility of whole object is between {lower} and {upper}%",
        }
        for number, (lower, upper) in enumerate(pairwise(percent), 1)
    ]


def _visibility(key_frames: Sequence[Boxes], actor: int) -> dict[str, float | None]:
    """Return the visibility of an actor in a sample, for the lidar that sees it best.

    The dictionary is empty if the visibility was not determined. Its entries are not part of
    nuScenes.
    """
    found = [boxes.visibility[actor] for boxes in key_frames if boxes.visibility is not None]
    if not found:
        return {}
    best = min(found, key=lambda box: (-np.nan_to_num(box.visible_fraction), box.nearest_ray_m))
    return {name: json_number(float(value)) for name, value in best.arrays.items()}


def _visibility_token(visibility: Mapping[str, float | None]) -> str:
    """Return the token of a visibility level, or an empty string if the visibility is unknown."""
    if not visibility:
        return ""
    return str(1 + bisect_right(_VISIBILITIES, visibility["visible_fraction"] or 0.0))


# -- reading ---------------------------------------------------------------------------------


class _NuScenesRecording(Recording):
    """The sweeps of a lidar in a nuScenes data set."""

    def __init__(self, info: RecordingInfo, tables: NuScenesTables, rows: list[_Row]) -> None:
        super().__init__(info)
        self._tables = tables
        self._rows = rows

    def __len__(self) -> int:
        return len(self._rows)

    def load(self, number: int) -> Sweep:
        return self._tables.read(self._rows[number])

    def load_stamps(self) -> list[int]:
        return [1000 * row["timestamp"] for row in self._rows]

    def load_boxes(self) -> RecordedBoxes | None:
        return self._tables.boxes(self._rows)


def tables_folder(ref: RecordingRef) -> Path:
    """Return the folder with the tables of a data set, given this folder or the root folder.

    Raises LidarError if the root folder contains several versions of the tables.
    """
    tables = ref.path
    if not (tables / _SWEEP_TABLE).is_file():
        versions = sorted(table.parent for table in ref.path.glob(f"v1.0-*/{_SWEEP_TABLE}"))
        if len(versions) > 1:
            names = ", ".join(version.name for version in versions)
            raise LidarError(
                f"{ref.name} contains several versions of nuScenes: {names}. Specify the "
                f"folder of one version, for example {ref.name}/{versions[0].name}."
            )
        (tables,) = versions
    return tables.absolute()


class NuScenesTables:
    """Tables of a nuScenes data set, which describe the sweeps of its lidars.

    File names in the tables are relative to the parent of the folder that contains the tables.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._poses = self.table("ego_pose")
        self._calibrated = self.table("calibrated_sensor")
        self._scenes = self.table("scene")
        self._samples = self.table("sample")
        # {lidar channel, with the scene as in `lidar_rows`: number of sweeps that are not stored}
        self.omitted: dict[str, int] = {}
        self._labels: dict[str, str] = {}  # {token of a sweep: its label file}
        for row in self.table("lidarseg", optional=True).values():
            self._labels[row["sample_data_token"]] = row["filename"]
        # Class number of each label. Data sets from other sources have no class numbers.
        self.classes = np.arange(256, dtype=np.uint16)
        for row in self.table("category", optional=True).values():
            if self._labels and "class" in row:
                self.classes[row["index"]] = row["class"]

    def table(self, name: str, *, optional: bool = False) -> dict[str, _Row]:
        """Read a table, whose rows are keyed by token.

        An optional table is empty if its file does not exist.
        """
        if optional and not (self.folder / f"{name}.json").exists():
            return {}
        rows = json.loads(read_input(self.folder / f"{name}.json"))
        return {row["token"]: row for row in rows}

    @property
    def scene_count(self) -> int:
        """Number of scenes."""
        return len(self._scenes)

    def scene(self, row: _Row) -> _Row:
        """Return the row of the scene of a sweep."""
        return self._scenes[self._samples[row["sample_token"]]["scene_token"]]

    def scene_name(self, row: _Row) -> str:
        """Return the name of the scene of a sweep."""
        return str(self.scene(row)["name"])

    def lidar_rows(self) -> dict[str, list[_Row]]:
        """Return the sweeps of each lidar channel, sorted by time.

        If there are several scenes, the name of the scene precedes the name of the channel. Sweeps
        between key frames are omitted if their folder does not exist.
        """
        sensors = self.table("sensor")
        rows_of_channel: dict[tuple[str, str], list[_Row]] = {}
        for row in self.table("sample_data").values():
            sensor = sensors[self._calibrated[row["calibrated_sensor_token"]]["sensor_token"]]
            if sensor["modality"] == "lidar":
                channel = self.scene_name(row), sensor["channel"]
                rows_of_channel.setdefault(channel, []).append(row)
                for name, entry in self._named_files(row):
                    check_name(name, entry)
        found: dict[str, list[_Row]] = {}
        for (scene, sensor_name), rows in sorted(rows_of_channel.items()):
            full_name = f"{scene} {sensor_name}" if self.scene_count > 1 else sensor_name
            stored = self._stored_rows(rows)
            self.omitted[full_name] = len(rows) - len(stored)
            found[full_name] = sorted(stored, key=lambda row: row["timestamp"])
        return found

    def _stored_rows(self, rows: list[_Row]) -> list[_Row]:
        """Return the key frames, and the other sweeps if their folder exists."""
        folders = {str(row["filename"]).rpartition("/")[0] for row in rows}
        missing = {folder for folder in folders if not (self.folder.parent / folder).is_dir()}
        return [
            row
            for row in rows
            if row["is_key_frame"] or str(row["filename"]).rpartition("/")[0] not in missing
        ]

    def _named_files(self, row: _Row) -> list[tuple[str, str]]:
        """Return the point file of a sweep and, if it exists, its label file.

        Each file name is accompanied by a description of the table entry that contains it.
        """
        token = row["token"]
        folder = self.folder.name
        names = [(row["filename"], f"{folder}/{_SWEEP_TABLE}, token {token},")]
        if token in self._labels:
            entry = f"{folder}/lidarseg.json, sample_data_token {token},"
            names.append((self._labels[token], entry))
        return names

    def files(self, row: _Row) -> list[Path]:
        """Return the paths of the point file of a sweep and, if it exists, of its label file.

        Raises LidarError if a file is outside of the data set.
        """
        return [file_below(self.folder.parent, *named) for named in self._named_files(row)]

    def sensor_pose(self, row: _Row) -> Floats:
        """Return the sensor pose of a sweep in the world frame, with shape (4, 4)."""
        calibration = _pose_of(self._calibrated[row["calibrated_sensor_token"]])
        return _pose_of(self._poses[row["ego_pose_token"]]) @ calibration

    def boxes(self, rows: Sequence[_Row]) -> RecordedBoxes | None:
        """Return the annotated boxes in the key frames among the sweeps `rows`, or None."""
        annotations = self.table("sample_annotation", optional=True)
        if not annotations:
            return None
        instances = self.table("instance")
        numbers = {token: number for number, token in enumerate(instances)}
        categories = self.table("category")
        of_sample: dict[str, list[_Row]] = {}
        for row in annotations.values():
            of_sample.setdefault(row["sample_token"], []).append(row)
        found = []
        for sweep, row in enumerate(rows):
            if not row["is_key_frame"]:
                continue
            from_world = np.linalg.inv(self.sensor_pose(row))
            for box in of_sample.get(row["sample_token"], []):
                instance = box["instance_token"]
                kind = categories[instances[instance]["category_token"]]["name"]
                width, length, height = box["size"]
                pose = from_world @ _pose_of(box)
                found.append((sweep, numbers[instance], kind, pose, (length, width, height)))
        return RecordedBoxes.from_rows(found)

    def read(self, row: _Row) -> Sweep:
        """Read a sweep."""
        file, *label_files = self.files(row)
        columns = read_float_columns(file, NUSCENES)
        for label_file in label_files:
            labels = np.frombuffer(read_input(label_file), "u1")
            if len(labels) != (count := len(columns["x"])):
                raise ValueError(f"{label_file.name} has {len(labels)} labels for {count} points")
            columns["class"] = self.classes[labels]
        return sweep_from_columns(
            columns, pose=self.sensor_pose(row), time_ns=1000 * row["timestamp"]
        )


def _pose_of(row: _Row) -> Floats:
    """Return the pose matrix for a row with a rotation and a translation.

    Raises ValueError if the pose is not finite, or if it does not consist of both.
    """
    w, x, y, z = row["rotation"]
    owner = f"the row with the token {row['token']}"
    rotation = recorded_rotation((x, y, z, w), owner)
    pose = affine(rotation, np.array(row["translation"], np.float64))
    if not np.isfinite(pose).all():
        raise ValueError(f"the pose in {owner} is not finite. Correct its translation")
    return pose
