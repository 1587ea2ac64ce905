"""Options of commands for the certificates of an encrypted cluster."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import click

from ..run.tls import TlsFiles


def tls_file_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add --tls-ca, --tls-cert and --tls-key."""
    for name, what in (
        ("key", "Private key of that certificate, if its file does not hold it."),
        ("cert", "Certificate to show to an encrypted cluster, a PEM file."),
        ("ca", "Certificates of the authority of an encrypted cluster, a PEM file."),
    ):
        command = click.option(f"--tls-{name}", type=click.Path(path_type=Path), help=what)(command)
    return command


def tls_files_for(scheduler: str | None, *files: Path | None) -> TlsFiles:
    """Certificates as one; an error if there is no scheduler to use them with."""
    if any(files) and scheduler is None:
        raise click.UsageError(
            "--tls-ca, --tls-cert and --tls-key are for the cluster of --scheduler: give its "
            "address, tls://host:8786, or --tls for an encrypted cluster of this machine."
        )
    return TlsFiles(*files)
