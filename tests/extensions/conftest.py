"""Small studies, and settings that keep their analysis short."""

from extension_marks import PRESENT
from study_fixtures import quick, sessions, study, without_figures, written

__all__ = ["quick", "sessions", "study", "without_figures", "written"]
# Norms of sites are merged where there are norms.
collect_ignore = [] if "norms" in PRESENT else ["consortia/test_merged_norms.py"]
