"""Functions that simulate a single survey, or a campaign that creates a data set."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Unpack

from lidarfiles.clouds.folder import output_destination
from lidarscenario.campaign.campaign import CampaignSpec
from lidarscenario.job import Job
from lidarscenario.plan import Planning
from lidarscenario.shard import Shard
from lidarsim.casting.scene_caster import check_backend_here
from lidarsim.errors import LidarError
from lidarsim.io.storage import Storage
from lidarsim.scene.scene import Scene
from lidarsim.schema.checks import check_number
from lidarsim.schema.declared import declared_values
from lidarsim.survey.survey import Survey
from lidarsim.words import did_you_mean

from ..pages import page_of
from ..report.campaign_output import run_campaign
from ..run.job_source import SingleJob
from ..run.options import RunKeywords, RunOptions, check_keywords
from ..run.pipeline.stage_messages import ScanFrame
from ..run.progress import Progress, Screen
from ..run.run_result import CampaignRun, RunResult
from ..run.runner import cast_to_store
from ..run.store.run_store import RUN_FOLDER
from ..run.stream import SweepStream
from .result import Result

# Run options that a call does not accept. A survey has no data set. A campaign does not plan paths,
# and stores its run next to the data set. A stream stores nothing and has no stages 1 and 4.
_UNUSED_BY_SURVEYS = ("restart", "retry_failed", "verify", "overwrite")
_UNUSED_BY_CAMPAIGNS = ("folder", "other_workers", "pace")
_UNUSED_BY_STREAMS = (
    *_UNUSED_BY_SURVEYS,
    *_UNUSED_BY_CAMPAIGNS,
    "scratch_dir",
    "resume",
    "live",
    "collectors",
    "queue_capacity",
)


def simulate(
    scene: Scene,
    survey: Survey,
    planning: Planning | None = None,
    *,
    on_frame: Callable[[ScanFrame], None] | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    **options: Unpack[RunKeywords],
) -> Result:
    """Simulate a survey of a scene on a cluster, and optionally plan a path at the same time.

    Parameters
    ----------
    scene, survey
        Scene and survey to simulate. Poses are in the local coordinates of the scene.
    planning
        Path planning to run on the OTHER partition during the survey, or None.
    on_frame
        Function that is called with each frame, in scan order, while the survey runs. The points of
        the frame have been stored by then, so `ScanFrame.points` and `ScanFrame.hit_counts` are
        available. The function is called in the calling thread. If it is slow, the pipeline waits,
        so no frame is lost.
    on_progress
        Function that is called with the progress about ten times per second. By default, progress
        bars are shown in notebooks and terminals.

    Other Parameters
    ----------------
    client
        Client of a cluster whose workers declare the resources GPU, LIDAR and OTHER. During the
        run, the cluster's dashboard has a page that shows the partitions. The address of that page
        is logged. By default, a local cluster is started on the loopback interface and stopped at
        the end.
    backend
        Ray-casting backend for stage 2: auto, cuda, tiles or numpy.
    live
        Whether to show the run in the browser, as `lidarpool run --live` does, or in a notebook
        cell. With "foxglove" or "rerun", the sweeps are shown in Foxglove or Rerun. To show the
        result afterwards, call `Result.view`.
    pace
        Rate at which `on_frame` and the live page receive the frames in scan order, relative to the
        rate of the scanner. For example, 0.1 is a tenth of the scanner's rate. By default, each
        frame is passed on as soon as its points are stored.
    queue_capacity
        Maximum number of items by which stage 1 can be ahead of stage 2.
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
        Maximum time in seconds to wait for workers. `startup_timeout_s` applies to partitions that
        have no workers at startup, and `worker_timeout_s` to partitions that lose all their workers
        later. To wait for a scheduler, use ``Client(address, timeout=600)``.
    folder
        Folder of the run, from which the run can be resumed if this process or its machine dies.
        Its parent must exist. The run stays in the folder. Remove it with `remove_run` once the
        result has been saved. By default, the points are stored in a temporary folder that exists
        as long as the result. The folder can also be a URL that fsspec can open, such as
        ``s3://bucket/run``.
    scratch_dir
        Location of the points during the run: a folder that the workers can access, or a URL that
        fsspec can open, such as ``s3://bucket/survey``. This option requires `folder`, which
        contains the database that lists the stored parts. `remove_run` removes both. By default,
        the points are stored in `folder`.
    resume
        Whether to continue an unfinished run in `folder`, which is required. If there is none, a
        new run is started. `on_frame` is called with the frames that it has not received yet.
        It may receive frames again that it received in the last second before the earlier run
        died, or in the last few seconds if `folder` is a URL.

    Returns
    -------
    Result
        Result of the survey. The same survey produces the same cloud on any cluster.

    Raises
    ------
    LidarError
        If the cluster lacks a resource or a task fails, if `folder` contains an unfinished run and
        `resume` is not set, or if that run is damaged or has a different scene, survey, planning or
        version. The message states the cause and the remedy.
    KeyboardInterrupt
        If the run is interrupted. The run is stopped before the error is raised.

    Examples
    --------
    >>> from lidarpool import Scene, Survey, simulate
    >>> result = simulate(Scene.seed(), Survey(poses=[(0, 0, 1)]))    # doctest: +SKIP
    >>> print(len(result.cloud), "points")                            # doctest: +SKIP
    1613 points
    """
    chosen = check_keywords("simulate", options, without=_UNUSED_BY_SURVEYS)
    for name in ("resume", "scratch_dir"):
        if chosen.get(name) and "folder" not in chosen:
            raise LidarError(f"`{name}` requires `folder`, the folder of the run.")
    run_options = RunOptions(**chosen)
    jobs = SingleJob(Job(scene, survey, planning))
    if run_options.starts_workers:  # fail before the folder is changed
        check_backend_here(run_options.backend)
    with page_of(jobs, run_options.live) as page:
        result = cast_to_store(jobs, run_options, Screen(on_progress), page, on_frame)
    return Result(**declared_values(result, RunResult))


class Campaign(CampaignSpec):  # noqa: D101 - inherits the docstring
    __doc__ = CampaignSpec.__doc__

    def run(
        self,
        out: str | Path,
        *,
        on_progress: Callable[[Progress], None] | None = None,
        shard: tuple[int, int] = (1, 1),
        **options: Unpack[RunKeywords],
    ) -> CampaignRun:
        """Run several jobs of the campaign at a time, and write the data set.

        Parameters
        ----------
        out
            Folder of the data set, or a URL that fsspec can open.
        on_progress
            Function that is called with the progress about ten times per second. By default,
            progress bars are shown in notebooks and terminals.
        shard
            Shard of the campaign to run. For example, (3, 10) runs the third of ten equal shards of
            the jobs. Use `lidarpool.merge` to combine the shards.

        Other Parameters
        ----------------
        client
            Client of a cluster whose workers declare the resources GPU and LIDAR. The LIDAR
            partition requires one slot more than for a survey, because one slot writes the jobs. By
            default, a local cluster is started.
        backend, collectors, queue_capacity, batch_mb
            As for `simulate`. By default, the values are taken from the scenario.
        gpu_workers
            Number of casting workers in a local cluster. By default, the number is taken from the
            scenario.
        scratch_dir
            Location of the points during the run, as for `simulate`, but without `folder`.
        resume
            Whether to continue an unfinished run in `out`. If there is none, a new run is started.
        restart
            Whether to remove an unfinished run of a campaign in `out` first.
        retry_failed
            Whether to resume the run and repeat the jobs that have failed.
        verify
            Whether to resume the run and verify every byte of the finished jobs. Damaged jobs are
            repeated.
        overwrite
            Whether to replace a finished data set. Together with `restart`, a data set with failed
            jobs is also replaced.
        live
            Whether to show the jobs in the browser, as `lidarpool run --live` does, or in a
            notebook cell. With "foxglove" or "rerun", sweeps of the jobs are shown in Foxglove or
            Rerun.
        tls, startup_timeout_s, worker_timeout_s
            As for `simulate`.

        Returns
        -------
        CampaignRun
            Summary of the run, including the jobs that have failed. A failed job does not stop the
            run.

        Raises
        ------
        LidarError
            If the cluster lacks a resource, or if `out` contains other files or the unfinished run
            of a different campaign or version. The message states the cause and the remedy.
        """
        target = output_destination(out)
        chosen = check_keywords("run", options, without=_UNUSED_BY_CAMPAIGNS)
        folder = Storage.at(target).below(RUN_FOLDER)
        run_options = RunOptions(folder=folder, **chosen).with_pool(self.pool, chosen)
        jobs = self.for_shard(Shard(*shard))
        with page_of(jobs, run_options.live) as page:
            return run_campaign(target, jobs, run_options, Screen(on_progress), page)

    def stream(
        self,
        ahead: int = 8,
        *,
        split: str | None = None,
        **options: Unpack[RunKeywords],
    ) -> SweepStream:
        """Return a stream of the campaign's sweeps, which are simulated while they are being read.

        The sweeps are the same as in a data set of the campaign, with all columns, and are ordered
        by job, sensor and time. The workers send points directly to this process rather than
        through the scheduler. If a worker dies, its sweeps are simulated again. A job that fails is
        skipped, and the reason is logged.

        Parameters
        ----------
        ahead
            Maximum number of sweeps that are being simulated or waiting to be read, which limits
            memory use. Use at least twice the number of casting workers.
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
            If the split is unknown. Iteration raises this error if the cluster lacks a resource or
            is lost.
        """
        check_number("ahead", ahead, whole=True, ge=1)
        chosen = check_keywords("stream", options, without=_UNUSED_BY_STREAMS)
        if split is not None and split not in self.splits:
            hint = (
                did_you_mean(split, self.splits)
                or f" Available splits: {', '.join(self.splits) or 'none'}."
            )
            raise LidarError(f"Unknown split {split!r}.{hint}")
        numbers = [n for n in range(self.count) if split in (None, self.split(n))]
        run_options = RunOptions(**chosen).with_pool(self.pool, chosen)
        return SweepStream(self, numbers, ahead, run_options)
