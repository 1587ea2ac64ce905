"""Collect notes on what is missing from a world or not read, and report them briefly."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from xml.etree.ElementTree import Element

from lidarsim.words import list_names, plural, printable

_MAX_NAMES = 12  # maximum number of names in a note

# Child elements that SDFormat 1.0 to 1.12 defines. They are either read or irrelevant to lidars.
_POSED = ("pose", "frame", "plugin", "origin")
_KNOWN: dict[str, frozenset[str]] = {
    tag: frozenset(text.split())
    for tag, text in {
        "sdf": "world model actor light",
        "world": "actor atmosphere audio frame gravity gui include joint light magnetic_field "
        "model physics plugin road scene spherical_coordinates state wind",
        "model": "allow_auto_disable enable_wind frame gripper include joint link model plugin "
        "pose self_collide static",
        "link": "audio_sink audio_source battery collision damping enable_wind frame gravity "
        "inertial kinematic light must_be_base_link particle_emitter plugin pose projector "
        "self_collide sensor velocity_decay visual",
        "visual": "cast_shadows frame geometry laser_retro material meta plugin pose transparency "
        "visibility_flags",
        "collision": "auto_inertia_params density frame geometry laser_retro max_contacts pose "
        "surface",
        "include": "name placement_frame plugin pose static uri",
        "mesh": "scale submesh uri",
        "heightmap": "blend pos sampling size texture uri use_terrain_paging",
        "road": "material point width",
        "sensor": "air_pressure air_speed altimeter always_on camera contact enable_metrics "
        "force_torque frame_id gps gz_frame_id ignition_frame_id imu lidar logical_camera "
        "magnetometer navsat noise ray rfid rfidtag sonar topic transceiver update_rate visualize",
        "lidar": "noise range scan visibility_mask",
        "ray": "noise range scan visibility_mask",
        "scan": "horizontal vertical",
        "horizontal": "max_angle min_angle resolution samples",
        "vertical": "max_angle min_angle resolution samples",
        "range": "max min resolution",
        "noise": "bias_mean bias_stddev dynamic_bias_correlation_time dynamic_bias_stddev mean "
        "precision stddev type",
        "actor": "animation joint link plugin pose script skin",
    }.items()
}


def unknown_children(element: Element) -> list[str]:
    """Return an element's children that SDFormat does not define, as PARENT/TAG.

    Tags with a namespace prefix are allowed.
    """
    defined_tags = _KNOWN[element.tag]
    tags = dict.fromkeys(child.tag for child in element)
    return [
        f"{element.tag}/{printable(tag)[:40]}"
        for tag in tags
        if tag not in defined_tags and ":" not in tag and tag not in _POSED
    ]


class Notes:
    """Notes on a world, each of which is only reported once."""

    def __init__(self) -> None:
        self.missing_models: Counter[str] = Counter()  # {name: number of uses}
        self.missing_files: Counter[str] = Counter()
        self.unread_files: dict[str, str] = {}  # {name: reason}
        self.unknown: dict[str, None] = {}  # elements, as PARENT/TAG
        self.without_visuals: dict[str, None] = {}  # links with collision shapes only
        self.hidden: dict[str, None] = {}  # links with fully transparent visuals
        self.invisible: dict[str, None] = {}  # links with visuals that no lidar sees
        self.remote: dict[str, None] = {}  # models that are too far away
        self.bright: dict[str, None] = {}  # links with a <laser_retro> brighter than white
        self.further: dict[str, None] = {}  # clauses
        self.of_meshes: dict[str, None] = {}  # lines on mesh files

    def check_children(self, element: Element) -> None:
        """Note which children of an element are not defined by SDFormat."""
        self.unknown |= dict.fromkeys(unknown_children(element))

    def remote_lines(self) -> Iterator[str]:
        """Yield a phrase on models that are too far away, unless there are none."""
        if self.remote:
            names = list_names([*self.remote], _MAX_NAMES)
            yield (
                "models that are more than 1,000 km away or whose position is not a number "
                f"({names})"
            )

    def lines(self) -> Iterator[str]:
        """Yield all notes as clauses that can follow the name of the file."""
        yield from _line("model", self.missing_models)
        yield from _line("file", self.missing_files)
        for name, reason in list(self.unread_files.items())[:_MAX_NAMES]:
            yield f"refers to {name}, which was skipped: {reason.rstrip('.')}"
        if self.unknown:
            yield (
                "contains elements that are not supported and were skipped: "
                f"{list_names([*self.unknown], _MAX_NAMES)}"
            )
        for links, reason in (
            (self.without_visuals, "without visuals, whose collision shapes were skipped"),
            (self.hidden, "with fully transparent visuals, which were skipped"),
            (self.invisible, "with visuals whose <visibility_flags> are 0, which were skipped"),
            (self.bright, "with a <laser_retro> above 255, which was limited to 255"),
        ):
            if links:
                yield f"contains links {reason}: {list_names([*links])}"
        yield from (f"contains {line}, which were skipped" for line in self.remote_lines())
        yield from self.further
        yield from _first_lines([*self.of_meshes])


def _line(noun: str, names: Counter[str]) -> Iterator[str]:
    """Yield a clause on missing models or files unless there are none."""
    if names:
        count = plural(len(names), f"missing {noun}")
        uses = f" in {names.total():,} places" if names.total() > len(names) else ""
        outcome = "It was skipped" if len(names) == 1 else "They were skipped"
        yield f"refers to {count}{uses}: {list_names([*names], _MAX_NAMES)}. {outcome}"


def _first_lines(lines: Iterable[str], max_lines: int = 3) -> Iterator[str]:
    """Yield the first few notes on meshes, and how many more there are."""
    all_lines = [*lines]
    yield from (f"has a note on a mesh: {line.rstrip('.')}" for line in all_lines[:max_lines])
    further = len(all_lines) - max_lines
    if further > 0:
        yield f"has {plural(further, 'further note')} on meshes"
