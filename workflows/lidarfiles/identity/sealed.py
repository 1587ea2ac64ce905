"""JSON files that end with a CRC-32 checksum, which reveals damage and manual edits."""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Mapping
from typing import IO, Any

_SEAL = re.compile(rb',\n"crc": (\d{1,10})\}\n\Z')


class SealedWriter:
    """Writer for a JSON object that is written in pieces and ends with a checksum.

    Call `write` for each piece and `seal` at the end.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._crc = 0

    def write(self, text: str) -> None:
        """Write a piece of the object's text, excluding the closing brace."""
        data = text.encode()
        self._crc = zlib.crc32(data, self._crc)
        self._file.write(data)

    def seal(self) -> None:
        """Write a checksum of the text, followed by the closing brace."""
        self._file.write(f',\n"crc": {self._crc}}}\n'.encode())


def seal_json(content: Mapping[str, Any]) -> bytes:
    r"""Serialize a non-empty mapping as a JSON object with a checksum at the end.

    Examples
    --------
    >>> seal_json({"count": 7})
    b'{\n "count": 7,\n"crc": 2540531583}\n'
    >>> unseal_json(seal_json({"count": 7}))
    {'count': 7}
    """
    text = json.dumps(content, indent=1).removesuffix("\n}").encode()
    return text + f',\n"crc": {zlib.crc32(text)}}}\n'.encode()


def unseal_json(data: bytes) -> dict[str, Any]:
    """Verify and return the content of a JSON object written by `seal_json` or `SealedWriter`.

    Raises
    ------
    ValueError
        If the checksum is missing or does not match the text.
    """
    seal = _SEAL.search(data)
    if seal is None:
        raise ValueError("its last line has no checksum")
    text = data[: seal.start()]
    if zlib.crc32(text) != int(seal[1]):
        raise ValueError("its checksum is wrong, so it was damaged or edited")
    content: dict[str, Any] = json.loads(text + b"}")
    return content
