"""Open3D without its viewers, or what it lacks."""

from __future__ import annotations

from typing import Any

from raybeam import open3d_module

from .errors import LidarpoolError
from .interrupts import deferred_interrupts


def load_open3d() -> Any:
    """Return the extension module of Open3D, which has `core`, `t`, `io` and `utility`.

    Raises
    ------
    LidarpoolError
        If Open3D is not installed, or lacks a library of the system.
    """
    # Interrupted while it loads, an extension module cannot be loaded again.
    with deferred_interrupts():
        try:
            return open3d_module.load_open3d()
        except (ImportError, OSError) as error:
            raise LidarpoolError(
                f"Clouds are written through Open3D, which does not load ({error}): install "
                "open3d-cpu (Linux x86_64) or open3d; on Debian and Ubuntu it needs the packages "
                "libegl1 libgl1 libgomp1 libusb-1.0-0, too."
            ) from error
