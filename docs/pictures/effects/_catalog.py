"""Registry of the effect modules."""

from __future__ import annotations

import pkgutil
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Protocol, cast

from docs.pictures import effects

from lidarpool import Survey


class Effect(Protocol):
    """Protocol of the effect modules.

    A module may also have a function `with_actors(scene)`. It returns the scene with moving
    objects, for runs with and without the effect.
    """

    DRAWS: str  # file name of the picture

    def with_effect(self, survey: Survey) -> Survey:
        """Return the survey with the effect."""

    def picture(self, path: Path) -> None:
        """Draw the effect."""


def load_effects(only: Sequence[str] = ()) -> dict[str, Effect]:
    """Import the modules of the named effects, or of all effects by default.

    The result maps names to modules.
    """
    names = [module.name for module in pkgutil.iter_modules(effects.__path__)]
    return {
        name: cast(Effect, import_module(f"{effects.__name__}.{name}"))
        for name in names
        if not name.startswith("_") and (not only or name in only)
    }
