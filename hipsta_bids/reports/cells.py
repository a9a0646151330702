"""The cells of pages: filters of templates that write a number, a measure or a position."""

import re
from collections.abc import Callable, Iterable, Mapping
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import escape

from hipsta_bids.io import files
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.reports.display import subfield_title
from hipsta_bids.types import JOINT, SIDES, p_text

if TYPE_CHECKING:
    import pandas as pd
    from markupsafe import Markup

MINUS = "\N{MINUS SIGN}"
IDS = ("participant_id", "session_id")
_THIRD = 1 / 3
FAR = 2.0  # w-scores beyond are listed: about one in twenty of the reference
#: Names of tissues inside names of measures; ``CA2_3`` before ``CA2``.
_SUBFIELD = re.compile(
    f"_({'|'.join(sorted((tissue.name for tissue in Tissue), key=len, reverse=True))})(?=_|$)"
)


def display_name(measure: str) -> str:
    """Write a measure in words, with its subfield after a comma."""
    words = _SUBFIELD.sub(lambda match: f", {subfield_title(match[1])}", measure)
    return words.replace("_", " ")


def measure_title(measure: object) -> str:
    """Name a measure at the beginning of a line."""
    name = display_name(str(measure))
    return name[:1].upper() + name[1:]


def unit_of(unit: str) -> str:
    """Write a unit with superscripts; nothing for pure numbers."""
    return "" if unit == "1" else unit.replace("^2", "²").replace("^3", "³")


def with_brackets(title: str, unit: str) -> str:
    """Append a unit to the title of a column or row."""
    return f"{title} [{unit_of(unit)}]" if unit_of(unit) else title


def with_unit(text: str, unit: str) -> str:
    """Append a unit to a number."""
    return f"{text} {unit_of(unit)}".rstrip()


def wrapped(label: str, names: Iterable[object]) -> str:
    """List names in lines that fit a notebook."""
    text = f"  {label}: {', '.join(map(str, names))}"
    return fill(text, 88, subsequent_indent="    ", break_on_hyphens=False)


def card(text: str, *parts: str) -> str:
    """Show an object in a notebook: a bold line, lines below it, and parts that are HTML."""
    title, _, lines = str(escape(text)).partition("\n")
    return f"<div><b>{title}</b><pre>{lines}</pre>{''.join(parts)}</div>"


def statistic_text(row: Mapping[str, Any]) -> str:
    """Write a statistic with its degrees of freedom; of F, the error's."""
    value = number_text(row["statistic"])
    if row["test"] == "z":
        return f"z {value}"
    if row["test"] == "t":
        return f"t({row['df']:.0f}) {value}" if np.isfinite(row["df"]) else f"z {value}"
    return f"{row['test']} {value}, error df {row['df']:.0f}"


def counted(number: int, singular: str, plural: str = "") -> str:
    """Write a number of things, in the singular or the plural."""
    return f"{number} {singular if number == 1 else plural or singular + 's'}"


def number_text(value: float, digits: int | None = None) -> str:
    """Write a number with three digits, or with as many decimals."""
    if not np.isfinite(value):
        return files.MISSING
    text = f"{value:.3g}" if digits is None else f"{value:.{digits}f}"
    text = f"{value:.0f}" if "e+" in text else text
    return text.replace("-", MINUS)


def position_text(peak: Mapping[str, Any]) -> str:
    """Describe the position of a peak."""
    inside = f"{peak['subfield']}, " if isinstance(peak["subfield"], str) else ""
    if np.isfinite(peak.get("x", np.nan)):
        words = [
            ends.split()[1 if abs(peak[axis]) < _THIRD else 0 if peak[axis] < 0 else 2]
            for axis, ends in (("x", "medial middle lateral"), ("y", "posterior midway anterior"))
        ]
        if isinstance(part := peak.get("part"), str):
            words[1:] = [part] if part != "body" else ["body", words[1]]
        x, y = (f"{peak[axis]:.2f}".replace("-", MINUS) for axis in "xy")
        return f"{inside}{', '.join(words)} (x {x}, y {y})"
    return f"{inside}vertex {int(peak['vertex'])}"


def effect_name(effect: str) -> str:
    """Write the kind of an effect size."""
    return {"cohen_d": "d", "partial_eta_squared": "partial η²"}.get(effect, effect)


def summary_side(hemi: str, measure: str) -> str:
    """Write the side of a summary measure."""
    if hemi == "LR" and "_asymmetry" not in measure:
        return "mean of both sides"
    return SIDES[hemi]


def effect_text(row: Mapping[str, Any]) -> str:
    """Write an effect size with its limits; of a joint test, the effect of each measure."""
    if row["measure"] == JOINT:
        return str(row["measures"])
    limits = f"{number_text(row['effect_low'])} to {number_text(row['effect_high'])}"
    text = f"{effect_name(row['effect'])} {number_text(row['effect_size'])} ({limits})"
    if np.isfinite(row.get("percent", np.nan)):
        percent, low, high = (number_text(row[f"percent{end}"]) for end in ("", "_low", "_high"))
        text += f"; {percent} % ({low} to {high})"
    return text


