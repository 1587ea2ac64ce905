"""A result as one file to share: a film, or a page that needs no server."""

from __future__ import annotations

import base64
import io
import json
import zlib
from dataclasses import replace
from importlib.resources import files
from itertools import pairwise, repeat
from pathlib import Path
from typing import Any

import click
import numpy as np
from PIL import Image

from lidarpool.run.progress import Screen, Written
from lidarsim.base.arrays import AnyArray, Floats
from lidarsim.base.errors import LidarError, explained
from lidarsim.base.storage import Storage
from lidarsim.columns.cloud import Cloud
from lidarsim.sweeps.sweeps import Sweeps

from ..render.colouring import TURBO
from ..render.film import Film
from .point_selection import HeldPoints, PointFinder, ScanRanges, even_shares, positions
from .server import VIEWER, Answer, bundle
from .view import MOST_POINTS, View, open_result

_FILMS = {".gif": (30, 96), ".webp": (40, 40)}  # {suffix: most frames, colours or quality}
_FEWEST, _FRAME_MS, _FILM_BYTES, _WIDTHS = 30, 100, 3_000_000, range(960, 320, -80)
_FILM_TRIANGLES, _FILM_POINTS, _FRAME_POINTS = 3_000_000, 800_000, 200_000  # one frame adds
_PAGE_BYTES, _PAGE_POINTS, _PAGE_TRIANGLES = 25_000_000, 1_000_000, 60_000
_CHOSEN_FROM, _CELLS = 5_000_000, 300  # points; cells along the diagonal, which tell where many are


