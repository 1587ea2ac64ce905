"""Determine which objects each sensor of a survey cannot see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..media.materials import match_object_names
from ..numerics.arrays import Bools
from ..scene.scene import Scene
from ..survey.survey import Survey


def unseen_objects(scene: Scene, survey: Survey) -> tuple[Bools | None, ...]:
    """Return the objects that each sensor of a survey cannot see.

    Returns
    -------
    tuple
        One boolean mask (objects,) per sensor, in the order of `Scene.object_names`, or None if the
        sensor sees all objects.

    Raises
    ------
    LidarError
        If a pattern in `Mounted.unseen` matches no object.
    """
    if not any(carried.unseen for carried in survey.mounted_sensors):
        return (None,) * len(survey.mounted_sensors)
    names = scene.object_names
    object_rows = {name: row for row, name in enumerate(names)}
    masks: list[Bools | None] = []
    for carried in survey.mounted_sensors:
        mask = np.zeros(len(names), np.bool_)
        subject = f"unseen of sensor {carried.name!r}" if carried.name else "unseen"
        for pattern in carried.unseen:
            mask[match_object_names(pattern, names, object_rows, subject)] = True
        masks.append(mask if mask.any() else None)
    return tuple(masks)


def static_key(scene: Scene, unseen: Bools | None) -> bytes:
    """Return a key that identifies the static objects that a mask marks as unseen.

    The key is empty if all static objects are visible.
    """
    if unseen is None or not unseen[: len(scene.names)].any():
        return b""
    return unseen[: len(scene.names)].tobytes()


def without_objects(scene: Scene, unseen: Bools) -> Scene | None:
    """Return the scene without invisible static objects, or None if no object is left.

    `unseen` is a mask (objects,). Objects keep their numbers. Colors, materials and actors are
    omitted.
    """
    faces = np.flatnonzero(~unseen[scene.face_object])
    instances = scene.instances
    if instances is not None:
        instance_indices = np.flatnonzero(~unseen[instances.owner])
        instances = replace(
            instances,
            part=instances.part[instance_indices],
            transforms=instances.transforms[instance_indices],
            owner=instances.owner[instance_indices],
        )
        instances = instances if len(instance_indices) else None
    if not len(faces) and instances is None:
        return None
    return Scene(
        scene.vertices,
        scene.faces[faces],
        scene.face_object[faces],
        scene.names,
        scene.origin,
        instances=instances,
        world_origin=scene.world_origin,
    )