def _size(row: Mapping[str, Any]) -> str:
    """Write an effect size without its limits."""
    return f"{effect_name(row['effect'])} {number_text(row['effect_size'])}"


def visit_of(row: Mapping[str, Any]) -> str:
    """Name a participant, and the session if there is one."""
    return " ".join(row[name] for name in IDS if isinstance(row[name], str))


def measures_text(measures: str, unit: str = "1") -> str:
    """Write a measure, or a sum of several, with its unit."""
    return with_brackets(" + ".join(map(display_name, measures.split(" + "))), unit)


def _side(hemi: str, measure: str | None = None) -> str:
    """Write the side of a map, or of a summary measure."""
    return SIDES[hemi] if measure is None else summary_side(hemi, measure)


def limits_text(row: Mapping[str, Any], name: str, digits: int | None = None) -> str:
    """Write a number with its limits."""
    columns = (name, f"{name}_low", f"{name}_high")
    value, low, high = (number_text(row[column], digits) for column in columns)
    return f"{value} ({low} to {high})"


def _quartiles(values: "pd.Series") -> str:
    """Write the median with the quartiles."""
    if not values.notna().any():
        return files.MISSING
    low, middle, high = (number_text(value) for value in values.quantile([0.25, 0.5, 0.75]))
    return f"{middle} ({low} to {high})"


def _decimals(value: float, digits: int) -> str:
    """Write a number with as many decimals, and a hyphen as its sign."""
    return f"{value:.{digits}f}" if np.isfinite(value) else files.MISSING


def _count(value: float) -> str:
    """Write a number of participants, which may be beyond all that was tried."""
    return f"{value:,.0f}" if np.isfinite(value) else "more"


def _arms(row: Mapping[str, Any], prefix: str = "") -> str:
    """Write the participants of two unequal arms, and of both together."""
    smaller, larger = row[f"{prefix}per_arm"], row[f"{prefix}larger_arm"]
    if not np.isfinite(smaller + larger):
        return _count(np.nan)
    return f"{_count(smaller)} and {_count(larger)} participants, {_count(smaller + larger)} in all"


def percent_text(share: float) -> str:
    """Write a share in percent."""
    return f"{share:.0%}" if np.isfinite(share) else files.MISSING


def _deviations(scores: "pd.Series") -> str:
    """Write the mean of scores with their SD, and how many are far from zero."""
    beyond = f"{(scores < -FAR).sum()} low, {(scores > FAR).sum()} high of {len(scores)}"
    spread = f"{number_text(scores.mean())} ({number_text(scores.std())})"
    return f"{spread}; {beyond}" if len(scores) else ""


def _quality(value: float, usual: Mapping[str, Any]) -> str:
    """Write a quality number, with its unit."""
    if np.isnan(value):
        return files.MISSING
    return f"{value:.1%}" if "percent" in usual else f"{value:.3g} {usual.get('unit', '')}".rstrip()


def _usual_range(usual: Mapping[str, Any]) -> str:
    """Write the usual range of a quality number."""
    low, high = (_quality(usual[end], usual) for end in ("low", "high"))
    if np.isinf(usual["high"]):
        return "any" if np.isinf(usual["low"]) else f"at least {low}"
    return f"at most {high}" if np.isinf(usual["low"]) else f"{low} to {high}"


def _code(text: str) -> "Markup":
    """Set what stands between backticks as code; no sign is escaped there, others may be."""
    from markupsafe import Markup, escape  # noqa: PLC0415  (start-up)

    html = Markup()
    for n, run in enumerate(_CODE.split(text)):
        if n % 3:
            html += Markup("<code>{}</code>").format(run) if run else ""
        else:
            html += escape(_ESCAPED.sub("", run))
    return html


#: Code in Markdown, in one backtick or two, and a backslash before a sign.
_CODE = re.compile(r"(?<!\\)(?:`` (.+?) ``|`([^`]+)`)")
_ESCAPED = re.compile(r"\\(?=[\\`*~<$\]&_])")

#: By the names that templates use.
FILTERS: dict[str, Callable[..., str]] = {
    "code": _code,
    "number": number_text,
    "decimals": _decimals,
    "p": p_text,
    "percent": percent_text,
    "arms": _arms,
    "count": _count,
    "counted": counted,
    "limits": limits_text,
    "quartiles": _quartiles,
    "deviations": _deviations,
    "measure": measures_text,
    "side": _side,
    "effect": effect_text,
    "size": _size,
    "statistic": statistic_text,
    "position": position_text,
    "visit": visit_of,
    "quality": _quality,
    "usual_range": _usual_range,
}
