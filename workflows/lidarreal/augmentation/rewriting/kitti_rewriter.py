"""Augmented copies of KITTI, SemanticKITTI and KITTI object data sets, and of .bin files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lidarfiles.clouds.kitti import CALIBRATION_FILE, MAX_INSTANCES, point_files, sequence_folders
from lidarfiles.clouds.recording import Recording
from lidarfiles.clouds.recording_ref import RecordingRef
from lidarsim.errors import LidarError
from lidarsim.io.input_files import read_input, read_input_text
from lidarsim.numerics.arrays import Ints
from lidarsim.scene.files.float_rows import columns_by_name
from lidarsim.words import list_names, plural

from ..augmented_sweep import AugmentedSweep
from .data_set_copy import copy_data_set, place_file
from .kitti_labels import KittiCamera, Label
from .rewriter import EncodedSweeps, Rewriter
from .stored_records import StoredRecords, unchanged

_CLASS_BITS = 16
_MAX_CLASS = (1 << _CLASS_BITS) - 1


class KittiRewriter(Rewriter):
    """Writer of augmented KITTI folders and .bin files.

    It supports folders of .bin files, sequences of SemanticKITTI and of our own exports, KITTI raw
    data, and the KITTI object benchmark (`training`). Points and their labels are written anew. The
    labels of inserted objects are appended to `label_2` and `label_02`. All other files are linked
    or copied.
    """

    title = "KITTI"

    def __init__(self, ref: RecordingRef, recording: Recording) -> None:
        super().__init__(ref, recording)
        if self.path.is_dir():
            self._folder, points = sequence_folders(self.path)[recording.info.sequence]
            self._files = point_files(points)
        else:
            self._folder = self.path.parent.parent
            self._files = [self.path]
        self._camera: KittiCamera | None = None

    def encode(
        self, number: int, augmented: AugmentedSweep
    ) -> tuple[dict[str, bytes], dict[str, Any]]:
        """Return the point file of a sweep, and its label files if they exist."""
        file = self._files[number]
        row = np.dtype([(name, "<f4") for name in columns_by_name(file)])
        records = np.frombuffer(read_input(file), row)
        stored = self.stored_records(number, records)
        rows = stored.augment(augmented)
        files = {self._name(file): rows.tobytes()}
        template = np.asarray(augmented.template, np.intp)
        details: dict[str, Any] = {"changed": not unchanged(rows, records, template)}
        if not self.path.is_dir():
            return files, details | {"boxes": len(augmented.boxes)}
        label_file = self._folder / "labels" / f"{file.stem}.label"
        details["unlabeled"] = not label_file.exists()
        if not details["unlabeled"]:
            numbers = np.frombuffer(read_input(label_file), "<u4")[template]
            files[self._name(label_file)] = _labels(numbers, stored, augmented).tobytes()
        labels = self._box_labels(file, augmented)
        details["boxes"] = len(augmented.boxes)
        if labels is not None:
            details["labels"] = len(labels)
            frame = int(file.stem) if file.stem.isdecimal() else number
            details["tracks"] = [label.track_line(frame) for label in labels]
        if labels:
            box_file = self._folder / "label_2" / f"{file.stem}.txt"
            text = read_input_text(box_file) if box_file.exists() else ""
            text += "" if text.endswith("\n") or not text else "\n"
            text += "".join(label.line for label in labels)
            files[self._name(box_file)] = text.encode()
        return files, details

    def _name(self, file: Path) -> str:
        return file.relative_to(self.path).as_posix() if self.path.is_dir() else file.name

    def _box_labels(self, file: Path, augmented: AugmentedSweep) -> list[Label] | None:
        """Return the labels of the inserted objects, or None if the data set has no labels."""
        if not (self._folder / "label_2").is_dir():
            return None
        if not len(augmented.boxes):
            return []
        frame_calibration = self._folder / "calib" / f"{file.stem}.txt"
        if frame_calibration.exists():
            image = self._folder / "image_2" / f"{file.stem}.png"
            camera = KittiCamera.from_object_benchmark(frame_calibration, image)
            return list(camera.labels(augmented))
        if self._camera is None:
            self._camera = KittiCamera.from_sequence(self._folder / CALIBRATION_FILE)
        return list(self._camera.labels(augmented))

    def sensors(self) -> list[str]:
        """Return the names of all sequences."""
        return [*sequence_folders(self.path)] if self.path.is_dir() else [""]

    @property
    def sensor(self) -> str:
        """Name of the sequence."""
        return self.recording.info.sequence

    def assemble(self, target: Path, encoded: EncodedSweeps, base: Path) -> list[str]:
        """Write the file, or the folder with all files of the data set."""
        if not self.path.is_dir():
            place_file(encoded.path(0, self.path.name), target)
            has_labels = (self._folder / "labels" / f"{self.path.stem}.label").exists()
            return [_SINGLE_FILE] if has_labels else []
        files = encoded.files()
        notes = self._notes(encoded)
        if base != target:
            notes += copy_data_set(base, target, files)
        for name, path in files.items():
            place_file(path, target / name)
        tracks_file = target / f"label_02/{self._folder.name}.txt"
        tracks = [line for sweep in encoded.details() for line in sweep.get("tracks", ())]
        if tracks and tracks_file.exists():
            tracks_file.write_text(_merge_tracks(read_input_text(tracks_file), tracks))
        return notes

    def _notes(self, encoded: EncodedSweeps) -> list[str]:
        notes = []
        boxes = labels = 0
        has_labels = False
        unlabeled = []
        for sweep in encoded.details():
            if sweep.get("unlabeled"):
                unlabeled.append(f"{self._files[sweep['number']].stem}.label")
            boxes += sweep["boxes"]
            labels += sweep.get("labels", 0)
            has_labels |= "labels" in sweep
        if unlabeled and (self._folder / "labels").is_dir():
            notes.append(
                f"{self.ref.name} has no {list_names(unlabeled)} in the folder `labels`, so the "
                "points of these sweeps are not labeled in the copy."
            )
        if boxes and not has_labels:
            notes.append(
                f"{self.ref.name} has no folder `label_2`, so the boxes of inserted objects are "
                "not stored."
            )
        elif labels < boxes:
            notes.append(
                f"{boxes - labels:,} of {plural(boxes, 'box', 'boxes')} of inserted objects were "
                "not labeled, because the object has no points or is outside the image."
            )
        if labels:
            notes.append(
                "The labels of recorded objects are unchanged, even if inserted objects hide them."
            )
        if not (self._folder / "labels").is_dir() and boxes:
            notes.append(
                f"{self.ref.name} has no semantic labels, so the classes of inserted points are "
                "not stored."
            )
        return notes


_SINGLE_FILE = (
    "The labels of the sweep are not written with a single .bin file. To write them, specify the "
    "folder of the sequence."
)


def _labels(labels: Ints, stored: StoredRecords, augmented: AugmentedSweep) -> Ints:
    """Return the SemanticKITTI labels of augmented points.

    Parameters
    ----------
    labels
        (n,): labels of the templates, which are kept unless the class or the object differs.
    stored
        The recorded points.
    augmented
        The augmented points.
    """
    template = np.asarray(augmented.template, np.intp)
    classes = labels & _MAX_CLASS
    instances = labels >> _CLASS_BITS
    columns = augmented.sweep.columns
    recorded = stored.recorded.columns
    if "class" in columns:
        values = np.asarray(columns["class"])
        changed = values != recorded["class"][template]
        classes = np.where(changed, values.clip(0, _MAX_CLASS), classes)
    if "object" in columns:
        objects = np.asarray(columns["object"], np.int64)
        if objects.max(initial=-1) >= MAX_INSTANCES:
            raise LidarError(
                f"KITTI labels support at most {MAX_INSTANCES:,} objects, but an inserted object "
                f"has the number {objects.max():,}. Remove instances from the labels, or write "
                "another format with `--format`."
            )
        changed = objects != recorded["object"][template]
        instances = np.where(changed, objects + 1, instances)
    return np.asarray(instances.astype("<u4") << _CLASS_BITS | classes.astype("<u4"), "<u4")


def _merge_tracks(text: str, tracks: list[str]) -> str:
    """Insert track lines after the lines of the same frame."""
    lines = [*text.splitlines(keepends=True), *tracks]
    lines = [line if line.endswith("\n") else f"{line}\n" for line in lines if line.strip()]
    lines.sort(key=lambda line: int(line.split(maxsplit=1)[0]))
    return "".join(lines)
