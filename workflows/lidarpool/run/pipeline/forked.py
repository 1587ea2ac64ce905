"""Imports of the fork server, which workers of a local cluster inherit.

Each worker would import the same modules itself while the run waits for it.
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
import numpy.ma  # noqa: F401 - numba asks for it with the first array
import tornado.platform.asyncio  # noqa: F401

import poolpart.deploy.local  # noqa: F401

from ...identity import software
from ...plan import trial  # noqa: F401
from ...processes.fork_server import keep_freed_memory
from . import casting_workers, long_stage_tasks  # noqa: F401

keep_freed_memory()
# A starting worker removes the folders of ended workers, at the same time as their nannies, and
# would log each missing folder as an error.
logging.getLogger("distributed.diskutils").setLevel(logging.CRITICAL)
with suppress(ImportError):  # a check says why the module cannot be loaded
    from lidarsim.numerics import elementary_loops  # noqa: F401
    from raybeam import moving_loops, tile_casts  # noqa: F401

    if tile_casts.COMPILED:
        print("note: the ray caster was compiled for this processor", file=sys.stderr)  # noqa: T201
# What each worker would read from many files: versions of packages, and a hash of the sources.
distributed.versions.get_versions()
software.source_hash()
gc.freeze()  # a collection in a worker would copy the memory that it shares with the others
