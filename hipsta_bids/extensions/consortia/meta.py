"""The meta-analysis from files to files: summaries of sites become tables, maps and a page."""

from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids import __version__
from hipsta_bids.errors import OutputError, UsageError
from hipsta_bids.extensions.consortia import EXTENSION
from hipsta_bids.extensions.consortia.effects import FIXED, RANDOM
from hipsta_bids.extensions.consortia.exchange import SiteSummary, read_summary, shown_counts
from hipsta_bids.extensions.consortia.page import FOLDER, write_meta_page
from hipsta_bids.extensions.consortia.settings import MetaSettings
from hipsta_bids.extensions.consortia.sites import Meta, analyze_sites, check_agreement, meta_tables
from hipsta_bids.group.cohort.data import Cohort
from hipsta_bids.group.output import write
from hipsta_bids.group.output.citations import Citations, code, escaped
from hipsta_bids.group.output.ground import grounds_of
from hipsta_bids.group.output.maps import ContrastMap, contrasts
from hipsta_bids.group.output.methods import discovery_text
from hipsta_bids.group.output.panels import Row, draw_pages
from hipsta_bids.group.output.style import Drawing
from hipsta_bids.group.output.tables import read_columns
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.io import files
from hipsta_bids.protocols.toml import resolve
from hipsta_bids.stats.arrays import SideMaps
from hipsta_bids.stats.glm import FittedMaps
from hipsta_bids.stats.inference import PERMUTATIONS


def run_meta(
    paths: Sequence[tuple[str | None, Path]],
    out_dir: Path,
    settings: GroupSettings,
    command: Sequence[str] = (),
    *,
    figures: bool = False,
) -> tuple[Path, list[str]]:
    """Combine the summaries of sites, perhaps renamed; returns the page and notes.

    ``figures`` asks for figures for print, too.
    """
    if settings.multiplicity.method in PERMUTATIONS:
        raise UsageError(
            "meta: summaries have no participants to permute; use --correction fdr2 or bh"
        )
    sites = _read(paths)
    notes = check_agreement(sites)
    meta = analyze_sites(sites, settings)
    folder = out_dir / FOLDER
    if folder.exists() and not (folder / "meta.json").exists():
        raise OutputError(
            f"{folder}: is no earlier meta-analysis; choose another output folder",
            reason="not-writable",
        )
    with write.whole_folder(folder) as scratch:
        for name, table in meta_tables(meta):
            write.write_table(
                scratch,
                name,
                table,
                described=name != "sites",
                meaning=read_columns(EXTENSION.package),
            )
        _write_maps(scratch, meta)
        notes += write.write_figures(scratch, _figures(meta), prints=figures)
        files.write_text(scratch / "methods.md", _methods(meta))
        files.write_json(scratch / "meta.json", _record(meta, paths, command, notes))
    return write_meta_page(out_dir), notes


def _read(paths: Sequence[tuple[str | None, Path]]) -> list[SiteSummary]:
    """Read summaries, and refuse any that would count twice."""
    sites: list[SiteSummary] = []
    path_of: dict[str, str] = {}
    for name, path in paths:
        site = read_summary(path)
        content = site.model_dump_json(exclude={"site"})
        site = site if name is None else site.model_copy(update={"site": name})
        if content in path_of:
            raise UsageError(
                f"meta: {site.site} and {path_of[content]} are the same summary; give each site"
                " once"
            )
        if site.site in path_of.values():
            raise UsageError(
                f"meta: two sites are called {site.site}; name them, as a={path} b=..."
            )
        path_of[content] = site.site
        sites.append(site)
    if len(sites) < 2:  # noqa: PLR2004 -- sites
        raise UsageError("meta: give the summaries of two sites or more")
    return sites


def _write_maps(folder: Path, meta: Meta) -> None:
    """Write maps of both models as GIFTI and CIFTI, and the sheets to draw them on."""
    tests = (test for item in meta.of("map") for test in meta.tests(item))
    write.write_stats(
        folder, write.stats_of((key, test, meta.discoveries[key]) for key, test, _ in tests)
    )
    cohort = _cohort(meta)
    for hemi in dict.fromkeys(item.model.hemi for item in meta.of("map")):
        write.write_surface(folder, cohort, _place(meta, hemi, cohort), hemi)


def _cohort(meta: Meta) -> Cohort:
    """Coordinates of the sheet, without anybody."""
    first = meta.sites[0]
    return Cohort(
        table=pd.DataFrame(), sides={}, x=np.array(first.x), y=np.array(first.y), units={}
    )


def _figures(meta: Meta) -> Iterator[tuple[str, Drawing]]:
    """List figures of maps, one per measure, for :func:`write_figures`."""
    maps, cohort = list(meta.of("map")), _cohort(meta)
    tests: dict[str, dict[str, dict[str, ContrastMap]]] = {}
    for item in maps:
        measures = tests.setdefault(item.model.hemi, {})
        for key, test, _ in meta.tests(item):
            result = meta.discoveries[key]
            measures.setdefault(item.model.measures[0], {})[key.contrast] = ContrastMap(
                kind=test.kind,
                effect=test.effect,
                statistic=test.statistic,
                df=np.asarray(test.df, dtype=np.float64),
                adjusted=result.adjusted,
                rejected=result.rejected,
                alpha=result.alpha,
            )
    places = grounds_of(cohort, {hemi: _place(meta, hemi, cohort) for hemi in tests})
    like = {item.label(RANDOM): item.label(FIXED) for item in maps}
    for measure in dict.fromkeys(item.model.measures[0] for item in maps):
        sides = {hemi: points for hemi, points in places.items() if measure in tests[hemi]}
        blocks = list(contrasts(tests, measure, like))
        items = [item for item in maps if item.model.measures[0] == measure]
        for number, contrast in enumerate(dict.fromkeys(item.contrast for item in items)):
            row = Row(
                kind="heterogeneity",
                index=number,
                title=f"Heterogeneity, {contrast}",
                label="I² [%]",
                scale={"cmap": "cividis", "vmin": 0.0, "vmax": 100.0},
                values={
                    item.model.hemi: 100 * item.result.random.i2
                    for item in items
                    if item.contrast == contrast
                },
            )
            blocks[2 * number + 1].append(row)
        yield f"{measure}_maps", partial(draw_pages, sides, blocks)


