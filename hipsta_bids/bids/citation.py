"""Wording of ``CITATION.md``: a methods paragraph that says what was done, with references."""

from collections.abc import Sequence

from hipsta_bids import __version__
from hipsta_bids.schemes import Scheme
from hipsta_bids.settings import Settings
from hipsta_bids.settings_file import flatten, resolve

_LAYER_RULES = {
    "nearest-sheet": "was given to the nearest subfield of the sheet",
    "nearest-label": "was given to the nearest label, the dentate gyrus and CA4 included",
}

_REGIONS = {
    "body": "",
    "extended": " For files with label-extended, the sheet goes on beyond the subiculum into the"
    " neighboring cortex, between the same end planes.",
    "entorhinal": " For files with label-entorhinal, the neighboring cortex alone was taken,"
    " between the same end planes; its interior side is the one that continues the hippocampal"
    " sheet's.",
}

#: Key and entry of each work that the methods rest on.
REFERENCES: dict[str, str] = {
    "method": "Diers K, Baumeister H, Jessen F, Düzel E, Berron D, Reuter M. An automated,"
    " geometry-based method for hippocampal shape and thickness analysis. NeuroImage"
    " 2023;276:120182. doi:10.1016/j.neuroimage.2023.120182",
    "shapedna": "Reuter M, Wolter FE, Peinecke N. Laplace-Beltrami spectra as 'Shape-DNA' of"
    " surfaces and solids. Computer-Aided Design 2006;38(4):342-366."
    " doi:10.1016/j.cad.2005.10.011",
    "brainprint": "Wachinger C, Golland P, Kremen W, Fischl B, Reuter M. BrainPrint: a"
    " discriminative characterization of brain morphology. NeuroImage 2015;109:232-248."
    " doi:10.1016/j.neuroimage.2015.01.032",
    "tetgen": "Si H. TetGen, a Delaunay-based quality tetrahedral mesh generator. ACM Transactions"
    " on Mathematical Software 2015;41(2):11. doi:10.1145/2629697",
    "pybids": "Yarkoni T, Markiewicz CJ, de la Vega A, et al. PyBIDS: Python tools for BIDS"
    " datasets. Journal of Open Source Software 2019;4(40):1294. doi:10.21105/joss.01294",
}


def citation_text(settings: Settings, schemes: Sequence[Scheme]) -> str:
    """Word the methods paragraph.

    Parameters
    ----------
    settings : Settings
        Those in use.
    schemes : sequence of Scheme
        Segmentation protocols in use.

    Returns
    -------
    str
        Markdown.
    """
    entries = list(REFERENCES.values())
    entries += [scheme.citation for scheme in schemes if scheme.citation not in entries]
    number = {entry: i for i, entry in enumerate(entries, start=1)}
    cite = {key: f"[{number[entry]}]" for key, entry in REFERENCES.items()}
    protocols = ", ".join(f"{s.title} [{number[s.citation]}]" for s in schemes) or "none"
    lines = [
        "# Methods",
        "",
        "This text may be used freely, as it stands or changed.",
        "",
        (
            f"Hippocampal thickness and curvature were measured with hipsta_bids {__version__},"
            f" an implementation of the method of Diers et al. {cite['method']}."
            f" Segmentations were found with PyBIDS {cite['pybids']} and follow: {protocols}."
            " The subfields of the hippocampal body from presubiculum to CA3 were merged into one"
            " sheet; the molecular layer, where labeled,"
            f" {_LAYER_RULES.get(settings.body.layer_rule, settings.body.layer_rule)}."
            f"{_REGIONS[settings.body.region]}"
            " The sheet was meshed as a closed surface of checked topology and filled with"
            f" tetrahedra by TetGen {cite['tetgen']}. Its medial and lateral ends were located with"
            " an eigenfunction of the anisotropic Laplace-Beltrami operator, computed with LaPy"
            f" {cite['shapedna']}{cite['brainprint']} and checked against the lines farthest from"
            " each other inside the body; three harmonic functions between opposite"
            " faces gave each point a medial-to-lateral, posterior-to-anterior and"
            " interior-to-exterior coordinate. Thickness is the length of a line from the interior"
            " to the exterior wall; curvature is the mean curvature of the mid-surface."
        ),
        "",
        "All settings:",
        "",
        *(f"- `{key}`: {value}" for key, value in flatten(resolve(settings)).items()),
        "",
        "# References",
        "",
        *(f"{i}. {entry}" for entry, i in number.items()),
    ]
    return "\n".join(lines) + "\n"
