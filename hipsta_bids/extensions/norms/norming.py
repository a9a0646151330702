"""Norms from files to files: fitted to a reference cohort, or for the scores of new people."""

from collections.abc import Callable, Iterable, Iterator, Mapping
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
from hipsta_bids.extensions.norms import EXTENSION
from hipsta_bids.extensions.norms import centiles as normative
from hipsta_bids.extensions.norms import sums as summed_norms
from hipsta_bids.extensions.norms.figures import deviation_rows, draw_norms, norm_rows
from hipsta_bids.extensions.norms.file import NormsFile, load_norms, save_norms
from hipsta_bids.extensions.norms.methods import norms_text
from hipsta_bids.extensions.norms.scoring import map_rows, score_rows, write_scores
from hipsta_bids.extensions.norms.settings import NormSettings
from hipsta_bids.extensions.norms.sites import with_sums
from hipsta_bids.extensions.norms.wscores import NormativeScores, ScoredMaps
from hipsta_bids.group.cohort.data import SHEET, Cohort, layers
from hipsta_bids.group.model import BOTH, AllSessions, Comparison
from hipsta_bids.group.output import write
from hipsta_bids.group.output.citations import escaped
from hipsta_bids.group.output.ground import grounds_of
from hipsta_bids.group.output.panels import draw_pages
from hipsta_bids.group.output.saved import templates_from_json
from hipsta_bids.group.output.style import Drawing
from hipsta_bids.group.output.tables import read_columns
from hipsta_bids.group.questions import study as studies
from hipsta_bids.group.questions.mixing import with_mixes
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.io import files
from hipsta_bids.io.labels import refuse_alike
from hipsta_bids.progress import tell
from hipsta_bids.protocols.toml import resolve
from hipsta_bids.stats.arrays import Bool, Float, Int, Key
from hipsta_bids.stats.design import FIRST_AGE
from hipsta_bids.stats.formula import check_names, level_labels, listed, typed
from hipsta_bids.stats.glm import most_frequent, points_of
from hipsta_bids.stats.warps import Template
from hipsta_bids.types import PARTICIPANT

#: Points of each map, spread evenly, that are cross-validated.
CHECKED_POINTS = 200

_NO_SITE = "unnamed"  # of everybody, where there is no column of sites

Values = Mapping[Key, tuple[Int, Float]]
"""Rows of the table, and (rows, points); summary measures are single points."""


@dataclass(frozen=True, eq=False)
class _Scoring:
    """What is written."""

    path: Path | None
    """Norms that score; ``None`` where norms are fitted."""
    controls: tuple[str, str] | None
    file: NormsFile
    norms: Mapping[Key, normative.Norms]
    people: normative.People
    cohorts: Mapping[str, Cohort]
    """With registered sheets; with other programs' maps by their names."""
    data: Values
    tables: dict[str, pd.DataFrame]
    known: int
    """Sites that the norms had before."""
    scored: Mapping[str, Mapping[str, ScoredMaps]] = field(default_factory=dict)
    """By cohort and hemisphere; empty where norms were fitted."""
    adapted: Bool | None = None
    """(visits,) controls from whom a site was estimated; ``None`` where norms were fitted."""


def run_norms(
    options: studies.GroupOptions,
    settings: GroupSettings,
    *,
    path: Path | None = None,
    among: tuple[str, str] | None = None,
    controls: tuple[str, str] | None = None,
) -> studies.GroupResult:
    """Fit norms, or score participants by a file's, and write all results or none.

    ``among`` are column and level of the participants, ``controls`` of the controls who estimate
    shift and scale of new sites.
    """
    dataset.check_own_dataset(options.out_dir)
    if path is not None:
        return _score_people(options, path, settings, among, controls)
    study = studies.read_study(options, settings, among).with_alignment()
    file, people = _planned(study)
    study = with_mixes(study, study.cohort.table[people.known], (file.age,))
    template, tables, cohorts, values = _registered(
        study, studies.read_templates(options.template, study.cohort)
    )
    tell("norms")
    file = file.model_copy(update={"template": template, "labels": dict(study.labels)})
    if settings.of(NormSettings).shared_knots:
        file, people, values = with_sums(study, file, people, values)
    norms, tables["coverage"] = _fit(values, people, file, settings.of(NormSettings))
    n_sites = len(file.sites)
    scoring = _Scoring(None, None, file, norms, people, cohorts, values, tables, n_sites)
    return _write(study, scoring, ())


