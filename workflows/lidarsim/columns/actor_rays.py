"""Ray counts and distances per actor and sweep, from which actor visibility is computed.

The workers that cast the rays compute the records of their scans. `merge_actor_rays` combines the
records of a survey. The result does not depend on how scans were grouped.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ..numerics.arrays import Records

# Fields of a record:
# - sweep: number of the sweep among the sweeps of all sensors
# - actor: number of the actor
# - rays: number of rays that would hit the actor if it were alone in the scene
# - visible: number of rays that hit the actor first
# - nearest_m: smallest distance in meters between a ray and the box of the actor at the start of
#   the sweep; 0 if a ray hits the actor or would hit it
# - truncated: fraction of the box that is outside the sensor's field of view or range
ACTOR_RAYS = np.dtype(
    [
        ("sweep", "<i4"),
        ("actor", "<i4"),
        ("rays", "<i8"),
        ("visible", "<i8"),
        ("nearest_m", "<f4"),
        ("truncated", "<f4"),
    ]
)
NO_ACTOR_RAYS = np.zeros(0, ACTOR_RAYS)


def merge_actor_rays(parts: Iterable[Records], actors: int, sweeps: int) -> Records:
    """Combine the records of all scans of a survey into a table.

    The table has shape (actors, sweeps). If an actor is absent during a sweep, `nearest_m` and
    `truncated` are NaN.
    """
    table = np.zeros((actors, sweeps), ACTOR_RAYS)
    table["actor"] = np.arange(actors)[:, None]
    table["sweep"] = np.arange(sweeps)
    table["nearest_m"] = np.nan
    table["truncated"] = np.nan
    for records in parts:
        index = records["actor"], records["sweep"]
        for name in ("rays", "visible"):
            np.add.at(table[name], index, records[name])
        np.fmin.at(table["nearest_m"], index, records["nearest_m"])
        table["truncated"][index] = records["truncated"]
    return table
