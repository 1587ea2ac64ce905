"""Draw a recorded sweep with simulated weather and inserted cars.

`python -m docs.pictures.augmentation OUT.png` simulates a sweep of an OS1-64 in the generated city,
augments it with rain, fog, snow, lost packets and cars, and draws the results next to each other.
Recorded points are colored by height, returns from the air are white, and inserted cars are orange.
"""

from __future__ import annotations

import numpy as np
from docs.pictures.film import BACK, RAISED, aim
from docs.pictures.options import file_parser
from PIL import Image, ImageDraw

from lidarfiles.clouds.recording import RecordingInfo, SweepsInMemory
from lidarfiles.color_table import TURBO
from lidarpool import Fault, Pose, Scanner, load_sensor
from lidarreal.augmentation.augmented_sweep import AugmentedSweep
from lidarreal.augmentation.augmenter import Augmenter
from lidarreal.augmentation.effects import Effects, Insertion
from lidarscenes.procedural.city import city
from lidarsim.columns.sweep import Sweep
from lidarsim.columns.table import CAUSES
from lidarsim.media.weather import Weather
from lidarsim.scene.actors import box
from lidarview.render.camera import Camera
from lidarview.render.pictures import draw_discs

SIZE = (420, 360)
HEIGHT_M = 1.9  # height of the sensor
EYE = np.array([-26.0, -17.0, 22.0 - HEIGHT_M])
TARGET = np.array([6.0, 1.0, -HEIGHT_M])
WHITE = (1.0, 1.0, 1.0)
ORANGE = (1.0, 0.6, 0.1)
CAR = (4.5, 1.8, 1.5)
PANELS = {
    "recorded": Effects(),
    "rain, 25 mm/h": Effects(weather=Weather(rain_mm_h=25.0)),
    "fog, visibility 60 m": Effects(weather=Weather(visibility_km=0.06)),
    "snow, 1 mm/h": Effects(weather=Weather(snow_mm_h=1.0)),
    "20 % of the packets lost": Effects(faults=(Fault("dropped_packets", share=0.2, packet=16),)),
    "two inserted cars": Effects(
        insertions=(
            Insertion(box("first", CAR), 8.0, -3.0),
            Insertion(box("second", CAR), 5.0, 3.2, heading_deg=180.0),
        )
    ),
}


def augmenters() -> list[Augmenter]:
    """Simulate a recording of one sweep, and return an augmenter for each panel."""
    model = load_sensor("ouster/os1-64", performance="datasheet")
    scanner = Scanner(city(20_000), model, columns=["intensity"], coordinates="sensor")
    cloud = scanner.sweep(Pose((-6.0, -3.0, HEIGHT_M)))
    columns = {name: cloud[name] for name in ("channel", "intensity")}
    sweep = Sweep(np.asarray(cloud.positions, np.float64), columns)
    recording = SweepsInMemory(RecordingInfo("drive", energy_unit=1.0), [sweep])
    return [Augmenter(recording, effects, model) for effects in PANELS.values()]


def draw(camera: Camera, augmented: AugmentedSweep) -> Image.Image:
    """Draw the points of a sweep."""
    points = augmented.sweep.points
    pixels, distance = camera.project(points)
    inside = np.flatnonzero(((pixels >= 0) & (pixels < camera.size)).all(axis=1))
    rows = inside[np.argsort(-distance[inside])]
    share = np.clip((points[rows, 2] + HEIGHT_M) / RAISED, 0, 1)
    paint = TURBO[(24 + 231 * np.sqrt(share)).astype(int)].copy()
    is_air = augmented.sweep.columns["cause"][rows] == CAUSES.index("air")
    paint[is_air] = WHITE
    paint[~is_air & ~augmented.is_recorded[rows]] = ORANGE
    paint = np.pad(paint, ((0, 0), (0, 1)), constant_values=1)
    empty = np.tile(BACK.astype(np.float32), (*camera.size[::-1], 1))
    image = draw_discs(empty, pixels[rows], paint, 1.6)
    return Image.fromarray(np.round(255 * image[..., :3]).astype(np.uint8))


def main(arguments: list[str] | None = None) -> int:
    """Draw the picture and return the exit status."""
    options = file_parser(__doc__, ".png").parse_args(arguments)
    camera = aim(EYE, TARGET, 400.0, SIZE)
    columns = 3
    lines = -(-len(PANELS) // columns)
    picture = Image.new("RGB", (columns * SIZE[0], lines * SIZE[1]), (14, 17, 22))
    for number, (title, augmenter) in enumerate(zip(PANELS, augmenters(), strict=True)):
        panel = draw(camera, augmenter.sweep(0))
        ImageDraw.Draw(panel).text((12, 10), title, fill=(235, 238, 242), font_size=17)
        line, column = divmod(number, columns)
        picture.paste(panel, (column * SIZE[0], line * SIZE[1]))
    picture.save(options.file)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
