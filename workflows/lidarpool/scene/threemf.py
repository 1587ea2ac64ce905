"""How many objects a .3mf file places, which trimesh does not always find all.

It follows nested components only so far (100 instances by two levels of ten come as 75), and
takes two items of one object and part number for the same. Of another file of the archive, where
slicers put their parts, it takes all meshes for each part, and its numbers for those of the model.
"""

from __future__ import annotations

import io
import zipfile
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from typing import Any

from lxml import etree  # type: ignore[import-untyped]

from .meshfault import MeshFileError


def placed_objects(data: bytes) -> int | None:
    """Count the instances of meshes that a .3mf file builds.

    Parameters
    ----------
    data
        The whole file.

    Returns
    -------
    Their number; None where nothing is nested or numbered, which is read right anyway.

    Raises
    ------
    MeshFileError
        If parts in other files of the archive would be taken for each other.
    Exception
        What zipfile and lxml raise on a broken file; RecursionError for components that
        contain themselves.
    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        # The reader takes the first of such a name, too.
        names = [name for name in archive.namelist() if "3d/3dmodel.model" in name.lower()]
        if not names:
            raise ValueError("a ZIP archive without 3D/3dmodel.model")
        model = archive.read(names[0])
        if b"component" not in model and b"partnumber" not in model:
            return None
        _check_elsewhere(archive, model)
    parts = defaultdict(list)  # {object: the objects that it consists of}
    built = []
    owner = ""
    events = etree.iterparse(io.BytesIO(model), events=("start", "end"), resolve_entities=False)
    for event, element in events:
        if event == "end":
            element.clear()
            continue
        tag = element.tag.rpartition("}")[2]
        if tag == "object":
            owner = element.attrib["id"]
        elif tag == "component":
            parts[owner].append(element.attrib["objectid"])
        elif tag == "item":
            built.append(element.attrib["objectid"])

    @cache
    def leaves(name: str) -> int:
        return sum(map(leaves, parts[name])) if name in parts else 1

    return sum(map(leaves, built))


def _check_elsewhere(archive: zipfile.ZipFile, model: bytes) -> None:
    """Refuse parts in other files, unless each has a file and a number to itself."""
    numbers: list[str] = []  # of the model's own objects, and of the parts elsewhere
    files: list[str] = []
    for element in _elements(model, "object", "component"):
        if element.tag.endswith("object"):
            numbers.append(element.attrib["id"])
            continue
        path = next((v.strip("/") for k, v in element.attrib.items() if k.endswith("path")), None)
        if path in archive.namelist():
            numbers.append(element.attrib["objectid"])
            files.append(path)
    if not files:
        return
    meshes = [sum(1 for _ in _elements(archive.read(path), "mesh")) for path in set(files)]
    if len(set(numbers)) < len(numbers) or len(meshes) < len(files) or max(meshes) > 1:
        raise MeshFileError(
            "keeps several parts in one of its inner files, or numbers them alike, which cannot "
            "be told apart: export it as one model, or as .glb"
        )


def _elements(text: bytes, *tags: str) -> Iterator[Any]:
    """Give the XML elements of some tags, and keep none."""
    wanted = [f"{{*}}{tag}" for tag in tags]
    for _, element in etree.iterparse(io.BytesIO(text), tag=wanted, resolve_entities=False):
        yield element
        element.clear()
