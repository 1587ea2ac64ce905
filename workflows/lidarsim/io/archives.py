"""NPZ archives: deterministic writing, lazy access, and reading that validates the contents."""

from __future__ import annotations

import io
import math
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from ..errors import LidarError, explain_os_errors, prefix_errors
from ..numerics.arrays import AnyArray
from .allowance import Allowance
from .checksum import crc32
from .input_files import read_input

# Header of an array of numbers or text in NPY format 1.0. It follows ten bytes, the last two of
# which contain its length.
_HEADER = re.compile(
    rb"\{'descr': '([<>|][a-zUV]\d+)', 'fortran_order': (False|True), "
    rb"'shape': \(((?:\d+, ?)*\d*)\), \} *\n"
)
# Records in a ZIP archive: local file header, central directory entry, ZIP64 extra field, end of
# central directory, ZIP64 end of central directory, and its locator. Source: PKWARE's APPNOTE.TXT,
# sections 4.3.7 to 4.5.3.
_FILE = struct.Struct("<4s5HIIIHH")
_ENTRY = struct.Struct("<4s6HIII5HII")
_SIZES = struct.Struct("<HHQQ")
_END = struct.Struct("<4s4HIIH")
_LARGE_END = struct.Struct("<4sQHHIIQQQQ")
_LARGE_END_PLACE = struct.Struct("<4sIQI")
_MAX_SIZE = (1 << 31) - 1  # larger numbers are stored in 64 bits, as in zipfile
_IN_64_BITS = 0xFFFFFFFF  # placeholder for a number that is stored in 64 bits
_VERSION = 45  # version of the ZIP format that introduced 64-bit numbers
_UNIX = 3 << 8  # the permissions are those of Unix
_PERMISSIONS = 0o600 << 16
_UTF8 = 0x800  # flag for file names in UTF-8
_DATE = 1 << 5 | 1  # always 1980-01-01, so that equal arrays result in equal bytes
_ADVICE = "download or copy it again, or read it on a machine with more memory"


Piece = bytes | memoryview  # a piece of a file that is written in pieces


def pack_arrays(arrays: Mapping[str, Any]) -> bytes:
    """Create a compressed archive of arrays.

    Equal arrays result in equal bytes.
    """
    memory = io.BytesIO()  # NumPy leaves a file open if writing fails
    np.savez_compressed(memory, **arrays)
    return memory.getvalue()


class StoredArray(NamedTuple):
    """Location and type of an array in an uncompressed archive.

    This information is sufficient to read the array in pieces.
    """

    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    offset: int  # position of the first element in the archive, bytes
    head_crc: int  # CRC-32 of the NPY file up to the first element
    crc: int  # CRC-32 of the entire NPY file


class _StoredFile(NamedTuple):
    name: bytes
    flags: int
    crc: int
    size: int  # bytes
    offset: int  # position of the local file header in the archive, bytes

    @property
    def header(self) -> bytes:
        """Local file header, with 64-bit sizes."""
        named = (len(self.name), _SIZES.size)
        numbers = (_VERSION, self.flags, zipfile.ZIP_STORED, 0, _DATE, self.crc)
        fixed = _FILE.pack(b"PK\3\4", *numbers, _IN_64_BITS, _IN_64_BITS, *named)
        return fixed + self.name + _SIZES.pack(1, _SIZES.size - 4, self.size, self.size)

    @property
    def entry(self) -> bytes:
        """Central directory entry, with 64-bit numbers only where they are required."""
        large: list[int] = []
        size = self.size
        offset = self.offset
        if size > _MAX_SIZE:
            large += [size, size]
            size = _IN_64_BITS
        if offset > _MAX_SIZE:
            large.append(offset)
            offset = _IN_64_BITS
        extra = struct.pack(f"<HH{len(large)}Q", 1, 8 * len(large), *large) if large else b""
        versions = (_UNIX | _VERSION, _VERSION)
        numbers = (*versions, self.flags, zipfile.ZIP_STORED, 0, _DATE, self.crc, size, size)
        named = (len(self.name), len(extra), 0)
        return _ENTRY.pack(b"PK\1\2", *numbers, *named, 0, 0, _PERMISSIONS, offset) + (
            self.name + extra
        )


def archive_pieces(arrays: Mapping[str, AnyArray]) -> list[Piece]:
    """Create an uncompressed archive of arrays. Return its pieces in order.

    Contiguous arrays are not copied. Their pieces are views, which must be written before the
    arrays change. Equal arrays result in equal bytes, which are the same as those that zipfile
    would write. zipfile is not used because it would copy each array to an in-memory file, and copy
    it again whenever that file grows.
    """
    pieces: list[Piece] = []
    files: list[_StoredFile] = []
    offset = 0
    for name, array in arrays.items():
        array = np.ascontiguousarray(array)
        content = array.reshape(-1).view(np.uint8).data
        head = _npy_head(array)
        crc = crc32(content, crc32(head))
        flags = 0 if name.isascii() else _UTF8
        size = len(head) + len(content)
        file = _StoredFile(f"{name}.npy".encode(), flags, crc, size, offset)
        header = file.header
        pieces += [header + head, content]
        files.append(file)
        offset += len(header) + size
    directory = b"".join(file.entry for file in files)
    return [*pieces, directory + _directory_end(len(files), len(directory), offset)]


def _npy_head(array: AnyArray) -> bytes:
    """Return the start of an NPY file, up to the first element."""
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, np.lib.format.header_data_from_array_1_0(array))
    return head.getvalue()


