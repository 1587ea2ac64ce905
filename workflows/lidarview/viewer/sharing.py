"""Writes a result as a single file to share: a film, or a page that needs no server."""

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

from lidarsim.base.arrays import AnyArray, Floats, Ints
from lidarsim.base.errors import LidarError, explained
from lidarsim.base.storage import Storage
from lidarsim.base.writing_progress import WritingProgress
from lidarsim.scene.colors import as_bytes
from lidarsim.sweeps.sweeps import Sweeps

from ..picture_file import SensorPositions
from ..render.coloring import TURBO
from ..render.film import Film
from .legends import legend_of
from .packing import pack_column, pack_positions
from .point_selection import PointFinder, ScanRanges, even_shares, positions
from .server import VIEWER, Answer, bundle
from .view import View

_FILMS = {".gif": (30, 96), ".webp": (40, 40)}  # {suffix: (maximum of frames, colors or quality)}
_MIN_FRAMES = 30
_FRAME_MS = 100
FILM_BYTES = 3_000_000  # maximum of a film
_WIDTHS = range(960, 320, -80)  # widths of a film, pixels, the widest first
_FILM_TRIANGLES = 3_000_000
_FILM_POINTS = 800_000  # points that a film shows at a time
_FRAME_POINTS = 200_000  # points that a frame adds
PAGE_BYTES = 25_000_000  # maximum of a page in one file
_PAGE_POINTS = 4_000_000
_PAGE_TRIANGLES = 60_000
_SAMPLE_POINTS = 5_000_000  # sample of points; a page's points are chosen among them
_CELLS = 300  # cells along the diagonal of the points, where their density is counted

# Statements of modules. `_IMPORT` has the names and the file, `_EXPORT` the name.
_IMPORT = re.compile(r'^import (\{[^}]*\}|\* as \w+) from "\./([\w.]+)";$', re.MULTILINE)
_EXPORT = re.compile(r"^export (?:async function|function|const|class) (\w+)", re.MULTILINE)
_EXPORT_LIST = re.compile(r"\bexport\{([^}]*)\};?\s*$")


def _show_nothing(output: str, count: int, total: int, unit: str) -> None:
    """Show no progress."""


def share(
    view: View,
    film: Path | None,
    page: Path | None,
    writing: Callable[[str], AbstractContextManager[WritingProgress]] | None = None,
) -> None:
    """Write a view as a film, a page or both, and replace existing files.

    `writing` opens the display of an output's progress, with a caption; none by default.

    LidarError without points, or if a file has another suffix or cannot be written.
    """
    for file, suffixes in (film, tuple(_FILMS)), (page, (".html",)):
        if file and file.suffix not in suffixes:
            raise LidarError(f"{file} has an unsupported extension. Use {' or '.join(suffixes)}.")
        if file and not file.parent.is_dir():  # films take seconds to draw
            raise LidarError(
                f"{file} cannot be written, because the folder {file.parent} does not exist."
            )
    if not len(PointFinder(view.points, view.origin).find(1000)[0]):
        raise LidarError("There are no points to show, because no ray hit a surface.")
    if view.note:
        click.echo(f"note: {view.note}", err=True)
    for file in filter(None, (film, page)):
        with ExitStack() as stack:
            show: WritingProgress = _show_nothing
            if writing is not None:
                show = stack.enter_context(writing(f"writing {file.name}"))
            content = page_of(view, show) if file == page else film_of(view, file.suffix, show)
        with explained(f"{file} cannot be written", "choose another path"):
            Storage.at(file.parent, durable=False).write(file.name, content)
        click.echo(click.format_filename(file))


def film_of(view: View, suffix: str, show: WritingProgress = _show_nothing) -> bytes:
    """Return a film, ".gif" or ".webp", of at most about 3 MB, and as wide as possible.

    `show` shows the number of frames that are drawn.
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
    """Encode frames in a width in pixels.

    `quality` is the number of colors of a .gif.
    """
    scaled = [f.resize((width, width * 9 // 16), Image.Resampling.LANCZOS) for f in frames]
    if suffix == ".gif":  # colors would flicker with a palette for each frame
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
    """Points of a view for a film, colored by height."""

    view: View
    finder: PointFinder
    top: float  # height above which the scene is cut open, meters

    def positions(self, max_points: int, scans: ScanRanges | None = None) -> Floats:
        """Return local positions (n, 3) of points below the top."""
        rows, _ = self.finder.find(max_points, scans=scans)
        local = positions(self.view.points, rows) - self.view.origin
        return local[local[:, 2] <= self.top]

    def points(
        self, box: Floats, max_points: int, scans: ScanRanges | None = None
    ) -> tuple[Floats, Floats]:
        """Return local positions (n, 3), and colors (n, 4) by the height in a box (2, 3)."""
        local = self.positions(max_points, scans)
        share = np.clip((local[:, 2] - box[0, 2]) / max(np.ptp(box[:, 2]), 1e-9), 0, 1)
        colors = TURBO[(24 + 231 * np.sqrt(share)).astype(np.int64)]  # darker colors are lost
        return local, np.pad(colors, ((0, 0), (0, 1)), constant_values=1)

    def new_points(
        self, box: Floats, spans: Sequence[ScanRanges]
    ) -> Iterator[tuple[Floats, Floats]]:
        """Yield the points and colors of each frame's scans."""
        for scans in spans:
            yield self.points(box, _FRAME_POINTS, scans)


def _never_abandoned() -> bool:
    """Return False: a file waits for each answer of its view."""
    return False


