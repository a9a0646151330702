"""Extension of griffe: what docstrings write in reStructuredText, in Markdown."""

import re
from typing import Any

import griffe

_ROLE = re.compile(r":(?:class|func|data|mod|meth):`~?([^`]+)`")
_CHOICE = re.compile(r"^(\w+ : )\{(.+?)\}", re.MULTILINE)


class DocstringWords(griffe.Extension):
    """Cross-references as code; choices as words, since griffe takes the first for a default."""

    def on_object(self, *, obj: griffe.Object, **_others: Any) -> None:  # noqa: ANN401  (griffe's own)
        """Rewrite the docstring of whatever was loaded."""
        if obj.docstring is not None:
            text = _ROLE.sub(r"`\1`", obj.docstring.value)
            obj.docstring.value = _CHOICE.sub(r"\1one of \2", text)
