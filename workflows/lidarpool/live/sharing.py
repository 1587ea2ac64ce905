"""A result as one file to share: a film, or a page that needs no server."""

from __future__ import annotations

import base64
import io
import json
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from importlib.resources import files
from itertools import pairwise, repeat
from pathlib import Path
from typing import Any

import click
import numpy as np
from PIL import Image

from raybeam import RayCaster

from ..base.arrays import AnyArray, Bytes, Floats, Floats32
from ..base.errors import LidarpoolError, explained
from ..columns.cloud import Cloud
from ..export.sweeps import Sweeps
from ..render.closeup import ShownPart, floor_and_cut
from ..render.colouring import TURBO
from ..render.film import circling, film, following
from .point_selection import HeldPoints, PointFinder, ScanRanges, even_shares, positions
from .server import ARRAY_TYPES, VIEWER, Answer, bundle
from .view import MOST_POINTS, View, open_result

_FRAME_MS, _FEWEST = 100, 30  # frames
_FILM_POINTS, _FRAME_POINTS = 800_000, 200_000  # that stay, and that one frame adds
_FILM_BYTES = 3_000_000
# {suffix: most frames; widths in pixels with numbers of colours or qualities, the best first}
_FILMS = {
    ".gif": (30, ((960, 128), (800, 96), (640, 96), (640, 48), (480, 48), (480, 24))),
    ".webp": (40, ((960, 75), (960, 50), (800, 50), (800, 30), (640, 40), (480, 30))),
}
_PAGE_BYTES, _PAGE_POINTS, _PAGE_TRIANGLES = 25_000_000, 1_000_000, 100_000
_CHOSEN_FROM = 5_000_000  # points
_CELLS = 300  # along the diagonal, within which points are dense or not


def share(path: Path, film_file: Path | None, page_file: Path | None) -> None:
    """Write a film, a page or both of a folder of a result, or a cloud; they are replaced.

    Raises
    ------
    LidarpoolError
        If there are no points, or a file has another suffix than .gif, .webp and .html, cannot be
        written, or would be too large.
    """
    wanted = ((film_file, (*_FILMS,), film_of), (page_file, (".html",), page_of))
    for file, suffixes, _ in wanted:
        if file is not None and file.suffix not in suffixes:
            raise LidarpoolError(f"{file} does not end with {' or '.join(suffixes)}: rename it.")
    view = open_result(path)
    if not len(view.points):
        raise LidarpoolError(f"{path} has no points to show: its rays hit nothing.")
    if view.note:
        click.echo(f"note: {view.note}", err=True)
    for file, _, made in wanted:
        if file is not None:
            content = made(view, file.suffix)
            with explained(f"{file} cannot be written", "give another place"):
                file.write_bytes(content)
            click.echo(click.format_filename(file))


