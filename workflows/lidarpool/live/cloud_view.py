"""The cloud on a page: colours, filter, picked points, and more points of a near view."""

from __future__ import annotations

import math
import time
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from ..columns.cloud import Cloud
from ..columns.table import AXES, Column, X, Y, Z
from ..render.colouring import MOST_ENTRIES, Colouring, colours_of
from .blocks import Blocks, Search
from .colouring import as_bytes, boxed, legend_of
from .labels import Labels
from .looking import TILES, Eye, Filter, even_shares, picked, values_of
from .page import LivePage
from .picked_point import PickedPoints

HIDDEN = "not shown"
REST_S = 0.4  # for which a camera stands still before a search
SEARCH_S = 0.15  # of a core, for searching before drawing
ENOUGH_SEEN = 0.5  # share of the points in a picture that shows the whole

# As shares of the scene's diagonal. Points can be seen where there are few, and told apart where
# there are many.
_POINT, _POINT_OF_MANY = 0.0035, 0.6
_POINT_FROM_NEAR = 0.002  # of the distance of those at the front: some two pixels
_SMALLEST = 0.1  # of the size of points that are seen from afar
_MOST_NAMES = 2000  # in a menu
_NS = 1e9


@dataclass(eq=False)
class _Near:
    """Near view of one browser."""

    eye: Eye
    since: float  # when the camera arrived
    wanted: Hashable = None  # the search
    search: Search | None = None
    cloud: Cloud | None = None  # with what is outside the picture; None: as for everybody
    size: float = 1.0  # of the points, as a share of that for everybody
    node: Any = None
    drawn: Hashable = None  # its inputs


