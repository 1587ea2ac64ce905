"""Open3D without its viewers."""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec, module_from_spec
from threading import Lock
from typing import Any

_LOCK = Lock()  # a second thread would find the package that is to be taken away


def load_open3d() -> Any:
    """Return the extension module of Open3D, which has `core`, `t`, `io` and `utility`.

    Importing the package takes more than twice the time: it brings Dash and Plotly for viewers in
    a browser. So the extension is loaded below a package that has not been run, and that is taken
    away again: whoever says `import open3d`, before or after, gets the whole package.

    Raises
    ------
    ImportError, OSError
        If Open3D is not installed, or lacks a library of the system.
    """
    name = "open3d.pybind"
    with _LOCK:
        spec = None if {"open3d", name} & sys.modules.keys() else find_spec("open3d")
        if spec is None:
            return import_module(name)
        sys.modules["open3d"] = module_from_spec(spec)
        try:
            return import_module(name)
        finally:
            del sys.modules["open3d"]
