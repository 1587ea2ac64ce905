"""Table of bridges that can be imported quickly, for example for shell completion."""

from __future__ import annotations

from typing import NamedTuple


class BridgeEntry(NamedTuple):
    """Location of a bridge class, and the extra that installs the packages that it requires."""

    target: str  # MODULE:CLASS
    extra: str = ""


# By the name that is passed to `--as`.
BRIDGES = {
    "packets": BridgeEntry("lidarlive.playback.live_sensor:PacketsBridge"),
    "ros2": BridgeEntry("lidarlive.playback.ros2:Ros2Bridge", "ros2"),
    "foxglove": BridgeEntry("lidarlive.playback.viewer_bridges:FoxgloveBridge", "live"),
    "rerun": BridgeEntry("lidarlive.playback.viewer_bridges:RerunBridge", "rerun"),
}
