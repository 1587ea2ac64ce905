"""A result as one file to share: a film, or a page that needs no server."""

from __future__ import annotations

import base64
import io
import json
import zlib
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from importlib.resources import files
from itertools import pairwise, repeat
from pathlib import Path
from typing import Any

import click
import numpy as np
from PIL import Image

from lidarsim.base.arrays import AnyArray, Floats
from lidarsim.base.errors import LidarError, explained
from lidarsim.base.storage import Storage
from lidarsim.base.writing_progress import WritingProgress
from lidarsim.columns.cloud import Cloud
from lidarsim.sweeps.sweeps import Sweeps

from ..render.colouring import TURBO
from ..render.film import Film
from .point_selection import HeldPoints, PointFinder, ScanRanges, even_shares, positions
from .server import VIEWER, Answer, bundle
from .view import MAX_POINTS, View, open_result

_FILMS = {".gif": (30, 96), ".webp": (40, 40)}  # {suffix: most frames, colours or quality}
_FEWEST = 30  # frames of a film
_FRAME_MS = 100
_FILM_BYTES = 3_000_000
_WIDTHS = range(960, 320, -80)  # of a film, pixels, the best first
_FILM_TRIANGLES = 3_000_000
_FILM_POINTS = 800_000  # that a film shows at a time
_FRAME_POINTS = 200_000  # that a frame adds
_PAGE_BYTES = 25_000_000
_PAGE_POINTS = 1_000_000
_PAGE_TRIANGLES = 60_000
_CHOSEN_FROM = 5_000_000  # points of which a page has some
_CELLS = 300  # along the diagonal of the points, to find where they are dense


def _show_nothing(output: str, count: int, total: int, unit: str) -> None:
    """Show no progress."""


def share(
    path: Path,
    film: Path | None,
    page: Path | None,
    writing: Callable[[str], AbstractContextManager[WritingProgress]] | None = None,
) -> None:
    """Write a result's folder, or a cloud, as a film, a page or both; files are replaced.

    `writing` opens the display of an output's progress, under words; by default nothing is shown.

    LidarError if there are no points, or a file has another suffix or cannot be written.
    """
    for file, suffixes in (film, tuple(_FILMS)), (page, (".html",)):
        if file and file.suffix not in suffixes:
            raise LidarError(f"{file} does not end with {' or '.join(suffixes)}: rename it.")
    view = open_result(path)
    if not len(PointFinder(view.points, view.origin).find(1000)[0]):
        raise LidarError(f"{path} has no points to show: its rays hit nothing.")
    if view.note:
        click.echo(f"note: {view.note}", err=True)
    for file in filter(None, (film, page)):
        with ExitStack() as stack:
            show: WritingProgress = _show_nothing
            if writing is not None:
                show = stack.enter_context(writing(f"writing {file.name}"))
            content = page_of(view, show) if file == page else film_of(view, file.suffix, show)
        with explained(f"{file} cannot be written", "give another place"):
            Storage.at(file.parent, durable=False).write(file.name, content)
        click.echo(click.format_filename(file))


