"""Make an animation of sweeps with many effects that plays in real time.

    python -m docs.pictures.film OUT.webp

One core casts sweeps of an OS1-64 among moving cars with sub-rays, noise and rain (`real` in
`benchmarks.realism`), while another core draws them. The program prints the duration of the scan
and the time it took to make the animation.
"""

from __future__ import annotations

import time
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.realism import REVOLUTION_S, cases
from docs.pictures.options import file_parser
from PIL import Image

from lidarfiles.color_table import TURBO
from lidarscenes.procedural.city import city
from lidarview.render.camera import Camera
from lidarview.render.pictures import draw_discs
from lidarview.render.surface import normalize

SIZE = (720, 405)
BACK = np.array([14, 17, 22, 255]) / 255
EYE = np.array([-38.0, -30.0, 34.0])
TARGET = np.array([4.0, 4.0, 0.0])
RAISED = 12.0  # meters above the ground with the last color


def cast(sweeps: int, triangles: int, connection: Connection) -> None:
    """Cast one sweep to compile the code, then cast and send the points of `sweeps` sweeps."""
    sweep = cases(city(triangles), "tiles", (100,), "ouster/os1-64")["real"]
    connection.send(len(sweep(0)))
    connection.recv()
    for number in range(sweeps):
        connection.send_bytes(sweep(number).positions.astype(np.float32).tobytes())


def frame(camera: Camera, points: Any) -> Image.Image:
    """Draw the points of a sweep, colored by height."""
    pixels, distance = camera.project(points)
    inside = np.flatnonzero(((pixels >= 0) & (pixels < camera.size)).all(axis=1))
    rows = inside[np.argsort(-distance[inside])]
    share = np.clip(points[rows, 2] / RAISED, 0, 1)
    paint = np.pad(TURBO[(24 + 231 * np.sqrt(share)).astype(int)], ((0, 0), (0, 1)), mode="edge")
    paint[:, 3] = 1
    empty = np.tile(BACK.astype(np.float32), (*camera.size[::-1], 1))
    image = draw_discs(empty, pixels[rows], paint, 1.6)
    return Image.fromarray(np.round(255 * image[..., :3]).astype(np.uint8))


def aim(eye: Any, target: Any, focal: float, size: tuple[int, int]) -> Camera:
    """Return a level camera that looks at a target."""
    ahead = normalize((target - eye)[None])
    right = normalize(np.cross(ahead, [0.0, 0.0, 1.0]))
    axes = np.concatenate([right, np.cross(right, ahead), ahead])
    return Camera(eye, axes, focal, np.array(size) / 2, size)


def save(frames: list[Image.Image], path: Path, period_s: float, **options: Any) -> None:
    """Save frames as an animated WebP file, with additional options for Pillow."""
    duration = round(1e3 * period_s)
    later = frames[1:]
    frames[0].save(
        path, "webp", save_all=True, append_images=later, duration=duration, loop=0, **options
    )


def main(arguments: list[str] | None = None) -> int:
    """Make the animation and return the exit status."""
    parser = file_parser(__doc__, ".webp")
    parser.add_argument("--sweeps", type=int, default=100)
    parser.add_argument("--triangles", type=int, default=100_000)
    options = parser.parse_args(arguments)
    camera = aim(EYE, TARGET, 600.0, SIZE)
    context = get_context("spawn")
    parent_end, child_end = context.Pipe()
    caster = context.Process(
        target=cast, args=(options.sweeps, options.triangles, child_end), daemon=True
    )
    caster.start()
    parent_end.recv()
    start = time.perf_counter()
    frames = []
    parent_end.send("go")
    for _ in range(options.sweeps):
        points = np.frombuffer(parent_end.recv_bytes(), np.float32).reshape(-1, 3)
        frames.append(frame(camera, points.astype(np.float64)))
    cast_s = time.perf_counter() - start
    caster.join()
    save(frames, options.file, REVOLUTION_S, method=0)
    took = time.perf_counter() - start
    print(
        f"{options.sweeps * REVOLUTION_S:.1f} s of scanning: cast and drawn in {cast_s:.1f} s, "
        f"written after {took:.1f} s"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
