"""What the fork server imports, so that the workers of a cluster on this machine have it."""

from __future__ import annotations

from contextlib import suppress

import distributed.nanny  # noqa: F401

from raybeam.open3d_module import load_open3d

from ..base.fork_server import keep_freed_memory
from ..plan import trial  # noqa: F401
from . import stages  # noqa: F401

keep_freed_memory()
with suppress(ImportError, OSError):  # where it cannot be loaded, a check says why
    load_open3d()
