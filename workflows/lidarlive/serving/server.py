"""A gRPC server for the sensor service."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, Self

import grpc

from lidarsim.errors import LidarError
from lidarsim.io.input_files import read_input_text

from ..viewers.viewer import Address
from .service import SensorService

PORT = 50051
_THREADS = 8
_MAX_CALLS = 64  # requests that are being answered or waiting; further requests are refused
_MAX_REQUEST_BYTES = 4 << 20
_MAX_REPLY_BYTES = 80 << 20
_MIN_TOKEN_LETTERS = 16
_STOP_S = 2.0  # time for replies in progress when the server stops


class Endpoint(NamedTuple):
    """Address on which a server listens, and the token that clients must send, if any."""

    address: Address
    token: str | None

    @classmethod
    def choose(cls, listen: str | None = None, token_file: Path | None = None) -> Endpoint:
        """Check an address and read the token.

        Parameters
        ----------
        listen
            Address and port. The default is port 50051 on 127.0.0.1, or the next free port.
        token_file
            File with the token. Without a token, only clients on this machine can connect.

        Raises
        ------
        LidarError
            If the address cannot be used, if it requires a token, or if the token is unsuitable.
        """
        address = Address.choose(listen, PORT)
        token = None if token_file is None else _read_token(token_file)
        if token is None and not address.is_loopback:
            raise LidarError(
                f"Other machines can connect to {address}, so a token is required. Pass a file "
                "with a token as --token-file, or listen on 127.0.0.1."
            )
        return cls(address, token)


class SensorServer:
    """A server that answers requests inside a `with` block.

    Parameters
    ----------
    service
        The service.
    endpoint
        Address and token.

    Raises
    ------
    LidarError
        If another program listens on the address.
    """

    def __init__(self, service: SensorService, endpoint: Endpoint) -> None:
        address, token = endpoint
        self._server = grpc.server(
            ThreadPoolExecutor(_THREADS, "sensor-service"),
            handlers=[service.handler()],
            interceptors=[] if token is None else [_TokenCheck(token)],
            options=[
                ("grpc.so_reuseport", 0),
                ("grpc.max_receive_message_length", _MAX_REQUEST_BYTES),
                ("grpc.max_send_message_length", _MAX_REPLY_BYTES),
            ],
            maximum_concurrent_rpcs=_MAX_CALLS,
        )
        try:
            port = self._server.add_insecure_port(str(address))
        except RuntimeError as error:
            raise LidarError(
                f"The server cannot listen on {address}. Another program may be using this port. "
                "Pass another port with `--listen`."
            ) from error
        self.address = address._replace(port=port)

    def __enter__(self) -> Self:
        self._server.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._server.stop(_STOP_S).wait()

    def wait(self) -> None:
        """Wait until the server is stopped, or until Ctrl-C is pressed."""
        self._server.wait_for_termination()


class _TokenCheck(grpc.ServerInterceptor):
    """Refuse calls whose metadata do not contain the token."""

    def __init__(self, token: str) -> None:
        self._expected = f"Bearer {token}".encode()
        self._refusal = grpc.unary_unary_rpc_method_handler(_refuse)

    def intercept_service(self, continuation: Callable[[Any], Any], details: Any) -> Any:
        """Return the handler of a call."""
        values = [value for key, value in details.invocation_metadata if key == "authorization"]
        found = "".join(str(value) for value in values).encode()
        if not secrets.compare_digest(found, self._expected):
            return self._refusal
        return continuation(details)


def _refuse(request: bytes, context: Any) -> None:
    context.abort(
        grpc.StatusCode.UNAUTHENTICATED,
        "The token is missing or wrong. Set the metadata entry authorization to Bearer TOKEN.",
    )


def _read_token(path: Path) -> str:
    """Read a token from a file.

    Raise LidarError if the file does not contain a single word of sufficient length.
    """
    words = read_input_text(path).split()
    if len(words) != 1 or len(words[0]) < _MIN_TOKEN_LETTERS or not words[0].isascii():
        raise LidarError(
            f"{path} must contain a single token with at least {_MIN_TOKEN_LETTERS} ASCII "
            "characters, such as the output of openssl rand -hex 32."
        )
    return words[0]
