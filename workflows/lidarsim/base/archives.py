"""Archives of arrays, as this package writes and reads them."""

from __future__ import annotations

import io
import math
import re
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from .allowance import Allowance
from .arrays import AnyArray
from .errors import LidarError, explained, prefixed
from .input_files import read_input

# Head of an array of numbers or text in format 1.0 of NumPy, after ten bytes that end with its
# length.
_HEADER = re.compile(
    rb"\{'descr': '([<>|][a-zUV]\d+)', 'fortran_order': (False|True), "
    rb"'shape': \(((?:\d+, ?)*\d*)\), \} *\n"
)
_ADVICE = "get it again, or read it on a machine with more memory"


def packed(arrays: Mapping[str, Any]) -> bytes:
    """Return an archive of arrays: the same arrays give the same bytes."""
    memory = io.BytesIO()  # NumPy leaves a file open if writing fails
    np.savez_compressed(memory, **arrays)
    return memory.getvalue()


@contextmanager
def open_archive(
    path: Path | str, read: Callable[[], bytes] | None = None
) -> Iterator[dict[str, Any]]:
    """Read an archive, without running code, for the body, whose errors become LidarError.

    With `read`, which returns the content of the file, the path is only a name in errors.
    """
    try:
        with explained(f"{path} cannot be read"), prefixed(path):
            data = read() if read else read_input(path)
            yield read_arrays(data, Allowance(len(data), _ADVICE))
    except LidarError:
        raise
    except Exception as error:  # zipfile, zlib, NumPy and Scene have many
        reason = " ".join(str(error).split())
        raise LidarError(
            f"{path} is damaged or not of this version of lidarpool ({reason}): run the survey "
            "again."
        ) from error


def read_arrays(data: bytes, allowance: Allowance | None = None) -> dict[str, AnyArray]:
    """Read all arrays of an archive, and compare their checksums.

    The bytes of the arrays are taken from `allowance`. LidarError if they exceed the allowance; any
    exception if the archive is damaged.
    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = archive.infolist()
    # A damaged entry of the file list may hide later ones.
    if len(entries) != int.from_bytes(data[-12:-10], "little"):
        raise ValueError(f"{len(entries)} arrays")
    if allowance is not None:
        allowance.take(sum(entry.file_size for entry in entries))
    files = ((entry.filename, _content(data, entry)) for entry in entries)
    return {name.removesuffix(".npy"): read_npy(content, name) for name, content in files}


def _content(data: bytes, entry: zipfile.ZipInfo) -> bytes | memoryview:
    """Return the content of a file in an archive.

    Raises ValueError for a damaged file.

    zipfile takes far longer to find the file than to unpack it.
    """
    name_start = entry.header_offset + 30
    length, extra = (
        int.from_bytes(data[name_start - k : name_start - k + 2], "little") for k in (4, 2)
    )
    content: bytes | memoryview = memoryview(data)[name_start + length + extra :][
        : entry.compress_size
    ]
    if entry.compress_type == zipfile.ZIP_DEFLATED:
        content = zlib.decompressobj(-zlib.MAX_WBITS).decompress(content, entry.file_size + 1)
    elif entry.compress_type != zipfile.ZIP_STORED:
        raise ValueError(f"{entry.filename} is compressed by a method other than Deflate")
    same_name = data[name_start : name_start + length] == entry.orig_filename.encode()
    if not same_name or len(content) != entry.file_size or zlib.crc32(content) != entry.CRC:
        raise ValueError(f"{entry.filename} is damaged")
    return content


def read_npy(content: bytes | memoryview, name: str) -> AnyArray:
    """Read an array of numbers or text from a file of NumPy.

    Raises ValueError for a damaged file.

    Archives are read by several threads. NumPy's reader parses headers with `ast`, which failed now
    and then in threads of Python 3.11: "AST constructor recursion depth mismatch".
    """
    start = 10 + int.from_bytes(content[8:10], "little")
    if (header := _HEADER.fullmatch(content, 10, start)) is None:
        raise ValueError(f"{name} is not an array of numbers or text")
    kind = np.dtype(header[1].decode())
    shape = tuple(int(count) for count in header[3].split(b",") if count.strip())
    data = bytearray(memoryview(content)[start:])
    if len(data) != math.prod(shape) * kind.itemsize:
        raise ValueError(f"{name} is longer or shorter than its array")
    array = np.frombuffer(data, kind)
    return array.reshape(shape[::-1]).T if header[2] == b"True" else array.reshape(shape)
