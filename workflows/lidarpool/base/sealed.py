"""JSON files that end with the CRC-32 of their text, so that damage and edits are noticed."""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Mapping
from typing import IO, Any

_SEAL = re.compile(rb',\n"crc": (\d{1,10})\}\n\Z')


class SealedWriter:
    """Writes the text of a JSON object piece by piece.

    `seal` ends the object with its CRC-32.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._crc = 0

    def write(self, text: str) -> None:
        """Write text of the object, without its last brace."""
        data = text.encode()
        self._crc = zlib.crc32(data, self._crc)
        self._file.write(data)

    def seal(self) -> None:
        """Write the CRC-32 of all text and the last brace."""
        self._file.write(f',\n"crc": {self._crc}}}\n'.encode())


def sealed(content: Mapping[str, Any]) -> bytes:
    r"""Return the text of a JSON object that is not empty, with its CRC-32 at the end.

    Examples
    --------
    >>> sealed({"count": 7})
    b'{\n "count": 7,\n"crc": 2540531583}\n'
    >>> unsealed(sealed({"count": 7}))
    {'count': 7}
    """
    text = json.dumps(content, indent=1).removesuffix("\n}").encode()
    return text + f',\n"crc": {zlib.crc32(text)}}}\n'.encode()


def unsealed(data: bytes) -> dict[str, Any]:
    """Return the object that `sealed` or `SealedWriter` has written.

    ValueError if the text does not fit its CRC-32.
    """
    seal = _SEAL.search(data)
    if seal is None:
        raise ValueError("its last line has no checksum")
    text = data[: seal.start()]
    if zlib.crc32(text) != int(seal[1]):
        raise ValueError("its checksum is wrong, so it was damaged or edited")
    content: dict[str, Any] = json.loads(text + b"}")
    return content
