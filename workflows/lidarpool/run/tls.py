"""Certificate files for an encrypted cluster, checked before anything is sent."""

from __future__ import annotations

import ssl
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from distributed import Security

from ..base.errors import LidarpoolError

_FLIGHTS = 4  # a handshake of TLS 1.2 has four messages, that of 1.3 three
_ADVICE = {  # {OpenSSL's X509_V_ERR: what to do}
    9: "one of them is not valid yet, so check the clock",
    10: "one of them is too old, so have it made anew",
}
_OPTIONS = ("--tls-ca", "--tls-cert", "--tls-key")
_SETTINGS = (  # of Dask's configuration
    "distributed.comm.tls.ca-file",
    "distributed.comm.tls.client.cert",
    "distributed.comm.tls.client.key",
)


@dataclass(frozen=True)
class TlsFiles:
    """Paths of PEM files, as the user gave them.

    Parameters
    ----------
    ca
        Certificates of whoever signs for the cluster.
    cert
        Certificate to show to the scheduler.
    key
        Its private key; None where the certificate's file holds that as well.
    """

    ca: Path | None = None
    cert: Path | None = None
    key: Path | None = None

    def __bool__(self) -> bool:
        return any((self.ca, self.cert, self.key))


NO_FILES = TlsFiles()


def security_for(address: str, files: TlsFiles) -> Security:
    """Security with which to connect to a scheduler.

    Parameters
    ----------
    address
        Of the scheduler, with its protocol.
    files
        Certificates; if none are given, those of Dask's configuration are used.

    Raises
    ------
    LidarpoolError
        If the certificates and the address do not go together, or the files are missing,
        unreadable, not PEM, expired or not of each other.
    """
    encrypted = address.startswith("tls://")
    if files:
        if not encrypted:
            raise LidarpoolError(
                f"Certificates are given, but {address!r} is not encrypted: give the scheduler's "
                f"address as tls://host:8786, or leave {', '.join(_OPTIONS)} out."
            )
        if files.ca is None or files.cert is None:
            raise LidarpoolError(
                f"{_OPTIONS[files.ca is not None]} is missing: an encrypted cluster needs "
                f"{_OPTIONS[0]}, {_OPTIONS[1]}, and {_OPTIONS[2]} unless the certificate's file "
                "holds the key."
            )
        _check(files.ca, files.cert, files.key, _OPTIONS)
        return Security(
            tls_ca_file=str(files.ca),
            tls_client_cert=str(files.cert),
            tls_client_key=None if files.key is None else str(files.key),
            require_encryption=True,
        )
    security = Security()
    if not encrypted and security.require_encryption:
        raise LidarpoolError(
            f"Dask's configuration requires encryption, and {address!r} has none: give the "
            "scheduler's address as tls://host:8786."
        )
    if encrypted:
        ca, cert, key = security.tls_ca_file, security.tls_client_cert, security.tls_client_key
        if not (ca and cert):
            raise LidarpoolError(
                f"{address!r} is encrypted: give {', '.join(_OPTIONS)}, or set "
                "distributed.comm.tls in Dask's configuration."
            )
        if not any("\n" in text for text in (ca, cert, key or "")):  # else not files, but PEM
            _check(Path(ca), Path(cert), Path(key) if key else None, _SETTINGS)
    return security


def _check(ca: Path, cert: Path, key: Path | None, names: tuple[str, str, str]) -> None:
    """Check that the files do; `names` says where each was given."""
    for name, path in zip(names, (ca, cert, key), strict=True):
        if path is not None:
            _check_readable(name, path)
    for name, path in zip(names[:2], (ca, cert), strict=True):
        _check_certificate(name, path)
    _check_pair(cert, key, names[2])
    _check_signed(ca, cert, key)


def _check_readable(name: str, path: Path) -> None:
    try:
        with path.open("rb") as file:
            file.read(1)
    except OSError as error:
        raise LidarpoolError(
            f"{name} {path} cannot be read: {error.strerror}. Give a PEM file."
        ) from error


def _check_certificate(name: str, path: Path) -> None:
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_verify_locations(path)
    except ssl.SSLError as error:
        raise LidarpoolError(
            f"{name} {path} holds no certificate in PEM form, which begins with "
            "-----BEGIN CERTIFICATE-----."
        ) from error


def _check_pair(cert: Path, key: Path | None, name: str) -> None:
    """Check that the key is one, is not encrypted, and belongs to the certificate."""
    holder = cert if key is None else key

    def no_password() -> str:
        raise LidarpoolError(
            f"The key in {holder} is protected by a password, which Dask cannot ask for: "
            "give one without."
        )

    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_cert_chain(cert, key, password=no_password)
    except ssl.SSLError as error:
        if error.reason == "KEY_VALUES_MISMATCH":
            raise LidarpoolError(
                f"The key in {holder} does not belong to the certificate in {cert}: give the "
                "key that the certificate was made with."
            ) from error
        missing = f" ({name} is not given)" if key is None else ""
        raise LidarpoolError(
            f"{holder} holds no private key in PEM form, which begins with "
            f"-----BEGIN PRIVATE KEY-----{missing}."
        ) from error


def _check_signed(ca: Path, cert: Path, key: Path | None) -> None:
    """Shake hands with a server in this process that trusts the CA, as the scheduler does.

    Whatever would make it refuse the certificate is found here, where there is a reason to
    tell: the scheduler of a real cluster only hangs up.
    """
    server = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=str(ca))
    server.verify_mode = ssl.CERT_REQUIRED
    server.verify_flags &= ~ssl.VERIFY_X509_STRICT  # as Dask has it
    client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    client.check_hostname, client.verify_mode = False, ssl.CERT_NONE
    for context in (server, client):
        context.load_cert_chain(cert, key)
    upward, downward = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = [
        client.wrap_bio(downward, upward),
        server.wrap_bio(upward, downward, server_side=True),
    ]
    try:
        for _ in range(_FLIGHTS):
            for end in ends:
                _go_on(end)
    except ssl.SSLError as error:
        reason = getattr(error, "verify_message", None) or error.reason or str(error)
        advice = _ADVICE.get(getattr(error, "verify_code", 0), "give two that belong together")
        raise LidarpoolError(
            f"The certificate in {cert} cannot be used with the authority in {ca} ({reason}): "
            f"{advice}."
        ) from error


def _go_on(end: ssl.SSLObject) -> None:
    """Do what can be done of a handshake with what the other end has sent so far."""
    with suppress(ssl.SSLWantReadError):
        end.do_handshake()