def _score_people(
    options: studies.GroupOptions,
    path: Path,
    settings: GroupSettings,
    among: tuple[str, str] | None,
    controls: tuple[str, str] | None,
) -> studies.GroupResult:
    """Score people by the norms of a file."""
    file, norms = load_norms(path)
    n_sites = len(file.sites)
    measures = options.measures or tuple({m: 0 for _, m in norms})
    comparison = Comparison(sessions=AllSessions())  # each visit has a score
    options = replace(options, measures=measures, comparison=comparison)
    settings = settings.changed(registration=file.registration)
    study = studies.read_study(options, settings, among)
    notes, table = _check(file, path, study), study.cohort.table
    repeated = table.duplicated([PARTICIPANT, *({file.site} & set(table.columns))])
    if repeated.any() and FIRST_AGE not in table:
        notes.append(
            f"{file.age} is equal in all sessions of a participant; give the age of each "
            "session in sessions.tsv"
        )
    people = _people(study, file)
    if not people.known.any():
        reasons = "; ".join(dict.fromkeys(message for _, message in study.left_out.values()))
        raise ModelError(f"{path}: no participant can be scored: {reasons}")
    study = with_mixes(study, table[people.known], (file.age,), source=(path, file.labels))
    controls_kept = studies.members(table, controls, "--controls")
    references = controls_kept & (controls is not None) & ~repeated.to_numpy()
    file = _with_new_sites(study, path, file, people, references, controls=controls)
    templates = None if file.template is None else templates_from_json(file.template, str(path))
    _, tables, cohorts, values = _registered(study, templates)
    values = {key: numbers for key, numbers in values.items() if key in norms}
    adapted = references & people.known & (people.site >= n_sites)
    tell("norms")
    extended = {}
    for key, (rows, numbers) in values.items():
        if norms[key].mean.shape[1] != numbers.shape[1]:
            points = f"{norms[key].mean.shape[1]} points, these participants {numbers.shape[1]}"
            raise ModelError(f"{path}: norms of {listed(key)} have {points}")
        at, least = adapted[rows], settings.of(NormSettings).least_controls // 2
        extended[key] = norms[key].extended(
            numbers[at], people.take(rows[at]), len(file.sites), least
        )
    scored = {
        name: _score_maps(c, values, extended, people, adapted) for name, c in cohorts.items()
    }
    scoring = _Scoring(
        path, controls, file, extended, people, cohorts, values, tables, n_sites, scored, adapted
    )
    tables["zscores"] = pd.concat(_score_rows(scoring, adapted, settings), ignore_index=True)
    return _write(study, scoring, notes)


def _registered(
    study: studies.Study, templates: Mapping[str, Template] | None
) -> tuple[dict[str, Any] | None, dict[str, pd.DataFrame], dict[str, Cohort], Values]:
    """Register maps, and collect them and summary measures of each side and of the mean of both."""
    template, cohorts, tables = study.register(templates)
    names = set(study.maps)
    for name, cohort in cohorts.items():
        sides = {
            hemi: side.only([name for name in side.maps if name in names])
            for hemi, side in cohort.sides.items()
        }
        cohorts[name] = replace(cohort, sides=sides)
    values = {
        (layer.hemi, layer.measure): (layer.rows, layer.data)
        for layer in layers(cohorts, study.measures.maps, study.measures.summaries)
    }
    return template, tables, cohorts, values


