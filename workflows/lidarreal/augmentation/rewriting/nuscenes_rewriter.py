"""Augmented copies of nuScenes data sets."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping, Sequence
from hashlib import md5
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidarfiles.clouds.nuscenes import NuScenesTables, tables_folder
from lidarfiles.clouds.recording import Recording
from lidarfiles.clouds.recording_ref import RecordingRef
from lidarsim.errors import LidarError
from lidarsim.io.archives import pack_arrays
from lidarsim.io.input_files import read_input
from lidarsim.io.named_files import check_name
from lidarsim.motion.rotations import matrices, quaternions_of, recorded_rotation
from lidarsim.numerics.arrays import AnyArray, Bytes, Floats, Ints
from lidarsim.scene.files.float_rows import NUSCENES
from lidarsim.words import join_names, plural

from ..augmented_sweep import AugmentedSweep
from .data_set_copy import copy_data_set, place_file
from .nuscenes_categories import OTHER_CATEGORY, attribute_tokens, find_category, visibility_token
from .rewriter import EncodedSweeps, Rewriter, box_details
from .stored_records import StoredRecords, unchanged

_ROW = np.dtype([(name, "<f4") for name in NUSCENES])
_MAX_LABEL = 255
_PANOPTIC_FACTOR = 1000  # panoptic labels are 1000 times the category index plus the instance
_MAX_PANOPTIC = 64  # highest category index for which a panoptic label fits into 16 bits
_Row = Mapping[str, Any]


class NuScenesRewriter(Rewriter):
    """Writer of an augmented nuScenes data set.

    The point files of one lidar channel, and their lidarseg and panoptic labels, are written anew.
    In changed key frames, the points in all annotated boxes are counted again. Inserted objects
    become instances with an annotation for each key frame in which they are present. All other
    files are linked or copied.
    """

    title = "nuScenes"

    def __init__(self, ref: RecordingRef, recording: Recording) -> None:
        super().__init__(ref, recording)
        folder = tables_folder(ref)
        self.path = folder.parent
        self._tables = NuScenesTables(folder)
        self._lidars = self._tables.lidar_rows()
        self._channel = ref.choose("sensors", self._lidars)
        self._rows = self._lidars[self._channel]
        self._categories = list(self._tables.table("category", optional=True).values())
        self._panoptic: dict[str, str] = {}  # {token of a sweep: its file}
        for row in self._tables.table("panoptic", optional=True).values():
            check_name(row["filename"], f"{folder.name}/panoptic.json, token {row['token']},")
            self._panoptic[row["sample_data_token"]] = row["filename"]

    def encode(
        self, number: int, augmented: AugmentedSweep
    ) -> tuple[dict[str, bytes], dict[str, Any]]:
        """Return the point file of a sweep, and its label files if they exist."""
        row = self._rows[number]
        file, *label_files = self._tables.files(row)
        records = np.frombuffer(read_input(file), _ROW)
        stored = self.stored_records(number, records)
        rows = stored.augment(augmented)
        template = np.asarray(augmented.template, np.intp)
        files = {self._name(file): rows.tobytes()}
        details: dict[str, Any] = {
            "changed": not unchanged(rows, records, template),
            "boxes": box_details(augmented),
        }
        new_categories = _NewCategories(self._categories)
        for label_file in label_files:
            labels = np.frombuffer(read_input(label_file), "u1")[template]
            labels = self._labels(labels, stored, augmented, new_categories)
            files[self._name(label_file)] = labels.tobytes()
            details["label_file"] = self._name(label_file)
        if row["token"] in self._panoptic:
            name = self._panoptic[row["token"]]
            with np.load(io.BytesIO(read_input(self.path / name))) as archive:
                panoptic = archive["data"]
            panoptic = _panoptic_labels(panoptic, augmented, new_categories)
            files[name] = pack_arrays({"data": panoptic})
            details["panoptic_file"] = name
        details["new_categories"] = new_categories.names
        return files, details

    def _name(self, file: Path) -> str:
        return file.relative_to(self.path).as_posix()

    def _labels(
        self,
        labels: Bytes,
        stored: StoredRecords,
        augmented: AugmentedSweep,
        new_categories: _NewCategories,
    ) -> Bytes:
        """Return the lidarseg labels of augmented points, given the labels of their templates."""
        labels = labels.copy()
        columns = augmented.sweep.columns
        if "class" in columns:
            classes = np.asarray(columns["class"])
            recorded = np.asarray(stored.recorded.columns["class"])[augmented.template]
            changed = classes != recorded
            label_of_class = {int(n): label for label, n in enumerate(self._tables.classes)}
            labels[changed] = [label_of_class.get(n, 0) for n in classes[changed].tolist()]
        for mask, index, _ in _inserted_points(augmented, new_categories):
            labels[mask] = index
        return labels

    def sensors(self) -> list[str]:
        """Return the names of all lidar channels."""
        return [*self._lidars]

    @property
    def sensor(self) -> str:
        """Name of the lidar channel."""
        return self._channel

    def assemble(self, target: Path, encoded: EncodedSweeps, base: Path) -> list[str]:
        """Write the folder with all files of the data set."""
        folder = self._tables.folder.name
        tables = _AnnotationTables(NuScenesTables(base / folder), self._rows, self.ref.name)
        files = encoded.files()
        notes = [] if base == target else copy_data_set(base, target, files)
        for name, path in files.items():
            place_file(path, target / name)
        for details in encoded.details():
            tables.add_new_categories(details)
        for details in encoded.details():
            if details["new_categories"]:
                tables.replace_placeholders(target, details)
        tables.add_boxes(encoded)
        counts = tables.count_points(encoded, target)
        for name, rows in tables.changed().items():
            with (target / folder / f"{name}.json").open("w") as file:
                json.dump(rows, file, indent=0)
        if counts:
            notes.append(
                f"`num_lidar_pts` was updated in {plural(counts, 'annotation')}. The visibility of "
                "recorded objects is unchanged."
            )
        return notes + tables.notes()


class _NewCategories:
    """Categories of inserted objects, some of which the data set does not contain.

    Sweeps are encoded independently of each other, so a new category gets a placeholder as its
    index, which is replaced when the categories of all sweeps are known.
    """

    def __init__(self, categories: Sequence[_Row]) -> None:
        self._indices = {row["name"]: row.get("index", 0) for row in categories}
        self.names: list[str] = []  # types of objects without a category

    def index(self, kind: str, highest: int = _MAX_LABEL) -> int:
        """Return the index of the category of an object type, or a placeholder.

        Placeholders descend from the highest index that a label file can contain.
        """
        name = find_category(kind, self._indices)
        if name is not None:
            return int(self._indices[name])
        if kind not in self.names:
            self.names.append(kind)
        return highest - self.names.index(kind)


class _InsertedPoints(NamedTuple):
    """Points of an inserted object."""

    mask: AnyArray  # (n,)
    category: int  # index of the category
    number: int  # number of the object among the inserted objects of the sweep


def _inserted_points(
    augmented: AugmentedSweep, new_categories: _NewCategories, highest: int = _MAX_LABEL
) -> Iterator[_InsertedPoints]:
    """Yield the points of each inserted object, if the sweep has the column `object`."""
    objects = augmented.sweep.columns.get("object")
    if objects is None:
        return
    numbers = augmented.boxes.objects.tolist()
    for number, (kind, own) in enumerate(zip(augmented.boxes.types, numbers, strict=True)):
        mask = (np.asarray(objects) == own) & ~np.asarray(augmented.is_recorded, bool)
        if mask.any():
            yield _InsertedPoints(mask, new_categories.index(kind, highest), number)


def _panoptic_labels(
    labels: AnyArray, augmented: AugmentedSweep, new_categories: _NewCategories
) -> AnyArray:
    """Return panoptic labels of augmented points. Added points have the label 0 (noise).

    Inserted objects have the instance numbers that follow those of the sweep.
    """
    free = int((labels % _PANOPTIC_FACTOR).max(initial=0)) + 1
    labels = labels[augmented.template].copy()
    labels[~np.asarray(augmented.is_recorded, bool)] = 0
    for mask, index, number in _inserted_points(augmented, new_categories, _MAX_PANOPTIC):
        labels[mask] = index * _PANOPTIC_FACTOR + free + number
    return labels


class _AnnotationTables:
    """Tables with categories, instances and annotations, to which inserted objects are added."""

    def __init__(self, tables: NuScenesTables, sweeps: Sequence[_Row], name: str) -> None:
        self._tables = tables
        self._sweeps = sweeps
        self._name = name
        self._rows = {
            table: [dict(row) for row in tables.table(table, optional=True).values()]
            for table in ("category", "instance", "sample_annotation")
        }
        self._changed: set[str] = set()
        self._added: set[str] = set()  # tokens of annotations of inserted objects
        self._added_categories: list[str] = []
        self._other_types: list[str] = []  # types of objects in the category for other objects

    def changed(self) -> dict[str, list[dict[str, Any]]]:
        """Return the tables that differ from those of the data set."""
        return {name: self._rows[name] for name in sorted(self._changed)}

    def notes(self) -> list[str]:
        """Return sentences about the categories of inserted objects."""
        notes = []
        if self._added_categories:
            names = ", ".join(self._added_categories)
            notes.append(f"These categories were added for inserted objects: {names}.")
        if self._other_types:
            notes.append(
                f"nuScenes has no category for {join_names(self._other_types)}, so these inserted "
                f"objects have the category {OTHER_CATEGORY}."
            )
        return notes

    def add_new_categories(self, details: Mapping[str, Any]) -> None:
        """Add the categories of the inserted objects in a sweep.

        Raises LidarError if there are more categories than labels.
        """
        for kind in dict.fromkeys(box["type"] for box in details["boxes"]):
            name = self._category(kind)["name"]
            if name == OTHER_CATEGORY != kind and kind not in self._other_types:
                self._other_types.append(kind)

    def _category(self, kind: str) -> dict[str, Any]:
        """Return the row of an object type in the table of categories, which may be added."""
        rows = self._rows["category"]
        name = find_category(kind, (row["name"] for row in rows))
        if name is not None:
            return next(row for row in rows if row["name"] == name)
        row: dict[str, Any] = {
            "token": self._token("category", kind),
            "name": kind,
            "description": "inserted by lidarpool",
        }
        if any("index" in other for other in rows):
            row["index"] = 1 + max(other.get("index", 0) for other in rows)
            if row["index"] > _MAX_LABEL:
                raise LidarError(
                    f"{self._name} has {len(rows):,} categories, so {kind!r} cannot be added, "
                    f"because lidarseg supports at most {_MAX_LABEL + 1}. Use the type of an "
                    "existing category."
                )
        rows.append(row)
        self._changed.add("category")
        self._added_categories.append(kind)
        return row

    def replace_placeholders(self, target: Path, details: Mapping[str, Any]) -> None:
        """Replace the placeholders of new categories in the label files of a sweep."""
        new = [self._category(kind).get("index", 0) for kind in details["new_categories"]]
        if "label_file" in details:
            table = np.arange(_MAX_LABEL + 1)
            table[_MAX_LABEL - np.arange(len(new))] = new
            path = target / details["label_file"]
            labels = table[np.frombuffer(path.read_bytes(), "u1")]
            path.unlink()  # the file may be a link
            path.write_bytes(labels.astype("u1").tobytes())
        if "panoptic_file" in details:
            path = target / details["panoptic_file"]
            with np.load(io.BytesIO(path.read_bytes())) as archive:
                labels = archive["data"]
            categories, instances = np.divmod(labels, _PANOPTIC_FACTOR)
            table = np.arange(_MAX_PANOPTIC + 2)
            table[_MAX_PANOPTIC - np.arange(len(new))] = new
            path.unlink()
            data = (table[categories] * _PANOPTIC_FACTOR + instances).astype(labels.dtype)
            path.write_bytes(pack_arrays({"data": data}))

    def _token(self, table: str, key: object) -> str:
        first = self._sweeps[0]["token"] if self._sweeps else ""
        used = {row["token"] for row in self._rows.get(table, ())}
        number = 0
        while True:  # a copy can be augmented again
            text = f"lidarpool augment {first} {table} {key} {number}"
            token = md5(text.encode(), usedforsecurity=False).hexdigest()
            if token not in used:
                return token
            number += 1

    def add_boxes(self, encoded: EncodedSweeps) -> None:
        """Add the instances and annotations of all inserted objects."""
        boxes: dict[str, list[_KeyFrameBox]] = {}  # {name of an object: its boxes}
        for sweep, details in zip(self._sweeps, encoded.details(), strict=True):
            if sweep["is_key_frame"] and details["boxes"]:
                pose = self._tables.sensor_pose(sweep)
                for box in details["boxes"]:
                    found = _KeyFrameBox.from_details(sweep, pose, box)
                    boxes.setdefault(box["name"], []).append(found)
        for name, boxes_of_object in boxes.items():
            self._add_instance(name, boxes_of_object)

    def _add_instance(self, name: str, boxes: Sequence[_KeyFrameBox]) -> None:
        category = self._category(boxes[0].details["type"])
        attributes = attribute_tokens(
            [*self._tables.table("attribute", optional=True).values()],
            category["name"],
            _speed(boxes),
        )
        visibilities = [*self._tables.table("visibility", optional=True).values()]
        instance = self._token("instance", name)
        key = [self._token("sample_annotation", (name, box.sweep["token"])) for box in boxes]
        self._rows["instance"].append(
            {
                "token": instance,
                "category_token": category["token"],
                "nbr_annotations": len(boxes),
                "first_annotation_token": key[0],
                "last_annotation_token": key[-1],
            }
        )
        neighbors = ["", *key, ""]
        for number, box in enumerate(boxes):
            length, width, height = box.details["size"]
            self._rows["sample_annotation"].append(
                {
                    "token": key[number],
                    "sample_token": box.sweep["sample_token"],
                    "instance_token": instance,
                    "visibility_token": visibility_token(visibilities, box.details["visibility"]),
                    "attribute_tokens": attributes,
                    "translation": box.position.tolist(),
                    "size": [width, length, height],
                    "rotation": box.rotation,
                    "prev": neighbors[number],
                    "next": neighbors[number + 2],
                    "num_lidar_pts": box.details["points"],  # counted again by `count_points`
                    "num_radar_pts": 0,
                }
            )
        self._changed |= {"instance", "sample_annotation"}
        self._added.update(key)

    def count_points(self, encoded: EncodedSweeps, target: Path) -> int:
        """Update `num_lidar_pts` in changed key frames, with the same rules as nuscenes-devkit.

        Points from all lidar channels of a sample are counted. Returns the number of annotations
        of recorded objects whose count differs from the stored count.
        """
        annotations: dict[str, list[dict[str, Any]]] = {}
        for row in self._rows["sample_annotation"]:
            annotations.setdefault(row["sample_token"], []).append(row)
        own = {sweep["token"] for sweep in self._sweeps}
        others: dict[str, list[_Row]] = {}
        for sweeps in self._tables.lidar_rows().values():
            for sweep in sweeps:
                if sweep["is_key_frame"] and sweep["token"] not in own:
                    others.setdefault(sweep["sample_token"], []).append(sweep)
        updated = 0
        for sweep, details in zip(self._sweeps, encoded.details(), strict=True):
            sample = sweep["sample_token"]
            if not (sweep["is_key_frame"] and sample in annotations):
                continue
            rows = annotations[sample]
            if not details["changed"]:
                rows = [row for row in rows if row["token"] in self._added]
            points = [self._points(sweep, target / sweep["filename"])]
            points += [
                self._points(other, target / other["filename"]) for other in others.get(sample, ())
            ]
            everything = np.concatenate(points)
            for row in rows:
                count = int(_inside(everything, row).sum())
                if count != row["num_lidar_pts"]:
                    updated += row["token"] not in self._added
                    row["num_lidar_pts"] = count
                    self._changed.add("sample_annotation")
        return updated

    def _points(self, sweep: _Row, path: Path) -> Floats:
        """Return the points of a sweep in the world frame."""
        rows = np.fromfile(path, _ROW)
        points = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64)
        pose = self._tables.sensor_pose(sweep)
        return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])


class _KeyFrameBox(NamedTuple):
    """Box of an inserted object in a key frame."""

    sweep: _Row
    details: Mapping[str, Any]
    position: Floats  # (3,), center in world coordinates, meters
    rotation: list[float]  # w, x, y, z of the rotation from the box to the world frame

    @classmethod
    def from_details(cls, sweep: _Row, pose: Floats, box: Mapping[str, Any]) -> _KeyFrameBox:
        (rotation,) = matrices(np.array([box["quaternion"]]))
        ((x, y, z, w),) = quaternions_of((pose[:3, :3] @ rotation)[None]).tolist()
        sign = -1 if w < 0 else 1
        position = pose[:3, :3] @ np.array(box["center"]) + pose[:3, 3]
        return cls(sweep, box, position, [sign * w, sign * x, sign * y, sign * z])


def _speed(boxes: Sequence[_KeyFrameBox]) -> float | None:
    """Return the mean speed of an object in m/s, or None if it has a single box."""
    first, last = boxes[0], boxes[-1]
    seconds = 1e-6 * (last.sweep["timestamp"] - first.sweep["timestamp"])
    if not seconds:
        return None
    offset = last.position - first.position
    return float(np.sqrt((offset**2).sum()) / seconds)


def _inside(points: Floats, box: _Row) -> Ints:
    """Return a mask of the points in an annotated box, including its surface."""
    w, x, y, z = box["rotation"]
    rotation = recorded_rotation((x, y, z, w), f"the annotation {box['token']}")
    width, length, height = box["size"]
    local = (points - np.array(box["translation"])) @ rotation
    return np.asarray((np.abs(local) <= np.array([length, width, height]) / 2).all(axis=1))
