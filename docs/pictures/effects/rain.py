"""Rain that returns light."""

from __future__ import annotations

from pathlib import Path

from docs.pictures.effects import _air

from lidarpool import Survey

DRAWS = "effect-rain.png"
WEATHER = {"rain_mm_h": 50.0}


def with_effect(survey: Survey) -> Survey:
    return _air.in_weather(survey, **WEATHER)


def picture(path: Path) -> None:
    """Plot a street in rain, and the number of returns against range."""
    figure, right = _air.page("50 mm/h of rain", WEATHER, 12.0)
    _air.counts(right, WEATHER, 6.0)
    _air.save(figure, path)
