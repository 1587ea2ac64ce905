"""Define the materials of roads, their colors, and the object classes."""

from __future__ import annotations

from functools import cache

import numpy as np

from lidarsim.numerics.arrays import Bytes
from lidarsim.scene.colors import as_srgb
from lidarsim.scene.files.scene_graph import ObjectClass

ASPHALT = "asphalt"
CONCRETE = "concrete"
EARTH = "earth"
GRASS = "grass"
PAINT = "paint"  # a color may follow, as in "paint white"
SIGN = "sign face"
LAMP = "lamp"
METAL = "metal"
LEAVES = "leaves"
WALL = "wall"

# {material: reflectance for red, green and blue light}. Luminances come from measured spectra at
# 905 nm (`lidarsim.media.materials.reflectances`) where the table has the material.
_LINEAR = {
    ASPHALT: (0.13, 0.13, 0.13),
    CONCRETE: (0.31, 0.31, 0.31),
    EARTH: (0.34, 0.31, 0.25),
    GRASS: (0.3, 0.62, 0.2),
    SIGN: (0.8, 0.8, 0.8),
    LAMP: (0.1, 0.1, 0.1),
    METAL: (0.4, 0.4, 0.4),
    LEAVES: (0.25, 0.58, 0.15),
    WALL: (0.5, 0.4, 0.3),
    f"{PAINT} white": (0.6, 0.6, 0.6),
    f"{PAINT} yellow": (0.65, 0.5, 0.02),
    f"{PAINT} red": (0.5, 0.03, 0.03),
    f"{PAINT} blue": (0.03, 0.1, 0.5),
    f"{PAINT} green": (0.03, 0.35, 0.1),
    f"{PAINT} orange": (0.6, 0.2, 0.02),
    f"{PAINT} violet": (0.3, 0.03, 0.4),
    f"{PAINT} black": (0.03, 0.03, 0.03),
}
_OTHER = (0.5, 0.5, 0.5)

# {lane type: material}. All other lanes are asphalt.
_LANES = {
    "sidewalk": CONCRETE,
    "walking": CONCRETE,
    "curb": CONCRETE,
    "median": GRASS,
    "none": EARTH,
}
# {object type: material}. All other objects are concrete.
_OBJECTS = {
    "building": WALL,
    "tree": LEAVES,
    "vegetation": LEAVES,
    "pole": METAL,
    "streetLamp": METAL,
    "gantry": METAL,
    "railing": METAL,
    "car": METAL,
    "van": METAL,
    "bus": METAL,
    "trailer": METAL,
    "train": METAL,
    "tram": METAL,
    "bike": METAL,
    "motorbike": METAL,
}
# Words in the attribute `surface` of lanes, and their materials.
_SURFACES = {
    "asphalt": ASPHALT,
    "concrete": CONCRETE,
    "pavement": CONCRETE,
    "cobble": CONCRETE,
    "grass": GRASS,
    "gravel": EARTH,
    "soil": EARTH,
}

# Types of lanes on which vehicles drive.
CARRIAGEWAY = (
    "driving", "bidirectional", "bus", "taxi", "HOV", "entry", "exit", "mwyEntry", "mwyExit",
    "onRamp", "offRamp", "connectingRamp", "slipLane", "shared", "stop",
)  # fmt: skip

# Class 1 is for types without a class in ASPRS LAS. Classes from 64 on are user-defined.
CLASSES = {
    1: ObjectClass("unclassified", ("obstacle *", "object *", "patch *", "wind *")),
    2: ObjectClass("ground", ("none lane *", "median lane *")),
    5: ObjectClass("high vegetation", ("tree *", "vegetation *")),
    6: ObjectClass("building", ("building *",)),
    10: ObjectClass("rail", ("rail lane *", "tram lane *")),
    11: ObjectClass(
        "road surface",
        tuple(
            f"{lane_type} lane *"
            for lane_type in (
                "bidirectional", "border", "bus", "connectingRamp", "driving", "entry", "exit",
                "HOV", "mwyEntry", "mwyExit", "offRamp", "onRamp", "parking", "restricted",
                "roadWorks", "shared", "shoulder", "slipLane", "special?", "stop", "taxi",
            )
        ),
    ),
    64: ObjectClass("road mark", ("road mark *", "crosswalk *", "parkingSpace *", "roadMark *")),
    65: ObjectClass("sidewalk", ("sidewalk lane *", "walking lane *", "curb lane *")),
    66: ObjectClass("cycle lane", ("biking lane *",)),
    67: ObjectClass("barrier", ("barrier *", "railing *", "soundBarrier *")),
    68: ObjectClass("pole", ("pole *", "streetLamp *", "gantry *")),
    69: ObjectClass("traffic sign", ("traffic sign *",)),
    70: ObjectClass("traffic light", ("traffic light *",)),
    71: ObjectClass("traffic island", ("trafficIsland *",)),
    72: ObjectClass("tunnel", ("tunnel *",)),
}  # fmt: skip


@cache
def material_color(material: str) -> Bytes:
    """Return the sRGB color for a material. Shape (1, 1, 3)."""
    return as_srgb(np.array(_LINEAR.get(material, _OTHER)).reshape(1, 1, 3))


def lane_material(lane_type: str, surface: str | None) -> str:
    """Return the material of a lane, given its type and the surface stated in the file."""
    for word, material in _SURFACES.items():
        if surface and word in surface.lower():
            return material
    return _LANES.get(lane_type, ASPHALT)


def object_material(object_type: str) -> str:
    """Return the material of an object, given its type."""
    return _OBJECTS.get(object_type, CONCRETE)
