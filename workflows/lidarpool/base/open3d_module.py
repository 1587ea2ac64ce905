"""Open3D without its viewers."""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec, module_from_spec
from threading import Lock
from typing import Any

from lidarsim.base.errors import LidarError
from lidarsim.base.extras import install_command
from lidarsim.base.interrupts import deferred_interrupts

_LOCK = Lock()  # a second thread would find the temporary package


def load_open3d() -> Any:
    """Return the extension module of Open3D, which has `core`, `t`, `io` and `utility`.

    Importing the package takes more than twice the time: it brings Dash and Plotly for viewers in a
    browser. So the extension is loaded below a temporary package without code, which is removed
    again: `import open3d`, before or after, gives the full package.

    LidarError if Open3D is not installed, or lacks a library of the system.
    """
    # Interrupted while it loads, an extension module cannot be loaded again.
    with deferred_interrupts(), _LOCK:
        try:
            return _extension("open3d.pybind")
        except (ImportError, OSError) as error:
            advice = (
                "On Debian and Ubuntu, run `apt-get install libegl1 libgl1 libgomp1 libusb-1.0-0`."
            )
            if isinstance(error, ModuleNotFoundError):
                advice = (
                    f"Run `{install_command('open3d-cpu')}`. "
                    "On platforms other than Linux x86_64, install open3d instead."
                )
            raise LidarError(
                f"Writing clouds requires Open3D, which cannot be loaded ({error}). {advice}"
            ) from error


def _extension(name: str) -> Any:
    spec = None if {"open3d", name} & sys.modules.keys() else find_spec("open3d")
    if spec is None:
        return import_module(name)
    sys.modules["open3d"] = module_from_spec(spec)
    try:
        return import_module(name)
    finally:
        del sys.modules["open3d"]
