"""Runs and results in the browser, on this machine alone and without the internet."""

from .viewing import view_result

__all__ = ["view_result"]
