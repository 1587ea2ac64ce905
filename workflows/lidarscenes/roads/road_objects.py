"""Convert road objects, such as boxes, cylinders, outlines, copies, markings, and tunnels."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.io.allowance import Allowance
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.numerics.elementary import arctan2
from lidarsim.numerics.vectors import norm
from lidarsim.scene.files.scene_graph import Piece

from .cross_sections import (
    HEIGHT_SHARE,
    Intervals,
    RoadStations,
    SampledSurface,
    SurfaceSamples,
    has_extent,
    place_stations,
)
from .elements import MAX_SHOWN, UnreadElements, read_non_negative, read_number
from .lanes import LaneSection
from .road import Road, RoadFrames, RoadNetwork
from .road_marks import LIFT_M
from .road_materials import CONCRETE, PAINT, object_material
from .solids import (
    box,
    cylinder,
    extrude_sections,
    merge_pieces,
    painted_strips,
    prism,
    rotation_matrix,
    transform_points,
    zebra_stripes,
)

TUNNEL_HEIGHT_M = 5.0
TUNNEL_MARGIN_M = 0.5  # distance between the outermost lanes and the walls
STRIPE_M = 0.5  # width of stripes and gaps in crosswalks without markings
UNTYPED = "object"  # name of objects without a type, whose flat outlines may be lines or decals
_FLAT = ("crosswalk", "roadMark", "parkingSpace")  # types that are paint if they have no height
_BYTES_PER_COPY = 4000
_BYTES_PER_POINT = 400  # peak memory per point of a rail or tunnel
_TOP = [3, 2]  # corners at the top of a rail, from right to left
_CEILING = [2, 1]  # corners at the ceiling of a tunnel, from right to left
_KNOWN_OBJECTS = ("object", "objectReference", "tunnel")
_KNOWN = ("repeat", "outline", "outlines", "material", "parkingSpace", "markings")


class ObjectBuilder:
    """Builds the road objects in a file."""

    def __init__(
        self, network: RoadNetwork, sag_m: float, allowance: Allowance, unread: UnreadElements
    ) -> None:
        self._network = network
        self._sag_m = sag_m
        self._allowance = allowance
        self._unread = unread
        self._rails = _rail_pieces(network, sag_m, allowance)

    def pieces(self, road: Road, sections: Sequence[LaneSection]) -> Iterator[tuple[str, Piece]]:
        """Yield the name and triangles of each object on a road."""
        for group in road.element.iterfind("objects"):
            self._unread.check(group, _KNOWN_OBJECTS)
            for element in group.iterfind("object"):
                self._unread.check(element, _KNOWN)
                yield from self._object(road, element)
            for k, element in enumerate(group.iterfind("tunnel")):
                name = f"tunnel {road.name}/{element.get('id') or k}"
                for piece in self._tunnel(road, sections, element):
                    yield name, piece

    def _object(self, road: Road, element: Element) -> Iterator[tuple[str, Piece]]:
        """Yield the names and triangles of an object and of its copies."""
        kind = _kind(element)
        name = f"{kind[:MAX_SHOWN]} {road.name}/{(element.get('id') or '')[:MAX_SHOWN]}"
        repeats = element.findall("repeat")
        if not repeats:
            base = _Placement.from_element(element)
            for piece in self._pieces_at(road, element, kind, base):
                yield name, piece
        count = 0
        for repeat in repeats:
            if _is_rail(element, repeat):
                if repeat in self._rails:
                    yield name, self._rails[repeat]
                else:
                    self._unread.add("object without a size")
                continue
            for placement in self._copies(element, repeat):
                count += 1
                for piece in self._pieces_at(road, element, kind, placement):
                    yield f"{name}/{count}", piece

    def _pieces_at(
        self, road: Road, element: Element, kind: str, placement: _Placement
    ) -> Iterator[Piece]:
        """Yield the triangles of an object with the given placement."""
        material = object_material(kind)
        frame = _ObjectFrame.from_element(self._network, road, element, placement)
        outlines = [
            _Outline.from_element(self._network, road, outline, frame)
            for outline in _outlines(element)
        ]
        painted = [*self._markings(element, frame, placement, outlines)]
        yield from painted
        size = placement.size
        has_walls = any(outline.heights.any() for outline in outlines)
        if kind in _FLAT and not has_walls:
            # A marking on the road is drawn as its stripes or, without stripes, as its area. If it
            # states a height and has no outline, it is a box, except for parking spaces.
            if not painted and (outlines or (min(size[:2]) > 0 and size[2] <= 0)):
                yield from _flat_pieces(element, kind, frame, placement, outlines)
            elif not outlines and size[2] > 0 and kind != "parkingSpace":
                yield box(size, frame.origin, frame.turn, material)
        elif has_walls or (outlines and kind != UNTYPED):
            # Outlines with heights are walls and roofs. Outlines without heights are surfaces.
            yield _walls_and_roofs(outlines, material)
        elif placement.radius > 0 and placement.height > 0:
            yield cylinder(
                placement.radius, placement.height, frame.origin, frame.turn, material, self._sag_m
            )
        elif not outlines and max(size[:2]) > 0 and placement.height > 0:
            yield box(size, frame.origin, frame.turn, material)
        else:
            self._unread.add("object without a size")

    def _copies(self, element: Element, repeat: Element) -> Iterator[_Placement]:
        """Yield the placement of each copy of an object along a road."""
        base = _Placement.from_element(element)
        span = read_non_negative(repeat, "length", 0.0)
        distance = read_non_negative(repeat, "distance", 0.0)
        count = span / distance + 1e-6 if distance > 0 else 0
        self._allowance.reserve(int(min(count, 1e15)) * _BYTES_PER_COPY)
        for k in range(int(count) + 1):
            fraction = min(1.0, k * distance / span) if span > 0 else 0.0
            yield base.repeat_at(repeat, fraction, read_number(repeat, "s") + k * distance)

    def _markings(
        self,
        element: Element,
        frame: _ObjectFrame,
        placement: _Placement,
        outlines: Sequence[_Outline],
    ) -> Iterator[Piece]:
        """Yield the paint of markings along an object's sides or between its corners."""
        corners = {key: point for outline in outlines for key, point in outline.ids.items()}
        rectangle = transform_points(_rectangle(placement.size), frame.origin, frame.turn)
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
            width = read_non_negative(marking, "width", 0.0)
            if len(line) < 2 or not width:
                self._unread.add("marking without a line")
                continue
            starts, stops = self._dashed(np.array(line), marking)
            if len(starts):
                lift = np.array([0, 0, max(read_number(marking, "zOffset", LIFT_M), LIFT_M)])
                paint = f"{PAINT} {_paint_color(marking.get('color'))}"
                yield painted_strips(starts + lift, stops + lift, width, paint)

    def _dashed(self, line: Floats, marking: Element) -> tuple[Floats, Floats]:
        """Return where the dashes of a marking along a line start and stop."""
        dash = read_non_negative(marking, "lineLength", 0.0)
        space = read_non_negative(marking, "spaceLength", 0.0)
        starts = []
        stops = []
        for begin, end in pairwise(line):
            size = float(norm(end - begin))
            first = read_non_negative(marking, "startOffset", 0.0)
            last = size - read_non_negative(marking, "stopOffset", 0.0)
            if last <= first or size <= 0:
                continue
            count = (last - first) / (dash + space) if dash > 0 and space > 0 else 0.0
            self._allowance.reserve(int(min(count, 1e15)) * _BYTES_PER_COPY)
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
        """Yield the walls and ceiling of a tunnel that encloses all lanes of a road."""
        start = max(0.0, read_number(element, "s"))
        stop = min(road.length, start + read_non_negative(element, "length", 0.0))
        for section in sections:
            first = max(start, section.start)
            last = min(stop, section.stop)
            if last - first < TUNNEL_MARGIN_M:
                continue
            yield from self._tunnel_part(road, section, first, last)

    def _tunnel_part(
        self, road: Road, section: LaneSection, start: float, stop: float
    ) -> Iterator[Piece]:
        """Yield the walls and ceiling of a tunnel between two distances in a lane section."""
        intervals = section.intervals(road, start, stop)
        is_plain = section.is_plain and road.is_plain
        samples = intervals.surface_samples(
            are_planes=is_plain and self._network.is_straight(road, intervals)
        )
        rings = self._tunnel_rings(road, section, samples.stations)
        surface = _sampled(samples, rings[:, _CEILING], self._sag_m)
        [placed] = place_stations([surface], self._sag_m, self._allowance, _BYTES_PER_POINT)
        rings = self._tunnel_rings(road, section, placed.stations)
        for a, b in pairwise(range(4)):  # open below
            yield _sheet(rings[:, a], rings[:, b], placed.steps)

    def _tunnel_rings(self, road: Road, section: LaneSection, stations: RoadStations) -> Floats:
        """Return a tunnel's corners at each station, clockwise from the lower left."""
        borders = np.stack([*section.borders(road, stations).values()])
        left = borders.max(axis=0) + TUNNEL_MARGIN_M
        right = borders.min(axis=0) - TUNNEL_MARGIN_M
        frames = self._network.frames([road], [stations])
        corners = ((left, 0.0), (left, TUNNEL_HEIGHT_M), (right, TUNNEL_HEIGHT_M), (right, 0.0))
        return np.stack(
            [frames.origins + t[:, None] * frames.side + h * frames.up for t, h in corners],
            axis=1,
        )


