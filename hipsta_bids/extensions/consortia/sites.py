"""The results of several sites together: what survives, tables, and forest plots as numbers."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from textwrap import shorten
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.errors import ModelError
from hipsta_bids.extensions.consortia.effects import Combined, MetaResult, meta_analyze
from hipsta_bids.extensions.consortia.exchange import ModelSummary, SiteSummary, shown_counts
from hipsta_bids.extensions.consortia.settings import MetaSettings
from hipsta_bids.group.output import columns, tables
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.io import files
from hipsta_bids.io.files import FileNumbers
from hipsta_bids.stats.arrays import Float
from hipsta_bids.stats.clusters import sheet_edges
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.formula import listed
from hipsta_bids.stats.glm import MEAN, PointTest
from hipsta_bids.stats.inference import Discoveries, MapKey, discover

#: Peaks of a map that get a forest plot.
_MOST_PEAKS = 6
_SAME_PEAK = 2  # nodes
_PREDICTION = "prediction"
#: What to do where a mean of the sample is in a contrast, as age is in those of an interaction.
_BY_COLUMNS = "write the contrast by columns, as -1*group[T.AD]"
_LONGEST = 200  # characters of what two sites have


@dataclass(frozen=True, eq=False, kw_only=True)
class Item:
    """One contrast of one model."""

    number: int
    """Position of the model in the summaries."""
    model: ModelSummary
    """Of the first site."""
    contrast: str
    result: MetaResult

    def label(self, effects: str) -> str:
        """Name of the contrast by fixed or random effects."""
        return f"{self.contrast} ({effects})"

    def key(self, effects: str) -> MapKey:
        """Name of a map."""
        return MapKey(self.model.measures[0], self.label(effects), self.model.hemi)


@dataclass(frozen=True, eq=False, kw_only=True)
class Meta:
    """Everything that is written."""

    sites: list[SiteSummary]
    items: list[Item]
    discoveries: Mapping[MapKey, Discoveries]
    frame: Mapping[str, columns.Frame]
    """Points by hemisphere."""
    settings: GroupSettings

    def tests(self, item: Item) -> Iterator[tuple[MapKey, PointTest, Combined]]:
        """A combined estimate as tests; Cohen's d is over the residual SD within sites."""
        sd, missing = item.result.sd, np.full(len(item.result.sd), np.nan)
        for effects, effects_of_kind in item.result.models.items():
            limits = effects_of_kind.limits(self.settings.of(MetaSettings).confidence)
            test = PointTest(
                contrast=Contrast(item.label(effects), np.ones(1)),
                statistic=effects_of_kind.statistic,
                p=effects_of_kind.p,
                df=effects_of_kind.df,
                estimate=effects_of_kind.estimate[None],
                se=effects_of_kind.se[None],
                cohen_d=effects_of_kind.estimate / sd,
                cohen_d_limits=np.stack(limits) / sd,
                eta_squared=missing,
                eta_squared_limits=np.stack([missing, missing]),
            )
            yield item.key(effects), test, effects_of_kind

    def of(self, kind: str) -> Iterator[Item]:
        """Contrasts of maps, or of summary measures."""
        return (item for item in self.items if item.model.kind == kind)

    @property
    def people(self) -> int:
        """Participants of all sites."""
        return sum(site.participants for site in self.sites)

    def counts(self, item: Item) -> Float:
        """(points,) participants of the sites that have an estimate."""
        sizes = np.array([[site.participants] for site in self.sites])
        return np.asarray(np.sum(np.isfinite(item.result.estimates) * sizes, axis=0))


