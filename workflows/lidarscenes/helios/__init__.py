"""Surveys and scanners of HELIOS++ as scenarios."""

from .import_scanner import import_scanner, is_scanner
from .survey_xml import Imported, import_survey

__all__ = ["Imported", "import_scanner", "import_survey", "is_scanner"]
