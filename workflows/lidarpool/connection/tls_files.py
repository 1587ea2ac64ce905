"""Certificate files for a TLS cluster."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple


class TlsFiles(NamedTuple):
    """PEM files that a client needs to connect to a TLS cluster."""

    ca: Path | None = None  # certificate of the certificate authority
    cert: Path | None = None  # certificate of the client
    key: Path | None = None  # private key of the client
