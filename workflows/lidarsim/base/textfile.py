"""Text files, and names of the formats of files that hold no text."""

from __future__ import annotations

from pathlib import Path

from .input_files import open_input, read_input

_START_BYTES = 4096  # bytes that tell text from other content
# {first bytes of a file that is not a text: format and advice}
_KINDS = {
    b"\x89MCAP0\r\n": "a bag (MCAP): give it the ending .mcap",
    b"SQLite format 3": "a database (SQLite), as bags of ROS 2 are: give it the ending .db3, or "
    "give the folder of the bag",
    b"#ROSBAG V": "a bag of ROS 1: convert it, rosbags-convert --src FILE.bag --dst FOLDER",
    b"TSCANTRJ": "a trajectory of TerraScan: export it as text",
    b"\x1f\x8b": "compressed by gzip: unpack it",
    b"\x28\xb5\x2f\xfd": "compressed by Zstandard: unpack it",
    b"PK\x03\x04": "a zip archive: unpack it, or save a spreadsheet as .csv",
    b"\x89HDF": "of HDF5: export its poses as .csv",
    b"PAR1": "of Parquet: export it as .csv",
    b"LASF": "a cloud (LAS)",
    b"\xff\xfe": "text in UTF-16: save it as UTF-8",
    b"\xfe\xff": "text in UTF-16: save it as UTF-8",
    b"\x93NUMPY": "an array of NumPy: save it as .csv with a header",
}


def read_text(path: Path) -> str:
    """Return the text of a file in UTF-8.

    Raises
    ------
    ValueError
        If the file is empty, or is not a text; the message names the format.
    LidarError
        If the file is larger than the memory.
    OSError
        If the file is not a plain file, or cannot be read.
    """
    with open_input(path) as file:
        first = file.read(_START_BYTES)
    kind = next((kind for magic, kind in _KINDS.items() if first.startswith(magic)), None)
    if kind is not None:
        raise ValueError(f"it is {kind}; a text file is expected")
    if b"\0" in first:
        raise ValueError("it is a binary file of an unknown kind, and a text file is expected")
    try:
        text = read_input(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError("it is no text in UTF-8: save it as UTF-8") from error
    if not text.strip():
        raise ValueError("it is empty")
    return text.replace("\r\n", "\n").replace("\r", "\n")
