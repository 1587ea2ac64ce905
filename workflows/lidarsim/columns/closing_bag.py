"""A ROS 2 bag reader that closes its files when it is garbage-collected."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rosbags.rosbag2 import Reader


class ClosingBag(Reader):
    """A bag reader that closes its files when it is garbage-collected.

    Recordings and data sets read their bags lazily and never close them explicitly. `Reader` leaves
    the files open, which causes a ResourceWarning.
    """

    def messages(self, *args: Any, **options: Any) -> Iterator[Any]:  # type: ignore[override]
        """Yield messages like `Reader.messages`, keeping the bag open during the iteration."""
        yield from super().messages(*args, **options)

    def __del__(self) -> None:
        if getattr(self, "is_open", False):
            self.close()
