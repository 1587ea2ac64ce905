"""Files of sensors are written completely or not at all."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from ..base.errors import explained
from ..base.storage import Storage


@contextmanager
def write_bytes_of(path: Path) -> Iterator[IO[bytes]]:
    """Open a file that appears after the body.

    Raises LidarError if the file cannot be written.
    """
    with (
        explained(f"{path} cannot be written"),
        Storage.at(path.parent, durable=False).writing(path.name) as file,
    ):
        yield file


def write_text_of(path: Path, text: str) -> None:
    """Write a text in UTF-8.

    Raises LidarError if the file cannot be written.
    """
    with write_bytes_of(path) as file:
        file.write(text.encode())


def remark(text: str) -> str:
    """Return a text for a comment of XML, which must not have two hyphens in a row."""
    return text.replace("--", "- -").rstrip("-")
