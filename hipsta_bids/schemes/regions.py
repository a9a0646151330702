"""What is measured: the hippocampal body, with the cortex beside it, or that cortex alone."""

from dataclasses import replace

from hipsta_bids.errors import SchemeError
from hipsta_bids.schemes.loader import load_scheme, scheme_names
from hipsta_bids.schemes.scheme import Scheme


def for_region(scheme: Scheme, region: str) -> Scheme:
    """Give a protocol the sheet of a region.

    Parameters
    ----------
    scheme : Scheme
    region : str
        ``body``, ``extended`` (the body and the neighboring cortex) or ``entorhinal`` (that cortex
        alone).

    Returns
    -------
    Scheme
        Its ``sheet`` is that of the region; all else stays.

    Raises
    ------
    SchemeError
        ``no-cortex-labels`` if the protocol has no neighboring cortex; the message says which
        bundled ones have.
    """
    if region == "body":
        return scheme
    if not scheme.neighbors:
        able = [name for name in scheme_names() if load_scheme(name).neighbors]
        raise SchemeError(
            f"region {region}: the protocol {scheme.name} has no labels of neighboring cortex; "
            f"{', '.join(able)} have; measure the body, or list them as neighbors in a protocol "
            "file for --scheme",
            reason="no-cortex-labels",
        )
    hippocampal = scheme.sheet if region == "extended" else ()
    return replace(scheme, sheet=(*scheme.neighbors, *hippocampal))
