"""Make an animation of a recorded drive next to the same drive in its reconstruction.

`python -m docs.pictures.twin OUT.webp` simulates an OS1-64 that drives through the generated city
among moving cars, and reconstructs the scene from its sweeps. The left side shows the recorded
sweeps. The right side shows sweeps of a Pandar128 in the twin, in which nothing moves. The program
prints the metrics of the twin.
"""

from __future__ import annotations

import numpy as np
from benchmarks.odometry import SWEEP_S, cloud_of, left_turn
from docs.pictures.film import aim, frame, save
from docs.pictures.options import file_parser
from PIL import Image, ImageDraw

from lidarpool import Actor, Mounted, Pose, Scanner, Survey, Track, load_sensor, twin
from lidarreal.reconstruction.twin import Twin
from lidarscenes.procedural.city import city
from lidarsim.columns.cloud import Cloud
from lidarsim.scene.actors import box

SIZE = (560, 420)  # of each half
EYE = np.array([-46.0, -34.0, 34.0])
TARGET = np.array([-6.0, 2.0, 0.0])
HEIGHT_M = 1.9  # of the sensor
TRIANGLES = 20_000
# Start and end of the cars that move.
CARS = (
    ((24, 3.0), (-34, 3.0)),
    ((-34, -3.0), (-4, -3.0)),
    ((3, -34), (3, -8)),
    ((-16, 3.2), (-60, 3.2)),
)
CAPTIONS = ("recorded: OS1-64", "in the twin: Pandar128")


def drive(sweeps: int) -> Cloud:
    """Simulate a drive through the city among cars, and return the recorded cloud."""
    end_s = (sweeps + 1) * SWEEP_S
    actors = [
        Actor(box(f"car {number}", (4.4, 1.8, 1.5)), Track([0, end_s], [(*start, 0), (*stop, 0)]))
        for number, (start, stop) in enumerate(CARS)
    ]
    scene = city(TRIANGLES).with_actors(actors)
    survey = Survey(
        sensors=[Mounted(load_sensor("ouster/os1-64"), Pose((0, 0, HEIGHT_M)))],
        trajectory=left_turn(end_s),
        steps=36 * sweeps,
        columns=["time", "intensity"],
        precision_m=1e-4,
    )
    return cloud_of(survey, scene)


def frames(cloud: Cloud, place: Twin, sweeps: int) -> list[Image.Image]:
    """Draw the recorded sweeps next to the sweeps of another sensor in the twin."""
    view = aim(EYE, TARGET, 470.0, SIZE)
    scanner = Scanner(place.scene, load_sensor("hesai/pandar128"))
    images = []
    for number in range(sweeps):
        recorded = cloud.positions[cloud["scan"] // 36 == number]
        simulated = scanner.sweep(
            Pose.from_rotation(place.poses[number, :3, 3], place.poses[number, :3, :3])
        ).positions
        image = Image.new("RGB", (2 * SIZE[0], SIZE[1]))
        for index, points in enumerate((recorded, simulated)):
            half = frame(view, points)
            ImageDraw.Draw(half).text((12, 10), CAPTIONS[index], fill=(235, 238, 242), font_size=17)
            image.paste(half, (index * SIZE[0], 0))
        images.append(image)
    return images


def main(arguments: list[str] | None = None) -> int:
    """Make the animation and return the exit status."""
    parser = file_parser(__doc__, ".webp")
    parser.add_argument("--sweeps", type=int, default=40)
    options = parser.parse_args(arguments)
    cloud = drive(options.sweeps)
    place = twin(cloud)
    print(repr(place))
    images = frames(cloud, place, options.sweeps)
    save(images, options.file, SWEEP_S, quality=35, method=4)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
