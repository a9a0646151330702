"""Norms from files to files: fitted to a reference cohort, or for the scores of new people."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import special

from hipsta_bids import __version__
from hipsta_bids.derivatives import dataset
from hipsta_bids.errors import ModelError
from hipsta_bids.group import write
from hipsta_bids.group.analysis import SideResult, mean_of_known
from hipsta_bids.group.comparison import BOTH
from hipsta_bids.group.data import Bool, Cohort, Float, Int, SideMaps
from hipsta_bids.group.figures import Drawing, draw_norms
from hipsta_bids.group.formula import check_names, listed, typed
from hipsta_bids.group.glm import FittedMaps, most_frequent
from hipsta_bids.group.normative import NormativeScores, ScoredMaps, map_rows, score_rows
from hipsta_bids.group.norms import (
    LEVELS,
    Norms,
    NormsFile,
    People,
    fit_norms,
    load_norms,
    save_norms,
)
from hipsta_bids.group.panels import Row
from hipsta_bids.group.run import (
    GroupInputs,
    GroupOptions,
    GroupResult,
    read_inputs,
    read_templates,
)
from hipsta_bids.group.settings import GroupSettings, NormSettings
from hipsta_bids.group.site_effects import level_labels
from hipsta_bids.group.summaries import hemispheres, summary_values
from hipsta_bids.group.tables import registration_tables
from hipsta_bids.group.trials import (
    document,
    draw_maps,
    members,
    register_cohorts,
    spanned,
    templates_of,
    write_answer,
)
from hipsta_bids.group.warps import Template, templates_from_json, templates_to_json
from hipsta_bids.io import files
from hipsta_bids.progress import tell
from hipsta_bids.protocols.toml import resolve
from hipsta_bids.reports.display import kind_of
from hipsta_bids.reports.group_tables import display_name, with_brackets

#: File of norms, in the folder of their results.
NORMS = "norms.json"
#: Site of everybody where there is no column of sites.
_NO_SITE = "unnamed"

Key = tuple[str, str]
"""Hemisphere and measure."""
Values = Mapping[Key, tuple[Int, Float]]
"""Rows of the cohort's table, and (rows, points); summary measures are single points."""


@dataclass(frozen=True, kw_only=True)
class NormsRequest:
    """What is asked for."""

    file: Path | None = None
    """Norms that score; ``None`` to fit norms."""
    among: tuple[str, str] | None = None
    """Column and level of the participants; all without."""
    controls: tuple[str, str] | None = None
    """Column and level of those who tell shift and scale of new sites."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Chosen:
    """Visits that are asked for."""

    inputs: GroupInputs
    keep: Bool
    """Of the visits that were read."""
    cohort: Cohort
    left_out: dict[str, tuple[str, str]]
    """Reason and message by visit."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Made:
    """What is written."""

    file: NormsFile
    norms: Mapping[Key, Norms]
    people: People
    cohorts: Mapping[str, Cohort]
    """With registered sheets; with other programs' maps by their names."""
    found: Values
    tables: dict[str, pd.DataFrame]
    known: int
    """Sites that the norms had before."""
    scored: Mapping[str, Mapping[str, ScoredMaps]] = field(default_factory=dict)
    """By cohort and hemisphere; empty where norms were fitted."""
    adapted: Bool | None = None
    """(visits,) controls from whom a site was estimated; ``None`` where norms were fitted."""


def run_norms(options: GroupOptions, request: NormsRequest, settings: GroupSettings) -> GroupResult:
    """Fit norms, or score people by them, and write all results or none.

    Raises
    ------
    HipstaError
        If inputs, file or output folder do not allow it.
    """
    dataset.check_own_dataset(options.out_dir)
    if request.file is not None:
        return _score_people(options, request, request.file, settings)
    chosen = _choose(options, request, settings)
    file, how = _planned(chosen, settings), settings.norms
    people, left_out = _people(chosen.cohort.table, file, settings)
    file = _counted(file, people, how)
    templates = read_templates(options.template, chosen.cohort)
    sides, cohorts, found = _registered(chosen, settings, templates)
    made = templates_of(sides)
    file = file.model_copy(update={"template": templates_to_json(made) if made else None})
    tell("norms")
    norms, table = _fit(found, people, file, how)
    tables = dict(registration_tables(chosen.cohort, sides)) if sides else {}
    tables["norms"] = table
    done = _Made(
        file=file,
        norms=norms,
        people=people,
        cohorts=cohorts,
        found=found,
        tables=tables,
        known=len(file.sites),
    )
    chosen.left_out.update(left_out)
    return _write(options, request, settings, chosen, done, ())


