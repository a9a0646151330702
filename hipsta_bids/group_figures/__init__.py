"""Figures of the group level, in the layout of the paper."""

from hipsta_bids.group_figures.draw import draw_figures
from hipsta_bids.group_figures.panels import Drawing

__all__ = ["Drawing", "draw_figures"]