def _place(meta: Meta, hemi: str, cohort: Cohort) -> FittedMaps:
    """Locate the points of maps of one hemisphere, of which there are no sheets."""
    shape, no_rows = (len(cohort.x), len(cohort.y)), np.zeros(0, dtype=np.int64)
    words = meta.frame[hemi].subfield
    names = tuple(name for name in dict.fromkeys(words) if name != files.MISSING)
    subfield = np.array([names.index(word) if word in names else -1 for word in words])
    maps = SideMaps(
        rows=no_rows,
        maps={},
        subfield=np.zeros((0, *shape), dtype=np.int8),
        names=names,
        summary=pd.DataFrame(),
    )
    return FittedMaps(
        maps=maps, used=no_rows, rows=no_rows, subfield=subfield.reshape(shape), fits={}
    )


def _record(
    meta: Meta,
    paths: Sequence[tuple[str | None, Path]],
    command: Sequence[str],
    notes: Sequence[str],
) -> dict[str, Any]:
    """Record what was combined, and how."""
    first = meta.sites[0]
    return {
        "command": list(command),
        "version": __version__,
        "inputs": {
            "datasets": [str(path.resolve()) for _, path in paths],
            "settings_hash": first.settings_hash,
            "versions": sorted({version for site in meta.sites for version in site.versions}),
            "seg": first.seg,
            "region": first.region,
            "template_hash": first.template_hash,
        },
        "formula": first.models[0].formula,
        "columns": first.models[0].columns,
        "contrasts": first.models[0].contrasts,
        "groups": {"levels": list(first.groups)},
        "comparison": {},
        "participants": meta.people,
        "sites": [site.site for site in meta.sites],
        "notes": notes,
        "settings": {
            name: values
            for name, values in resolve(meta.settings).items()
            if name in {"meta", "multiplicity"}
        },
    }


def _random_effects(method: str, cite: Citations) -> str:
    """Return how the variance between sites was estimated."""
    if method == "dl":
        return (
            f"estimated by the moments of DerSimonian and Laird {cite('dl')}. Tests used the normal"
            " distribution"
        )
    text = (
        f"estimated by restricted maximum likelihood {cite('reml')}. Tests and limits followed"
        f" Knapp and Hartung {cite('knapp-hartung')}"
    )
    if method == "reml-adhoc":
        text += (
            f", with standard errors not smaller than without their correction {cite('modified')}"
        )
    return text


def _methods(meta: Meta) -> str:
    """Return methods and results."""
    rules, sites = meta.settings.of(MetaSettings), meta.sites
    cite = Citations()
    counts = Counter[str]()
    sizes = [size for site in sites for size in shown_counts(site.groups).items()]
    for level, n in sizes if all(isinstance(n, int) for _, n in sizes) else ():
        counts[level] += int(n)
    groups = f" ({escaped(', '.join(f'{n} {name}' for name, n in counts.items()))})" * bool(counts)
    aligned = (
        "Maps were not registered to each other."
        if sites[0].template is None
        else "All sites registered their maps to one template of curvature profiles (hash"
        f" {sites[0].template_hash})."
    )
    method_text = cite("method")
    if sites[0].template is not None:
        aligned += f" Registration used monotone B-spline warps {cite('registr')}."
    random = _random_effects(rules.random, cite)
    measure_text = (
        f"Measures of the hippocampal body {method_text} of {meta.people} participants{groups} at"
        f" {len(sites)} sites were combined with hipsta_bids {__version__}. No value of a"
        f" participant left its site. Each site fitted the linear model"
        f" {code(sites[0].models[0].formula)} at each point of the sheet and to each summary"
        " measure."
    )
    effects = (
        "The fixed effect was the mean of the sites' estimates, weighted by inverse variances. In"
        " the random-effects model, true effects differ between sites. Their variance"
        f" (tau²) was {random}. Heterogeneity was described by Cochran's Q, by I² {cite('i2')}, and"
        f" by limits of the effect at a further site {cite('prediction')}."
    )
    if meta.items[0].result.without:
        effects += " All analyses were repeated without each site."
    errors = (
        f"{discovery_text(meta.settings.multiplicity, cite, meta.discoveries)}, and over all"
        " summary measures of a contrast by each model. Effect sizes are Cohen's d: the estimate"
        " divided by the residual standard deviation within sites, with"
        f" {rules.confidence:.0%} confidence limits."
    )
    paragraphs = [f"{measure_text} {aligned}", effects, errors]
    survivors = [
        f"- {escaped(f'{key.measure}, {key.contrast}, {key.hemi}')}: {int(test.rejected.sum())} of"
        f" {test.n_tests} points"
        for key, test in meta.discoveries.items()
    ]
    if survivors:
        paragraphs.append("\n".join(["Significant points after correction:", "", *survivors]))
    return cite.page(paragraphs, sites[0].region)
