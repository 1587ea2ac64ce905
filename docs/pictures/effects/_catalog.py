"""Lookup of effects by name."""

from __future__ import annotations

import pkgutil
from collections.abc import Sequence
from importlib import import_module
from typing import Protocol, cast

from docs.pictures import effects
from docs.pictures.effects._weather import WEATHER
from matplotlib.figure import Figure

from lidarpool import Survey


class Effect(Protocol):
    """Interface of an effect's module or object.

    An effect may also have `with_actors(scene)`, which returns the scene with moving objects. These
    are used for runs with and without the effect.
    """

    def with_effect(self, survey: Survey) -> Survey:
        """Return the survey with the effect."""

    def picture(self) -> Figure:
        """Draw the effect."""


def load_effects(only: Sequence[str] = ()) -> dict[str, Effect]:
    """Return the effects with the given names, or all effects if no names are given."""
    modules = [module.name for module in pkgutil.iter_modules(effects.__path__)]
    names = sorted({*WEATHER, *(name for name in modules if not name.startswith("_"))})
    return {
        name: WEATHER.get(name) or cast(Effect, import_module(f"{effects.__name__}.{name}"))
        for name in names
        if not only or name in only
    }
