"""Draw the plots of docs/how-to/sensor-pictures.md: `python -m docs.pictures.sensors`."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

from docs.pictures.options import IMAGES, folder_parser
from PIL import Image

from lidarsim import load_sensor
from lidarsim.schema.model_names import model_names
from lidarview.render.pattern_picture import pattern_page

WIDTH = 800  # pixels
QUALITY = 50  # of WebP


def draw(model: str, path: Path) -> None:
    """Draw the pattern of a sensor model in a small size."""
    image = Image.open(io.BytesIO(pattern_page(load_sensor(model)).png())).convert("RGB")
    height = round(image.height * WIDTH / image.width)
    small = image.resize((WIDTH, height), Image.Resampling.LANCZOS)
    small.save(path, "WEBP", quality=QUALITY, method=6)


def main(arguments: Sequence[str] | None = None) -> None:
    options = folder_parser(__doc__, IMAGES / "sensors").parse_args(arguments)
    options.folder.mkdir(parents=True, exist_ok=True)
    for model in options.only or model_names():
        draw(model, options.folder / f"{model.replace('/', '-')}.webp")


if __name__ == "__main__":
    main()