def _score_people(
    options: GroupOptions, request: NormsRequest, path: Path, settings: GroupSettings
) -> GroupResult:
    """Score people by the norms of a file."""
    file, norms = load_norms(path)
    known = len(file.sites)
    every = tuple(dict.fromkeys(measure for _, measure in norms))
    options = replace(options, measures=options.measures or every)
    settings = settings.changed(registration=file.registration)
    chosen = _choose(options, request, settings)
    notes = _check(file, path, chosen.inputs)
    table = chosen.cohort.table
    people, left_out = _people(table, file, settings)
    controls = np.zeros(len(table), dtype=bool)
    if request.controls is not None:
        controls = members(table, request.controls, "--controls")
    file = _with_new_sites(file, table, people, controls, request, settings)
    templates = None if file.template is None else templates_from_json(file.template, str(path))
    sides, cohorts, found = _registered(chosen, settings, templates)
    found = {key: own for key, own in found.items() if key in norms}
    adapted = controls & people.known & (people.site >= known)
    tell("norms")
    extended = {}
    for key, (rows, own) in found.items():
        if norms[key].mean.shape[1] != own.shape[1]:
            raise ModelError(
                f"{path}: norms of {key[1]}, hemisphere {key[0]}, have"
                f" {norms[key].mean.shape[1]} points, these people {own.shape[1]}",
                reason="norms-differ",
            )
        at, least = adapted[rows], settings.norms.least_site // 2
        extended[key] = norms[key].extended(own[at], people.take(rows[at]), len(file.sites), least)
    scored = {
        name: _score_maps(one, found, extended, people, adapted) for name, one in cohorts.items()
    }
    tables = dict(registration_tables(chosen.cohort, sides)) if sides else {}
    made = _Made(
        file=file,
        norms=extended,
        people=people,
        cohorts=cohorts,
        found=found,
        tables=tables,
        known=known,
        scored=scored,
        adapted=adapted,
    )
    tables["zscores"] = pd.concat(_score_rows(made, adapted, settings), ignore_index=True)
    chosen.left_out.update(left_out)
    return _write(options, request, settings, chosen, made, notes)


def _choose(options: GroupOptions, request: NormsRequest, settings: GroupSettings) -> _Chosen:
    tell("reading")
    inputs = read_inputs(options, settings)
    keep = members(inputs.cohort.table, request.among)
    others = map(str, inputs.cohort.table.index[~keep])
    left_out = dict.fromkeys(others, ("not-asked", "another level than --among"))
    return _Chosen(inputs=inputs, keep=keep, cohort=inputs.cohort.take(keep), left_out=left_out)


def _registered(
    chosen: _Chosen, settings: GroupSettings, templates: Mapping[str, Template] | None
) -> tuple[dict[str, SideResult], dict[str, Cohort], Values]:
    """Register maps, and collect them and summary measures of each side and of the mean of both."""
    inputs = chosen.inputs
    sides, cohorts = register_cohorts(chosen.cohort, inputs, chosen.keep, settings, templates)
    names = [*inputs.measures.maps, *inputs.others]
    found: dict[Key, tuple[Int, Float]] = {}
    for name, cohort in cohorts.items():
        own = {
            hemi: side.only([name for name in names if name in side.maps])
            for hemi, side in cohort.sides.items()
        }
        cohorts[name] = replace(cohort, sides=own)
        for hemi, side in own.items():
            for measure, values in side.maps.items():
                found[hemi, measure] = side.rows, values.reshape(len(side.rows), -1)
    every: Int = np.arange(len(chosen.cohort.table))
    for hemi in hemispheres(chosen.cohort):
        table = summary_values(chosen.cohort, hemi, inputs.measures.summaries)
        for name in table.columns:
            found[hemi, str(name)] = every, table[[name]].to_numpy(dtype=np.float64)
    return sides, cohorts, found


