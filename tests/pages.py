"""Asks a page's server, as the page does."""

from __future__ import annotations

import json
import urllib.request
from typing import Any
from urllib.parse import urlencode

import numpy as np


def ask(url: str, what: str, headers: dict[str, str] | None = None, **asked: Any) -> Any:
    """Return the answer: its JSON, with the arrays as {name: array} under "arrays"."""
    request = urllib.request.Request(f"{url}{what}?{urlencode(asked)}", headers=headers or {})
    with urllib.request.urlopen(request, timeout=120) as response:
        return unpacked(response.read())


def unpacked(message: bytes) -> Any:
    """Return what `lidarview.viewer.server.pack_answer` has packed."""
    length = int.from_bytes(message[:4], "little")
    header = json.loads(message[4 : 4 + length])
    start = 4 + length
    header["arrays"] = {
        name: np.frombuffer(message, kind, int(np.prod(shape)), start + at).reshape(shape)
        for name, kind, shape, at in header["arrays"]
    }
    return header
