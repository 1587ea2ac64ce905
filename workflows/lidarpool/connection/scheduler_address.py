"""Validate scheduler addresses and certificates that the user specified.

A command checks them before it reads or computes anything else.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from urllib.parse import urlsplit

from lidarsim.errors import LidarError, MissingFileError, convert_errors, explain_os_errors

from .tls_files import TlsFiles

_LOOK_EVERY_S = 0.5  # interval between checks for a scheduler file
_WRITING_S = 2.0  # maximum time that a scheduler takes to write its file
_ENCRYPTED = ("tls://", "wss://")
_SCHEMES = ("tcp", "tls", "ucx", "ucxx", "ws", "wss")  # Dask's schemes for inter-process traffic
_NEEDED = {  # {option: key in Dask's configuration}
    "--tls-ca": "distributed.comm.tls.ca-file",
    "--tls-cert": "distributed.comm.tls.client.cert",
}


def is_scheduler_file(given: str) -> bool:
    """Return whether `given` is the path of a scheduler file instead of an address."""
    return "://" not in given and (given.endswith(".json") or Path(given).is_file())


def read_scheduler_file(
    path: Path, wait_s: float = 0.0, report: Callable[[str], None] = lambda text: None
) -> str:
    """Read the scheduler address from a file that ``dask scheduler --scheduler-file`` wrote.

    Parameters
    ----------
    path
        Path of the scheduler file.
    wait_s
        Maximum time to wait for a file that does not exist yet, in seconds.
    report
        Function that is called with a message for the user before waiting.

    Raises
    ------
    LidarError
        If the file does not exist after `wait_s` seconds, or is not a scheduler file.
    """
    deadline = time.monotonic() + wait_s
    if wait_s and not path.exists():
        report(f"waiting for the scheduler file {path}")
    was_found = False
    while True:
        found = path.exists()
        try:
            return _read(path)
        except LidarError:
            if found and not was_found:  # the scheduler may still be writing the file
                deadline = min(deadline, time.monotonic() + _WRITING_S)
                was_found = True
            if time.monotonic() >= deadline:
                raise
        time.sleep(_LOOK_EVERY_S)


def _read(path: Path) -> str:
    """Read the address from a scheduler file, or raise LidarError if this is not possible."""
    from lidarsim.io.input_files import read_input_text  # imported late to keep --help fast

    if not path.exists():
        raise MissingFileError(
            f"The scheduler file {path} does not exist. Start the scheduler with "
            f"`dask scheduler --scheduler-file {path}`, or increase `--startup-timeout`."
        )
    failure = f"The scheduler file {path} cannot be read"
    with explain_os_errors(failure):
        text = read_input_text(path)
    with convert_errors(failure):
        address = json.loads(text)["address"]
        check_address(address)
    return str(address)


def check_address(address: str) -> None:
    """Raise LidarError if an address has an unknown scheme, no host or an invalid port."""
    scheme, separator, _ = address.partition("://")
    if separator and scheme not in _SCHEMES:
        raise LidarError(
            f"The address {address!r} has the unknown scheme {scheme!r}. Use an address such as "
            "tcp://host:8786 or, for a TLS cluster, tls://host:8786."
        )
    with suppress(ValueError):  # the port is not a number or out of range
        parts = urlsplit(f"//{address.rpartition('//')[2]}")
        if parts.hostname and parts.port:
            return
    raise LidarError(
        f"Invalid scheduler address {address!r}. Expected a host and a port from 1 to 65535, "
        "such as tcp://host:8786, or a scheduler file."
    )


def check_certificates(address: str, files: TlsFiles) -> None:
    """Raise LidarError unless the TLS files match the scheme of the scheduler address.

    An encrypted cluster requires certificates, which may also be set in Dask's configuration. An
    unencrypted cluster must not have any.
    """
    if not address.startswith(_ENCRYPTED):
        if any(files):
            raise LidarError(
                "`--tls-ca`, `--tls-cert` and `--tls-key` require a TLS cluster, but the address "
                f"{address!r} does not start with tls://. Start the scheduler with certificates, "
                "or remove these options."
            )
        return
    from dask import config

    missing = [
        f"`{option}`"
        for (option, key), file in zip(_NEEDED.items(), files, strict=False)
        if file is None and not config.get(key, None)
    ]
    if missing:
        raise LidarError(
            f"The cluster at {address!r} uses TLS, but {' and '.join(missing)} "
            f"{'is' if len(missing) == 1 else 'are'} missing. Pass the cluster's certificates "
            "with `--tls-ca`, `--tls-cert` and `--tls-key`, or set `distributed.comm.tls` in "
            "Dask's configuration."
        )
