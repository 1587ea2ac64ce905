"""Read Gazebo actors, whose skins follow waypoints."""

from __future__ import annotations

from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.errors import LidarError, prefix_errors
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.actors import join_meshes
from lidarsim.scene.files.scene_graph import PlacedNode, RigidPart
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.words import printable

from .frames import child_numbers, read_matrix, read_pose
from .link_meshes import LinkMeshes
from .notes import Notes
from .resources import Source

_LOOP_S = 600.0  # duration for which a looping script is repeated
_MAX_POSES = 5000  # maximum number of poses of an actor
_JUMP_S = 1e-3  # time in which an actor returns from its last waypoint to the first


class Actors(NamedTuple):
    """The actors in a world."""

    moving: list[RigidPart]
    standing: list[PlacedNode]


def read_actors(world: Element, source: Source, meshes: LinkMeshes, notes: Notes) -> Actors:
    """Read the actors in a world, with skins in their rest pose."""
    actors = Actors([], [])
    for element in world.findall("actor"):
        notes.check_children(element)
        name = printable(element.get("name", "")) or "actor"
        with prefix_errors(f"actor {name!r}"):
            mesh = _skin(element, source, meshes)
            if mesh is None:
                continue
            notes.further["contains actors, whose skins are not animated"] = None
            times_s, poses = _waypoints(element, name, notes)
            if len(times_s) < 2:
                actors.standing.append(PlacedNode(mesh, poses[0], name))
            else:
                part = RigidPart(name, [mesh], times_s, poses[:, :3, 3], poses[:, :3, :3])
                actors.moving.append(part)
    return actors


def _skin(actor: Element, source: Source, meshes: LinkMeshes) -> SceneMesh | None:
    """Return an actor's skin, or None if it has none or if the file is missing."""
    skin = actor.find("skin")
    if skin is None:
        return None
    parts = meshes.skin_meshes((skin.findtext("filename") or "").strip(), source)
    scale = child_numbers(skin, "scale", 1, "1").item()
    if not parts or not scale:
        return None
    joined = join_meshes("skin", parts)
    return joined.affine_transform("skin", scale * np.eye(3), np.zeros(3))


def _waypoints(actor: Element, name: str, notes: Notes) -> tuple[Floats, Floats]:
    """Return an actor's times in seconds, and its poses at these times.

    A stationary actor has a single pose.
    """
    script = actor.find("script")
    entries = [] if script is None else script.findall("trajectory/waypoint")
    if not entries:
        return np.zeros(1), read_pose(actor).matrix[None]
    times_s = np.array([child_numbers(entry, "time", 1, "0").item() for entry in entries])
    poses = np.array([_waypoint_pose(entry) for entry in entries])
    times_s, rows = np.unique(times_s, return_index=True)
    poses = poses[rows]
    assert script is not None, "a script that has waypoints"
    delay_s = child_numbers(script, "delay_start", 1, "0").item()
    if (script.findtext("loop") or "true").strip() in ("true", "1") and times_s[-1] > 0:
        times_s, poses = _repeated(times_s, poses)
        if times_s[-1] < _LOOP_S:
            notes.further[
                f"contains the actor {name} with so many waypoints that its loop is repeated for "
                f"only {times_s[-1]:.4g} s"
            ] = None
    return times_s + delay_s, poses


def _waypoint_pose(waypoint: Element) -> Floats:
    """Return a waypoint's pose in the world.

    Raises LidarError if the waypoint has no pose.
    """
    pose = waypoint.find("pose")
    if pose is None:
        raise LidarError("a <waypoint> has no <pose>.")
    return read_matrix(pose)


def _repeated(times_s: Floats, poses: Floats) -> tuple[Floats, Floats]:
    """Repeat waypoints for at least `_LOOP_S` seconds, or up to `_MAX_POSES` poses."""
    duration_s = float(times_s[-1])
    # Each repetition begins shortly after the previous one ends.
    start_s = np.maximum(times_s, _JUMP_S) if duration_s > _JUMP_S else times_s
    start_s, rows = np.unique(start_s, return_index=True)
    rounds = int(min(np.ceil(_LOOP_S / duration_s), _MAX_POSES // len(poses)))
    later = [start_s + k * duration_s for k in range(1, max(rounds, 1))]
    all_times = np.concatenate([times_s, *later])
    return all_times, np.concatenate([poses, *[poses[rows]] * len(later)])
