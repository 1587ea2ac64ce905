from .augmentation.effects import Effects as Effects
from .augmentation.effects import Insertion as Insertion
from .augmentation.transform import Augment as Augment
from .augmentation.transform import augment as augment
from .comparing.comparison import Comparison as Comparison
from .comparing.fit.fitting import Fit as Fit
from .comparing.fit.fitting import fit as fit
from .comparing.surveys import SurveyComparison as SurveyComparison
from .comparing.surveys import compare_strips as compare_strips
from .comparing.surveys import compare_surveys as compare_surveys
from .comparing.two_clouds import compare as compare
from .reconstruction.building import twin as twin
from .reconstruction.twin import Twin as Twin
from .scan_patterns import PatternFit as PatternFit
from .scan_patterns import fit_pattern as fit_pattern

__all__ = [
    "Augment",
    "Comparison",
    "Effects",
    "Fit",
    "Insertion",
    "PatternFit",
    "SurveyComparison",
    "Twin",
    "augment",
    "compare",
    "compare_strips",
    "compare_surveys",
    "fit",
    "fit_pattern",
    "twin",
]
