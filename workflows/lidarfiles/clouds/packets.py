"""Read and write captures of sensor packets in the manufacturers' protocols."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from lidarsim.columns.sweep import Sweep
from lidarsim.environment.extras import reading
from lidarsim.packets.encoders import WHITE, PacketSource, decoder_of, encoder_of
from lidarsim.packets.pcap import PcapWriter
from lidarsim.packets.shots import Shots, check_columns
from lidarsim.survey.survey import Survey
from lidarsim.sweeps.sweeps import make_identifiers

from .cloud_format import CloudFormat
from .format_options import FormatOptions
from .point_field import OMITTED, PointField
from .recording import Recording, sweep_from_columns
from .recording_ref import RecordingRef
from .sequential_recording import SequentialRecording


class PacketCapture(CloudFormat):
    """A folder with one packet capture per sensor.

    The captures are `NAME.pcap`, where NAME is the name of the sensor or `lidar`. Packets have the
    ports, the order and the times of the real sensor. Packets that are dropped by a simulated fault
    are omitted. If readers require metadata from the manufacturer, it is stored in `NAME.json`.
    """

    title = "PCAP"
    by_sweep = True
    frame = "none"
    fields = (
        PointField("firing and laser", ("scan", "ray", "channel")),
        PointField("distance", ("range",)),
        # `survey_columns` adds the columns that the protocols of the sensors contain.
        PointField("reflectivity", ("reflectivity",), OMITTED, on_request=True),
        PointField("signal", ("signal",), OMITTED, on_request=True),
        PointField("timestamp", ("time",), "computed from the firing", on_request=True),
        PointField("sensor", ("sensor",), "one file per sensor", on_request=True),
    )
    other_columns = False
    file_pattern = r"[^/]+\.(pcap|json)"

    @classmethod
    def survey_columns(cls, survey: Survey) -> tuple[str, ...]:
        """Return the columns that the packets of the sensors require.

        Raises LidarError if packets are not supported for a sensor.
        """
        names: dict[str, None] = {}
        for carried, returns in zip(survey.mounted_sensors, survey.returns_each, strict=True):
            encoder = encoder_of(PacketSource(carried.sensor, returns.mode, carried.name))
            names |= dict.fromkeys(encoder.columns)
        return (*names,)

    def write(self, path: Path, spec: FormatOptions) -> None:
        """Write the folder."""
        sources = [
            PacketSource.for_sensor(self.sweeps, number)
            for number in range(len(self.sweeps.sensors))
        ]
        encoders = [encoder_of(source) for source in sources]
        cloud_columns = {column.name for column in self.cloud.table}
        for encoder in encoders:
            check_columns(cloud_columns, encoder.columns)
        path.mkdir()
        names = make_identifiers(name or "lidar" for name in self.sweeps.sensors)
        with ExitStack() as stack:
            writers = [
                PcapWriter(
                    stack.enter_context((path / f"{name}.pcap").open("wb")),
                    encoder.address,
                    encoder.destination,
                    encoder.source.start_ns,
                )
                for name, encoder in zip(names, encoders, strict=True)
            ]
            for sweep, points in enumerate(self.sweeps.points(self.cloud)):
                encoder = encoders[self.sweeps.sensor[sweep]]
                shots = Shots.from_points(self.sweeps, sweep, points, encoder.columns)
                writers[self.sweeps.sensor[sweep]].write(encoder.encode(shots))
            for writer, encoder in zip(writers, encoders, strict=True):
                writer.write(encoder.finish())
        for name, encoder in zip(names, encoders, strict=True):
            for suffix, content in encoder.files().items():
                (path / f"{name}{suffix}").write_bytes(content)

    @classmethod
    def open(cls, ref: RecordingRef) -> Recording:
        """Open the packets of a sensor with the decoder for its manufacturer."""
        return _CaptureRecording(ref)


class _CaptureRecording(SequentialRecording):
    """Packets of one sensor."""

    def __init__(self, ref: RecordingRef) -> None:
        self._decoder = decoder_of(ref.path, ref.name)
        name = ref.choose("sensors", self._decoder.sensors)
        self._sensor = [*self._decoder.sensors].index(name)
        has_reflectivities = ref.intensity in (None, self._decoder.intensity)
        with reading(ref.name):
            count = sum(1 for _ in self.stored_sweeps())
        info = ref.info(
            sensor=name,
            compensated=False,
            white=WHITE if has_reflectivities else None,
            notes=ref.prefix_notes(self._decoder.notes),
        )
        super().__init__(info, count)

    def stored_sweeps(self) -> Iterable[Any]:
        return self._decoder.sweeps(self._sensor)

    def convert(self, stored: Any) -> Sweep:
        columns = dict(self._decoder.columns(self._sensor, stored))
        return sweep_from_columns(columns, time_ns=self._decoder.time_ns(stored))

    def load_stamps(self) -> list[int]:
        with self.lock:
            return [self._decoder.time_ns(sweep) for sweep in self.stored_sweeps()]
