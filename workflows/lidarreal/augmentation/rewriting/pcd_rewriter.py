"""Augmented copies of .pcd files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lidarfiles.clouds.pcd import point_files
from lidarfiles.clouds.recording import Recording
from lidarfiles.clouds.recording_ref import RecordingRef
from lidarsim.io.input_files import read_input
from lidarsim.scene.files.pcd import PCDRecords

from ..augmented_sweep import AugmentedSweep
from .data_set_copy import copy_data_set, place_file
from .rewriter import EncodedSweeps, Rewriter, organization_notes
from .stored_records import unchanged


class PCDRewriter(Rewriter):
    """Writer of an augmented .pcd file, or of a folder with one .pcd file per sweep.

    The fields, the header lines, and the kind of DATA stay the same. Other files in the folder are
    linked or copied.
    """

    title = "PCD"

    def __init__(self, ref: RecordingRef, recording: Recording) -> None:
        super().__init__(ref, recording)
        self._files = point_files(self.path)

    def encode(
        self, number: int, augmented: AugmentedSweep
    ) -> tuple[dict[str, bytes], dict[str, Any]]:
        """Return the file of a sweep."""
        file = self._files[number]
        pcd = PCDRecords.read(file)
        stored = self.stored_records(number, pcd.records)
        rows = stored.augment(augmented)
        template = np.asarray(augmented.template, np.intp)
        details: dict[str, Any] = {"boxes": len(augmented.boxes)}
        height = 1
        if pcd.height > 1:
            organized = stored.organize(rows, augmented)
            if organized is None:
                returned = np.isfinite(augmented.sweep.points).all(axis=1)
                rows, template = rows[returned], template[returned]
                details["unorganized"] = True
            else:
                rows, template = organized, np.arange(len(organized))
                height = pcd.height
        if unchanged(rows, pcd.records, template):
            return {file.name: read_input(file)}, details
        return {file.name: pcd.encode(rows, template, height)}, details

    def assemble(self, target: Path, encoded: EncodedSweeps, base: Path) -> list[str]:
        """Write the file, or the folder with all files."""
        notes = organization_notes(encoded.details())
        if any(sweep["boxes"] for sweep in encoded.details()):
            notes.append("PCD files cannot store the boxes of inserted objects.")
        if not self.path.is_dir():
            place_file(encoded.path(0, self.path.name), target)
            return notes
        files = encoded.files()
        notes += copy_data_set(base, target, files)
        for name, path in files.items():
            place_file(path, target / name)
        return notes
