"""Features beyond the published analysis. Each is a folder that can be deleted.

``hipsta_bids.joints`` finds them, so that the core imports none.
"""

#: Folders, in the order of the help.
NAMES = (
    *("combination", "repeated", "sites", "multilevel", "consortia", "trials", "norms"),
    *("agreement", "maps", "conjunctions", "percent", "parcels", "signals", "visits", "regions"),
    *("uncertainty", "surrogate", "export", "cluster"),
)
