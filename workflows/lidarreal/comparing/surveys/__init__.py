"""Comparison of survey clouds in world coordinates, with the statistics that surveyors use."""

from .comparing_surveys import compare_strips, compare_surveys
from .survey_comparison import SurveyComparison

__all__ = ["SurveyComparison", "compare_strips", "compare_surveys"]
