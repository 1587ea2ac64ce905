"""The look at what processes listen on, by which the demo is judged."""

from __future__ import annotations

import socket
import subprocess
import sys
import uuid
from ipaddress import ip_address
from pathlib import Path

import pytest
from tests.system.sockets import listened_on

pytestmark = pytest.mark.skipif(
    not Path("/proc/net/tcp").exists(), reason="finds the sockets of a run through /proc"
)


@pytest.fixture
def tag(monkeypatch) -> str:
    tag = uuid.uuid4().hex
    monkeypatch.setenv("TEST_RUN_TAG", tag)
    return tag


@pytest.mark.parametrize("host", ["0.0.0.0", "127.0.0.1", "::", "::1"])
def test_the_look_at_sockets_sees_them_all(host, tag):
    family = "AF_INET6" if ":" in host else "AF_INET"
    if ":" in host:
        try:
            socket.create_server((host, 0), family=socket.AF_INET6).close()
        except OSError:
            pytest.skip("this machine has no IPv6")
    listen = (
        f"import socket, sys; s = socket.create_server(({host!r}, 0), family=socket.{family}); "
        "print('there', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", listen], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout
        assert process.stdout.readline() == b"there\n"
        assert listened_on(tag) == [ip_address(host)]
        process.communicate(b"")
    assert listened_on(tag) == []
