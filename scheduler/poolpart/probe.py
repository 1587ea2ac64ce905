"""Functions that query a worker's GPUs. They run on the worker."""

from __future__ import annotations

import asyncio
import ctypes
import logging
import subprocess
import sys
from functools import cache
from typing import Any

logger = logging.getLogger(__name__)

# The script queries the driver, which lists the devices in CUDA's order (the order of nvidia-smi
# may differ) and respects CUDA_VISIBLE_DEVICES. It runs in a separate process, because cuInit would
# fix the visible devices of the worker permanently. Version 2 of the function distinguishes the
# instances of a MIG device, but drivers older than CUDA 11.4 only provide version 1.
CUDA_DRIVER = "libcuda.so.1"
_LIST_GPUS = """
import ctypes, sys
cuda = ctypes.CDLL(sys.argv[1])
get_uuid = getattr(cuda, "cuDeviceGetUuid_v2", None) or cuda.cuDeviceGetUuid
count = ctypes.c_int()
if cuda.cuInit(0) == 0 and cuda.cuDeviceGetCount(ctypes.byref(count)) == 0:
    for ordinal in range(count.value):
        uuid = (ctypes.c_ubyte * 16)()
        if (error := get_uuid(uuid, ordinal)) != 0:
            sys.exit(f"cuDeviceGetUuid of device {ordinal} gives error {error}")
        print(bytes(uuid).hex())
"""


@cache  # a call takes up to a second; errors are not cached
def list_gpus() -> tuple[str, ...]:
    """Return the UUIDs of this process's CUDA devices in order, or () if there is no driver.

    Raises
    ------
    subprocess.CalledProcessError, subprocess.TimeoutExpired
        If the driver fails.
    """
    try:
        ctypes.CDLL(CUDA_DRIVER)
    except OSError:
        return ()
    command = [sys.executable, "-c", _LIST_GPUS, CUDA_DRIVER]
    process = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    return tuple(process.stdout.split())


def visible_gpus() -> tuple[str, ...]:
    """Return the UUIDs of this process's CUDA devices in order, or () if there are none.

    Unlike `list_gpus`, this function logs a warning and returns () if the driver fails.
    """
    try:
        return list_gpus()
    except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
        logger.warning(
            "No GPU is used, because the GPUs could not be listed: %s %s", error, error.stderr or ""
        )
        return ()


async def worker_gpus(dask_worker: Any = None) -> tuple[str, ...]:
    """Return a worker's CUDA devices, as found by `visible_gpus`."""
    # Run in a thread to avoid blocking the worker's event loop.
    return await asyncio.to_thread(visible_gpus)
