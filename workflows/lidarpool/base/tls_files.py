"""Certificates of an encrypted cluster."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple


class TlsFiles(NamedTuple):
    """PEM files for an encrypted cluster: certificates of authority and client, and a key."""

    ca: Path | None = None
    cert: Path | None = None
    key: Path | None = None