def _write(  # noqa: PLR0917
    options: GroupOptions,
    request: NormsRequest,
    settings: GroupSettings,
    chosen: _Chosen,
    made: _Made,
    notes: Iterable[str],
) -> GroupResult:
    file, people, cohort = made.file, made.people, chosen.cohort
    keys = [key for key in made.norms if key[1] in settings.norms.charts and key[0] != BOTH]
    if keys:
        made.tables["centiles"] = pd.concat([_centiles(made, key) for key in keys])

    def fill(folder: Path) -> list[str]:
        save_norms(folder / NORMS, file, made.norms)
        for surface, one in made.cohorts.items():
            for hemi, side in one.sides.items():
                if side.maps:
                    write.write_surface(folder, one, _place(side), hemi)
            if found := made.scored.get(surface):
                write.write_scores(folder, one, one.table, found, letter="z", sheets=not surface)
        files.write_text(folder / "methods.md", _methods(made, request, settings))
        return write.write_figures(folder, _figures(made))

    counts = np.bincount(people.site[people.known], minlength=len(file.sites)).tolist()
    record = {
        "hemispheres": {hemi: len(side.rows) for hemi, side in cohort.sides.items()},
        "norms": {
            "file": request.file and str(request.file),
            "participants": file.participants,
            "ages": [file.knots[0], file.knots[-1]],
            "sites": [
                {"site": site, "n": n, "here": counts[i], "new": i >= made.known}
                for i, (site, n) in enumerate(file.sites.items())
            ],
            "controls": request.controls,
        },
        "among": request.among,
    }
    parts = ["norms" if request.file is None else "scores", *(request.among or ())[1:]]
    name = "_".join("".join(c if c.isalnum() else "-" for c in part) for part in parts)
    return write_answer(
        options, name, chosen.inputs, settings, left_out=chosen.left_out,
        notes=[*chosen.inputs.notes, *notes], visits=cohort.table[people.known],
        tables=made.tables, record=record, fill=fill,
    )  # fmt: skip


def _protocol(inputs: GroupInputs) -> str:
    records = inputs.found.records
    return records[0].place.name.seg if records else "none"


def _planned(chosen: _Chosen, settings: GroupSettings) -> NormsFile:
    """Say what norms are about, before they are fitted."""
    how, cohort, inputs = settings.norms, chosen.cohort, chosen.inputs
    table = cohort.table
    check_names([how.age], table.columns)
    sexes = level_labels(table[how.sex], settings.design).dropna() if how.sex in table else ()
    sites = _site_labels(table, how.site, settings).dropna()
    ages = np.sort(_ages(table, how.age, settings))
    ages = ages[np.isfinite(ages)]
    if len(ages) < how.least_participants:
        raise _too_few(len(ages), how)
    # No age of a single person: some are beyond the ends.
    low, high = np.floor(ages[how.edge - 1]), np.ceil(ages[-how.edge])
    inside = ages[(ages >= low) & (ages <= high)]
    inner = np.quantile(inside, np.linspace(0, 1, how.knots)[1:-1]).round(1)
    knots = np.array([low, *inner, high], dtype=np.float64)
    if not (np.diff(knots) > 0).all():
        raise ModelError(
            f"--fit-norms: too few different ages for {how.knots} knots of a spline"
            f" ({listed([f'{age:g}' for age in knots])}); set norms.knots to fewer",
            reason="norms-reference",
        )
    found = inputs.found
    return NormsFile(
        description="norms of maps and summary measures by age, sex and site",
        format=1,
        hash="",
        version=__version__,
        versions=list(found.versions),
        seg=_protocol(inputs),
        region=found.records[0].place.name.region if found.records else "none",
        settings_hash=found.settings_hash,
        registration=resolve(settings)["registration"],
        template=None,
        x=cohort.x.tolist(),
        y=cohort.y.tolist(),
        age=how.age,
        sex=how.sex,
        site=how.site,
        knots=knots.tolist(),
        sexes=sorted(set(sexes)),
        sites=dict.fromkeys(sorted(set(sites)), 1),
        participants=1,
        norms={},
    )


def _too_few(count: int, how: NormSettings) -> ModelError:
    return ModelError(
        f"--fit-norms: {count} participants with age, sex and site are too few; norms need"
        f" {how.least_participants} or more: join the reference cohorts of several sites by"
        " --derivatives",
        reason="norms-reference",
    )


def _ages(table: pd.DataFrame, column: str, settings: GroupSettings) -> Float:
    ages = typed(table[column], settings.design)
    if not pd.api.types.is_numeric_dtype(ages):
        raise ModelError(f"norms: column {column!r} has to hold years", reason="not-numeric")
    return ages.to_numpy(dtype=np.float64)


