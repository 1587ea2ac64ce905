"""Create pedestrian.glb, a 1.75 m tall adult who walks at 1.4 m/s.

Run it with `python make_pedestrian.py`.

The body consists of tubes with elliptical cross-sections along the limbs, which a skin with 15
joints deforms. The animation "Walk" is one cycle of two steps. Feet roll from heel to ball without
sliding, the positions of hips and feet determine the knee angles, and the arms swing opposite to
the legs. Below the root node, x points forward and z points up. The root node rotates these axes
to those of glTF.
"""

import json
import struct
from itertools import pairwise
from pathlib import Path

import numpy as np

SPEED_M_S = 1.4
CYCLE_S = 1.05
KEYS = 36  # key frames of the animation
STANCE = 0.62  # share of the cycle during which a foot is on the ground
LEG = 0.43  # length of the thigh and of the shank, meters
ANKLE_M = 0.08  # height
# Positions on a foot, forward of its ankle, meters.
HEEL = -0.05
BALL = 0.13
STRIKE_M = 0.27  # where a heel strikes the ground, forward of the hips
HIP_M = 0.90  # height of the hips
LIFT_M = 0.08  # height by which a foot is lifted
# Joints: name, parent, and position in the rest pose. Joints with L are at positive y.
JOINTS = [("hips", None, (0, 0, 0.94)), ("spine", "hips", (0, 0, 1.08)),
          ("head", "spine", (0, 0, 1.5))]  # fmt: skip
for _side, _y in (("L", 1), ("R", -1)):
    JOINTS += [
        (f"thigh{_side}", "hips", (0, 0.09 * _y, ANKLE_M + 2 * LEG)),
        (f"shank{_side}", f"thigh{_side}", (0, 0.09 * _y, ANKLE_M + LEG)),
        (f"foot{_side}", f"shank{_side}", (0, 0.09 * _y, ANKLE_M)),
        (f"toes{_side}", f"foot{_side}", (BALL, 0.09 * _y, 0)),
        (f"arm{_side}", "spine", (0, 0.195 * _y, 1.42)),
        (f"forearm{_side}", f"arm{_side}", (0, 0.225 * _y, 1.13)),
    ]
NAMES = [name for name, *_ in JOINTS]


class Figure:
    """Vertices and triangles of the body.

    Each vertex is attached to one or two weighted joints.
    """

    def __init__(self) -> None:
        self.points = []
        self.faces = []
        self.joints = []
        self.weights = []

    def tube(self, rings, held, across=16, along=2) -> None:
        """Add a closed tube through rings.

        Each ring is given by its center x, y, z and two semi-axes.

        The ellipses are perpendicular to the axis `along`. `held` maps the coordinate along this
        axis to two joints and the weight of the second joint.
        """
        first = len(self.points)
        angles = 2 * np.pi * np.arange(across) / across
        first_axis, second_axis = [axis for axis in range(3) if axis != along]
        for *middle, a, b in rings:
            for angle in angles:
                point = np.array(middle, float)
                point[first_axis] += a * np.cos(angle)
                point[second_axis] += b * np.sin(angle)
                self._add(point, held(point[along]))
        tips = [len(self.points), len(self.points) + 1]
        for *middle, _, _ in (rings[0], rings[-1]):
            self._add(np.array(middle, float), held(middle[along]))
        turned = (rings[-1][along] > rings[0][along]) != (along == 1)
        for row in range(len(rings) - 1):
            for k in range(across):
                a, b = (first + row * across + n for n in (k, (k + 1) % across))
                quads = [(a, b, a + across), (b, b + across, a + across)]
                self.faces += quads if turned else [q[::-1] for q in quads]
        last = first + (len(rings) - 1) * across
        for k in range(across):
            a = k
            b = (k + 1) % across
            caps = [(tips[0], first + b, first + a), (tips[1], last + a, last + b)]
            self.faces += caps if turned else [e[::-1] for e in caps]

    def _add(self, point, held) -> None:
        joint, next_joint, share = held
        self.points.append(point)
        self.joints.append([NAMES.index(joint), NAMES.index(next_joint), 0, 0])
        self.weights.append([1 - share, share, 0, 0])


