"""Recordings whose parts are functions, and recordings in which some parts are replaced."""

from __future__ import annotations

from lidarfiles.clouds.recording import PointCloud, Recording, RecordingInfo

_PARTS = {  # {keyword: method of `Recording`}
    "read": "load",
    "fired": "load_fired",
    "read_stamps": "load_stamps",
    "read_poses": "load_poses",
    "read_boxes": "load_boxes",
    "read_classes": "load_classes",
}


class _MadeRecording(Recording):
    def __init__(self, info, count, functions):
        super().__init__(info)
        self._count = count
        self._functions = functions

    def __len__(self):
        return self._count

    def load(self, number):
        return self._functions["read"](number)

    def load_fired(self, number):
        return self._functions["fired"](number)

    def load_stamps(self):
        return self._read("read_stamps")

    def load_poses(self):
        return self._read("read_poses")

    def load_boxes(self):
        return self._read("read_boxes")

    def load_classes(self):
        return self._read("read_classes") or {}

    def _read(self, part):
        function = self._functions.get(part)
        return None if function is None else function()


def made_recording(name, count, read, **changes):
    """Return a recording whose sweeps are returned by a function.

    `changes` are fields of `RecordingInfo` and the keywords of `_PARTS`, whose values are functions
    or None.
    """
    functions = {part: changes.pop(part) for part in [*changes] if part in _PARTS}
    info = RecordingInfo(name, has_firing_poses=functions.get("fired") is not None, **changes)
    return _MadeRecording(info, count, {"read": read} | functions)


class MadeCloud(PointCloud):
    """A cloud whose parts are in memory."""

    def __init__(self, name, parts):
        super().__init__(RecordingInfo(name))
        self.parts = parts

    def __len__(self):
        return len(self.parts)

    def load(self, number):
        return self.parts[number]


def changed_recording(recording, count=None, **changes):
    """Return a recording in which some parts and some fields of its info are replaced."""
    functions = {part: getattr(recording, method) for part, method in _PARTS.items()}
    for part in [*changes]:
        if part in _PARTS:
            functions[part] = changes.pop(part)
            if part == "fired":
                changes["has_firing_poses"] = functions[part] is not None
    info = recording.with_info(**changes).info
    return _MadeRecording(info, len(recording) if count is None else count, functions)
