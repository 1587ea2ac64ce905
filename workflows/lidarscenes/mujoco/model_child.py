"""Script that `model_file.py` runs in a separate process to read a MuJoCo model.

Invalid files can crash MuJoCo, and some models need unlimited memory, but this only affects the
separate process. The script imports nothing from lidarpool. It writes one frame to standard output:
a line of JSON, followed by the bytes of the arrays that the line lists.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

MAX_WAIT_S = 120  # invalid files may never finish

# Memory for the simulation. Each ray of a camera needs 24 bytes.
_ARENA_BYTES = 128 * 2**20

# Prefixes of array names, and the names that follow each prefix.
_OF_MODEL = {
    "name": ("s", "_bodyadr", "_geomadr", "_matadr", "_siteadr", "_camadr"),
    "body": ("_parentid", "_rootid", "_weldid", "_mocapid", "_pos", "_quat"),
    "geom": ("_type", "_bodyid", "_dataid", "_matid", "_group", "_size", "_pos", "_quat", "_rgba"),
    "mesh": ("_vert", "_vertadr", "_vertnum", "_face", "_faceadr", "_facenum"),
    "hfield": ("_size", "_nrow", "_ncol", "_adr", "_data"),
    "mat": ("_rgba", "_texid"),
    "tex": ("_height", "_width", "_nchannel", "_adr", "_data"),
    "site": ("_bodyid",),
    "cam": ("_bodyid", "_fovy", "_resolution", "_sensorsize", "_intrinsic", "_projection"),
    "sensor": ("_type", "_objtype", "_objid", "_cutoff", "_noise", "_interval"),
}
_OF_DATA = ("xpos", "xmat", "site_xpos", "site_xmat", "cam_xpos", "cam_xmat")


class NoKeyframeError(Exception):
    """Raised if a model does not have the requested keyframe.

    The argument of the error is the list of the existing keyframes.
    """


def main(path: str, request: dict[str, Any]) -> None:
    """Read a file, and write one frame to the standard output."""
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    warnings: list[str] = []
    # By default, MuJoCo writes warnings to a file in the working directory.
    mujoco.set_mju_user_warning(warnings.append)
    frame: dict[str, Any]
    arrays: list[NDArray[Any]] = []
    try:
        model, data = _state(path, request["keyframe"])
        names = [prefix + name for prefix, rest in _OF_MODEL.items() for name in rest]
        # Older versions of MuJoCo lack some fields.
        fields = {name: getattr(model, name) for name in names if hasattr(model, name)}
        if not request["colors"]:
            fields["tex_data"] = fields["tex_data"][:0]
        fields["names"] = np.frombuffer(model.names, np.uint8)
        fields |= {name: getattr(data, name) for name in _OF_DATA}
        frame = {
            "what": "model",
            "names": [*fields],
            "warnings": warnings[:8],
            "extent_m": float(model.stat.extent),
            "timestep_s": float(model.opt.timestep),
            "nflex": int(model.nflex),
            "nskin": int(model.nskin),
        }
        arrays = [np.ascontiguousarray(array) for array in fields.values()]
    except NoKeyframeError as error:
        frame = {"what": "keyframes", "names": error.args[0][:1000]}
    except Exception as error:  # MuJoCo raises errors of any type
        reason = " ".join(str(error).split())
        frame = {"what": "error", "reason": reason.replace(os.path.dirname(path) + "/", "")}  # noqa: PTH120
    signal.alarm(0)  # the receiving process may take long
    frame["arrays"] = [(array.dtype.str, array.shape) for array in arrays]
    output.write(json.dumps(frame).encode() + b"\n")
    for array in arrays:
        output.write(array.data)
    output.flush()


def _state(path: str, keyframe: str | None) -> tuple[Any, Any]:
    """Load the model in a file, and its data at the reference pose or at a keyframe."""
    spec = mujoco.MjSpec.from_file(path)
    spec.memory = _ARENA_BYTES
    spec.nstack = -1  # old files have sizes that conflict with the memory
    model = spec.compile()
    data = mujoco.MjData(model)
    if keyframe is not None:
        names = [model.key(number).name or str(number) for number in range(model.nkey)]
        if keyframe not in names:
            raise NoKeyframeError(names)
        mujoco.mj_resetDataKeyframe(model, data, names.index(keyframe))
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)
    return model, data


if __name__ == "__main__":
    file = sys.argv[1]
    message = json.loads(sys.argv[2])
    signal.alarm(MAX_WAIT_S)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _, hard_limit = resource.getrlimit(resource.RLIMIT_DATA)
    max_bytes = message["memory"] if hard_limit < 0 else min(message["memory"], hard_limit)
    resource.setrlimit(resource.RLIMIT_DATA, (max_bytes, hard_limit))
    main(file, message)
    os._exit(0)
