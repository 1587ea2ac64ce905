"""Extensions of pye57 that write coordinate systems, times, normals and reproducible GUIDs."""

from __future__ import annotations

import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pye57
from pye57 import libe57

from lidarsim.columns.table import NORMAL
from lidarsim.sweeps.sweeps import Sweeps

from .gps_time import gps_start_s

NORMAL_FIELDS = {f"nor:normal{name[-1].upper()}": name for name in NORMAL}  # {field: column}


class E57Writer(pye57.E57):
    """A new E57 file with a coordinate system and a creation time.

    pye57 leaves both empty.
    """

    def __init__(self, path: Path, system: str, sweeps: Sweeps) -> None:
        self._system = system
        self._sweeps = sweeps
        self._in_header = False
        super().__init__(str(path), mode="w")

    def write_default_header(self) -> None:
        """Write the header with the coordinate system and the creation time."""
        self._in_header = True
        super().write_default_header()
        self._in_header = False

    @property
    def root(self) -> Any:
        """Root node of the file.

        While the header is written, this is a stand-in that intercepts the fields.
        """
        return SimpleNamespace(set=self._set_field) if self._in_header else super().root

    def _set_field(self, name: str, node: Any) -> None:
        if name == "coordinateMetadata":  # replaced here, because a field can only be set once
            node = libe57.StringNode(self.image_file, self._system)
        if name == "creationDateTime":
            has_start = self._sweeps.start_ns is not None
            time = libe57.FloatNode(self.image_file, gps_start_s(self._sweeps))
            node = libe57.StructureNode(self.image_file)
            node.set("dateTimeValue", time)
            node.set("isAtomicClockReferenced", libe57.IntegerNode(self.image_file, has_start))
        super().root.set(name, node)


class E57WriterWithNormals(E57Writer):
    """A new E57 file whose scans have normals.

    pye57 does not support normals.
    """

    def make_buffers(self, field_names: Sequence[str], *arguments: Any, **options: Any) -> Any:
        """Return the buffers of pye57, with normals added."""
        return super().make_buffers([*field_names, *NORMAL_FIELDS], *arguments, **options)


@contextmanager
def normal_fields() -> Iterator[None]:
    """Patch pye57 so that it writes normals."""
    supported = pye57.e57.SUPPORTED_POINT_FIELDS
    library = pye57.e57.libe57

    def vector_node(image_file: Any, prototype: Any, codecs: Any) -> Any:
        for field in NORMAL_FIELDS:
            node = libe57.FloatNode(image_file, 0.0, libe57.E57_SINGLE, -1.0, 1.0)
            prototype.set(field, node)
        return libe57.CompressedVectorNode(image_file, prototype, codecs)

    pye57.e57.SUPPORTED_POINT_FIELDS = supported | dict.fromkeys(NORMAL_FIELDS, "f")
    pye57.e57.libe57 = SimpleNamespace(**vars(libe57) | {"CompressedVectorNode": vector_node})
    try:
        yield
    finally:
        pye57.e57.SUPPORTED_POINT_FIELDS = supported
        pye57.e57.libe57 = library


@contextmanager
def content_guids(content: str) -> Iterator[None]:
    """Patch pye57 to derive GUIDs from a text instead of generating random GUIDs."""
    numbers = count()
    uuid_module = pye57.e57.uuid
    pye57.e57.uuid = SimpleNamespace(
        uuid4=lambda: uuid.uuid5(uuid.NAMESPACE_OID, f"{content} {next(numbers)}")
    )
    try:
        yield
    finally:
        pye57.e57.uuid = uuid_module
