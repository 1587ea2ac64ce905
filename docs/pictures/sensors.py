"""Draw the plots of docs/how-to/sensor-pictures.md: `python -m docs.pictures.sensors`."""

from __future__ import annotations

import argparse
import io
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from lidarsim import load_sensor
from lidarsim.schema.model_names import model_names
from lidarview.render.pattern_picture import pattern_page

IMAGES = Path(__file__).parents[1] / "images/sensors"
WIDTH = 800  # pixels
QUALITY = 50  # of WebP


def picture_name(model: str) -> str:
    """Return the file name of a model's plot."""
    return f"{model.replace('/', '-')}.webp"


def draw(model: str, path: Path) -> None:
    """Draw a small plot of a model's scan pattern."""
    image = Image.open(io.BytesIO(pattern_page(load_sensor(model)).png())).convert("RGB")
    height = round(image.height * WIDTH / image.width)
    small = image.resize((WIDTH, height), Image.Resampling.LANCZOS)
    small.save(path, "WEBP", quality=QUALITY, method=6)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=IMAGES)
    parser.add_argument("--only", nargs="*", default=model_names(), help="names of models")
    options = parser.parse_args(arguments)
    options.folder.mkdir(parents=True, exist_ok=True)
    for model in options.only:
        draw(model, options.folder / picture_name(model))


if __name__ == "__main__":
    main()
