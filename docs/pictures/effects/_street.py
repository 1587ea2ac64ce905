"""The survey on which the plots of effects are based."""

from __future__ import annotations

from lidarpool import Survey, load_sensor

SCANS = 36


def survey_without() -> Survey:
    """Return a survey of one OS1-64 revolution in a street, with all returns and intensities."""
    sensor = load_sensor("ouster/os1-64", max_range_m=120)
    return Survey(sensor, poses=[(0, 0, 2)], steps=SCANS, columns=["intensity", "range"])
