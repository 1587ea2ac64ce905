"""Imports of the fork server, which workers of a local cluster inherit."""

from __future__ import annotations

import logging
import sys
from contextlib import suppress

import distributed.nanny  # noqa: F401

from ...base.fork_server import keep_freed_memory
from ...plan import trial  # noqa: F401
from . import stages  # noqa: F401

keep_freed_memory()
# A starting worker removes the folders of ended workers, at the same time as their nannies, and
# would log each missing folder as an error.
logging.getLogger("distributed.diskutils").setLevel(logging.CRITICAL)
with suppress(ImportError):  # if it cannot be loaded, a check says why
    from raybeam import embree_bodies, embree_packets, moving_loops  # noqa: F401

    if embree_packets.COMPILED:
        print("note: compiled the ray caster for this processor, once", file=sys.stderr)  # noqa: T201
