"""Texts in Markdown that cite works by number."""

import re
from collections.abc import Sequence

from hipsta_bids.derivatives.dataset import references

REFERENCES = "# References"

#: What was measured, by region.
_MEASURED = {
    "body": "the hippocampal body",
    "extended": "the hippocampal body and the neighboring cortex",
    "entorhinal": "the cortex beside the hippocampal body",
    "headbody": "the hippocampal head and body on one sheet (experimental)",
    "whole": "the whole hippocampus on one sheet (experimental)",
}

#: Signs in a name that Markdown, or the HTML in it, would take for its own.
_SIGNS = re.compile(r"([\\`*~<$]|\](?=\()|&(?=#?\w+;)|(?<!\w)_|_(?!\w))")


def escaped(text: object) -> str:
    """Escape a name, or a text with names, that Markdown should show as it is."""
    return _SIGNS.sub(r"\\\1", " ".join(str(text).split()))


def code(formula: str) -> str:
    """Write a formula as Markdown's code; it may have backticks."""
    return f"`` {formula} ``" if "`" in formula else f"`{formula}`"


def joined(names: Sequence[str]) -> str:
    """Join names as a sentence does."""
    return " and ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))


class Citations:
    """Numbers works in the order of the text."""

    def __init__(self) -> None:
        self._keys: list[str] = []

    def __call__(self, key: str) -> str:
        """Return the number of a work in brackets."""
        if key not in self._keys:
            self._keys.append(key)
        return f"[{self._keys.index(key) + 1}]"

    def page(self, paragraphs: Sequence[str], region: str = "body") -> str:
        """Return the text with its references; the first paragraph names the region."""
        region_text = _MEASURED["body"]
        first = paragraphs[0].replace(region_text, _MEASURED.get(region, region_text), 1)
        bibliography = references()
        works = "\n".join(f"{i}. {bibliography[key]}" for i, key in enumerate(self._keys, start=1))
        use = "This text may be used freely, as it stands or changed."
        parts = ["# Methods and findings", use, first, *paragraphs[1:], REFERENCES, works]
        return "\n\n".join(parts) + "\n"
