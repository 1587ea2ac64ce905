"""The modules of effects by name."""

from __future__ import annotations

import pkgutil
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Protocol, cast

from docs.pictures import effects

from lidarpool import Survey


class Effect(Protocol):
    """A module of an effect.

    A module may also have `with_actors(scene)`, which returns the scene with moving objects, for
    runs with and without the effect.
    """

    DRAWS: str  # file name of the picture

    def with_effect(self, survey: Survey) -> Survey:
        """Return the survey with the effect."""

    def picture(self, path: Path) -> None:
        """Draw the effect."""


def load_effects(only: Sequence[str] = ()) -> dict[str, Effect]:
    """Import the modules of the named effects, by default all effects; return modules by name."""
    names = [module.name for module in pkgutil.iter_modules(effects.__path__)]
    return {
        name: cast(Effect, import_module(f"{effects.__name__}.{name}"))
        for name in names
        if not name.startswith("_") and (not only or name in only)
    }
