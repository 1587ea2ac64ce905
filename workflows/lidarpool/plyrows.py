"""Rows of the elements of a .ply file, whose properties are numbers and lists of numbers."""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


@dataclass
class Element:
    """An element of a header.

    Parameters
    ----------
    name, count
        What it is called, and how many rows there are.
    properties
        Name, type of the length ('' for a single number) and type of the numbers of each.
    """

    name: str
    count: int
    properties: list[tuple[str, str, str]] = field(default_factory=list)

    @classmethod
    def named(cls, name: bytes, count: bytes) -> Element:
        """Take an element from its line; ValueError for a count that is none."""
        number = int(count)
        if number < 0:
            raise ValueError(f"{number} rows of {name[:20].decode(errors='replace')} announced")
        return cls(name.decode("ascii", errors="replace"), number)

    def add(self, words: Sequence[bytes]) -> None:
        """Add a property from its line; ValueError for an unknown type."""
        *kinds, name = (word.decode("ascii", errors="replace") for word in words)
        types = [_TYPES.get(kind, "") for kind in kinds[-2:]]
        listed = len(kinds) == 3 and kinds[0] == "list"
        if not all(types) or not (listed or len(kinds) == 1) or (listed and types[0][0] == "f"):
            raise ValueError(f"a property of type {' '.join(kinds)[:40] or 'none'}")
        self.properties.append((name, types[0] if listed else "", types[-1]))


@dataclass(frozen=True)
class Rows:
    """All rows of an element.

    Parameters
    ----------
    single
        {property: (rows,)} of single numbers.
    lists
        {property: (numbers of all rows one after the other, how many each row has)}.
    """

    single: Mapping[str, NDArray[Any]]
    lists: Mapping[str, tuple[NDArray[Any], NDArray[np.int64]]]


def text_rows(body: bytes, elements: Sequence[Element]) -> Iterator[Rows]:
    """Yield the rows of each element of a text file; ValueError where it holds other than that."""
    # Through ASCII, since NumPy takes whatever follows the last number that it understands.
    numbers = np.fromstring(body.decode("ascii"), dtype=np.float64, sep=" ")
    at = 0
    for element in elements:
        places, lengths = _text_layout(numbers, at, element)
        at = int(places[-1, -1] + lengths[-1, -1]) if len(places) else at
        if at > len(numbers):
            raise ValueError(_cut(element, len(numbers)))
        yield _gathered(numbers, element, places, lengths)
    if at < len(numbers):
        raise ValueError(f"{len(numbers) - at:,} more numbers than announced")


