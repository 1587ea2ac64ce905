"""Modules that the fork server imports, so that workers of a local cluster inherit them.

Otherwise, each worker would import these modules itself while the run waits for it.
"""

from __future__ import annotations

import gc
import logging
import multiprocessing.popen_forkserver  # noqa: F401
import multiprocessing.synchronize  # noqa: F401
import sys
from contextlib import suppress

import distributed.nanny  # noqa: F401
import distributed.versions
import numpy.ma  # noqa: F401 - numba imports it with the first array
import tornado.platform.asyncio  # noqa: F401

import poolpart.deploy.local  # noqa: F401
from lidarfiles.identity import versions
from lidarfiles.processes.freed_memory import keep_freed_memory
from lidarscenario.plan import trial  # noqa: F401

from . import casting_workers, stage1_generate, stage3_sort, stage4_collect  # noqa: F401

keep_freed_memory()
# Workers that are starting and nannies remove the folders of stopped workers at the same time. The
# folders that are already missing would be logged as errors.
logging.getLogger("distributed.diskutils").setLevel(logging.CRITICAL)
with suppress(ImportError):  # a later check reports why the module cannot be loaded
    from lidarsim.numerics import elementary_loops  # noqa: F401
    from raybeam import tile_casts

    if tile_casts.COMPILED:
        print("note: the ray caster was compiled for this processor", file=sys.stderr)  # noqa: T201
# Cache the versions of packages and the hash of the sources, which are read from many files.
distributed.versions.get_versions()
versions.source_hash()
gc.freeze()  # otherwise, garbage collection in a worker would copy shared memory pages