def check_agreement(sites: Sequence[SiteSummary]) -> list[str]:
    """Refuse summaries that are not about the same; note what may differ but should be known.

    ModelError in one line that names the site that differs from most, and the item.
    """
    items: dict[str, Callable[[SiteSummary], object]] = {
        "segmentation protocol": lambda site: site.seg,
        "region": lambda site: site.region,
        "hash of the participant level's settings": lambda site: site.settings_hash,
        "direction of the axes": lambda site: site.axes,
        "grid of the sheet": lambda site: f"{_few(site.x)} by {_few(site.y)}",
        "what a row of the model is": lambda site: "a change" if site.change else "a visit",
        "registration": lambda site: site.align,
        "hash of the template of registration": lambda site: site.template_hash,
        "measures with a relative asymmetry": lambda site: ", ".join(site.asymmetry),
        "reference levels": lambda site: ", ".join(
            f"{name} {next(iter(levels), '')}" for name, levels in site.factors.items()
        ),
    }
    for item, value in items.items():
        _agree(sites, item, [str(value(site)) for site in sites])
    _agree_on_measures(sites)
    for number, model in enumerate(sites[0].models):
        title = model.title
        _agree(sites, f"{title}: columns", [", ".join(s.models[number].columns) for s in sites])
        _agree(sites, f"{title}: contrasts", [", ".join(s.models[number].contrasts) for s in sites])
        for name in model.contrasts:
            # The mean is that of a site's participants, whatever their age.
            rows = [site.models[number].contrasts[name] for site in sites if name != MEAN]
            if rows:
                words = [", ".join(f"{weight:.6g}" for weight in row) for row in rows]
                item = f"{title}: weights of {name} on {', '.join(model.columns)}"
                _agree(sites, item, words, _BY_COLUMNS)
    return list(_differences(sites))


def _differences(sites: Sequence[SiteSummary]) -> Iterator[str]:
    """Note in which versions and labels the sites differ."""
    if len({site.version for site in sites}) > 1:
        yield "sites used several versions of hipsta_bids, see sites.tsv"
    for name in dict.fromkeys(name for site in sites for name in site.labels):
        kinds = {site.site: ", ".join(site.labels.get(name, ["unknown"])) for site in sites}
        if len(set(kinds.values())) > 1:
            texts = "; ".join(f"{kind} at {site}" for site, kind in kinds.items())
            yield f"labels of sites differ in {name}: {texts}"


def _agree(
    sites: Sequence[SiteSummary],
    item: str,
    values: Sequence[str],
    remedy: str = "all sites need the same",
) -> None:
    usual = Counter(values).most_common(1)[0][0]
    for site, value in zip(sites, values, strict=True):
        if value != usual:
            usual_site = sites[values.index(usual)].site
            raise ModelError(
                f"site {site.site}: {item}: {shorten(value, _LONGEST)}, but at {usual_site}"
                f" {shorten(usual, _LONGEST)}; {remedy}"
            )


def _agree_on_measures(sites: Sequence[SiteSummary]) -> None:
    """Refuse sites that lack a map or summary measure of other sites."""
    names_of = [
        [
            f"{name}, {model.hemi} ({'map' if model.kind == 'map' else model.formula})"
            for model in site.models
            for name in model.measures
        ]
        for site in sites
    ]
    all_names = list(dict.fromkeys(name for names in names_of for name in names))
    for site, names in zip(sites, names_of, strict=True):
        if lacking := [name for name in all_names if name not in names]:
            raise ModelError(
                f"site {site.site}: lacks {listed(lacking)}; give all sites the same --measures"
            )
    titles = ["; ".join(model.title for model in site.models) for site in sites]
    _agree(sites, "order of results", titles)


def _few(values: Sequence[float]) -> str:
    return f"{len(values)} nodes from {values[0]:.4g} to {values[-1]:.4g}" if values else "none"


@np.errstate(
    over="ignore", divide="ignore", invalid="ignore"
)  # of numbers as other sites sent them
def analyze_sites(sites: list[SiteSummary], settings: GroupSettings) -> Meta:
    """Combine each contrast of each model, and determine the points that survive."""
    items = [
        Item(
            number=number,
            model=model,
            contrast=contrast,
            result=meta_analyze(
                _stack(site.models[number].estimate[contrast] for site in sites),
                _stack(site.models[number].se[contrast] for site in sites),
                _stack(site.models[number].sd for site in sites),
                np.array([site.models[number].df for site in sites]),
                settings.of(MetaSettings),
            ),
        )
        for number, model in enumerate(sites[0].models)
        for contrast in model.contrasts
    ]
    maps = [item for item in items if item.model.kind == "map"]
    discoveries = discover(
        {item.key(name): model.p for item in maps for name, model in item.result.models.items()},
        settings.multiplicity,
    )
    frames: dict[str, columns.Frame] = {
        item.model.hemi: _frame(sites, item.number) for item in reversed(maps)
    }
    return Meta(sites=sites, items=items, discoveries=discoveries, frame=frames, settings=settings)


def _stack(rows: Iterable[FileNumbers]) -> Float:
    return np.array(list(rows), dtype=np.float64)