class _Rail(NamedTuple):
    """An object that extends along a road, such as a guard rail."""

    road: Road
    start: float  # m
    stop: float  # m
    first: _Placement
    last: _Placement
    intervals: Intervals
    material: str

    @classmethod
    def from_element(cls, road: Road, element: Element, repeat: Element) -> _Rail | None:
        """Return the rail for a <repeat>, or None if it has no size."""
        start = read_number(repeat, "s")
        stop = min(start + read_non_negative(repeat, "length", 0.0), road.length)
        base = _Placement.from_element(element)
        first = base.repeat_at(repeat, 0.0, start)
        last = base.repeat_at(repeat, 1.0, stop)
        if stop <= start or max(first.height, last.height) <= 0:
            return None
        intervals = Intervals.between(start, stop, road.breaks)
        material = object_material(_kind(element))
        return cls(
            road=road,
            start=start,
            stop=stop,
            first=first,
            last=last,
            intervals=intervals,
            material=material,
        )

    def rings(self, stations: RoadStations, frames: RoadFrames) -> Floats:
        """Return the rail's cross sections, clockwise from the lower right. Shape (k, 4, 3)."""
        fraction = (stations.s - self.start) / (self.stop - self.start)
        first = self.first
        last = self.last
        width = np.maximum(first.wide + fraction * (last.wide - first.wide), 1e-3)
        t = first.t + fraction * (last.t - first.t)
        lower = first.z + fraction * (last.z - first.z)
        upper = lower + (first.height + fraction * (last.height - first.height))
        right_side = (t - width / 2)[:, None] * frames.side
        left_side = (t + width / 2)[:, None] * frames.side
        lower_up = lower[:, None] * frames.up
        upper_up = upper[:, None] * frames.up
        corners = (
            right_side + lower_up,
            left_side + lower_up,
            left_side + upper_up,
            right_side + upper_up,
        )
        return np.stack([frames.origins + corner for corner in corners], axis=1)