def share(path: Path, film: Path | None, page: Path | None, screen: Screen | None = None) -> None:
    """Write a result's folder, or a cloud, as a film, a page or both; files are replaced.

    `screen` shows what is being written; by default the log.

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
    screen = screen or Screen()
    for file in filter(None, (film, page)):
        with screen.writing(f"writing {file.name}") as show:
            made = page_of(view, show) if file == page else film_of(view, file.suffix, show)
        with explained(f"{file} cannot be written", "give another place"):
            Storage.at(file.parent, durable=False).write(file.name, made)
        click.echo(click.format_filename(file))


def film_of(view: View, suffix: str, show: Written = lambda *_: None) -> bytes:
    """Return a film, ".gif" or ".webp", as wide as some 3 MB allow; see `Film`.

    `show` is told how many frames are drawn.
    """
    (most, quality), view = _FILMS[suffix], replace(view, triangles=_FILM_TRIANGLES)
    film, frames = _film(view, most), list[Image.Image]()
    for frame in film.frames():
        frames.append(Image.fromarray(frame))
        show("film", len(frames), len(film.moments_ns), "frames")

    def encoded(frames: list[Image.Image], width: int) -> bytes:
        small = [f.resize((width, width * 9 // 16), Image.Resampling.LANCZOS) for f in frames]
        if suffix == ".gif":  # with a palette for each frame, colours would flicker
            every = np.concatenate([np.asarray(frame)[::2, ::2] for frame in small])
            palette = Image.fromarray(every).quantize(quality, Image.Quantize.FASTOCTREE)
            small = [f.quantize(palette=palette, dither=Image.Dither.NONE) for f in small]
        given = {"save_all": True, "duration": _FRAME_MS, "loop": 0, "quality": quality}
        small[0].save(memory := io.BytesIO(), suffix[1:], append_images=small[1:], **given)
        return memory.getvalue()

    some = frames[len(frames) // 6 :: len(frames) // 3]
    room = 0.95 * _FILM_BYTES * len(some) / len(frames)
    fits = (width for width in _WIDTHS if len(encoded(some, width)) < room)
    return encoded(frames, next(fits, _WIDTHS[-1]))


def _film(view: View, most: int) -> Film:
    finder, still, top = PointFinder(view.points, view.origin), np.empty((0, 3, 3)), np.inf
    if view.pictured is not None and len(view.pictured.scene.faces):
        told, arrays = view.answer("surface", {"colour": "grey"}, bool)
        still, top = arrays["corners"], told["roof_cut"] or top

    def read(most: int, scans: ScanRanges | None = None) -> tuple[Floats, Floats]:
        places = positions(view.points, finder.find(most, scans=scans)[0]) - view.origin
        places = places[places[:, 2] <= top]
        share = np.clip((places[:, 2] - box[0, 2]) / max(np.ptp(box[:, 2]), 1e-9), 0, 1)
        colours = TURBO[(24 + 231 * np.sqrt(share)).astype(np.int64)]  # darker ones are lost
        return places, np.pad(colours, ((0, 0), (0, 1)), constant_values=1)

    box = np.zeros((2, 3))
    box = np.percentile(read(_FRAME_POINTS)[0], [1, 99], axis=0)
    frames = int(np.clip(view.duration_ns / (1e6 * _FRAME_MS), _FEWEST, most))
    moments: Floats = np.linspace(0, view.duration_ns, frames + 1)[1:]
    ways = [way for way in view.sensors if way.moves]
    film = Film(moments, repeat(read(_FILM_POINTS), frames), 0.0, still, top, view.actors, box)
    if view.sweeps is None or not (ways or view.actors):
        return film
    ends = pairwise([-np.inf, *moments[:-1], np.inf])
    spans = [_scans_between(view.sweeps, *pair) for pair in ends]
    kept = _FILM_POINTS / max(_FILM_POINTS, min(len(view.points), _FRAME_POINTS * frames))
    film = replace(film, parts=(read(_FRAME_POINTS, scans) for scans in spans), kept=kept)
    for way in ways[:1]:
        seen = read(_FRAME_POINTS, spans[frames // 2])[0] - way.at(moments[frames // 2])
        away = float(np.median(np.linalg.norm(seen, axis=1))) if len(seen) else 20.0
        film = replace(film, way=(way.times_ns, way.positions), range_m=away)
    return film


def _scans_between(sweeps: Sweeps, begin_ns: float, end_ns: float) -> ScanRanges:
    """Return the scans from a time to another, which are even over each sweep."""
    first, count = sweeps.scans[:-1], np.diff(sweeps.scans)
    each = np.maximum(sweeps.ends_ns - sweeps.begins_ns, 1.0) / count
    since = [np.clip((time - sweeps.begins_ns) / each, 0, count) for time in (begin_ns, end_ns)]
    low, after = (first + np.ceil(scans).astype(np.int64) for scans in since)
    return tuple((a, b - 1) for a, b in zip(low.tolist(), after.tolist(), strict=True) if a < b)


def page_of(view: View, show: Written = lambda *_: None) -> bytes:
    """Return a page of at most 25 MB that holds the answers to all that it asks for.

    `show` is told how many answers are held.
    """
    folder, modules = files(__package__) / "page", {}
    page = (folder / VIEWER).read_text("utf-8")
    for file in folder.iterdir():
        text, link = file.read_text("utf-8"), f'<link rel="stylesheet" href="{file.name}">'
        page = page.replace(link, f"<style>\n{text}</style>")
        if file.name.endswith(".js"):  # modules in data: cannot name others by their paths
            code = base64.b64encode(text.replace('from "./', 'from "').encode()).decode()
            modules[file.name] = f"data:text/javascript;base64,{code}"
    inside = f'<script type="importmap">{json.dumps({"imports": modules}, sort_keys=True)}</script>'
    inside += '\n<script type="module">import "page.js";</script>'
    page = page.replace('<script type="module" src="page.js"></script>', inside)
    view, most = replace(view, triangles=_PAGE_TRIANGLES), _PAGE_POINTS
    told, arrays = view.answer("state", {}, bool)
    held = {"state?": _packed(told | {"offline": True, "exports": []}, arrays)}
    questions = [("surface", "colour", value) for value in told["scene"] or ()]
    questions += [("column", "name", value) for value in view.columns]
    for number, (what, word, value) in enumerate(questions, 1):
        held[f"{what}?{word}={value}"] = _packed(*view.answer(what, {word: value}, bool))
        show("page", number, len(questions), "answers")
    room = _PAGE_BYTES - len(page) - sum(len(text) + 99 for text in held.values())
    while len(cloud := _packed(*_thinned(view, most))) > room:
        most = int(most * min(0.9, 0.95 * max(room, 0) / len(cloud)))
        if most < 1000:
            raise LidarError("Even without points the page has 25 MB: use lidarpool view only.")
    script = '<script type="text/plain" data-question="{}">{}</script>\n'
    texts = [script.format(*each) for each in (held | {"cloud?": cloud}).items()]
    return page.replace("</body>", "".join([*texts, "</body>"])).encode()


def _packed(told: dict[str, Any], arrays: dict[str, AnyArray]) -> str:
    return base64.b64encode(zlib.compress(b"".join(bundle(told, arrays)))).decode()


def _thinned(view: View, most: int) -> Answer:
    """Choose points, fewer where they are dense, with all columns and the colours by each."""
    rows, _ = PointFinder(view.points, view.origin).find(_CHOSEN_FROM)
    places = positions(view.points, rows)
    cell = max(float(np.linalg.norm(np.ptp(places, axis=0))) / _CELLS, 1e-9)
    cells = ((places - places.min(axis=0)) / cell).astype(np.int64) @ [1 << 20, 1 << 10, 1]
    _, which, counts = np.unique(cells, return_inverse=True, return_counts=True)
    some = np.random.default_rng(0).random(len(rows)) < even_shares(counts, most)[which]
    columns = {c.name: view.points.values(c.name, rows[some]) for c in view.points.table}
    thin = replace(view, points=HeldPoints(Cloud(places[some], columns, view.points.table)))
    legends = dict[str, Any]()
    arrays: dict[str, AnyArray] = {n: values.astype(np.float64) for n, values in columns.items()}
    for name in thin.answer("state", {}, bool)[0]["colours"]:
        told, found = thin.answer("points", {"colour": name, "most": str(MOST_POINTS)}, bool)
        palette, shades = np.unique(found["colours"].view(np.uint32), return_inverse=True)
        kind = np.uint8 if len(palette) <= 1 << 8 else np.uint32
        arrays |= {f"{name} palette": palette, f"{name} shades": shades.ravel().astype(kind)}
        legends[name], arrays["positions"] = told["legend"], found["positions"]
    return {"legends": legends, "origin": view.origin.tolist()}, arrays
