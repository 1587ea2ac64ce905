"""Write sensor files so that an incomplete file never exists."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from ..errors import explain_os_errors
from ..io.storage import replacing_file


@contextmanager
def open_complete(path: Path) -> Iterator[IO[bytes]]:
    """Open a file that only appears once the context exits without an error.

    Raises LidarError if the file cannot be written.
    """
    with explain_os_errors(f"{path} cannot be written"):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing_file(path) as file:
            yield file


def write_complete_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file, which only appears once it is complete.

    Raises LidarError if the file cannot be written.
    """
    with open_complete(path) as file:
        file.write(text.encode())


def xml_comment(text: str) -> str:
    """Return text for an XML comment, with consecutive hyphens separated."""
    return text.replace("--", "- -").rstrip("-")
