"""Encode single sweeps as packets, for programs that move the sensor themselves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..columns.cloud import Cloud
from ..errors import LidarError
from ..motion.trajectory import CENTER
from ..schema.checks import check_fits
from ..sensor import Returns, Sensor
from ..sensor.optics import TWO_RETURNS
from ..simulator import Scanner
from ..simulator.scanner import StartSeconds, SweepNumber
from ..survey.survey import Mounted, Survey, nanoseconds
from ..sweeps.ray_image import RayImage
from .encoders import START_NS, Datagrams, PacketEncoder, PacketSource, encoder_of
from .shots import Shots, check_columns


class Packets:
    """Encoder that converts clouds from `Scanner.sweep` to the datagrams of a sensor.

    Poses do not have to be continuous, because packets contain ranges and angles but no poses.
    Shots that do not fill a packet are sent with the next sweep. Sweeps must be encoded in the
    order of their numbers.

    Parameters
    ----------
    sensor
        The lidar, or a `Mounted` lidar on a platform.
    name
        Name of the sensor, from which its serial number is derived. A `Mounted` sensor already has
        a name.
    returns
        Sub-rays and reported returns, which must be the same as for the scanner.
    start
        Date and time that correspond to time 0 of the scanner, as in `Survey`. If `start` is set,
        the timestamps are those of a clock that is synchronized by a GNSS receiver or PTP.

    Raises
    ------
    LidarError
        If the sensor has no packet format, or if the format cannot store its returns.

    Examples
    --------
    >>> from lidarpool import Packets, Pose, Scanner, Scene, load_sensor
    >>> packets = Packets(load_sensor("velodyne/vlp16"))
    >>> scanner = Scanner(Scene.seed(), load_sensor("velodyne/vlp16"), columns=packets.columns)
    >>> for number in range(2):
    ...     sweep = scanner.sweep(Pose((0, 0, 1 + number)), number=number)
    ...     data, positions = packets.encode(sweep, number=number)
    ...     print(data.payloads.shape, data.port, data.due_ns[:2])
    (75, 1206) 2368 [1327104 2654208]
    (75, 1206) 2368 [100859904 102187008]
    """

    def __init__(
        self,
        sensor: Sensor | Mounted,
        *,
        name: str = "",
        returns: Returns | None = None,
        start: Any = None,
    ) -> None:
        if name and isinstance(sensor, Mounted):
            raise LidarError(
                f"The name of a Mounted sensor is set in Mounted, but name is {name!r}. Use "
                f"Mounted(sensor, name={name!r})."
            )
        mounted = sensor if isinstance(sensor, Mounted) else Mounted(sensor, name=name)
        survey = Survey(
            sensors=[mounted],
            poses=[CENTER],
            steps=1,
            returns=returns,  # type: ignore[arg-type]
            start=start,
        )
        self._prepare(survey)

    @classmethod
    def for_scanner(cls, scanner: Scanner, start: Any = None) -> Packets:
        """Create an encoder for the sensor of a scanner.

        `start` has the same meaning as in `Packets`.
        """
        carried = scanner.survey.mounted_sensors[0]
        return cls(carried, returns=scanner.survey.returns_each[0], start=start)

    def _prepare(self, survey: Survey) -> None:
        """Create the encoder for the sensor of a survey."""
        carried = survey.mounted_sensors[0]
        self._sensor = carried.sensor
        self._returns = 2 if survey.returns_each[0].mode in TWO_RETURNS else 1
        start_ns = START_NS if survey.start is None else nanoseconds(survey.start)
        self.encoder: PacketEncoder = encoder_of(
            PacketSource(
                carried.sensor,
                survey.returns_each[0].mode,
                carried.name,
                start_ns,
                survey.start is not None,
            )
        )
        self._next_number = 0

    def __repr__(self) -> str:
        return f"<Packets: {self._sensor.model}, next sweep {self._next_number}>"

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns that a cloud must contain to be encoded."""
        return ("ray", "range", *self.encoder.columns)

    def encode(
        self, sweep: Cloud, *, number: int | None = None, start_s: float | None = None
    ) -> list[Datagrams]:
        """Encode a sweep as datagrams, in one group per port.

        Parameters
        ----------
        sweep
            Cloud that `Scanner.sweep` returned for this number and start.
        number
            Number of the revolution or frame, which must be the same as in `Scanner.sweep`. By
            default, the first sweep has number 0, and each further sweep has the next number.
        start_s
            Start of the revolution in seconds, as in `Scanner.sweep`.

        Raises
        ------
        LidarError
            If the cloud lacks a column, or if it belongs to another sweep.
        """
        number = self._next_number if number is None else number
        check_fits("number", number, SweepNumber)
        check_fits("start_s", start_s, StartSeconds)
        steps = self._sensor.steps_of_revolution(number)
        check_columns(sweep.columns, self.encoder.columns)
        scans = sweep["scan"]
        if len(scans) and not (steps.start <= scans.min() and scans.max() < steps.stop):
            raise LidarError(
                f"The cloud does not belong to sweep {number}. Pass the same number to "
                "Scanner.sweep and to Packets.encode."
            )
        late_ns = 0
        if start_s is not None:
            late_ns = round(start_s * 1e9 - self._sensor.revolution_start_ns(number))
        image = RayImage.from_steps(self._sensor, steps, steps.start, late_ns, self._returns, sweep)
        datagrams = self.encoder.encode(Shots.from_image(image, sweep, self.encoder.columns))
        self._next_number = number + 1
        return datagrams

    def finish(self) -> list[Datagrams]:
        """Return the datagrams with the shots that remain after the last sweep."""
        return self.encoder.finish()

    def files(self) -> Mapping[str, bytes]:
        """Return additional files that readers of the packets require.

        The keys are file name suffixes, and the values are file contents.
        """
        return self.encoder.files()