def _directory_end(count: int, size: int, offset: int) -> bytes:
    """Return the records that follow a central directory.

    `count` is the number of entries in the directory. `size` and `offset` are in bytes.
    """
    end = b""
    if max(size, offset) > _MAX_SIZE:
        numbers = (_LARGE_END.size - 12, _VERSION, _VERSION, 0, 0, count, count, size, offset)
        end = _LARGE_END.pack(b"PK\6\6", *numbers)
        end += _LARGE_END_PLACE.pack(b"PK\6\7", 0, offset + size, 1)
    shown = (min(size, _IN_64_BITS), min(offset, _IN_64_BITS))
    return end + _END.pack(b"PK\5\6", 0, 0, count, count, *shown, 0)


@contextmanager
def open_archive(
    path: Path | str, read: Callable[[], bytes] | None = None
) -> Iterator[dict[str, Any]]:
    """Read the arrays of an archive without unpickling objects.

    Exceptions raised while the archive is read or in the context are converted to LidarError. If
    `read` is set, it is called to obtain the content of the file, and the path is used only in
    error messages.
    """
    try:
        with explain_os_errors(f"{path} cannot be read"), prefix_errors(path):
            data = read() if read else read_input(path)
            yield read_arrays(data, Allowance(len(data), _ADVICE))
    except LidarError:
        raise
    except Exception as error:  # zipfile, zlib, NumPy and Scene raise many types of exceptions
        reason = " ".join(str(error).split())
        raise LidarError(
            f"{path} is damaged or was written by a different version of lidarpool ({reason}). Run "
            "the survey again."
        ) from error


def read_arrays(data: bytes, allowance: Allowance | None = None) -> dict[str, AnyArray]:
    """Read all arrays in an archive and verify their checksums.

    The size of the arrays counts toward `allowance`. If the archive is damaged, the exception may
    be of any class.

    Raises
    ------
    LidarError
        If the arrays exceed the allowance.
    """
    entries = _entries(io.BytesIO(data))
    if allowance is not None:
        allowance.reserve(sum(entry.file_size for entry in entries))
    files = ((entry.filename, _content(data, entry)) for entry in entries)
    return {name.removesuffix(".npy"): read_npy(content, name) for name, content in files}


def locate_arrays(file: IO[bytes]) -> dict[str, StoredArray]:
    """Locate the arrays in an uncompressed archive without reading their elements.

    If the archive is damaged, the exception may be of any class.

    Returns
    -------
    dict
        Mapping from array names to locations.
    """
    return {
        entry.filename.removesuffix(".npy"): _stored_array(file, entry) for entry in _entries(file)
    }


def _entries(file: IO[bytes]) -> list[zipfile.ZipInfo]:
    """Return the files in an archive. Raise ValueError if the central directory is damaged."""
    with zipfile.ZipFile(file) as archive:
        entries = archive.infolist()
    # A damaged entry in the central directory may hide later entries.
    file.seek(-12, os.SEEK_END)
    if len(entries) != int.from_bytes(file.read(2), "little"):
        raise ValueError(f"{len(entries)} arrays")
    return entries


def _stored_array(file: IO[bytes], entry: zipfile.ZipInfo) -> StoredArray:
    """Locate the array that a file in an archive contains.

    Raise ValueError if the file is damaged or compressed.
    """
    name = entry.orig_filename.encode()
    file.seek(entry.header_offset)
    header = file.read(_FILE.size + len(name))
    file.seek(int.from_bytes(header[28:30], "little"), os.SEEK_CUR)
    head = file.read(10)
    head += file.read(int.from_bytes(head[8:10], "little"))
    array = _array_type(head, entry.filename)
    size = len(head) + math.prod(array.shape) * array.dtype.itemsize
    is_stored = entry.compress_type == zipfile.ZIP_STORED and not array.is_fortran
    if not is_stored or header[_FILE.size :] != name or entry.file_size != size:
        raise ValueError(f"{entry.filename} is damaged")
    return StoredArray(array.dtype, array.shape, file.tell(), crc32(head), entry.CRC)


def _content(data: bytes, entry: zipfile.ZipInfo) -> bytes | memoryview:
    """Return the content of a file in an archive. Raise ValueError if the file is damaged.

    zipfile is not used because it takes far longer to find a file than to decompress it.
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
        raise ValueError(f"{entry.filename} uses a compression method other than Deflate")
    same_name = data[name_start : name_start + length] == entry.orig_filename.encode()
    if not same_name or len(content) != entry.file_size or crc32(content) != entry.CRC:
        raise ValueError(f"{entry.filename} is damaged")
    return content


def read_npy(content: bytes | memoryview, name: str) -> AnyArray:
    """Read an array of numbers or text from the content of an NPY file.

    This function is safe to call from several threads. `numpy.load` parses headers with `ast`,
    which occasionally fails in threads in Python 3.11 with the error "AST constructor recursion
    depth mismatch".

    Raises
    ------
    ValueError
        If the file is damaged.
    """
    kind, shape, is_fortran, start = _array_type(content, name)
    data = bytearray(memoryview(content)[start:])
    if len(data) != math.prod(shape) * kind.itemsize:
        raise ValueError(f"the size of {name} does not match its header")
    array = np.frombuffer(data, kind)
    return array.reshape(shape[::-1]).T if is_fortran else array.reshape(shape)


class _ArrayType(NamedTuple):
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    is_fortran: bool
    start: int  # position of the first element in the file, bytes


def _array_type(content: bytes | memoryview, name: str) -> _ArrayType:
    """Parse the header of an NPY file. Raise ValueError if it is damaged."""
    start = 10 + int.from_bytes(content[8:10], "little")
    if (header := _HEADER.fullmatch(content, 10, start)) is None:
        raise ValueError(f"{name} is not an array of numbers or text")
    shape = tuple(int(count) for count in header[3].split(b",") if count.strip())
    return _ArrayType(np.dtype(header[1].decode()), shape, header[2] == b"True", start)
