"""Write docs/measures.md (measures, figures, errors on phantoms) and docs/measures-errors.tsv.

Run it after a change of a measure, or of the geometry by more than a rounding::

    .venv/bin/python tools/make_measures.py docs

With ``--results OUT_DIR`` it first takes the ranges of sizes in ``tools/real_sizes.json`` anew from
the results of real hemispheres. A test compares the page with what the code says now.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from io import BytesIO
from pathlib import Path

import numpy as np
import pandas as pd
from measure_example import Comparison, Example
from measure_figures import DRAWINGS
from measure_topics import ERRORS, INTRODUCTION, PUBLISHED, SIZES_TEXT, TOPICS, Topic
from PIL import Image
from reference_pages import table

from hipsta_bids.geometry.catalog import MAPS, PER_SUBFIELD, SECTIONS, SUMMARY, Column
from hipsta_bids.participant.measure import measure_hemisphere
from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.settings import Settings
from validation.report import Picture, render

#: Where measures are found, and the rows of the catalog that are there.
TABLES: Mapping[str, Sequence[Column]] = {
    "sheet": MAPS,
    "sections": SECTIONS,
    "summary": SUMMARY,
    "subfields": PER_SUBFIELD,
}

#: The phantom of the figures, and the others of the table of errors.
SHOWN = PhantomSpec(kind="spiral", thickness=2.0, variation=0.2, variation_axis="x", bend=0.02)
OTHERS: Mapping[str, PhantomSpec] = {
    "slab": PhantomSpec(kind="slab", thickness=2.0),
    "arc": PhantomSpec(kind="arc", thickness=2.0),
    "spiral": PhantomSpec(kind="spiral", thickness=2.0),
    "s-shape": PhantomSpec(kind="s-shape", thickness=2.0),
    "spiral ±30 %": PhantomSpec(kind="spiral", thickness=2.0, variation=0.3),
    "arc, bent axis": PhantomSpec(kind="arc", thickness=2.0, bend=-0.03),
    "spiral 1.2 mm": PhantomSpec(kind="spiral", thickness=1.2),
    "tight": PhantomSpec(kind="tight", thickness=2.0),
}
SUBFIELD = "CA1"
"""Whose numbers stand for those of all subfields."""

PAGE, ALL_ERRORS = "measures.md", "measures-errors.tsv"
LARGEST = 60_000
"""Bytes of a figure."""
SIZES = Path(__file__).with_name("real_sizes.json")


def make_example(spec: PhantomSpec) -> Example:
    """Draw a left phantom in voxels of 0.4 mm and measure it with default settings."""
    phantom, protocol = Phantom(spec), load_protocol("freesurfer")
    volume = phantom.label_volume(protocol)
    maps = measure_hemisphere(volume, "L", Settings(), lambda _: nullcontext())
    return Example(phantom=phantom, maps=maps, protocol=protocol)


def write(out: Path) -> None:
    """Write the page and its figures below a folder."""
    shown = make_example(SHOWN)
    others = {name: make_example(spec) for name, spec in OTHERS.items()}
    for topic in TOPICS:
        (out / image(topic)).write_bytes(_draw(topic, shown))
    (out / PAGE).write_text(page(shown, others), encoding="utf-8")
    rows = [("measure", "table", *others), *errors(others)]
    text = "\n".join("\t".join(row) for row in rows)
    (out / ALL_ERRORS).write_text(f"{text}\n", encoding="utf-8")


def page(shown: Example, others: Mapping[str, Example]) -> str:
    """Write the page in Markdown.

    Parameters
    ----------
    shown : Example
        Of the figures and of the numbers beside them.
    others : mapping of str to Example
        Of the table of errors.
    """
    parts = [
        "<!-- Written by `tools/make_measures.py`; do not edit, run it again. -->",
        "# Measures",
        INTRODUCTION,
        *(_section(topic, shown) for topic in TOPICS),
        "## Errors on phantoms",
        ERRORS,
        table(("measure", "table", "smallest", "largest"), map(_range, errors(others))),
        "## Sizes of real bodies",
        _real_sizes(json.loads(SIZES.read_text(encoding="utf-8"))),
    ]
    return "\n\n".join(parts) + "\n"


def image(topic: Topic) -> str:
    """Name the file of a topic's figure, below the folder of the page."""
    return f"images/measures-{topic.figure}.png"