def _rail_pieces(network: RoadNetwork, sag_m: float, allowance: Allowance) -> dict[Element, Piece]:
    """Return all rails in a file, keyed by their <repeat> elements."""
    rails: dict[Element, _Rail] = {}
    for road in network.roads:
        for element in road.element.iterfind("objects/object"):
            for repeat in element.iterfind("repeat"):
                rail = (
                    _Rail.from_element(road, element, repeat) if _is_rail(element, repeat) else None
                )
                if rail is not None:
                    rails[repeat] = rail
    samples = [
        rail.intervals.surface_samples(
            are_planes=rail.road.is_plain and network.is_straight(rail.road, rail.intervals)
        )
        for rail in rails.values()
    ]
    allowance.check(4 * sum(len(entry.stations) for entry in samples) * _BYTES_PER_POINT)
    rings = _rings(network, rails.values(), [entry.stations for entry in samples])
    surfaces = [
        _sampled(entry, sections[:, _TOP], sag_m)
        for entry, sections in zip(samples, rings, strict=True)
    ]
    placed = place_stations(surfaces, sag_m, allowance, _BYTES_PER_POINT)
    rings = _rings(network, rails.values(), [entry.stations for entry in placed])
    # Where the road steps, a solid ends and another one starts.
    return {
        repeat: merge_pieces(
            [extrude_sections(part, rail.material) for part in np.split(sections, entry.steps + 1)]
        )
        for (repeat, rail), sections, entry in zip(rails.items(), rings, placed, strict=True)
    }


