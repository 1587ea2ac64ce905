"""A planning trial as JSON, to the bit: a float is written with the digits that identify it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..plan import Trial


def trial_to_json(trial: Trial) -> bytes:
    """JSON of a trial."""
    data = {
        "trial": trial.trial,
        "seed": trial.seed,
        "length": trial.length,
        "waypoints": trial.waypoints.tolist(),
        "collision_free": trial.collision_free,
        "history": trial.history.tolist(),
        "seconds": trial.seconds,
    }
    return json.dumps(data).encode()


def trial_from_json(data: bytes | bytearray) -> Trial:
    """Inverse of `trial_to_json`.

    Raises
    ------
    KeyError, TypeError, ValueError
        If it is not that.
    """
    found: Mapping[str, Any] = json.loads(data)
    return Trial(
        trial=int(found["trial"]),
        seed=int(found["seed"]),
        length=float(found["length"]),
        waypoints=np.array(found["waypoints"], np.float64).reshape(-1, 2),
        collision_free=bool(found["collision_free"]),
        history=np.array(found["history"], np.float32),
        seconds=float(found["seconds"]),
    )
