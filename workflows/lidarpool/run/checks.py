"""Questions asked before a run starts, so that it need not fail in the middle."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from distributed import Client

from poolpart import Pool, PoolError, WorkerInfo, ask_workers, worker_identities
from raybeam import available_backends

from .._version import __version__
from ..base.errors import LidarpoolError
from ..base.interrupts import deferred_interrupts
from ..base.words import did_you_mean
from ..scan import COLLECT, GENERATE, GPU, LIDAR, OTHER, SORT
from ..scene.scene import Scene
from ..sensor import Survey


def check_counts(**counts: int | None) -> None:
    """Check that numbers of tasks or workers are at least 1, or None; LidarpoolError if not."""
    for name, count in counts.items():
        if count is not None and count < 1:
            raise LidarpoolError(f"{name} is {count}; it must be at least 1.")


def check_versions(client: Client, workers: Sequence[str]) -> None:
    """Check that these workers have this version of lidarpool; LidarpoolError if not.

    Parameters
    ----------
    client
        Client of the cluster.
    workers
        Their addresses.
    """

    # Nested, so that it travels by value: a worker that lacks the package can still run it.
    def version() -> str:
        from lidarpool._version import __version__

        return __version__

    answers = ask_workers(client, version, workers)
    for address, answer in answers.items():
        if isinstance(answer, ModuleNotFoundError):
            raise LidarpoolError(
                f"The worker at {address} does not have lidarpool: install lidarpool "
                f"{__version__} in the environment that dask worker is started from."
            )
        if answer != __version__:
            raise LidarpoolError(
                f"The worker at {address} has lidarpool {answer}, here it is {__version__}: "
                "install the same version on both sides."
            )


def survey_pool(client: Client, collectors: int, planning: bool) -> Pool:
    """All workers of the cluster, once it is sure that they are enough for a survey.

    Raises
    ------
    LidarpoolError
        If there are no workers, other versions, or too few slots in a partition.
    """
    if client.asynchronous:
        raise LidarpoolError("The client is asynchronous: give one made without asynchronous=True.")
    names = (GPU, LIDAR, OTHER) if planning else (GPU, LIDAR)
    try:
        workers = worker_identities(client)
        if not workers:
            raise TooFewWorkersError(
                f"The cluster at {client.scheduler.address} has no workers: start some, for "
                f'example dask worker {client.scheduler.address} --resources "GPU=1"'
            )
        # Only those that are to work: a cluster may have others' workers, with other packages.
        if members := [a for a, worker in workers.items() if {*names} & set(worker["resources"])]:
            check_versions(client, members)
        pool = Pool.from_client(client, declaring=set(names))
        pool.require(dict.fromkeys(names, 0))  # that none declares two
    except PoolError as error:  # what more workers do not put right
        raise LidarpoolError(str(error)) from error
    try:
        needs = {GPU: 1, LIDAR: 2 + collectors}
        purpose = {
            GPU: "stage 2 casts the rays",
            LIDAR: f"{GENERATE}, {SORT} and {collectors} x {COLLECT}",
            OTHER: "path planning; or leave it out with --no-plan",
        }
        pool.require(needs | ({OTHER: 1} if planning else {}), purpose)
    except PoolError as error:
        raise TooFewWorkersError(str(error)) from error
    return pool


class TooFewWorkersError(LidarpoolError):
    """A partition lacks workers or slots; more may come."""


AUTO_TAKES = "Backend 'auto' takes what works."
RETURN_S = 30.0  # for workers that die while they are asked; a nanny needs a second or two
LOOK_EVERY_S = 0.2
TELL_EVERY_S = 5.0


def common_backend(
    client: Client, wanted: str, workers: Sequence[WorkerInfo], advice: str = AUTO_TAKES
) -> str:
    """Name of the ray-casting backend to use on all these workers.

    "auto" is settled here, once: if each worker chose for itself, a cloud would depend on
    which of them casts which scan. `advice` ends the message where one is not to be had.

    Raises
    ------
    LidarpoolError
        If the backend wanted is not there on all of them.
    """
    answers: Mapping[str, Any] = ask_workers(
        client, available_backends, [worker.address for worker in workers]
    )
    for answer in answers.values():
        if isinstance(answer, BaseException):
            raise answer
    if not answers:
        raise LidarpoolError(
            "The workers of partition 'GPU' left before the run started: see in their logs why."
        )
    names = list(next(iter(answers.values())))
    if wanted == "auto":
        return next(n for n in names if not any(reasons[n] for reasons in answers.values()))
    check_backend_name(wanted)
    for address, reasons in answers.items():
        if reasons[wanted]:
            raise LidarpoolError(
                f"Backend {wanted!r} cannot be used on the GPU worker at {address}: "
                f"{reasons[wanted]}. {advice}"
            )
    return wanted


def find_workers(
    client: Client,
    collectors: int,
    planning: bool,
    wanted: str,
    advice: str = AUTO_TAKES,
    *,
    wait_s: float = 0.0,
    tell: Callable[[str], None] = lambda words: None,
) -> tuple[Pool, list[WorkerInfo], str]:
    """Find all workers, those that cast among them, and the backend that these have.

    Workers that die while they are asked are likely to come back: what is lacking without them
    is looked for again, for a while. Workers that have not come yet are waited for, if asked to.

    Parameters
    ----------
    client
        Client of the cluster.
    collectors, planning
        Tasks of stage 4, and whether there is something to plan.
    wanted
        Backend.
    advice
        End of the message where that is not to be had.
    wait_s
        How long to wait for workers that are not there, seconds.
    tell
        Called, every few seconds, with what is waited for.

    Raises
    ------
    LidarpoolError
        What `survey_pool` and `common_backend` raise.
    """
    until, left = time.monotonic() + RETURN_S, False
    wait_until = told = time.monotonic()
    wait_until += wait_s
    while True:
        known = set() if client.asynchronous else worker_identities(client).keys()
        try:
            pool = survey_pool(client, collectors, planning)
            casting = [worker for worker in pool if worker.resources.get(GPU)]
            return pool, casting, common_backend(client, wanted, casting, advice)
        except TooFewWorkersError as error:
            left = left or bool(known and known - worker_identities(client).keys())
            now = time.monotonic()
            if now > wait_until and not (left and now <= until):
                raise
            if now - told >= TELL_EVERY_S:
                told = now
                tell(f"waiting for workers, for another {wait_until - now:.0f} s: {error}")
        except LidarpoolError:
            left = left or bool(known and known - worker_identities(client).keys())
            if not left or time.monotonic() > until:
                raise
        time.sleep(LOOK_EVERY_S)


def check_backend_name(wanted: str) -> None:
    """Refuse a backend that there is nowhere."""
    names = ("auto", *_backends_here())
    if wanted not in names:
        hint = did_you_mean(wanted, names) or f" There are {', '.join(names)}."
        raise LidarpoolError(f"There is no backend {wanted!r}.{hint}")


def check_backend_here(wanted: str, advice: str = AUTO_TAKES) -> None:
    """Refuse a backend that this machine lacks, before a local cluster is started for it."""
    check_backend_name(wanted)
    reason = _backends_here().get(wanted)
    if reason:
        raise LidarpoolError(f"Backend {wanted!r} cannot be used here: {reason}. {advice}")


def _backends_here() -> dict[str, str]:
    """Backends of this machine; an interrupt waits until they are loaded.

    Within an extension module's first lines, it would pass for one that cannot be loaded.
    """
    with deferred_interrupts():
        return available_backends()


def check_precision(scene: Scene, survey: Survey) -> None:
    """Check that the scene spans few enough cells of the cloud's precision to be numbered."""
    reach = float(np.abs(scene.vertices).max(initial=0.0))
    if reach / survey.precision_m >= 2**31 - 1:
        raise LidarpoolError(
            f"precision_m {survey.precision_m} is too fine for a scene that reaches {reach:.0f} m "
            f"from its origin: use at least {reach / 2**31:.2g}."
        )