def _sampled(samples: SurfaceSamples, points: Floats, sag_m: float) -> SampledSurface:
    """Return the surface between two lines, given their points at the samples."""
    columns = np.moveaxis(points, 1, 0)
    is_cell = np.ones(1, np.bool_)
    return SampledSurface(samples.intervals, columns, is_cell, HEIGHT_SHARE * sag_m)


def _rings(
    network: RoadNetwork, rails: Collection[_Rail], stations: Sequence[RoadStations]
) -> Iterator[Floats]:
    """Yield each rail's cross sections at its stations. Shape (k, 4, 3)."""
    frames = network.frames([rail.road for rail in rails], stations)
    stop = 0
    for rail, at in zip(rails, stations, strict=True):
        start = stop
        stop += len(at)
        yield rail.rings(at, frames.select(slice(start, stop)))


class _Placement(NamedTuple):
    """The position and size of an object or of a copy."""

    # All values are in meters.
    s: float
    t: float
    z: float  # height above the plane of the road
    length: float
    width: float
    height: float
    radius: float  # 0 for a box
    shift: float = 0.0  # distance along the road from the object to its copy

    @classmethod
    def from_element(cls, element: Element) -> _Placement:
        """Return the placement of an <object>."""
        # A negative size counts as zero, so that a single object does not make a file unusable.
        names = ("length", "width", "height", "radius")
        sizes = [max(0.0, read_number(element, name, 0.0)) for name in names]
        return cls(
            read_number(element, "s"),
            read_number(element, "t"),
            read_number(element, "zOffset", 0.0),
            *sizes,
        )

    @property
    def size(self) -> tuple[float, float, float]:
        return self.length, self.width, self.height

    @property
    def wide(self) -> float:
        """Width in meters. For a round object, this is its diameter."""
        return 2 * self.radius if self.radius > 0 else self.width

    def repeat_at(self, repeat: Element, share: float, s: float) -> _Placement:
        """Return the placement of a copy at a given fraction of a <repeat>'s length."""
        values = {}
        for name, field in (
            ("t", "t"), ("zOffset", "z"), ("length", "length"), ("width", "width"),
            ("height", "height"), ("radius", "radius"),
        ):  # fmt: skip
            default = getattr(self, field)
            first = read_number(repeat, f"{name}Start", default)
            last = read_number(repeat, f"{name}End", first)
            value = first + share * (last - first)
            values[field] = value if field in ("t", "z") else max(0.0, value)
        return self._replace(s=s, shift=s - self.s, **values)


class _ObjectFrame(NamedTuple):
    """The coordinate frame of a placed object."""

    origin: Floats  # (3,) in meters
    turn: Floats  # (3, 3)
    shift: float  # distance of a copy along the road, in meters

    @classmethod
    def from_element(
        cls, network: RoadNetwork, road: Road, element: Element, placement: _Placement
    ) -> _ObjectFrame:
        """Return the frame of an object, which is upright even if the road slopes."""
        frames = network.frames([road], [RoadStations.at(np.array([placement.s]))])
        origin = frames.origins + placement.t * frames.side + placement.z * frames.up
        heading = float(arctan2(frames.along[0, 1], frames.along[0, 0]))
        turn = rotation_matrix(
            heading + read_number(element, "hdg", 0.0),
            read_number(element, "pitch", 0.0),
            read_number(element, "roll", 0.0),
        )
        return cls(origin[0], turn, placement.shift)


