"""The table of bridges, quick to import for the completion of commands."""

from __future__ import annotations

from typing import NamedTuple


class BridgeEntry(NamedTuple):
    """Where a bridge is implemented, and the extra that installs its packages."""

    target: str  # module and class
    extra: str = ""


# {name for --as: the bridge}
BRIDGES = {
    "packets": BridgeEntry("lidarpool.playback.live_sensor:PacketsBridge"),
    "ros2": BridgeEntry("lidarpool.playback.ros2:Ros2Bridge", "ros2"),
    "foxglove": BridgeEntry("lidarpool.playback.viewer_bridges:FoxgloveBridge", "live"),
    "rerun": BridgeEntry("lidarpool.playback.viewer_bridges:RerunBridge", "rerun"),
}
