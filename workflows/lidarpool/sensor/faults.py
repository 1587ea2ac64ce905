"""Faults of sensors, to test what reads their data: which, of which sensor, and when."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ..base.arrays import Bools, Floats, Ints
from ..base.declared import AngleDeg, Several, Text, Two, UnitShare, about
from ..base.errors import LidarpoolError, prefixed
from ..base.validation import checked_fields
from ..base.words import did_you_mean

if TYPE_CHECKING:
    from .survey import ScanSpec, Survey

FaultKind = Literal["dirt", "dead_channels", "dropped_packets", "frozen", "time_jump"]
ChannelNumber = Annotated[int, Field(ge=0)]

# {kind: fields that it needs, and fields that it may have beside those of every kind}
_OWN: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "dirt": (("transmission",), ("azimuth_deg", "elevation_deg")),
    "dead_channels": (("channels",), ()),
    "dropped_packets": (("share", "packet"), ()),
    "frozen": ((), ()),
    "time_jump": (("by_s",), ()),
}


@dataclass(frozen=True)
@checked_fields
class Fault:
    """A fault of a sensor from one time to another; labels keep the truth.

    Raises
    ------
    LidarpoolError
        If a number is outside its range, it ends before it begins, or has fields of another kind.

    Examples
    --------
    >>> Fault("dirt", 1.0, 2.0, transmission=0.3, azimuth_deg=(-20, 20))
    Fault(kind='dirt', from_s=1.0, to_s=2.0, transmission=0.3, azimuth_deg=(-20, 20))
    """

    kind: Annotated[
        FaultKind,
        about("dirt on the window, dead channels, lost packets, repeated sweeps, shifted stamps"),
    ]
    from_s: Annotated[
        float, about("when it begins, seconds since the survey's start", ge=0, le=1e9)
    ] = 0.0
    to_s: Annotated[
        float | None, about("when it ends; by default with the survey", 20.0, gt=0, le=1e9)
    ] = None
    sensor: Annotated[Text | None, about("its sensor's name; by default all have it", "roof")] = (
        None
    )
    transmission: Annotated[
        UnitShare | None, about("of dirt: share of the energy that passes it, out and back", 0.3)
    ] = None
    azimuth_deg: Annotated[
        Two[AngleDeg] | None,
        about("of dirt: from one azimuth counter-clockwise to another; by default all", [-20, 20]),
    ] = None
    elevation_deg: Annotated[
        Two[AngleDeg] | None, about("of dirt: lowest and highest; by default all", [-90, 0])
    ] = None
    channels: Annotated[
        Several[ChannelNumber] | None, about("dead channels, the lowest is 0", [3, 17])
    ] = None
    share: Annotated[UnitShare | None, about("of packets: share that is lost", 0.05)] = None
    packet: Annotated[
        int | None, about("of packets: consecutive firings in each", 12, ge=1, le=1_000_000)
    ] = None
    by_s: Annotated[
        float | None, about("of a time jump: added to stamps, seconds", -0.05, ge=-1e6, le=1e6)
    ] = None

    def __post_init__(self) -> None:
        needed, further = _OWN[self.kind]
        given = set(self.words()) - {"kind", "from_s", "to_s", "sensor"}
        if lacking := [name for name in needed if name not in given]:
            raise LidarpoolError(f"{self.kind} needs {lacking[0]}: give it.")
        if extra := sorted(given.difference(needed, further)):
            owner = next(kind for kind, both in _OWN.items() if extra[0] in sum(both, ()))
            raise LidarpoolError(f"{extra[0]} is for {owner}, and this is {self.kind}.")
        if self.to_s is not None and self.to_s <= self.from_s:
            raise LidarpoolError(
                f"to_s is {self.to_s:g} and from_s {self.from_s:g}: a fault ends after it begins."
            )
        low, high = self.elevation_deg or (0, 0)
        if low > high:
            raise LidarpoolError(f"elevation_deg is {[low, high]}: give the lowest first.")
        for name in ("azimuth_deg", "elevation_deg", "channels"):
            if getattr(self, name) is not None:  # of JSON and YAML, lists
                object.__setattr__(self, name, tuple(getattr(self, name)))

    def words(self) -> dict[str, Any]:
        """Return what is given, for JSON and labels: {field: value}."""
        both = ((one.name, getattr(self, one.name)) for one in fields(self))
        return {name: value for name, value in both if value is not None}

    def is_of(self, sensor: str) -> bool:
        """Whether a sensor has it."""
        return self.sensor in (None, sensor)

    def during(self, times_ns: Floats | Ints, ends_ns: Floats | Ints | None = None) -> Bools:
        """Whether there is a fault at times, or between them and others: (n,)."""
        last = times_ns if ends_ns is None else ends_ns
        until = np.inf if self.to_s is None else self.to_s * 1e9
        return np.asarray((last >= self.from_s * 1e9) & (times_ns < until))

    def jump_ns(self, time_ns: Any) -> Any:
        """By how much it shifts stamps at times, nanoseconds: a whole number, or (n,)."""
        return np.where(self.during(time_ns), round((self.by_s or 0.0) * 1e9), 0)[()]

    def covers(self, azimuth_deg: Floats, elevation_deg: Floats) -> Bools:
        """Whether dirt is where beams (n,) pass the window, by their angles in sensor axes."""
        covered = np.ones(len(azimuth_deg), np.bool_)
        if self.azimuth_deg is not None:
            begin, end = self.azimuth_deg
            covered &= (azimuth_deg - begin) % 360 <= (end - begin) % 360
        if self.elevation_deg is not None:
            low, high = self.elevation_deg
            covered &= (elevation_deg >= low) & (elevation_deg <= high)
        return covered


def faults_of(survey: Survey, number: int, *kinds: FaultKind) -> list[tuple[int, Fault]]:
    """Faults of some kinds that a sensor has, and their places in the survey's list."""
    name = survey.carried[number].name
    numbered = enumerate(survey.faults)
    return [(k, one) for k, one in numbered if one.kind in kinds and one.is_of(name)]


