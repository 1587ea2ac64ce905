"""Base class of the formats in which an augmented copy of a recording can be written.

Sweeps are encoded independently of each other by any number of processes, and their files are
collected in a folder. The files of a sweep do not depend on other sweeps, so an interrupted run can
be resumed. The driver assembles the data set from the folder.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from lidarfiles.clouds.recording import Recording
from lidarfiles.clouds.recording_ref import RecordingRef
from lidarsim.environment.extras import reading
from lidarsim.errors import LidarError
from lidarsim.words import list_names, plural

from ..augmented_sweep import AugmentedSweep
from .data_set_copy import MARK_FILE, check_target
from .stored_records import StoredRecords

_LONG_ENDINGS = (".pcd.bin",)  # endings of files whose format the suffix does not determine
DETAILS_FILE = ".details.json"  # stored with the other files of each sweep


@dataclass(frozen=True)
class EncodedSweeps:
    """Encoded sweeps of a recording.

    Attributes
    ----------
    folder
        Folder that contains a subfolder for each sweep, with the files that `Rewriter.sweep_files`
        returned.
    count
        Number of sweeps in the recording.
    """

    folder: Path
    count: int

    def path(self, number: int, name: str) -> Path:
        """Return the path of an encoded file of a sweep."""
        return self.folder / sweep_folder(number) / name

    def details(self) -> Iterator[dict[str, Any]]:
        """Yield the details of all sweeps in order."""
        for number in range(self.count):
            yield json.loads(self.path(number, DETAILS_FILE).read_bytes())

    def files(self) -> dict[str, Path]:
        """Return the paths of all encoded files of the data set, keyed by name."""
        return {
            name: self.path(details["number"], name)
            for details in self.details()
            for name in details["files"]
        }


def sweep_folder(number: int) -> str:
    """Return the name of the folder with the encoded files of a sweep."""
    return f"{number:08}"


class Rewriter(ABC):
    """Writer of an augmented copy of a recording in the format of the recording.

    Use `open_rewriter` to create the rewriter for a recording.

    Parameters
    ----------
    ref
        Reference to the recording, whose path is valid in this process.
    recording
        The recording, opened with `keep_noise=True`.
    """

    title: ClassVar[str] = ""  # proper name of the format

    def __init__(self, ref: RecordingRef, recording: Recording) -> None:
        self.ref = ref
        self.path = ref.path
        self.recording = recording

    @abstractmethod
    def encode(
        self, number: int, augmented: AugmentedSweep
    ) -> tuple[dict[str, bytes], dict[str, Any]]:
        """Return the files of a sweep, and JSON-serializable details for `assemble`.

        The names of the files are relative to the data set.
        """

    @abstractmethod
    def assemble(self, target: Path, encoded: EncodedSweeps, base: Path) -> list[str]:
        """Write the augmented copy, and return notes for the user.

        Parameters
        ----------
        target
            File or folder to write.
        encoded
            Encoded sweeps.
        base
            File or folder that contains everything else. This is the recording, or the target if
            the sweeps of another sensor have already been written there.
        """

    def sensors(self) -> Sequence[str]:
        """Return the names of all sensors, topics or sequences in the file or folder."""
        return [self.sensor]

    @property
    def sensor(self) -> str:
        """Name of the sensor, topic or sequence that is augmented."""
        return ""

    def sweep_files(self, number: int, augmented: AugmentedSweep) -> dict[str, bytes]:
        """Return the encoded files of an augmented sweep, keyed by name.

        The files depend only on the recording and on this sweep, and are the same in all processes.

        Parameters
        ----------
        number
            Number of the sweep in the recording.
        augmented
            The augmented sweep.

        Raises
        ------
        LidarError
            If the sweep cannot be read, or if the format cannot store its points.
        """
        with reading(self.recording.info.name):
            files, details = self.encode(number, augmented)
        details |= {"number": number, "files": sorted(files), "points": len(augmented.sweep)}
        return files | {DETAILS_FILE: json.dumps(details).encode()}

    @property
    def ending(self) -> str:
        """End of the name of the file that is written, or an empty string for a folder."""
        if self.path.is_dir():
            return ""
        return next(
            (ending for ending in _LONG_ENDINGS if self.path.name.lower().endswith(ending)),
            self.path.suffix.lower(),
        )

    def check_target(self, target: Path, *, overwrite: bool = False) -> None:
        """Raise LidarError unless the augmented copy can be written to a path."""
        check_target(target, self.path, overwrite=overwrite)
        if not target.name.lower().endswith(self.ending):
            raise LidarError(
                f"{target} does not end in {self.ending}, but a {self.ending} file is written. "
                f"Specify a path that ends in {self.ending}."
            )

    def finish(
        self, target: Path, encoded: Path, others: Sequence[tuple[Rewriter, Path]] = ()
    ) -> list[str]:
        """Write the augmented copy of the recording from the encoded sweeps.

        Sweeps are read one after the other, and are not modified.

        Parameters
        ----------
        target
            File or folder to write, depending on the kind of the recording. It does not exist, and
            nothing else is in its folder.
        encoded
            Folder with the encoded files of all sweeps (see `EncodedSweeps`).
        others
            Rewriters of other sensors in the same recording, with their folders. Their sweeps are
            written to the same target.

        Returns
        -------
        Sentences for the user about files and values that were linked, kept or lost.

        Raises
        ------
        LidarError
            If the recording cannot be read.
        """
        parts = [
            (rewriter, EncodedSweeps(folder, len(rewriter.recording)))
            for rewriter, folder in ((self, encoded), *others)
        ]
        notes = self._sensor_notes([rewriter.sensor for rewriter, _ in parts])
        base = self.path
        for rewriter, sweeps in parts:
            with reading(self.ref.name):
                notes += rewriter.assemble(target, sweeps, base)
            base = target
        if target.is_dir():
            (target / MARK_FILE).write_text("Written by lidarpool augment.\n")
        return list(dict.fromkeys(notes))

    def _sensor_notes(self, chosen: Sequence[str]) -> list[str]:
        """Return a note if the sweeps of some sensors are unchanged."""
        unchanged = [name for name in self.sensors() if name not in chosen]
        if not unchanged:
            return []
        verb = "is" if len(unchanged) == 1 else "are"
        return [
            (
                f"Only the sweeps of {list_names(chosen)} were augmented. {list_names(unchanged)} "
                f"in {self.ref.name} {verb} unchanged."
            )
        ]

    def stored_records(self, number: int, records: Any) -> StoredRecords:
        """Combine the records of a file with the points of the recording."""
        recording = self.recording
        return StoredRecords(
            records, recording[number], recording.info.meters, recording.info.intensity_column
        )


def box_details(augmented: AugmentedSweep) -> list[dict[str, Any]]:
    """Return JSON-serializable descriptions of the boxes of inserted objects.

    The visibility is None if it is unknown.
    """
    boxes = augmented.boxes
    visibility = np.asarray(augmented.visibility, np.float64)
    shares = visibility.tolist() if len(visibility) == len(boxes) else [None] * len(boxes)
    return [
        {
            "name": name,
            "type": kind,
            "object": int(number),
            "center": center,
            "quaternion": quaternion,
            "size": size,
            "points": int(points),
            "visibility": share,
        }
        for name, kind, number, center, quaternion, size, points, share in zip(
            boxes.names,
            boxes.types,
            boxes.objects,
            boxes.centers.tolist(),
            boxes.quaternions.tolist(),
            boxes.sizes.tolist(),
            boxes.points,
            shares,
            strict=True,
        )
    ]


def organization_notes(details: Iterator[Mapping[str, Any]]) -> list[str]:
    """Return a note if clouds are not organized any more."""
    lost = sum(bool(sweep.get("unorganized")) for sweep in details)
    if not lost:
        return []
    return [
        (
            f"{plural(lost, 'sweep')} cannot stay organized, because not every added return has a "
            "free cell. Their height is 1, and they contain no points for pulses without a return."
        )
    ]
