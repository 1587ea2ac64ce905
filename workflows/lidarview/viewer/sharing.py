"""Export a view as a single file to share.

The file is a film or a page that needs no server.
"""

from __future__ import annotations

import base64
import hashlib
import io
import re
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from importlib.resources import files
from importlib.resources.abc import Traversable
from itertools import pairwise, repeat
from pathlib import Path
from typing import Any

import click
import numpy as np
from PIL import Image

from lidarfiles.color_table import TURBO
from lidarfiles.picture_file import SensorPositions
from lidarsim.errors import LidarError, explain_os_errors
from lidarsim.io.storage import replace_file
from lidarsim.io.writing_progress import WritingProgress
from lidarsim.numerics.arrays import AnyArray, Floats, Ints
from lidarsim.scene.colors import as_bytes
from lidarsim.sweeps.sweeps import Sweeps

from ..render.film import Film
from .legends import make_legend
from .packing import pack_column, pack_positions
from .point_selection import PointFinder, ScanRanges, even_shares, read_positions
from .server import VIEWER, Answer, pack_answer
from .view import View

# Maximum number of frames, and number of colors (.gif) or quality (.webp).
_FILMS = {".gif": (30, 96), ".webp": (40, 40)}
_MIN_FRAMES = 30
_FRAME_MS = 100
FILM_BYTES = 3_000_000  # maximum size of a film
_WIDTHS = range(960, 320, -80)  # widths to try, in pixels
_FILM_TRIANGLES = 3_000_000
_FILM_POINTS = 800_000  # maximum number of points in a frame
_FRAME_POINTS = 200_000  # maximum number of points that a frame adds
PAGE_BYTES = 25_000_000  # maximum size of a page
_PAGE_POINTS = 4_000_000
_PAGE_TRIANGLES = 60_000
_SAMPLE_POINTS = 5_000_000  # sample from which the points of a page are chosen
_CELLS = 300  # cells along the diagonal of the points, for estimating their density

# Statements in modules. `_IMPORT` captures the names and the file, `_EXPORT` the name.
_IMPORT = re.compile(r'^import (\{[^}]*\}|\* as \w+) from "\./([\w.]+)";$', re.MULTILINE)
_EXPORT = re.compile(r"^export (?:async function|function|const|class) (\w+)", re.MULTILINE)
_EXPORT_LIST = re.compile(r"\bexport\{([^}]*)\};?\s*$")


def _show_nothing(output: str, count: int, total: int, unit: str) -> None:
    """Ignore progress reports."""


def export_view(
    view: View,
    film: Path | None,
    page: Path | None,
    writing: Callable[[str], AbstractContextManager[WritingProgress]] | None = None,
) -> None:
    """Write a view as a film, a page, or both, replacing existing files.

    Parameters
    ----------
    view
        The view.
    film
        Path of the film, with the extension .gif or .webp.
    page
        Path of the page, with the extension .html.
    writing
        Opens a progress display with a caption. By default, no progress is shown.

    Raises
    ------
    LidarError
        If the view has no points, or if a file has another extension or cannot be written.
    """
    for file, suffixes in (film, tuple(_FILMS)), (page, (".html",)):
        if file and file.suffix not in suffixes:
            raise LidarError(f"{file} has an unsupported extension. Use {' or '.join(suffixes)}.")
        if (
            file and not file.parent.is_dir()
        ):  # fail before the film is rendered, which takes seconds
            raise LidarError(
                f"{file} cannot be written, because the folder {file.parent} does not exist."
            )
    if not len(PointFinder(view.points, view.origin).find_points(1000)[0]):
        raise LidarError("There are no points to show, because no ray hit a surface.")
    if view.note:
        click.echo(f"note: {view.note}", err=True)
    for file in filter(None, (film, page)):
        with ExitStack() as stack:
            show: WritingProgress = _show_nothing
            if writing is not None:
                show = stack.enter_context(writing(f"writing {file.name}"))
            content = (
                render_page(view, show) if file == page else render_film(view, file.suffix, show)
            )
        with explain_os_errors(f"{file} cannot be written", "choose another path"):
            replace_file(file, content)
        click.echo(click.format_filename(file))