def blend(*stops):
    """Return a function that maps a coordinate to two joints and the weight of the second one.

    Each stop consists of a joint's name, its end and its reach. Stops are in descending order.
    """

    def held(coordinate):
        for (joint, below, reach), (next_joint, *_) in pairwise(stops):
            share = np.clip((below + reach - coordinate) / (2 * reach), 0, 1)
            if share < 1:
                return joint, next_joint, float(share)
        return stops[-1][0], stops[-1][0], 0.0

    return held


def figure() -> Figure:
    """Return the standing body in its rest pose."""
    person = Figure()
    torso = [
        (0.84, 0.07, 0.10),
        (0.88, 0.105, 0.15),
        (0.94, 0.118, 0.168),
        (1.02, 0.108, 0.155),
        (1.10, 0.10, 0.14),
        (1.20, 0.11, 0.152),
        (1.30, 0.12, 0.17),
        (1.38, 0.112, 0.187),
        (1.43, 0.09, 0.172),
        (1.46, 0.065, 0.10),
        (1.49, 0.055, 0.058),
        (1.54, 0.052, 0.052),
    ]
    body = blend(("head", 1.5, 0.03), ("spine", 1.05, 0.08), ("hips", 0, 1))
    person.tube([(0, 0, z, a, b) for z, a, b in torso], body)
    tilt = np.radians(np.linspace(-85, 85, 11))
    skull = [(0.02, 0, 1.635 + 0.115 * np.sin(t), 0.098 * np.cos(t), 0.076 * np.cos(t))
             for t in tilt]  # fmt: skip
    person.tube(skull, lambda z: ("head", "head", 0.0))
    legs = [
        (0.95, 0.09, 0.078),
        (0.88, 0.092, 0.085),
        (0.78, 0.085, 0.08),
        (0.66, 0.072, 0.068),
        (0.56, 0.06, 0.056),
        (0.51, 0.06, 0.055),
        (0.46, 0.056, 0.052),
        (0.38, 0.06, 0.055),
        (0.28, 0.052, 0.048),
        (0.18, 0.041, 0.038),
        (0.08, 0.042, 0.036),
        (0.05, 0.04, 0.034),
    ]
    arms = [
        (1.44, 0.19, 0.035, 0.03),
        (1.42, 0.197, 0.054, 0.047),
        (1.34, 0.205, 0.054, 0.048),
        (1.24, 0.215, 0.046, 0.042),
        (1.16, 0.222, 0.04, 0.037),
        (1.10, 0.228, 0.041, 0.036),
        (1.02, 0.232, 0.037, 0.033),
        (0.94, 0.236, 0.029, 0.026),
        (0.88, 0.24, 0.026, 0.022),
        (0.83, 0.24, 0.042, 0.018),
        (0.77, 0.24, 0.038, 0.017),
        (0.72, 0.24, 0.02, 0.012),
    ]
    foot = [(-0.075, 0.045, 0.02, 0.02), (-0.06, 0.05, 0.033, 0.045), (0.0, 0.05, 0.04, 0.05),
            (0.07, 0.04, 0.044, 0.04), (0.14, 0.028, 0.046, 0.028), (0.19, 0.022, 0.036, 0.021),
            (0.205, 0.018, 0.018, 0.012)]  # fmt: skip
    for side, y in (("L", 1), ("R", -1)):
        leg = blend(("hips", 0.93, 0.06), (f"thigh{side}", 0.51, 0.06),
                    (f"shank{side}", 0.09, 0.03), (f"foot{side}", 0, 1))  # fmt: skip
        person.tube([(0, 0.09 * y, z, a, b) for z, a, b in legs], leg, 14)
        person.tube([(x, 0.095 * y, z, a, b) for x, z, a, b in foot],
                  lambda x, own=side: (f"foot{own}", f"toes{own}", np.clip((x - 0.1) / 0.06, 0, 1)),
                  12, along=0)  # fmt: skip
        arm = blend(("spine", 1.44, 0.03), (f"arm{side}", 1.13, 0.05), (f"forearm{side}", 0, 1))
        person.tube([(0, w * y, z, a, b) for z, w, a, b in arms], arm, 12)
    return person


