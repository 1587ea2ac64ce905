"""The 3D view of a page: scene, cloud, sensors, rays and path, and their controls."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Hashable, Sequence
from contextlib import suppress
from dataclasses import replace
from html import escape
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from ..columns.cloud import Cloud
from ..columns.table import Column
from ..render.closeup import CUT, around_ways, floor_and_roof
from ..render.theme import CLAY, object_colours, rgb
from ..run.picture_file import Pictured, ways_of
from ..sensor.trajectory import quaternions_of
from .cloud_view import HIDDEN, CloudView
from .colouring import as_bytes
from .labels import Labels
from .looking import Filter, Limits, within
from .page import LivePage, place_eye
from .surface import MeshNode, Surface, below, colours_for

Floats = NDArray[np.float64]
Rays = NDArray[np.float32]  # (n, 2, 3), metres, local
NO_RAYS: Rays = np.zeros((0, 2, 3), np.float32)
NO_TRIANGLES = np.zeros((0, 3, 3), np.float32)
MOST_POSES = 1000  # that have a ball
MOST_RAYS = 150  # more rays would hide the surfaces

_RED, _PALE = (224, 24, 45), (232, 140, 150)
_PATH, _DISC = (20, 150, 90), (120, 130, 150)
# As shares of the scene's diagonal.
_BALL, _POSE, _END = 0.009, 0.0054, 0.008
_MOVES = 0.4  # of that: motion in a large scene is shown from near
_PLAY_S = (6.0, 60.0)  # limits of the playing time of a survey


class View:
    """Scene, cloud, sensors, rays and path on a page, with their controls.

    One thread draws everything, in the scene's local coordinates. Unchanged things are not drawn
    again. `table` has the columns of the cloud. For a cloud alone, without `pictured`, `around` is
    the world position of the local origin, (3,), and the cloud's box (2, 3) from there.
    """

    def __init__(
        self,
        page: LivePage,
        table: Sequence[Column],
        pictured: Pictured | None,
        around: tuple[Floats, Floats] | None = None,
    ) -> None:
        self._page = page
        self._scene = None if pictured is None else pictured.scene
        self._reflectance = None if pictured is None else pictured.reflectance
        self._planning = None if pictured is None else pictured.planning
        self._sensors = () if pictured is None else pictured.sensors
        self._actors = () if self._scene is None else self._scene.actors
        self._first_actor = 0 if self._scene is None else len(self._scene.names)
        self._ends_ns = 0.0 if pictured is None else pictured.duration_ns
        self._poses = np.concatenate([np.empty((0, 3)), *(way.positions for way in self._sensors)])
        self.origin, bounds = around or _whole(pictured, self._poses)
        self._ground = float(bounds[0, 2])
        near = around_ways(bounds, ways_of(self._sensors, self._actors, self._ends_ns))
        from_near = near is not None
        near = bounds if near is None else near
        self._size_m = float(np.linalg.norm(near[1] - near[0])) or 1.0
        self._labels = Labels(page)
        names = {} if pictured is None else {c.name: pictured.names_of(c) for c in table}
        self.cloud = CloudView(page, self._labels, table, names, self.origin, self._size_m)
        self._drawn: dict[str, Hashable] = {}  # {name: its inputs when it was drawn}
        # {limits of the objects: surface}; of all, and of those that were shown last
        self._surfaces: dict[Limits, Surface] = {}
        self._mesh = MeshNode(page, "/scene")
        self._rays: Any = None  # viser shows no lines without points
        self._markers: list[Any] = []  # of the sensors, once the time is known
        self._bodies: list[Any] = []  # of the actors
        self._linked: dict[str, Any] = {}  # {name in a link: slider or menu}
        self._time: Any = None  # slider, where anything moves
        self._follow: Any = None  # checkbox, where a sensor moves
        self._trail: Any = None  # slider, where points have a time
        self._followed: Floats | None = None  # last position of the carrier
        self._playing = False
        self._moved_at = 0.0  # when the time was last moved on by playing
        page.frame_scene(near)
        self._add_controls(bounds, any(column.name == "time" for column in table))
        if from_near:  # towers would hide the street
            self._cut.value = min(float(near[1, 2] + self.origin[2]), self._top)
        self._add_poses()
        self._add_actors()

    def _add_controls(self, bounds: Floats, timed: bool) -> None:
        gui = self._page.gui
        low, high = (bounds[:, 2] + self.origin[2]).tolist()
        step = 10.0 ** math.floor(math.log10(max(high - low, 1e-3) / 50))
        first, self._top = (
            round(step * math.floor(low / step), 6),
            round(step * (math.floor(high / step) + 1), 6),
        )
        carried = any(way.moves for way in self._sensors)
        if self._ends_ns > 0 and (self._actors or carried):
            self._add_time(self._ends_ns / 1e9, carried, timed)
        self.cloud.add_colour()
        if self._scene is not None:
            colours = colours_for(self._scene, self._reflectance)
            self._scene_colour = gui.add_dropdown("scene colour", (*colours, HIDDEN))
            self._scene_legend = gui.add_html("")
            self._linked["scene"] = self._scene_colour
        self.cloud.add_filter()
        with gui.add_folder("view", expand_by_default=False):
            sides = (*self._page.SIDES, *(("sensor",) if self._sensors else ()))
            gui.add_button_group("look", sides).on_click(self._look)
            self._cut: Any = gui.add_slider("cut above, m", first, self._top, step, self._top)
            self._point_size = gui.add_slider("point size", 0.1, 4.0, 0.1, 1.0)
            if self._scene is not None:
                self._show_rays = gui.add_checkbox("rays", initial_value=True)
            gui.add_button("Save picture").on_click(self._save)
            gui.add_button("Link to this view").on_click(self._link)
            self._link_text = gui.add_html("")
        self._linked |= {"cut": self._cut, "colour": self.cloud.colour}

    def _add_time(self, duration_s: float, carried: bool, timed: bool) -> None:
        gui, step = self._page.gui, 10.0 ** math.floor(math.log10(duration_s / 200))
        end = round(step * math.ceil(duration_s / step), 9)  # as many digits are shown as it has
        self._time = self._linked["time"] = gui.add_slider("time, s", 0.0, end, step, 0.0)
        self._play = gui.add_button("Play")
        self._play.on_click(lambda _: self._start_or_stop())
        if carried:
            self._follow = gui.add_checkbox(
                "follow", initial_value=False, hint="the carrier, with the camera"
            )
        if timed:
            self._trail = self._linked["last"] = gui.add_slider(
                "last, s", 0.0, end, step, 0.0, hint="of the points, up to the time; 0: all"
            )

    @property
    def cut(self) -> float | None:
        """Height above which nothing is shown, metres; None to show all."""
        value = self._cut.value
        return None if value >= self._top else float(value) - float(self.origin[2])

    def _changed(self, name: str, *state: Hashable) -> bool:
        """Whether to draw something with these inputs."""
        changed = self._drawn.get(name) != state
        self._drawn[name] = state
        return changed

    def draw(
        self,
        cloud: Cloud | None,
        version: Hashable,
        hits: Callable[[], NDArray[Any]] = lambda: np.zeros(0),
        hits_version: Hashable = 0,
        rays: Rays = NO_RAYS,
        rays_version: Hashable = 0,
        path: Floats | None = None,
    ) -> None:
        """Draw what has changed, as the versions tell.

        `cloud` is an evenly spaced sample of the points, in world coordinates; `hits` returns the
        hits of each triangle, (f,); `path` is the planned path, (n, 2) metres.
        """
        self._draw_time()
        self._draw_scene(hits, hits_version, cloud)
        if self._scene is not None:
            self._draw_rays(rays, rays_version)
        if path is not None and self._changed("path"):
            self._draw_path(path)
        if cloud is not None:
            self.cloud.show(cloud, version)
            if self._trail is not None:
                length, at = self._trail.value, self._time.value
                limits = ((at - length) * 1e9, at * 1e9) if length > 0 else None
                self.cloud.trail = Filter().with_limits("time", limits)
            self.cloud.draw(self.cut, self._point_size.value, self._playing)
        self._labels.draw()

    def _draw_scene(
        self, hits: Callable[[], NDArray[Any]], version: Hashable, cloud: Cloud | None
    ) -> None:
        """Show the surfaces of all objects, or of those that the filter keeps."""
        self._mesh.settle()
        if self._scene is None:
            return
        if not self._surfaces:
            self._surfaces[None] = Surface(self._scene, self._reflectance)
            self._look_around(self._surfaces[None])
        colour, only = self._scene_colour.value, self.cloud.filter.of("object")
        seen = version if colour == "hits" else 0
        if self._changed("scene", seen, self.cut, colour, only):
            rows = within(self._scene.face_object, only)
            corners, colours, legend = NO_TRIANGLES, np.zeros((0, 3), np.uint8), ""
            if colour != HIDDEN and rows.any():
                counts, places = np.zeros(0), NO_TRIANGLES[:, 0]
                if colour == "hits":
                    counts, places = hits()[rows], self._on_scene(cloud, only)
                corners, colours, legend = self._surface(only, rows).coloured(
                    colour, counts, places
                )
            corners, kept = below(corners, self.cut)
            self._scene_legend.content = legend
            self._mesh.show(corners, colours[kept])
            self._colour_actors(colour == "object")

    def _surface(self, only: Limits, rows: NDArray[np.bool_]) -> Surface:
        """Surface of the objects within these limits, whose triangles are these (f,)."""
        scene, whole = self._scene, self._surfaces[None]
        assert scene is not None
        if only not in self._surfaces:
            part = replace(scene, faces=scene.faces[rows], face_object=scene.face_object[rows])
            self._surfaces = {None: whole, only: Surface(part, self._reflectance)}
        return self._surfaces[only]

    def _colour_actors(self, own: bool) -> None:
        """Give actors their objects' colours, or grey."""
        count = self._first_actor + len(self._bodies)
        colours = object_colours(count) if own else np.tile(rgb(CLAY), (count, 1))
        for body, colour in zip(self._bodies, as_bytes(colours[self._first_actor :]), strict=True):
            body.color = tuple(colour.tolist())

    def _on_scene(self, cloud: Cloud | None, only: Limits) -> NDArray[np.float32]:
        """Positions (n, 3) of points on static objects, local."""
        if cloud is None:
            return NO_TRIANGLES[:, 0]
        places = (cloud.positions - self.origin).astype(np.float32)
        if "object" in cloud.columns and self._scene is not None:
            static = cloud["object"] < len(self._scene.names)
            places = places[static & within(cloud["object"], only)]
        return places

    def _look_around(self, surface: Surface) -> None:
        """Cut a building open if the sensors stand in one, and find the floor."""
        floor, roof = floor_and_roof(surface.coarse, self._poses)
        self._ground = self._ground if floor is None else floor
        if roof is not None and (self.cut is None or roof < self.cut):
            top = float(self._poses[:, 2].max())
            height = top + CUT * (roof - top) + float(self.origin[2])
            self._cut.value = min(max(height, self._cut.min), self._top)

    def _draw_rays(self, rays: Rays, version: Hashable) -> None:
        """Show some of the rays if they end below the cut and no object is looked at alone."""
        cut = self.cut
        shown = self._show_rays.value and self.cloud.filter.of("object") is None
        if not self._changed("rays", version, cut, shown):
            return
        if cut is not None:
            rays = rays[(rays[:, :, 2] <= cut).all(axis=1)]
        rays = rays[:: len(rays) // MOST_RAYS + 1]
        if self._rays is not None:
            self._rays.visible = shown and len(rays) > 0
            if self._rays.visible:
                self._rays.points = rays
        elif shown and len(rays):
            self._rays = self._page.scene.add_line_segments(
                "/rays", rays, _PALE, thickness=1.0, thickness_units="screen"
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

    def _draw_time(self) -> None:
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
        only = self.cloud.filter.of("object")
        hidden = self._scene is not None and self._scene_colour.value == HIDDEN
        if not self._changed("time", time_ns, only, hidden):
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
            for number, (body, actor) in enumerate(zip(self._bodies, self._actors, strict=True)):
                positions, rotations = actor.trajectory.poses(0, np.array([time_ns]))
                body.position = positions[0]
                if rotations is not None:
                    body.wxyz = np.roll(quaternions_of(rotations)[0], 1)
                wanted = bool(within(self._first_actor + number, only))
                body.visible = wanted and not hidden
                top = positions[0] + [0.0, 0.0, float(actor.mesh.vertices[:, 2].max())]
                self._labels.put(actor.name, top if wanted else None)

    def _follow_carrier(self, time_ns: float) -> None:
        """Move all cameras as the carrier has moved."""
        if self._follow is None:
            return
        before, self._followed = self._followed, self._carrier(time_ns)
        if self._follow.value and before is not None:
            for client in self._page.get_clients().values():  # the camera looks along
                client.camera.position = client.camera.position + self._followed - before

    def _carrier(self, time_ns: float) -> Floats:
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
        time_ns, step = 0.0 if self._time is None else self._time.value * 1e9, 0.02 * self._ends_ns
        at = self._carrier(time_ns)
        way = self._carrier(time_ns + step) - self._carrier(time_ns - step)
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
        values = {name: control.value for name, control in self._linked.items()}
        chosen = [(n, v if isinstance(v, str) else f"{v:g}") for n, v in values.items()]
        limits = self.cloud.filter.limits
        return chosen + [("only", f"{name},{low!r},{high!r}") for name, low, high in limits]

    def choose(self, choices: Sequence[tuple[str, str]]) -> None:
        """Apply the choices of a link; invalid ones are ignored."""
        wanted = Filter()
        for name, value in choices:
            control = self._linked.get(name)
            with suppress(ValueError):
                if name == "only":
                    column, low, high = value.split(",")
                    if column in self.cloud.columns:
                        wanted = wanted.with_limits(column, (float(low), float(high)))
                elif control is None:
                    continue
                elif not isinstance(control.value, str):
                    control.value = min(max(control.min, float(value)), control.max)
                elif value in control.options:
                    control.value = value
        self.cloud.set_filter(wanted)

    def _save(self, event: Any) -> None:
        if event.client is not None:
            self._page.save_picture(event.client)

    def _add_actors(self) -> None:
        for number, actor in enumerate(self._actors):
            body = self._page.scene.add_mesh_simple(
                f"/actors/{number}",
                actor.mesh.vertices,
                actor.mesh.faces,
                flat_shading=True,
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            )
            self._bodies.append(body)

    def _add_poses(self) -> None:
        """Show trajectories of moving sensors as lines, and positions of others as balls."""
        for number, way in enumerate(self._sensors):
            if way.moves and len(way.positions) > 1:
                line = np.stack([way.positions[:-1], way.positions[1:]], axis=1)
                self._page.scene.add_line_segments(
                    f"/ways/{number}", line, _RED, thickness=3.0, thickness_units="screen"
                )
        standing = [place for way in self._sensors if not way.moves for place in way.positions]
        if not standing:
            return
        count = min(len(standing), MOST_POSES)
        some = np.array(standing)[np.linspace(0, len(standing) - 1, count).astype(np.int64)]
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

    def _draw_path(self, path: Floats) -> None:
        """Show a path, (n, 2) in metres, and its obstacles over the ground."""
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
        if self._planning is None:
            return
        height = 0.002 * size
        for number, ((x, y), radius) in enumerate(
            zip(self._planning.centres.tolist(), self._planning.radii.tolist(), strict=True)
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


def _whole(pictured: Pictured | None, poses: Floats) -> tuple[Floats, Floats]:
    """Local origin, and the box (2, 3) around scene, sensors at (p, 3) and ends of the path."""
    assert pictured is not None
    places = np.concatenate([pictured.scene.bounds, poses])
    low, high = places.min(axis=0), places.max(axis=0)
    if pictured.planning is not None:
        ends = np.array([pictured.planning.start, pictured.planning.target])
        low[:2] = np.minimum(low[:2], ends.min(axis=0))
        high[:2] = np.maximum(high[:2], ends.max(axis=0))
    return pictured.scene.origin, np.stack([low, high])