def ranges(results: Path) -> dict[str, object]:
    """Take smallest, median and largest of every size from the summaries of an output dataset."""
    found = sorted(results.glob("sub-*/**/*_desc-summary_morph.tsv"))
    table = pd.concat([pd.read_csv(path, sep="\t", na_values="n/a") for path in found])
    return {
        "hemispheres": len(found),
        "sizes": {
            row.name: [float(f(table[row.name])) for f in (np.min, np.median, np.max)]
            for row in SUMMARY
        },
    }


def _section(topic: Topic, shown: Example) -> str:
    columns = [
        (column, name)
        for name, names in topic.measures.items()
        for column in TABLES[name]
        if column.name in names
    ]
    parts = [f"## {topic.title}", topic.text, f"![{topic.title} on a phantom]({image(topic)})"]
    if columns:
        headings = ("measure", "table", "unit", "definition", "measured", "analytic")
        parts.append(table(headings, (_row(*pair, shown) for pair in columns)))
        parts.append(_sources([column for column, _ in columns]))
    return "\n\n".join(parts)


def _row(column: Column, name: str, shown: Example) -> tuple[str, ...]:
    key = f"{column.name}_{SUBFIELD}" if name == "subfields" else column.name
    means = (f"{mean:.{column.digits - 1}f}" for mean in shown.measured[name][key].means)
    words = column.definition.format("a subfield")
    return (f"`{column.name}`", name, column.unit, words, *means)


def _sources(columns: Sequence[Column]) -> str:
    """Cite the works that define measures; the most frequent one without their names."""
    names: dict[str, list[str]] = {}
    for column in columns:
        names.setdefault(column.source, []).append(f"`{column.name}`")
    usual, *others = sorted(names, key=lambda source: -len(names[source]))
    rest = (f"; {', '.join(names[source])}: {source}" for source in others)
    return f"Source: {usual}{''.join(rest)}."


def errors(others: Mapping[str, Example]) -> list[tuple[str, ...]]:
    """List each measure with its table and its error on each phantom."""
    return [
        (name, where, *(_error(example.measured[where][name]) for example in others.values()))
        for where in TABLES
        for name in next(iter(others.values())).measured[where]
    ]


def _range(row: tuple[str, ...]) -> tuple[str, ...]:
    name, where, *cells = row
    relative = [cell for cell in cells if cell.endswith("%")]
    ordered = sorted(relative or cells, key=lambda cell: float(cell.split()[0]))
    return (f"`{name}`", where, ordered[0], ordered[-1])


def _error(comparison: Comparison) -> str:
    """Spell an error: in percent, or in the unit of curvatures that are about zero."""
    measured, true = comparison.means
    if "gaussian" in comparison.name or abs(true) < 1e-6:  # noqa: PLR2004 -- zero but for rounding
        return f"{round(measured - true, 4) + 0.0:+.4f}"  # no -0
    return f"{round(100 * (measured / true - 1), 1) + 0.0:+.1f} %"


def _real_sizes(record: Mapping[str, object]) -> str:
    sizes = record["sizes"]
    assert isinstance(sizes, dict)  # noqa: S101 -- our own file
    rows = (
        (f"`{row.name}`", row.unit, *(f"{x:.{row.digits - 1}f}" for x in sizes[row.name]))
        for row in SUMMARY
        if row.name in sizes
    )
    sizes_table = table(("measure", "unit", "smallest", "median", "largest"), rows)
    return f"{SIZES_TEXT.format(count=record['hemispheres'])}\n\n{sizes_table}\n\n{PUBLISHED}"


def _draw(topic: Topic, shown: Example) -> bytes:
    """Draw a figure as a small PNG, with a palette if it is large otherwise."""
    drawing = DRAWINGS[topic.figure]
    picture = Picture(
        name=topic.figure,
        caption=topic.text,
        draw=lambda figure: drawing(figure, shown),
        size=(7.2, 4.0),
    )
    data = render(picture)
    if len(data) < LARGEST:
        return data
    smaller = BytesIO()
    Image.open(BytesIO(data)).convert("RGB").quantize(255).save(smaller, "png", optimize=True)
    return smaller.getvalue()


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description="write docs/measures.md and its figures")
    parser.add_argument("out", type=Path, help="folder of the page, such as docs")
    parser.add_argument("--results", type=Path, help="output dataset of real hemispheres")
    options = parser.parse_args()
    if options.results:
        record = json.dumps(ranges(options.results), indent=1)
        SIZES.write_text(f"{record}\n", encoding="utf-8")
    write(options.out)


if __name__ == "__main__":
    main()