def _frame(sites: Sequence[SiteSummary], number: int) -> columns.Frame:
    """Locate points, in the subfield that most participants have there."""
    first = sites[0]
    votes: list[Counter[str]] = [Counter() for _ in range(len(first.x) * len(first.y))]
    for site in sites:
        for vote, name in zip(votes, site.models[number].subfield or [], strict=False):
            vote[name or files.MISSING] += site.participants
    names = [vote.most_common(1)[0][0] if vote else files.MISSING for vote in votes]
    shape = len(first.x), len(first.y)
    return columns.Frame.of_sheet(
        np.array(first.x), np.array(first.y), np.array(names).reshape(shape)
    )


def meta_tables(meta: Meta) -> Iterator[tuple[str, pd.DataFrame]]:
    """Make all tables."""
    confidence = meta.settings.of(MetaSettings).confidence
    yield "sites", _sites(meta)
    edges = sheet_edges(
        len(meta.sites[0].x), len(meta.sites[0].y), meta.settings.multiplicity.neighbors
    )
    rows, peaks, forests = [], [], []
    for item in meta.of("map"):
        frame = meta.frame[item.model.hemi]
        tables_of_side = []
        for key, test, combined in meta.tests(item):
            discoveries = meta.discoveries[key]
            stem = tables.map_name(key.hemi, key.measure, key.contrast)
            rows.append(columns.overview_row(stem, key, discoveries))
            low, high = combined.limits(confidence)
            values = {
                **columns.point_columns(test, discoveries, frame, meta.counts(item).astype(int)),
                "n_sites": item.result.random.sites.astype(int),
                "estimate_low": low,
                "estimate_high": high,
                **_between(item),
            }
            yield stem, pd.DataFrame(values)
            table = columns.peak_table(test, discoveries, frame, edges)
            peaks.append(table.assign(measure=key.measure, hemi=key.hemi))
            tables_of_side.append(table)
        forests += [_forest(meta, item, point) for point in _points(tables_of_side, frame)]
    if rows:
        yield "maps", pd.DataFrame(rows)
        table = pd.concat(peaks, ignore_index=True)
        yield "peaks", table[["measure", "hemi", *table.columns.drop(["measure", "hemi"])]]
    if list(meta.of("summary")):
        yield "measures", _summaries(meta)
    for item in meta.of("summary"):
        tested = np.flatnonzero(np.isfinite(item.result.random.estimate))
        forests += [_forest(meta, item, int(point)) for point in tested]
    if forests:
        yield (
            "forest",
            pd.concat([table.assign(plot=number) for number, table in enumerate(forests, start=1)]),
        )
    if left := list(_left_out(meta)):
        yield "leave_one_out", pd.DataFrame(left)


def _sites(meta: Meta) -> pd.DataFrame:
    rows = []
    for site in meta.sites:
        counts = {k: shown_counts(levels) for k, levels in site.factors.items()}
        levels = {f"{k}_{level}": n for k, levels in counts.items() for level, n in levels.items()}
        numbers = {f"{k}_{s}": v for k, n in site.covariates.items() for s, v in n.items()}
        people = {"site": site.site, "n": site.participants, **levels, **numbers}
        about = {"version": site.version, "template": site.template_hash}
        rows.append({**people, "df": site.models[0].df, **about})
    return pd.DataFrame(rows)


def _between(item: Item) -> dict[str, Float]:
    random = item.result.random
    return {"tau2": random.tau2, "q": random.q, "q_p": random.q_p, "i2": random.i2}


def _points(peaks: Sequence[pd.DataFrame], frame: columns.Frame) -> list[int]:
    """Peaks of a map by either model, the largest statistics first; else the strongest point."""
    table = pd.concat(peaks, ignore_index=True)
    if not len(table):
        return []
    rows = table[table["extent"] > 0] if (table["extent"] > 0).any() else table.tail(1)
    rows = rows.reindex(rows["statistic"].abs().sort_values(ascending=False, kind="stable").index)
    x, y = (frame.position[axis].tolist() for axis in "xy")
    at = {position: point for point, position in enumerate(zip(x, y, strict=True))}
    nodes = np.stack([frame.number["node_x"], frame.number["node_y"]])
    nodes_kept: list[int] = []
    for position in zip(rows["x"].tolist(), rows["y"].tolist(), strict=True):
        distance = np.abs(nodes[:, nodes_kept] - nodes[:, [at[position]]]).max(axis=0)
        # Both models have the same cluster's peak there, or nearly.
        if (distance > _SAME_PEAK).all():
            nodes_kept.append(at[position])
    return nodes_kept[:_MOST_PEAKS]


