"""Robots in worlds that another program controls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidarsim.numerics.arrays import Floats
from lidarsim.numerics.elementary_scalars import sin_cos_of
from lidarsim.numerics.vectors import matmul, matvec
from lidarsim.scene.scene_instances import SceneInstance
from lidarsim.worlds.world import WORLD, World, WorldBody, WorldFrame

from .robot import Joint, Robot


def world_of_robot(robot: Robot, prefix: str = "") -> World:
    """Return the links of a robot as bodies of a world.

    Each link is a frame, whose parent is its parent link. The root link is at the origin of the
    world, and the joints are at zero, or at the limits that are closest to zero.

    Parameters
    ----------
    robot
        The robot.
    prefix
        Beginning of all frame names, such as "robot/".
    """
    bodies = []
    frames = {}
    in_world: dict[str, Floats] = {}
    for link in robot.links:
        joint = robot.joints.get(link)
        if joint is None:
            in_world[link] = np.eye(4)
            frames[prefix + link] = WorldFrame(WORLD, np.eye(4))
        else:
            lower, upper = joint.limits or (0.0, 0.0)
            matrix = joint_matrix(joint, min(max(0.0, lower), max(upper, lower)))
            in_world[link] = matmul(in_world[joint.parent], matrix)
            frames[prefix + link] = WorldFrame(prefix + joint.parent, matrix)
        if (mesh := robot.meshes.get(link)) is not None:
            name = f"{prefix or f'{robot.name}/'}{link}"
            item = SceneInstance(replace(mesh, name=name), in_world[link], name)
            bodies.append(WorldBody(item, prefix + link, in_world[link], is_static=False))
    return World(tuple(bodies), frames)


def joint_matrix(joint: Joint, value: float) -> Floats:
    """Return the pose of a link relative to its parent link.

    Parameters
    ----------
    joint
        The joint between the links.
    value
        Value of the joint in radians or meters. It is ignored for joints that do not move.

    Returns
    -------
    float64 array of shape (4, 4)
    """
    matrix = joint.origin.copy()
    if joint.kind == "prismatic":
        matrix[:3, 3] += matvec(matrix[:3, :3], joint.axis * value)
    elif joint.is_movable and value:
        cross = np.cross(np.eye(3), joint.axis)  # Rodrigues, 1840
        sine, cosine = sin_cos_of(value)
        rotation = np.eye(3) + sine * cross + (1 - cosine) * matmul(cross, cross)
        matrix[:3, :3] = matmul(matrix[:3, :3], rotation)
    return matrix
