"""Find the XML files to which a HELIOS++ survey refers, and read values from them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.errors import LidarError, explain_os_errors, prefix_errors
from lidarsim.io.input_files import read_input
from lidarsim.io.named_files import is_inside
from lidarsim.io.xmlfile import xml_root
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.transform import rotation_about
from lidarsim.words import did_you_mean, printable

# Folder in a checkout of HELIOS++ that contains its surveys' data/scanners_als.xml.
_PACKAGE = Path("python/pyhelios")
_MAX_FOLDERS_UP = 5  # folders above a survey that are searched for its files
_MAX_TEMPLATES = 10  # maximum length of a chain of templates


class Asset(NamedTuple):
    """An element, and the XML file that contains it."""

    element: Element
    home: Path  # file that contains the element, for references without a file


class Assets:
    """The files to which a survey may refer.

    Files are searched for in `folders`, in the folder of the survey, and in its parent folders. All
    other files are rejected.
    """

    def __init__(self, survey: Path, folders: Sequence[Path]) -> None:
        own, *above = survey.resolve().parents
        home = Path(os.path.expanduser("~")).resolve()  # noqa: PTH111 - never fails
        nearby = [Path(), *above[:_MAX_FOLDERS_UP]]
        nearby = [own, *(f for f in nearby if not home.is_relative_to(f.resolve()))]
        candidates = [*folders, *nearby, *(folder / _PACKAGE for folder in nearby)]
        self.folders = tuple(dict.fromkeys(candidates))
        self._allowed = [folder.resolve() for folder in self.folders]
        self.root = cache(_root)

    def check_allowed(self, file: Path, name: str) -> None:
        """Check that the survey may refer to a file.

        Raises LidarError if the file is outside all folders.
        """
        with suppress(OSError, ValueError, RuntimeError):  # no file can have this name
            if is_inside(file, self._allowed):
                return
            raise LidarError(
                f"the survey refers to the file {printable(name)!r}, which is neither in its "
                "folder nor in a parent folder. Pass a folder that contains the file with "
                "--assets DIR."
            )

    def find_file(self, name: str) -> Path:
        """Find the path of a file, given its name.

        Raises LidarError if no folder contains the file, or if the survey may not refer to it.
        """
        for folder in self.folders:
            if (folder / name).is_file():
                self.check_allowed(folder / name, name)
                return folder / name
        raise LidarError(
            f"the file {name!r} is neither in the folder of the survey nor in a parent folder. "
            "Pass the folder to which its path is relative with --assets DIR."
        )

    def find_element(self, reference: str, kind: str, home: Path) -> Asset:
        """Return the element with the tag `kind` to which a reference such as FILE.xml#ID refers.

        A reference without a file refers to the file `home`.
        """
        file, _, name = reference.rpartition("#")
        path = self.find_file(file) if file else home
        elements = {element.get("id", ""): element for element in self.root(path).findall(kind)}
        if name not in elements:
            raise LidarError(f"{path} has no <{kind}> {name!r}.{did_you_mean(name, elements)}")
        return Asset(elements[name], path)

    def read_settings(self, element: Element | None, home: Path, depth: int = 0) -> dict[str, str]:
        """Return the attributes of a settings element, with default values from its template."""
        if element is None:
            return {}
        attributes = dict(element.attrib)
        if (template := attributes.pop("template", None)) is None:
            return attributes
        if depth == _MAX_TEMPLATES:
            raise LidarError(
                f"the template {template!r} refers to itself or to too many other templates."
            )
        defaults = self.find_element(template, element.tag, home)
        return self.read_settings(*defaults, depth + 1) | attributes


def _root(path: Path) -> Element:
    """Return the <document> element in a file.

    Raises LidarError if the file is not a HELIOS++ document.
    """
    try:
        with explain_os_errors(f"{path} cannot be read"):
            root = xml_root(read_file(path))
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise LidarError(f"{path} is not valid XML: {error}.") from error
    if root.tag != "document":
        raise LidarError(
            f"{path} is an XML file, but not a HELIOS++ document. Its root element is "
            f"<{root.tag[:40]}>."
        )
    return root


def read_file(path: Path) -> bytes:
    """Read a regular file completely.

    Raises LidarError if the file cannot be read or does not fit into memory.
    """
    with explain_os_errors(f"{path} cannot be read"), prefix_errors(path):
        return read_input(path)


def read_number(values: Element | dict[str, str], name: str, default: float) -> float:
    """Return an attribute as a finite number.

    Raises LidarError if the attribute is not a finite number.
    """
    text = values.get(name)
    if text is None:
        return default
    with suppress(ValueError):
        if np.isfinite(value := float(text)):
            return value
    raise LidarError(f"{name} is {text!r}; it must be a number.")


def read_flag(values: dict[str, str], name: str, default: bool) -> bool:
    """Return an attribute as a bool, or the default if it is missing."""
    return values[name].lower() in ("true", "1") if name in values else default


def read_vector(values: Element | dict[str, str] | None) -> Floats:
    """Return the attributes x, y, and z as an array. Missing attributes count as zero."""
    return np.array([read_number({} if values is None else values, axis, 0.0) for axis in "xyz"])


def read_rotation(element: Element | None) -> Floats:
    """Return the product of all <rot> rotations in an element, in the given order.

    The axes are fixed unless the element states ``rotations="local"``. In this case, each rotation
    also rotates the axes of the following ones.
    """
    total = np.eye(3)
    for step in () if element is None else element.findall("rot"):
        axis = step.get("axis", "").lower()
        if axis not in ("x", "y", "z"):
            raise LidarError(f"<rot> has the axis {axis!r}; it must be x, y or z.")
        step_rotation = rotation_about(
            np.eye(3)["xyz".index(axis)], read_number(step, "angle_deg", 0.0)
        )
        local = element is not None and element.get("rotations") == "local"
        total = total @ step_rotation if local else step_rotation @ total
    return total


def round_values(values: Floats | float | Sequence[float]) -> list[float] | float:
    """Round numbers to 12 significant digits for a scenario, and set tiny values to zero."""
    array = np.asarray(values, np.float64)
    if array.ndim:
        return [round_values(value) for value in array.tolist()]  # type: ignore[misc]
    value = array.item()
    return float(f"{value:.12g}") if abs(value) > 1e-9 else 0.0
