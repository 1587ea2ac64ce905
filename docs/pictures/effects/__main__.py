"""Draw the plots of docs/effects.md: `python -m docs.pictures.effects [--only rain]`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from docs.pictures.effects._catalog import load_effects

IMAGES = Path(__file__).parents[2] / "images"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default=IMAGES)
    parser.add_argument("--only", nargs="*", default=[], help="names of effects")
    options = parser.parse_args(arguments)
    for effect in load_effects(options.only).values():
        effect.picture(options.folder / effect.DRAWS)


if __name__ == "__main__":
    main()
