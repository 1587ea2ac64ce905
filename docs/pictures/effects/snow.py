"""Snow that returns light."""

from __future__ import annotations

from pathlib import Path

from docs.pictures.effects import _air

from lidarpool import Survey

DRAWS = "effect-snow.png"
WEATHER = {"snow_mm_h": 1.0}


def with_effect(survey: Survey) -> Survey:
    return _air.in_weather(survey, **WEATHER)


def picture(path: Path) -> None:
    """Plot a street in snow, and the number of returns against range."""
    figure, right = _air.page("1 mm/h of snow", WEATHER, 20.0)
    _air.counts(right, WEATHER, 16.0)
    _air.save(figure, path)
