"""Options of a run, of the command line and of Python."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, TypedDict

from distributed import Client
from pydantic import Field

from lidarsim.errors import LidarError
from lidarsim.io.storage import Storage
from lidarsim.schema.checks import check_fields
from lidarsim.schema.declared import declared_values
from lidarsim.schema.value_texts import one_line
from lidarsim.schema.vocabulary import BACKENDS, PATIENCE_S, WAIT_S
from lidarsim.words import did_you_mean

from ..connection.tls_files import TlsFiles
from ..scenario.sections import PoolSection, TaskOptions
from .cluster_file import ClusterFile
from .store.database import FILE

# The page in the browser (also True), or a viewer; False for none.
Live = bool | Literal["page", "foxglove", "rerun"]


@dataclass(frozen=True, kw_only=True)
class RunOptions(TaskOptions):
    """Options of casting, of the cluster, and of the treatment of an earlier run.

    In Python they are the `RunKeywords` of `simulate`, `Campaign.run` and `Campaign.stream`, which
    describe them; the same are options of commands. The defaults are valid for all.
    """

    # Folder of the run's store until the result is complete; None for a temporary folder that is
    # deleted with the last user of the points.
    folder: str | Path | Storage | None = None
    scratch_dir: str | Path | None = None
    resume: bool = False
    restart: bool = False
    retry_failed: bool = False
    verify: bool = False
    overwrite: bool = False
    client: Client | None = None
    scheduler: str | None = None  # address, with certificates for it
    files: TlsFiles | None = None
    cluster: ClusterFile | None = None  # cluster to be started
    tls: bool = False
    gpu_workers: int | None = None
    other_workers: int | None = None
    startup_timeout_s: Annotated[float, Field(ge=0)] = WAIT_S
    worker_timeout_s: Annotated[float, Field(ge=0)] = PATIENCE_S
    live: Live = False
    pace: Annotated[float | None, Field(gt=0)] = None  # speed of frames; 1 is that of the scanner
    stay: bool = True  # False if the live page, or viewer, ends with the run

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)
        if (self.restart or self.overwrite) and self.may_continue:
            raise LidarError(
                "The options `restart` and `overwrite` cannot be combined with `resume`, "
                "`retry_failed` or `verify`, because they remove the run that these options "
                "continue."
            )

    @property
    def may_continue(self) -> bool:
        """True if the run may continue an earlier run."""
        return self.resume or self.retry_failed or self.verify

    @property
    def continues_run(self) -> bool:
        """True if the run continues an unfinished run, which is in `folder`."""
        folder = self.folder
        return self.may_continue and folder is not None and FILE in Storage.at(folder).sizes()

    def with_pool(
        self, pool: PoolSection, overrides: Mapping[str, Any] = MappingProxyType({})
    ) -> RunOptions:
        """Fill in a scenario's section `pool`.

        Options in `overrides` that are not None stay.
        """
        options = declared_values(pool, TaskOptions)
        options |= {name: overrides[name] for name in options if overrides.get(name) is not None}
        options["gpu_workers"] = self.gpu_workers or pool.gpu
        options["other_workers"] = self.other_workers or pool.other
        return replace(self, **options)

    @property
    def starts_workers(self) -> bool:
        """True if a cluster of this machine is started for the run."""
        return self.client is None and self.scheduler is None and self.cluster is None


class RunKeywords(TypedDict, total=False):
    """`RunOptions` as keywords of Python.

    The destination of a result is a parameter there, and a client replaces the options for clusters
    that commands have.
    """

    collectors: int
    queue_capacity: int
    batch_mb: int
    backend: Literal[BACKENDS] | None  # type: ignore[valid-type]
    folder: str | Path | Storage | None
    scratch_dir: str | Path | None
    resume: bool
    restart: bool
    retry_failed: bool
    verify: bool
    overwrite: bool
    client: Client | None
    tls: bool
    gpu_workers: int | None
    other_workers: int | None
    startup_timeout_s: float
    worker_timeout_s: float
    live: Live
    pace: float | None


def options_of_call(
    call: str, keywords: RunKeywords, without: Collection[str] = ()
) -> dict[str, Any]:
    """Return the keywords of a call that are not None.

    TypeError, as Python's, for a keyword that is not an option, or is meaningless in this call:
    such keywords are in `without`.
    """
    accepted = RunKeywords.__annotations__.keys() - set(without)
    for name in keywords:
        if name not in accepted:
            suggestion = did_you_mean(name, accepted)
            raise TypeError(f"{call}() got an unexpected keyword argument {name!r}.{suggestion}")
    return {name: value for name, value in keywords.items() if value is not None}
