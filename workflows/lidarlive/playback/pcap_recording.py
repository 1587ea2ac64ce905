"""Play back UDP datagrams from a packet capture with their original timing."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import count, groupby
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim.io.input_files import open_input
from lidarsim.packets.capture import Capture, CapturedDatagram
from lidarsim.packets.encoders import Datagrams
from lidarsim.packets.service import Destination, Service

from ..devices.ouster_api import OusterApi
from .schedule import Schedule
from .transmitter import Stream, Transmitter, streams_to


class PcapRecording:
    """UDP datagrams from a packet capture, in file order.

    Times are relative to the first datagram.

    Raises
    ------
    LidarError
        If the file is not a capture, is damaged, or contains no IPv4 datagrams.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._capture = Capture(path)
        self.sources: list[str] = []  # sensor addresses in order of their first datagrams
        self.ports: dict[str, list[int]] = {}  # ports by sensor address
        last_ns = 0
        packet_count = 0
        for datagram in self._datagrams():
            if datagram.source not in self.ports:
                self.sources.append(datagram.source)
            ports = self.ports.setdefault(datagram.source, [])
            if datagram.port not in ports:
                ports.append(datagram.port)
            last_ns = max(last_ns, datagram.time_ns)
            packet_count += 1
        self.notes = [f"{path} {clause}." for clause in self._capture.notes]
        self.period_ns = last_ns + last_ns // max(1, packet_count - 1)  # duration of one repetition

    def batches(self, length_ns: int) -> Iterator[tuple[int, dict[str, list[Datagrams]]]]:
        """Yield the start time and the datagrams of each interval of `length_ns`.

        The datagrams are grouped by source.
        """
        spans = groupby(self._datagrams(), lambda datagram: datagram.time_ns // length_ns)
        for span, datagrams in spans:
            groups: dict[str, dict[tuple[int, int], list[CapturedDatagram]]] = {}
            for datagram in datagrams:
                key = datagram.port, len(datagram.payload)
                groups.setdefault(datagram.source, {}).setdefault(key, []).append(datagram)
            yield (
                span * length_ns,
                {
                    source: [_stack_datagrams(alike) for alike in by_kind.values()]
                    for source, by_kind in groups.items()
                },
            )

    def _datagrams(self) -> Iterator[CapturedDatagram]:
        first_ns: int | None = None
        for datagram in self._capture.datagrams():
            first_ns = datagram.time_ns if first_ns is None else first_ns
            yield datagram._replace(time_ns=max(0, datagram.time_ns - first_ns))


_LEAD_NS = 300_000_000  # time by which datagrams are passed to the sender in advance
_START_NS = 50e6  # time between the start of the schedule and the first datagram


def recorded_streams(
    recording: PcapRecording, to: Sequence[str], api: Sequence[str]
) -> list[Stream]:
    """Return a stream for each sensor of the recording.

    Each stream is named after the address of its sensor. The streams are directed with
    `streams_to`. For an Ouster sensor, the sensor interface is simulated if there is a .json file
    with its metadata next to the recording.
    """
    streams = [
        Stream(
            source,
            f"{recording.path.name} of {source}",
            {f"port {port}": port for port in recording.ports[source]},
            _service_of(recording),
            distinguished_by_receivers=True,
        )
        for source in recording.sources
    ]
    return streams_to(streams, to, api)


def _service_of(recording: PcapRecording) -> Callable[..., Service | None]:
    """Return a function that creates a simulation of the sensor's interface.

    The function returns None if the interface is unknown.
    """
    path = recording.path.with_suffix(".json")
    if len(recording.sources) > 1 or not path.exists():
        return lambda *_: None
    try:
        with open_input(path) as file:
            metadata: dict[str, Any] = json.load(file)
        settings = metadata["config_params"]
        ports = settings["udp_port_lidar"], settings["udp_port_imu"]
        metadata["sensor_info"]["image_rev"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return lambda *_: None

    def make_service(
        address: str, destination: Destination, send_to: Callable[[Destination], None]
    ) -> Service:
        return OusterApi(address, destination, send_to, metadata, ports)

    return make_service


def play_recording(
    recording: PcapRecording, transmitter: Transmitter, schedule: Schedule, *, loop: bool = False
) -> None:
    """Send the datagrams of a recording on time, repeating them if `loop` is set."""
    schedule.start(0, _START_NS)
    for lap in count() if loop else range(1):
        shift_ns = lap * recording.period_ns
        for start_ns, groups_by_source in recording.batches(_LEAD_NS):
            schedule.wait_until(start_ns + shift_ns - _LEAD_NS)
            for source, groups in groups_by_source.items():
                later = [replace(group, due_ns=group.due_ns + shift_ns) for group in groups]
                number = recording.sources.index(source)
                transmitter.sender.send(number, later, schedule.deadlines_ns)
    transmitter.sender.finish()


def _stack_datagrams(datagrams: list[CapturedDatagram]) -> Datagrams:
    """Combine datagrams of the same size and port into arrays."""
    payloads = np.frombuffer(b"".join(datagram.payload for datagram in datagrams), np.uint8)
    times_ns = np.array([datagram.time_ns for datagram in datagrams], np.int64)
    return Datagrams(
        payloads.reshape(len(datagrams), len(datagrams[0].payload)), times_ns, datagrams[0].port
    )
