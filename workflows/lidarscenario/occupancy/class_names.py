"""Classes of Occ3D-nuScenes, and the corresponding names in other data sets."""

from __future__ import annotations

OCC3D_CLASSES = (
    "others", "barrier", "bicycle", "bus", "car", "construction_vehicle", "motorcycle",
    "pedestrian", "traffic_cone", "trailer", "truck", "driveable_surface", "other_flat",
    "sidewalk", "terrain", "manmade", "vegetation",
)  # fmt: skip
# Names in SemanticKITTI, Cityscapes and nuScenes-lidarseg, and everyday names.
_SYNONYMS = {
    "bicycle": ("bike", "bicyclist", "cyclist", "vehicle.bicycle"),
    "bus": ("vehicle.bus.rigid", "vehicle.bus.bendy"),
    "car": ("vehicle.car",),
    "construction_vehicle": ("vehicle.construction",),
    "motorcycle": ("motorcyclist", "vehicle.motorcycle"),
    "pedestrian": ("person", "human.pedestrian.adult", "human.pedestrian.child"),
    "traffic_cone": ("cone", "movable_object.trafficcone"),
    "barrier": ("movable_object.barrier", "guard_rail"),
    "trailer": ("vehicle.trailer",),
    "truck": ("vehicle.truck",),
    "driveable_surface": ("road", "parking", "lane_marking", "flat.driveable_surface"),
    "other_flat": ("other_ground", "flat.other"),
    "sidewalk": ("pavement", "flat.sidewalk"),
    "terrain": ("ground", "grass", "flat.terrain"),
    "manmade": (
        "building", "wall", "fence", "pole", "traffic_sign", "traffic_light", "house",
        "static.manmade", "bridge", "kerb", "curb",
    ),
    "vegetation": ("tree", "trunk", "bush", "static.vegetation"),
}  # fmt: skip
_NUMBERS = {name: number for number, name in enumerate(OCC3D_CLASSES)} | {
    synonym: OCC3D_CLASSES.index(name) for name, words in _SYNONYMS.items() for synonym in words
}


def occ3d_class(name: str) -> int | None:
    """Return the class of Occ3D for a class name, or None if there is no equivalent.

    Examples
    --------
    >>> occ3d_class("Traffic cone"), occ3d_class("building"), occ3d_class("cloud")
    (8, 15, None)
    """
    return _NUMBERS.get(name.strip().lower().replace(" ", "_").replace("-", "_"))
