"""Reference levels: the level of a factor with which the other levels are compared."""

import re
import tomllib
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import chain

_WORDS = tomllib.loads((files("hipsta_bids.stats") / "controls.toml").read_text(encoding="utf-8"))
#: Words that negate the words after them, and levels that state an absence.
_NEGATIONS = frozenset(_WORDS["negations"])
#: Controls by the whole level only; in phrases, these mean something else.
_WHOLE_LEVELS = frozenset(_WORDS["alone"])
#: Beginnings that negate another level: nondemented, unaffected.
_NEGATING = ("non", "un", "a")
_MINUS = re.compile(r"(.+?)\s*[-\u2212\u2013]")  # APOE4-, if APOE4+ is a level


@dataclass(frozen=True)
class Reference:
    """A reference level, with the reason for it."""

    level: str
    reason: str
    is_known: bool
    """Whether the level is a control by its name, or was asked for."""


def _phrases(spelled: Mapping[str, str], controls: Iterable[str]) -> list[str]:
    """Return the levels with the first control word that any has."""
    matches = ([n for n, text in spelled.items() if _has_control(text, w)] for w in controls)
    return next(filter(None, matches), [])


def choose_reference(
    levels: Sequence[str],
    words: Iterable[str],
    *,
    requested: str | None = None,
    declared: Sequence[str] = (),
) -> Reference:
    """Choose the reference of a factor; the same names of levels give the same reference.

    In this order: the requested level; a level that is one of ``words`` or another control word;
    a single level with a control word in it (``healthy control``); a single negation
    (``non-demented``, ``no``, ``APOE4-``); else the first one, in the order of ``declared``
    or else of ``levels``.
    """
    if requested is not None:
        return Reference(requested, "as requested", is_known=True)
    levels = list(filter(levels.__contains__, declared)) or levels
    controls = {_singular(word): None for word in chain(words, *_WORDS["controls"].values())}
    spelled = {level: " ".join(_words(level)) for level in levels}
    names = {_singular(text): level for level, text in reversed(spelled.items())}
    if exact := [names[word] for word in filter(names.__contains__, controls)]:
        return Reference(exact[0], "control", is_known=len(exact) == 1)
    phrases = _phrases(spelled, controls)
    negations = [level for level in levels if _is_negation(level, levels, spelled)]
    for reason, candidates in (("control", phrases), ("negation", negations)):
        if len(candidates) == 1:
            return Reference(candidates[0], reason, is_known=True)
    first = next(iter(phrases or negations), levels[0])
    return Reference(first, "first of Levels" if declared else "first in order", is_known=False)


def references_note(references: Mapping[str, Reference]) -> str:
    """Note the reference levels of a model, and how to change levels that names do not decide."""
    texts = [f"{factor} {choice.level} ({choice.reason})" for factor, choice in references.items()]
    is_certain = all(choice.is_known for choice in references.values())
    hint = "" if is_certain else "; change with --reference FACTOR=LEVEL"
    return f"reference levels: {', '.join(texts)}{hint}"


def _words(level: str) -> list[str]:
    """Split a level into words of small letters without accents and signs."""
    plain = unicodedata.normalize("NFKD", level.casefold())
    return re.findall(r"[^\W_]+", "".join(c for c in plain if not unicodedata.combining(c)))


def _singular(text: str) -> str:
    return "".join(_words(text)).rstrip("s")


def _has_control(text: str, control: str) -> bool:
    """Check for a control word that no word negates; scripts without blanks by parts of words."""
    words = text.split()
    if control in _WHOLE_LEVELS or _NEGATIONS & set(words):
        return False
    return control in map(_singular, words) or (not control.isascii() and control in text)


def _is_negation(level: str, levels: Sequence[str], spelled: Mapping[str, str]) -> bool:
    """Check whether a level negates something, by a word, or another level, by its beginning."""
    if _NEGATIONS & set(spelled[level].split()):
        return True
    minus = _MINUS.fullmatch(level.strip())
    if minus and any(label.replace(" ", "") == f"{minus[1]}+" for label in levels):
        return True
    whole = spelled[level].replace(" ", "")
    spellings = {text.replace(" ", "") for name, text in spelled.items() if name != level}
    return any(whole == f"{start}{spelling}" for start in _NEGATING for spelling in spellings)
