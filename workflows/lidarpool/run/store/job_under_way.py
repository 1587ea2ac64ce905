"""A job under way, and how a run reads its committed parts."""

from __future__ import annotations

import errno
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from lidarsim.base.arrays import Floats32, Ints
from lidarsim.base.errors import LidarError
from lidarsim.base.storage import Storage
from lidarsim.columns.cloud import Cloud
from lidarsim.sweeps.sweeps import Sweeps

from ...columns.parts import StoredCloud, read_part, read_tally, unpack
from ...scenario.job import Job
from ..pipeline.pipeline_job import PipelineJob
from ..pipeline.stage_messages import Receipt, samples_of_scan, summary_type
from ..progress import Progress

SAMPLE_RAYS = 400  # rays in pictures of a survey, about


class JobUnderWay(PipelineJob):
    """A job from its first batch until it is written, with access to its parts.

    Parameters
    ----------
    job
        The job.
    scans
        Scans of the job that are to be cast.
    storage
        Storage of the job's parts.
    summaries
        Returns the summaries of a committed part.
    has_frames
        True if scans are handed out as frames, too.
    keeper
        Object that must live as long as the points are in use: the parts are deleted with it.
    """

    def __init__(
        self,
        job: Job,
        scans: range,
        storage: Storage,
        summaries: Callable[[Receipt], bytes],
        *,
        has_frames: bool = False,
        keeper: object = None,
    ) -> None:
        super().__init__(job.number, job.scene, job.survey, scans, has_frames=has_frames)
        self.job = job
        self.storage = storage
        self.resumed = 0  # scans whose points are of an earlier run
        self.is_identified = False  # True if the store knows what the job is made of
        self._summaries = summaries
        self._keeper = keeper

    def receipt(self, name: str) -> Receipt | None:
        """Return the receipt of a part in storage, or None if the part is damaged."""
        try:
            data = self.storage.read(name)
            return Receipt.from_part(unpack(data), self.number, name, len(data))
        except LidarError:
            return None
        except OSError as error:
            if error.errno in (errno.EIO, errno.ENOENT):  # a bad disk, or the part was just removed
                return None
            raise LidarError(
                f"The part {self.storage.path(name)} cannot be read: {error.strerror or error}."
            ) from error

    @property
    def committed_in_words(self) -> str:
        """Number of committed scans or trials in words, or no text if nothing is committed."""
        if self.parts.scans_done:
            return f"{self.parts.scans_done:,} of {len(self.scans):,} scans"
        if self.trials:
            return f"{len(self.trials):,} of {self.job.trials:,} planning trials"
        return ""

    @property
    def complete(self) -> bool:
        """True if all scans and planning trials are committed, and all frames were handed out."""
        return self.scans_complete and len(self.trials) == self.job.trials

    def progress(self) -> Progress:
        """Return the progress of a resumed run at its start."""
        framed = self.frames - self.scans.start
        start = self.scans.start
        stop = self.scans.stop
        return Progress(
            scans=len(self.scans),
            generated=framed,
            cast=self.parts.scans_done,
            framed=framed,
            collected=self.parts.scans_done,
            points=self.parts.point_count,
            trials=self.job.trials,
            trials_done=len(self.trials),
            sweeps=self.survey.sweeps_within(start, stop),
            sweeps_done=self.survey.sweeps_within(start, min(self.frames, stop)),
        )

    def status(self, *, is_writing: bool) -> dict[str, Any]:
        """Return name, values and progress of the job for a page.

        `stored` is the number of its `scans` in storage, and `points` the number of their points;
        `seconds` is the casting time so far, and `writing` is True while its files are written.
        """
        return {
            "name": self.job.name,
            "values": self.job.values,
            "stored": self.parts.scans_done,
            "scans": len(self.scans),
            "points": self.parts.point_count,
            "seconds": self.seconds,
            "writing": is_writing,
        }

    def points(self) -> StoredCloud:
        """Return the points that are committed so far."""
        parts = self.parts.ordered
        job = self.job
        world = job.survey.coordinates == "world"
        return StoredCloud(
            storage=self.storage,
            names=[part.name for part in parts],
            firsts=[part.first for part in parts],
            rows=[part.point_count for part in parts],
            columns=job.survey.stored_columns,
            cells=self.parts.cell_box,
            precision_m=job.survey.precision_m,
            origin=job.scene.origin if world else np.zeros(3),
            keeper=self._keeper,
            sweeps=partial(Sweeps.from_survey, job.survey, job.scene),
        )

    def points_of_scan(self, scan: int) -> Cloud:
        """Return the points of a committed scan."""
        part = self.parts.part_of(scan)
        columns = read_part(self.storage, part.name)
        stops = np.cumsum(columns.counts)
        index = scan - part.first
        rows = slice(int(stops[index] - columns.counts[index]), int(stops[index]))
        return self.points().cloud_of(columns, rows)

    def hit_counts(self) -> Ints:
        """Return the committed hits by hit counters of the scene: (counters,).

        A face of the scene, an instance, and a triangle of an actor have a counter each
        (`Scene.counters`).
        """
        counts = np.zeros(self.job.scene.counters, np.int64)
        for part in self.parts.ordered:
            counters, hits = read_tally(self.storage, part.name)
            counts[counters] += hits
        return counts

    def sample_rays(self) -> Floats32:
        """Return starts and ends of sample rays, (k, 2, 3), meters, local coordinates."""
        survey = self.job.survey
        samples = samples_of_scan(survey.scan_count)
        dtype = summary_type(samples)
        step = max(1, samples * survey.scan_count // SAMPLE_RAYS)
        rays = [np.empty((0, 2, 3), np.float32)]
        sampled_scans = range(0, survey.scan_count, step)
        chosen = {scan for scan in sampled_scans if not self.parts.missing(scan, scan + 1)}
        parts = {part.first: part for part in map(self.parts.part_of, sorted(chosen))}
        for part in parts.values():
            for scan, summary in enumerate(np.frombuffer(self._summaries(part), dtype), part.first):
                end_points = summary["samples"][~np.isnan(summary["samples"][:, 0])]
                if scan in chosen and len(end_points):
                    start = np.asarray(survey.pose(scan).position, np.float32)
                    starts = np.broadcast_to(start, end_points.shape)
                    rays.append(np.stack([starts, end_points], axis=1))
        return np.concatenate(rays)
