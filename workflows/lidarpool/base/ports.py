"""What lower rooms call of higher ones: the package itself, which knows all, connects them."""

from __future__ import annotations

from collections.abc import Callable

save_cloud: Callable[..., list[str]]  # `lidarpool.export.formats.save`, for `Cloud.save`
