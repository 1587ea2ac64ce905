"""Recorded sweeps: comparison, fitted sensors, simulated weather, and reconstructed scenes."""

from lidarsim.environment.lazy_names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        ".augmentation.effects": "Effects Insertion",
        ".augmentation.transform": "Augment augment",
        ".comparing.comparison": "Comparison",
        ".comparing.fit.fitting": "Fit fit",
        ".comparing.surveys": "SurveyComparison compare_strips compare_surveys",
        ".comparing.two_clouds": "compare",
        ".reconstruction.building": "twin",
        ".reconstruction.twin": "Twin",
        ".scan_patterns": "PatternFit fit_pattern",
    },
)
