"""A job in the pipeline: which scans are committed, handed out as frames, and cast."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

import numpy as np

from lidarsim.columns.cloud import Cloud
from lidarsim.scene.scene import Scene
from lidarsim.survey.survey import Survey

from ...base.tracing import trace
from .committed_job import CommittedJob
from .stage_messages import Receipt, ScanFrame, Summaries, samples_of_scan, summary_type
from .stage_names import SORT


class PipelineJob(CommittedJob):
    """A job in the pipeline.

    Subclasses say where the points of its scans are read.

    Parameters
    ----------
    number
        Number of the job in its run.
    scene, survey
        Scene, and the sensors and scans of the survey.
    scans
        Scans that are to be done.
    has_frames
        True if scans are handed out as frames, too.
    """

    def __init__(
        self, number: int, scene: Scene, survey: Survey, scans: range, *, has_frames: bool = False
    ) -> None:
        super().__init__(number, scans, has_frames=has_frames)
        self.scene = scene
        self.survey = survey
        # How the pipeline casts it; `Pipeline.begin` sets these.
        self.run = ""  # id of the run, for traces
        self.packed = b""  # the survey, pickled
        self.scene_name = ""  # jobs of one scene may be cast in one task
        self.scans_per_task = 1  # scans that fit into the memory of a casting task
        self.scans_of_run = 0  # scans of all jobs, where many jobs are like this one
        self.on_frame: Callable[[ScanFrame], None] | None = None
        self.on_parts: Callable[[list[Receipt]], None] | None = None
        # Progress of the pipeline.
        self.generated = scans.start  # one past the last scan that was taken from stage 1
        self.cast = 0  # scans that stage 2 has finished
        self.offered_again = 0  # batches
        self.seconds = 0.0  # casting time of committed batches
        self.condemned: list[str] = []  # why scans cannot be done
        self.sorted_at = time.monotonic()  # when the last frames came

    def points_of_scan(self, scan: int) -> Cloud:
        """Return the points of a committed scan."""
        raise NotImplementedError

    def trace(self, event: str, stage: str, scans: Iterable[int], **details: str) -> None:
        """Emit a trace event of the driver about scans of this job."""
        details |= {"run": self.run, "stage": stage}
        trace(f"driver.{event}", job=self.number, scans=list(scans), **details)

    def hand_out(self, ordered: Summaries) -> int:
        """Hand out frames in scan order, and return the number of frames that are new."""
        self.sorted_at = time.monotonic()
        earlier = self.frames
        survey = self.survey
        dtype = summary_type(samples_of_scan(survey.scan_count))
        for scan, summary in zip(ordered.scans, np.frombuffer(ordered.data, dtype), strict=True):
            if scan != self.frames:
                continue
            assert self.on_frame is not None, "it has frames"
            samples = summary["samples"]
            spec = survey.scan(scan)
            frame = ScanFrame(
                scan=scan,
                sensor=survey.carried[spec.sensor].name,
                rays=spec.ray_count,
                hit_count=int(summary["hits"]),
                count=int(summary["points"]),
                samples=samples[~np.isnan(samples[:, 0])],
                _triangles=self.scene.triangles,
                _survey=survey,
                _read=self.points_of_scan,
            )
            self.trace("frame", SORT, [scan])
            self.on_frame(frame)
            # Only now: after an error of the caller the frame is handed out again.
            self.frames = scan + 1
            self.trace("release", SORT, [scan])
        return self.frames - earlier
