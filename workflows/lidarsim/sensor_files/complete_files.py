"""Write sensor files so that they are either complete or do not exist."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from ..errors import explain_os_errors
from ..io.storage import Storage


@contextmanager
def open_complete(path: Path) -> Iterator[IO[bytes]]:
    """Open a file for writing that appears only when the context ends without an error.

    Raises LidarError if the file cannot be written.
    """
    with (
        explain_os_errors(f"{path} cannot be written"),
        Storage.at(path.parent, durable=False).writing(path.name) as file,
    ):
        yield file


def write_complete_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8.

    Raises LidarError if the file cannot be written.
    """
    with open_complete(path) as file:
        file.write(text.encode())


def xml_comment(text: str) -> str:
    """Return a text for an XML comment, in which consecutive hyphens are separated."""
    return text.replace("--", "- -").rstrip("-")
