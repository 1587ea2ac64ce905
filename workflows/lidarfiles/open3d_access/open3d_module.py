"""Import Open3D without its viewers."""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec, module_from_spec
from threading import Lock
from typing import Any

from lidarsim.environment.extras import install_command
from lidarsim.environment.interrupts import defer_interrupts
from lidarsim.errors import LidarError

_LOCK = Lock()  # keeps other threads from finding the temporary package


def load_open3d() -> Any:
    """Return Open3D's extension module, which contains `core`, `t`, `io` and `utility`.

    Importing the full package takes more than twice as long, because it also imports Dash and
    Plotly for its browser viewers. The extension module is therefore loaded inside a temporary,
    empty package, which is removed afterwards. A later `import open3d` still imports the full
    package.

    Raises
    ------
    LidarError
        If Open3D is not installed, or if a system library that it requires is missing.
    """
    # An extension module whose import was interrupted cannot be imported again.
    with defer_interrupts(), _LOCK:
        try:
            return _import_extension("open3d.pybind")
        except (ImportError, OSError) as error:
            advice = (
                "On Debian and Ubuntu, run "
                "`apt-get install libegl1 libgl1 libgomp1 libidn2-0 libusb-1.0-0`."
            )
            if isinstance(error, ModuleNotFoundError):
                advice = (
                    f"Run `{install_command('open3d-cpu')}`. "
                    "On platforms other than Linux x86_64, install open3d instead."
                )
            raise LidarError(
                f"Writing clouds requires Open3D, which cannot be loaded ({error}). {advice}"
            ) from error


def _import_extension(name: str) -> Any:
    spec = None if {"open3d", name} & sys.modules.keys() else find_spec("open3d")
    if spec is None:
        return import_module(name)
    sys.modules["open3d"] = module_from_spec(spec)
    try:
        return import_module(name)
    finally:
        del sys.modules["open3d"]
