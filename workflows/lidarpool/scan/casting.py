"""Stage 2: what becomes of one item on a GPU worker."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from poolpart import Recorder, TaskRecord, trace
from raybeam import Returns

from ..survey import Pose, ScanSpec
from .failures import naming_scans
from .messages import HIT, Batch, Frame
from .setup import SurveySetup, ray_directions
from .stage_names import GPU, INTERSECT

SAMPLES_PER_SCAN = 4  # rays of each scan that are shown in pictures


def intersect(setup: SurveySetup, wire: Sequence[Sequence[float]], run: str = "") -> Batch:
    """Cast the rays of some scans; runs on a GPU worker.

    Parameters
    ----------
    setup
        Scene and sensor.
    wire
        The scans, as `ScanSpec.wire` describes them.
    run
        Id of the survey, for traces.

    Raises
    ------
    RuntimeError
        If casting fails, naming the scans.
    """
    recorder = Recorder(INTERSECT, GPU)
    specs = tuple(ScanSpec.from_wire(numbers) for numbers in wire)
    scans = [spec.scan for spec in specs]
    trace("intersect.start", run=run, stage=INTERSECT, scans=scans)
    frames: list[Frame] = []
    tables: list[NDArray[np.void]] = []
    for pose, group in _same_pose(specs):
        with naming_scans(group[0].scan, group[-1].scan):
            hits = setup.cast(pose, (group[0].azimuths[0], group[-1].azimuths[1]))
        for spec, part in _by_scan(setup, group, hits):
            frames.append(_frame(setup, spec, part))
            table = np.empty(len(part), HIT)
            table["ray"], table["distance"] = part.ray, part.distance
            table["object"] = setup.scene.face_object[part.triangle]
            tables.append(table)
    trace("intersect.cast", run=run, stage=INTERSECT, scans=scans)
    batch = Batch(
        scans=specs,
        hits=np.concatenate(tables),
        hit_counts=tuple(len(table) for table in tables),
        frames=tuple(frames),
        record=recorder.done(len(specs)),
    )
    trace("intersect.end", run=run, stage=INTERSECT, scans=scans)
    return batch


def frames_of(batch: Batch) -> tuple[tuple[Frame, ...], TaskRecord]:
    """Take out the frames: a key of their own, so that stage 3 fetches no hits with them."""
    return batch.frames, batch.record


def _same_pose(specs: Sequence[ScanSpec]) -> Iterator[tuple[Pose, list[ScanSpec]]]:
    """Find runs of scans from one pose whose azimuths follow on: they are cast in one go."""
    run: list[ScanSpec] = []
    for spec in specs:
        if run and (spec.pose != run[-1].pose or spec.azimuths[0] != run[-1].azimuths[1]):
            yield run[0].pose, run
            run = []
        run.append(spec)
    if run:
        yield run[0].pose, run


def _by_scan(
    setup: SurveySetup, group: Sequence[ScanSpec], hits: Returns
) -> Iterator[tuple[ScanSpec, Returns]]:
    """Divide the hits of neighbouring scans; ray numbers then start at 0 in each scan."""
    layers = setup.sensor.layers
    starts = np.array([s.azimuths[0] - group[0].azimuths[0] for s in group]) * layers
    cuts = [*np.searchsorted(hits.ray, starts), len(hits.ray)]
    for spec, start, i, j in zip(group, starts, cuts, cuts[1:], strict=False):
        yield spec, Returns(hits.ray[i:j] - start, hits.distance[i:j], hits.triangle[i:j])


def _frame(setup: SurveySetup, spec: ScanSpec, hits: Returns) -> Frame:
    triangles, counts = np.unique(hits.triangle, return_counts=True)
    few = np.unique(np.linspace(0, len(hits.ray) - 1, SAMPLES_PER_SCAN).astype(int))
    few = few[: len(hits.ray)]
    ends = hits.distance[few, None] * ray_directions(setup.sensor, spec, hits.ray[few])
    return Frame(
        scan=spec.scan,
        pose=spec.pose,
        rays=spec.ray_count(setup.sensor),
        hits=len(hits.ray),
        triangles=triangles.astype(np.int32),
        counts=counts.astype(np.int32),
        samples=(ends + spec.pose.position).astype(np.float32),
    )