def _film(view: View, max_frames: int) -> Film:
    """Return the film of a view: along its first moving sensor, or around static points."""
    triangles = np.empty((0, 3, 3))
    top = np.inf
    if view.pictured is not None and len(view.pictured.scene.faces):
        header, arrays = view.answer("surface", {"color": "gray"}, _never_abandoned)
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
    """Return a film that follows a sensor.

    `spans` are the scans of each frame.
    """
    middle = len(spans) // 2
    position = sensor.position_at(film.moments_ns[middle])
    ranges = np.linalg.norm(source.positions(_FRAME_POINTS, spans[middle]) - position, axis=1)
    range_m = float(np.median(ranges)) if len(ranges) else 20.0
    trajectory = (sensor.times_ns, sensor.positions)
    return replace(film, carrier_trajectory=trajectory, range_m=range_m)


def _scans_between(sweeps: Sweeps, start_ns: float, stop_ns: float) -> ScanRanges:
    """Return the ranges of scans between two times.

    Scans are even over each sweep.
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


def page_of(view: View, show: WritingProgress = _show_nothing) -> bytes:
    """Return a page of at most 25 MB that holds the answers to all its questions.

    `show` shows the number of answers that are packed.
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
    """Return the viewer's page with its styles and modules inside, and a policy that allows these.

    Scripts and styles are allowed by their hashes; whatever else a page might load is refused.
    """
    folder = files(__package__) / "page"
    page = (folder / VIEWER).read_text("utf-8")
    styles: list[str] = []
    for name in re.findall(r'<link rel="stylesheet" href="([\w.]+)">', page):
        styles.append(f"\n{(folder / name).read_text('utf-8')}")
        page = page.replace(
            f'<link rel="stylesheet" href="{name}">', f"<style>{styles[-1]}</style>"
        )
    script = f"\n{joined_modules(folder, 'page.js')}"
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
    """Return the source of a content policy that allows an inline script or style."""
    digest = hashlib.sha256(text.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"


def joined_modules(folder: Traversable, name: str) -> str:
    """Join a module of JavaScript and the modules that it imports into a single script.

    Each module becomes a function that returns its exports. A page in one file cannot import: a
    content policy allows inline scripts by hash, but modules in addresses only as a whole.
    """
    modules: dict[str, str] = {}  # {file: script}, imported modules first

    def add(name: str) -> None:
        text = (folder / name).read_text("utf-8")
        for _, imported in _IMPORT.findall(text):
            if imported not in modules:
                add(imported)
        exports = _EXPORT.findall(text)
        for names in _EXPORT_LIST.findall(text):  # a minified module says "a as Name"
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
    """Return the answers to all questions of a page but for points: {question: packed answer}."""
    header, arrays = view.answer("state", {}, _never_abandoned)
    answers = {"state?": _packed(header | {"offline": True, "exports": []}, arrays)}
    questions = [("surface", "color", value) for value in header["scene_colors"] or ()]
    questions += [("column", "name", value) for value in view.columns]
    labels = [name for name, column in view.columns.items() if column.kind == "label"]
    questions += [("counts", "name", name) for name in labels]
    for number, (question, key, value) in enumerate(questions, 1):
        answer = view.answer(question, {key: value}, _never_abandoned)
        answers[f"{question}?{key}={value}"] = _packed(*answer)
        show("page", number, len(questions), "parts")
    return answers


def _packed(header: dict[str, Any], arrays: dict[str, AnyArray]) -> str:
    """Return an answer as text in a page."""
    return base64.b64encode(zlib.compress(b"".join(bundle(header, arrays)))).decode()


def _thinned(view: View, max_points: int) -> Answer:
    """Choose points, fewer where points are dense, and pack all their columns."""
    points = view.shown_points
    rows, _ = PointFinder(points, view.origin).find(_SAMPLE_POINTS)
    world = positions(points, rows)
    cell_m = max(float(np.linalg.norm(np.ptp(world, axis=0))) / _CELLS, 1e-9)
    cells = ((world - world.min(axis=0)) / cell_m).astype(np.int64) @ [1 << 20, 1 << 10, 1]
    _, cell_of_point, counts = np.unique(cells, return_inverse=True, return_counts=True)
    shares = even_shares(counts, max_points)[cell_of_point]
    chosen = np.random.default_rng(0).random(len(rows)) < shares
    columns = {c.name: points.values(c.name, rows[chosen]) for c in points.table}
    order = _compact_order(columns, int(chosen.sum()))
    return _packed_points(
        view,
        world[chosen][order] - view.origin,
        {name: values[order] for name, values in columns.items()},
    )


def _compact_order(columns: Mapping[str, AnyArray], count: int) -> Ints:
    """Return an order with similar neighbors: by sensor and channel, then as they are."""
    keys = [columns[name] for name in ("channel", "sensor") if name in columns]
    return np.lexsort(keys) if keys else np.arange(count)


def _packed_points(view: View, local: Floats, columns: Mapping[str, AnyArray]) -> Answer:
    """Return points with their packed columns, and the colors and legend of each column."""
    packed_columns = dict(zip("xyz", pack_positions(local), strict=True))
    packed_columns |= {name: pack_column(values) for name, values in columns.items()}
    arrays: dict[str, AnyArray] = {name: c.planes for name, c in packed_columns.items()}
    legends = dict[str, Any]()
    for name in view.answer("state", {}, _never_abandoned)[0]["colors"]:
        coloring = view.coloring(name)
        legends[name] = legend_of(coloring) | {"column": name, "divisor": coloring.divisor}
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