def _write(study: studies.Study, scoring: _Scoring, notes: Iterable[str]) -> studies.GroupResult:
    """Write all results; charts are of the measures that the settings name."""
    file, people, cohort = scoring.file, scoring.people, study.cohort
    charts = [
        file.centiles(norms).assign(hemi=hemi, measure=name, unit=cohort.units.get(name, "1"))
        for (hemi, name), norms in scoring.norms.items()
        if name in study.settings.of(NormSettings).charts and hemi != BOTH
    ]
    if charts:
        table = pd.concat(charts, ignore_index=True)
        first = ["hemi", "measure", "unit"]
        scoring.tables["centiles"] = table[[*first, *table.columns.drop(first)]]
    among = f" ({escaped(' '.join(study.among))})" if study.among else ""
    visits = cohort.table[people.known]
    is_first = ~visits[PARTICIPANT].duplicated().to_numpy()
    sample = f"{is_first.sum()} participants{among}"
    text = norms_text(
        file,
        sample=sample if is_first.all() else f"{sample}, at {len(is_first)} visits,",
        coverage=scoring.tables.get("coverage"),
        new=list(file.sites)[scoring.known :],
        controls=scoring.controls,
        shared=study.cohort.shared,
    )

    def fill(folder: Path) -> list[str]:
        save_norms(folder / "norms.json", file, scoring.norms)
        for surface, cohort in scoring.cohorts.items():
            for hemi, side in cohort.sides.items():
                if side.maps:
                    write.write_surface(folder, cohort, points_of(side), hemi)
            if scored := scoring.scored.get(surface):
                write_scores(
                    folder, cohort, cohort.table, scored, letter="z", sheets=surface == SHEET
                )
        files.write_text(folder / "methods.md", text)
        return write.write_figures(folder, _figures(scoring), prints=study.options.figures)

    record = {
        "hemispheres": {hemi: len(side.rows) for hemi, side in cohort.sides.items()},
        "norms": _record(scoring, people.site[people.known][is_first]),
        "among": study.among,
    }
    name = studies.folder_of(["norms" if scoring.path is None else "scores"], study.among)
    notes = [*notes]
    if n_later := sum(exclusion.reason == "later-session" for exclusion in study.exclusions):
        notes.append(f"{n_later} later sessions are not in the norms, which take first ones")
    if file.site not in cohort.table:
        notes.append(f"no column {file.site!r}: all are taken to be at one, {_NO_SITE!r}")
    return study.write(
        name,
        notes,
        visits=visits,
        tables=scoring.tables,
        meaning=read_columns(EXTENSION.package),
        record=record,
        fill=fill,
    )


def _record(scoring: _Scoring, sites: Int) -> dict[str, Any]:
    """Record norms; ``sites`` (participants,) are positions in the sites of the file."""
    file = scoring.file
    counts = np.bincount(sites, minlength=len(file.sites)).tolist()
    return {
        "file": scoring.path and str(scoring.path),
        "participants": file.participants,
        "ages": [file.knots[0], file.knots[-1]],
        "sites": [
            {"site": site, "n": n, "here": counts[i], "new": i >= scoring.known}
            for i, (site, n) in enumerate(file.sites.items())
        ],
        "controls": scoring.controls,
        "folds": normative.CENTILE_FOLDS,
    }


def _protocol(study: studies.Study) -> tuple[str, str]:
    """Segmentation protocol and region of the sheets, if there are sheets."""
    records = study.collection.records
    return (records[0].result.name.seg, records[0].result.name.region) if records else ("none",) * 2


