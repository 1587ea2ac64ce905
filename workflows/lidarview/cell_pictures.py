"""Draw the small plots that notebooks show for scenes, sensors, surveys, and clouds.

`lidarview/__init__.py` registers each ``draw_CLASS`` function of this module by its name.
"""

from __future__ import annotations

import io
from dataclasses import replace
from itertools import product

import numpy as np
from matplotlib.colors import Normalize
from PIL import Image

from lidarfiles.picture_file import SensorPositions, sensor_positions
from lidarsim.columns.cloud import CloudLike
from lidarsim.columns.table import Z
from lidarsim.environment.notebook import PICTURE_SIZE
from lidarsim.numerics.arrays import Floats, Floats32
from lidarsim.scene.scene import Scene
from lidarsim.scene.simplified import SimplifiedScene, cut_masks, simplify_scene
from lidarsim.sensor import Sensor
from lidarsim.survey.survey import Survey
from lidarsim.words import plural

from .render import theme
from .render.beam_picture import beam_page
from .render.camera import fit_camera
from .render.coloring import make_coloring
from .render.picture_page import Page
from .render.pictures import draw_discs
from .render.pictures import draw_scene as draw_objects
from .render.shot import take_shot
from .render.stage import PlotBox

MAX_BYTES = 60_000  # maximum size of a picture, because notebooks store every picture
MAX_POINTS = 60_000
MAX_TRIANGLES = 200_000
_PALETTES = (128, 32)  # numbers of colors to try until a picture is small enough
_CHART = (0.09, 0.115, 0.72, 0.735)  # left, bottom, width, height on the page
_BOX = (0.06, 0.2, 0.82, 0.94)  # left, top, right, bottom of the points on the page
_SPREAD = (1, 99)  # percentiles of the positions that the picture shows