def check_faults(survey: Survey) -> None:
    """Check that faults are of sensors and channels that are there; LidarpoolError if not."""
    names = [carried.name for carried in survey.carried]
    for number, fault in enumerate(survey.faults):
        with prefixed(f"faults[{number}]"):
            if fault.sensor is not None and fault.sensor not in names:
                hint = did_you_mean(fault.sensor, names) or f" There are {', '.join(names[:10])}."
                one = "The only sensor has no name: leave sensor out." if names == [""] else hint
                raise LidarpoolError(f"there is no sensor {fault.sensor!r}. {one.strip()}")
            for carried in survey.carried:
                last, model = carried.sensor.channels - 1, carried.name or carried.sensor.model
                if fault.is_of(carried.name) and max(fault.channels or [0]) > last:
                    raise LidarpoolError(
                        f"there is no channel {max(fault.channels or [0])}: {model} has 0 to {last}."
                    )
                begins_s = (carried.sensor.sweeps(1)[1][0]) / 1e9
                if (
                    fault.is_of(carried.name)
                    and fault.kind == "frozen"
                    and fault.from_s <= begins_s
                ):
                    raise LidarpoolError(
                        f"from_s is {fault.from_s:g}, and a frozen sensor repeats the sweep before: "
                        f"the first begins at {begins_s:g} s, so give a later time."
                    )


def check_within(survey: Survey) -> None:
    """Check that faults begin within a survey; LidarpoolError if not."""
    lasts_s = survey.duration_ns / 1e9
    for number, fault in enumerate(survey.faults):
        if fault.from_s > lasts_s:
            raise LidarpoolError(
                f"faults[{number}] begins at {fault.from_s:g} s, and the survey lasts "
                f"{lasts_s:.6g} s: make from_s smaller, or steps more."
            )


def shown_from(survey: Survey, number: int) -> Ints:
    """First scans of what a sensor sends as each sweep, counted from its own first: (k,)."""
    firsts, _, _ = survey.sweeps_each[number]
    found = firsts[:-1]
    if faults_of(survey, number, "frozen"):
        found = np.array([one.scan + one.ahead for one in (sent(survey, int(k)) for k in found)])
    return np.asarray(found - firsts[0])


def sent(survey: Survey, index: int) -> ScanSpec:
    """Describe what a sensor sends as a scan: the scan itself, or if it is frozen, an older one.

    A sweep that begins while a sensor is frozen repeats the last one that began before. Which that
    is follows from the times alone, so it does not matter which scans were cast.
    """
    spec = survey.scan(index)
    frozen = [fault for _, fault in faults_of(survey, spec.sensor, "frozen")]
    if not frozen:
        return spec
    firsts, begins, _ = survey.sweeps_each[spec.sensor]
    own = source = int(np.searchsorted(firsts, index, "right")) - 1
    while now := [fault for fault in frozen if fault.during(begins[source])]:
        source = int(np.searchsorted(begins, now[0].from_s * 1e9)) - 1
    if source == own:
        return spec
    # The last sweep at a pose may have fewer scans than the one that repeats it: the others are
    # lost, see `LossStep`.
    older = int(min(firsts[source] + index - firsts[own], firsts[source + 1] - 1))
    repeats = int(firsts[source]), int(firsts[own])
    return replace(survey.scan(older), scan=index, ahead=older - index, repeats=repeats)
