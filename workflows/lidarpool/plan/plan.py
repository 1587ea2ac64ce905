"""The plan: the best of the trials, checked."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from ..base.errors import LidarpoolError
from .geometry import Floats, clearance, path_length
from .planning import Planning
from .tangents import shortest_path_length
from .trial import Trial, with_ends


@dataclass(frozen=True, eq=False)
class Plan:
    """The best path found.

    Parameters
    ----------
    path
        Corners of the path from start to target, both included, in metres: (k + 2, 2).
    length
        Its length in metres.
    shortest_possible
        Length in metres of the shortest path, computed from the discs' tangents; inf if discs cut
        off the target.
    clearance
        Least distance in metres from the path to a disc; negative if it enters one, inf without
        discs.
    trial
        Number of the trial that found the path.
    trials
        Number of trials.
    """

    path: Floats
    length: float
    shortest_possible: float
    clearance: float
    trial: int
    trials: int

    @property
    def collision_free(self) -> bool:
        """Whether the path enters no disc."""
        return self.clearance >= 0

    @property
    def excess(self) -> float:
        """Share by which the path is longer than the shortest possible: 0.01 is 1%."""
        return self.length / self.shortest_possible - 1


def best(trials: Iterable[Trial], planning: Planning) -> Plan:
    """Choose the best path of `trials`: the shortest of those that enter no disc.

    Each path is checked again, segment by segment against each disc. If none is free of
    collisions, the one that enters discs least is chosen, with `collision_free` False. The order
    of `trials` does not matter; of equal ones the lowest number wins.

    Raises
    ------
    LidarpoolError
        If there are no trials.
    """
    candidates = []
    for trial in trials:
        path = with_ends(planning, trial.waypoints)
        room = clearance(path, planning.centres, planning.radii)
        candidates.append((max(0.0, -room), path_length(path), trial.trial, room, path))
    if not candidates:
        raise LidarpoolError("No planning trial was finished, so there is no best path.")
    _, length, number, room, path = min(candidates, key=lambda candidate: candidate[:3])
    return Plan(
        path=path,
        length=length,
        shortest_possible=shortest_path_length(
            planning.start, planning.target, planning.centres, planning.radii
        ),
        clearance=room,
        trial=number,
        trials=len(candidates),
    )
