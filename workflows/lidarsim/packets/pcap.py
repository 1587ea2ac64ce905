"""Write datagrams to pcap files with Ethernet, IPv4 and UDP headers, and times in microseconds."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from ipaddress import IPv4Address
from struct import pack
from typing import BinaryIO

import numpy as np

from ..numerics.arrays import Bytes, Indices, Ints
from .capture import CapturedDatagram
from .encoders import Datagrams

# Little-endian magic number for microseconds, version 2.4, maximum frame size, Ethernet.
_FILE_HEADER = pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 262_144, 1)
_RECORD_BYTES = 16  # size of a frame's header in the file
_IP_OFFSET = _RECORD_BYTES + 14  # Ethernet header
_UDP_OFFSET = _IP_OFFSET + 20
_PAYLOAD_OFFSET = _UDP_OFFSET + 8
_TIME_TO_LIVE = 64
_UDP = 17
_IPV4_BROADCAST = "255.255.255.255"
# Locally administered addresses, because the frames do not come from a real device.
_SOURCE_MAC = bytes.fromhex("020000000001")
_DESTINATION_MAC = bytes.fromhex("020000000002")
_BROADCAST_MAC = b"\xff" * 6


class PcapWriter:
    """Writer of datagrams to a pcap file. The datagrams of each call are sorted by time.

    `address` is the address of the sensor, and `destination` the address of the receiver.
    `start_ns` is time 0 of the datagrams, in nanoseconds since 1970. The output depends only on the
    arguments.
    """

    def __init__(
        self, file: BinaryIO, address: str, destination: str = _IPV4_BROADCAST, start_ns: int = 0
    ) -> None:
        self._file = file
        self._start_ns = start_ns
        self._addresses = IPv4Address(address).packed + IPv4Address(destination).packed
        is_broadcast = destination == _IPV4_BROADCAST
        self._macs = (_BROADCAST_MAC if is_broadcast else _DESTINATION_MAC) + _SOURCE_MAC
        file.write(_FILE_HEADER)

    def write(self, groups: Sequence[Datagrams]) -> None:
        """Write the datagrams of all groups, sorted by time.

        Raises OSError on failure.
        """
        groups = [group for group in groups if len(group)]
        if not groups:
            return
        frames = [self._frames(group) for group in groups]
        sizes = np.concatenate([np.full(len(rows), rows.shape[1]) for rows in frames])
        order = np.argsort(np.concatenate([group.due_ns for group in groups]), kind="stable")
        ends = np.empty(len(order), np.int64)
        ends[order] = np.cumsum(sizes[order])
        content = np.empty(int(sizes.sum()), np.uint8)
        first = 0
        for rows in frames:
            starts = ends[first : first + len(rows)] - rows.shape[1]
            content[starts[:, None] + np.arange(rows.shape[1])] = rows
            first = first + len(rows)
        self._file.write(content.data)

    def _frames(self, group: Datagrams) -> Bytes:
        """Return the frames of datagrams, with pcap record headers and one row per frame."""
        count, size = group.payloads.shape
        frames = np.zeros((count, _PAYLOAD_OFFSET + size), np.uint8)
        frames[:, _PAYLOAD_OFFSET:] = group.payloads
        frame_bytes = frames.shape[1] - _RECORD_BYTES
        micros = (group.due_ns + self._start_ns) // 1000
        seconds, rest = np.divmod(micros, 1_000_000)
        record = np.stack([seconds, rest, *[np.full(count, frame_bytes)] * 2], axis=1)
        frames[:, :_RECORD_BYTES] = record.astype("<u4").view(np.uint8)
        headers = self._macs + b"\x08\x00" + self._ip_header(size) + self._udp_header(group, size)
        frames[:, _RECORD_BYTES:_PAYLOAD_OFFSET] = np.frombuffer(headers, np.uint8)
        frames[:, _UDP_OFFSET + 6 : _UDP_OFFSET + 8] = self._udp_checksums(frames[:, _UDP_OFFSET:])
        return frames

    def _ip_header(self, size: int) -> bytes:
        head = pack(">BBHHHBB", 0x45, 0, 28 + size, 0, 0x4000, _TIME_TO_LIVE, _UDP)
        words = np.frombuffer(head + self._addresses, ">u2").astype(np.int64)
        checksum = int(_complement(words.sum(keepdims=True))[0])
        return head + pack(">H", checksum) + self._addresses

    def _udp_header(self, group: Datagrams, size: int) -> bytes:
        return pack(">HHHH", group.source_port or group.port, group.port, 8 + size, 0)

    def _udp_checksums(self, segments: Bytes) -> Bytes:
        """Return the checksums of UDP segments as big-endian bytes."""
        count, size = segments.shape
        padded = np.pad(segments, ((0, 0), (0, size % 2)))
        words = padded.view(">u2").sum(axis=1, dtype=np.int64)
        pseudo_header = np.frombuffer(self._addresses + pack(">HH", _UDP, size), ">u2")
        checksums = _complement(words + pseudo_header.sum(dtype=np.int64))
        checksums[checksums == 0] = 0xFFFF  # 0 would mean that there is no checksum
        return checksums.astype(">u2").view(np.uint8).reshape(count, 2)


def write_datagrams(file: BinaryIO, datagrams: Iterable[CapturedDatagram]) -> None:
    """Write captured datagrams to a plain pcap file, as broadcasts without checksums.

    Raises OSError on failure.
    """
    file.write(_FILE_HEADER)
    macs = _BROADCAST_MAC + _SOURCE_MAC + b"\x08\x00"
    to = IPv4Address(_IPV4_BROADCAST).packed
    for time_ns, source, port, payload in datagrams:
        udp = pack(">HHHH", port, port, 8 + len(payload), 0) + payload
        head = pack(">BBHHHBBH", 0x45, 0, 20 + len(udp), 0, 0x4000, _TIME_TO_LIVE, _UDP, 0)
        frame = macs + head + IPv4Address(source).packed + to + udp
        seconds, rest = divmod(time_ns, 1_000_000_000)
        file.write(pack("<IIII", seconds, rest // 1000, len(frame), len(frame)) + frame)


def _complement(sums: Ints | Indices) -> Ints:
    """Return ones' complement checksums (RFC 1071) from sums of 16-bit words."""
    folded = np.asarray(sums, np.int64)
    for _ in range(3):
        folded = (folded & 0xFFFF) + (folded >> 16)
    return 0xFFFF - folded
