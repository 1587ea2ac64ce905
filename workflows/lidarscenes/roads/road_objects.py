"""Objects beside and on roads: boxes, cylinders, outlines, rows of copies, markings and tunnels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.base.allowance import Allowance
from lidarsim.base.arrays import Floats
from lidarsim.base.elementary import arctan2
from lidarsim.base.vectors import length
from lidarsim.scene.files.scene_graph import Piece

from .elements import MAX_SHOWN, UnreadElements, number, positive
from .lanes import LaneSection
from .materials import CONCRETE, PAINT, material_of_object
from .road import Network, Road
from .road_marks import LIFT_M
from .solids import box, cylinder, extruded, painted_strips, placed, prism, rotation, zebra

TUNNEL_HEIGHT_M = 5.0
TUNNEL_MARGIN_M = 0.5  # from the outermost lanes to the walls
STRIPE_M = 0.5  # stripes and gaps of crosswalks that state no markings
UNTYPED = "object"  # name of objects without a type, whose flat outlines may be lines or decals
_FLAT = ("crosswalk", "roadMark", "parkingSpace")  # types that are paint if they have no height
_BYTES_PER_COPY = 4000
_KNOWN_OBJECTS = ("object", "objectReference", "tunnel")
_KNOWN = ("repeat", "outline", "outlines", "material", "parkingSpace", "markings")


class ObjectBuilder(NamedTuple):
    """Builder of the objects of a file."""

    network: Network
    sag_m: float
    allowance: Allowance
    unread: UnreadElements

    def pieces(self, road: Road, sections: Sequence[LaneSection]) -> Iterator[tuple[str, Piece]]:
        """Yield the names and triangles of the objects of a road."""
        for group in road.element.iterfind("objects"):
            self.unread.check(group, _KNOWN_OBJECTS)
            for element in group.iterfind("object"):
                self.unread.check(element, _KNOWN)
                yield from self._object(road, element)
            for k, element in enumerate(group.iterfind("tunnel")):
                name = f"tunnel {road.name}/{element.get('id') or k}"
                for piece in self._tunnel(road, sections, element):
                    yield name, piece

    def _object(self, road: Road, element: Element) -> Iterator[tuple[str, Piece]]:
        """Yield the names and triangles of an object and of its copies."""
        kind = element.get("type")
        if kind in (None, "", "none", "-1"):
            kind = UNTYPED
        name = f"{kind[:MAX_SHOWN]} {road.name}/{(element.get('id') or '')[:MAX_SHOWN]}"
        repeats = element.findall("repeat")
        if not repeats:
            base = _Placement.of(element)
            for piece in self._pieces_at(road, element, kind, base):
                yield name, piece
        count = 0
        for repeat in repeats:
            if positive(repeat, "distance", 0.0) == 0 and not _outlines(element):
                strip = self._continuous(road, element, repeat, kind)
                if strip is not None:
                    yield name, strip
                continue
            for placement in self._copies(element, repeat):
                count += 1
                for piece in self._pieces_at(road, element, kind, placement):
                    yield f"{name}/{count}", piece

    def _pieces_at(
        self, road: Road, element: Element, kind: str, placement: _Placement
    ) -> Iterator[Piece]:
        """Yield the triangles of an object at a placement."""
        material = material_of_object(kind)
        frame = _ObjectFrame.of(self.network, road, element, placement)
        outlines = [
            _Outline.of(self.network, road, outline, frame) for outline in _outlines(element)
        ]
        painted = [*self._markings(element, frame, placement, outlines)]
        yield from painted
        size = placement.size
        has_walls = any(outline.heights.any() for outline in outlines)
        if kind in _FLAT and not has_walls:
            if not painted and (outlines or (min(size[:2]) > 0 and size[2] <= 0)):
                yield from _flat_pieces(element, kind, frame, placement, outlines)
            elif not outlines and size[2] > 0 and kind != "parkingSpace":
                yield box(size, frame.origin, frame.turn, material)
        elif has_walls or (outlines and kind != UNTYPED):
            yield _roof(outlines, material)
        elif placement.radius > 0 and placement.height > 0:
            yield cylinder(
                placement.radius, placement.height, frame.origin, frame.turn, material, self.sag_m
            )
        elif not outlines and max(size[:2]) > 0 and placement.height > 0:
            yield box(size, frame.origin, frame.turn, material)
        else:
            self.unread.add("object without a size")

    def _copies(self, element: Element, repeat: Element) -> Iterator[_Placement]:
        """Yield the placements of the copies of an object along a road."""
        base = _Placement.of(element)
        span = positive(repeat, "length", 0.0)
        distance = positive(repeat, "distance", 0.0)
        count = span / distance + 1e-6 if distance > 0 else 0
        self.allowance.take(int(min(count, 1e15)) * _BYTES_PER_COPY)
        for k in range(int(count) + 1):
            share = min(1.0, k * distance / span) if span > 0 else 0.0
            yield base.repeated(repeat, share, number(repeat, "s") + k * distance)

    def _continuous(self, road: Road, element: Element, repeat: Element, kind: str) -> Piece | None:
        """Return an object that is drawn along a road, such as a guard rail; None without size."""
        start = number(repeat, "s")
        stop = min(start + positive(repeat, "length", 0.0), road.length)
        base = _Placement.of(element)
        first = base.repeated(repeat, 0.0, start)
        last = base.repeated(repeat, 1.0, stop)
        if stop <= start or max(first.height, last.height) <= 0:
            self.unread.add("object without a size")
            return None
        stations = self._stations(road, start, stop)
        share = (stations - start) / (stop - start)

        def along(a: float, b: float) -> Floats:
            return np.asarray(a + share * (b - a))

        width = np.maximum(along(first.wide, last.wide), 1e-3)
        t = along(first.t, last.t)
        lower = along(first.z, last.z)
        upper = lower + along(first.height, last.height)
        ring = [(-0.5, lower), (0.5, lower), (0.5, upper), (-0.5, upper)]
        frames = self.network.frames([road], [stations])
        sections = np.stack(
            [
                frames.origins
                + (t + side * width)[:, None] * frames.side
                + height[:, None] * frames.up
                for side, height in ring
            ],
            axis=1,
        )
        return extruded(sections, material_of_object(kind))

    def _stations(self, road: Road, start: float, stop: float) -> Floats:
        """Return distances (k,) at which a line along a road is cut, within the tolerance."""
        breaks = road.breaks
        inside = breaks[(breaks > start) & (breaks < stop)]
        breaks = np.unique(np.concatenate([[start], inside, [stop]]))
        starts = breaks[:-1]
        stops = breaks[1:]
        bend = self.network.max_curvatures(road, starts, stops)
        bend = bend * 2 + road.elevation.max_bends(starts, stops)
        counts = np.ceil((stops - starts) * np.sqrt(bend / (8 * self.sag_m)))
        counts = np.maximum(1, np.minimum(counts, 1e9)).astype(np.int64)
        self.allowance.take(int(counts.sum()) * _BYTES_PER_COPY)
        pieces = [
            a + (b - a) * np.arange(n) / n
            for a, b, n in zip(starts.tolist(), stops.tolist(), counts.tolist(), strict=True)
        ]
        return np.concatenate([*pieces, [stop]])

    def _markings(
        self,
        element: Element,
        frame: _ObjectFrame,
        placement: _Placement,
        outlines: Sequence[_Outline],
    ) -> Iterator[Piece]:
        """Yield the painted edges of an object."""
        corners = {key: point for outline in outlines for key, point in outline.ids.items()}
        rectangle = placed(_rectangle(placement.size), frame.origin, frame.turn)
        sides = {
            "right": rectangle[[0, 1]],
            "front": rectangle[[1, 2]],
            "left": rectangle[[2, 3]],
            "rear": rectangle[[3, 0]],
        }
        for marking in element.iterfind("markings/marking"):
            references = [corner.get("id", "") for corner in marking.iterfind("cornerReference")]
            if references:
                line = [corners[key] for key in references if key in corners]
            else:
                line = [*sides.get(marking.get("side", ""), ())]
            width = positive(marking, "width", 0.0)
            if len(line) < 2 or not width:
                self.unread.add("marking without a line")
                continue
            starts, stops = self._dashed(np.array(line), marking)
            if len(starts):
                lift = np.array([0, 0, max(number(marking, "zOffset", LIFT_M), LIFT_M)])
                paint = f"{PAINT} {_paint_colour(marking.get('color'))}"
                yield painted_strips(starts + lift, stops + lift, width, paint)

    def _dashed(self, line: Floats, marking: Element) -> tuple[Floats, Floats]:
        """Return starts and stops (d, 3) of the dashes of a marking along a line (n, 3)."""
        dash = positive(marking, "lineLength", 0.0)
        space = positive(marking, "spaceLength", 0.0)
        starts = []
        stops = []
        for begin, end in pairwise(line):
            size = float(length(end - begin))
            first = positive(marking, "startOffset", 0.0)
            last = size - positive(marking, "stopOffset", 0.0)
            if last <= first or size <= 0:
                continue
            count = (last - first) / (dash + space) if dash > 0 and space > 0 else 0.0
            self.allowance.take(int(min(count, 1e15)) * _BYTES_PER_COPY)
            offsets = first + (dash + space) * np.arange(int(count) + 1)
            offsets = offsets[offsets < last]
            ends = np.minimum(offsets + dash, last) if count else np.array([last])
            direction = (end - begin) / size
            starts.append(begin + offsets[:, None] * direction)
            stops.append(begin + ends[:, None] * direction)
        if not starts:
            return np.zeros((0, 3)), np.zeros((0, 3))
        return np.concatenate(starts), np.concatenate(stops)

    def _tunnel(
        self, road: Road, sections: Sequence[LaneSection], element: Element
    ) -> Iterator[Piece]:
        """Yield the walls and the ceiling of a tunnel around all lanes of a road."""
        start = max(0.0, number(element, "s"))
        stop = min(road.length, start + positive(element, "length", 0.0))
        for section in sections:
            first = max(start, section.start)
            last = min(stop, section.stop)
            if last - first < TUNNEL_MARGIN_M:
                continue
            stations = self._stations(road, first, last)
            borders = np.stack([*section.borders(road, stations).values()])
            left = borders.max(axis=0) + TUNNEL_MARGIN_M
            right = borders.min(axis=0) - TUNNEL_MARGIN_M
            frames = self.network.frames([road], [stations])
            corners = ((left, 0.0), (left, TUNNEL_HEIGHT_M), (right, TUNNEL_HEIGHT_M), (right, 0.0))
            rings = np.stack(
                [frames.origins + t[:, None] * frames.side + h * frames.up for t, h in corners],
                axis=1,
            )
            for a, b in ((0, 1), (1, 2), (2, 3)):  # open below
                yield _sheet(rings[:, a], rings[:, b])


class _Placement(NamedTuple):
    """Place and size of an object or of a copy."""

    s: float  # m
    t: float  # m
    z: float  # above the plane of the road, m
    length: float  # m
    width: float  # m
    height: float  # m
    radius: float  # m; 0 for a box
    shift: float = 0.0  # of a copy along the road from the object, m

    @classmethod
    def of(cls, element: Element) -> _Placement:
        """Return the placement of an <object>."""
        # A broken size of one object is no reason to refuse a file: it counts as no size.
        names = ("length", "width", "height", "radius")
        sizes = [max(0.0, number(element, name, 0.0)) for name in names]
        return cls(
            number(element, "s"), number(element, "t"), number(element, "zOffset", 0.0), *sizes
        )

    @property
    def size(self) -> tuple[float, float, float]:
        """Length, width and height, m."""
        return self.length, self.width, self.height

    @property
    def wide(self) -> float:
        """Width, or diameter of a round object, m."""
        return 2 * self.radius if self.radius > 0 else self.width

    def repeated(self, repeat: Element, share: float, s: float) -> _Placement:
        """Return the placement of a copy at a share of the way along a <repeat>."""
        values = {}
        for name, field in (
            ("t", "t"), ("zOffset", "z"), ("length", "length"), ("width", "width"),
            ("height", "height"), ("radius", "radius"),
        ):  # fmt: skip
            default = getattr(self, field)
            first = number(repeat, f"{name}Start", default)
            last = number(repeat, f"{name}End", first)
            value = first + share * (last - first)
            values[field] = value if field in ("t", "z") else max(0.0, value)
        return self._replace(s=s, shift=s - self.s, **values)


class _ObjectFrame(NamedTuple):
    """Frame of an object: its origin, and the directions of its axes."""

    origin: Floats  # (3,), m
    turn: Floats  # (3, 3)
    shift: float  # of a copy along the road, m

    @classmethod
    def of(
        cls, network: Network, road: Road, element: Element, placement: _Placement
    ) -> _ObjectFrame:
        """Return the frame of an object, which is upright whatever the slope of the road."""
        frames = network.frames([road], [np.array([placement.s])])
        origin = frames.origins + placement.t * frames.side + placement.z * frames.up
        heading = float(arctan2(frames.along[0, 1], frames.along[0, 0]))
        turn = rotation(
            heading + number(element, "hdg", 0.0),
            number(element, "pitch", 0.0),
            number(element, "roll", 0.0),
        )
        return cls(origin[0], turn, placement.shift)


class _Outline(NamedTuple):
    """An outline of an object."""

    corners: Floats  # (n, 3), m
    heights: Floats  # (n,), m
    ids: dict[str, Floats]  # {id of a corner: its point}
    closed: bool
    outer: bool

    @classmethod
    def of(cls, network: Network, road: Road, element: Element, frame: _ObjectFrame) -> _Outline:
        """Return the outline of an <outline>."""
        points = []
        heights = []
        ids = {}
        for corner in element:
            if corner.tag == "cornerRoad":
                s = np.array([number(corner, "s") + frame.shift])
                t = np.array([number(corner, "t")])
                point = network.points(road, s, t, number(corner, "dz", 0.0))[0]
            elif corner.tag == "cornerLocal":
                uvz = [number(corner, name, 0.0) for name in "uvz"]
                point = placed(np.array([uvz]), frame.origin, frame.turn)[0]
            else:
                continue
            points.append(point)
            heights.append(positive(corner, "height", 0.0))
            ids[corner.get("id", "")] = point
        return cls(
            np.array(points).reshape(-1, 3),
            np.array(heights),
            ids,
            element.get("closed") != "false",
            element.get("outer") != "false",
        )


def _outlines(element: Element) -> list[Element]:
    """Return the outlines of an object that have two corners or more."""
    outlines = [*element.iterfind("outline"), *element.iterfind("outlines/outline")]
    return [
        outline
        for outline in outlines
        if sum(corner.tag.startswith("corner") for corner in outline) > 1
    ]


def _roof(outlines: Sequence[_Outline], material: str) -> Piece:
    """Return walls and roofs over outlines; inner outlines are holes of the first outer one."""
    outer = [outline for outline in outlines if outline.outer]
    holes = [outline for outline in outlines if not outline.outer and outline.closed]
    pieces = []
    for k, outline in enumerate(outer or holes):
        rings = [outline, *holes] if outer and not k and outline.closed else [outline]
        pieces.append(
            prism(
                [ring.corners for ring in rings],
                [ring.heights for ring in rings],
                outline.closed,
                material,
            )
        )
    counts = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
    return Piece(
        np.concatenate([piece.vertices for piece in pieces]),
        np.concatenate(
            [piece.faces + start for piece, start in zip(pieces, counts.tolist(), strict=False)]
        ),
        material=material,
    )


def _flat_pieces(
    element: Element,
    kind: str,
    frame: _ObjectFrame,
    placement: _Placement,
    outlines: Sequence[_Outline],
) -> Iterator[Piece]:
    """Yield the paint of an object without height: stripes, or the whole area of a mark."""
    lift = np.array([0, 0, LIFT_M])
    rings = [outline.corners for outline in outlines]
    rings = rings or [placed(_rectangle(placement.size), frame.origin, frame.turn)]
    for ring in rings:
        if kind == "crosswalk":
            yield zebra(ring + lift, STRIPE_M, f"{PAINT} white")
        elif kind == "roadMark":
            yield prism([ring + lift], [np.zeros(len(ring))], True, _paint_of(element))


def _rectangle(size: Sequence[float]) -> Floats:
    """Return the corners (4, 3) of a length and a width, from the rear right corner to the left."""
    half_length = size[0] / 2
    half_width = size[1] / 2
    return np.array(
        [
            [-half_length, -half_width, 0],
            [half_length, -half_width, 0],
            [half_length, half_width, 0],
            [-half_length, half_width, 0],
        ]
    )


def _sheet(first: Floats, second: Floats) -> Piece:
    """Return the surface between two lines of points (k, 3)."""
    count = len(first)
    a = np.arange(count - 1)
    faces = np.concatenate(
        [
            np.stack([a, a + 1, a + 1 + count], axis=1),
            np.stack([a, a + 1 + count, a + count], axis=1),
        ]
    )
    return Piece(np.concatenate([first, second]), faces, material=CONCRETE)


def _paint_of(element: Element) -> str:
    """Return the paint of an object that is a mark."""
    stated = element.find("material")
    return f"{PAINT} {_paint_colour(None if stated is None else stated.get('roadMarkColor'))}"


def _paint_colour(colour: str | None) -> str:
    """Return the colour of paint; the standard colour is white."""
    return "white" if colour in (None, "", "standard") else colour[:MAX_SHOWN]
