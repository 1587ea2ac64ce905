"""Imports of the fork server, which workers of a local cluster inherit."""

from __future__ import annotations

from contextlib import suppress

import distributed.nanny  # noqa: F401

from ..base.fork_server import keep_freed_memory
from ..plan import trial  # noqa: F401
from . import stages  # noqa: F401

keep_freed_memory()
with suppress(ImportError):  # if it cannot be loaded, a check says why
    import embreex.mesh_construction
    import embreex.rtcore_scene  # noqa: F401
