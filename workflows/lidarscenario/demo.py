"""Scenario of `lidarpool demo`."""

from __future__ import annotations

from typing import Any

from .scenario import Scenario

# examples/seed.yaml contains the same scenario.
_DATA: dict[str, Any] = {
    "scene": "seed",
    "poses": [[0, 0, 1], [0, 0, 2], [0, 0, 3]],
    "steps": 36,
    "cloud": {"keep_every": 5, "precision_m": 0.01},
    "planning": {"start": [25, 25], "target": [-30, -20], "trials": 100},
}


def demo_scenario() -> Scenario:
    """Return the scenario of `lidarpool demo`.

    The scene has six objects. The scenario simulates 108 scans from three poses, and plans a path.
    """
    return Scenario.from_data(_DATA, source="the demo")