def rotations(angle, axis=1):
    """Return the quaternions (x, y, z, w) of rotations about an axis."""
    quaternions = np.zeros((*np.shape(angle), 4))
    quaternions[..., axis], quaternions[..., 3] = (
        np.sin(np.asarray(angle) / 2),
        np.cos(np.asarray(angle) / 2),
    )
    return quaternions


def times(p, q):
    (a, b, c, d), (e, f, g, h) = np.moveaxis(p, -1, 0), np.moveaxis(q, -1, 0)
    return np.stack([d * e + a * h + b * g - c * f, d * f - a * g + b * h + c * e,
                     d * g + a * f - b * e + c * h, d * h - a * e - b * f - c * g], -1)  # fmt: skip


def ankle(phase):
    """Return the position of an ankle and the pitch of its foot at a given phase of the gait cycle.

    The position consists of the forward distance from the hips and the height above the ground. The
    pitch is positive if the toes point up. The phase is 0 when the heel strikes the ground.
    """
    phase = np.asarray(phase) % 1

    def standing(phase):
        traveled = SPEED_M_S * CYCLE_S * phase
        up = np.radians(20) * np.clip(1 - phase / 0.1, 0, 1)
        rises = np.clip((phase - 0.32) / (STANCE - 0.32), 0, 1)
        down = np.radians(60) * rises**1.6
        pitch = up - down
        pivot = np.where(phase < 0.2, HEEL, BALL)
        x = STRIKE_M - HEEL + pivot - traveled - (pivot * np.cos(pitch) + ANKLE_M * np.sin(pitch))
        return np.stack([x, ANKLE_M * np.cos(pitch) - pivot * np.sin(pitch), pitch])

    # In the air, the foot follows a cubic that matches position and velocity at both ends.
    step = 1e-4
    air = 1 - STANCE
    u = np.clip((phase - STANCE) / air, 0, 1)
    leaves = standing(STANCE)
    strikes = standing(0.0)
    leaving_slope = (leaves - standing(STANCE - step)) / step * air
    striking_slope = (standing(step) - strikes) / step * air
    leaving_slope[1:] = 0
    striking_slope[1:] = 0
    one, other = (2 * u**3 - 3 * u**2 + 1, 3 * u**2 - 2 * u**3), (u**3 - 2 * u**2 + u, u**3 - u**2)
    path = [
        one[0] * p + one[1] * q + other[0] * v + other[1] * w
        for p, v, q, w in zip(leaves, leaving_slope, strikes, striking_slope, strict=True)
    ]
    path[1] = path[1] + LIFT_M * np.sin(np.pi * u) ** 2
    return np.where(phase < STANCE, standing(phase), path)


def walk(phase):
    """Return joint rotations and hip positions at the given phases.

    Phases have shape (k,), and the result has the form {joint: (k, …)}.
    """
    cycle = 2 * np.pi * phase
    swing = np.cos(cycle)  # forward swing of the left leg
    yaw = np.radians(6) * -swing  # moves the left hip forward
    height = HIP_M + 0.018 * np.cos(2 * (cycle - 2 * np.pi * 0.32))
    sway = 0.02 * np.sin(cycle)
    lean = rotations(np.radians(3) + 0 * yaw)
    moved = {
        "hips": rotations(yaw, 2),
        "spine": times(rotations(-2 * yaw, 2), lean),
        "head": rotations(yaw, 2),
    }
    moved["translation"] = np.stack([0 * phase, sway, height + 0.94 - ANKLE_M - 2 * LEG], axis=-1)
    for side, late, y in (("L", 0.0, 1), ("R", 0.5, -1)):
        x, z, pitch = ankle(phase - late)
        x = x + np.sin(yaw) * 0.09 * y
        reach = np.minimum(np.hypot(x, height - z), 1.999 * LEG)
        bent = np.arccos(reach / (2 * LEG))
        ahead = np.arctan2(x, height - z) + bent
        moved[f"thigh{side}"] = times(rotations(-yaw, 2), rotations(-ahead))
        moved[f"shank{side}"] = rotations(2 * bent)
        moved[f"foot{side}"] = rotations(ahead - 2 * bent - pitch)
        flying = np.clip(((phase - late) % 1 - STANCE) / 0.25, 0, 1)
        moved[f"toes{side}"] = rotations(np.minimum(pitch, 0) * (1 - flying))  # flat on the ground
        forth = -swing if side == "L" else swing
        moved[f"arm{side}"] = rotations(-np.radians(24) * forth + np.radians(2))
        moved[f"forearm{side}"] = rotations(-np.radians(18 + 12 * forth))
    return moved


