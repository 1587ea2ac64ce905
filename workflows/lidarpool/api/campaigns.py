"""Campaigns from Python: many jobs into one data set."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from distributed import Client

from ..base.declared import declared
from ..base.storage import Storage
from ..base.validation import checked
from ..base.vocabulary import PATIENCE_S, WAIT_S
from ..export.folder import output_place
from ..live import page_of
from ..report.campaign_output import DataSetOutput
from ..run.conductor import Conductor
from ..run.options import RunOptions
from ..run.progress import Progress
from ..run.result import CampaignRun
from ..run.screen import Screen
from ..run.store import RUN_FOLDER
from ..scenario import campaign as described
from ..scenario.sections import TaskOptions


class Campaign(described.Campaign):  # noqa: D101 - as there
    __doc__ = described.Campaign.__doc__

    @checked
    def run(
        self,
        out: str | Path,
        *,
        client: Client | None = None,
        backend: str | None = None,
        on_progress: Callable[[Progress], None] | None = None,
        gpu_workers: int | None = None,
        parts: str | Path | None = None,
        resume: bool = False,
        fresh: bool = False,
        retry_failed: bool = False,
        verify: bool = False,
        overwrite: bool = False,
        live: bool = False,
        wait_s: float = WAIT_S,
        patience_s: float = PATIENCE_S,
    ) -> CampaignRun:
        """Do the jobs, several at a time, and write the data set.

        Parameters
        ----------
        out
            Its folder, or a URL that fsspec opens.
        client
            Client of a cluster whose workers declare the resources GPU and LIDAR; without one, a
            local cluster is started. LIDAR needs a slot more than a survey does: jobs are written
            in it.
        backend
            Ray-casting backend; by default that of the scenario.
        on_progress
            Called some ten times a second. Without it there are bars in a notebook and at a
            terminal.
        gpu_workers
            Workers of a local cluster that cast.
        parts
            Place of the points during the run, as for `simulate`.
        resume
            Go on from what an earlier run has left in `out`, from the beginning if there is
            nothing.
        fresh
            Remove first what an unfinished run of a campaign has left in `out`.
        retry_failed
            Resume, and do the jobs that have failed again.
        verify
            Resume, and compare every byte of the jobs that are done: those with others are damaged,
            and made again.
        overwrite
            Replace a finished data set, too; if jobs of it have failed, with `fresh`.
        live
            Show the jobs in the browser meanwhile, as `lidarpool run --live` does; in a notebook,
            in the cell.
        wait_s, patience_s
            As for `simulate`.

        Returns
        -------
        CampaignRun
            What was done, and which jobs have failed: a job that fails does not stop the others.

        Raises
        ------
        LidarpoolError
            If the cluster lacks something, or `out` holds something else, or the unfinished run of
            another campaign or version; one or two lines say which and what to do.
        """
        place = output_place(out)
        options = RunOptions(
            out=place,
            folder=Storage.at(place).below(RUN_FOLDER),
            client=client,
            gpu_workers=gpu_workers,
            **declared(self.pool, TaskOptions) | ({"backend": backend} if backend else {}),
            parts=parts,
            resume=resume,
            fresh=fresh,
            retry_failed=retry_failed,
            verify=verify,
            overwrite=overwrite,
            live=live,
            wait_s=wait_s,
            patience_s=patience_s,
        )
        with page_of(self, live) as page:
            output = DataSetOutput(place, self)
            return Conductor(self, options, output, Screen(on_progress), page)()