def _text_layout(
    numbers: NDArray[np.float64], at: int, element: Element
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Place and length of each property (rows, properties) from the number `at` on."""
    lists = [bool(kind) for _, kind, _ in element.properties]
    if not lists or not element.count:
        return np.empty((0, 0), dtype=np.int64), np.empty((0, 0), dtype=np.int64)
    if element.count > len(numbers) - at:
        raise ValueError(_cut(element, len(numbers)))
    row = _text_row(numbers, at, lists)
    width = row[-1][0] + row[-1][1] - at
    begins = at + width * np.arange(element.count, dtype=np.int64)
    shape = (element.count, 1)
    if begins[-1] + width <= len(numbers):
        # Rows are mostly alike: if all lists are as long as those of the first, this is it.
        alike = [
            (numbers[begins + place - 1 - at] == length).all()
            for (place, length), listed in zip(row, lists, strict=True)
            if listed
        ]
        if all(alike):
            places = begins[:, None] + np.array([place - at for place, _ in row])
            return places, np.tile(np.array([length for _, length in row]), shape)
    rows = []
    for _ in range(element.count):
        rows.append(_text_row(numbers, at, lists))
        at = rows[-1][-1][0] + rows[-1][-1][1]
    found = np.array(rows, dtype=np.int64)
    return found[..., 0], found[..., 1]


def _text_row(
    numbers: NDArray[np.float64], at: int, lists: Sequence[bool]
) -> list[tuple[int, int]]:
    """Place and length of each property of the row that begins at the number `at`."""
    row = []
    for listed in lists:
        length = 1
        if listed:
            if at >= len(numbers):
                raise ValueError("its last row is cut short")
            length = int(numbers[at])
            at += 1
        if length < 0:
            raise ValueError(f"a list of {length} numbers")
        row.append((at, length))
        at += length
    return row


def binary_rows(body: bytes, elements: Sequence[Element], order: str) -> Iterator[Rows]:
    """Yield the rows of each element of a binary file, `order` being '<' or '>'.

    Raises
    ------
    ValueError
        If it holds other than announced.
    """
    at = 0
    for element in elements:
        if not element.count or not element.properties:
            yield _columns(element, np.empty(0, _row_type(element, {}, order)), {})
            continue
        lengths = _first_lengths(body, at, element, order)
        dtype = _row_type(element, lengths, order)
        if element.count * dtype.itemsize <= len(body) - at:
            rows = np.frombuffer(body, dtype, element.count, at)
            if all((rows[f"{i} length"] == n).all() for i, n in lengths.items()):
                at += element.count * dtype.itemsize
                yield _columns(element, rows, lengths)
                continue
        elif not lengths:
            raise ValueError(_cut(element, len(body)))
        walked = _walked(body, at, element, order)
        yield _bytes_gathered(body, element, walked, order)
        last, length = walked[-1, -1].tolist()
        at = last + length * np.dtype(element.properties[-1][2]).itemsize
    if rest := body[at:].strip(b"\0\r\n\t "):
        raise ValueError(f"{len(rest):,} bytes more than announced")


def _first_lengths(body: bytes, at: int, element: Element, order: str) -> dict[int, int]:
    """Lengths of the lists of the first row: {number of the property: length}."""
    if not element.count or not any(kind for _, kind, _ in element.properties):
        return {}
    only = Element(element.name, 1, element.properties)
    row = _walked(body, at, only, order)[0]
    return {i: int(row[i, 1]) for i, (_, kind, _) in enumerate(element.properties) if kind}


def _row_type(element: Element, lengths: dict[int, int], order: str) -> np.dtype[np.void]:
    """Row whose lists have these lengths."""
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    for i, (_, kind, numbers) in enumerate(element.properties):
        if kind:
            fields.append((f"{i} length", order + kind))
            fields.append((str(i), order + numbers, (lengths.get(i, 0),)))
        else:
            fields.append((str(i), order + numbers))
    return np.dtype(fields)


def _columns(element: Element, rows: NDArray[np.void], lengths: dict[int, int]) -> Rows:
    """Rows that are all alike, by property."""
    single, lists = {}, {}
    for i, (name, kind, _) in enumerate(element.properties):
        if kind:
            sizes = np.full(len(rows), lengths.get(i, 0), dtype=np.int64)
            lists[name] = (rows[str(i)].reshape(-1), sizes)
        else:
            single[name] = rows[str(i)]
    return Rows(single, lists)


def _walked(body: bytes, at: int, element: Element, order: str) -> NDArray[np.int64]:
    """Byte and length of each property, row by row: (rows, properties, 2)."""
    steps = [
        (np.dtype(kind).itemsize if kind else 0, kind[:1] == "i", np.dtype(numbers).itemsize)
        for _, kind, numbers in element.properties
    ]
    least = sum(head or size for head, _, size in steps)
    if element.count * least > len(body) - at:
        raise ValueError(_cut(element, len(body)))
    endian = "little" if order == "<" else "big"
    rows = array("q")
    for _ in range(element.count):
        for head, signed, size in steps:
            length = 1
            if head:
                length = int.from_bytes(body[at : at + head], endian, signed=signed)  # type: ignore[arg-type]
                at += head
                if length < 0:
                    raise ValueError(f"a list of {length} numbers")
            rows.extend((at, length))
            at += length * size
        if at > len(body):
            raise ValueError(_cut(element, len(body)))
    return np.frombuffer(rows, dtype=np.int64).reshape(element.count, len(steps), 2)


def _bytes_gathered(body: bytes, element: Element, walked: NDArray[np.int64], order: str) -> Rows:
    """Rows that differ, by property, from where each of them is."""
    raw = np.frombuffer(body, dtype=np.uint8)
    single, lists = {}, {}
    for i, (name, kind, numbers) in enumerate(element.properties):
        dtype = np.dtype(order + numbers)
        lengths = walked[:, i, 1]
        picked = raw[_spans(walked[:, i, 0], lengths * dtype.itemsize)].view(dtype)
        if kind:
            lists[name] = (picked, lengths)
        else:
            single[name] = picked
    return Rows(single, lists)


def _gathered(
    numbers: NDArray[np.float64],
    element: Element,
    places: NDArray[np.int64],
    lengths: NDArray[np.int64],
) -> Rows:
    """Rows of a text file by property."""
    single, lists = {}, {}
    none = np.empty(0, dtype=np.int64)
    for i, (name, kind, _) in enumerate(element.properties):
        begin, length = (places[:, i], lengths[:, i]) if len(places) else (none, none)
        if kind:
            lists[name] = (numbers[_spans(begin, length)], length)
        else:
            single[name] = numbers[begin]
    return Rows(single, lists)


def _spans(begins: NDArray[np.int64], lengths: NDArray[np.int64]) -> NDArray[np.int64]:
    """Numbers from each begin on, as many as its length, one after the other."""
    before = np.cumsum(lengths) - lengths
    return np.repeat(begins - before, lengths) + np.arange(int(lengths.sum()), dtype=np.int64)


def _cut(element: Element, there: int) -> str:
    return f"{element.count:,} rows of {element.name[:20]} announced, and less there"
