"""How jobs are run: the options of the command line and of Python."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from distributed import Client
from pydantic import Field

from lidarsim.base.declared import declared
from lidarsim.base.storage import Storage
from lidarsim.base.validation import checked_fields
from lidarsim.base.vocabulary import PATIENCE_S, WAIT_S

from ..scenario.sections import PoolSection, TaskOptions
from .cluster.cluster_file import ClusterFile
from .cluster.connection import TlsFiles


@dataclass(frozen=True, kw_only=True)
@checked_fields
class RunOptions(TaskOptions):
    """How jobs are run, on what, and what becomes of an earlier run; the defaults are those of all.

    Those of Python are described at `simulate` and `Campaign.run`, and are options of commands.
    """

    out: Path | Storage | None = None  # of the result or data set; None if nothing is written
    # Of what the run keeps until its result is complete; None for a temporary folder that goes with
    # the last user of the points.
    folder: str | Path | Storage | None = None
    parts: str | Path | None = None
    resume: bool = False
    fresh: bool = False
    retry_failed: bool = False
    verify: bool = False
    overwrite: bool = False
    client: Client | None = None
    scheduler: str | None = None  # address, with certificates for it
    files: TlsFiles | None = None
    cluster: ClusterFile | None = None  # to be started
    tls: bool = False
    gpu_workers: int | None = None
    other_workers: int | None = None
    wait_s: Annotated[float, Field(ge=0)] = WAIT_S
    patience_s: Annotated[float, Field(ge=0)] = PATIENCE_S
    live: bool = False
    stay: bool = True  # of the live page, at the end

    def with_pool(self, pool: PoolSection, backend: str | None = None) -> RunOptions:
        """Fill in a scenario's section `pool`; a `backend`, and workers that are here, stay."""
        own = declared(pool, TaskOptions) | {"backend": backend or pool.backend}
        own["gpu_workers"] = self.gpu_workers or pool.gpu
        own["other_workers"] = self.other_workers or pool.other
        return replace(self, **own)

    @property
    def own(self) -> bool:
        """Whether a cluster of this machine is started for the run."""
        return self.client is None and self.scheduler is None and self.cluster is None
