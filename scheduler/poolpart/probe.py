"""Facts about a worker's machine, found by functions that run on the workers."""

from __future__ import annotations

import asyncio
import ctypes
import logging
import subprocess
import sys
from functools import cache
from typing import Any

logger = logging.getLogger(__name__)

# Asks the driver itself, in CUDA's order of the devices (nvidia-smi's order may be another) and
# with CUDA_VISIBLE_DEVICES applied. In a separate process: cuInit would fix the visible devices of
# the worker for good. Version 2 tells the instances of a divided (MIG) device apart; drivers before
# CUDA 11.4 have only the first.
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


@cache  # it takes up to a second; an error is not kept
def list_gpus() -> tuple[str, ...]:
    """Return the UUIDs of the CUDA devices of this process, by ordinal, or () without a driver.

    CalledProcessError or TimeoutExpired if the driver fails.
    """
    try:
        ctypes.CDLL(CUDA_DRIVER)
    except OSError:
        return ()
    command = [sys.executable, "-c", _LIST_GPUS, CUDA_DRIVER]
    process = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    return tuple(process.stdout.split())


def visible_gpus() -> tuple[str, ...]:
    """UUIDs of the CUDA devices this process may use, by ordinal, or () without a driver.

    A driver that fails counts as none, with a warning in the log.
    """
    try:
        return list_gpus()
    except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
        logger.warning(
            "No GPU is used, because the GPUs could not be listed: %s %s", error, error.stderr or ""
        )
        return ()


async def worker_gpus(dask_worker: Any = None) -> tuple[str, ...]:
    """CUDA devices of a worker, as `visible_gpus` finds them."""
    # In a thread, to keep the worker's event loop free.
    return await asyncio.to_thread(visible_gpus)
