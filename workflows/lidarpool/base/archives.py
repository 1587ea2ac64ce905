"""Archives of arrays: what this package writes, and reads again."""

from __future__ import annotations

import io
import math
import re
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

from .allowance import Allowance
from .arrays import AnyArray
from .errors import LidarpoolError, explained, prefixed

# Head of an array of numbers in format 1.0 of NumPy, after ten bytes with its length at their end.
_HEADER = re.compile(
    rb"\{'descr': '([<>|][a-zV]\d+)', 'fortran_order': (False|True), "
    rb"'shape': \(((?:\d+, ?)*\d*)\), \} *\n"
)
_LIMITED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # others unpack more than they are asked for
_AGAIN = "get it again, or read it on a machine with more memory"


def packed(arrays: Mapping[str, Any]) -> bytes:
    """Return an archive of arrays: the same arrays give the same bytes."""
    memory = io.BytesIO()  # NumPy leaves its own file open if it cannot write it
    np.savez_compressed(memory, **arrays)
    return memory.getvalue()


@contextmanager
def open_archive(
    path: Path | str, read: Callable[[], bytes] | None = None
) -> Iterator[dict[str, Any]]:
    """Read an archive for the body, whose errors become LidarpoolError; nothing in it is run.

    With `read`, which returns the content of the file, the path is only its name in errors.
    """
    try:
        with explained(f"{path} cannot be read"), prefixed(path):
            data = read() if read else Path(path).read_bytes()
            yield read_arrays(data, Allowance(len(data), _AGAIN))
    except LidarpoolError:
        raise
    except Exception as error:  # zipfile, zlib, NumPy and Scene have many
        reason = " ".join(str(error).split())
        raise LidarpoolError(
            f"{path} is damaged or not of this version of lidarpool ({reason}): run the survey "
            "again."
        ) from error


def read_arrays(data: bytes, allowance: Allowance | None = None) -> dict[str, AnyArray]:
    """Read all arrays of an archive, and compare their checksums.

    They are taken from `allowance`. LidarpoolError if they are more; any exception if the archive
    is damaged.
    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        names = archive.namelist()
        # A damaged entry of the file list may hide later ones.
        if len(names) != int.from_bytes(data[-12:-10], "little"):
            raise ValueError(f"{len(names)} arrays")
        return {name.removesuffix(".npy"): read_array(archive, name, allowance) for name in names}


def read_array(archive: zipfile.ZipFile, name: str, allowance: Allowance | None = None) -> AnyArray:
    """Read an array to its end, where its checksum is compared; errors as of `read_arrays`.

    Archives are read by several threads. NumPy's reader parses headers with `ast`, which failed now
    and then in threads of Python 3.11: "AST constructor recursion depth mismatch".
    """
    if archive.getinfo(name).compress_type not in _LIMITED:
        raise ValueError(f"{name} is compressed by a method other than Deflate")
    with archive.open(name) as file:
        return read_npy(file, name, allowance)


def read_npy(file: IO[bytes], name: str, allowance: Allowance | None = None) -> AnyArray:
    """Read an array of numbers from a file of NumPy that has no more; as `read_array`."""
    length = int.from_bytes(file.read(10)[8:], "little")
    if (header := _HEADER.fullmatch(file.read(length))) is None:
        raise ValueError(f"{name} is not an array of numbers")
    kind = np.dtype(header[1].decode())
    shape = tuple(map(int, re.findall(rb"\d+", header[3])))
    size = math.prod(shape) * kind.itemsize
    if allowance is not None:
        allowance.take(size)
    data = bytearray(file.read(size))
    if file.read(1):
        raise ValueError(f"{name} is longer than its array")
    array = np.frombuffer(data, kind)
    return array.reshape(shape[::-1]).T if header[2] == b"True" else array.reshape(shape)
