"""Headers of Point Cloud Data (.pcd): checked before a library takes memory by their counts."""

from __future__ import annotations

import struct
from pathlib import Path

from ...base.allowance import Allowance
from ...base.input_files import check_input, read_input

_HEADER_MAX_BYTES = 1 << 20
_MAX_NUMBERS = 10_000  # of a point; descriptors of PCL have up to 1,980
_SMALLER = "write it uncompressed"


def checked_pcd(path: Path) -> dict[str, list[str]]:
    """Read the header of a .pcd file, and compare its counts with the size of the file.

    Returns
    -------
    The words of each line of the header, by their keyword; DATA among them.

    Raises
    ------
    ValueError
        If the header is incomplete, or announces more numbers than the file can hold.
    LidarError
        If the points would take far more memory than the file has bytes.
    OSError
        If the file cannot be read.
    """
    size = check_input(path)
    start = read_input(path, _HEADER_MAX_BYTES)
    head, mark, data = start.partition(b"\nDATA ")
    encoding, _, body = data.partition(b"\n")
    if not mark:
        raise ValueError("it has no line DATA, with which the header of a .pcd ends")
    lines = map(str.split, head.decode("latin-1").splitlines())
    header = {words[0]: words[1:] for words in lines if words}
    header["DATA"] = encoding.decode("latin-1").split()
    if missing := [name for name in ("FIELDS", "SIZE", "TYPE", "POINTS") if not header.get(name)]:
        raise ValueError(f"its header has no {missing[0]}")
    _check_body(header, size, size - (len(start) - len(body)), body[:8])
    return header


def _check_body(header: dict[str, list[str]], file_size: int, body_size: int, head: bytes) -> None:
    """Check that the points that a header announces fit the body, which starts with `head`."""
    count = int(header["POINTS"][0])
    numbers, row_size = _row_layout(header, count)
    min_sizes = {
        "ascii": count * (2 * numbers),  # a digit, and a space or the end of the line
        "binary": count * row_size,
    }
    kind = header["DATA"][0] if header["DATA"] else ""
    if kind == "binary_compressed":
        packed, unpacked = struct.unpack("<II", head) if len(head) >= 8 else (0, 0)
        if 8 + packed > body_size or unpacked != count * row_size:
            raise ValueError(f"{count:,} points announced, but there are fewer")
        Allowance(file_size, _SMALLER).take(unpacked)
    elif kind not in min_sizes:
        raise ValueError(f"its DATA is {kind[:20]!r}, not ascii, binary or binary_compressed")
    elif min_sizes[kind] > body_size + 1:  # the last line may have no end
        raise ValueError(f"{count:,} points announced, but there are fewer")


def _row_layout(header: dict[str, list[str]], count: int) -> tuple[int, int]:
    """Return the numbers of a point, and their bytes; ValueError if the header is broken."""
    sizes = list(map(int, header["SIZE"]))
    repeats = list(map(int, header.get("COUNT", ["1"] * len(sizes))))
    if not len(header["FIELDS"]) == len(sizes) == len(header["TYPE"]) == len(repeats):
        raise ValueError("the lines FIELDS, SIZE, TYPE and COUNT of its header differ in length")
    if count < 0 or not set(sizes) <= {1, 2, 4, 8} or min(repeats) < 1:
        raise ValueError("its header has sizes or counts that no point can have")
    if (numbers := sum(repeats)) > _MAX_NUMBERS:
        raise ValueError(
            f"{numbers:,} numbers for each point announced, of at most {_MAX_NUMBERS:,}"
        )
    return numbers, sum(n * repeat for n, repeat in zip(sizes, repeats, strict=True))
