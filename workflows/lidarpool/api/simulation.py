"""Runs from Python: `simulate`, and campaigns of many jobs into a data set."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Unpack

from pydantic import Field

from lidarsim.base.declared import declared
from lidarsim.base.errors import LidarError
from lidarsim.base.storage import Storage
from lidarsim.base.validation import checked
from lidarsim.base.words import did_you_mean
from lidarsim.scene.scene import Scene
from lidarsim.simulator.casting.scene_caster import check_backend_here
from lidarsim.survey.survey import Survey

from ..base.shard import Shard
from ..clouds.folder import output_place
from ..plan import Planning
from ..report.campaign_output import DataSetOutput
from ..run.job_source import OneJob
from ..run.options import RunKeywords, RunOptions, options_of_call
from ..run.pipeline.stage_messages import ScanFrame
from ..run.progress import Progress, Screen
from ..run.run_result import CampaignRun, RunResult
from ..run.runner import Run, StoredOutput
from ..run.store.run_store import RUN_FOLDER
from ..run.stream import SweepStream
from ..scenario import campaign as described
from ..scenario.build import Job
from ..showing.pages import page_of
from .result import Result

# Options without a meaning in a call: a survey has no data set, a campaign plans no paths, and its
# run is stored beside the data set; a stream stores nothing and has no stages 1 and 4.
_NOT_OF_SURVEYS = ("restart", "retry_failed", "verify", "overwrite")
_NOT_OF_CAMPAIGNS = ("folder", "other_workers", "pace")
_NOT_OF_STREAMS = (
    *_NOT_OF_SURVEYS,
    *_NOT_OF_CAMPAIGNS,
    "parts",
    "resume",
    "live",
    "collectors",
    "queue_capacity",
)


@checked
def simulate(
    scene: Scene,
    survey: Survey,
    planning: Planning | None = None,
    *,
    on_frame: Callable[[ScanFrame], None] | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    **options: Unpack[RunKeywords],
) -> Result:
    """Simulate a survey of a scene on a cluster, and plan a path at the same time.

    Parameters
    ----------
    scene, survey
        The scene and the survey. Poses are in the local coordinates of the scene.
    planning
        The path to plan on the OTHER partition while the survey runs, or None.
    on_frame
        Function that is called with each frame, in scan order, while the survey runs. The points of
        the frame are already stored (`ScanFrame.points`, `ScanFrame.hit_counts`). The function is
        called in this thread. If it is slow, the pipeline waits and no frame is lost.
    on_progress
        Function that is called with the progress about ten times per second. By default, progress
        bars are shown in notebooks and terminals.

    Other Parameters
    ----------------
    client
        Client of a cluster whose workers declare the resources GPU, LIDAR and OTHER. During the
        run, the dashboard of the cluster has a page with the partitions, whose address is logged.
        By default, a local cluster is started on the loopback interface and stopped at the end.
    backend
        Ray-casting backend of stage 2: auto, cuda, tiles or numpy.
    live
        Whether to show the run in the browser, as `lidarpool run --live` does, or in the cell of a
        notebook. "foxglove" and "rerun" show the sweeps in Foxglove and Rerun. To show the result
        afterwards, call `Result.view`.
    pace
        Speed at which `on_frame` and the live page receive the frames, in scan order. 1 is the rate
        of the scanner, and 0.1 is a tenth of it. By default, they receive each frame as soon as its
        points are stored.
    queue_capacity
        Maximum number of items that stage 1 is ahead of stage 2.
    collectors
        Number of tasks in stage 4.
    batch_mb
        Maximum memory, in megabytes, that a GPU worker uses to cast a batch of scans. A scan is
        never split.
    gpu_workers, other_workers
        Number of workers in a local cluster. The defaults depend on the machine.
    tls
        Whether to encrypt the traffic of a local cluster with a new certificate.
    startup_timeout_s, worker_timeout_s
        Time in seconds to wait for partitions that have no workers at the start, and for partitions
        that lose all their workers later. To wait for a scheduler, use ``Client(address,
        timeout=600)``.
    folder
        Folder of the run, from which the run can be resumed if this process or its machine dies.
        Its parent must exist. The run stays in the folder; remove it with `remove_run` once the
        result is saved. By default, the points are stored in a temporary folder as long as the
        result is in use. The folder may be a URL that fsspec can open, such as ``s3://bucket/run``.
    parts
        Location of the parts, which is a folder that the workers can access, or a URL that fsspec
        can open, such as ``s3://bucket/survey``. It requires `folder`, whose database lists the
        parts. `remove_run` removes both. By default, the parts are in `folder`.
    resume
        Whether to continue an unfinished run in `folder`. If there is none, a new run is started.
        `on_frame` is called with the frames that it has not received yet, and again with the frames
        of the last second before the earlier run died, or of the last seconds if `folder` is a URL.

    Returns
    -------
    Result
        The result. The same survey results in the same cloud on any cluster.

    Raises
    ------
    LidarError
        If the cluster lacks a resource, a task fails, `folder` contains an unfinished run and
        `resume` is not set, or that run is damaged or has a different scene, survey, planning or
        version. The message names the cause and the remedy.
    KeyboardInterrupt
        If the run is interrupted. The run is stopped before the error is raised.

    Examples
    --------
    >>> from lidarpool import Scene, Survey, simulate
    >>> result = simulate(Scene.seed(), Survey(poses=[(0, 0, 1)]))    # doctest: +SKIP
    >>> print(len(result.cloud), "points")                            # doctest: +SKIP
    1613 points
    """
    chosen = options_of_call("simulate", options, without=_NOT_OF_SURVEYS)
    run_options = RunOptions(**chosen)
    jobs = OneJob(Job(scene, survey, planning))
    if run_options.starts_workers:  # before the folder is changed
        check_backend_here(run_options.backend)
    with page_of(jobs, run_options.live) as page:
        result = Run(
            jobs, run_options, StoredOutput(), Screen(on_progress), page, on_frame
        ).execute()
    return Result(**declared(result, RunResult))


class Campaign(described.CampaignSpec):  # noqa: D101 - as there
    __doc__ = described.CampaignSpec.__doc__

    @checked
    def run(
        self,
        out: str | Path,
        *,
        on_progress: Callable[[Progress], None] | None = None,
        shard: tuple[int, int] = (1, 1),
        **options: Unpack[RunKeywords],
    ) -> CampaignRun:
        """Run the jobs of the campaign, several at a time, and write the data set.

        Parameters
        ----------
        out
            Folder of the data set, or a URL that fsspec can open.
        on_progress
            Function that is called with the progress about ten times per second. By default,
            progress bars are shown in notebooks and terminals.
        shard
            Share of the jobs to run. For example, (3, 10) is the third of ten equal shares, which
            `lidarpool.merge` combines.

        Other Parameters
        ----------------
        client
            Client of a cluster whose workers declare the resources GPU and LIDAR. The LIDAR
            partition needs one more slot than for a survey, to write jobs. By default, a local
            cluster is started.
        backend, collectors, queue_capacity, batch_mb
            As for `simulate`. By default, the values are taken from the scenario.
        gpu_workers
            Number of casting workers in a local cluster. By default, the number is taken from the
            scenario.
        scratch_dir
            Location of the points during the run, as for `simulate`.
        resume
            Whether to continue an unfinished run in `out`. If there is none, a new run is started.
        restart
            Whether to remove an unfinished run of a campaign in `out` first.
        retry_failed
            Whether to resume the run and repeat the jobs that have failed.
        verify
            Whether to resume the run and compare every byte of the finished jobs. Jobs with
            different bytes are damaged and are repeated.
        overwrite
            Whether to replace a finished data set. Together with `restart`, a data set with failed
            jobs is replaced, too.
        live
            Whether to show the jobs in the browser, as `lidarpool run --live` does, or in the cell
            of a notebook. "foxglove" and "rerun" show sweeps of the jobs in Foxglove and Rerun.
        tls, startup_timeout_s, worker_timeout_s
            As for `simulate`.

        Returns
        -------
        CampaignRun
            Counts of the jobs, and the jobs that have failed. A failed job does not stop the run.

        Raises
        ------
        LidarError
            If the cluster lacks a resource, or `out` contains other files or the unfinished run of
            a different campaign or version. The message names the cause and the remedy.
        """
        target = output_place(out)
        chosen = options_of_call("run", options, without=_NOT_OF_CAMPAIGNS)
        folder = Storage.at(target).below(RUN_FOLDER)
        run_options = RunOptions(out=target, folder=folder, **chosen).with_pool(self.pool, chosen)
        jobs = self.of_shard(Shard(*shard))
        with page_of(jobs, run_options.live) as page:
            output = DataSetOutput(target, jobs)
            return Run(jobs, run_options, output, Screen(on_progress), page).execute()

    @checked
    def stream(
        self,
        ahead: Annotated[int, Field(ge=1)] = 8,
        *,
        split: str | None = None,
        **options: Unpack[RunKeywords],
    ) -> SweepStream:
        """Stream the sweeps of the jobs while they are cast, without writing a data set.

        The sweeps are the same as in a data set of the campaign, with all columns, and are ordered
        by job, sensor and time. Points are sent from the workers directly to this process, and not
        through the scheduler. If a worker dies, its sweeps are cast again. A job that fails is
        skipped, and the reason is logged.

        Parameters
        ----------
        ahead
            Maximum number of sweeps that are being cast or wait to be read, which limits the
            memory. Use at least twice the number of casting workers.
        split
            Name of a split. By default, the jobs of all splits are streamed.

        Other Parameters
        ----------------
        client
            Client of a cluster whose workers declare the resource GPU. By default, each loop starts
            a local cluster and stops it at the end.
        backend, batch_mb, gpu_workers, tls, startup_timeout_s, worker_timeout_s
            As for `run`.

        Returns
        -------
        SweepStream
            An iterable of `Sweep` objects.

        Raises
        ------
        LidarError
            If the split is unknown. The loop raises the error if the cluster lacks a resource or is
            lost.
        """
        chosen = options_of_call("stream", options, without=_NOT_OF_STREAMS)
        if split is not None and split not in self.splits:
            hint = (
                did_you_mean(split, self.splits)
                or f" Available splits: {', '.join(self.splits) or 'none'}."
            )
            raise LidarError(f"Unknown split {split!r}.{hint}")
        numbers = [n for n in range(self.count) if split in (None, self.split(n))]
        run_options = RunOptions(**chosen).with_pool(self.pool, chosen)
        return SweepStream(self, numbers, ahead, run_options)
