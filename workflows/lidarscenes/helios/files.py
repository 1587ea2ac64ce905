"""Finds the XML files of HELIOS++, and reads their values."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.base.arrays import Floats
from lidarsim.base.errors import LidarError, explained, prefixed
from lidarsim.base.input_files import read_input
from lidarsim.base.words import did_you_mean
from lidarsim.base.xmlfile import xml_root
from lidarsim.scene.transform import rotation_about

# Where a checkout of HELIOS++ has what its surveys call data/scanners_als.xml.
_PACKAGE = Path("python/pyhelios")
_TEMPLATES_MOST = 10  # that name each other


class Asset(NamedTuple):
    """An element, and the file that it is from, where names without a file are looked up."""

    element: Element
    home: Path


class Assets:
    """Files that a survey names: in the given folders, or in those that its own lies in."""

    def __init__(self, survey: Path, folders: Sequence[Path]) -> None:
        above = survey.resolve().parents
        places = [*folders, Path(), *above, *(folder / _PACKAGE for folder in above)]
        self.places = tuple(dict.fromkeys(places))
        self.root = cache(_root)

    def file(self, name: str) -> Path:
        """Find a file; LidarError if it is nowhere."""
        for place in self.places:
            if (place / name).is_file():
                return place / name
        raise LidarError(
            f"there is no file {name!r} in the survey's folder or one above it: give the folder "
            "that it starts from, --assets DIR."
        )

    def asset(self, reference: str, kind: str, home: Path) -> Asset:
        """Find the element of a kind that FILE.xml#ID names, or ID in the file `home`."""
        file, _, name = reference.rpartition("#")
        path = self.file(file) if file else home
        known = {element.get("id", ""): element for element in self.root(path).findall(kind)}
        if name not in known:
            raise LidarError(f"there is no <{kind}> {name!r} in {path}.{did_you_mean(name, known)}")
        return Asset(known[name], path)

    def settings(self, element: Element | None, home: Path, depth: int = 0) -> dict[str, str]:
        """Attributes of settings, and beneath them those of the template that they name."""
        if element is None:
            return {}
        own = dict(element.attrib)
        if (template := own.pop("template", None)) is None:
            return own
        if depth == _TEMPLATES_MOST:
            raise LidarError(f"the template {template!r} names itself, or too many others.")
        under = self.asset(template, element.tag, home)
        return self.settings(*under, depth + 1) | own


def _root(path: Path) -> Element:
    """Return the <document> of a file; LidarError if it is none."""
    try:
        with explained(f"{path} cannot be read"):
            root = xml_root(read(path))
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise LidarError(f"{path} is not readable XML: {error}.") from error
    if root.tag != "document":
        raise LidarError(
            f"{path} is XML, but not of HELIOS++: it begins with <{root.tag[:40]}>, not <document>."
        )
    return root


def read(path: Path) -> bytes:
    """Read a file; LidarError if it is no plain file or larger than the memory."""
    with explained(f"{path} cannot be read"), prefixed(path):
        return read_input(path)


def number(values: Element | dict[str, str], name: str, default: float) -> float:
    """Return an attribute as a finite number."""
    text = values.get(name)
    if text is None:
        return default
    with suppress(ValueError):
        if np.isfinite(value := float(text)):
            return value
    raise LidarError(f"{name} is {text!r}; it must be a number.")


def flag(values: dict[str, str], name: str, default: bool) -> bool:
    """Return an attribute as true or false."""
    return values[name].lower() in ("true", "1") if name in values else default


def vector(values: Element | dict[str, str] | None) -> Floats:
    """Return x, y and z of an element or its attributes; zeros where there is none."""
    return np.array([number({} if values is None else values, axis, 0.0) for axis in "xyz"])


def rotation(element: Element | None) -> Floats:
    """Return the rotation (3, 3) of the <rot> in an element, one after the other.

    About the axes around the element; with rotations="local" about its own.
    """
    out = np.eye(3)
    for step in () if element is None else element.findall("rot"):
        axis = step.get("axis", "").lower()
        if axis not in ("x", "y", "z"):
            raise LidarError(f"<rot> has the axis {axis!r}; it must be x, y or z.")
        turn = rotation_about(np.eye(3)["xyz".index(axis)], number(step, "angle_deg", 0.0))
        local = element is not None and element.get("rotations") == "local"
        out = out @ turn if local else turn @ out
    return out


def clean(values: Floats | float | Sequence[float]) -> list[float] | float:
    """Numbers as a scenario has them: 12 digits, nothing that is 0 but for rounding."""
    array = np.asarray(values, np.float64)
    if array.ndim:
        return [clean(value) for value in array.tolist()]  # type: ignore[misc]
    value = array.item()
    return float(f"{value:.12g}") if abs(value) > 1e-9 else 0.0
