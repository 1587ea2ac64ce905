"""Script that `omnilidar.py` runs in a separate process to read an OmniLidar prim with usd-core.

Invalid files can crash usd-core, but this only affects the separate process. The script imports
nothing from lidarpool. It writes one frame to standard output, which is a line of JSON with the
attributes of the prim, followed by the bytes of the arrays that the line lists.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Tf, Usd

MAX_WAIT_S = 120  # invalid files may never finish
_API = "OmniSensorGenericLidarCoreAPI"
_PREFIX = "omni:sensor:"


def main(path: str) -> None:
    """Read a file, and write one frame to the standard output."""
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    frame: dict[str, Any]
    arrays: list[np.ndarray] = []
    try:
        stage = Usd.Stage.Open(path)
        _check_layers(stage, path)
        prims = [prim for prim in stage.TraverseAll() if _is_lidar(prim)]
        values = _attributes(prims[0]) if prims else {}
        fields = {name: np.asarray(value) for name, value in values.items() if _is_array(value)}
        arrays = [np.ascontiguousarray(array) for array in fields.values()]
        plain = {name: value for name, value in values.items() if name not in fields}
        frame = {
            "what": "lidar",
            "prims": [str(prim.GetPath()) for prim in prims],
            "values": plain,
            "names": [*fields],
        }
    except Exception as error:  # usd-core raises errors of several classes
        frame = {"what": "error", "reason": _reason(error, path)}
        arrays = []
    frame["arrays"] = [[array.dtype.str, array.shape] for array in arrays]
    output.write(json.dumps(frame, default=str).encode() + b"\n")
    for array in arrays:
        output.write(array.tobytes())
    output.flush()


def _reason(error: Exception, path: str) -> str:
    """Return the reason for an error, without C++ names and folders."""
    try:
        text = error.args[0].commentary if isinstance(error, Tf.ErrorException) else str(error)
    except UnicodeDecodeError:
        return "its text is not valid UTF-8"
    return " ".join(text.replace(path, Path(path).name).split())[:300]


def _check_layers(stage: Usd.Stage, path: str) -> None:
    """Raise ValueError if any content comes from outside the file's folder."""
    folder = Path(path).resolve().parent
    for layer in stage.GetUsedLayers():
        if layer.realPath and not Path(layer.realPath).resolve().is_relative_to(folder):
            raise ValueError(f"it refers to {layer.realPath}, which is outside its folder")


def _is_lidar(prim: Usd.Prim) -> bool:
    """Return True if a prim is an OmniLidar that has the attributes of the generic model."""
    applied = prim.GetMetadata("apiSchemas")
    names = applied.GetAddedOrExplicitItems() if applied else []
    return str(prim.GetTypeName()) == "OmniLidar" or _API in names


def _attributes(prim: Usd.Prim) -> dict[str, Any]:
    """Return those attributes of a sensor that have a value."""
    attributes = {
        attribute.GetName(): attribute.Get()
        for attribute in prim.GetAttributes()
        if attribute.GetName().startswith(_PREFIX)
    }
    return {name: value for name, value in attributes.items() if value is not None}


def _is_array(value: Any) -> bool:
    return not isinstance(value, str) and hasattr(value, "__len__")


if __name__ == "__main__":
    message = json.loads(sys.argv[2])
    signal.alarm(MAX_WAIT_S)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _, hard_limit = resource.getrlimit(resource.RLIMIT_DATA)
    max_bytes = message["memory"] if hard_limit < 0 else min(message["memory"], hard_limit)
    resource.setrlimit(resource.RLIMIT_DATA, (max_bytes, hard_limit))
    main(sys.argv[1])
    os._exit(0)
