"""How many objects a .3mf file places, which trimesh does not always find all.

It follows nested components only so far (100 instances by two levels of ten come as 75), and
takes two items of one object and part number for the same.
"""

from __future__ import annotations

import io
import zipfile
from collections import defaultdict
from functools import cache

from lxml import etree  # type: ignore[import-untyped]


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
