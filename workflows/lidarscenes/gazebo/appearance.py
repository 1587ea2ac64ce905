"""Read the colors and material names of SDFormat visuals."""

from __future__ import annotations

from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Bytes
from lidarsim.scene.colors import as_bytes, as_srgb
from lidarsim.words import printable

from .frames import child_numbers

FULL_RETRO = 255.0  # value of <laser_retro> that is as bright as white

# Diffuse sRGB colors of the plain materials that are part of Gazebo.
_NAMED: dict[str, tuple[float, float, float]] = {
    "black": (0.0, 0.0, 0.0),
    "blue": (0.0, 0.0, 1.0),
    "darkgray": (0.175, 0.175, 0.175),
    "darkgrey": (0.175, 0.175, 0.175),
    "darkyellow": (0.7, 0.7, 0.0),
    "flatblack": (0.1, 0.1, 0.1),
    "gray": (0.7, 0.7, 0.7),
    "green": (0.0, 1.0, 0.0),
    "grey": (0.7, 0.7, 0.7),
    "orange": (1.0, 0.5088, 0.0468),
    "purple": (1.0, 0.0, 1.0),
    "red": (1.0, 0.0, 0.0),
    "turquoise": (0.0, 1.0, 1.0),
    "white": (1.0, 1.0, 1.0),
    "yellow": (1.0, 1.0, 0.0),
}
_PREFIX = "Gazebo/"


class Appearance(NamedTuple):
    """Color and material of a visual.

    Attributes
    ----------
    color
        uint8 (1, 1, 3), sRGB; None without a color.
    material
        Name of the material, or an empty string.
    is_retro
        Whether the color comes from <laser_retro>, which takes precedence over images.
    is_hidden
        Whether the visual is fully transparent.
    """

    color: Bytes | None
    material: str
    is_retro: bool
    is_hidden: bool


def read_appearance(shape: Element, retro: float) -> Appearance:
    """Return the appearance of a visual or collision.

    `retro` is its <laser_retro>, or 0 if there is none.
    """
    material = shape.find("material")
    hidden = child_numbers(shape, "transparency", 1, "0").item() >= 1
    name = "" if material is None else printable(material.findtext("script/name") or "")
    if retro > 0:
        gray = as_srgb(np.full((1, 1, 3), min(retro / FULL_RETRO, 1.0)))
        return Appearance(gray, name, True, hidden)
    color = None
    if material is not None:
        text = (material.findtext("diffuse") or "").strip()
        values = text.split()
        if text and len(values) not in (3, 4):
            raise LidarError(f"<diffuse> is {text[:60]!r}; it must be 3 or 4 finite numbers.")
        if text:
            color = as_bytes(child_numbers(material, "diffuse", len(values), "")[:3])
        elif name.startswith(_PREFIX):
            named = _NAMED.get(name.removeprefix(_PREFIX).lower())
            color = None if named is None else as_bytes(named)
    return Appearance(None if color is None else color.reshape(1, 1, 3), name, False, hidden)
