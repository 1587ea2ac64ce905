"""Surveys, which combine sensors with a trajectory and environmental conditions."""

from .faults import Fault
from .survey import Mounted, ScanSpec, Survey

__all__ = ["Fault", "Mounted", "ScanSpec", "Survey"]
