"""Convert road signals to traffic sign plates and traffic light boxes on poles."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.numerics.arrays import Floats
from lidarsim.numerics.elementary import arctan2
from lidarsim.scene.files.scene_graph import Piece

from .cross_sections import RoadStations
from .elements import MAX_SHOWN, UnreadElements, read_non_negative, read_number
from .lanes import LaneSection
from .road import Road, RoadNetwork
from .road_materials import CARRIAGEWAY, LAMP, METAL, SIGN
from .solids import FRONT_FACES, box, cylinder, rotation_matrix

SIZE_M = 0.6  # default width and height of signs
LIGHT_M = (0.3, 0.9)  # default width and height of traffic lights
BOTTOM_M = 2.2  # default height of the lower edge of signs
PLATE_M = 0.02  # thickness of signs
LAMP_M = 0.25  # thickness of traffic lights
POLE_M = 0.038  # radius of poles
_MIN_POLE_M = 0.3  # signals with a lower bottom edge have no pole
_POLE_SAG_M = 0.003
# German signs that are painted on the road, such as lines, arrows and hatched areas.
_PAINTED = ("293", "294", "295", "296", "297", "298", "299", "340", "341")
_GERMAN = ("opendrive", "de", "deu", "ger", "germany")
_KNOWN_SIGNALS = ("signal", "signalReference")
_KNOWN = (
    "dependency", "reference", "semantics", "positionInertial", "positionRoad", "physicalPosition",
    "staticBoard", "vmsBoard",
)  # fmt: skip


class SignalBuilder(NamedTuple):
    """Builds the road signals in a file."""

    network: RoadNetwork
    unread: UnreadElements

    def pieces(self, road: Road, sections: Sequence[LaneSection]) -> Iterator[tuple[str, Piece]]:
        """Yield the name and triangles of each signal on a road."""
        for group in road.element.iterfind("signals"):
            self.unread.check(group, _KNOWN_SIGNALS)
            for element in group.iterfind("signal"):
                self.unread.check(element, _KNOWN)
                if _is_painted(element):
                    self.unread.add("signal painted on the road")
                    continue
                is_light = element.get("dynamic") in ("yes", "true", "1")
                kind = "traffic light" if is_light else "traffic sign"
                name = f"{kind} {road.name}/{(element.get('id') or '')[:MAX_SHOWN]}"
                for piece in self._signal(road, sections, element, is_light=is_light):
                    yield name, piece

    def _signal(
        self, road: Road, sections: Sequence[LaneSection], element: Element, *, is_light: bool
    ) -> Iterator[Piece]:
        """Yield a signal's pole, and its plate or box."""
        default_width, default_height = LIGHT_M if is_light else (SIZE_M, SIZE_M)
        width = read_non_negative(element, "width", 0.0) or default_width
        height = read_non_negative(element, "height", 0.0) or default_height
        position = _position(element)
        if position is not None:
            origin = np.array([read_number(position, name) for name in "xyz"])
            heading = read_number(position, "hdg", 0.0)
        else:
            frame = self._frame(road, element)
            bottom = read_number(element, "zOffset", 0.0)
            bottom = bottom if bottom > 0 else BOTTOM_M
            origin = frame.foot + np.array([0, 0, bottom])
            heading = frame.heading
            if bottom > _MIN_POLE_M and not _hangs(road, sections, element):
                # The pole is behind the sign.
                turn = rotation_matrix(heading)
                behind = (PLATE_M + LAMP_M * is_light) / 2 + POLE_M
                foot = frame.foot - behind * turn[:, 0]
                yield cylinder(POLE_M, bottom + height, foot, turn, METAL, _POLE_SAG_M)
        turn = rotation_matrix(
            heading, read_number(element, "pitch", 0.0), read_number(element, "roll", 0.0)
        )
        thickness = LAMP_M if is_light else PLATE_M
        solid = box((thickness, width, height), origin, turn, METAL)
        if is_light:
            yield solid._replace(material=LAMP)
            return
        is_front = np.zeros(len(solid.faces), np.bool_)
        is_front[FRONT_FACES] = True
        yield solid._replace(faces=solid.faces[~is_front])
        yield solid._replace(faces=solid.faces[is_front], material=SIGN)

    def _frame(self, road: Road, element: Element) -> _SignalFrame:
        """Return the frame of a signal so that it faces the traffic for which it is valid."""
        placement = element.find("positionRoad")
        if placement is None:
            placement = element.find("physicalPosition/positionRoad")
        source = element if placement is None else placement
        at = RoadStations.at(np.array([read_number(source, "s")]))
        frames = self.network.frames([road], [at])
        foot = frames.origins[0] + read_number(source, "t") * frames.side[0]
        if road.has_curved_sections:
            t = np.array([read_number(source, "t")])
            foot = foot + road.heights(at, t)[0] * frames.up[0]
        heading = float(arctan2(frames.along[0, 1], frames.along[0, 0]))
        if element.get("orientation", "+") != "-":  # it faces traffic in the direction of the road
            heading += np.pi
        return _SignalFrame(foot, heading + read_number(source, "hOffset", 0.0))


class _SignalFrame(NamedTuple):
    """The foot and heading of a signal."""

    foot: Floats  # (3,) point on the plane of the road, in meters
    heading: float  # direction that the signal faces, in radians


def _position(element: Element) -> Element | None:
    """Return a signal's <positionInertial> element, or None if it has none."""
    position = element.find("positionInertial")
    return element.find("physicalPosition/positionInertial") if position is None else position


def _is_painted(element: Element) -> bool:
    """Return True if a signal is painted on the road, such as a stop line."""
    country = element.get("country", "").lower()
    return element.get("type") in _PAINTED and country in _GERMAN


def _hangs(road: Road, sections: Sequence[LaneSection], element: Element) -> bool:
    """Return True if a signal hangs above lanes on which vehicles drive."""
    s = read_number(element, "s")
    t = read_number(element, "t")
    section = next((x for x in sections if x.start <= s <= x.stop), None)
    if section is None:
        return False
    at = RoadStations.at(np.array([s]))
    borders = {key: float(t[0]) for key, t in section.borders(road, at).items()}
    for lane in section.all_lanes:
        inner = max(
            (k for k in borders if abs(k) < abs(lane.number) and k * lane.number >= 0),
            key=abs,
            default=0,
        )
        lower, upper = sorted((borders[inner], borders[lane.number]))
        if lane.type in CARRIAGEWAY and lower < t < upper:
            return True
    return False
