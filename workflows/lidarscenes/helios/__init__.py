"""Surveys of HELIOS++ as scenarios."""

from .survey_xml import Imported, import_survey

__all__ = ["Imported", "import_survey"]
