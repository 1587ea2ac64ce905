"""The 3D view of a page: scene, cloud, sensors, rays and path, and their controls."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Hashable, Sequence
from contextlib import suppress
from html import escape
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from ..columns.cloud import Cloud
from ..columns.table import Column
from ..plan import Planning
from ..render.closeup import CUT, around_ways
from ..render.theme import CLAY, object_colours, rgb
from ..run.picture_file import SensorWay, ways_of
from ..scene.scene import Scene
from ..sensor.trajectory import quaternions_of
from .cloud_view import HIDDEN, CloudView
from .colouring import as_bytes
from .labels import Labels
from .looking import Filter
from .page import LivePage, place_eye
from .surface import MeshNode, Surface, below, colours_for

MOST_POSES = 1000  # that have a ball
MOST_RAYS = 150  # more rays would hide the surfaces

_RED, _PALE = (224, 24, 45), (232, 140, 150)
_PATH, _DISC = (20, 150, 90), (120, 130, 150)
# As shares of the scene's diagonal.
_BALL, _POSE, _END = 0.009, 0.0054, 0.008
_MOVES = 0.4  # of that: motion in a large scene is shown from near
Hits = tuple[NDArray[Any], Cloud | None]  # of each triangle (f,), and points evenly chosen
_PLAY_S = (6.0, 60.0)  # limits of the playing time of a survey


class View:
    """Scene, cloud, sensors, rays and path on a page, with their controls.

    One thread draws everything, in the scene's local coordinates. Unchanged things are not drawn
    again.

    Parameters
    ----------
    page
        Where they are shown.
    scene
        The scene; None for a cloud alone.
    sensors
        Where they are in the course of time.
    table
        The columns of the cloud.
    origin
        World position of the local origin, (3,), metres.
    bounds
        Box (2, 3) of the visible scene, metres.
    duration_ns
        Duration of the survey.
    reflectance
        (objects,): of each object of the scene, 0 to 1; None if unknown.
    """

    def __init__(
        self,
        page: LivePage,
        scene: Scene | None,
        sensors: Sequence[SensorWay],
        table: Sequence[Column],
        origin: NDArray[np.float64],
        bounds: NDArray[np.float64],
        duration_ns: float = 0.0,
        reflectance: NDArray[np.float64] | None = None,
    ) -> None:
        self._page, self._scene, self._sensors = page, scene, sensors
        self._reflectance = reflectance
        self._poses = places_of(sensors)
        self._actors = () if scene is None else scene.actors
        self._actor_names = () if scene is None else scene.all_names[len(scene.names) :]
        self._origin, self._ground = origin, float(bounds[0, 2])
        near = around_ways(bounds, ways_of(sensors, self._actors, duration_ns))
        from_near = near is not None
        near = bounds if near is None else near
        self._size_m = float(np.linalg.norm(near[1] - near[0])) or 1.0
        self._columns = {column.name for column in table}
        names = {} if scene is None else {"object": scene.all_names}
        names["sensor"] = tuple(way.name for way in sensors)
        self.cloud = CloudView(page, table, names, origin, self._size_m)
        self._drawn: dict[str, Hashable] = {}  # {name: its inputs when it was drawn}
        self._surface: Surface | None = None
        self._mesh = MeshNode(page, "/scene")
        self._lines: dict[str, Any] = {}  # {name: node}; nor no lines
        self._labels = Labels(page)
        self._markers: list[Any] = []  # of the sensors, once the time is known
        self._bodies: list[Any] = []  # of the actors
        self._time: Any = None  # slider, where anything moves
        self._follow: Any = None  # checkbox, where a sensor moves
        self._trail: Any = None  # slider, where points have a time
        self._followed: NDArray[np.float64] | None = None  # last position of the carrier
        self._playing = False
        self._moved_at = 0.0  # when the time was last moved on by playing
        self._ends_ns = duration_ns
        page.frame_scene(near)
        self._add_controls(bounds, duration_ns / 1e9)
        if from_near:  # towers would hide the street
            self._cut.value = min(float(near[1, 2] + origin[2]), self._top)
        self._add_poses()
        self._add_actors()

    def _add_controls(self, bounds: NDArray[np.float64], duration_s: float) -> None:
        gui = self._page.gui
        low, high = (bounds[:, 2] + self._origin[2]).tolist()
        step = 10.0 ** math.floor(math.log10(max(high - low, 1e-3) / 50))
        first, self._top = (
            round(step * math.floor(low / step), 6),
            round(step * (math.floor(high / step) + 1), 6),
        )
        if duration_s > 0 and (self._actors or any(way.moves for way in self._sensors)):
            self._add_time(duration_s)
        self.cloud.add_controls()
        if self._scene is not None:
            colours = colours_for(self._scene, self._reflectance)
            self._scene_colour = gui.add_dropdown("scene colour", (*colours, HIDDEN))
            self._scene_legend = gui.add_html("")
        self.cloud.add_picked()
        self.cloud.add_filter()
        with gui.add_folder("view", expand_by_default=False):
            sides = (*self._page.SIDES, *(("sensor",) if self._sensors else ()))
            gui.add_button_group("look", sides).on_click(self._look)
            self._cut: Any = gui.add_slider("cut above, m", first, self._top, step, self._top)
            self.cloud.add_point_size()
            if self._scene is not None:
                self._show_rays = gui.add_checkbox("rays", initial_value=True)
            save = gui.add_button("Save picture")
            save.on_click(self._save)
            link = gui.add_button("Link to this view")
            link.on_click(self._link)
            self._link_text = gui.add_html("")

    def _add_time(self, duration_s: float) -> None:
        gui, step = self._page.gui, 10.0 ** math.floor(math.log10(duration_s / 200))
        end = round(step * math.ceil(duration_s / step), 9)  # as many digits are shown as it has
        self._time = gui.add_slider("time, s", 0.0, end, step, 0.0)
        self._play = gui.add_button("Play")
        self._play.on_click(lambda _: self._start_or_stop())
        if any(way.moves for way in self._sensors):
            self._follow = gui.add_checkbox(
                "follow", initial_value=False, hint="the carrier, with the camera"
            )
        if "time" in self._columns:
            self._trail = gui.add_slider(
                "last, s", 0.0, end, step, 0.0, hint="of the points, up to the time; 0: all"
            )

    @property
    def cut(self) -> float | None:
        """Height above which nothing is shown, metres; None to show all."""
        value = self._cut.value
        return None if value >= self._top else float(value) - float(self._origin[2])

    def _changed(self, name: str, *state: Hashable) -> bool:
        """Whether to draw something with these inputs."""
        changed = self._drawn.get(name) != state
        self._drawn[name] = state
        return changed

    def draw_cloud(self, cloud: Cloud, version: Hashable) -> None:
        """Show a sample of the points, world coordinates; see `CloudView.show`."""
        self.cloud.show(cloud, version)
        if self._trail is not None:
            length, at = self._trail.value, self._time.value
            limits = ((at - length) * 1e9, at * 1e9) if length > 0 else None
            self.cloud.trail = Filter().with_limits("time", limits)
        self.cloud.draw(self.cut, self._playing)

    def draw_labels(self) -> None:
        """Show labels where there is room, after all else is drawn."""
        self._labels.draw()

    def draw_scene(self, hits: Callable[[], Hits], version: Hashable) -> None:
        """Show the scene; another version has other hits."""
        self._mesh.settle()
        if self._scene is None:
            return
        if self._surface is None:
            self._surface = Surface(self._scene, self._reflectance)
            self._look_around(self._surface)
        colour = self._scene_colour.value
        if colour != HIDDEN and self._changed(
            "scene", version if colour == "hits" else 0, self.cut, colour
        ):
            counts, cloud = hits() if colour == "hits" else (np.zeros(0), None)
            places = np.zeros((0, 3), np.float32) if cloud is None else self._on_scene(cloud)
            corners, colours, legend = self._surface.coloured(colour, counts, places)
            corners, kept = below(corners, self.cut)
            self._scene_legend.content = legend
            self._mesh.show(corners, colours[kept])
            self._colour_actors(colour == "object")
        if self._changed("scene shown", colour == HIDDEN):
            self._mesh.set_visible(colour != HIDDEN)
            self._scene_legend.visible = colour != HIDDEN

    def _colour_actors(self, own: bool) -> None:
        """Give actors their objects' colours, or grey."""
        names = () if self._scene is None else self._scene.all_names
        colours = as_bytes(
            object_colours(len(names)) if own else rgb(CLAY)[None].repeat(len(names), 0)
        )
        for body, colour in zip(self._bodies[::-1], colours[::-1].tolist(), strict=False):
            body.color = tuple(colour)

    def _on_scene(self, cloud: Cloud) -> NDArray[np.float32]:
        """Positions (n, 3) of points on static objects, local."""
        places = (cloud.positions - self._origin).astype(np.float32)
        if self._actors and "object" in cloud.columns and self._scene is not None:
            places = places[cloud["object"] < len(self._scene.names)]
        return places

    def _look_around(self, surface: Surface) -> None:
        """Cut a building open if the sensors stand in one, and find the floor."""
        floor, roof = surface.around(self._poses)
        self._ground = self._ground if floor is None else floor
        if roof is not None and (self.cut is None or roof < self.cut):
            top = float(self._poses[:, 2].max())
            height = top + CUT * (roof - top) + float(self._origin[2])
            self._cut.value = min(max(height, self._cut.min), self._top)

    def draw_rays(self, rays: NDArray[np.float32], version: Hashable) -> None:
        """Show some of the rays (n, 2, 3) in local coordinates, if they end below the cut."""
        cut, shown = self.cut, self._show_rays.value
        if not self._changed("rays", version, cut, shown):
            return
        if cut is not None:
            rays = rays[(rays[:, :, 2] <= cut).all(axis=1)]
        self._draw_lines("/rays", rays[:: len(rays) // MOST_RAYS + 1] if shown else rays[:0])

    def _draw_lines(self, name: str, lines: NDArray[np.float32]) -> None:
        if name in self._lines:
            self._lines[name].visible = len(lines) > 0
            if len(lines):
                self._lines[name].points = lines
        elif len(lines):
            self._lines[name] = self._page.scene.add_line_segments(
                name, lines, _PALE, thickness=1.0, thickness_units="screen"
            )

    def _start_or_stop(self) -> None:
        self._playing, self._moved_at = not self._playing, time.monotonic()
        self._play.label = "Pause" if self._playing else "Play"

    def set_time(self, time_ns: float) -> None:
        """Show sensors and actors at a time, unless a user plays another."""
        if self._time is None:
            self._place(time_ns)
        elif not self._playing:
            self._time.value = time_ns / 1e9

    def draw_time(self) -> None:
        """Show sensors and actors at the chosen or played time."""
        while (choices := self._page.opened_link()) is not None:
            self.choose(choices)
        if self._time is None:
            return
        if self._playing:
            now = time.monotonic()
            speed = self._time.max / float(np.clip(self._time.max, *_PLAY_S))
            at = self._time.value + (now - self._moved_at) * speed
            self._moved_at, self._time.value = now, at % self._time.max
        self._place(self._time.value * 1e9)

    def _place(self, time_ns: float) -> None:
        time_ns = min(time_ns, self._ends_ns)  # the slider ends at a round number
        if not self._changed("time", time_ns):
            return
        scene = self._page.scene
        for number, way in enumerate(self._sensors[len(self._markers) :], len(self._markers)):
            name = f"/sensors/{number}"
            radius = _BALL * self._size_m * (_MOVES if way.moves else 1.0)
            self._markers.append(scene.add_icosphere(name, radius, _RED, cast_shadow=False))
        self._follow_carrier(time_ns)
        moving = [way for way in self._sensors if way.moves]
        if moving:  # those of one carrier are near each other
            names = ", ".join(way.name for way in moving if way.name) or "sensor"
            self._labels.put(names, moving[0].at(time_ns))
        for way in self._sensors:
            if not way.moves:
                self._labels.put(way.name or "sensor", way.at(time_ns))
        with self._page.atomic():
            for marker, way in zip(self._markers, self._sensors, strict=True):
                marker.position = way.at(time_ns)
            for body, actor, name in zip(
                self._bodies, self._actors, self._actor_names, strict=True
            ):
                positions, rotations = actor.trajectory.poses(0, np.array([time_ns]))
                body.position = positions[0]
                if rotations is not None:
                    body.wxyz = np.roll(quaternions_of(rotations)[0], 1)
                top = float(actor.mesh.vertices[:, 2].max())
                self._labels.put(name, positions[0] + [0.0, 0.0, top])

    def _follow_carrier(self, time_ns: float) -> None:
        """Move all cameras as the carrier has moved."""
        if self._follow is None:
            return
        at, before = self._carrier(time_ns), self._followed
        self._followed = at
        if self._follow.value and before is not None and (at != before).any():
            for client in self._page.get_clients().values():
                client.camera.position = client.camera.position + at - before  # looks along

    def _carrier(self, time_ns: float) -> NDArray[np.float64]:
        """Position of the first moving sensor, or of the first of all, (3,)."""
        way = next((way for way in self._sensors if way.moves), self._sensors[0])
        return way.at(time_ns)

    def _look(self, event: Any) -> None:
        """Move the camera of a browser to a side, or behind the sensor."""
        if event.client is None:
            return
        if event.target.value != "sensor":
            self._page.look_from(event.client, event.target.value)
            return
        time_ns = 0.0 if self._time is None else self._time.value * 1e9
        at = self._carrier(time_ns)
        way = self._carrier(time_ns + 0.02 * self._ends_ns) - self._carrier(
            time_ns - 0.02 * self._ends_ns
        )
        length = float(np.linalg.norm(way[:2]))
        ahead = np.array([*way[:2] / length, 0.0]) if length > 1e-6 else np.array([1.0, 0.0, 0.0])
        back = 5 * _BALL * self._size_m  # and up: it would hide everything
        eye = at - back * ahead + [0.0, 0.0, back / 2]
        place_eye(event.client, eye, at + 0.1 * self._size_m * ahead)

    def _link(self, event: Any) -> None:
        """Show a browser the link to its current view."""
        if event.client is not None:
            url = escape(self._page.link(event.client, self.choices))
            self._link_text.content = (
                '<div style="padding:0 0.8em;font-size:0.7em;word-break:break-all;'
                f'user-select:all;max-height:6em;overflow-y:auto">{url}</div>'
            )

    @property
    def choices(self) -> list[tuple[str, str]]:
        """(name, value) of the current choices, for `choose`."""
        chosen = [("cut", f"{self._cut.value:g}"), ("colour", self.cloud.colour.value)]
        if self._scene is not None:
            chosen.append(("scene", self._scene_colour.value))
        if self._time is not None:
            chosen.append(("time", f"{self._time.value:g}"))
        if self._trail is not None:
            chosen.append(("last", f"{self._trail.value:g}"))
        limits = self.cloud.filter.limits
        return chosen + [("only", f"{name},{low!r},{high!r}") for name, low, high in limits]

    def choose(self, choices: Sequence[tuple[str, str]]) -> None:
        """Apply the choices of a link; invalid ones are ignored."""
        menus: dict[str, Any] = {"colour": self.cloud.colour}
        sliders: dict[str, Any] = {"cut": self._cut, "time": self._time, "last": self._trail}
        if self._scene is not None:
            menus["scene"] = self._scene_colour
        wanted = Filter()
        for name, value in choices:
            with suppress(ValueError):
                if name in menus and value in menus[name].options:
                    menus[name].value = value
                elif (slider := sliders.get(name)) is not None:
                    slider.value = min(max(slider.min, float(value)), slider.max)
                elif name == "only":
                    column, low, high = value.split(",")
                    if column in self.cloud.filtered:
                        wanted = wanted.with_limits(column, (float(low), float(high)))
        self.cloud.set_filter(wanted)

    def _save(self, event: Any) -> None:
        if event.client is not None:
            self._page.save_picture(event.client)

    def _add_actors(self) -> None:
        for number, actor in enumerate(self._actors):
            name = f"/actors/{number}"
            self._bodies.append(
                self._page.scene.add_mesh_simple(
                    name,
                    actor.mesh.vertices,
                    actor.mesh.faces,
                    flat_shading=True,
                    side="double",
                    cast_shadow=False,
                    receive_shadow=False,
                )
            )

    def _add_poses(self) -> None:
        """Show trajectories of moving sensors as lines, and positions of others as balls."""
        for number, way in enumerate(self._sensors):
            if way.moves and len(way.positions) > 1:
                line = np.stack([way.positions[:-1], way.positions[1:]], axis=1)
                self._page.scene.add_line_segments(
                    f"/ways/{number}", line, _RED, thickness=3.0, thickness_units="screen"
                )
        standing = places_of([way for way in self._sensors if not way.moves])
        if not len(standing):
            return
        count = min(len(standing), MOST_POSES)
        some = standing[np.linspace(0, len(standing) - 1, count).astype(np.int64)]
        ball = trimesh.creation.icosphere(subdivisions=2, radius=_POSE * self._size_m)
        self._page.scene.add_batched_meshes_simple(
            "/poses",
            ball.vertices,
            ball.faces,
            batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
            batched_positions=some,
            batched_colors=_RED,
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )

    def draw_path(self, path: NDArray[np.float64], planning: Planning | None) -> None:
        """Show a path, (n, 2) in metres, and its obstacles over the ground, once."""
        if not self._changed("path"):
            return
        scene, size = self._page.scene, self._size_m
        corners = np.column_stack([path, np.full(len(path), self._ground + 0.004 * size)])
        scene.add_line_segments(
            "/path",
            np.stack([corners[:-1], corners[1:]], axis=1),
            _PATH,
            thickness=4.0,
            thickness_units="screen",
        )
        for name, at in (("start", corners[0]), ("target", corners[-1])):
            scene.add_icosphere(f"/path/{name}", _END * size, _PATH, position=at, cast_shadow=False)
            self._labels.put(name, at)
        if planning is None:
            return
        height = 0.002 * size
        for number, ((x, y), radius) in enumerate(
            zip(planning.centres.tolist(), planning.radii.tolist(), strict=True)
        ):
            scene.add_cylinder(
                f"/discs/{number}",
                radius,
                height,
                _DISC,
                radial_segments=48,
                opacity=0.35,
                cast_shadow=False,
                receive_shadow=False,
                position=(x, y, self._ground + height / 2),
            )


def places_of(sensors: Sequence[SensorWay]) -> NDArray[np.float64]:
    """All positions of sensors, (p, 3) metres, local."""
    return np.concatenate([np.empty((0, 3)), *(way.positions for way in sensors)])


def described(sensors: Sequence[SensorWay]) -> str:
    """Models of the sensors, with their names if any, as HTML."""
    words = (f"{way.name}: {way.model}" if way.name else way.model for way in sensors)
    return "<br>".join(map(escape, words))


def bounds_of(
    scene: Scene, poses: NDArray[np.float64], planning: Planning | None
) -> NDArray[np.float64]:
    """Box (2, 3) around the scene, the sensors at (p, 3) and both ends of the path, local."""
    places = [*scene.bounds, *poses]
    low, high = np.min(places, axis=0), np.max(places, axis=0)
    if planning is not None:
        ends = np.array([planning.start, planning.target])
        low[:2] = np.minimum(low[:2], ends.min(axis=0))
        high[:2] = np.maximum(high[:2], ends.max(axis=0))
    return np.stack([low, high])
