"""Rows of the elements of a .ply file, by plyfile.

plyfile believes what a header says: it makes room for the rows that are announced, reads a
list of negative length to the end of the file, and does not ask what follows the last row. It
also takes nothing but ASCII in comments. Hence a header is made plain here, and what it
announces compared with what there is, before plyfile sees the file.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import sys
import tempfile
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement, PlyElementParseError, PlyListProperty

from .meshfault import MeshFileError

_HEADER_LIMIT = 1 << 20  # bytes
_ELEMENT = re.compile(rb"^element (\S+) (\S+)$", re.MULTILINE)
_NUMBERS = re.compile(rb"^property (list \S+ )?\S+ (\S+)$", re.MULTILINE)


def announced_rows(data: bytes) -> dict[str, int]:
    """Look up in the header of a file how many rows each element has; ValueError without one."""
    header, _ = _divided(data)
    return {name.decode(): int(count) for name, count in _ELEMENT.findall(header)}


def read_rows(data: bytes) -> PlyData:
    """Read all rows of all elements.

    Parameters
    ----------
    data
        The whole file: text, or binary of either order.

    Raises
    ------
    ValueError, PlyParseError
        If it is no PLY file, or holds more or less than announced.
    MeshFileError
        If there is no room for a temporary file.
    """
    header, body = _divided(data)
    # As if there were no rows: what elements and properties there are.
    empty = PlyData.read(io.BytesIO(_ELEMENT.sub(rb"element \1 0", header)))
    counts = [int(count) for _, count in _ELEMENT.findall(header)]
    _check_room(empty, counts, len(body))
    if empty.text:
        return _text_rows(header, body, sum(counts))
    return _binary_rows(header, body, _first_lengths(body, empty, counts))


def numbers_of(element: PlyElement, name: str) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Numbers of a list property of all rows one after the other, and how many each row has."""
    column = element[name]
    if column.dtype != object:  # lists of one length
        count, length = column.shape
        return column.reshape(-1), np.full(count, length, dtype=np.int64)
    sizes = np.fromiter(map(len, column), dtype=np.int64, count=len(column))
    return np.concatenate(column) if len(column) else np.empty(0, dtype=np.int64), sizes


def _divided(data: bytes) -> tuple[bytes, bytes]:
    """Header with one way to end a line and without comments, and what follows it."""
    head = data[:_HEADER_LIMIT]
    found = re.match(rb"ply[ \t]*\r?\n(.*?\n)??end_header[ \t]*\r?\n", head, re.DOTALL)
    found = found or re.match(rb"ply\r(.*?\r)??end_header\r", head, re.DOTALL)
    if not found:
        raise ValueError("no PLY header, or cut within it")
    lines = [b"ply"]
    for line in (found[1] or b"").splitlines():
        words = line.decode("ascii", errors="backslashreplace").split()
        # An empty comment in its place keeps the numbers of lines in errors right.
        said = words and words[0] not in ("comment", "obj_info")
        lines.append(" ".join(words).encode() if said else b"comment")
    return b"\n".join([*lines, b"end_header\n"]), data[found.end() :]


def _check_room(empty: PlyData, counts: list[int], there: int) -> None:
    """Compare what is announced with the bytes that are there."""
    for element, count in zip(empty.elements, counts, strict=True):
        least = sum(_least(prop, empty.text) for prop in element.properties)
        if count < 0 or (count and not least):
            raise ValueError(f"{count} rows of {element.name[:20]} announced, without content")
        there -= count * least
        if there < -1:  # text may end without the end of a line
            raise ValueError(f"{count:,} rows of {element.name[:20]} announced, and less there")


def _least(prop: Any, text: bool) -> int:
    """Bytes that a property takes in a row at least: of a list its length alone."""
    if text:
        return 2  # a digit, and what divides it from others
    return np.dtype(
        prop.len_dtype if isinstance(prop, PlyListProperty) else prop.val_dtype
    ).itemsize


def _text_rows(header: bytes, body: bytes, count: int) -> PlyData:
    """Rows of a text file, of which each has a line."""
    lines = [line for line in body.decode("ascii").splitlines() if line.strip()]
    if len(lines) != count:
        raise ValueError(f"{count:,} rows announced, {len(lines):,} lines there")
    # What is called single precision may have more digits, on maps above all, and what is called
    # a byte a fraction; in text that does no harm.
    header = _NUMBERS.sub(rb"property \1double \2", header)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "loadtxt: input contained no data")  # an empty list
        return PlyData.read(io.StringIO(header.decode("ascii") + "\n".join(lines)))


def _binary_rows(header: bytes, body: bytes, lengths: dict[str, dict[str, int]]) -> PlyData:
    """Rows of a binary file, whose lists mostly have these `lengths` in all rows."""
    with _unnamed_file() as file:
        file.write(header)
        file.write(body)
        content = _Content(file)
        try:
            content.seek(0)
            data = PlyData.read(content, known_list_len=lengths)
        except PlyElementParseError:
            if not lengths:
                raise
            content.seek(0)
            data = PlyData.read(content)  # row by row
        if rest := file.read().strip(b"\0\r\n\t "):
            raise ValueError(f"{len(rest):,} bytes more than announced")
    return data


def _first_lengths(body: bytes, empty: PlyData, counts: list[int]) -> dict[str, dict[str, int]]:
    """Lengths of the lists of the first row with lists: {element: {property: length}}.

    Mostly all rows have these, and plyfile takes as many at once if it is told so.
    """
    order, at = empty.byte_order, 0
    for element, count in zip(empty.elements, counts, strict=True):
        lists = [prop for prop in element.properties if isinstance(prop, PlyListProperty)]
        if not lists or not count:
            at += count * element.dtype(order).itemsize * (not lists)
            continue
        lengths: dict[str, int] = {}
        for prop in element.properties:
            if prop in lists:
                kind, each = map(np.dtype, prop.list_dtype(order))
                lengths[prop.name] = int(np.frombuffer(body, kind, 1, at)[0])
                at += kind.itemsize + lengths[prop.name] * each.itemsize
                if not at <= len(body) or lengths[prop.name] < 0:
                    return {}  # for the reader of single rows to say what is wrong
            else:
                at += np.dtype(prop.dtype(order)).itemsize
        return {element.name: lengths}
    return {}


@contextlib.contextmanager
def _unnamed_file() -> Iterator[Any]:
    """File to write and read, since plyfile takes rows at once from real files only.

    The file that is read may change meanwhile, and a mapped one that is cut short ends the
    process. Hence a copy: in memory where the system has such files, else in a temporary one.
    """
    try:
        with _memory_file() if sys.platform == "linux" else tempfile.TemporaryFile() as file:
            yield file
    except OSError as error:
        raise MeshFileError(f"cannot be copied to be read: {error.strerror or error}") from error


def _memory_file() -> Any:
    return os.fdopen(os.memfd_create("ply"), "w+b")


class _Content:
    """What plyfile needs of a file, of which a negative number of bytes is not all the rest."""

    def __init__(self, file: Any) -> None:
        self._file = file
        self.seek = file.seek
        self.tell = file.tell
        self.fileno = file.fileno

    def read(self, size: int) -> bytes:
        """So many bytes, or what there is; ValueError for a negative number."""
        if size < 0:
            raise ValueError(f"a list of negative length, {size} bytes")
        found: bytes = self._file.read(size)
        return found
