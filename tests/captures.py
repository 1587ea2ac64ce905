"""Captures for tests: the same datagrams with other link types and in other file formats."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping

Frame = tuple[int, bytes]  # time since 1970 in nanoseconds, content
IPV4 = b"\x08\x00"
MACS = b"\xff" * 6 + b"\2\0\0\0\0\1"
ARP = MACS + b"\x08\x06" + b"\0" * 46


def ip_packet(payload: bytes, port: int = 2368, *, options: bytes = b"", states_length: bool = True,
              source: tuple[int, ...] = (192, 168, 1, 201)) -> bytes:  # fmt: skip
    """Return an IPv4 packet with a UDP datagram."""
    segment = struct.pack(">HHHH", port, port, 8 + len(payload), 0) + payload
    words = 5 + len(options) // 4
    length = 4 * words + len(segment) if states_length else 0
    head = struct.pack(">BBHHHBBH", 0x40 | words, 0, length, 7, 0, 64, 17, 0)
    return head + bytes([*source, 255, 255, 255, 255]) + options + segment


def pcap(frames: Iterable[Frame], link: int = 1, *, order: str = "<", nano: bool = False) -> bytes:
    """Return a pcap file."""
    magic = 0xA1B23C4D if nano else 0xA1B2C3D4
    parts = [struct.pack(f"{order}IHHiIII", magic, 2, 4, 0, 0, 65535, link)]
    for time_ns, content in frames:
        seconds, rest = divmod(time_ns, 10**9)
        sizes = len(content), len(content)
        parts += [struct.pack(f"{order}IIII", seconds, rest if nano else rest // 1000, *sizes)]
        parts += [content]
    return b"".join(parts)


def pcapng(
    frames: Iterable[Frame], link: int = 1, *, order: str = "<", resolution: int = 6
) -> bytes:
    """Return a pcapng file of a section, with blocks that describe neither frame nor interface."""

    def block(kind: int, body: bytes) -> bytes:
        body += b"\0" * (-len(body) % 4)
        size = struct.pack(f"{order}I", 12 + len(body))
        return struct.pack(f"{order}I", kind) + size + body + size

    # Its name, its resolution, and the end.
    option = struct.pack(f"{order}HH4sHHB3xHH", 2, 4, b"eth0", 9, 1, resolution, 0, 0)
    parts = [
        block(0x0A0D0D0A, struct.pack(f"{order}IHHq", 0x1A2B3C4D, 1, 0, -1)),
        block(1, struct.pack(f"{order}HHI", 105, 0, 0)),  # a second interface
        block(1, struct.pack(f"{order}HHI", link, 0, 0) + option),
        block(4, b"\0" * 4),  # names of addresses
        block(6, struct.pack(f"{order}IIIII", 0, 0, 0, 4, 4) + b"wifi"),
    ]
    units_per_s = 2 ** (resolution & 127) if resolution & 128 else 10**resolution
    for time_ns, content in frames:
        high, low = divmod(time_ns * units_per_s // 10**9, 2**32)
        head = struct.pack(f"{order}IIIII", 1, high, low, len(content), len(content))
        parts += [block(6, head + content), block(5, b"\0" * 12)]
    return b"".join(parts)


def variants(datagrams: Iterable[tuple[int, bytes]], port: int = 2368) -> Mapping[str, bytes]:
    """Return captures of datagrams (time, payload), by what is special of each."""
    rows = [*datagrams]
    packets = [(time_ns, ip_packet(payload, port)) for time_ns, payload in rows]

    def ethernet(before: bytes = MACS + IPV4, after: bytes = b"") -> list[Frame]:
        return [(time_ns, before + packet + after) for time_ns, packet in packets]

    plain = ethernet()
    cooked = b"\0\4\0\1\0\6\2\0\0\0\0\1\0\0"
    return {
        "plain": pcap(plain),
        "arp first": pcap([(rows[0][0], ARP), *plain]),
        "mdns first": pcap([(rows[0][0], MACS + IPV4 + ip_packet(b"\0" * 45, 5353)), *plain]),
        "position first": pcap([(rows[0][0], MACS + IPV4 + ip_packet(b"\0" * 512, 8308)), *plain]),
        "vlan": pcap(ethernet(MACS + b"\x81\0\0\5" + IPV4)),
        "qinq": pcap(ethernet(MACS + b"\x88\xa8\0\5\x81\0\0\6" + IPV4)),
        "check sequence": pcap(ethernet(after=b"\1\2\3\4"), link=1 | 0x5000_0000 | 1 << 26),
        "no length": pcap([
            (time_ns, MACS + IPV4 + ip_packet(payload, port, states_length=False) + b"\0\0")
            for time_ns, payload in rows
        ]),
        "options": pcap([
            (time_ns, MACS + IPV4 + ip_packet(payload, port, options=b"\1" * 8))
            for time_ns, payload in rows
        ]),
        "big-endian": pcap(plain, order=">"),
        "nanoseconds": pcap(plain, nano=True),
        "cooked": pcap(ethernet(cooked + IPV4), link=113),
        "cooked 2": pcap(ethernet(IPV4 + b"\0\0\0\0\0\2\0\1\4\6\2\0\0\0\0\1\0\0"), link=276),
        "raw": pcap(packets, link=101),
        "loopback": pcap(ethernet(b"\2\0\0\0"), link=0),
        "loopback of a big-endian machine": pcap(ethernet(b"\0\0\0\2"), link=108),
        "pcapng": pcapng(plain),
        "pcapng, big-endian": pcapng(plain, order=">", resolution=9),
        "pcapng, binary fractions": pcapng(plain, resolution=128 | 30),
    }  # fmt: skip
