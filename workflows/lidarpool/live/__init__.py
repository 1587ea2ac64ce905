"""Runs and results in the browser, on this machine alone and without the internet."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__all__ = ["LiveRun", "live_run", "shown_on_page", "view_result"]

if TYPE_CHECKING:
    from .partitions_page import shown_on_page
    from .result_page import view_result
    from .run_page import LiveRun, live_run
else:
    # viser and matplotlib take a second, and come only with a page.
    _MODULES = {
        "LiveRun": "run_page",
        "live_run": "run_page",
        "shown_on_page": "partitions_page",
        "view_result": "result_page",
    }

    def __getattr__(name: str) -> Any:
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(f".{_MODULES[name]}", __name__), name)