def _planned(study: studies.Study) -> tuple[NormsFile, normative.People]:
    """Say what norms are about, before they are fitted, and of whom.

    Refuses a cohort that is too small, or whose sexes are those of sites.
    """
    cohort, collection, settings = study.cohort, study.collection, study.settings
    rules, table = settings.of(NormSettings), cohort.table
    check_names([rules.age], table.columns)
    sites, complete = _site_labels(table, rules.site), np.ones(len(table), dtype=bool)
    sexes = level_labels(table[rules.sex]) if rules.sex in table else None
    for labels in (sites, sexes):
        complete &= True if labels is None else labels.notna().to_numpy()
    knots = np.array(rules.shared_knots, dtype=np.float64)
    if not len(knots):
        knots = normative.choose_knots(_ages(table, rules.age)[complete], rules)
    elif len(knots) < 3 or not (np.diff(knots) > 0).all():  # noqa: PLR2004 -- of a spline
        raise ModelError("--fit-norms: norms.shared_knots needs three ages or more that rise")
    file = NormsFile(
        description="norms of maps and summary measures by age, sex and site",
        format=1,
        hash="",
        version=__version__,
        versions=list(collection.versions),
        seg=_protocol(study)[0],
        region=_protocol(study)[1],
        settings_hash=collection.settings_hash,
        registration=resolve(settings)["registration"],
        template=None,
        x=cohort.x.tolist(),
        y=cohort.y.tolist(),
        age=rules.age,
        sex=rules.sex,
        site=rules.site,
        knots=knots.tolist(),
        sexes=[] if sexes is None else sorted(set(sexes.dropna())),
        sites=dict.fromkeys(sorted(set(sites.dropna())), 1),
        participants=1,
        norms={},
    )
    people = _people(study, file)
    is_known = people.known
    numbers = np.bincount(people.site[is_known], minlength=len(file.sites)).tolist()
    counts = dict(zip(file.sites, numbers, strict=True))
    if small := [f"{site} ({n})" for site, n in counts.items() if n < rules.least_site]:
        raise ModelError(
            f"--fit-norms: too few participants at {file.site} {listed(small)} (least "
            f"{rules.least_site}); use --exclude, or join sites of one scanner"
        )
    joined = np.hstack([np.eye(len(counts))[people.site[is_known]], people.sex[is_known]])
    if np.linalg.matrix_rank(joined) < joined.shape[1]:
        raise ModelError(
            f"--fit-norms: {file.sex} does not vary within {file.site}, and effects are "
            "inseparable; add sites with both"
        )
    return file.model_copy(update={"sites": counts, "participants": int(is_known.sum())}), people


def _ages(table: pd.DataFrame, column: str) -> Float:
    ages = typed(table[column])
    if not pd.api.types.is_numeric_dtype(ages):
        raise ModelError(f"norms: column {column!r} has to hold years")
    return ages.to_numpy(dtype=np.float64)


def _site_labels(table: pd.DataFrame, column: str) -> pd.Series:
    if column not in table:
        return pd.Series(_NO_SITE, index=table.index, dtype=object)
    return level_labels(table[column])


def _people(study: studies.Study, file: NormsFile) -> normative.People:
    """Describe visits as norms have to know them, new sites last; all other visits are left out."""
    table = study.cohort.table
    check_names([file.age, *([file.sex] if file.sexes else [])], table.columns)
    age, labels = _ages(table, file.age), _site_labels(table, file.site)
    refuse_alike(set(labels.dropna()), file.sites, f"norms: column {file.site}")
    low, high = file.knots[0], file.knots[-1]
    reach = f"outside of the norms' {low:g} to {high:g} years"
    sex = np.zeros((len(table), max(len(file.sexes) - 1, 0)))
    lacks = {file.age: np.isnan(age), file.site: labels.isna().to_numpy()}
    problems = {("norms-age", reach): (age < low) | (age > high)}
    if file.sexes:
        levels = level_labels(table[file.sex])
        lacks[file.sex] = levels.isna().to_numpy()
        strange = levels.notna() & ~levels.isin(file.sexes)
        problems["norms-sex", f"{file.sex} is none of {listed(file.sexes)}"] = strange.to_numpy()
        for i, level in enumerate(file.sexes[1:]):
            sex[:, i] = levels == level
    for reason, is_problem in problems.items():
        study.left_out.update(dict.fromkeys(map(str, table.index[is_problem]), reason))
    lacking = {name: map(str, table.index[is_lacking]) for name, is_lacking in lacks.items()}
    study.left_out.update(study.incomplete(lacking, table[PARTICIPANT]))
    usable = ~np.any([*problems.values(), *lacks.values()], axis=0)
    sites = [*file.sites, *sorted(set(labels[usable]) - set(file.sites))]
    site = np.where(usable, pd.Categorical(labels, categories=sites).codes, -1).astype(np.int64)
    return normative.People(age=age, sex=sex, site=site)


