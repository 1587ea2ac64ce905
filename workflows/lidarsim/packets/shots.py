"""Shots of a sensor's lasers, with and without returns, in the manufacturer's order."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, fields, replace

import numpy as np

from ..columns.cloud import Cloud
from ..errors import LidarError
from ..numerics.arrays import AnyArray, Bools, Floats, Floats32, Ints
from ..sensor import Sensor
from ..sensor.packet_settings import PacketSettings
from ..sweeps.ray_image import RayImage, require_fired_rays
from ..sweeps.sweeps import Sweeps


@dataclass(frozen=True, eq=False)
class Shots:
    """Firings of lasers in the manufacturer's order, with up to r returns per laser.

    There are n firings of c lasers. The returns of a pulse have the same order as in the cloud, by
    range. A single return is the first.
    """

    firings: Ints  # (n,): firing numbers since the start of the station
    starts_ns: Ints  # (n,): start of each firing, nanoseconds since the start of the survey
    stamps_ns: Ints  # (n,): the same on the sensor's clock, including its jumps
    azimuths: Floats  # (n,): head azimuth, radians counterclockwise from the sensor's x axis
    dropped: Bools  # (n,): whether the firing is in a packet that is lost
    range_m: Floats32  # (r, n, c): distance from the beam origin; NaN without a return
    columns: Mapping[str, AnyArray]  # {cloud column: (r, n, c)}; 0 without a return

    def __len__(self) -> int:
        return len(self.firings)

    def __getitem__(self, firings: slice) -> Shots:
        """Return the selected firings."""
        columns = {name: values[:, firings] for name, values in self.columns.items()}
        arrays = {name: getattr(self, name)[firings] for name in _OF_FIRINGS}
        return Shots(**arrays, range_m=self.range_m[:, firings], columns=columns)

    @property
    def return_mask(self) -> Bools:
        """Whether each shot has a first return, a second return, and so on.

        The shape is (r, n, c).
        """
        return ~np.isnan(self.range_m)

    @classmethod
    def concatenate(cls, tables: list[Shots]) -> Shots:
        """Concatenate one or more groups of shots, which must have the same columns."""
        if len(tables) == 1:
            return tables[0]
        columns = {
            name: np.concatenate([part.columns[name] for part in tables], axis=1)
            for name in tables[0].columns
        }
        arrays = {
            name: np.concatenate([getattr(part, name) for part in tables]) for name in _OF_FIRINGS
        }
        range_m = np.concatenate([part.range_m for part in tables], axis=1)
        return cls(**arrays, range_m=range_m, columns=columns)

    @classmethod
    def from_points(
        cls, sweeps: Sweeps, sweep: int, points: Cloud, columns: Iterable[str] = ()
    ) -> Shots:
        """Return the shots of a sweep.

        `points` are all returns of the sweep in order. `columns` are names of columns to store in
        addition to the range.

        Raises
        ------
        LidarError
            If the sensor has no packet format, the points lack a column or are not in order, or the
            rays of the survey are unknown.
        """
        names = tuple(columns)
        settings_of(require_fired_rays(sweeps).sensors[sweeps.sensor[sweep]])
        check_columns(points.columns, names)
        shots = cls.from_image(RayImage.from_points(sweeps, sweep, points), points, names)
        faults = sweeps.faults_in(sweep)
        return replace(
            shots,
            stamps_ns=shots.starts_ns
            + sum(fault.time_errors_ns(shots.starts_ns) for fault in faults),
            dropped=_dropped(sweeps, sweep, shots.firings, shots.starts_ns),
        )

    @classmethod
    def from_image(cls, image: RayImage, points: Cloud, columns: Iterable[str] = ()) -> Shots:
        """Create shots from the points in a range image, ignoring sensor faults.

        Raises LidarError if the sensor has no packet format, or if the points lack a column.
        """
        sensor = image.sensor
        lasers = settings_of(sensor).lasers
        names = tuple(columns)
        check_columns(points.columns, names)

        shape = (image.planes, len(image.firings), len(lasers))
        shot = (image.plane * shape[1] + image.column) * shape[2] + lasers[image.row]

        def in_laser_order(values: AnyArray, missing: float) -> AnyArray:
            filled = np.full(shape, missing, values.dtype)
            filled.reshape(-1)[shot] = values
            return filled

        starts = image.begin_ns + sensor.begins_ns(image.firings)
        starts_ns = np.rint(starts).astype(np.int64)
        return cls(
            firings=image.firings,
            starts_ns=starts_ns,
            stamps_ns=starts_ns,
            azimuths=sensor.head.azimuths(image.firings),
            dropped=np.zeros(len(image.firings), np.bool_),
            range_m=in_laser_order(points["range"].astype(np.float32, copy=False), np.nan),
            columns={name: in_laser_order(points[name], 0) for name in names},
        )

    def shift_times(self, shift_ns: int) -> Shots:
        """Return the shots with shifted times, for the repetition of a survey."""
        if not shift_ns:
            return self
        return replace(
            self, starts_ns=self.starts_ns + shift_ns, stamps_ns=self.stamps_ns + shift_ns
        )


_OF_FIRINGS = tuple(
    field.name for field in fields(Shots) if field.name not in ("range_m", "columns")
)


def _dropped(sweeps: Sweeps, sweep: int, firings: Ints, starts_ns: Ints) -> Bools:
    """Return whether each firing of a sweep is in a lost packet."""
    sensor = int(sweeps.sensor[sweep])
    sweeps_per_station = int(np.count_nonzero(sweeps.sensor == sensor)) // sweeps.stations
    station = int(sweeps.numbers[sweep]) // sweeps_per_station
    seed = require_fired_rays(sweeps).seeds[sensor]
    dropped = np.zeros(len(firings), np.bool_)
    for number, fault in enumerate(sweeps.faults):
        if fault.kind == "dropped_packets" and fault.sensor in (None, sweeps.sensors[sensor]):
            dropped |= fault.is_active(starts_ns) & fault.find_dropped(
                firings, seed, station, number
            )
    return dropped


def check_columns(cloud_columns: Collection[str], names: Iterable[str]) -> None:
    """Raise LidarError if the cloud lacks a column that the packet format requires."""
    if missing := [name for name in ("ray", "range", *names) if name not in cloud_columns]:
        lacks = ", ".join(missing)
        raise LidarError(
            f"Packets require {lacks}, but the cloud does not contain it. Run the survey with "
            f"pcap in output.write, or with {lacks} in cloud.columns."
        )


def settings_of(sensor: Sensor) -> PacketSettings:
    """Return the packet settings of a sensor.

    Raises LidarError, listing models with a packet format, if the sensor has none.
    """
    if sensor.packets is None:
        names = ", ".join(name.rpartition("/")[2] for name in with_packets())
        raise LidarError(f"{sensor.model} has no packet format. Use one of these models: {names}.")
    return sensor.packets


def last_and_strongest(values: AnyArray, returned: Bools) -> list[AnyArray]:
    """Return the last and the strongest return of each shot, for dual mode.

    The results have shape (n, c). `values` (r, n, c) are in the order of `Shots`, and `returned`
    (r, n, c) states whether each return is sent. Where the last return is the strongest, the second
    array has the second strongest return. A single return is in both arrays.
    """
    if len(values) == 1:
        return [values[0], values[0]]
    return [np.where(returned[1], values[1], values[0]), values[0]]


class CarryOver:
    """Firings that wait until a packet is full.

    A revolution does not usually fill a whole number of packets.
    """

    def __init__(self, firings_per_packet: int) -> None:
        self.firings_per_packet = firings_per_packet
        self._rest: Shots | None = None

    def whole_packets(self, shots: Shots) -> Shots:
        """Add firings, and return the firings that fill whole packets. Keep the rest.

        The result may be empty. Firings that remain at the end of a station are discarded.
        """
        if len(shots) and shots.firings[0] == 0:
            self._rest = None
        joined = shots if self._rest is None else Shots.concatenate([self._rest, shots])
        count = len(joined) // self.firings_per_packet * self.firings_per_packet
        self._rest = joined[count:]
        return joined[:count]

    def rest(self) -> Shots | None:
        """Remove and return the remaining firings. Return None before the first sweep."""
        rest = self._rest
        self._rest = None
        return rest


def with_packets() -> tuple[str, ...]:
    """Return the names of the built-in models that have a packet format."""
    from ..schema.model_names import model_names
    from ..sensor.models import read_model

    return tuple(name for name in model_names() if read_model(name).packets is not None)