def _site_labels(table: pd.DataFrame, column: str, settings: GroupSettings) -> pd.Series:
    if column not in table:
        return pd.Series(_NO_SITE, index=table.index, dtype=object)
    return level_labels(table[column], settings.design)


def _people(
    table: pd.DataFrame, file: NormsFile, settings: GroupSettings
) -> tuple[People, dict[str, tuple[str, str]]]:
    """Describe visits as norms have to know them, new sites last; of others reason and message."""
    check_names([file.age, *([file.sex] if file.sexes else [])], table.columns)
    age, labels = _ages(table, file.age, settings), _site_labels(table, file.site, settings)
    low, high = file.knots[0], file.knots[-1]
    reach = f"outside of the norms' {low:g} to {high:g} years"
    sex = np.zeros((len(table), max(len(file.sexes) - 1, 0)))
    lacks = {file.age: np.isnan(age), file.site: labels.isna().to_numpy()}
    problems = {("norms-age", reach): (age < low) | (age > high)}
    if file.sexes:
        levels = level_labels(table[file.sex], settings.design)
        lacks[file.sex] = levels.isna().to_numpy()
        strange = levels.notna() & ~levels.isin(file.sexes)
        problems["norms-sex", f"{file.sex} is none of {listed(file.sexes)}"] = strange.to_numpy()
        for i, level in enumerate(file.sexes[1:]):
            sex[:, i] = levels == level
    problems |= {("incomplete", f"{name} is missing"): where for name, where in lacks.items()}
    left_out = {str(v): why for why, where in problems.items() for v in table.index[where]}
    usable = ~np.any(list(problems.values()), axis=0)
    sites = [*file.sites, *sorted(set(labels[usable]) - set(file.sites))]
    site = np.where(usable, pd.Categorical(labels, categories=sites).codes, -1).astype(np.int64)
    return People(age=age, sex=sex, site=site), left_out


def _counted(file: NormsFile, people: People, how: NormSettings) -> NormsFile:
    """Count a reference cohort; refuse one that is too small, or whose sexes are those of sites."""
    known = people.known
    if known.sum() < how.least_participants:
        raise _too_few(int(known.sum()), how)
    counts = np.bincount(people.site[known], minlength=len(file.sites)).tolist()
    sites = dict(zip(file.sites, counts, strict=True))
    if small := [f"{site} ({n})" for site, n in sites.items() if n < how.least_site]:
        raise ModelError(
            f"--fit-norms: too few participants at {file.site} {listed(small)}; each needs"
            f" {how.least_site}: leave these out by --exclude, or join those of one scanner",
            reason="norms-reference",
        )
    both = np.hstack([np.eye(len(sites))[people.site[known]], people.sex[known]])
    if np.linalg.matrix_rank(both) < both.shape[1]:
        raise ModelError(
            f"--fit-norms: {file.sex} does not vary within {file.site}, so that their effects"
            " cannot be told apart; add sites with both",
            reason="norms-reference",
        )
    return file.model_copy(update={"sites": sites, "participants": int(known.sum())})


def _check(file: NormsFile, path: Path, inputs: GroupInputs) -> list[str]:
    """Refuse people who were measured in another way; note what may differ."""
    cohort, found = inputs.cohort, inputs.found
    same = all(
        len(a) == len(b) and np.allclose(a, b) for a, b in ((file.x, cohort.x), (file.y, cohort.y))
    )
    here = f"{len(cohort.x)} by {len(cohort.y)} nodes"
    there = here if same else f"others, {len(file.x)} by {len(file.y)} nodes"
    region = found.records[0].place.name.region if found.records else "none"
    for what, own, wanted in (
        ("segmentation protocol", _protocol(inputs), file.seg),
        ("region", region, file.region),
        ("hash of the participant level's settings", found.settings_hash, file.settings_hash),
        ("grid of the sheet", here, there),
    ):
        if own != wanted:
            raise ModelError(
                f"{path}: {what}: {wanted}, but here {own}; measure people as the reference"
                " cohort of the norms was",
                reason="norms-differ",
            )
    known = {measure for measures in file.norms.values() for measure in measures}
    asked = [*inputs.measures.maps, *inputs.others, *(inputs.measures.summaries or ())]
    if unknown := [name for name in asked if name not in known]:
        raise ModelError(
            f"{path}: has no norms of {listed(unknown)}, only of {listed(sorted(known))};"
            " choose by --measures",
            reason="norms-differ",
        )
    if set(found.versions) - set(file.versions):
        note = (
            f"the norms are of maps of hipsta_bids {listed(file.versions)}, these people were"
            f" measured with {listed(found.versions)}; a version may change numbers"
        )
        return [note]
    return []


