"""Network captures: link types, formats, and frames that are not of the sensor."""

from __future__ import annotations

import struct

import pytest
from tests.captures import ARP, IPV4, MACS, ip_packet, pcap, pcapng, variants

from lidarsim import LidarError
from lidarsim.packets.capture import Capture
from lidarsim.packets.encoders import decoder_of

START_NS = 1_700_000_000_123_456_000
PAYLOADS = [bytes([number]) * 20 for number in range(3)]
VARIANTS = variants((START_NS + 1_500_000 * k, payload) for k, payload in enumerate(PAYLOADS))


@pytest.mark.parametrize("name", VARIANTS)
def test_datagrams_are_found_in_any_capture(name, tmp_path):
    path = tmp_path / "a.pcap"
    path.write_bytes(VARIANTS[name])
    capture = Capture(path)
    found = [datagram for datagram in capture.datagrams() if datagram.port == 2368]
    assert [datagram.payload for datagram in found] == PAYLOADS
    assert {datagram.source for datagram in found} == {"192.168.1.201"}
    # Binary fractions of a second are not whole nanoseconds.
    times_ns = [datagram.time_ns for datagram in found]
    assert times_ns == pytest.approx([START_NS + 1_500_000 * k for k in range(3)], rel=0, abs=1)
    assert capture.notes == []


def test_simple_blocks_of_pcapng_have_no_times(tmp_path):
    frame = MACS + IPV4 + ip_packet(b"abcd")
    content = pcapng([(START_NS, frame)])
    interface = struct.pack("<IIHHII", 1, 20, 1, 0, 0, 20)
    size = 16 + len(frame) + -len(frame) % 4
    simple = struct.pack("<III", 3, size, len(frame)) + frame.ljust(size - 16, b"\0")
    content += content[:28] + interface + simple + struct.pack("<I", size)
    (tmp_path / "a.pcapng").write_bytes(content)
    first, second = Capture(tmp_path / "a.pcapng").datagrams()
    assert (first.payload, second.payload) == (b"abcd", b"abcd")
    assert first.time_ns == second.time_ns == START_NS


def test_what_a_capture_lacks_is_noted(tmp_path):
    whole = (0, MACS + IPV4 + ip_packet(b"whole"))
    content = pcap([whole, (0, (MACS + IPV4 + ip_packet(b"x" * 100))[:80]), whole])
    (tmp_path / "a.pcap").write_bytes(content[:-1])
    capture = Capture(tmp_path / "a.pcap")
    assert [datagram.payload for datagram in capture.datagrams()] == [b"whole"]
    ends, cut = capture.notes
    assert ends.startswith("ends inside a frame")
    assert cut.startswith("has 1 truncated datagrams")


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "is not a pcap or pcapng file"),
        (b"\x1f\x8b" + b"x" * 100, "is not a pcap or pcapng file"),
        (pcap([])[:20], "ends inside its header"),
        (pcap([]), "has no UDP datagrams over IPv4"),
        (pcap([(0, ARP)]), "has no UDP datagrams over IPv4"),
        (pcap([(0, b"\x80" * 60)], link=105), "link type 105, which is not supported"),
        (pcap([(0, (MACS + IPV4 + ip_packet(b"x" * 99))[:60])]), "only truncated datagrams"),
        (pcap([]) + struct.pack("<IIII", 0, 0, 2**31, 60), "damaged before byte 40"),
        (pcapng([])[:8] + b"\xff" * 60, "is damaged before byte 12"),
        (pcapng([]) + struct.pack("<III", 6, 2**32 - 4, 0), "is damaged before byte"),
        (pcapng([]) + struct.pack("<III", 6, 13, 0), "is damaged before byte"),
        (pcapng([(0, ARP)]) + struct.pack("<IIIII", 6, 20, 9, 0, 20), "is damaged before byte"),
    ],
)
def test_a_file_without_datagrams_is_refused_in_a_line(content, says, tmp_path):
    path = tmp_path / "a.pcap"
    path.write_bytes(content)
    with pytest.raises(LidarError, match=says) as raised:
        list(Capture(path).datagrams())
    assert str(raised.value).startswith(f"{path} ") and "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("payload", "says"),
    [
        (b"\xee\xff" + b"\0" * 600, "Hesai packets, which are not supported. Convert"),
        (b"\x55\xaa\x05\x5a" + b"\0" * 1244, "RoboSense packets, which are not supported. Convert"),
        (b"\0\x54\5" + b"\0" * 1361, "Livox packets, which are not supported. Record"),
        (b"\0" * 512, "contains no packets of a supported sensor. Sweeps can be read from"),
    ],
)
def test_the_first_known_packet_decides_whose_they_are(payload, says, tmp_path):
    path = tmp_path / "a.pcap"
    others = [(0, ARP), (0, MACS + IPV4 + ip_packet(b"mdns", 5353))]
    path.write_bytes(pcap([*others, (0, MACS + IPV4 + ip_packet(payload))]))
    with pytest.raises(LidarError, match=f"^a.pcap .*{says}"):
        decoder_of(path, "a.pcap")
