"""Reads a model of MuJoCo in a process that `model_file.py` starts: a script, not a module.

Broken files can end the process, and some models take any memory; here both end this process only.
The script imports nothing of lidarpool. Standard output gets one frame: a line of JSON, and the
bytes of the arrays of the model at its initial state, named by `names` of the line.
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

MAX_WAIT_S = 300  # broken files may take for ever

_ARENA_BYTES = 2**20  # memory for simulating, which is not needed for poses

_OF_MODEL = """
names name_bodyadr name_geomadr name_matadr name_siteadr name_camadr
body_parentid body_rootid body_weldid body_mocapid body_pos body_quat
geom_type geom_bodyid geom_dataid geom_matid geom_group geom_size geom_pos geom_quat geom_rgba
mesh_vert mesh_vertadr mesh_vertnum mesh_face mesh_faceadr mesh_facenum
hfield_size hfield_nrow hfield_ncol hfield_adr hfield_data
mat_rgba mat_texid tex_height tex_width tex_nchannel tex_adr tex_data
site_bodyid cam_bodyid cam_fovy cam_resolution cam_sensorsize cam_intrinsic
sensor_type sensor_objtype sensor_objid sensor_dim sensor_cutoff sensor_noise
""".split()
_OF_DATA = "xpos xmat site_xpos site_xmat cam_xpos cam_xmat sensordata".split()


class NoKeyframeError(Exception):
    """The model lacks a keyframe; the argument has the names of its keyframes."""


def main(path: str, request: dict[str, Any]) -> None:
    """Read a file, and write a frame to standard output."""
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    warnings: list[str] = []
    mujoco.set_mju_user_warning(warnings.append)  # else into a file of the working directory
    frame: dict[str, Any]
    arrays: list[NDArray[Any]] = []
    try:
        model, data = _state(path, request["keyframe"])
        fields = {name: getattr(model, name) for name in _OF_MODEL if hasattr(model, name)}
        if not request["colours"]:
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
    except Exception as error:  # of any type, as readers of broken files are
        frame = {"what": "error", "reason": str(error).replace(os.path.dirname(path) + "/", "")}  # noqa: PTH120
    signal.alarm(0)  # who reads this may take long
    frame["arrays"] = [(array.dtype.str, array.shape) for array in arrays]
    output.write(json.dumps(frame).encode() + b"\n")
    for array in arrays:
        output.write(array.data)
    output.flush()


def _state(path: str, keyframe: str | None) -> tuple[Any, Any]:
    """Return the model of a file, and its data at the reference pose or at a keyframe."""
    spec = mujoco.MjSpec.from_file(path)
    spec.memory = _ARENA_BYTES
    spec.nstack = -1  # of old files, and in conflict with the memory
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
