"""Running a function on a worker or nanny, from the scheduler's event loop."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from distributed.protocol.pickle import dumps
from distributed.protocol.serialize import Serialize, Serialized, deserialize


async def call(scheduler: Any, address: str, function: Callable[..., Any], **arguments: Any) -> Any:
    """Call a function in the event loop of a worker or nanny, which it gets as `dask_worker`.

    Raises
    ------
    OSError
        If nobody answers there, or the function raises something.
    """
    answer = await scheduler.rpc(address).run(function=dumps(function), kwargs=dumps(arguments))
    if answer["status"] != "OK":
        raise OSError(answer["exception_text"])
    result = answer["result"]
    # The scheduler leaves what passes through it as it came: as bytes, or not yet packed where
    # the worker is in the same process.
    if isinstance(result, Serialized):
        return deserialize(result.header, result.frames)
    return result.data if isinstance(result, Serialize) else result
