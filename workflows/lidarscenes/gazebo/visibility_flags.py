"""Determine which visuals are seen by the lidars in a world.

A lidar sees a visual if its <visibility_mask> and the <visibility_flags> of the visual have a
common bit (SDFormat 1.12).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from xml.etree.ElementTree import Element

from lidarsim.errors import LidarError, prefix_errors
from lidarsim.schema.value_texts import format_value
from lidarsim.words import printable

LIDARS = ("gpu_lidar", "lidar", "gpu_ray", "ray")  # sensor types
ALL_BITS = 0xFFFF_FFFF  # default for flags and masks


def lidar_elements(link: Element) -> Iterator[Element]:
    """Yield those <sensor> elements of a link that are lidars."""
    return (sensor for sensor in link.findall("sensor") if sensor.get("type") in LIDARS)


def lidar_settings(sensor: Element) -> Element | None:
    """Return the <lidar> or <ray> element in a <sensor>, or None."""
    figures = sensor.find("lidar")
    return sensor.find("ray") if figures is None else figures


def read_flags(visual: Element) -> int:
    """Return the <visibility_flags> of a visual.

    Raises LidarError if they are not a 32-bit number.
    """
    return _bits(visual, "visibility_flags")


def read_mask(sensor: Element) -> int:
    """Return the <visibility_mask> of a lidar.

    Raises LidarError if it is not a 32-bit number.
    """
    figures = lidar_settings(sensor)
    return ALL_BITS if figures is None else _bits(figures, "visibility_mask")


def distinct_masks(links: Iterable[Element]) -> tuple[int, ...]:
    """Return the distinct visibility masks of all lidars on the given links, in ascending order."""
    masks = set()
    for link in links:
        for sensor in lidar_elements(link):
            with prefix_errors(f"sensor {printable(sensor.get('name', ''))!r}"):
                masks.add(read_mask(sensor))
    return tuple(sorted(masks))


def _bits(element: Element, name: str) -> int:
    """Return a 32-bit number from a child element, or all bits if the element is missing."""
    text = (element.findtext(name) or "").strip()
    if not text:
        return ALL_BITS
    try:
        bits = int(text, 16 if text.lower().startswith("0x") else 10)
    except ValueError:
        bits = -1
    if not 0 <= bits <= ALL_BITS:
        raise LidarError(
            f"<{name}> is {format_value(text)}; it must be an integer from 0 to {ALL_BITS}."
        )
    return bits
