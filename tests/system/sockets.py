"""What processes of this machine listen on, found through /proc."""

from __future__ import annotations

import os
import re
import sys
from ipaddress import IPv4Address, IPv6Address, ip_address
from pathlib import Path

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
