"""What a run listens on: this machine's own interface, and no other."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time
import uuid
from ipaddress import IPv4Address, IPv6Address, ip_address
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(
    not Path("/proc/net/tcp").exists(), reason="finds the sockets of a run through /proc"
)

LISTENING = "0A"  # a socket's state in /proc/net/tcp: TCP_LISTEN

Address = IPv4Address | IPv6Address


def address_of(digits: str) -> Address:
    """Address from /proc/net: 32-bit words in the machine's own byte order."""
    words = [int(digits[at : at + 8], 16) for at in range(0, len(digits), 8)]
    return ip_address(b"".join(word.to_bytes(4, sys.byteorder) for word in words))


def listening() -> dict[str, Address]:
    """Every TCP socket of this machine that listens, by its inode."""
    found = {}
    for table in ("tcp", "tcp6"):
        path = Path("/proc/net", table)
        for row in path.read_text().splitlines()[1:] if path.exists() else ():
            _, local, _, state, *_, inode = row.split()[:10]
            if state == LISTENING:
                found[inode] = address_of(local.partition(":")[0])
    return found


def sockets_of(tag: str) -> set[str]:
    """Inodes of the sockets that processes with `tag` in their environment hold."""
    found = set()
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if tag.encode() not in (entry / "environ").read_bytes():
                continue
            links = [os.readlink(file) for file in (entry / "fd").iterdir()]  # noqa: PTH115
        except OSError:
            continue  # it has ended meanwhile, or is another user's
        found |= {match[1] for link in links if (match := re.match(r"socket:\[(\d+)\]", link))}
    return found


def listened_on(tag: str) -> list[Address]:
    """Addresses on which processes with this tag listen now, one a socket."""
    held = sockets_of(tag)
    return [address for inode, address in listening().items() if inode in held]


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


@pytest.mark.parametrize("options", [[], ["--tls"]], ids=["plain", "tls"])
def test_the_demo_listens_on_loopback_only(options, tag, tmp_path):
    log = tmp_path / "log"
    command = "from lidarpool.cli.commands import main; main()"
    with log.open("wb") as file:
        process = subprocess.Popen(
            [sys.executable, "-c", command, "demo", "--out", tmp_path / "out", *options],
            stdout=file,
            stderr=file,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        )
    seen: set[Address] = set()
    most = 0
    stop = time.monotonic() + 120
    try:
        while not re.search(r"[1-9]\d* of 100 trials", log.read_text()):
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < stop, log.read_text()
            now = listened_on(tag)
            seen, most = seen | set(now), max(most, len(now))
            time.sleep(0.05)
        now = listened_on(tag)
        seen, most = seen | set(now), max(most, len(now))
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(300)
    # Scheduler and dashboard, and of each of three partitions at least a nanny and a worker.
    assert most >= 2 + 3 * 2
    assert all(address.is_loopback for address in seen), seen
