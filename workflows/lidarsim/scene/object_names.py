"""Unique object names, which are created by appending numbers or by merging objects."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

from ..words import plural
from .actors import join_meshes
from .scene_instances import SceneInstance
from .scene_mesh import SceneMesh

SameNames = Literal["number", "join"]

_MAX_SHOWN = 3


def resolve_same_names(
    objects: Sequence[SceneMesh | SceneInstance],
    same_names: SameNames,
    report: Callable[[str], None],
) -> list[SceneMesh | SceneInstance]:
    """Merge objects with the same name, or report duplicate names.

    Parameters
    ----------
    objects
        Objects in world coordinates, in the order of the files.
    same_names
        With "join", all objects with the same name become one object at the position of the first.
        With "number", the objects are returned unchanged, since a scene appends numbers to
        duplicate names (Wall, Wall.2).
    report
        Called with a message about duplicate names if `same_names` is "number".

    Raises
    ------
    LidarError
        If an object with voxels would be merged with another object.
    """
    if same_names == "join":
        groups: dict[str, list[SceneMesh | SceneInstance]] = {}
        for item in objects:
            groups.setdefault(item.name, []).append(item)
        return [
            group[0] if len(group) == 1 else join_meshes(name, group)
            for name, group in groups.items()
        ]
    names = [item.name for item in objects]
    pairs = zip(names, unique_names(names), strict=True)
    if numbered := [unique for name, unique in pairs if unique != name]:
        shown = ", ".join(numbered[:_MAX_SHOWN]) + ", …" * (len(numbered) > _MAX_SHOWN)
        have = "has" if len(numbered) == 1 else "have"
        report(
            f"{plural(len(numbered), 'object')} with a duplicate name {have} a number appended: "
            f'{shown}. To merge objects with the same name, use <scene.same_names="join">'
        )
    return list(objects)


def unique_names(names: Sequence[str]) -> tuple[str, ...]:
    """Make names unique by appending numbers to duplicates.

    Examples
    --------
    >>> unique_names(["Shelf", "Shelf", "Shelf.2", "Shelf"])
    ('Shelf', 'Shelf.3', 'Shelf.2', 'Shelf.4')
    """
    all_names = set(names)
    used: set[str] = set()
    numbers: dict[str, int] = {}  # {name: last number that was tried}
    numbered = []
    for name in names:
        unique = name
        while unique in used or (unique != name and unique in all_names):
            numbers[name] = numbers.get(name, 1) + 1
            unique = f"{name}.{numbers[name]}"
        used.add(unique)
        numbered.append(unique)
    return tuple(numbered)
