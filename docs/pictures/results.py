"""Draw the pictures of results that the documentation shows.

    python -m docs.pictures.results [FOLDER] [--only hits path]

The program runs the demo and the example scenarios in a temporary folder, as described on the pages
with the pictures.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from docs.pictures.options import IMAGES, folder_parser
from PIL import Image

EXAMPLES = IMAGES.parents[1] / "examples"


def lidarpool(folder: Path, *arguments: str) -> None:
    """Run a command in a folder."""
    subprocess.run([sys.executable, "-m", "lidarpool", *arguments], cwd=folder, check=True)


def plot(folder: Path, result: str, picture: str, *options: str) -> Path:
    """Draw a picture of a result, and return its path."""
    lidarpool(folder, "plot", result, "--only", picture, "--out", "drawn", *options)
    return folder / "drawn" / f"{picture}.png"


def draw_demo(folder: Path, picture: str) -> Path:
    """Draw a picture of the demo."""
    lidarpool(folder, "demo")
    return folder / "lidarpool-out" / f"{picture}.png"


def draw_drive(folder: Path, picture: str, *scene: str, cars: str = "car-*", size: str) -> Path:
    """Draw a picture of `drive.yaml` in a city with options of `lidarpool scene`.

    `cars` is the name of the parked cars in this city.
    """
    text = (EXAMPLES / "drive.yaml").read_text("utf-8")
    (folder / "drive.yaml").write_text(text.replace("car-*", cars), "utf-8")
    lidarpool(folder, "scene", "city", "city.glb", *scene)
    lidarpool(folder, "run", "drive.yaml", "--out", "drive")
    return plot(folder, "drive", picture, "--size", size)


def draw_road(folder: Path, color: str) -> Path:
    """Draw the points of `road.yaml`."""
    for name in ("road.yaml", "road.glb"):
        shutil.copy(EXAMPLES / name, folder)
    lidarpool(folder, "run", "road.yaml", "--out", "road")
    return plot(folder, "road", "cloud", "--color", color, "--size", "1200x750")


PICTURES: dict[str, Callable[[Path], Path]] = {
    "hits": lambda folder: draw_demo(folder, "hits"),
    "path": lambda folder: draw_demo(folder, "path"),
    "crossing": lambda folder: draw_drive(folder, "cloud", size="1280x800"),
    "trees": lambda folder: draw_drive(
        folder, "scene", "--trees", "500", "--cars", "200", cars="Estate*", size="1120x700"
    ),
    "road": lambda folder: draw_road(folder, "reflectance"),
    "road-colors": lambda folder: draw_road(folder, "rgb"),
}


def main() -> None:
    """Write the pictures to a folder."""
    arguments = folder_parser(__doc__, IMAGES).parse_args()
    for name in arguments.only or PICTURES:
        with TemporaryDirectory() as folder:
            picture = Image.open(PICTURES[name](Path(folder))).convert("RGB")
        picture.save(arguments.folder / f"{name}.png", optimize=True)


if __name__ == "__main__":
    main()
