"""Bags of ROS 2 that are closed with the last object that reads them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rosbags.rosbag2 import Reader


class ClosingBag(Reader):
    """A bag that is closed when it is no longer used, unless it was closed before.

    Recordings and data sets read their bags lazily and have no end of their own. rosbags leaves the
    files open, which Python reports by a ResourceWarning.
    """

    def messages(self, *args: Any, **options: Any) -> Iterator[Any]:  # type: ignore[override]
        """Yield messages as `Reader.messages` does, and keep the bag open meanwhile."""
        yield from super().messages(*args, **options)

    def __del__(self) -> None:
        if getattr(self, "is_open", False):
            self.close()
