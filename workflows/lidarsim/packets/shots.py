"""Shots of a sensor in its maker's order of lasers, with and without returns."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, fields, replace

import numpy as np

from ..base.arrays import AnyArray, Bools, Floats, Floats32, Ints
from ..base.errors import LidarError
from ..columns.cloud import Cloud
from ..sensor import Sensor
from ..sensor.packet_settings import PacketSettings
from ..sweeps.ray_image import Image, fired_of
from ..sweeps.sweeps import Sweeps


@dataclass(frozen=True, eq=False)
class Shots:
    """Firings of a sensor: n firings of c lasers in the maker's order, each with up to r returns.

    Returns of a pulse are in the order of the cloud, by range; an only return is the first.
    """

    firings: Ints  # (n,): numbers since the start of the station
    starts_ns: Ints  # (n,): start of each firing, nanoseconds since the survey's start
    stamps_ns: Ints  # (n,): the same by the sensor's clock, with its jumps
    azimuths: Floats  # (n,): of the head, radians counter-clockwise from the sensor's x axis
    dropped: Bools  # (n,): whether the firing is in a packet that is lost on its way
    range_m: Floats32  # (r, n, c): distance from the beam's origin; NaN without a return
    columns: Mapping[str, AnyArray]  # {column of the cloud: (r, n, c)}; 0 without a return

    def __len__(self) -> int:
        return len(self.firings)

    def __getitem__(self, firings: slice) -> Shots:
        """Select consecutive firings."""
        columns = {name: values[:, firings] for name, values in self.columns.items()}
        arrays = {name: getattr(self, name)[firings] for name in _OF_FIRINGS}
        return Shots(**arrays, range_m=self.range_m[:, firings], columns=columns)

    @property
    def returned(self) -> Bools:
        """Whether each shot has a return of each number: (r, n, c)."""
        return ~np.isnan(self.range_m)

    @classmethod
    def joined(cls, tables: list[Shots]) -> Shots:
        """Concatenate one or more parts with firings, which have the same columns."""
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
        """Return the shots of a sweep, from all returns of the sweep in order, `points`.

        `columns` are names of columns that the shots have beside the range.

        Raises
        ------
        LidarError
            If the sensor has no packets, the points lack a column or are not in order, or the rays
            of the survey are unknown.
        """
        names = tuple(columns)
        settings_of(fired_of(sweeps).sensors[sweeps.sensor[sweep]])
        check_columns(points.columns, names)
        shots = cls.from_image(Image.from_points(sweeps, sweep, points), points, names)
        faults = sweeps.faults_in(sweep)
        return replace(
            shots,
            stamps_ns=shots.starts_ns + sum(fault.jumps_ns(shots.starts_ns) for fault in faults),
            dropped=_dropped(sweeps, sweep, shots.firings, shots.starts_ns),
        )

    @classmethod
    def from_image(cls, image: Image, points: Cloud, columns: Iterable[str] = ()) -> Shots:
        """Return the shots of the points of an image, without faults.

        LidarError if the sensor has no packets, or the points lack a column.
        """
        sensor = image.sensor
        lasers = settings_of(sensor).lasers
        names = tuple(columns)
        check_columns(points.columns, names)

        shape = (image.planes, len(image.firings), len(lasers))
        shot = (image.plane * shape[1] + image.column) * shape[2] + lasers[image.row]

        def in_laser_order(values: AnyArray, missing: float) -> AnyArray:
            """Return values (n,) of points as an array (r, n, c)."""
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

    def later(self, shift_ns: int) -> Shots:
        """Return the shots with later times and stamps, as of a survey that is repeated."""
        if not shift_ns:
            return self
        return replace(
            self, starts_ns=self.starts_ns + shift_ns, stamps_ns=self.stamps_ns + shift_ns
        )


_OF_FIRINGS = tuple(
    field.name for field in fields(Shots) if field.name not in ("range_m", "columns")
)


def _dropped(sweeps: Sweeps, sweep: int, firings: Ints, starts_ns: Ints) -> Bools:
    """Return whether firings (n,) of a sweep are in packets that are lost on their way."""
    sensor = int(sweeps.sensor[sweep])
    sweeps_per_station = int(np.count_nonzero(sweeps.sensor == sensor)) // sweeps.stations
    station = int(sweeps.numbers[sweep]) // sweeps_per_station
    seed = fired_of(sweeps).seeds[sensor]
    dropped = np.zeros(len(firings), np.bool_)
    for number, fault in enumerate(sweeps.faults):
        if fault.kind == "dropped_packets" and fault.sensor in (None, sweeps.sensors[sensor]):
            dropped |= fault.during(starts_ns) & fault.drops(firings, seed, station, number)
    return dropped


def check_columns(cloud_columns: Collection[str], names: Iterable[str]) -> None:
    """Raise LidarError if a cloud with some columns lacks columns that packets hold."""
    if missing := [name for name in ("ray", "range", *names) if name not in cloud_columns]:
        lacks = ", ".join(missing)
        raise LidarError(
            f"Packets require {lacks}, but the cloud does not contain it. Run the survey with "
            f"pcap in output.write, or with {lacks} in cloud.columns."
        )


def settings_of(sensor: Sensor) -> PacketSettings:
    """Return the packets of a sensor.

    Raises LidarError, with models that have some, without packets.
    """
    if sensor.packets is None:
        names = ", ".join(name.rpartition("/")[2] for name in with_packets())
        raise LidarError(f"{sensor.model} has no packet format. Use one of these models: {names}.")
    return sensor.packets


def last_and_strongest(values: AnyArray, returned: Bools) -> list[AnyArray]:
    """Return the last and the strongest returns of the mode dual: two arrays (n, c).

    `values` (r, n, c) are in the order of `Shots`, `returned` (r, n, c) whether a return is sent.
    Where the last return is the strongest, the second array has the second strongest; an only
    return is in both.
    """
    if len(values) == 1:
        return [values[0], values[0]]
    return [np.where(returned[1], values[1], values[0]), values[0]]


class CarryOver:
    """Firings that fill no packet yet: a revolution is not a whole number of packets."""

    def __init__(self, firings_per_packet: int) -> None:
        self.firings_per_packet = firings_per_packet
        self._rest: Shots | None = None

    def whole_packets(self, shots: Shots) -> Shots:
        """Add firings, return all firings that fill packets, perhaps none, and keep the rest.

        At a new station the sensor starts anew: the rest of the last station is never sent.
        """
        if len(shots) and shots.firings[0] == 0:
            self._rest = None
        joined = shots if self._rest is None else Shots.joined([self._rest, shots])
        count = len(joined) // self.firings_per_packet * self.firings_per_packet
        self._rest = joined[count:]
        return joined[:count]

    def rest(self) -> Shots | None:
        """Return firings that fill no packet, and forget them, or None before the first sweep."""
        rest = self._rest
        self._rest = None
        return rest


def with_packets() -> tuple[str, ...]:
    """Return the names of the models of the package that have packets, in order."""
    from ..base.model_names import model_names
    from ..sensor.models import read_model

    return tuple(name for name in model_names() if read_model(name).packets is not None)
