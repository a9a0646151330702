"""Small studies, and settings that keep their analysis short."""

from study_fixtures import quick, sessions, study, without_figures, written

__all__ = ["quick", "sessions", "study", "without_figures", "written"]
