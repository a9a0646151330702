"""Analytic hippocampal bodies with known truth."""

from hipsta_bids.phantom.phantom import Phantom
from hipsta_bids.phantom.spec import KINDS, PhantomSpec

__all__ = ["KINDS", "Phantom", "PhantomSpec"]
