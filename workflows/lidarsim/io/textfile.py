"""Text file reading, with error messages that identify common binary formats."""

from __future__ import annotations

from pathlib import Path

from .input_files import open_input, read_input

_START_BYTES = 4096  # bytes to read in order to distinguish text from binary content
# {first bytes of a file that is not UTF-8 text: format and advice}
_KINDS = {
    b"\x89MCAP0\r\n": "an MCAP bag. Its name must end with .mcap",
    b"SQLite format 3": (
        "an SQLite database, like ROS 2 bags. Its name must end with .db3, "
        "or pass the folder of the bag"
    ),
    b"#ROSBAG V": "a ROS 1 bag. Convert it with rosbags-convert --src FILE.bag --dst FOLDER",
    b"TSCANTRJ": "a TerraScan trajectory. Export it as text",
    b"\x1f\x8b": "compressed with gzip. Decompress it",
    b"\x28\xb5\x2f\xfd": "compressed with Zstandard. Decompress it",
    b"PK\x03\x04": "a zip archive. Unpack it, or save a spreadsheet as .csv",
    b"\x89HDF": "an HDF5 file. Export its poses as .csv",
    b"PAR1": "a Parquet file. Export it as .csv",
    b"LASF": "a LAS point cloud",
    b"\xff\xfe": "encoded in UTF-16. Save it as UTF-8",
    b"\xfe\xff": "encoded in UTF-16. Save it as UTF-8",
    b"\x93NUMPY": "a NumPy array. Save it as .csv with a header",
}


def read_text(path: Path) -> str:
    """Read a text file encoded in UTF-8, and convert its line endings to newlines.

    Raises
    ------
    ValueError
        If the file is empty or is not a text file. The message names the format if it is known.
    LidarError
        If the file is larger than the memory.
    OSError
        If the file is not a regular file or cannot be read.
    """
    with open_input(path) as file:
        first = file.read(_START_BYTES)
    kind = next((kind for magic, kind in _KINDS.items() if first.startswith(magic)), None)
    if kind is not None:
        raise ValueError(f"expected a text file, but it is {kind}")
    if b"\0" in first:
        raise ValueError("expected a text file, but it is a binary file in an unknown format")
    try:
        text = read_input(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError("it is not encoded in UTF-8. Save it as UTF-8") from error
    if not text.strip():
        raise ValueError("it is empty")
    return text.replace("\r\n", "\n").replace("\r", "\n")
