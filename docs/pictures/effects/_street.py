"""The survey that pictures of effects start from."""

from __future__ import annotations

from lidarpool import Survey, load_sensor

SCANS = 36


def survey_without() -> Survey:
    """Return a turn of an OS1-64 in a street, every return kept, with intensities."""
    sensor = load_sensor("ouster/os1-64", max_range_m=120)
    return Survey(sensor, poses=[(0, 0, 2)], steps=SCANS, columns=["intensity", "range"])