class CloudView:
    """A cloud on a page.

    `columns` are all but the positions; `names` are those of the values 0, 1, 2, … of a label;
    `origin` is the world position of the local origin, (3,); `size_m` the diagonal of the scene.
    """

    def __init__(
        self,
        page: LivePage,
        labels: Labels,
        columns: Sequence[Column],
        names: Mapping[str, Sequence[str]],
        origin: NDArray[np.float64],
        size_m: float,
    ) -> None:
        self._page, self._labels, self._names = page, labels, names
        self._origin, self._size_m = origin, size_m
        rest = {column.name: column for column in columns if column not in AXES}
        self.columns = {"z": Z, "x": X, "y": Y, **rest}  # to colour and filter by
        self.blocks: Blocks | None = None  # file with more points
        self._even: Cloud | None = None  # of all points
        self._even_version: Hashable = None
        self._found: Cloud | None = None  # that the filter keeps
        self._count: int | None = None  # number of those
        self._search: Search | None = None
        self._search_for = Filter()
        self._progress = 0.0
        self._version = 0  # of what is drawn from
        self.filter = Filter()
        self.trail = Filter()  # of the time that is played
        self._kept = 0  # points that the filter keeps of those that are drawn from
        self._colouring: Colouring | None = None
        self._scaled: Hashable = None  # inputs of the colours
        self._drawn: Hashable = None
        self._node: Any = None  # viser shows no cloud without points
        self._near: dict[int, _Near] = {}  # {client: its near view}
        self._clicks: SimpleQueue[viser.SceneClickEvent] = SimpleQueue()
        self._input: Any = None  # of the filter
        self._input_for = ""
        self._label_values: dict[str, int] = {}
        for modifier in (None, "shift"):
            page.scene.on_click(modifier=modifier)(self._clicks.put)

    # -- controls ------------------------------------------------------------------------

    def add_colour(self) -> None:
        """Add the menu of colours and their legend."""
        gui = self._page.gui
        self.colour = gui.add_dropdown("cloud colour", (*self.columns, HIDDEN))
        self._legend = gui.add_html("")

    def add_filter(self) -> None:
        """Add the panel of clicked points and the controls of the filter."""
        gui = self._page.gui
        self.picked = PickedPoints(
            self._page, self._labels, self.columns, self._names, self._origin
        )
        self._folder = gui.add_folder("filter", expand_by_default=False)
        with self._folder:
            self._filter_by = gui.add_dropdown("column", tuple(self.columns))
            self._filter_text = gui.add_html("", order=1e4)
            self._all = gui.add_button("Show all", order=1e5, visible=False)
        self._all.on_click(lambda _: self.set_filter(Filter()))

    def set_filter(self, wanted: Filter) -> None:
        """Show only points that pass this filter."""
        self.filter, self._input_for = wanted, ""  # the controls follow

    def _follow_filter(self) -> None:
        """Update the filter from its controls for the chosen column."""
        name = self._filter_by.value
        if name != self._input_for:
            if self._input is not None:
                self._input.remove()
            with self._folder:
                self._input = self._filter_input(name)
            self._input_for = name
        else:
            self.filter = self.filter.with_limits(name, self._chosen_limits(name))
        words = [self._in_words(*entry) for entry in self.filter.limits]
        self._filter_text.content = boxed(words)
        self._all.visible = bool(words)

    def _filter_input(self, name: str) -> Any:
        gui, column, limits = self._page.gui, self.columns[name], self.filter.of(name)
        values = np.zeros(0) if self._even is None else values_of(self._even, name)
        values = values[np.isfinite(values)]
        if column.kind == "label" and (labels := self._values_by_name(name, values)):
            self._label_values = labels
            chosen = next((word for word, at in labels.items() if limits == (at, at)), "all")
            return gui.add_dropdown("only", ("all", *labels), initial_value=chosen)
        unit = _NS if column.unit == "ns" else 1.0
        low, high = (values.min() / unit, values.max() / unit) if len(values) else (0.0, 1.0)
        span = max(high - low, 1e-6 * abs(high), 1e-6)  # resolution of a slider
        step = 10.0 ** math.floor(math.log10(span / 500))
        step = max(step, 1.0) if values.dtype.kind in "iu" and unit == 1.0 else step
        first = round(step * math.floor(low / step), 9)
        last = max(round(step * math.ceil(high / step), 9), first + step)
        ends = (first, last) if limits is None else (limits[0] / unit, limits[1] / unit)
        title = f"{name}, {'s' if unit == _NS else column.unit}".rstrip(", ")
        shown = max(ends[0], first), min(ends[1], last)
        return gui.add_multi_slider(title, first, last, step, shown)

    def _values_by_name(self, name: str, values: NDArray[Any]) -> dict[str, int]:
        """Return {name: value} of a label with few values, or with names."""
        names, found = self._names.get(name, ()), np.unique(values).astype(np.int64)
        if len(found) > (_MOST_NAMES if names else MOST_ENTRIES) or name == "scan":
            return {}
        return {
            names[value] if 0 <= value < len(names) else f"{name} {value}": value
            for value in found.tolist()
        }

    def _chosen_limits(self, name: str) -> tuple[float, float] | None:
        handle = self._input
        if isinstance(handle, viser.GuiDropdownHandle):
            at = self._label_values.get(handle.value)
            return None if at is None else (at, at)
        low, high = handle.value
        if low <= handle.min and high >= handle.max:
            return None
        unit = _NS if self.columns[name].unit == "ns" else 1.0
        return low * unit, high * unit

    def _in_words(self, name: str, low: float, high: float) -> str:
        names = self._names.get(name, ())
        if low == high and 0 <= low < len(names):
            return f"only {names[int(low)]}"
        unit = self.columns[name].unit
        low, high, unit = (low / _NS, high / _NS, "s") if unit == "ns" else (low, high, unit)
        span = f"{low:g}" if low == high else f"{low:g} to {high:g}"
        return f"{name} {span} {unit}".rstrip()

    # -- what is drawn -------------------------------------------------------------------

    def show(self, cloud: Cloud, version: Hashable) -> None:
        """Show these points, an evenly spaced sample; a new version has others."""
        if version == self._even_version:
            return
        self._even, self._even_version = cloud, version
        self._version += 1

    def draw(self, cut: float | None, size: float = 1.0, playing: bool = False) -> None:
        """Draw what has changed: points of this size, and nothing above `cut`, metres, local."""
        if self._even is None:
            return
        self._follow_filter()
        self._look_for_filtered()
        state = self._version, self.filter, self.trail, cut, self.colour.value, size
        self._scale()
        self._follow_eyes(playing)
        if state != self._drawn:
            self._drawn = state
            self._node = self._draw(self._page.scene, self._node, self._base(), cut, size)
        for client, near in self._near.items():
            handle = self._page.get_clients().get(client)
            if handle is not None and near.drawn != state:
                near.drawn = state
                if near.cloud is not None:
                    # A node for one browser hides the common node of the same name.
                    sizes = near.size * size
                    near.node = self._draw(handle.scene, near.node, near.cloud, cut, sizes)
                elif near.node is not None:
                    near.node.remove()
                    near.node = None
        self._pick(cut)

    def _base(self) -> Cloud:
        """Points for all browsers that pass the filter."""
        assert self._even is not None
        return self._even if self._found is None else self._found

    def _wanted(self, cloud: Cloud, cut: float | None) -> NDArray[np.bool_]:
        if self.colour.value == HIDDEN:
            return np.zeros(len(cloud), np.bool_)
        kept = self.filter.keeps(cloud) & self.trail.keeps(cloud)
        if cut is not None:
            kept &= cloud.positions[:, 2] - self._origin[2] <= cut
        return kept

    def _point_m(self) -> float:
        """Width of the points for all browsers."""
        return min(_POINT, _POINT_OF_MANY / len(self._base()) ** 0.5) * self._size_m

    def _scale(self) -> None:
        """Fit the colour scale and its legend to the filtered points."""
        name = self.colour.value
        if self._scaled == (self._version, self.filter, name):
            return
        self._scaled, self._colouring = (self._version, self.filter, name), None
        base = self._base()
        kept = self.filter.keeps(base)
        self._kept = int(np.count_nonzero(kept))
        if name != HIDDEN and self._kept:
            values, names = values_of(base, name)[kept], self._names.get(name, ())
            self._colouring = colours_of(values, self.columns[name], names)
        self._legend.content = legend_of(self._colouring) if self._colouring else ""

    def _draw(
        self, scene: viser.SceneApi, node: Any, cloud: Cloud, cut: float | None, size: float
    ) -> Any:
        """Draw the filtered points; returns the node."""
        rows = np.flatnonzero(self._wanted(cloud, cut))
        if not len(rows) or self._colouring is None:
            if node is not None:
                node.visible = False
            return node
        values = values_of(cloud, self.colour.value)[rows]
        colours = as_bytes(self._colouring.paint(values))
        places = (cloud.positions[rows] - self._origin).astype(np.float32)
        size *= self._point_m()
        if node is None:
            return scene.add_point_cloud(
                "/cloud",
                places,
                colours,
                point_size=size,
                point_shape="circle",
                point_shading="flat",
                precision="float32",
            )
        with self._page.atomic():  # otherwise points would lack colours for a moment
            node.visible, node.points, node.colors, node.point_size = True, places, colours, size
        return node

    # -- points of the file --------------------------------------------------------------

    def _look_for_filtered(self) -> None:
        """Search the whole file for filtered points, unless all are shown."""
        if self.blocks is None or self._even is None:
            return
        if self._search_for != self.filter:
            self._search_for, self._search, self._progress = self.filter, None, 0.0
            self._found = self._count = None
            self._version += 1
            if self.filter.limits and len(self._even) < len(self.blocks.file):
                self._search = self.blocks.search(self.filter, self.blocks.most)
        if self._search is not None and (found := self._go_on(self._search)):
            self._search = None
            self._found, self._count = found
            self._version += 1

    def _go_on(self, search: Search) -> tuple[Cloud, int] | None:
        """Continue a search for a moment; returns its result at the end."""
        until = time.thread_time() + SEARCH_S
        try:
            while time.thread_time() < until:
                self._progress = next(search)
        except StopIteration as end:
            found: tuple[Cloud, int] = end.value
            return found
        return None

    def _follow_eyes(self, playing: bool) -> None:
        """Search for more points when a camera stands still and shows few of them."""
        if self.blocks is None:
            return
        clients, now = self._page.get_clients(), time.monotonic()
        self._near = {client: near for client, near in self._near.items() if client in clients}
        for client, handle in clients.items():
            eye = Eye.of(handle.camera)
            near = self._near.setdefault(client, _Near(eye, now))
            if eye != near.eye:
                near.eye, near.since = eye, now
            wanted = (eye, self.filter, self._version)
            if wanted != near.wanted and now - near.since >= REST_S and not playing:
                near.wanted = wanted
                self._look_from(near, self.blocks.most // len(clients))
        searching = next((near for near in self._near.values() if near.search), None)
        if searching is not None and searching.search is not None and self._search is None:
            found = self._go_on(searching.search)
            if found is not None:
                searching.search = None
                self._keep_near(searching, found[0])

    def _look_from(self, near: _Near, most: int) -> None:
        """Start a search for the view of a browser, unless it shows most points."""
        assert self.blocks is not None
        base, near.search = self._base(), None
        rows = self.filter.keeps(base)
        total = self._count if self._count is not None else len(self.blocks.file)
        tiles = near.eye.tiles(base.positions[rows] - self._origin)
        seen = tiles >= 0
        if len(tiles) < total and 0 < np.count_nonzero(seen) < ENOUGH_SEEN * len(tiles):
            counts = np.bincount(tiles[seen], minlength=TILES) * (total / len(tiles))
            shares = even_shares(counts, most)
            near.search = self.blocks.search(self.filter, most, near.eye, shares)
        elif near.cloud is not None:
            near.cloud = near.drawn = None

    def _keep_near(self, near: _Near, found: Cloud) -> None:
        """Show a browser the points found, and the common points outside its picture."""
        base = self._base()
        seen = near.eye.tiles(base.positions - self._origin) >= 0
        if len(found):
            away = np.linalg.norm(found.positions - self._origin - near.eye.position, axis=1)
            size = _POINT_FROM_NEAR * float(np.percentile(away, 20)) / self._point_m()
            near.size = float(np.clip(size, _SMALLEST, 1.0))
        near.cloud = Cloud.joined([base.part(np.flatnonzero(~seen)), found])
        near.drawn = None

    @property
    def facts(self) -> list[str]:
        """Numbers of all and of shown points, as lines of HTML."""
        if self._even is None:
            return ["reading the points …"]
        whole = len(self._even) if self.blocks is None else len(self.blocks.file)
        shown, count = self._kept, self._count
        if count is None:
            count = shown if self.filter.limits else whole
        words = "all shown" if shown == count else f"{shown:,} shown"
        lines = [f"{count:,} of {whole:,} points, {words}"]
        if self._search is not None or any(near.search for near in self._near.values()):
            what = "reading all of them" if self._search is not None else "looking closer"
            lines.append(f"{what}: {self._progress:.0%}")
        elif any(near.cloud is not None for near in self._near.values()):
            lines.append("more of them from near")
        return lines

    # -- what is picked ------------------------------------------------------------------

    def _pick(self, cut: float | None) -> None:
        """Find clicked points."""
        while True:
            try:
                click = self._clicks.get_nowait()
            except Empty:
                return
            near = self._near.get(click.client_id)
            cloud = near.cloud if near is not None and near.cloud is not None else self._base()
            rows = np.flatnonzero(self._wanted(cloud, cut))
            camera = click.client.camera
            pixel = camera.fov / max(camera.image_height, 1)
            places = cloud.positions[rows] - self._origin
            at = picked(places, click.ray_origin, click.ray_direction, pixel)
            one = None if at is None else cloud.part(rows[at : at + 1])
            self.picked.take(one, click.modifier == "shift", click.ray_origin)