def compress_png(png: bytes) -> bytes:
    """Reduce a PNG to at most `MAX_BYTES`.

    The number of colors is reduced first, and then the size is halved. An image of noise may still
    be too large. In that case, the smallest version is returned.
    """
    image = Image.open(io.BytesIO(png)).convert("RGB")
    half = image.resize((image.width // 2, image.height // 2), Image.Resampling.BOX)
    for candidate, colors in product((image, half), _PALETTES):
        file = io.BytesIO()
        candidate.quantize(colors, dither=Image.Dither.NONE).save(file, "PNG", optimize=True)
        if file.tell() <= MAX_BYTES:
            break
    return file.getvalue()


def draw_scene(scene: Scene) -> bytes:
    """Draw a scene at time 0, with one color per object."""
    drawn = SimplifiedScene.from_scene(cut_masks(scene)).scene
    if len(drawn.faces) > MAX_TRIANGLES:
        drawn, _ = simplify_scene(drawn, MAX_TRIANGLES)
    sides = " × ".join(f"{side:,.1f}" for side in np.ptp(scene.bounds, axis=0))
    shot = take_shot(
        replace(drawn, actors=scene.actors).solid(0.0),
        np.empty((0, 3)),
        actors=len(scene.actors),
        caption=f"{sides} m",
        size=PICTURE_SIZE,
    )
    return compress_png(draw_objects(shot, scene.triangles).png())


def draw_sensor(sensor: Sensor) -> bytes:
    """Draw the directions of a sensor's first rays, colored by time."""
    return compress_png(beam_page(sensor, PICTURE_SIZE).png())


def draw_survey(survey: Survey) -> bytes:
    """Draw a survey's sensor positions from above, with arrows along the sensors' x axes."""
    page = Page(PICTURE_SIZE)
    sensors = sensor_positions(survey)
    limits = _around(np.concatenate([sensor.positions for sensor in sensors])[:, :2])
    axes = page.map_chart(_CHART, limits, tick_count=5)
    colors = theme.object_colors(len(sensors))
    for sensor, color in zip(sensors, colors, strict=True):
        x, y, _ = sensor.positions.T
        axes.plot(x, y, "-" if sensor.moves else "o", color=color, lw=1.6, ms=4)
        axes.plot(x[0], y[0], "o", color=color, ms=5)
    headings = _headings(survey)
    axes.quiver(*headings.T, color=theme.MUTED, width=0.003, scale=24, zorder=3)
    names = [sensor.name or sensor.model or "sensor" for sensor in sensors]
    page.legend([*zip(names, colors, strict=True)], "")
    rays = f"{plural(survey.scan_count, 'scan')} · {plural(survey.ray_count, 'ray')}"
    page.title("Survey from above", f"{_positions_in_words(sensors)} · {rays}")
    return compress_png(page.png())


def _headings(survey: Survey, count: int = 24) -> Floats:
    """Sample `count` poses of the first sensor.

    Returns an array of shape (k, 4) with the columns x, y, dx, and dy, where (dx, dy) is the
    horizontal direction of the sensor's x axis.
    """
    last = survey.steps_each[0] * survey.path.stations - 1
    scans = np.unique(np.linspace(0, last, count).astype(int)).tolist()
    poses = [survey.pose(scan) for scan in scans]
    return np.array([(*pose.position[:2], *pose.rotation_matrix[:2, 0]) for pose in poses])


def _around(points: Floats) -> Floats:
    """Return chart limits around points, with the aspect ratio of the chart.

    `points` has shape (n, 2). The result has shape (2, 2) and contains the lower and the upper
    corner.
    """
    lower = points.min(axis=0)
    upper = points.max(axis=0)
    sides = np.array(_CHART[2:]) * PICTURE_SIZE
    half = sides * (np.maximum(upper - lower, 1.0) / sides).max() * 0.6
    middle = (lower + upper) / 2
    return np.stack([middle - half, middle + half])


def _positions_in_words(sensors: list[SensorPositions]) -> str:
    """Describe the number of positions, or the length of a moving sensor's trajectory."""
    if not sensors[0].moves:
        return plural(sum(len(sensor.positions) for sensor in sensors), "position")
    steps = np.diff(sensors[0].positions, axis=0)
    return f"trajectory of {np.linalg.norm(steps, axis=1).sum():,.1f} m"


def draw_cloud(cloud: CloudLike) -> bytes | None:
    """Draw a cloud colored by height, or return None if the cloud is empty.

    A cloud with more than `MAX_POINTS` points is thinned out evenly.
    """
    total = len(cloud)
    positions = _sampled(cloud, -(-total // MAX_POINTS) or 1)
    if not len(positions):
        return None
    box = np.percentile(positions, _SPREAD, axis=0)
    positions = positions[((positions >= box[0]) & (positions <= box[1])).all(axis=1)]
    page = Page(PICTURE_SIZE)
    if len(positions):
        coloring = make_coloring(positions[:, 2], Z)
        image = _image_of(positions, coloring.paint(positions[:, 2]), box)
        page.figure.figimage(image, zorder=-1)
        page.color_bar(coloring.scale, Normalize(*coloring.limits or (0, 1)), "z (m)")
    sides = " × ".join(f"{side:,.1f}" for side in np.ptp(cloud.bounds, axis=0))
    page.title("Point cloud by height", f"{plural(total, 'point')} · {sides} m")
    return compress_png(page.png())


draw_storedcloud = draw_cloud


def _sampled(cloud: CloudLike, step: int) -> Floats:
    pieces = [np.zeros((0, 3))]
    first = 0
    for piece in cloud.chunks():
        pieces.append(piece.positions[-first % step :: step].astype(np.float64))
        first += len(piece)
    return np.concatenate(pieces)


def _image_of(positions: Floats, colors: Floats, box: Floats) -> Floats32:
    """Render points as an RGBA image, viewed obliquely from above.

    `positions` has shape (n, 3), `colors` (n, 3), and `box` (2, 3). The image has shape
    (height, width, 4).
    """
    origin = np.round(box.mean(axis=0))
    stage = PlotBox.from_bounds(box - origin, origin)
    is_wide = np.ptp(stage.ground[:, 0]) >= np.ptp(stage.ground[:, 1])
    camera = fit_camera(stage.corners, PICTURE_SIZE, _BOX, -62.0 if is_wide else -28.0, 40.0)
    pixels, distance = camera.project(positions - origin)
    order = np.argsort(-distance)
    opaque = np.ones((len(positions), 4), np.float32)
    opaque[:, :3] = colors
    width, height = PICTURE_SIZE
    radius = float(np.clip(180 / np.sqrt(len(positions)), 1.5, 5.0))
    empty = np.zeros((height, width, 4), np.float32)
    return draw_discs(empty, pixels[order], opaque[order], radius)
