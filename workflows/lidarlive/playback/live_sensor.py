"""Bridge that sends each packet at the same time as a live sensor would."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Self

from lidarfiles.clouds.writing import ExportSpec
from lidarsim.columns.cloud import Cloud
from lidarsim.packets.encoders import PacketEncoder, PacketSource, encoder_of
from lidarsim.packets.shots import Shots, check_columns
from lidarsim.sweeps.instruments import IMU_FILE, Instruments
from lidarsim.sweeps.sweeps import Sweeps

from .bridge import Bridge, BridgeOptions
from .schedule import Schedule
from .transmitter import Transmitter, sensor_streams

_LEAD_NS = 0.3e9  # time before its first packet at which a sweep is passed to the sender


class PacketsBridge(Bridge):
    """Bridge that sends packets in each sensor's protocol, and simulates the sensors' interfaces.

    The setting `api` contains the addresses on which the sensor interfaces listen, as
    NAME=HOST:PORT or HOST:PORT. The setting `lateness` is a file for statistics on how late packets
    were.
    """

    format = ExportSpec("pcap")
    settings = ("api", "lateness")
    lead_ns = _LEAD_NS

    def __init__(
        self,
        sweeps: Sweeps,
        schedule: Schedule,
        options: BridgeOptions,
        note: Callable[[str], None],
    ) -> None:
        super().__init__(sweeps, schedule, options, note)
        instruments = sweeps.instruments
        if options.period_ns and instruments is not None:
            instruments = RepeatedInstruments.from_instruments(instruments, options.period_ns)
        sources = [
            PacketSource.for_sensor(replace(sweeps, instruments=instruments), number)
            for number in range(len(sweeps.sensors))
        ]
        self._encoders = [encoder_of(source) for source in sources]
        streams = sensor_streams(self._encoders, options.to, options.settings.get("api", ()))
        self._transmitter = Transmitter(streams, note, options.settings.get("lateness"))

    @property
    def description(self) -> str:
        """Destinations of the packets, and available sensor interfaces."""
        return self._transmitter.description

    def due_ns(self, sweep: int) -> float:
        """Return the start of the sweep, which is shortly before its first packet is sent."""
        return float(self.sweeps.begins_ns[sweep])

    def prepare(self, sweep: int, points: Cloud) -> None:
        """Compile the encoding loops by encoding a sweep with a temporary encoder."""
        source = PacketSource.for_sensor(self.sweeps, int(self.sweeps.sensor[sweep]))
        encoder = encoder_of(replace(source, instruments=None))
        encoder.encode(self._shots(encoder, sweep, points))

    def send(self, sweep: int, points: Cloud, shift_ns: int) -> None:
        """Pass the packets of a sweep to the sending process."""
        number = int(self.sweeps.sensor[sweep])
        encoder = self._encoders[number]
        shots = self._shots(encoder, sweep, points).shift_times(shift_ns)
        self._transmitter.sender.send(number, encoder.encode(shots), self.schedule.deadlines_ns)

    def finish(self) -> None:
        """Send the remaining packets, and wait until all packets have been sent."""
        for number, encoder in enumerate(self._encoders):
            self._transmitter.sender.send(number, encoder.finish(), self.schedule.deadlines_ns)
        self._transmitter.sender.finish()

    @property
    def summary(self) -> str:
        """Number of sent packets and their delays."""
        return self._transmitter.summary

    def __enter__(self) -> Self:
        self._transmitter.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._transmitter.__exit__(*error)

    def _shots(self, encoder: PacketEncoder, sweep: int, points: Cloud) -> Shots:
        check_columns(points.columns, encoder.columns)
        return Shots.from_points(self.sweeps, sweep, points, encoder.columns)


@dataclass(frozen=True)
class RepeatedInstruments(Instruments):
    """Instruments whose IMU samples repeat indefinitely, with a period of `period_ns`.

    Positions do not repeat. Instead, the receiver keeps reporting its last position.
    """

    period_ns: int = 0

    @classmethod
    def from_instruments(cls, instruments: Instruments, period_ns: int) -> RepeatedInstruments:
        """Create repeated instruments from the given instruments."""
        return cls(instruments.imu, instruments.gnss, instruments.folder, period_ns)

    def rows(self, name: str) -> Iterator[list[str]]:
        """Yield the rows of a file, repeating those of the IMU with later times."""
        if name != IMU_FILE:
            yield from super().rows(name)
            return
        shift_ns = 0
        while True:
            row: list[str] = []
            for row in super().rows(name):
                yield [str(int(row[0]) + shift_ns), *row[1:]]
            if not row:
                return
            shift_ns += self.period_ns
