"""A film of a recorded drive and of the same drive with another sensor in a digital twin.

`python -m docs.pictures.twin OUT.webp` drives an OS1-64 through the generated city among moving
cars, and reconstructs the scene from its sweeps. The left half shows the recorded sweeps. The right
half shows sweeps of a Pandar128 in the twin, where nothing moves. The module prints statistics of
the twin.
"""

from __future__ import annotations

import argparse
import io
from dataclasses import replace
from pathlib import Path

import numpy as np
from benchmarks.odometry import SWEEP_S, left_turn
from docs.pictures.film import frame
from PIL import Image, ImageDraw

from lidarpool import Actor, Mounted, Pose, Scanner, Survey, Track, load_sensor, twin
from lidarpool.reconstruction.building import Twin
from lidarscenes.procedural.city import city
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.table import SCAN
from lidarsim.scene.actors import box
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.sweeps import Sweeps
from lidarview.render.camera import Camera
from lidarview.render.surface import normalize

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
    """Simulate a drive through the city among moving cars, and return the recorded cloud."""
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
    part = columns_of(list(Rig(scene, survey, "auto").cast(0, survey.scan_count)))
    cloud = part.cloud((SCAN, *survey.stored_columns[3:]), survey.precision_m, scene.origin)
    sweeps_of_survey = Sweeps.from_survey(survey, scene)
    return replace(cloud, sweeps=lambda: sweeps_of_survey)


def camera() -> Camera:
    """Return the camera that both halves share."""
    ahead = normalize((TARGET - EYE)[None])
    right = normalize(np.cross(ahead, [0.0, 0.0, 1.0]))
    axes = np.concatenate([right, np.cross(right, ahead), ahead])
    return Camera(EYE, axes, 470.0, np.array(SIZE) / 2, SIZE)


def frames(cloud: Cloud, place: Twin, sweeps: int) -> list[Image.Image]:
    """Draw the recorded sweeps beside sweeps of another sensor in the twin."""
    view = camera()
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
    """Make the film and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("film", type=Path, help="a .webp file")
    parser.add_argument("--sweeps", type=int, default=40)
    options = parser.parse_args(arguments)
    cloud = drive(options.sweeps)
    place = twin(cloud)
    print(repr(place))
    images = frames(cloud, place, options.sweeps)
    images[0].save(
        memory := io.BytesIO(),
        "webp",
        save_all=True,
        append_images=images[1:],
        duration=round(1e3 * SWEEP_S),
        loop=0,
        quality=35,
        method=4,
    )
    options.film.write_bytes(memory.getvalue())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
