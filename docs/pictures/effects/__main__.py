"""Draw the plots of docs/effects.md: `python -m docs.pictures.effects [--only rain]`."""

from __future__ import annotations

from collections.abc import Sequence

from docs.pictures.effects._catalog import load_effects
from docs.pictures.options import IMAGES, folder_parser


def main(arguments: Sequence[str] | None = None) -> None:
    options = folder_parser(__doc__, IMAGES).parse_args(arguments)
    for name, effect in load_effects(options.only).items():
        path = options.folder / f"effect-{name.replace('_', '-')}.png"
        effect.picture().savefig(path, pil_kwargs={"optimize": True})


if __name__ == "__main__":
    main()
