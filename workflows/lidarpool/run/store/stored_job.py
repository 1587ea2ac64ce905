"""Committed results of a job that are read from the run store."""

from __future__ import annotations

import errno
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from lidarfiles.parts.parts import StoredCloud, read_actor_rays, read_hit_counts, read_part, unpack
from lidarscenario.job import Job
from lidarscenario.plan import Trial
from lidarsim.columns.cloud import Cloud
from lidarsim.errors import LidarError
from lidarsim.io.storage import Storage
from lidarsim.numerics.arrays import Floats32, Ints
from lidarsim.sweeps.sweeps import Sweeps

from ..pipeline.committed_results import CommittedParts, CommittedResults
from ..pipeline.stage_messages import (
    SAMPLES_PER_SURVEY,
    Receipt,
    ScanFrame,
    Summaries,
    samples_of_scan,
    summary_type,
)
from ..progress import Progress
from .database import RunDatabase


@dataclass(frozen=True, eq=False)
class StoredJob:
    """Job whose committed results are in a run store.

    Parameters
    ----------
    job
        Job of the run.
    committed
        Committed results of the job, which grow during the run.
    storage
        Storage of the job's parts.
    db
        Database of the run.
    resumed
        Number of scans whose points come from an earlier run.
    keeper
        Object that must exist as long as the points are in use, because the parts may be deleted
        when it is garbage collected.
    """

    job: Job
    committed: CommittedResults
    storage: Storage
    db: RunDatabase
    resumed: int = 0
    keeper: object = None

    @property
    def scans(self) -> range:
        """Scans of the job that this run casts."""
        return self.committed.scans

    @property
    def parts(self) -> CommittedParts:
        """Committed parts of the job."""
        return self.committed.parts

    @property
    def trials(self) -> list[Trial]:
        """Committed planning trials of the job."""
        return self.committed.trials

    def receipt(self, name: str) -> Receipt | None:
        """Create the receipt of a stored part, or return None if the part is damaged."""
        try:
            data = self.storage.read(name)
            return Receipt.from_part(unpack(data), self.job.number, name, len(data))
        except LidarError:
            return None
        except OSError as error:
            if error.errno in (errno.EIO, errno.ENOENT):  # disk error, or the part was removed
                return None
            raise LidarError(
                f"The part {self.storage.path(name)} cannot be read: {error.strerror or error}."
            ) from error

    @property
    def committed_text(self) -> str:
        """Number of committed scans or trials as text, or an empty string if there are none."""
        if self.parts.scans_done:
            return f"{self.parts.scans_done:,} of {len(self.scans):,} scans"
        if self.trials:
            return f"{len(self.trials):,} of {self.job.trials:,} planning trials"
        return ""

    @property
    def is_complete(self) -> bool:
        """True if all scans and trials have been committed and all frames delivered."""
        return self.committed.scans_complete and len(self.trials) == self.job.trials

    def progress(self) -> Progress:
        """Return the progress of the job, computed from its committed results."""
        start = self.scans.start
        stop = self.scans.stop
        frames = self.committed.frames
        survey = self.job.survey
        return Progress(
            scans=len(self.scans),
            generated=frames - start,
            cast=self.parts.scans_done,
            framed=frames - start,
            collected=self.parts.scans_done,
            points=self.parts.point_count,
            trials=self.job.trials,
            trials_done=len(self.trials),
            sweeps=survey.sweeps_within(start, stop),
            sweeps_done=survey.sweeps_within(start, min(frames, stop)),
        )

    def points(self) -> StoredCloud:
        """Return all points that have been committed so far."""
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
            keeper=self.keeper,
            sweeps=partial(_sweeps, job, self.storage, [part.name for part in parts]),
        )

    def sweeps(self) -> Sweeps:
        """Return the sweeps of the job, with the visibility of actors if the survey determines it.

        All scans must have been committed.
        """
        return _sweeps(self.job, self.storage, [part.name for part in self.parts.ordered])

    def read_scan(self, scan: int) -> Cloud:
        """Return the points of a committed scan."""
        part = self.parts.part_of(scan)
        columns = read_part(self.storage, part.name)
        stops = np.cumsum(columns.counts)
        index = scan - part.first
        rows = slice(int(stops[index] - columns.counts[index]), int(stops[index]))
        return self.points().cloud_of(columns, rows)

    def frames(self, summaries: Summaries) -> Iterator[ScanFrame]:
        """Yield a frame for each scan in `summaries` that has not been delivered yet."""
        survey = self.job.survey
        dtype = summary_type(samples_of_scan(survey.scan_count))
        for scan, summary in zip(
            summaries.scans, np.frombuffer(summaries.data, dtype), strict=True
        ):
            if scan < self.committed.frames:
                continue
            samples = summary["samples"]
            spec = survey.scan(scan)
            yield ScanFrame(
                scan=scan,
                sensor=survey.mounted_sensors[spec.sensor].name,
                rays=spec.ray_count,
                hit_count=int(summary["hits"]),
                count=int(summary["points"]),
                samples=samples[~np.isnan(samples[:, 0])],
                _triangles=self.job.scene.triangles,
                _survey=survey,
                _read=self.read_scan,
            )

    def hit_counts(self) -> Ints:
        """Return the number of committed hits of each hit counter in the scene.

        Returns
        -------
        int64 array of shape (counters,). Each face of the scene, each instance, and each triangle
        of an actor has a counter (`Scene.counters`).
        """
        counts = np.zeros(self.job.scene.counters, np.int64)
        for part in self.parts.ordered:
            counters, hits = read_hit_counts(self.storage, part.name)
            counts[counters] += hits
        return counts

    def sample_rays(self) -> Floats32:
        """Return the start and end points of sample rays in local coordinates, in meters.

        Returns
        -------
        float32 array of shape (k, 2, 3).
        """
        survey = self.job.survey
        samples = samples_of_scan(survey.scan_count)
        dtype = summary_type(samples)
        step = max(1, samples * survey.scan_count // SAMPLES_PER_SURVEY)
        rays = [np.empty((0, 2, 3), np.float32)]
        sampled_scans = range(0, survey.scan_count, step)
        chosen = {scan for scan in sampled_scans if not self.parts.missing(scan, scan + 1)}
        parts = {part.first: part for part in map(self.parts.part_of, sorted(chosen))}
        for part in parts.values():
            for scan, summary in enumerate(
                np.frombuffer(self.db.summaries(part), dtype), part.first
            ):
                end_points = summary["samples"][~np.isnan(summary["samples"][:, 0])]
                if scan in chosen and len(end_points):
                    start = np.asarray(survey.pose(scan).position, np.float32)
                    starts = np.broadcast_to(start, end_points.shape)
                    rays.append(np.stack([starts, end_points], axis=1))
        return np.concatenate(rays)


def _sweeps(job: Job, storage: Storage, names: Sequence[str]) -> Sweeps:
    """Return the sweeps of a job whose parts have the given names."""
    if not job.survey.actor_visibility:
        return job.sweeps
    return job.sweeps.with_actor_rays(read_actor_rays(storage, name) for name in names)
