"""Importer for XML files in which <stop x="" y="" z=""/> elements are the poses of a survey."""

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import yaml


def read_tour(survey: Path, folder: Path, assets: Sequence[Path]) -> list[str]:
    """Write scenario.yaml to a folder and return a list of unsupported features."""
    root = ElementTree.parse(survey).getroot()
    stops = [[float(stop.attrib[axis]) for axis in "xyz"] for stop in root.iter("stop")]
    scenario = {"scene": root.get("scene", "seed"), "poses": stops}
    scenario["sensor"] = root.get("sensor", "acme/x1")
    (folder / "scenario.yaml").write_text(yaml.safe_dump(scenario), encoding="utf-8")
    return sorted({f"<{element.tag}>" for element in root if element.tag != "stop"})