def _check(file: NormsFile, path: Path, study: studies.Study) -> list[str]:
    """Refuse people who were measured in another way; note what may differ."""
    cohort, collection = study.cohort, study.collection
    is_same_grid = all(
        len(a) == len(b) and np.allclose(a, b) for a, b in ((file.x, cohort.x), (file.y, cohort.y))
    )
    grid_text = f"{len(cohort.x)} by {len(cohort.y)} nodes"
    file_text = grid_text if is_same_grid else f"another grid, {len(file.x)} by {len(file.y)} nodes"
    seg, region = _protocol(study)
    for subject, value, expected in (
        ("segmentation protocol", seg, file.seg),
        ("region", region, file.region),
        ("hash of the participant level's settings", collection.settings_hash, file.settings_hash),
        ("grid of the sheet", grid_text, file_text),
    ):
        if value != expected:
            raise ModelError(
                f"{path}: {subject}: {expected}, but here {value}; measure participants as "
                "the reference cohort was"
            )
    available = {measure for measures in file.norms.values() for measure in measures}
    requested = [*study.maps, *(study.measures.summaries or ())]
    if unknown := [name for name in requested if name not in available]:
        raise ModelError(
            f"{path}: has no norms of {listed(unknown)}, only of {listed(sorted(available))};"
            " choose by --measures"
        )
    if set(collection.versions) - set(file.versions):
        note = (
            f"the norms are of maps of hipsta_bids {listed(file.versions)}, these "
            f"participants of {listed(collection.versions)}; numbers may differ"
        )
        return [note]
    return []


def _with_new_sites(
    study: studies.Study,
    path: Path,
    file: NormsFile,
    people: normative.People,
    references: Bool,
    *,
    controls: tuple[str, str] | None,
) -> NormsFile:
    """Add the names of new sites, if they have controls enough."""
    table, settings = study.cohort.table, study.settings
    least, sites = settings.of(NormSettings).least_controls, dict(file.sites)
    labels = _site_labels(table, file.site).to_numpy()
    for number in range(len(sites), int(people.site.max(initial=-1)) + 1):
        members = people.site == number
        site, count = str(labels[members][0]), int((members & references).sum())
        if count < least:
            controls_text = "=".join(controls) if controls else "(--controls COLUMN=LEVEL)"
            raise ModelError(
                f"{path}: no norms of {file.site} {site!r}, only {listed(list(file.sites))}; it"
                f" needs {least} controls {controls_text} within the ages, and has {count}"
            )
        sites[site] = count
    return file.model_copy(update={"sites": sites})


