"""Read OpenDRIVE files (.xodr) according to ASAM OpenDRIVE 1.4 to 1.8.

libOpenDRIVE is not used, because it reads neither lane borders nor lateral shapes.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.io.allowance import Allowance
from lidarsim.io.xmlfile import xml_root
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.colors import Colors
from lidarsim.scene.files.coordinate_systems import (
    center_of,
    includes_offset,
    scale_problem,
    world_advice,
)
from lidarsim.scene.files.scene_graph import Content, MeshFileError, Piece, ReadOptions, join_pieces
from lidarsim.scene.scene_instances import SceneInstance
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.schema.declared import about

from .elements import UnreadElements, read_number
from .lanes import Lane, SectionSurface, lane_sections, section_surfaces
from .road import Road, RoadNetwork
from .road_marks import painted_quads
from .road_materials import CARRIAGEWAY, CLASSES, CONCRETE, PAINT, lane_material, material_color
from .road_objects import ObjectBuilder
from .signals import SignalBuilder

# Roads in a junction overlap. Other lanes are lowered by these distances, so that rays hit the
# lanes on which vehicles drive.
_SINK_OF_NONE_M = 0.005
_SINK_M = 0.002
_SMALLER = "use a larger sag_m, or divide the file"
_KNOWN = ("header", "road", "junction", "junctionGroup", "controller", "station")
_KNOWN_OF_JUNCTIONS = ("connection", "priority", "controller", "surface", "crossPath")
_UTM = re.compile(r"\+proj=utm\b.*\+zone=(\d{1,2})\b")
_EPSG = re.compile(r"(?i)\bepsg:(\d{4,6})\b")

Pieces = dict[str, list[Piece]]  # {name of an object: its triangles}


@dataclass(frozen=True)
class RoadOptions:
    """Options for reading OpenDRIVE roads."""

    sag_m: Annotated[
        float,
        about(
            "maximum distance in meters between curves and their triangles (.xodr only)", gt=0, le=1
        ),
    ] = 0.01


def read_xodr(data: bytes, path: Path, options: ReadOptions) -> Content:
    """Read the roads in a file with lanes, marks, objects, and signals."""
    # Comments before the XML declaration are common, although they are invalid.
    root = xml_root(data[max(data.find(b"<?xml"), 0) :])
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    if root.tag != "OpenDRIVE":
        raise MeshFileError(
            f"is an XML file, but not an OpenDRIVE file. Its root element is <{root.tag[:40]}>"
        )
    header = root.find("header")
    if header is not None and read_number(header, "revMajor", 1.0) > 1:
        raise MeshFileError(
            f"uses OpenDRIVE {header.get('revMajor')}, but only versions 1.4 to 1.8 are supported"
        )
    unread = UnreadElements()
    unread.check(root, _KNOWN)
    for junction in root.iterfind("junction"):
        unread.check(junction, _KNOWN_OF_JUNCTIONS)
    allowance = Allowance(len(data), _SMALLER)
    reader = _RoadReader(options, allowance, unread)
    network = RoadNetwork(root.findall("road"), allowance, unread)
    content = Content(reader.meshes(network))
    content.unit_m = 1.0
    content.up_axis = "z"
    content.classes = CLASSES
    content.is_landscape = True
    content.notes = _notes(header, content.meshes, unread)
    return content


class _RoadReader:
    """Converts the roads in a file to meshes."""

    def __init__(self, options: ReadOptions, allowance: Allowance, unread: UnreadElements) -> None:
        self._options = options
        self._allowance = allowance
        self._unread = unread
        self._pieces: Pieces = defaultdict(list)
        own: RoadOptions = options.own
        self._sag_m = own.sag_m

    def meshes(self, network: RoadNetwork) -> list[SceneMesh]:
        """Convert the roads, and return the meshes of all objects."""
        sections_of_roads = [lane_sections(road, self._unread) for road in network.roads]
        sections = [
            (road, section)
            for road, road_sections in zip(network.roads, sections_of_roads, strict=True)
            for section in road_sections
        ]
        surfaces = section_surfaces(network, sections, self._sag_m, self._allowance)
        for (road, _), surface in zip(sections, surfaces, strict=True):
            self._add_section(road, surface)
        objects = ObjectBuilder(network, self._sag_m, self._allowance, self._unread)
        signals = SignalBuilder(network, self._unread)
        for road, road_sections in zip(network.roads, sections_of_roads, strict=True):
            for name, piece in objects.pieces(road, road_sections):
                self._add(name, piece)
            for name, piece in signals.pieces(road, road_sections):
                self._add(name, piece)
        self._drop_degenerate()
        return [
            mesh
            for name, pieces in self._pieces.items()
            for mesh in join_pieces(name, pieces, self._allowance)
        ]

    def _add_section(self, road: Road, surface: SectionSurface) -> None:
        """Add a lane section's lanes and road marks."""
        for strip in (*surface.strips, *surface.curbs):
            lane = strip.lane
            material = CONCRETE if strip.is_curb else _material(lane)
            points = strip.points.reshape(-1, 3)
            if road.in_junction and lane.type not in CARRIAGEWAY and not strip.is_curb:
                sink_m = _SINK_OF_NONE_M if lane.type == "none" else _SINK_M
                points = points - np.array([0, 0, sink_m])
            piece = Piece(points, strip.faces, material=material)
            self._add(f"{lane.type} lane {road.name}/{lane.number}", piece)
        for quads in painted_quads(surface, self._allowance, self._unread):
            piece = Piece(quads.points, quads.faces, material=f"{PAINT} {quads.color}")
            self._add(f"road mark {road.name}", piece)

    def _add(self, name: str, piece: Piece) -> None:
        """Add triangles to an object, including colors and materials if requested."""
        if not len(piece.faces):
            return
        colors = None
        if self._options.colors:
            colors = Colors.plain(material_color(piece.material), len(piece.faces))
        material = piece.material if self._options.materials else ""
        self._pieces[name].append(piece._replace(colors=colors, material=material))

    def _drop_degenerate(self) -> None:
        """Remove triangles without an area, for example where a lane's width becomes zero."""
        pieces = [piece for pieces in self._pieces.values() for piece in pieces]
        corners = [piece.vertices[piece.faces[:, k]] for k in range(3) for piece in pieces]
        if not corners:
            return
        a, b, c = np.concatenate(corners).reshape(3, -1, 3)
        areas = np.cross(b - a, c - a)
        has_area = np.asarray(areas.any(axis=1))
        if has_area.all():
            return
        stop = 0
        for name, object_pieces in self._pieces.items():
            remaining = []
            for piece in object_pieces:
                start = stop
                stop += len(piece.faces)
                mask = has_area[start:stop]
                if mask.all():
                    remaining.append(piece)
                elif mask.any():
                    face_indices = np.flatnonzero(mask)
                    colors = None if piece.colors is None else piece.colors.take(face_indices)
                    remaining.append(piece._replace(faces=piece.faces[face_indices], colors=colors))
            self._pieces[name] = remaining


