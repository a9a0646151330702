"""Analytic hippocampi with known truth, and synthetic datasets of them."""

from hipsta_bids.phantom.dataset import (
    TRUTH_TABLE,
    Hemisphere,
    refuse_taken,
    rigid_motion,
    write_dataset,
    write_demo_dataset,
)
from hipsta_bids.phantom.labels import encode
from hipsta_bids.phantom.phantom import Phantom, PhantomTruth
from hipsta_bids.phantom.shape import KINDS, PhantomSpec, Thinning

__all__ = [
    "KINDS",
    "TRUTH_TABLE",
    "Hemisphere",
    "Phantom",
    "PhantomSpec",
    "PhantomTruth",
    "Thinning",
    "encode",
    "refuse_taken",
    "rigid_motion",
    "write_dataset",
    "write_demo_dataset",
]