def _with_new_sites(  # noqa: PLR0917
    file: NormsFile,
    table: pd.DataFrame,
    people: People,
    controls: Bool,
    request: NormsRequest,
    settings: GroupSettings,
) -> NormsFile:
    """Add the names of new sites, if they have controls enough."""
    least, sites = settings.norms.least_site, dict(file.sites)
    labels = _site_labels(table, file.site, settings).to_numpy()
    for number in range(len(sites), int(people.site.max(initial=-1)) + 1):
        own = people.site == number
        site, count = str(labels[own][0]), int((own & controls).sum())
        if count < least:
            which = "=".join(request.controls) if request.controls else "(--controls COLUMN=LEVEL)"
            raise ModelError(
                f"{request.file}: {file.site} {site!r} is none of the norms'"
                f" ({listed(list(file.sites))}) and has {count} controls {which} within the range"
                f" of ages; {least} are needed to tell a site from its people",
                reason="norms-site",
            )
        sites[site] = count
    return file.model_copy(update={"sites": sites})


def _fit(
    values: Values, people: People, file: NormsFile, how: NormSettings
) -> tuple[dict[Key, Norms], pd.DataFrame]:
    """Fit all norms, and tell by cross-validation how many lie below each centile."""
    n_sites, knots = len(file.sites), np.array(file.knots)
    # Folds are spread evenly over sites.
    order = np.lexsort((np.random.default_rng(how.seed).random(len(people.site)), people.site))
    fold = np.empty(len(order), dtype=np.int64)
    fold[order] = np.arange(len(order)) % how.folds
    norms, rows = {}, []
    for (hemi, measure), (visits, own) in values.items():
        who = people.take(visits)
        fitted = fit_norms(own, who, n_sites, knots, how)
        known = np.isfinite(fitted.mean).all(axis=0)
        if not known.any():
            continue  # constant, or of too few people
        norms[hemi, measure] = fitted
        some = own[:, :: -(-own.shape[1] // how.checked_points)]
        z = np.full(some.shape, np.nan)
        for left in range(how.folds):
            out = fold[visits] == left
            rest = fit_norms(some[~out], who.take(~out), n_sites, knots, how)
            z[out] = rest.score(some[out], who.take(out))
        scores = z[np.isfinite(z)]
        below = {f"below_{100 * one:g}": np.mean(scores < special.ndtri(one)) for one in LEVELS}
        rows.append(
            {
                "hemi": hemi,
                "measure": measure,
                "n": int(fitted.n.sum(axis=0).max()),
                "n_points": int(known.sum()),
                "transformed": float(np.any(fitted.shape[:, known] != 0, axis=0).mean()),
                **below,
            }
        )
    return norms, pd.DataFrame(rows)


def _score_maps(
    cohort: Cohort, values: Values, norms: Mapping[Key, Norms], people: People, adapted: Bool
) -> dict[str, ScoredMaps]:
    """Score the maps of each hemisphere."""
    scored = {}
    for hemi, side in cohort.sides.items():
        scores = {}
        for measure in side.maps:
            one = norms[hemi, measure]
            z = one.score(values[hemi, measure][1], people.take(side.rows))
            scores[measure] = NormativeScores(z, 2 * special.ndtr(-np.abs(z)), one.n.sum(axis=0))
        if scores:
            scored[hemi] = ScoredMaps(
                rows=side.rows,
                reference=adapted[side.rows],
                scores=scores,
                subfield=most_frequent(side.subfield, len(side.names)),
                names=side.names,
            )
    return scored


def _score_rows(made: _Made, adapted: Bool, settings: GroupSettings) -> Iterator[pd.DataFrame]:
    """List scores: of maps over regions, of summary measures also centiles."""
    maps = set()
    for name, found in made.scored.items():
        maps |= {(hemi, measure) for hemi, one in found.items() for measure in one.scores}
        for rows in map_rows(made.cohorts[name], found, settings):
            table = rows.drop(columns="p").rename(columns={"w": "z", "reference": "adapted"})
            yield table[table["z"].notna()].assign(centile=np.nan)
    for (hemi, measure), (visits, own) in made.found.items():
        if (hemi, measure) not in maps:
            known = visits[made.people.known[visits] & np.isfinite(own[:, 0])]
            z = made.norms[hemi, measure].score(own[known], made.people.take(known))[:, 0]
            columns = {"adapted": adapted[known], "z": z, "low": np.nan, "high": np.nan}
            what = {"hemi": hemi, "measure": measure, "region": None, **columns}
            yield score_rows(made.cohorts[""], known, **what, centile=100 * special.ndtr(z))


def _centiles(made: _Made, key: Key) -> pd.DataFrame:
    """List centiles of a summary measure at each year, by sex, at the average site."""
    file, unit = made.file, made.cohorts[""].units.get(key[1], "1")
    ages = np.arange(file.knots[0], file.knots[-1] + 1)
    blocks = []
    for number, sex in enumerate(file.sexes or [files.MISSING]):
        kind = np.eye(max(len(file.sexes), 1))[number, 1:]
        people = People(age=ages, sex=np.tile(kind, (len(ages), 1)), site=np.zeros(len(ages), int))
        values = made.norms[key].centiles(people, LEVELS)[:, :, 0]
        columns = {f"p{100 * one:g}": row for one, row in zip(LEVELS, values, strict=True)}
        what = {"hemi": key[0], "measure": key[1], "unit": unit, "sex": sex}
        blocks.append(pd.DataFrame({**what, "age": ages, **columns}))
    return pd.concat(blocks)


def _place(side: SideMaps) -> FittedMaps:
    every: Int = np.arange(len(side.rows))
    subfield = most_frequent(side.subfield, len(side.names))
    return FittedMaps(maps=side, used=every, rows=every, subfield=subfield, fits={})


def _figures(made: _Made) -> Iterator[tuple[str, Drawing]]:
    """List charts of summary measures, and maps."""
    if "centiles" in made.tables:
        for measure, own in made.tables["centiles"].groupby("measure", sort=False):
            yield f"{measure}_norms", partial(draw_norms, own, _dots(made, own))
    for surface, cohort in made.cohorts.items():
        for measure in dict.fromkeys(n for side in cohort.sides.values() for n in side.maps):
            sides = {hemi: one for hemi, one in cohort.sides.items() if measure in one.maps}
            places = {hemi: _place(one) for hemi, one in sides.items()}
            unit = cohort.units.get(measure, "1")
            rows = _expectations(made, list(sides), measure, unit)
            if made.adapted is not None:
                rows = _deviations(made.scored[surface], measure)
            yield f"{measure}_normmaps", partial(draw_maps, cohort, places, list(rows))


def _dots(made: _Made, lines: pd.DataFrame) -> pd.DataFrame:
    """Collect values of new people as they would be at the average site."""
    sexes, blocks = made.file.sexes or [files.MISSING], []
    for key in lines[["hemi", "measure"]].drop_duplicates().itertuples(index=False, name=None):
        rows, own = made.found[key]
        rows, own = (rows, own) if made.adapted is not None else (rows[:0], own[:0])
        who = made.people.take(rows)
        level = (who.sex @ np.arange(1, len(sexes))).astype(np.int64)
        what = {"hemi": key[0], "sex": np.array(sexes)[level], "age": who.age}
        moved = made.norms[key].average_site(own, who)[:, 0]
        adapted = np.zeros(0, bool) if made.adapted is None else made.adapted
        blocks.append(pd.DataFrame({**what, "value": moved, "adapted": adapted}))
    return pd.concat(blocks, ignore_index=True).dropna()


def _expectations(made: _Made, sides: Sequence[str], measure: str, unit: str) -> Iterator[Row]:
    """Show mean and SD at the middle knot of age, halfway between the sexes."""
    knots, n_sexes = made.file.knots, max(len(made.file.sexes), 1)
    age = knots[len(knots) // 2]
    one = People(
        age=np.array([age]), sex=np.full((1, n_sexes - 1), 1 / n_sexes), site=np.zeros(1, int)
    )
    found = {hemi: made.norms[hemi, measure].expected(one) for hemi in sides}
    kind = kind_of(measure)
    for i, (what, colors) in enumerate({"mean": kind.colors, "SD": "magma"}.items()):
        values = {hemi: pair[i][0] for hemi, pair in found.items()}
        scale = spanned(colors, values)
        if kind.limits and what == "mean":
            scale = {"cmap": colors, "vmin": kind.limits[0], "vmax": kind.limits[1]}
        title = f"{what[0].upper()}{what[1:]} at {age:g} years"
        label = with_brackets(f"{what},\n{display_name(measure)}", unit)
        yield Row(kind="expected", index=i, title=title, label=label, scale=scale, values=values)


def _deviations(scored: Mapping[str, ScoredMaps], measure: str) -> Iterator[Row]:
    """Show mean deviations, and shares of low ones, of those whom no site was adapted to."""
    z = {
        hemi: side.scores[measure].w[~side.reference]
        for hemi, side in scored.items()
        if measure in side.scores
    }
    means = {hemi: mean_of_known(own, 0) for hemi, own in z.items()}
    below = special.ndtri(LEVELS[0])
    low = {
        hemi: 100 * mean_of_known(np.where(np.isfinite(own), own < below, np.nan), 0)
        for hemi, own in z.items()
    }
    reach = max(1.0, *(np.nanmax(np.abs(one), initial=0.0) for one in means.values()))
    most = max(20.0, *(np.nanmax(one, initial=0.0) for one in low.values()))
    for kind, title, label, colors, ends, values in (
        ("effect", "Mean deviation", "mean z", "RdBu_r", (-reach, reach), means),
        ("error", "Below the 5th centile", "participants [%]", "magma", (0.0, most), low),
    ):
        scale: dict[str, Any] = {"cmap": colors, "vmin": ends[0], "vmax": ends[1]}
        yield Row(kind=kind, index=0, title=title, label=label, scale=scale, values=values)


def _methods(made: _Made, request: NormsRequest, settings: GroupSettings) -> str:
    """Word what was done, with the works it rests on."""
    file, cited = made.file, list[str]()

    def cite(key: str) -> str:
        if key not in cited:
            cited.append(key)
        return f"[{cited.index(key) + 1}]"

    among = f" ({' '.join(request.among)})" if request.among else ""
    first = (
        f"Measures of the hippocampus {cite('method')} of {made.people.known.sum()}"
        f" participants{among} were "
    )
    ages = f"{file.knots[0]:g} to {file.knots[-1]:g} years"
    if request.file is None:
        first += f"taken as norms for ages of {ages} with hipsta_bids {__version__}."
    else:
        first += (
            f"compared with norms of {file.participants} participants of {ages} from {made.known} sites"
            f" (hipsta_bids {__version__}; norms made by {file.version})."
        )
    if file.template is not None:
        whose = "each other" if request.file is None else "the template of the norms"
        first += (
            f" Sheets were registered to {whose} by their curvature profiles {cite('registr')}."
        )
    sex = "sex and " if file.sexes else ""
    model = (
        f"Norms have a mean with a natural cubic spline of age ({len(file.knots)} knots) and"
        f" constants for {sex}site, and an SD whose logarithm is linear in age with a constant for"
        f" each site {cite('gamlss')}, at each point and for each summary measure. Where a"
        f" likelihood-ratio test (p < {settings.norms.shape_level:g}) rejected a normal"
        f" distribution, residuals have a sinh-arcsinh distribution {cite('shash')}, as in"
        f" {cite('warped')}. Deviations z are normal quantiles of the probability of a value;"
        " shift and scale of a site count as known from its participants only (Student's t)."
    )
    paragraphs = [first, model]
    if request.file is None:
        table = made.tables["norms"]
        of_maps = table["n_points"] > 1
        parts = [
            f"{_shares(own)} % of {what}"
            for what, own in (
                ("points of maps", table[of_maps]),
                ("summary measures", table[~of_maps]),
            )
            if len(own)
        ]
        paragraphs.append(
            f"In {settings.norms.folds}-fold cross-validation {' and '.join(parts)} lay below"
            f" centiles {listed([f'{100 * one:g}' for one in LEVELS])}."
        )
    if new := [f"{site} ({n})" for site, n in list(file.sites.items())[made.known :]]:
        paragraphs.append(
            "Shift and scale of sites without norms were estimated from their controls"
            f" {'='.join(request.controls or ())}: {listed(new)}. All else was kept."
        )
    return document(paragraphs, cited)


def _shares(table: pd.DataFrame) -> str:
    return listed([f"{100 * table[f'below_{100 * one:g}'].mean():.1f}" for one in LEVELS])