def _material(lane: Lane) -> str:
    stated = lane.element.find("material")
    return lane_material(lane.type, None if stated is None else stated.get("surface"))


def _notes(
    header: Element | None,
    meshes: Sequence[SceneMesh | SceneInstance],
    unread: UnreadElements,
) -> list[str]:
    """Return notes on the coordinate system of a file and on unread elements."""
    notes = []
    if header is not None:
        notes = _reference_notes(header, center_of(meshes))
    listed = str(unread)
    if listed:
        notes.append(f"contains elements that were skipped: {listed}")
    return notes


def _reference_notes(header: Element, middle: Floats) -> list[str]:
    """Return notes on the coordinate system and offset in a file header.

    `middle` (2,) is the center of the roads.
    """
    text = " ".join((header.findtext("geoReference") or "").split())
    epsg = _epsg(text)
    offset = header.find("offset")
    shift = [0.0] * 4
    if offset is not None:
        shift = [read_number(offset, name, 0.0) for name in ("x", "y", "z", "hdg")]
    system = f"EPSG:{epsg}" if epsg else f"the coordinate system {text[:80]!r}"
    is_placed = includes_offset(middle, np.array(shift[:2]))
    place = (
        middle if is_placed else middle + shift[:2]
    )  # approximate if a heading rotates the roads about their origin
    problem = scale_problem(f"EPSG:{epsg}" if epsg else text, *place.tolist()) if text else ""
    if problem:
        system += f", {problem}"
    if is_placed:
        where = system if text else "its coordinate system"
        return [
            f"is already in {where}. It also contains the same offset, which must not be applied "
            "again"
        ]
    if any(shift):
        x, y, z, heading = shift
        moves = [f"translation [{x:.12g}, {y:.12g}, {z:.9g}]"]
        if heading:
            moves.append(f"rotation_deg [0, 0, {np.degrees(heading):.9g}]")
        where = system if text else "its coordinate system"
        all_of_it = "" if heading else f". {world_advice(x, y, z)}"
        return [
            f"contains an offset, which was not applied. To move the roads to {where}, use "
            f"{' and '.join(moves)}{all_of_it}"
        ]
    if problem:
        return [f"uses {system}"]
    if epsg:
        return [f"uses EPSG:{epsg}. To write this code to LAS files, use <world.epsg={epsg}>"]
    if text:
        return [f"uses {system}, which was ignored"]
    return []


def _epsg(text: str) -> int | None:
    """Return the EPSG code in a PROJ definition, or None if there is none.

    Explicit codes and UTM zones with WGS 84 are recognized.
    """
    code = _EPSG.search(text)
    if code:
        return int(code[1])
    zone = _UTM.search(text)
    if zone and 1 <= int(zone[1]) <= 60 and re.search(r"\+(datum|ellps)=WGS84\b", text):
        return (32700 if "+south" in text else 32600) + int(zone[1])
    return None
