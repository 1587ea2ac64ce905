"""Names and figures shared by scenario files, commands and functions; quick to import.

Help and completion of the command import no other module.
"""

from __future__ import annotations

BACKENDS = ("auto", "cuda", "embree", "numpy")
PICTURES = ("scene", "hits", "intensity", "cloud", "path")  # drawn pictures

# Metres in each unit.
UNITS_M = {
    "um": 1e-6,
    "mm": 1e-3,
    "cm": 1e-2,
    "dm": 1e-1,
    "m": 1.0,
    "km": 1e3,
    "in": 0.0254,
    "ft": 0.3048,
    "yd": 0.9144,
    "mi": 1609.344,
}

WAIT_S = 10.0  # wait for partitions that are empty at the start of a run
QUEUE_S = 3600.0  # for both waits, if workers are jobs in a queue
PATIENCE_S = 60.0  # wait for partitions that become empty; a nanny needs a few seconds
