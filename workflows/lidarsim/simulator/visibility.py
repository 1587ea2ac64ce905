"""Visibility: the objects that each sensor of a survey does not see."""

from __future__ import annotations

import numpy as np

from ..base.arrays import Bools
from ..scene.scene import Scene
from ..sensor import Survey
from ..sensor.materials import matching_rows


def unseen_objects(scene: Scene, survey: Survey) -> tuple[Bools | None, ...]:
    """Return the objects that the sensors of a survey do not see, by the sensors' patterns.

    Returns
    -------
    For each sensor a mask (objects,), in the order of `Scene.all_names`; None if the sensor sees
    all objects.

    Raises
    ------
    LidarError
        If a pattern of a sensor fits no object.
    """
    if not any(carried.unseen for carried in survey.carried):
        return (None,) * len(survey.carried)
    names = scene.all_names
    object_rows = {name: row for row, name in enumerate(names)}
    masks: list[Bools | None] = []
    for carried in survey.carried:
        mask = np.zeros(len(names), np.bool_)
        subject = f"unseen of sensor {carried.name!r}" if carried.name else "unseen"
        for pattern in carried.unseen:
            mask[matching_rows(pattern, names, object_rows, subject)] = True
        masks.append(mask if mask.any() else None)
    return tuple(masks)


def static_key(scene: Scene, unseen: Bools | None) -> bytes:
    """Return bytes that are equal for masks (objects,) of the same unseen static objects.

    Empty if all static objects are seen: of the mask None, or of unseen actors alone.
    """
    if unseen is None or not unseen[: len(scene.names)].any():
        return b""
    return unseen[: len(scene.names)].tobytes()
