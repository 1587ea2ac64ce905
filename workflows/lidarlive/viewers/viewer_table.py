"""Table of viewers that can be imported quickly, for example for command-line help."""

from __future__ import annotations

from typing import NamedTuple


class ViewerRow(NamedTuple):
    """Class of a viewer, and the packages that it requires."""

    target: str  # MODULE:CLASS, which is called with an address and a title
    package: str  # name of the import package
    distribution: str
    extra: str  # extra of lidarpool that installs the distribution


PAGE = "page"  # the live page of the run instead of a viewer
VIEWERS = {
    "foxglove": ViewerRow(
        "lidarlive.viewers.foxglove_server:FoxgloveServer",
        "foxglove",
        "foxglove-sdk",
        "live",
    ),
    "rerun": ViewerRow("lidarlive.viewers.rerun_server:RerunServer", "rerun", "rerun-sdk", "rerun"),
}