def film_of(view: View, suffix: str) -> bytes:
    """Return a film of a result, ".gif" or ".webp", as large as some 3 MB allow.

    If a sensor moves, the camera follows it; else it circles around the points.
    """
    most, rungs = _FILMS[suffix]
    frames = [Image.fromarray(frame) for frame in _frames(view, most)]
    some = frames[len(frames) // 6 :: len(frames) // 3]
    for rung in rungs:
        if len(_encoded(some, suffix, *rung)) * len(frames) < 0.95 * _FILM_BYTES * len(some):
            break
    return _encoded(frames, suffix, *rung)


def _encoded(frames: Sequence[Image.Image], suffix: str, width: int, quality: int) -> bytes:
    small = [frame.resize((width, width * 9 // 16), Image.Resampling.LANCZOS) for frame in frames]
    if suffix == ".gif":  # with a palette of its own for each frame, colours would flicker
        every = Image.fromarray(np.concatenate([np.asarray(frame)[::2, ::2] for frame in small]))
        palette = every.quantize(quality)
        small = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in small]
    given = {"save_all": True, "duration": _FRAME_MS, "loop": 0, "quality": quality}
    small[0].save(memory := io.BytesIO(), suffix[1:], append_images=small[1:], **given)
    return memory.getvalue()


def _frames(view: View, most: int) -> Iterator[Bytes]:
    """Draw the frames of a film, (height, width, 3) each."""
    finder, sweeps = PointFinder(view.points, view.origin), view.sweeps
    scene, top = None if view.pictured is None else view.pictured.scene, np.inf
    if scene is not None and len(scene.faces) and view.sensors:  # rooms are seen without a roof
        poses = np.concatenate([way.positions for way in view.sensors])
        _, cut = floor_and_cut(scene, RayCaster(scene.vertices, scene.faces), poses)
        if cut is not None:
            top, box = cut, scene.bounds.clip(max=[np.inf, np.inf, cut])
            scene = replace(ShownPart.whole(scene).cut(box).scene, actors=scene.actors)

    def read(most: int, scans: ScanRanges | None = None) -> tuple[Floats32, Floats32]:
        places = positions(view.points, finder.find(most, scans=scans)[0]) - view.origin
        places = places[places[:, 2] <= top]
        share = np.clip((places[:, 2] - low[2]) / max(high[2] - low[2], 1e-9), 0, 1)
        colours = TURBO[(24 + 231 * np.sqrt(share)).astype(np.int64)]  # darker ones are lost
        return places.astype(np.float32), colours.astype(np.float32)

    low, high = np.zeros((2, 3))
    low, high = box = np.percentile(read(_FRAME_POINTS)[0], [1, 99], axis=0).astype(np.float64)
    frames = int(np.clip(view.duration_ns / (1e6 * _FRAME_MS), _FEWEST, most))
    moments: Floats = np.linspace(0, view.duration_ns, frames + 1)[1:]
    carrier = next((way for way in view.sensors if way.moves), None)
    if sweeps is None or (carrier is None and not (scene and scene.actors)):
        parts: Iterable[tuple[Floats32, Floats32]] = repeat(read(_FILM_POINTS), frames)
        yield from film(circling(box, frames), moments, parts, scene, 0.0)
        return
    spans = [_scans_between(sweeps, *pair) for pair in pairwise([-np.inf, *moments[:-1], np.inf])]
    views = circling(box, frames)
    if carrier is not None:
        seen = read(_FRAME_POINTS, spans[frames // 2])[0] - carrier.at(moments[frames // 2])
        away = float(np.median(np.linalg.norm(seen, axis=1))) if len(seen) else 20.0
        views = following(carrier.times_ns, carrier.positions, moments, away)
    kept = _FILM_POINTS / max(_FILM_POINTS, min(len(view.points), _FRAME_POINTS * frames))
    parts = (read(_FRAME_POINTS, scans) for scans in spans)
    yield from film(views, moments, parts, scene, kept)


def _scans_between(sweeps: Sweeps, begin_ns: float, end_ns: float) -> ScanRanges:
    """Scans from a time to another, of each sweep; they are even over it."""
    first, count = sweeps.scans[:-1], np.diff(sweeps.scans)
    each = np.maximum(sweeps.ends_ns - sweeps.begins_ns, 1.0) / count
    low, after = (
        first + np.ceil(np.clip((time - sweeps.begins_ns) / each, 0, count)).astype(np.int64)
        for time in (begin_ns, end_ns)
    )
    return tuple((a, b - 1) for a, b in zip(low.tolist(), after.tolist(), strict=True) if a < b)


def page_of(view: View, _: str = ".html") -> bytes:
    """Return a page that shows a result without a server, of at most 25 MB.

    It holds answers to all that the page asks for, and as many points as there is room for.
    LidarpoolError if there is room for none.
    """
    view.triangles = _PAGE_TRIANGLES
    state, arrays = view.answer("state", {}, _wait)
    held = {"state?": _packed(state | {"offline": True}, arrays)}
    grey: dict[str, AnyArray] = {}
    for colour in state["scene"] or ():
        header, arrays = view.answer("surface", {"colour": colour}, _wait)
        rest = {name: array for name, array in arrays.items() if array is not grey.get(name)}
        held[f"surface?colour={colour}"] = _packed(header | {"like": bool(grey)}, rest)
        grey = grey or arrays
    for name in view.columns:
        held[f"column?name={name}"] = _packed(*view.answer("column", {"name": name}, _wait))
    page, most = _page(), _PAGE_POINTS
    room = _PAGE_BYTES - len(page) - sum(len(text) + 100 for text in held.values())
    while len(cloud := _packed(*_thinned(view, most))) > room:
        most = int(most * min(0.9, 0.95 * max(room, 0) / len(cloud)))
        if most < 1000:
            raise LidarpoolError(
                "Scene and actors alone make a page of more than 25 MB: use lidarpool view RESULT."
            )
    for question, text in {**held, "cloud?": cloud}.items():
        entry = f'<script type="text/plain" data-question="{question}">{text}</script>'
        page = page.replace("</body>", f"{entry}\n</body>")
    return page.encode()


def _wait() -> bool:
    return False


def _packed(header: dict[str, Any], arrays: Mapping[str, AnyArray]) -> str:
    return base64.b64encode(zlib.compress(b"".join(bundle(header, arrays)))).decode()


def _thinned(view: View, most: int) -> Answer:
    """Some points, fewer where they are dense, with their columns, and colours by each of these."""
    rows, _ = PointFinder(view.points, view.origin).find(_CHOSEN_FROM)
    places = positions(view.points, rows)
    cell = max(float(np.linalg.norm(np.ptp(places, axis=0))) / _CELLS, 1e-9)
    cells = ((places - places.min(axis=0)) / cell).astype(np.int64) @ [1 << 20, 1 << 10, 1]
    _, which, counts = np.unique(cells, return_inverse=True, return_counts=True)
    some = np.random.default_rng(0).random(len(rows)) < even_shares(counts, most)[which]
    columns = {c.name: view.points.values(c.name, rows[some]) for c in view.points.table}
    thin = replace(view, points=HeldPoints(Cloud(places[some], columns, view.points.table)))
    arrays, legends = dict[str, AnyArray](), {}
    for name in thin.answer("state", {}, _wait)[0]["colours"]:
        asked = {"colour": name, "most": str(MOST_POINTS)}
        header, found = thin.answer("points", asked, _wait)
        palette, shades = np.unique(found["colours"].view(np.uint32), return_inverse=True)
        kind = np.uint8 if len(palette) <= 1 << 8 else np.uint32
        arrays |= {f"{name} palette": palette, f"{name} shades": shades.ravel().astype(kind)}
        legends[name], arrays["positions"] = header["legend"], found["positions"]
    for name, values in columns.items():
        arrays[name] = values if values.dtype.name in ARRAY_TYPES else values.astype(np.float64)
    return {"legends": legends, "origin": view.origin.tolist()}, arrays


def _page() -> str:
    """Return the page of the viewer with its styles and modules in it."""
    folder = files(__package__) / "page"
    page, modules = (folder / VIEWER).read_text("utf-8"), {}
    for file in folder.iterdir():
        text = file.read_text("utf-8")
        link = f'<link rel="stylesheet" href="{file.name}">'
        page = page.replace(link, f"<style>\n{text}</style>")
        if file.name.endswith(".js"):  # modules in data: cannot name others by their paths
            code = base64.b64encode(re.sub(r'from "\./', 'from "', text).encode()).decode()
            modules[file.name] = f"data:text/javascript;base64,{code}"
    inside = f'<script type="importmap">{json.dumps({"imports": modules}, sort_keys=True)}</script>'
    inside += '\n<script type="module">import "page.js";</script>'
    return page.replace('<script type="module" src="page.js"></script>', inside)
