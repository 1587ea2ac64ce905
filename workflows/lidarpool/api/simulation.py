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
_NOT_OF_SURVEYS = ("fresh", "retry_failed", "verify", "overwrite")
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
    """Scan a scene on a partitioned cluster, and plan a path at the same time.

    Parameters
    ----------
    scene, survey
        The scene and the survey; poses in the scene's local coordinates.
    planning
        A path to plan on the OTHER partition while the survey runs; None for none.
    on_frame
        Called with each frame, in scan order, while the survey runs; its points are in storage by
        then (`ScanFrame.points`, `ScanFrame.hit_counts`). It is called in this thread: a slow
        callback makes the pipeline wait, and nothing is lost.
    on_progress
        Called about ten times a second with the progress. Without it there are bars in a notebook
        and at a terminal.

    Other Parameters
    ----------------
    client
        Client of a cluster whose workers declare the resources GPU, LIDAR and OTHER. Its dashboard
        has a page of partitions during the run; the log has its address. Without a client, a local
        cluster is started on the loopback interface and stopped at the end.
    backend
        Ray-casting backend of stage 2: auto, cuda, tiles or numpy.
    live
        Show the run in the browser meanwhile, as `lidarpool run --live` does; in a notebook, in the
        cell. `Result.view` shows the result afterwards. "foxglove" and "rerun" show its sweeps in
        Foxglove and Rerun.
    pace
        Speed at which `on_frame` and the live page get the frames, in scan order: 1 is the rate of
        the scanner, 0.1 a tenth of it. By default, they get each frame once its points are in
        storage.
    queue_capacity
        How many items stage 1 may be ahead of stage 2.
    collectors
        Tasks of stage 4.
    batch_mb
        Most memory, in megabytes, that a GPU worker takes to cast a batch of scans; a scan is never
        split.
    gpu_workers, other_workers
        Workers of a local cluster; by default chosen for the machine.
    tls
        Encrypt the traffic of a local cluster, with a certificate made for the cluster.
    wait_s, patience_s
        Seconds to wait for partitions that are empty at the start, and for partitions that become
        empty later. A client waits for its scheduler by itself: ``Client(address, timeout=600)``.
    folder
        A folder for the run, so that the run can be resumed if this process or its machine dies;
        its parent must exist. The run stays in the folder at the end: remove it with `remove_run`
        once the result is saved. By default the points are in a temporary folder as long as the
        result is in use. The folder may be a URL that fsspec opens, such as ``s3://bucket/run``.
    parts
        Storage of the parts: a folder that the workers see, or a URL that fsspec opens, such as
        ``s3://bucket/survey``. It needs a `folder`, whose database lists the parts; `remove_run`
        removes both. By default the parts are in `folder`.
    resume
        Continue an unfinished run in `folder`; without an unfinished run, start from the
        beginning. `on_frame` gets the frames that it has not had yet. It gets frames of the last
        second before the earlier run died again, of the last seconds if `folder` is a URL.

    Returns
    -------
    Result
        The same survey gives the same cloud on any cluster.

    Raises
    ------
    LidarError
        If the cluster lacks a resource or a task fails, if `folder` has an unfinished run and
        `resume` is not set, if that run is damaged, or of another scene, survey, planning or
        version; the message says which and what to do. KeyboardInterrupt passes through once
        the run has been stopped.

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
        """Do the jobs, several at a time, and write the data set.

        Parameters
        ----------
        out
            Its folder, or a URL that fsspec opens.
        on_progress
            Called about ten times a second. Without it there are bars in a notebook and at a
            terminal.
        shard
            (3, 10): do the third of ten equal shares of the jobs, for `lidarpool.merge`.

        Other Parameters
        ----------------
        client
            Client of a cluster whose workers declare the resources GPU and LIDAR; without one, a
            local cluster is started. LIDAR needs a slot more than for a survey, to write jobs.
        backend, collectors, queue_capacity, batch_mb
            As for `simulate`; by default as in the scenario.
        gpu_workers
            Workers of a local cluster that cast; by default as many as the scenario says.
        parts
            Storage of the points during the run, as for `simulate`.
        resume
            Continue an unfinished run in `out`; without an unfinished run, start from the
            beginning.
        fresh
            Remove an unfinished run of a campaign in `out` first.
        retry_failed
            Resume, and do the jobs that have failed again.
        verify
            Resume, and compare every byte of the jobs that are done: jobs with other bytes are
            damaged, and done again.
        overwrite
            Replace a finished data set, too, and with `fresh` even if some of its jobs have failed.
        live
            Show the jobs in the browser meanwhile, as `lidarpool run --live` does; in a notebook,
            in the cell. "foxglove" and "rerun" show sweeps of jobs in Foxglove and Rerun.
        tls, wait_s, patience_s
            As for `simulate`.

        Returns
        -------
        CampaignRun
            Counts of the jobs, and the jobs that have failed: a failed job does not stop the run.

        Raises
        ------
        LidarError
            If the cluster lacks a resource, or `out` holds other files, or the unfinished run of
            another campaign or version; the message says which and what to do.
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
        """Stream the sweeps of the jobs while they are cast, without a data set.

        The sweeps are the same as in a data set of the campaign, with all columns, in the order of
        jobs, sensors and time. Points go from the workers to this process, past the scheduler. The
        sweeps of a worker that dies are cast again. A job that fails is left out, and the log says
        why.

        Parameters
        ----------
        ahead
            Largest number of sweeps that are being cast or wait to be read, which bounds the
            memory: give twice the number of casting workers, or more.
        split
            Only the jobs of this split.

        Other Parameters
        ----------------
        client
            Client of a cluster whose workers declare the resource GPU; without one, each loop
            starts a local cluster, and stops it.
        backend, batch_mb, gpu_workers, tls, wait_s, patience_s
            As for `run`.

        Raises
        ------
        LidarError
            If the split is unknown; in the loop, if the cluster lacks a resource or is lost.
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