def film_of(view: View, suffix: str, show: WritingProgress = _show_nothing) -> bytes:
    """Return a film, ".gif" or ".webp", of at most about 3 MB and as wide as these allow.

    `show` shows how many frames are drawn.
    """
    max_frames, quality = _FILMS[suffix]
    film = _film(replace(view, triangles=_FILM_TRIANGLES), max_frames)
    frames: list[Image.Image] = []
    for frame in film.frames():
        frames.append(Image.fromarray(frame))
        show("film", len(frames), len(film.moments_ns), "frames")

    def encoded(frames: list[Image.Image], width: int) -> bytes:
        small = [f.resize((width, width * 9 // 16), Image.Resampling.LANCZOS) for f in frames]
        if suffix == ".gif":  # with a palette for each frame, colours would flicker
            every = np.concatenate([np.asarray(frame)[::2, ::2] for frame in small])
            palette = Image.fromarray(every).quantize(quality, Image.Quantize.FASTOCTREE)
            small = [f.quantize(palette=palette, dither=Image.Dither.NONE) for f in small]
        file = io.BytesIO()
        small[0].save(
            file,
            suffix[1:],
            append_images=small[1:],
            save_all=True,
            duration=_FRAME_MS,
            loop=0,
            quality=quality,
        )
        return file.getvalue()

    sample = frames[len(frames) // 6 :: len(frames) // 3]
    max_bytes = 0.95 * _FILM_BYTES * len(sample) / len(frames)
    fitting = (width for width in _WIDTHS if len(encoded(sample, width)) < max_bytes)
    return encoded(frames, next(fitting, _WIDTHS[-1]))


def _film(view: View, max_frames: int) -> Film:
    """Return the film of a view: along its first moving sensor, or around still points."""
    finder = PointFinder(view.points, view.origin)
    still = np.empty((0, 3, 3))
    top = np.inf
    if view.pictured is not None and len(view.pictured.scene.faces):
        header, arrays = view.answer("surface", {"colour": "grey"}, bool)
        still = arrays["corners"]
        top = header["roof_cut"] or top

    def read(max_points: int, scans: ScanRanges | None = None) -> tuple[Floats, Floats]:
        rows, _ = finder.find(max_points, scans=scans)
        local = positions(view.points, rows) - view.origin
        local = local[local[:, 2] <= top]
        share = np.clip((local[:, 2] - box[0, 2]) / max(np.ptp(box[:, 2]), 1e-9), 0, 1)
        colours = TURBO[(24 + 231 * np.sqrt(share)).astype(np.int64)]  # darker colours are lost
        return local, np.pad(colours, ((0, 0), (0, 1)), constant_values=1)

    box = np.zeros((2, 3))
    box = np.percentile(read(_FRAME_POINTS)[0], [1, 99], axis=0)
    frames = int(np.clip(view.duration_ns / (1e6 * _FRAME_MS), _FEWEST, max_frames))
    moments: Floats = np.linspace(0, view.duration_ns, frames + 1)[1:]
    moving = [sensor for sensor in view.sensors if sensor.moves]
    film = Film(moments, repeat(read(_FILM_POINTS), frames), 0.0, still, top, view.actors, box)
    if view.sweeps is None or not (moving or view.actors):
        return film
    intervals = pairwise([-np.inf, *moments[:-1], np.inf])
    spans = [_scans_between(view.sweeps, *interval) for interval in intervals]
    all_points = max(_FILM_POINTS, min(len(view.points), _FRAME_POINTS * frames))
    parts = (read(_FRAME_POINTS, scans) for scans in spans)
    film = replace(film, parts=parts, keep_share=_FILM_POINTS / all_points)
    if moving:
        sensor = moving[0]
        halfway = sensor.position_at(moments[frames // 2])
        local, _ = read(_FRAME_POINTS, spans[frames // 2])
        ranges = np.linalg.norm(local - halfway, axis=1)
        range_m = float(np.median(ranges)) if len(ranges) else 20.0
        film = replace(
            film, carrier_trajectory=(sensor.times_ns, sensor.positions), range_m=range_m
        )
    return film


def _scans_between(sweeps: Sweeps, begin_ns: float, end_ns: float) -> ScanRanges:
    """Return the scans from a time to another; scans are even over each sweep."""
    first = sweeps.scans[:-1]
    count = np.diff(sweeps.scans)
    scan_ns = np.maximum(sweeps.ends_ns - sweeps.begins_ns, 1.0) / count
    starts, stops = (
        first + np.ceil(np.clip((time - sweeps.begins_ns) / scan_ns, 0, count)).astype(np.int64)
        for time in (begin_ns, end_ns)
    )
    spans = zip(starts.tolist(), stops.tolist(), strict=True)
    return tuple((start, stop - 1) for start, stop in spans if start < stop)


def page_of(view: View, show: WritingProgress = _show_nothing) -> bytes:
    """Return a page of at most 25 MB that holds the answers to all its questions.

    `show` shows how many answers are held.
    """
    folder = files(__package__) / "page"
    modules: dict[str, str] = {}
    page = (folder / VIEWER).read_text("utf-8")
    for file in folder.iterdir():
        text = file.read_text("utf-8")
        link = f'<link rel="stylesheet" href="{file.name}">'
        page = page.replace(link, f"<style>\n{text}</style>")
        if file.name.endswith(".js"):  # modules in data: cannot name others by their paths
            code = base64.b64encode(text.replace('from "./', 'from "').encode()).decode()
            modules[file.name] = f"data:text/javascript;base64,{code}"
    inside = f'<script type="importmap">{json.dumps({"imports": modules}, sort_keys=True)}</script>'
    inside += '\n<script type="module">import "page.js";</script>'
    page = page.replace('<script type="module" src="page.js"></script>', inside)
    view = replace(view, triangles=_PAGE_TRIANGLES)
    header, arrays = view.answer("state", {}, bool)
    held = {"state?": _packed(header | {"offline": True, "exports": []}, arrays)}
    questions = [("surface", "colour", value) for value in header["scene"] or ()]
    questions += [("column", "name", value) for value in view.columns]
    for number, (question, key, value) in enumerate(questions, 1):
        held[f"{question}?{key}={value}"] = _packed(*view.answer(question, {key: value}, bool))
        show("page", number, len(questions), "answers")
    room = _PAGE_BYTES - len(page) - sum(len(text) + 99 for text in held.values())
    max_points = _PAGE_POINTS
    while len(cloud := _packed(*_thinned(view, max_points))) > room:
        max_points = int(max_points * min(0.9, 0.95 * max(room, 0) / len(cloud)))
        if max_points < 1000:
            raise LidarError("Even without points the page has 25 MB: use lidarpool view only.")
    script = '<script type="text/plain" data-question="{}">{}</script>\n'
    texts = [script.format(*pair) for pair in (held | {"cloud?": cloud}).items()]
    return page.replace("</body>", "".join([*texts, "</body>"])).encode()


def _packed(header: dict[str, Any], arrays: dict[str, AnyArray]) -> str:
    """Return an answer as text in a page."""
    return base64.b64encode(zlib.compress(b"".join(bundle(header, arrays)))).decode()


def _thinned(view: View, max_points: int) -> Answer:
    """Choose points, fewer where they are dense, with all columns and the colours by each."""
    rows, _ = PointFinder(view.points, view.origin).find(_CHOSEN_FROM)
    world = positions(view.points, rows)
    cell_m = max(float(np.linalg.norm(np.ptp(world, axis=0))) / _CELLS, 1e-9)
    cells = ((world - world.min(axis=0)) / cell_m).astype(np.int64) @ [1 << 20, 1 << 10, 1]
    _, cell_of_point, counts = np.unique(cells, return_inverse=True, return_counts=True)
    shares = even_shares(counts, max_points)[cell_of_point]
    chosen = np.random.default_rng(0).random(len(rows)) < shares
    columns = {c.name: view.points.values(c.name, rows[chosen]) for c in view.points.table}
    thin = replace(view, points=HeldPoints(Cloud(world[chosen], columns, view.points.table)))
    legends = dict[str, Any]()
    arrays: dict[str, AnyArray] = {n: values.astype(np.float64) for n, values in columns.items()}
    for name in thin.answer("state", {}, bool)[0]["colours"]:
        question = {"colour": name, "most": str(MAX_POINTS)}
        header, points = thin.answer("points", question, bool)
        palette, shades = np.unique(points["colours"].view(np.uint32), return_inverse=True)
        kind = np.uint8 if len(palette) <= 1 << 8 else np.uint32
        arrays |= {f"{name} palette": palette, f"{name} shades": shades.ravel().astype(kind)}
        legends[name] = header["legend"]
        arrays["positions"] = points["positions"]
    return {"legends": legends, "origin": view.origin.tolist()}, arrays
