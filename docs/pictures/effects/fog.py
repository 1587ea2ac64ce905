"""Fog that returns light."""

from __future__ import annotations

from pathlib import Path

from docs.pictures.effects import _air

from lidarpool import Survey

DRAWS = "effect-fog.png"
WEATHER = {"visibility_km": 0.05}


def with_effect(survey: Survey) -> Survey:
    return _air.in_weather(survey, **WEATHER)


def picture(path: Path) -> None:
    """Plot a street in fog, and the received energies against range."""
    figure, right = _air.page("fog, 50 m of visibility", WEATHER, 25.0)
    _air.energies(right, WEATHER)
    _air.save(figure, path)
