"""Convert HELIOS++ surveys and scanners to scenarios."""

from .import_scanner import import_scanner, is_scanner
from .survey_xml import ImportedSurvey, import_survey

__all__ = ["ImportedSurvey", "import_scanner", "import_survey", "is_scanner"]