class _Outline(NamedTuple):
    """An outline of an object."""

    corners: Floats  # (n, 3) in meters
    heights: Floats  # (n,) in meters
    ids: dict[str, Floats]  # {id of a corner: its point}
    closed: bool
    outer: bool

    @classmethod
    def from_element(
        cls, network: RoadNetwork, road: Road, element: Element, frame: _ObjectFrame
    ) -> _Outline:
        points = []
        heights = []
        ids = {}
        for corner in element:
            if corner.tag == "cornerRoad":
                s = read_number(corner, "s") + frame.shift
                point = network.point(
                    road, s, read_number(corner, "t"), read_number(corner, "dz", 0.0)
                )
            elif corner.tag == "cornerLocal":
                uvz = [read_number(corner, name, 0.0) for name in "uvz"]
                point = transform_points(np.array([uvz]), frame.origin, frame.turn)[0]
            else:
                continue
            points.append(point)
            heights.append(read_non_negative(corner, "height", 0.0))
            ids[corner.get("id", "")] = point
        return cls(
            np.array(points).reshape(-1, 3),
            np.array(heights),
            ids,
            element.get("closed") != "false",
            element.get("outer") != "false",
        )


def _kind(element: Element) -> str:
    kind = element.get("type")
    return UNTYPED if kind in (None, "", "none", "-1") else kind


def _is_rail(element: Element, repeat: Element) -> bool:
    """Return True if a <repeat> extends an object along the road instead of copying it."""
    return read_non_negative(repeat, "distance", 0.0) == 0 and not _outlines(element)


def _outlines(element: Element) -> list[Element]:
    """Return those outlines of an object that have at least two corners."""
    outlines = [*element.iterfind("outline"), *element.iterfind("outlines/outline")]
    return [
        outline
        for outline in outlines
        if sum(corner.tag.startswith("corner") for corner in outline) > 1
    ]


def _walls_and_roofs(outlines: Sequence[_Outline], material: str) -> Piece:
    """Return walls along outlines, and roofs over them.

    Inner outlines are holes in the first outer outline.
    """
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
    return merge_pieces(pieces)


def _flat_pieces(
    element: Element,
    kind: str,
    frame: _ObjectFrame,
    placement: _Placement,
    outlines: Sequence[_Outline],
) -> Iterator[Piece]:
    """Yield the paint of a flat object: the stripes of a crosswalk, or the area of a mark."""
    lift = np.array([0, 0, LIFT_M])
    rings = [outline.corners for outline in outlines]
    rings = rings or [transform_points(_rectangle(placement.size), frame.origin, frame.turn)]
    for ring in rings:
        if kind == "crosswalk":
            yield zebra_stripes(ring + lift, STRIPE_M, f"{PAINT} white")
        elif kind == "roadMark":
            yield prism([ring + lift], [np.zeros(len(ring))], True, _paint_of(element))


def _rectangle(size: Sequence[float]) -> Floats:
    """Return a rectangle's counterclockwise corners, starting at the rear right."""
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


def _sheet(first: Floats, second: Floats, steps: Ints) -> Piece:
    """Return the surface between two lines of points, including walls at steps."""
    count = len(first)
    points = np.concatenate([first, second])
    a = np.arange(count - 1)
    faces = np.concatenate(
        [
            np.stack([a, a + 1, a + 1 + count], axis=1),
            np.stack([a, a + 1 + count, a + count], axis=1),
        ]
    )
    face_indices = np.concatenate([steps, steps + count - 1])
    thin = face_indices[~has_extent(points, faces[face_indices])]
    return Piece(points, np.delete(faces, thin, axis=0), material=CONCRETE)


def _paint_of(element: Element) -> str:
    """Return the paint material for an object that is a road mark."""
    stated = element.find("material")
    return f"{PAINT} {_paint_color(None if stated is None else stated.get('roadMarkColor'))}"


def _paint_color(color: str | None) -> str:
    """Return a paint color. The color "standard" means white."""
    return "white" if color in (None, "", "standard") else color[:MAX_SHOWN]
