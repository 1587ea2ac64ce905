"""An augmented sweep, and how its points relate to the points of the recorded sweep."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lidarfiles.clouds.boxes import SweepBoxes
from lidarsim.columns.sweep import Sweep
from lidarsim.numerics.arrays import Bools, Floats, Ints


def _no_boxes() -> SweepBoxes:
    empty = np.zeros((0, 3))
    return SweepBoxes(
        (), (), np.zeros(0, np.int32), empty, np.zeros((0, 4)), empty, np.zeros(0, np.int64)
    )


@dataclass(frozen=True, eq=False)
class AugmentedSweep:
    """Points of a recorded sweep after simulation steps have been applied to its pulses.

    Attributes
    ----------
    sweep
        The n augmented points in the frame of the recorded sweep, in meters, sorted by template.
        Columns have standard names. All columns of the recording are present. `cause` (uint8, an
        index into `lidarsim.columns.table.CAUSES`) is added. `object` numbers of inserted objects
        follow those of the recording.
    template
        (n,): row of the recorded sweep from which a point takes all values that the simulation does
        not compute. For a recorded return, this is its own row. For an added return, it is the
        nearest recorded point of the same ring.
    is_recorded
        (n,): whether a point is a recorded return. Its position and intensity may have changed.
    boxes
        Bounding boxes of the inserted objects in the sensor frame, with the number of their points.
    visibility
        (k,): fraction of the pulses that hit the object k alone and that also return from it in the
        augmented sweep, from 0 to 1.
    """

    sweep: Sweep
    template: Ints
    is_recorded: Bools
    boxes: SweepBoxes = field(default_factory=_no_boxes)
    visibility: Floats = field(default_factory=lambda: np.zeros(0))