def _fit(
    values: Values, people: normative.People, file: NormsFile, rules: NormSettings
) -> tuple[dict[Key, normative.Norms], pd.DataFrame]:
    """Fit all norms, and estimate by cross-validation how many lie below each centile."""
    n_sites, knots = len(file.sites), np.array(file.knots)
    fit: Callable[[Float, normative.People, int, Float], normative.Norms]
    fit = partial(normative.fit_norms, settings=rules)
    if file.columns:
        fit = summed_norms.fit_values
    # Folds are spread evenly over sites.
    order = np.lexsort((np.random.default_rng(rules.seed).random(len(people.site)), people.site))
    fold = np.empty(len(order), dtype=np.int64)
    fold[order] = np.arange(len(order)) % normative.CENTILE_FOLDS
    norms, rows = {}, []
    for (hemi, measure), (visits, numbers) in values.items():
        people_here = people.take(visits)
        fitted = fit(numbers, people_here, n_sites, knots)
        is_fitted = np.isfinite(fitted.mean).all(axis=0)
        if not is_fitted.any():
            continue  # constant, or of too few people
        norms[hemi, measure] = fitted
        sampled = numbers[:, :: -(-numbers.shape[1] // CHECKED_POINTS)]
        z = np.full(sampled.shape, np.nan)
        for left in range(normative.CENTILE_FOLDS):
            out = fold[visits] == left
            fold_norms = fit(sampled[~out], people_here.take(~out), n_sites, knots)
            z[out] = fold_norms.score(sampled[out], people_here.take(out))
        scores = z[np.isfinite(z)]
        below = {
            f"below_{100 * level:g}": np.mean(scores < special.ndtri(level))
            for level in normative.LEVELS
        }
        rows.append(
            {
                "hemi": hemi,
                "measure": measure,
                "n": int(fitted.n.sum(axis=0).max()),
                "n_points": int(is_fitted.sum()),
                "transformed": float(np.any(fitted.shape[:, is_fitted] != 0, axis=0).mean()),
                **below,
            }
        )
    return norms, pd.DataFrame(rows)


def _score_maps(
    cohort: Cohort,
    values: Values,
    norms: Mapping[Key, normative.Norms],
    people: normative.People,
    adapted: Bool,
) -> dict[str, ScoredMaps]:
    """Score the maps of each hemisphere."""
    scored = {}
    for hemi, side in cohort.sides.items():
        scores = {}
        for measure in side.maps:
            if (hemi, measure) not in norms:
                continue
            norm = norms[hemi, measure]
            z = norm.score(values[hemi, measure][1], people.take(side.rows))
            scores[measure] = NormativeScores(z, 2 * special.ndtr(-np.abs(z)))
        if scores:
            scored[hemi] = ScoredMaps(
                rows=side.rows,
                reference=adapted[side.rows],
                scores=scores,
                subfield=most_frequent(side.subfield[:], len(side.names)),
                names=side.names,
            )
    return scored


def _score_rows(
    scoring: _Scoring, adapted: Bool, settings: GroupSettings
) -> Iterator[pd.DataFrame]:
    """List scores: of maps over regions, of summary measures also centiles."""
    maps = set()
    for name, scored in scoring.scored.items():
        maps |= {
            (hemi, measure)
            for hemi, side_scores in scored.items()
            for measure in side_scores.scores
        }
        for rows in map_rows(scoring.cohorts[name], scored, settings):
            table = rows.drop(columns="p").rename(columns={"w": "z", "reference": "adapted"})
            yield table[table["z"].notna()].assign(centile=np.nan)
    for (hemi, measure), (visits, numbers) in scoring.data.items():
        if (hemi, measure) not in maps:
            rows_known = visits[scoring.people.known[visits] & np.isfinite(numbers[:, 0])]
            z = scoring.norms[hemi, measure].score(
                numbers[rows_known], scoring.people.take(rows_known)
            )[:, 0]
            columns = {"adapted": adapted[rows_known], "z": z, "low": np.nan, "high": np.nan}
            labels = {"hemi": hemi, "measure": measure, "region": None, **columns}
            yield score_rows(
                scoring.cohorts[SHEET], rows_known, **labels, centile=100 * special.ndtr(z)
            )


def _figures(scoring: _Scoring) -> Iterator[tuple[str, Drawing]]:
    """List charts of summary measures, and maps."""
    if "centiles" in scoring.tables:
        for measure, centiles in scoring.tables["centiles"].groupby("measure", sort=False):
            yield f"{measure}_norms", partial(draw_norms, centiles, _dots(scoring, centiles))
    for surface, cohort in scoring.cohorts.items():
        for measure in dict.fromkeys(n for side in cohort.sides.values() for n in side.maps):
            sides = {h: side for h, side in cohort.sides.items() if (h, measure) in scoring.norms}
            grounds = grounds_of(cohort, {hemi: points_of(side) for hemi, side in sides.items()})
            unit = cohort.units.get(measure, "1")
            middle = scoring.file.middle
            means = {hemi: scoring.norms[hemi, measure].expected(middle) for hemi in sides}
            rows = norm_rows(means, float(middle.age[0]), measure, unit)
            if scoring.adapted is not None:
                rows = deviation_rows(scoring.scored[surface], measure)
            yield f"{measure}_normmaps", partial(draw_pages, grounds, [list(rows)])


def _dots(scoring: _Scoring, lines: pd.DataFrame) -> pd.DataFrame:
    """Collect values of new people as they would be at the average site."""
    sexes, blocks = scoring.file.sexes or [files.MISSING], []
    for key in lines[["hemi", "measure"]].drop_duplicates().itertuples(index=False, name=None):
        rows, numbers = scoring.data[key]
        rows, numbers = (rows, numbers) if scoring.adapted is not None else (rows[:0], numbers[:0])
        people_here = scoring.people.take(rows)
        level = (people_here.sex @ np.arange(1, len(sexes))).astype(np.int64)
        labels = {"hemi": key[0], "sex": np.array(sexes)[level], "age": people_here.age}
        moved = scoring.norms[key].average_site(numbers, people_here)[:, 0]
        adapted = np.zeros(0, bool) if scoring.adapted is None else scoring.adapted
        blocks.append(pd.DataFrame({**labels, "value": moved, "adapted": adapted}))
    return pd.concat(blocks, ignore_index=True).dropna()
