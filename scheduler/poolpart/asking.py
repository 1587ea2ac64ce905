"""Asking workers something, some of which may die meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from distributed import Client
from distributed.comm.core import CommClosedError

from .identities import worker_identities


def ask_workers(
    client: Client, question: Callable[..., Any], addresses: Sequence[str]
) -> dict[str, Any]:
    """Run a function on workers, outside their tasks.

    Parameters
    ----------
    client
        Client of their cluster.
    question
        What `Client.run` is to run there.
    addresses
        The workers.

    Returns
    -------
    dict
        By address, what each returned, or the exception that it raised there. Workers that
        have died before they answered are left out, as those that had died before.
    """
    if not addresses:  # to Client.run that would be all workers
        return {}
    answers = client.run(question, workers=list(addresses), on_error="return")
    if not any(isinstance(answer, OSError) for answer in answers.values()):
        return dict(answers)
    here = worker_identities(client)
    return {a: answer for a, answer in answers.items() if not _has_died(answer, a in here)}


def _has_died(answer: Any, is_here: bool) -> bool:
    # An OSError may also be what the question raised on a worker that is well.
    return isinstance(answer, CommClosedError) or (isinstance(answer, OSError) and not is_here)