def render_film(view: View, suffix: str, show: WritingProgress = _show_nothing) -> bytes:
    """Render a film of at most about 3 MB, as wide as this limit allows.

    `suffix` is ".gif" or ".webp". `show` reports the number of rendered frames.
    """
    max_frames, quality = _FILMS[suffix]
    film = _film(replace(view, triangles=_FILM_TRIANGLES), max_frames)
    frames: list[Image.Image] = []
    for frame in film.frames():
        frames.append(Image.fromarray(frame))
        show("film", len(frames), len(film.moments_ns), "frames")

    sample = frames[len(frames) // 6 :: len(frames) // 3]
    max_bytes = 0.95 * FILM_BYTES * len(sample) / len(frames)
    widths = (w for w in _WIDTHS if len(_encode(sample, suffix, w, quality)) < max_bytes)
    return _encode(frames, suffix, next(widths, _WIDTHS[-1]), quality)


def _encode(frames: list[Image.Image], suffix: str, width: int, quality: int) -> bytes:
    """Encode frames, scaled to a width in pixels.

    `quality` is the number of colors for .gif and the compression quality for .webp.
    """
    scaled = [f.resize((width, width * 9 // 16), Image.Resampling.LANCZOS) for f in frames]
    if suffix == ".gif":  # a palette per frame would make the colors flicker
        pixels = np.concatenate([np.asarray(frame)[::2, ::2] for frame in scaled])
        palette = Image.fromarray(pixels).quantize(quality, Image.Quantize.FASTOCTREE)
        scaled = [f.quantize(palette=palette, dither=Image.Dither.NONE) for f in scaled]
    file = io.BytesIO()
    scaled[0].save(
        file,
        suffix[1:],
        append_images=scaled[1:],
        save_all=True,
        duration=_FRAME_MS,
        loop=0,
        quality=quality,
    )
    return file.getvalue()


@dataclass(frozen=True, eq=False)
class _FilmSource:
    """The points of a view as they appear in a film, colored by height."""

    view: View
    finder: PointFinder
    top: float  # height above which the scene is cut open, meters

    def positions(self, max_points: int, scans: ScanRanges | None = None) -> Floats:
        """Sample the points below `top` and return their local positions."""
        rows, _ = self.finder.find_points(max_points, scans=scans)
        local = read_positions(self.view.points, rows) - self.view.origin
        return local[local[:, 2] <= self.top]

    def points(
        self, box: Floats, max_points: int, scans: ScanRanges | None = None
    ) -> tuple[Floats, Floats]:
        """Sample the points and return their local positions and RGBA colors.

        The colors span the height of `box`, which has shape (2, 3).
        """
        local = self.positions(max_points, scans)
        fraction = np.clip((local[:, 2] - box[0, 2]) / max(np.ptp(box[:, 2]), 1e-9), 0, 1)
        # The darkest colors are skipped, because they are hard to see on a dark background.
        colors = TURBO[(24 + 231 * np.sqrt(fraction)).astype(np.int64)]
        return local, np.pad(colors, ((0, 0), (0, 1)), constant_values=1)

    def new_points(
        self, box: Floats, spans: Sequence[ScanRanges]
    ) -> Iterator[tuple[Floats, Floats]]:
        """Yield the positions and colors of the scans in each frame."""
        for scans in spans:
            yield self.points(box, _FRAME_POINTS, scans)


def _never_disconnected() -> bool:
    return False


def _film(view: View, max_frames: int) -> Film:
    """Compose the film of a view.

    The camera follows the first moving sensor. If no sensor moves, it circles the points.
    """
    triangles = np.empty((0, 3, 3))
    top = np.inf
    if view.pictured is not None and len(view.pictured.scene.faces):
        header, arrays = view.answer("surface", {"color": "gray"}, _never_disconnected)
        triangles = arrays["corners"]
        top = header["roof_cut"] or top
    source = _FilmSource(view, PointFinder(view.points, view.origin), top)
    box = np.percentile(source.positions(_FRAME_POINTS), [1, 99], axis=0)
    frames = int(np.clip(view.duration_ns / (1e6 * _FRAME_MS), _MIN_FRAMES, max_frames))
    film = Film(
        moments_ns=np.linspace(0, view.duration_ns, frames + 1)[1:],
        new_points=repeat(source.points(box, _FILM_POINTS), frames),
        keep_share=0.0,
        scene_triangles=triangles,
        top=top,
        actors=view.actors,
        box=box,
    )
    moving = [sensor for sensor in view.sensors if sensor.moves]
    if view.sweeps is None or not (moving or view.actors):
        return film
    intervals = pairwise([-np.inf, *film.moments_ns[:-1], np.inf])
    spans = [_scans_between(view.sweeps, *interval) for interval in intervals]
    all_points = max(_FILM_POINTS, min(len(view.points), _FRAME_POINTS * frames))
    film = replace(
        film, new_points=source.new_points(box, spans), keep_share=_FILM_POINTS / all_points
    )
    return _follow(film, moving[0], source, spans) if moving else film


def _follow(
    film: Film, sensor: SensorPositions, source: _FilmSource, spans: Sequence[ScanRanges]
) -> Film:
    """Return the film with a camera that follows a sensor.

    `spans` contains the scans in each frame.
    """
    middle = len(spans) // 2
    position = sensor.position_at(film.moments_ns[middle])
    ranges = np.linalg.norm(source.positions(_FRAME_POINTS, spans[middle]) - position, axis=1)
    range_m = float(np.median(ranges)) if len(ranges) else 20.0
    trajectory = (sensor.times_ns, sensor.positions)
    return replace(film, platform_trajectory=trajectory, range_m=range_m)


def _scans_between(sweeps: Sweeps, start_ns: float, stop_ns: float) -> ScanRanges:
    """Return the ranges of the scans between two times.

    The scans of a sweep are assumed to be evenly spaced in time.
    """
    first = sweeps.scans[:-1]
    count = np.diff(sweeps.scans)
    scan_ns = np.maximum(sweeps.ends_ns - sweeps.begins_ns, 1.0) / count
    starts, stops = (
        first + np.ceil(np.clip((time - sweeps.begins_ns) / scan_ns, 0, count)).astype(np.int64)
        for time in (start_ns, stop_ns)
    )
    spans = zip(starts.tolist(), stops.tolist(), strict=True)
    return tuple((start, stop - 1) for start, stop in spans if start < stop)


def render_page(view: View, show: WritingProgress = _show_nothing) -> bytes:
    """Render a page of at most 25 MB that contains the answers to all of its requests.

    `show` reports the number of packed answers.

    Raises
    ------
    LidarError
        If the page exceeds 25 MB even without points.
    """
    page = _page_with_modules()
    view = replace(view, triangles=_PAGE_TRIANGLES)
    answers = _pack_answers(view, show)
    free_bytes = PAGE_BYTES - len(page) - sum(len(text) + 99 for text in answers.values())
    max_points = _PAGE_POINTS
    while len(cloud := _packed(*_thinned(view, max_points))) > free_bytes:
        max_points = int(max_points * min(0.9, 0.95 * max(free_bytes, 0) / len(cloud)))
        if max_points < 1000:
            raise LidarError("The page exceeds 25 MB even without points. Omit `--export`.")
    script = '<script type="text/plain" data-question="{}">{}</script>\n'
    texts = [script.format(*pair) for pair in (answers | {"cloud?": cloud}).items()]
    return page.replace("</body>", "".join([*texts, "</body>"])).encode()


def _page_with_modules() -> str:
    """Return the viewer's page with inlined style sheets and modules, and a content policy.

    The policy allows scripts and styles by their hashes and blocks everything else.
    """
    folder = files(__package__) / "page"
    page = (folder / VIEWER).read_text("utf-8")
    styles: list[str] = []
    for name in re.findall(r'<link rel="stylesheet" href="([\w.]+)">', page):
        styles.append(f"\n{(folder / name).read_text('utf-8')}")
        page = page.replace(
            f'<link rel="stylesheet" href="{name}">', f"<style>{styles[-1]}</style>"
        )
    script = f"\n{bundle_modules(folder, 'page.js')}"
    page = page.replace(
        '<script type="module" src="page.js"></script>', f'<script type="module">{script}</script>'
    )
    policy = (
        f"default-src 'none'; script-src {_hash_source(script)}; "
        f"style-src {' '.join(map(_hash_source, styles))}; img-src data: blob:; "
        "base-uri 'none'; form-action 'none'"
    )
    charset = '<meta charset="utf-8">\n'
    meta = f'{charset}<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
    return page.replace(charset, meta)


def _hash_source(text: str) -> str:
    """Return the content policy source that allows an inline script or style."""
    digest = hashlib.sha256(text.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"


def bundle_modules(folder: Traversable, name: str) -> str:
    """Combine a JavaScript module and its imports into a single script.

    Each module becomes a function that returns its exports. A page in a single file cannot use
    imports: a content policy can allow inline scripts by their hashes, but imported modules only by
    their addresses.
    """
    modules: dict[str, str] = {}  # {file: script}, imported modules first

    def add(name: str) -> None:
        text = (folder / name).read_text("utf-8")
        for _, imported in _IMPORT.findall(text):
            if imported not in modules:
                add(imported)
        exports = _EXPORT.findall(text)
        for names in _EXPORT_LIST.findall(text):  # minified modules export "a as Name"
            pairs = (entry.strip().partition(" as ") for entry in names.split(","))
            exports += [f"{exported or local}: {local}" for local, _, exported in pairs]
        text = _IMPORT.sub(r'const \1 = modules["\2"];', text).replace("const * as ", "const ")
        text = _EXPORT_LIST.sub("", _EXPORT.sub(lambda match: match[0][len("export ") :], text))
        modules[name] = (
            f'modules["{name}"] = (() => {{\n{text}\nreturn {{ {", ".join(exports)} }};\n}})();\n'
        )

    add(name)
    return "const modules = {};\n" + "".join(modules.values())


def _pack_answers(view: View, show: WritingProgress) -> dict[str, str]:
    """Return the packed answer to each request of the page, except requests for points."""
    header, arrays = view.answer("state", {}, _never_disconnected)
    answers = {"state?": _packed(header | {"offline": True, "exports": []}, arrays)}
    questions = [("surface", "color", value) for value in header["scene_colors"] or ()]
    questions += [("column", "name", value) for value in view.columns]
    labels = [name for name, column in view.columns.items() if column.kind == "label"]
    questions += [("counts", "name", name) for name in labels]
    for number, (question, key, value) in enumerate(questions, 1):
        answer = view.answer(question, {key: value}, _never_disconnected)
        answers[f"{question}?{key}={value}"] = _packed(*answer)
        show("page", number, len(questions), "parts")
    return answers


def _packed(header: dict[str, Any], arrays: dict[str, AnyArray]) -> str:
    """Return an answer as text that can be embedded in a page."""
    return base64.b64encode(zlib.compress(b"".join(pack_answer(header, arrays)))).decode()


def _thinned(view: View, max_points: int) -> Answer:
    """Sample points and pack all their columns.

    The sample contains a smaller fraction of the points where they are dense.
    """
    points = view.shown_points
    rows, _ = PointFinder(points, view.origin).find_points(_SAMPLE_POINTS)
    world = read_positions(points, rows)
    cell_m = max(float(np.linalg.norm(np.ptp(world, axis=0))) / _CELLS, 1e-9)
    cells = ((world - world.min(axis=0)) / cell_m).astype(np.int64) @ [1 << 20, 1 << 10, 1]
    _, cell_of_point, counts = np.unique(cells, return_inverse=True, return_counts=True)
    fractions = even_shares(counts, max_points)[cell_of_point]
    chosen = np.random.default_rng(0).random(len(rows)) < fractions
    columns = {c.name: points.values(c.name, rows[chosen]) for c in points.table}
    order = _compact_order(columns, int(chosen.sum()))
    return _packed_points(
        view,
        world[chosen][order] - view.origin,
        {name: values[order] for name, values in columns.items()},
    )


def _compact_order(columns: Mapping[str, AnyArray], count: int) -> Ints:
    """Sort the points by sensor and channel, which makes them compress well."""
    keys = [columns[name] for name in ("channel", "sensor") if name in columns]
    return np.lexsort(keys) if keys else np.arange(count)


def _packed_points(view: View, local: Floats, columns: Mapping[str, AnyArray]) -> Answer:
    """Pack the columns of points, with the colors and the legend of each column."""
    packed_columns = dict(zip("xyz", pack_positions(local), strict=True))
    packed_columns |= {name: pack_column(values) for name, values in columns.items()}
    arrays: dict[str, AnyArray] = {name: c.planes for name, c in packed_columns.items()}
    legends = dict[str, Any]()
    for name in view.answer("state", {}, _never_disconnected)[0]["colors"]:
        coloring = view.coloring(name)
        legends[name] = make_legend(coloring) | {"column": name, "divisor": coloring.divisor}
        if coloring.limits is not None:
            arrays[f"{name} scale"] = as_bytes(coloring.scale)
        elif name in columns:
            values = np.unique(columns[name])
            arrays[f"{name} labels"] = values.astype(np.float64)
            arrays[f"{name} palette"] = as_bytes(coloring.paint(values))
    described = {
        name: {
            "base": column.base,
            "step": column.step,
            "fractions": column.fractions,
            "logarithmic": column.logarithmic,
        }
        for name, column in packed_columns.items()
    }
    header = {"legends": legends, "origin": view.origin.tolist(), "count": len(local)}
    return header | {"packed": described}, arrays
