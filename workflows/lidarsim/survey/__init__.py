"""Surveys: sensors on a carrier or at stations, and their faults."""

from .faults import Fault
from .survey import Mounted, ScanSpec, Survey

__all__ = ["Fault", "Mounted", "ScanSpec", "Survey"]
