"""Small studies, and settings that keep their analysis short."""

from study_fixtures import quick, study, without_figures, written

__all__ = ["quick", "study", "without_figures", "written"]