class Buffer:
    """Binary chunk of a glTF file, with the buffer views and accessors of the arrays in it."""

    def __init__(self) -> None:
        self.views = []
        self.accessors = []
        self.data = b""

    def store(self, array, kind, **extra) -> int:
        """Append an array and return the index of its accessor."""
        array = np.ascontiguousarray(array)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes}
        self.views.append(view)
        self.data += array.tobytes() + bytes(-array.nbytes % 4)
        part = {"f": 5126, "B": 5121, "H": 5123}[array.dtype.char]
        count = array.size // {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[kind]
        self.accessors.append({"bufferView": len(self.views) - 1, "componentType": part,
                               "type": kind, "count": count, **extra})  # fmt: skip
        return len(self.accessors) - 1


def skeleton() -> list[dict]:
    """Return the glTF nodes of the root, the body and the joints."""
    positions = {name: np.array(position, float) for name, _, position in JOINTS}
    nodes = [{"name": "Pedestrian", "children": [1, 2], "rotation": [-(0.5**0.5), 0, 0, 0.5**0.5]},
             {"name": "Body", "mesh": 0, "skin": 0}]  # fmt: skip
    for name, parent, position in JOINTS:
        start = 0.0 if parent is None else positions[parent]
        children = [2 + k for k, (_, above, _) in enumerate(JOINTS) if above == name]
        nodes.append({"name": name, "translation": (np.array(position) - start).tolist()}
                     | ({"children": children} if children else {}))  # fmt: skip
    return nodes


def walk_animation(buffer: Buffer) -> dict:
    """Store the key frames of a gait cycle and return the animation."""
    phase = np.linspace(0, 1, KEYS + 1)
    times = np.array(CYCLE_S * phase, "f")
    keys = buffer.store(times, "SCALAR", min=[0.0], max=[float(times[-1])])
    samplers = []
    channels = []
    for name, values in walk(phase).items():
        kind, path = ("VEC3", name) if name == "translation" else ("VEC4", "rotation")
        node = 2 + NAMES.index("hips" if name == "translation" else name)
        samplers.append({"input": keys, "output": buffer.store(np.array(values, "f"), kind)})
        target = {"node": node, "path": path}
        channels.append({"sampler": len(samplers) - 1, "target": target})
    return {"name": "Walk", "samplers": samplers, "channels": channels}


def glb(person: Figure) -> bytes:
    """Return a glTF file that contains the figure, its skin and its animation."""
    buffer = Buffer()
    bound = np.tile(np.eye(4, dtype="f"), (len(JOINTS), 1, 1))
    bound[:, 3, :3] = [-np.array(position, float) for _, _, position in JOINTS]
    points = np.array(person.points, "f")
    limits = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
    attributes = {
        "POSITION": buffer.store(points, "VEC3", **limits),
        "JOINTS_0": buffer.store(np.array(person.joints, "B"), "VEC4"),
        "WEIGHTS_0": buffer.store(np.array(person.weights, "f"), "VEC4"),
    }
    faces = buffer.store(np.array(person.faces, "H"), "SCALAR")
    inverse = buffer.store(bound, "MAT4")
    animation = walk_animation(buffer)
    header = {
        "asset": {"version": "2.0", "generator": "lidarpool"},
        "scene": 0, "scenes": [{"nodes": [0]}], "nodes": skeleton(),
        "meshes": [{"name": "Body", "primitives": [{"attributes": attributes, "indices": faces}]}],
        "skins": [{"joints": list(range(2, 2 + len(JOINTS))), "inverseBindMatrices": inverse}],
        "animations": [animation],
        "accessors": buffer.accessors, "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }  # fmt: skip
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(buffer.data), b"BIN\0") + buffer.data
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


if __name__ == "__main__":
    Path(__file__).with_name("pedestrian.glb").write_bytes(glb(figure()))
