"""Options of a run, as used on the command line and in Python."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType, NoneType
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypedDict

from pydantic import Field

from lidarscenario.sections import PoolSection, TaskOptions
from lidarsim.errors import LidarError
from lidarsim.io.storage import Storage
from lidarsim.schema.checks import check_fields, check_type
from lidarsim.schema.declared import declared_values
from lidarsim.schema.value_texts import one_line
from lidarsim.schema.vocabulary import BACKENDS, PATIENCE_S, WAIT_S
from lidarsim.words import did_you_mean

from ..connection.tls_files import TlsFiles
from .cluster_file import ClusterFile
from .store.database import FILE

if TYPE_CHECKING:
    from distributed import Client
else:
    Client = Any  # `RunOptions` checks the class, because importing distributed takes long

# Options of a cluster that is started on this machine.
_LOCAL_OPTIONS = {"gpu_workers", "other_workers", "tls"}
# Live view of a run: a page in the browser (True or "page"), a viewer, or False for none.
Live = bool | Literal["page", "foxglove", "rerun"]


@dataclass(frozen=True, kw_only=True)
class RunOptions(TaskOptions):
    """Options that control casting, the cluster, and what happens to an earlier run.

    `simulate`, `Campaign.run` and `Campaign.stream` accept most of them as keywords (`RunKeywords`)
    and document them. Commands have corresponding command-line options.
    """

    # Folder of the run store until the result is complete, or None for a temporary folder, which is
    # deleted when the points are no longer in use.
    folder: str | Path | Storage | None = None
    scratch_dir: str | Path | None = None
    resume: bool = False
    restart: bool = False
    retry_failed: bool = False
    verify: bool = False
    overwrite: bool = False
    client: Client | None = None
    scheduler: str | None = None  # address of an existing scheduler
    files: TlsFiles | None = None  # certificates for this scheduler
    cluster: ClusterFile | None = None  # cluster to start
    tls: bool = False
    gpu_workers: int | None = None
    other_workers: int | None = None
    startup_timeout_s: Annotated[float, Field(ge=0)] = WAIT_S
    worker_timeout_s: Annotated[float, Field(ge=0)] = PATIENCE_S
    live: Live = False
    pace: Annotated[float | None, Field(gt=0)] = None  # speed of frames relative to the scanner
    stay: bool = True  # whether the live page or viewer stays open after the run

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)
        if self.client is not None:
            from distributed import Client  # imported late because commands pass no client

            check_type("client", self.client, Client, NoneType)
        if (self.restart or self.overwrite) and self.may_continue:
            raise LidarError(
                "The options `restart` and `overwrite` cannot be combined with `resume`, "
                "`retry_failed` or `verify`, because they remove the run that these options "
                "continue."
            )

    @property
    def may_continue(self) -> bool:
        """True if the options allow continuing an earlier run."""
        return self.resume or self.retry_failed or self.verify

    @property
    def continues_run(self) -> bool:
        """True if the run will continue an unfinished run in `folder`."""
        folder = self.folder
        return self.may_continue and folder is not None and FILE in Storage.at(folder).sizes()

    def with_pool(
        self, pool: PoolSection, overrides: Mapping[str, Any] = MappingProxyType({})
    ) -> RunOptions:
        """Return a copy with the values of a scenario's `pool` section.

        Values in `overrides` that are not None take precedence over the section.
        """
        options = declared_values(pool, TaskOptions)
        options |= {name: overrides[name] for name in options if overrides.get(name) is not None}
        options["gpu_workers"] = self.gpu_workers or pool.gpu
        options["other_workers"] = self.other_workers or pool.other
        return replace(self, **options)

    @property
    def starts_workers(self) -> bool:
        """True if the run starts a cluster on this machine."""
        return self.client is None and self.scheduler is None and self.cluster is None


class RunKeywords(TypedDict, total=False):
    """Keyword arguments of Python functions that correspond to `RunOptions`.

    A client replaces the options with which commands connect to a cluster or start one.
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


def check_keywords(
    call: str, keywords: RunKeywords, without: Collection[str] = ()
) -> dict[str, Any]:
    """Validate the keyword arguments of a call, and return those that are not None.

    Parameters
    ----------
    call
        Name of the called function, for the error message.
    keywords
        Keywords of the call.
    without
        Names of `RunKeywords` that the function does not accept.

    Raises
    ------
    TypeError
        If the function does not accept a keyword.
    LidarError
        If keywords apply to a cluster that is started, but `client` is connected to a cluster.
    """
    assert RunKeywords.__annotations__.keys() >= {*without}, "these keywords do not exist"
    accepted = RunKeywords.__annotations__.keys() - set(without)
    for name in keywords:
        if name not in accepted:
            suggestion = did_you_mean(name, accepted)
            raise TypeError(f"{call}() got an unexpected keyword argument {name!r}.{suggestion}")
    chosen = {name: value for name, value in keywords.items() if value is not None}
    if "client" in chosen:
        for name in _LOCAL_OPTIONS & {name for name, value in chosen.items() if value}:
            raise LidarError(
                f"`{name}` applies to a local cluster, but `client` is connected to a cluster that "
                f"is already running. Remove `{name}` or `client`."
            )
    return chosen
