"""What a worker says about its machine; these functions run on the workers."""

from __future__ import annotations

import asyncio
import ctypes
import subprocess
import sys
from typing import Any

# Asks the driver itself, in the order in which CUDA numbers the devices (nvidia-smi's order
# may be another) and with CUDA_VISIBLE_DEVICES applied. In a process of its own: cuInit
# would fix the visible devices of the worker for good.
_LIST_GPUS = """
import ctypes
cuda = ctypes.CDLL("libcuda.so.1")
count = ctypes.c_int()
if cuda.cuInit(0) == 0 and cuda.cuDeviceGetCount(ctypes.byref(count)) == 0:
    for ordinal in range(count.value):
        uuid = (ctypes.c_ubyte * 16)()
        cuda.cuDeviceGetUuid(uuid, ordinal)
        print(bytes(uuid).hex())
"""


def visible_gpus() -> tuple[str, ...]:
    """UUIDs of the CUDA devices this process may use, by ordinal; empty without a driver."""
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return ()
    done = subprocess.run(
        [sys.executable, "-c", _LIST_GPUS], capture_output=True, text=True, timeout=60, check=False
    )
    return tuple(done.stdout.split())


async def probe_worker(dask_worker: Any = None) -> dict[str, Any]:
    """Facts about this worker that the scheduler does not know."""
    # In a thread: the worker's event loop must go on answering meanwhile.
    return {"gpus": await asyncio.to_thread(visible_gpus)}


async def declare_resource(
    slots: dict[str, int], resource: str, dask_worker: Any = None
) -> dict[str, float]:
    """Give this worker its number of slots of a resource; returns all that it has."""
    await dask_worker.set_resources(**{resource: slots[str(dask_worker.name)]})
    return dict(dask_worker.state.total_resources)
