"""Dust that returns light."""

from __future__ import annotations

from pathlib import Path

from docs.pictures.effects import _air

from lidarpool import Survey

DRAWS = "effect-dust.png"
WEATHER = {"dust_mg_m3": 100.0}


def with_effect(survey: Survey) -> Survey:
    return _air.in_weather(survey, **WEATHER)


def picture(path: Path) -> None:
    """Plot a street in dust, and the received energies against range."""
    figure, right = _air.page("100 mg/m³ of dust", WEATHER, 25.0)
    _air.energies(right, WEATHER)
    _air.save(figure, path)
