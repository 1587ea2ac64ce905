"""Runs and results in the browser, on this machine alone and without the internet."""

from .live_run import LiveRun, live_run
from .viewing import view_result

__all__ = ["LiveRun", "live_run", "view_result"]
