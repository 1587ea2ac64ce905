"""Read the UDP datagrams in a network capture, in the pcap or pcapng format.

The format is detected from the content, not from the file name. Frames may have any of the link
types in `_LINKS`, VLAN tags, padding and a frame check sequence. Frames of other protocols are
skipped, because captures usually contain ARP, mDNS and others.

Sources: IETF drafts opsawg-pcap and opsawg-pcapng; registry of link types at tcpdump.org.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from pathlib import Path
from struct import Struct, error, unpack_from
from typing import BinaryIO, NamedTuple

from ..errors import LidarError, explain_os_errors
from ..io.input_files import open_input

ENDINGS = (".pcap", ".pcapng")
_SECOND_NS = 1_000_000_000
_MAX_FRAME_BYTES = 1 << 18
_MAX_DATAGRAM_BYTES = 65_535
_MAX_FRAGMENTED = 64  # incomplete datagrams that are kept; older ones are discarded
_UDP = 17

# {pcap magic number: (byte order, nanoseconds per time unit, size of the frame header in bytes)}
_PCAP_MAGIC = {
    bytes.fromhex("d4c3b2a1"): ("<", 1000, 16),
    bytes.fromhex("a1b2c3d4"): (">", 1000, 16),
    bytes.fromhex("4d3cb2a1"): ("<", 1, 16),
    bytes.fromhex("a1b23c4d"): (">", 1, 16),
    bytes.fromhex("34cdb2a1"): ("<", 1000, 24),  # written by a modified libpcap
    bytes.fromhex("a1b2cd34"): (">", 1000, 24),
}
_PCAPNG_MAGIC = bytes.fromhex("0a0d0d0a")
_PCAPNG_ORDERS = {bytes.fromhex("4d3c2b1a"): "<", bytes.fromhex("1a2b3c4d"): ">"}
# Types of pcapng blocks.
_SECTION = 0x0A0D0D0A
_INTERFACE = 1
_OLD_PACKET = 2
_SIMPLE_PACKET = 3
_ENHANCED_PACKET = 6
# Options of an interface.
_RESOLUTION = 9
_OFFSET = 14


class _Link(NamedTuple):
    """Header layout of a link layer protocol."""

    size: int  # bytes
    protocol: int | None = None  # offset of the EtherType; None if the payload is always IP


_LINKS = {
    1: _Link(14, 12),  # Ethernet
    0: _Link(4),  # BSD loopback
    108: _Link(4),
    12: _Link(0),  # raw IP, for which programs have used three numbers
    14: _Link(0),
    101: _Link(0),
    113: _Link(16, 14),  # Linux "cooked", as from `tcpdump -i any`
    228: _Link(0),  # raw IPv4
    276: _Link(20, 0),  # Linux "cooked", version 2
}
_IPV4 = 0x0800
_TAGS = (0x8100, 0x88A8, 0x9100)  # VLAN: 802.1Q, 802.1ad, and an older QinQ
_LOOPBACKS = (0, 108)
_INET = (b"\2\0\0\0", b"\0\0\0\2")  # IPv4, in the byte order of the capturing machine


class CapturedDatagram(NamedTuple):
    """A UDP datagram over IPv4."""

    time_ns: int  # capture time of the frame, nanoseconds since 1970
    source: str  # address of the sensor
    port: int  # destination port
    payload: bytes


class _Frame(NamedTuple):
    """A captured frame."""

    time_ns: int
    link: int  # its link type
    content: bytes


class Capture:
    """A network capture file.

    Parameters
    ----------
    path
        Path of the file.
    name
        Name of the file for messages.

    Attributes
    ----------
    cut_datagrams
        Number of truncated datagrams, which were skipped. Available once `datagrams` has ended.
    ends_early
        Whether the file ends inside a frame. Available once `datagrams` has ended.
    """

    def __init__(self, path: Path, name: str = "") -> None:
        self.path = path
        self.name = name or str(path)
        self.cut_datagrams = 0
        self.ends_early = False

    @property
    def notes(self) -> list[str]:
        """Messages about missing data in the file, available after `datagrams` has ended."""
        notes = []
        if self.ends_early:
            notes.append("ends inside a frame. The rest of the recording is missing")
        if self.cut_datagrams:
            notes.append(
                f"has {self.cut_datagrams:,} truncated datagrams, which are skipped. Capture whole "
                "frames, for example with tcpdump -s 0"
            )
        return notes

    def is_classic(self, links: Collection[int]) -> bool:
        """Return whether this is a classic pcap file whose link type is one of the given types.

        Raises LidarError if the file cannot be read.
        """
        with explain_os_errors(f"{self.name} cannot be read"), open_input(self.path) as file:
            head = file.read(24)
        if len(head) < 24 or head[:4] not in _PCAP_MAGIC:
            return False
        order, _, header_bytes = _PCAP_MAGIC[head[:4]]
        return header_bytes == 16 and _link_of(head[4:], order) in links

    def datagrams(self) -> Iterator[CapturedDatagram]:
        """Yield the datagrams in file order, with fragments reassembled.

        Raises
        ------
        LidarError
            If the file is not a capture, is damaged, or contains no datagrams.
        """
        self.cut_datagrams = 0
        self.ends_early = False
        unknown_links: set[int] = set()
        fragments = _Fragments()
        is_empty = True
        with explain_os_errors(f"{self.name} cannot be read"), open_input(self.path) as file:
            for frame in self._frames(file):
                if frame.link not in _LINKS:
                    unknown_links.add(frame.link)
                    continue
                start = _ipv4_start(frame)
                if start is None:
                    continue
                datagram = self._datagram(frame, start, fragments)
                if datagram is not None:
                    is_empty = False
                    yield datagram
        if is_empty:
            raise LidarError(f"{self.name} {self._why_empty(unknown_links)}")

    def _why_empty(self, unknown_links: set[int]) -> str:
        """Return why the file has no datagrams, phrased as the end of an error message."""
        if self.cut_datagrams:
            return (
                "contains only truncated datagrams. Capture whole frames, for example "
                "with tcpdump -s 0."
            )
        if unknown_links:
            numbers = ", ".join(map(str, sorted(unknown_links)))
            return (
                f"has frames with link type {numbers}, which is not supported. Capture on an "
                "Ethernet interface."
            )
        return "has no UDP datagrams over IPv4. Expected a recording of a sensor."

    def _frames(self, file: BinaryIO) -> Iterator[_Frame]:
        magic = file.read(4)
        if magic == _PCAPNG_MAGIC:
            file.seek(0)
            yield from self._pcapng_frames(file)
        elif magic in _PCAP_MAGIC:
            yield from self._pcap_frames(file, *_PCAP_MAGIC[magic])
        else:
            raise LidarError(
                f"{self.name} is not a pcap or pcapng file. Expected a recording of a sensor."
            )

    def _pcap_frames(
        self, file: BinaryIO, order: str, unit_ns: int, header_bytes: int
    ) -> Iterator[_Frame]:
        """Yield the frames in the rest of a pcap file, after its magic number."""
        head = file.read(20)
        if len(head) < 20:
            raise LidarError(f"{self.name} ends inside its header. Copy or record it again.")
        link = _link_of(head, order)
        header = Struct(f"{order}IIII")
        while record := file.read(header_bytes):
            if len(record) < header_bytes:
                self.ends_early = True
                return
            seconds, rest, size, _ = header.unpack_from(record)
            self._check_size(size, file)
            content = file.read(size)
            if len(content) < size:
                self.ends_early = True
                return
            yield _Frame(seconds * _SECOND_NS + rest * unit_ns, link, content)

    def _pcapng_frames(self, file: BinaryIO) -> Iterator[_Frame]:
        """Yield the frames of a pcapng file, whose sections may have different byte orders."""
        order = "<"
        interfaces: list[_Interface] = []
        last_ns = 0
        while head := file.read(12):
            if len(head) < 12:
                self.ends_early = True
                return
            if head[:4] == _PCAPNG_MAGIC:
                if head[8:12] not in _PCAPNG_ORDERS:
                    raise self._damaged(file)
                order = _PCAPNG_ORDERS[head[8:12]]
                interfaces = []
            kind, size = unpack_from(f"{order}II", head)
            if size < 12 or size % 4:
                raise self._damaged(file)
            if kind not in (_INTERFACE, _OLD_PACKET, _SIMPLE_PACKET, _ENHANCED_PACKET):
                self._skip(file, size - 12)
                continue
            self._check_size(size, file)
            body = head[8:12] + file.read(size - 12)
            if len(body) < size - 8:
                self.ends_early = True
                return
            try:
                if kind == _INTERFACE:
                    interfaces.append(_Interface.from_block(body[:-4], order))
                else:
                    frame = _frame_of_block(kind, body[:-4], order, interfaces, last_ns)
                    last_ns = frame.time_ns
                    yield frame
            except (error, IndexError, ArithmeticError) as reason:
                raise self._damaged(file) from reason

    def _skip(self, file: BinaryIO, size: int) -> None:
        """Skip bytes of the file, and record whether they extend beyond its end."""
        file.seek(size, os.SEEK_CUR)
        self.ends_early = file.tell() > os.fstat(file.fileno()).st_size

    def _check_size(self, size: int, file: BinaryIO) -> None:
        if size > _MAX_FRAME_BYTES:
            raise self._damaged(file)

    def _damaged(self, file: BinaryIO) -> LidarError:
        return LidarError(
            f"{self.name} is damaged before byte {file.tell():,}. Copy or record it again."
        )

    def _datagram(
        self, frame: _Frame, start: int, fragments: _Fragments
    ) -> CapturedDatagram | None:
        """Return the UDP datagram that an IPv4 packet completes, or None if it completes none."""
        packet = frame.content[start:]
        if len(packet) < 20 or packet[0] >> 4 != 4 or packet[9] != _UDP:
            return None
        header_bytes = 4 * (packet[0] & 15)
        length = int.from_bytes(packet[2:4], "big")
        # Frames recorded on the sending machine may lack the length.
        stop = length or len(packet)
        if header_bytes < 20 or stop < header_bytes:
            return None
        if stop > len(packet):
            self.cut_datagrams += 1
            return None
        content: bytes | None = packet[header_bytes:stop]
        flags = int.from_bytes(packet[6:8], "big")
        if flags & 0x3FFF:  # more fragments, or an offset
            content = fragments.join(packet[4:6] + packet[12:20], flags, packet[header_bytes:stop])
        if content is None or len(content) < 8:
            return None
        # Padding and check sequences follow the datagram if the IPv4 header has no length.
        size = int.from_bytes(content[4:6], "big")
        if size > len(content):
            self.cut_datagrams += 1
            return None
        payload = content[8:size] if size >= 8 else content[8:]
        source = ".".join(map(str, packet[12:16]))
        return CapturedDatagram(frame.time_ns, source, int.from_bytes(content[2:4], "big"), payload)


def _link_of(head: bytes, order: str) -> int:
    """Return the link type in the header of a pcap file. `head` lacks the magic number."""
    (link,) = unpack_from(f"{order}I", head, 16)
    return int(link) & 0xFFFF  # the other bits describe the frame check sequence


class _Interface(NamedTuple):
    """Description of an interface in a pcapng section."""

    link: int
    snap_bytes: int  # length to which frames are truncated; 0 if they are not
    units_per_s: int = 1_000_000
    offset_s: int = 0

    @classmethod
    def from_block(cls, body: bytes, order: str) -> _Interface:
        """Parse an interface description and its options."""
        link, _, snap_bytes = unpack_from(f"{order}HHI", body)
        units_per_s = 1_000_000
        offset_s = 0
        start = 8
        while start + 4 <= len(body):
            code, size = unpack_from(f"{order}HH", body, start)
            value = body[start + 4 : start + 4 + size]
            if code == _RESOLUTION:
                exponent = value[0] & 0x7F
                units_per_s = 1 << exponent if value[0] & 0x80 else int("1" + "0" * exponent)
            elif code == _OFFSET:
                (offset_s,) = unpack_from(f"{order}q", value)
            elif code == 0:
                break
            start += 4 + size + -size % 4
        return cls(link, snap_bytes, units_per_s, offset_s)


def _frame_of_block(
    kind: int, body: bytes, order: str, interfaces: list[_Interface], last_ns: int
) -> _Frame:
    """Return the frame in a pcapng block. Simple blocks get the time of the previous frame."""
    if kind == _SIMPLE_PACKET:
        interface = interfaces[0]
        (size,) = unpack_from(f"{order}I", body)
        size = min(size, interface.snap_bytes or size)
        return _Frame(last_ns, interface.link, _part(body, 4, size))
    layout = f"{order}IIIII" if kind == _ENHANCED_PACKET else f"{order}HHIIII"
    fields = unpack_from(layout, body)
    high, low, size = fields[-4:-1]
    interface = interfaces[fields[0]]
    units = (high << 32 | low) * _SECOND_NS // interface.units_per_s
    time_ns = units + interface.offset_s * _SECOND_NS
    if not 0 <= time_ns < 2**63:
        raise OverflowError("the time is out of range")
    return _Frame(time_ns, interface.link, _part(body, 20, size))


def _part(body: bytes, start: int, size: int) -> bytes:
    """Return part of a block. Raises IndexError if the block is too short."""
    if start + size > len(body):
        raise IndexError("the frame is longer than its block")
    return body[start : start + size]


def _ipv4_start(frame: _Frame) -> int | None:
    """Return the offset of a frame's IPv4 header, or None for other protocols."""
    content = frame.content
    link = _LINKS[frame.link]
    if link.protocol is None:
        if frame.link in _LOOPBACKS and content[:4] not in _INET:
            return None
        return link.size
    start = link.size
    protocol = int.from_bytes(content[link.protocol : link.protocol + 2], "big")
    while protocol in _TAGS:  # each tag has four bytes and ends with the next protocol
        protocol = int.from_bytes(content[start + 2 : start + 4], "big")
        start += 4
    return start if protocol == _IPV4 else None


class _Fragments:
    """Fragments of datagrams that are still incomplete."""

    def __init__(self) -> None:
        self._parts: dict[bytes, dict[int, bytes]] = {}  # {datagram: {offset: fragment}}

    def join(self, key: bytes, flags: int, content: bytes) -> bytes | None:
        """Add a fragment. Return its datagram if that is now complete, otherwise None."""
        parts = self._parts.setdefault(key, {})
        parts[(flags & 0x1FFF) * 8] = content
        if not flags & 0x2000:
            parts[-1] = b""  # marks that the last fragment has arrived
        while len(self._parts) > _MAX_FRAGMENTED:
            self._parts.pop(next(iter(self._parts)))
        if sum(map(len, parts.values())) > _MAX_DATAGRAM_BYTES:
            self._parts.pop(key, None)
            return None
        joined = b""
        for offset, part in sorted(parts.items()):
            if offset >= 0 and offset != len(joined):
                return None
            joined += part
        if -1 not in parts:
            return None
        self._parts.pop(key, None)
        return joined
