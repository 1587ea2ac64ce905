"""Recordings of Rerun: clouds, frames, boxes of actors, trajectories, path and scene over time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from .cloud_format import CloudFormat
from .shown_sweeps import Surroundings, SweepSequence

if TYPE_CHECKING:
    from .writing import ExportSpec


class Rerun(CloudFormat):
    """A recording of Rerun, with scene and planned path of the pictures' content.

    Points are at `map/base_link/NAME/points`, in the sensor frame at the start of their sweep, with
    all columns; `map/base_link` and its sensors have their poses over time. The boxes of actors are
    `map/actors`; `map/scene`, `map/trajectories` and `map/path` do not change. Positions are
    float32 in Rerun, so those in the world are relative to the scene's local origin, which the
    recording's property `origin` holds. Rerun's own identifiers make the bytes of each file unique.
    """

    title = "RRD"
    by_sweep = True
    frame = "sweep"
    required = ("object",)
    actor_boxes = True

    def write(self, path: Path, spec: ExportSpec) -> None:
        """Write the file."""
        from .rerun_log import RerunLog, recording_to

        with recording_to(path) as recording:
            log = RerunLog(recording)
            log.show_surroundings(Surroundings.from_sweeps(self.sweeps, self.content()))
            sequence = SweepSequence(self.sweeps)
            for sweep, points in enumerate(self.sweeps.points(self.cloud)):
                log.show_sweep(sequence.show(sweep, points))
