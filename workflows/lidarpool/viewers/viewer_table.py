"""The table of viewers, quick to import for the help of commands."""

from __future__ import annotations

from typing import NamedTuple


class ViewerRow(NamedTuple):
    """A kind of viewers: its class and its packages."""

    target: str  # module and class, which is called with an address and a title
    package: str  # import package
    distribution: str
    extra: str  # extra of lidarpool that installs the distribution


PAGE = "page"  # the run's own page, in place of a viewer
VIEWERS = {
    "foxglove": ViewerRow(
        "lidarpool.viewers.foxglove_server:FoxgloveServer",
        "foxglove",
        "foxglove-sdk",
        "live",
    ),
    "rerun": ViewerRow("lidarpool.viewers.rerun_server:RerunServer", "rerun", "rerun-sdk", "rerun"),
}
