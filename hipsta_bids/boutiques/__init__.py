"""The command line as Boutiques descriptors, for platforms that run BIDS Apps.

Made from the parsers themselves, so that an option that is added there is in the descriptors too.
Loads nothing heavy.
"""

from hipsta_bids.boutiques.descriptor import DESCRIPTORS, describe, descriptor_text

__all__ = ["DESCRIPTORS", "describe", "descriptor_text"]