def _forest(meta: Meta, item: Item, point: int) -> pd.DataFrame:
    """Everything in a forest plot: a row per site, and one per combined estimate."""
    result, confidence = item.result, meta.settings.of(MetaSettings).confidence
    is_map = item.model.kind == "map"
    labels: dict[str, Any] = {
        "measure": item.model.measures[0 if is_map else point],
        "unit": item.model.units[0 if is_map else point],
        "hemi": item.model.hemi,
        "model": item.model.formula,
        "contrast": item.contrast,
    }
    if is_map:
        frame = meta.frame[item.model.hemi]
        labels |= {name: values[point] for name, values in frame.position.items()}
        labels["subfield"] = frame.subfield[point]
    rows: list[dict[str, Any]] = []
    for number, site in enumerate(meta.sites):
        df = np.full(result.sd.shape, site.models[item.number].df, dtype=np.float64)
        site_effect = Combined(estimate=result.estimates[number], se=result.ses[number], df=df)
        row = {"site": site.site, "kind": "site", "n": site.participants}
        row |= _row(site_effect, point, confidence) | {
            "weight": result.random.weights[number, point]
        }
        if result.without:
            row_without = _row(result.without[number].random, point, confidence)
            del row_without["se"]
            row |= {f"without_{k.removeprefix('estimate_')}": v for k, v in row_without.items()}
        rows.append(row)
    n = int(meta.counts(item)[point])
    for name, combined in result.models.items():
        rows.append({"site": name, "kind": name, "n": n, **_row(combined, point, confidence)})
    rows[-1] |= {name: values[point] for name, values in _between(item).items()}
    low, high = result.random.prediction(confidence)
    limits = {"estimate_low": low[point], "estimate_high": high[point]}
    rows.append({"site": _PREDICTION, "kind": _PREDICTION, **limits})
    return pd.DataFrame([{**labels, **row} for row in rows])


def _row(combined: Combined, point: int, confidence: float) -> dict[str, float]:
    low, high = combined.limits(confidence)
    return {
        "estimate": combined.estimate[point],
        "se": combined.se[point],
        "estimate_low": low[point],
        "estimate_high": high[point],
        "p": combined.p[point],
    }


def _summaries(meta: Meta) -> pd.DataFrame:
    """List summary measures by fixed and random effects."""
    confidence = meta.settings.of(MetaSettings).confidence
    parts = []
    for item in meta.of("summary"):
        for key, test, combined in meta.tests(item):
            low, high = combined.limits(confidence)
            parts.append(
                pd.DataFrame(
                    {
                        "hemi": item.model.hemi,
                        "measure": item.model.measures,
                        "unit": item.model.units,
                        "model": item.model.formula,
                        "contrast": key.contrast,
                        "test": "t",
                        "n": meta.counts(item).astype(int),
                        "visits": meta.counts(item).astype(int),
                        "n_sites": item.result.random.sites.astype(int),
                        **columns.test_columns(test),
                        "p_fdr": np.nan,
                        "estimate_low": low,
                        "estimate_high": high,
                        **columns.effect_columns(test),
                        **_between(item),
                    }
                )
            )
    table = pd.concat(parts, ignore_index=True)
    table = table[table["estimate"].notna()]
    return tables.with_fdr(table, meta.settings)


def _left_out(meta: Meta) -> Iterator[dict[str, Any]]:
    """Count what survives without each site, and how far estimates move."""
    maps = [item for item in meta.of("map") if item.result.without]
    for number, site in enumerate(meta.sites if maps else ()):
        without = {
            item.key(name): model
            for item in maps
            for name, model in item.result.without[number].models.items()
        }
        discoveries = discover(
            {key: model.p for key, model in without.items()}, meta.settings.multiplicity
        )
        for item in maps:
            for name, all_sites in item.result.models.items():
                key = item.key(name)
                moved = np.abs(without[key].estimate - all_sites.estimate) / item.result.sd
                overlap = discoveries[key].rejected & meta.discoveries[key].rejected
                yield {
                    "measure": key.measure,
                    "contrast": key.contrast,
                    "hemi": key.hemi,
                    "site": site.site,
                    "n_significant": int(discoveries[key].rejected.sum()),
                    "n_kept": int(overlap.sum()),
                    "largest_change": float(np.nan_to_num(moved).max(initial=0.0)),
                }
