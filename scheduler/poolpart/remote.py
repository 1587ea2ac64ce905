"""Running a function of this package on the scheduler; a leaf module."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from distributed import Client

from .errors import PoolError


def on_scheduler(client: Client, function: Callable[..., Any], **kwargs: Any) -> Any:
    """Call `function(**kwargs, dask_scheduler=…)` in the scheduler's event loop.

    Raises
    ------
    PoolError
        If the scheduler's environment lacks this package.
    """
    try:
        return client.run_on_scheduler(function, **kwargs)
    except ModuleNotFoundError as error:
        raise PoolError(
            f"The scheduler at {client.scheduler.address} has no module {error.name!r}: start "
            "it in the environment that is used here."
        ) from error
