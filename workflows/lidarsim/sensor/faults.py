"""Faults of sensors, to test what reads their data: which, of which sensor, and when."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ..base.arrays import Bools, Floats, Ints
from ..base.declared import AngleDeg, Ends, Several, Text, Two, UnitShare, about
from ..base.errors import LidarError, prefixed
from ..base.validation import checked_fields, without_numpy
from ..base.words import did_you_mean

if TYPE_CHECKING:
    from .survey import ScanSpec, Survey

FaultKind = Literal["dirt", "dead_channels", "dropped_packets", "frozen", "time_jump"]
Time = Annotated[float, Field(ge=0, le=1e9)]  # seconds since the survey's start
Channels = Annotated[Several[Annotated[int, Field(ge=0)]], Field(min_length=1)]
Count = Annotated[int, Field(ge=1, le=1_000_000)]
Shift = Annotated[float, Field(ge=-1e6, le=1e6)]

# {kind: its own fields}; sectors may be left out
_OWN: dict[str, tuple[str, ...]] = {
    "dirt": ("transmission", "azimuth_deg", "elevation_deg"),
    "dead_channels": ("channels",),
    "dropped_packets": ("share", "packet"),
    "frozen": (),
    "time_jump": ("by_s",),
}


@dataclass(frozen=True)
@checked_fields
class Fault:
    """A fault of a sensor for some time; labels keep the truth, and list it.

    Raises
    ------
    LidarError
        If a number is outside its range, or its fields do not fit together.
    """

    kind: Annotated[FaultKind, about("what happens")]
    from_s: Annotated[Time, about("when it begins, seconds since the survey's start")] = 0.0
    to_s: Annotated[Time | None, about("when it ends; by default with the survey")] = None
    sensor: Annotated[Text | None, about("its sensor's name; by default all have it")] = None
    transmission: Annotated[UnitShare | None, about("of dirt: of energy, out and back")] = None
    azimuth_deg: Annotated[Two[AngleDeg] | None, about("of dirt: counter-clockwise")] = None
    elevation_deg: Annotated[Ends[AngleDeg] | None, about("of dirt: lowest and highest")] = None
    channels: Annotated[Channels | None, about("dead ones; 0 is the lowest")] = None
    share: Annotated[UnitShare | None, about("of packets that are lost")] = None
    packet: Annotated[Count | None, about("consecutive firings in a packet")] = None
    by_s: Annotated[Shift | None, about("of a time jump: added to stamps, seconds")] = None

    def __post_init__(self) -> None:
        for name, value in self.words().items():  # labels have them as JSON
            listed = np.iterable(value) and not isinstance(value, str)
            object.__setattr__(self, name, without_numpy(tuple(value) if listed else value))
        own, given = _OWN[self.kind], self.words().keys() - {"kind", "from_s", "to_s", "sensor"}
        for name in sorted((given ^ {*own}) - {one for one in own if one.endswith("_deg")}):
            advice = f"leave {name} out" if name in given else f"give {name}"
            takes = f"takes {', '.join(own)}" if own else "has times only"
            raise LidarError(f"{self.kind} {takes}: {advice}.")
        if self.to_s is not None and self.to_s <= self.from_s:
            raise LidarError(f"to_s is {self.to_s:g}; give more than from_s, {self.from_s:g}.")

    def words(self) -> dict[str, Any]:
        """Return what is given, for labels: {field: value}."""
        return {name: value for name, value in vars(self).items() if value is not None}

    @property
    def span_ns(self) -> tuple[float, float]:
        """When it begins and ends, nanoseconds since the survey's start."""
        return self.from_s * 1e9, inf if self.to_s is None else self.to_s * 1e9

    def during(self, begins_ns: Floats | Ints, ends_ns: Floats | Ints | None = None) -> Bools:
        """Whether it is there at times (n,), or between them and others."""
        ends_ns = begins_ns if ends_ns is None else ends_ns
        begin, end = self.span_ns
        return np.asarray((ends_ns >= begin) & (begins_ns < end))

    def jumps_ns(self, times_ns: Floats | Ints) -> Ints:
        """By how much it shifts stamps at times (n,), nanoseconds."""
        return self.during(times_ns) * np.int64(round((self.by_s or 0) * 1e9))


def faults_of(survey: Survey, number: int, *kinds: FaultKind) -> dict[int, Fault]:
    """Faults of some kinds that a sensor has, by their places in the survey's list."""
    name, every = survey.carried[number].name, enumerate(survey.faults)
    return {place: one for place, one in every if one.kind in kinds and one.sensor in (None, name)}


def check_faults(survey: Survey) -> None:
    """Check that faults fit sensors and times of a survey; LidarError if not."""
    names, lasts_s = [carried.name for carried in survey.carried], survey.duration_ns / 1e9
    for place, fault in enumerate(survey.faults):
        with prefixed(f"faults[{place}]"):
            lidars = [one.sensor for one in survey.carried if fault.sensor in (None, one.name)]
            if not lidars:
                known = f" There are {', '.join(names)}." if any(names) else " Leave it out."
                hint = did_you_mean(str(fault.sensor), names) or known
                raise LidarError(f"there is no sensor {fault.sensor!r}.{hint}")
            first_s = max(one.begins_ns(np.zeros(1, np.int64))[0] + one.lead_ns for one in lidars)
            if fault.kind == "frozen" and fault.from_s <= first_s / 1e9:
                raise LidarError("a frozen sensor repeats a sweep: give a later from_s.")
            if fault.from_s > lasts_s:
                told = f"from_s is {fault.from_s:g}, and the survey lasts {lasts_s:.6g} s"
                raise LidarError(f"{told}: make from_s smaller.")
            least, last = min(one.channels for one in lidars), max(fault.channels or (0,))
            if last >= least:
                raise LidarError(f"there is no channel {last}, but 0 to {least - 1}.")


def sent(survey: Survey, index: int) -> ScanSpec:
    """Describe what a sensor sends as a scan: the scan itself, or if it is frozen, an older one.

    A sweep that begins while it is frozen repeats the last that began before. Which that is follows
    from times alone, so it does not matter which scans are cast where.
    """
    spec = survey.scan(index)
    frozen = faults_of(survey, spec.sensor, "frozen").values()
    if not frozen:
        return spec
    firsts, begins, _ = survey.sweeps_each[spec.sensor]
    own = source = int(np.searchsorted(firsts, index, "right")) - 1
    while now := [fault for fault in frozen if fault.during(begins[source])]:
        source = int(np.searchsorted(begins, now[0].from_s * 1e9)) - 1
    if source == own:
        return spec
    # The last sweep at a pose may have fewer scans: then the others are lost, see `LossStep`.
    older = min(int(firsts[source] + index - firsts[own]), int(firsts[source + 1]) - 1)
    repeats = int(firsts[source]), int(firsts[own])
    return replace(survey.scan(older), scan=index, ahead=older - index, repeats=repeats)
