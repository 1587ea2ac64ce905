"""Fields of a scenario that name files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from lidarsim.base.section_fields import FieldPath, dotted, fields_of, is_section

_FIELDS = {"file", "calibration", "model", "times"}


def field_that_names(section: Any, is_file: Callable[[str], bool]) -> str:
    """Return the path of the first field whose text is the name of a file, or an empty string.

    Parameters
    ----------
    section
        The section in which fields are searched, also in sections within it.
    is_file
        Returns True for a text that names the file.

    Returns
    -------
    Such as ``scene.files[0].file``.
    """
    for path, text in _texts(section):
        if path[-1] in _FIELDS and is_file(text):
            return dotted(path)
    return ""


def _texts(node: Any, path: FieldPath = ()) -> Iterator[tuple[FieldPath, str]]:
    """Yield the texts in a section, a list or a mapping, each with its path."""
    entries: Any = ()
    if isinstance(node, str):
        yield path, node
    elif is_section(type(node)):
        fields = fields_of(type(node)).items()
        entries = ((field.alias or name, getattr(node, name, None)) for name, field in fields)
    elif isinstance(node, Mapping):
        entries = node.items()
    elif isinstance(node, (tuple, list)):
        entries = enumerate(node)
    for key, value in entries:
        yield from _texts(value, (*path, key))
