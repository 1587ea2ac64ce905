"""How jobs are run: the options of the command line and of Python."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from distributed import Client
from pydantic import Field

from ..base.storage import Storage
from ..base.validation import checked_fields
from ..base.vocabulary import PATIENCE_S, WAIT_S
from ..scenario.sections import TaskOptions
from .cluster_file import ClusterFile
from .connection import TlsFiles


@dataclass(frozen=True, kw_only=True)
@checked_fields
class RunOptions(TaskOptions):
    """How jobs are run, on what, and what becomes of an earlier run; the defaults are those of all.

    Parameters
    ----------
    out
        Folder or URL of the result or data set; None if nothing is written.
    folder
        Place of what the run keeps until its result is complete, a folder or URL; None for a
        temporary folder that goes with the last user of the points.
    parts
        Another place for the parts, a path or URL.
    resume, fresh
        Whether to go on with an unfinished run, or to drop it.
    retry_failed, verify
        Of a data set: resume, and do failed jobs again; compare every byte of what is done.
    overwrite
        Replace the result of another survey, or a finished data set.
    client, scheduler, cluster
        The cluster: a client of it, its address, or the file of one to start. By default a local
        one is started.
    files, tls
        Certificates for the scheduler; whether to encrypt the traffic of a local cluster.
    gpu_workers, other_workers
        Workers of a local cluster.
    wait_s, patience_s
        How long to wait for partitions that are empty at the start, and for those that become empty
        later, seconds.
    live, stay
        Whether to show the live page, and to keep it at the end.
    """

    out: Path | Storage | None = None
    folder: str | Path | Storage | None = None
    parts: str | Path | None = None
    resume: bool = False
    fresh: bool = False
    retry_failed: bool = False
    verify: bool = False
    overwrite: bool = False
    client: Client | None = None
    scheduler: str | None = None
    cluster: ClusterFile | None = None
    files: TlsFiles | None = None
    tls: bool = False
    gpu_workers: int | None = None
    other_workers: int | None = None
    wait_s: Annotated[float, Field(ge=0)] = WAIT_S
    patience_s: Annotated[float, Field(ge=0)] = PATIENCE_S
    live: bool = False
    stay: bool = True

    @property
    def own(self) -> bool:
        """Whether a cluster of this machine is started for the run."""
        return self.client is None and self.scheduler is None and self.cluster is None
