"""Draw the pictures of the guide to mounting positions.

`python -m docs.pictures.mounting` compares the mounts in the first vehicle file of the guide, and
writes the pictures of the report as PNG files.
"""

from __future__ import annotations

import io
import re

import yaml
from docs.pictures.options import IMAGES, folder_parser
from PIL import Image

from lidarscenario.mount_sections import VehicleFile
from lidarscenario.mounting.pictures import draw_all
from lidarscenario.mounting.study import MountStudy

GUIDE = IMAGES.parent / "how-to/mount.md"
SHOWN = ("blind", "comparison", "points", "detection")
_COLORS = 128


def main() -> None:
    """Write the pictures to a folder."""
    arguments = folder_parser(__doc__, IMAGES).parse_args()
    block = re.search(r'```yaml title="vehicle.yaml"\n(.*?)```', GUIDE.read_text("utf-8"), re.S)
    assert block is not None
    ranking = MountStudy.from_file(VehicleFile.from_data(yaml.safe_load(block[1]))).run()
    pages = draw_all(ranking)
    for name in arguments.only or SHOWN:
        picture = Image.open(io.BytesIO(pages[name].png())).convert("RGB")
        picture.quantize(_COLORS).save(arguments.folder / f"mount-{name}.png", optimize=True)


if __name__ == "__main__":
    main()
