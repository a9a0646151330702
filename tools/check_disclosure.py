"""Attack summaries for other sites: read small cells, small sums and single values out of them.

Random designs are fitted and exported as ``group --export-summary`` does it. The attack has the
file, and all coefficients with their covariance: contrasts that a site chooses can hold these. They
hold the sum of each product of two columns, and of each column with each measure; the names of
columns say which levels a sum is about. From these the attack

- solves for counts and sums in all cells of the factors, in whole numbers if these are counts;
- takes functions with a bend apart into the piece below and the piece above;
- looks for the only values of a number, and of a count that is a measure, that have these sums.

What it reads is compared with the table of participants afterwards.
"""

import argparse
import json
import re
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations, product
from math import comb
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import pandas as pd
from checks import demand, echo
from numpy.typing import NDArray
from scipy import optimize, sparse

from hipsta_bids.errors import ModelError
from hipsta_bids.extensions.consortia import exchange
from hipsta_bids.group.cohort.data import Cohort, Measures
from hipsta_bids.group.questions.analysis import analyze_cohort
from hipsta_bids.group.request import Request
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.stats.arrays import SideMaps
from hipsta_bids.stats.design import Design
from hipsta_bids.stats.formula import model_from_shortcut, parse_model
from hipsta_bids.stats.settings import RegistrationSettings

exchange_model = exchange._model  # noqa: SLF001  (its result gets coefficients)
FEWEST = 5  # participants that a number has to be about
COUNT, SEED = 1000, 0
ORDINARY, SIZE, LEAST = 200, 100, 0.97  # cohorts, participants, share to be exported

#: Values that a number can have, as anybody knows them; ``y`` are measures.
SUPPORT: Mapping[str, Sequence[float]] = {
    "apoe": (0, 1, 2),
    "cdr": (0, 0.5, 1, 2, 3),
    "edu": tuple(range(4, 25)),
    "gds": tuple(range(16)),
    "age": tuple(range(40, 101)),
    "y cysts": tuple(range(6)),
}
#: Numbers that are zero or more, with their smallest step.
STEPS = {"apoe": 1.0, "cdr": 0.5, "gds": 1.0, "y cysts": 1.0}
#: Numbers with few values are looked for in every cell, other numbers in small cells.
_FEW_VALUES, _SMALL_CELL = 6, 14
_MOMENTS = (3, 5)  # power sums from the zeroth, least and most
_EXACT, _WHOLE = 1e-8, 1e-5  # errors of weights, and of counts
_COUNT_ERROR, _AGE_ERROR = 0.01, 0.1
#: In designs: two groups and not three; interactions of factors, of three, with numbers; a bend.
_TWO, _PAIR, _TRIPLE, _WITH_NUMBER, _BEND = 0.6, 0.25, 0.2, 0.3, 0.4

Floats = NDArray[np.float64]
#: Level by factor, sorted: a cell, or several cells together.
Cell = tuple[tuple[str, str], ...]
Terms = tuple[str, ...]
#: A column: levels, and functions of numbers.
Column = tuple[Cell, Terms]


@dataclass(frozen=True)
class Sums:
    """Sums over cells by the numbers that are multiplied, as a file holds them."""

    levels: dict[str, list[str]]
    by_terms: dict[Terms, dict[Cell, float]] = field(default_factory=lambda: defaultdict(dict))


class Leak(NamedTuple):
    """A number that was read out of a file."""

    kind: str
    cell: Cell
    terms: Terms
    """What is summed; empty for a count."""
    value: float
    times: int = 0
    """How often a value occurs."""


# --- designs -----------------------------------------------------------------------------------


def draw_table(random: np.random.Generator) -> pd.DataFrame:
    """Draw participants; some levels, and some values of numbers, are rare."""
    n = int(random.integers(20, 301))

    def level(names: Sequence[str]) -> list[str]:
        shares = random.dirichlet([float(random.choice([1, 5, 50]))] * len(names))
        return [str(name) for name in random.choice(names, n, p=shares)]

    age = random.normal(70, random.choice([1.5, 4, 8]), n).clip(41, 99)
    labels = [f"sub-{i:03d}" for i in range(n)]
    return pd.DataFrame(
        {
            "participant_id": labels,
            "group": level(["CN", "AD"] if random.random() < _TWO else ["CN", "MCI", "AD"]),
            "sex": level(["F", "M"]),
            "site": level([f"s{i}" for i in range(int(random.integers(2, 5)))]),
            "hand": level(["left", "right"]),
            "age": np.round(age, int(random.integers(0, 2))),
            "icv": np.round(random.normal(1.5e6, 1.5e5, n)),
            "edu": np.round(random.normal(14, random.choice([1, 3]), n)).clip(4, 24),
            "apoe": random.choice([0.0, 1, 2], n, p=random.dirichlet([8, 4, 2])),
            "cdr": random.choice([0, 0.5, 1, 2], n, p=random.dirichlet([6, 4, 3, 1])),
            "gds": random.poisson(random.choice([0.3, 3]), n).clip(0, 15).astype(np.float64),
            "cysts": random.poisson(0.1, n).astype(np.float64),
        },
        index=labels,
    )


def draw_formula(random: np.random.Generator) -> str:
    """Draw factors, numbers, interactions, and functions of age with and without a bend."""
    factors = [str(name) for name in random.permutation(["group", "sex", "site", "hand"])]
    factors = factors[: int(random.choice([1, 1, 2, 2, 2, 3]))]
    numbers = [
        str(name) for name in random.permutation(["age", "icv", "edu", "apoe", "cdr", "gds"])
    ]
    numbers = numbers[: int(random.choice([0, 1, 1, 2, 2, 3]))]
    terms = [*factors, *numbers]
    terms += [f"{a}:{b}" for a, b in combinations(factors, 2) if random.random() < _PAIR]
    terms += ["*".join(factors)] if random.random() < _TRIPLE else []
    for name in numbers:
        if random.random() < _WITH_NUMBER:
            terms.append("*".join([*factors[: int(random.integers(1, len(factors) + 1))], name]))
    if "age" in numbers and random.random() < _BEND:
        knot = int(random.integers(60, 86))
        shapes = [
            f"abs(age - {knot})",
            f"{factors[0]}:age + {factors[0]}:abs(age - {knot}) + abs(age - {knot})",
            f"abs(age - 65) + abs(age - {knot})",
            "I((age - 70)**2)",
            "exp((age - 70) / 2)",
        ]
        terms.append(str(random.choice(shapes)))
    return " + ".join(terms)


def draw_ordinary(random: np.random.Generator, n: int) -> tuple[pd.DataFrame, str]:
    """Draw a cohort and a model as most articles have them; groups are of one size."""
    table = pd.DataFrame({"participant_id": [f"sub-{i:03d}" for i in range(n)]})
    table = table.assign(
        group=np.resize(["CN", "AD"], n),
        sex=random.choice(["F", "M"], n),
        age=np.round(random.normal(70, 7, n)),
        icv=np.round(random.normal(1.5e6, 1.5e5, n)),
        edu=np.round(random.normal(14, 3, n)).clip(6, 22),
        cysts=random.poisson(0.1, n).astype(np.float64),
    ).set_index("participant_id", drop=False)
    formulas = [
        "group + age + sex",
        "group + age + sex + icv",
        "group + age + sex + edu",
        "group*age + sex",
        "group*sex + age",
    ]
    return table, str(random.choice(formulas))


def export(table: pd.DataFrame, formula: str, random: np.random.Generator) -> str:
    """Return the text of the summary that a site would send; ModelError if it is refused."""
    n, ends = len(table), np.array([-1.0, 1.0])
    settings = GroupSettings(registration=RegistrationSettings(align="none"))
    side = SideMaps(
        rows=np.arange(n),
        maps={name: random.normal(2, 0.2, (n, 2, 2)) for name in ("thickness", "curvature")},
        subfield=np.zeros((n, 2, 2), dtype=np.int8),
        names=("CA1",),
        summary=pd.DataFrame(
            {"volume": random.normal(500, 50, n), "cysts": table["cysts"].to_numpy()}
        ),
    )
    cohort = Cohort(table=table, sides={"L": side}, x=ends, y=ends, units={})
    request = Request(
        cohort=cohort,
        model=parse_model(model_from_shortcut(formula, ["constant = Intercept"], "attack")),
        groups=None,
        settings=settings,
        measures=Measures(maps=("thickness",)),
        references={},
        icv="icv" if random.integers(2) else None,
    )
    analysis = analyze_cohort(request)
    inputs = {"versions": [], "seg": "demo", "region": "body", "settings_hash": "0"}
    with patch.object(exchange, "_model", model_with_coefficients):
        summary, _ = exchange.summarize(cohort, analysis, settings, site="a", inputs=inputs)
    return json.dumps(summary)


def model_with_coefficients(values: Floats, design: Design, *rest: Any) -> dict[str, Any]:  # noqa: ANN401  (passed on)
    """Export a model with what contrasts of each column, and of pairs of columns, would add."""
    entry = exchange_model(values, design, *rest)
    inverse = np.linalg.inv(design.matrix.T @ design.matrix)
    known = np.array([sd is not None for sd in entry["sd"]])
    fitted = inverse @ design.matrix.T @ np.where(known, values, 0.0)
    return entry | {"covariance": inverse.tolist(), "coefficients": fitted.tolist()}


# --- the attack, which knows the text of a summary with coefficients, and nothing else -----------


def read_column(name: str) -> Column:
    """Take the name of a column apart into levels and functions of numbers."""
    levels, numbers = [], []
    for part in re.split(r":(?![^(]*\))", name):
        if level := re.fullmatch(r"C?\(?(\w+)\)?\[T\.(.+)\]", part):
            levels.append((level[1], level[2]))
        elif part != "Intercept":
            numbers.append(part)
    return tuple(sorted(levels)), tuple(sorted(numbers))


def intersect(first: Cell, second: Cell) -> Cell | None:
    """Return who is in both cells, or None if nobody can be."""
    joined = dict(first) | dict(second)
    return tuple(sorted(joined.items())) if dict(second) | dict(first) == joined else None


def add_pieces(columns: Sequence[Column]) -> tuple[list[Column], Floats]:
    """Add both pieces of each function with a bend; all as weights of the columns."""
    names, rows = list(columns), list(np.eye(len(columns)))
    for number, (cell, terms) in enumerate(columns):
        for term in terms:
            bend = re.fullmatch(r"abs\((\w+) - ([\d.]+)\)", term)
            rest = tuple(other for other in terms if other != term)
            line = (cell, tuple(sorted((*rest, bend[1] if bend else ""))))
            if bend is None or line not in columns or (cell, rest) not in columns:
                continue
            for sign, side in ((1, "above"), (-1, "below")):
                row = np.zeros(len(columns))
                row[number], row[columns.index(line)] = 0.5, 0.5 * sign
                row[columns.index((cell, rest))] -= 0.5 * sign * float(bend[2])
                names.append((cell, tuple(sorted((*rest, f"{side}({bend[1]}, {bend[2]})")))))
                rows.append(row)
    return names, np.array(rows)


def read_sums(content: Mapping[str, Any]) -> Sums:
    """Read all sums of products in a summary."""
    sums = Sums({name: list(levels) for name, levels in content["factors"].items()})
    for model in content["models"]:
        columns, weights = add_pieces([read_column(name) for name in model["columns"]])
        covariance = np.array(model["covariance"])
        lengths = np.sqrt(np.diag(covariance))
        inverse = np.linalg.inv(covariance / np.outer(lengths, lengths))
        matrix = inverse / np.outer(lengths, lengths)
        squares = weights @ matrix @ weights.T
        size = np.sqrt(np.abs(np.diag(squares)))
        squares[np.abs(squares) < 1e-9 * np.outer(size, size)] = 0
        for i, j in product(range(len(columns)), repeat=2):
            cell = intersect(columns[i][0], columns[j][0])
            if cell is not None:
                terms = tuple(sorted((*columns[i][1], *columns[j][1])))
                sums.by_terms[terms].setdefault(cell, float(squares[i, j]))
        coefficients = np.array(model["coefficients"], dtype=np.float64).T
        for name, row, sd in zip(model["measures"], coefficients, model["sd"], strict=False):
            if sd is None:
                continue
            square = float(row @ matrix @ row) + model["df"] * sd**2
            sums.by_terms[f"y {name}", f"y {name}"].setdefault((), square)
            for (cell, terms), value in zip(columns, weights @ matrix @ row, strict=True):
                sums.by_terms[(*terms, f"y {name}")].setdefault(cell, float(value))
    return sums


def all_cells(levels: Mapping[str, Sequence[str]]) -> Iterator[Cell]:
    """List the cells of each set of factors."""
    for cell in product(*([None, *names] for names in levels.values())):
        yield tuple(sorted((f, x) for f, x in zip(levels, cell, strict=True) if x is not None))


class Solver:
    """Sums over all cells that follow from the sums over some."""

    def __init__(self, levels: Mapping[str, Sequence[str]], known: Mapping[Cell, float]) -> None:
        self.finest = [dict(zip(levels, cell, strict=True)) for cell in product(*levels.values())]
        self.rows = np.array([self.row(cell) for cell in known])
        self.sums = np.array(list(known.values()))
        self.inverse = np.linalg.pinv(self.rows)

    def row(self, cell: Cell) -> Floats:
        """Tell which of the finest cells a cell holds."""
        return np.array([float(all(one[f] == x for f, x in cell)) for one in self.finest])

    def solve(self, cell: Cell) -> float | None:
        """Give the sum over a cell, if there is only one solution."""
        row = self.row(cell)
        weights = row @ self.inverse
        return (
            float(weights @ self.sums)
            if np.allclose(weights @ self.rows, row, atol=_EXACT)
            else None
        )

    def solve_count(self, cell: Cell) -> float | None:
        """Give the count of a cell, if there is only one in whole numbers from zero."""
        ends = []
        for sign in (1, -1):
            result = optimize.linprog(
                sign * self.row(cell),
                A_eq=self.rows,
                b_eq=np.round(self.sums),
                bounds=(0, None),
                method="highs",
            )
            if not result.success or result.fun is None:
                return None
            ends.append(sign * result.fun)
        low, high = np.ceil(ends[0] - _WHOLE), np.floor(ends[1] + _WHOLE)
        return float(low) if low == high else None


def only_values(
    support: Sequence[float], moments: Sequence[float], random: np.random.Generator
) -> Floats | None:
    """Find how often each value of a number occurs, if its power sums leave one answer."""
    orders = range(len(moments))
    middle = float(np.round(moments[1] / moments[0]))
    # Power sums about a number near the mean are small, and exact in whole sixteenths.
    shift = [[comb(k, j) * (-middle) ** max(k - j, 0) for j in orders] for k in orders]
    wanted = np.round(np.array(shift) @ np.array(moments) * 16) / 16
    powers = np.vander(np.array(support) - middle, len(moments), increasing=True).T
    weights: Floats = random.normal(size=len(support))
    answers: list[Floats] = []
    for sign in (1, -1):
        result = optimize.milp(
            sign * weights,
            constraints=optimize.LinearConstraint(sparse.csr_array(powers), wanted, wanted),
            integrality=np.ones(len(support), dtype=np.int64),
            bounds=optimize.Bounds(0, moments[0]),
            options={"time_limit": 5},
        )
        if result.status != 0:
            return None
        answers.append(np.round(result.x))
    return answers[0] if (answers[0] == answers[1]).all() else None


def attack_numbers(
    solvers: Mapping[Terms, Solver], cell: Cell, random: np.random.Generator
) -> Iterator[Leak]:
    """Read values of numbers in a cell, and that few participants are above zero."""
    for name, step in STEPS.items():
        value = solvers[name,].solve(cell) if (name,) in solvers else None
        if value is not None and 0 < round(value / step) < FEWEST:
            yield Leak(f"few have {name}", cell, (name,), value)
    for name, support in SUPPORT.items():
        powers = [solvers.get((name,) * k) for k in range(_MOMENTS[1])]
        moments = [power.solve(cell) if power else None for power in powers]
        exact = moments[: moments.index(None) if None in moments else len(moments)]
        known = [moment for moment in exact if moment is not None]
        if len(known) < _MOMENTS[0] or round(known[0]) < 1:
            continue
        if len(support) > _FEW_VALUES and known[0] > _SMALL_CELL:
            continue
        counts = only_values(support, known, random)
        for value, count in zip(support, [] if counts is None else counts, strict=False):
            if 0 < count < FEWEST:
                yield Leak(f"values of {name}", cell, (name,), value, int(count))


def attack(text: str, random: np.random.Generator) -> Iterator[Leak]:
    """Read counts and sums of cells, and values of numbers, out of a summary."""
    content = json.loads(text)
    for name, levels in content["factors"].items():
        for level, count in levels.items():
            if count in range(FEWEST):
                yield Leak("count in plain text", ((name, level),), (), count)
    sums = read_sums(content)
    solvers = {terms: Solver(sums.levels, known) for terms, known in sums.by_terms.items()}
    for cell in all_cells(sums.levels):
        for terms, solver in solvers.items():
            value = solver.solve(cell)
            if value is not None:
                yield Leak("sum" if terms else "cell", cell, terms, value)
            elif not terms:
                count = solver.solve_count(cell)
                if count is not None:
                    yield Leak("cell in whole numbers", cell, (), count)
        yield from attack_numbers(solvers, cell, random)
    largest = solvers.get(("exp((age - 70) / 2)",) * 2)
    value = largest.solve(()) if largest else None
    if value is not None and value > 0:
        yield Leak("largest age", (), ("age",), float(70 + np.log(value)))


# --- what is behind it ---------------------------------------------------------------------------


def is_secret(leak: Leak, table: pd.DataFrame) -> bool:
    """Tell whether a number is right, and about fewer than five participants."""
    people = table
    for name, level in leak.cell:
        people = people[people[name].astype(str) == level]
    if leak.kind.startswith(("values of", "few have")):
        numbers = people[leak.terms[0].removeprefix("y ")]
        if leak.kind.startswith("few have"):
            return bool(0 < (numbers > 0).sum() < FEWEST)
        return bool((numbers == leak.value).sum() == leak.times)
    if leak.kind == "largest age":
        return bool(abs(leak.value - table["age"].max()) < _AGE_ERROR)
    for term in leak.terms:
        if piece := re.fullmatch(r"(above|below)\((\w+), ([\d.]+)\)", term):
            beyond = people[piece[2]] - float(piece[3])
            people = people[beyond > 0 if piece[1] == "above" else beyond < 0]
    if not leak.terms:
        return len(people) < FEWEST and abs(leak.value - len(people)) < _COUNT_ERROR
    return 0 < len(people) < FEWEST


class Outcome(NamedTuple):
    """What came of the designs."""

    exported: int
    refused: int
    leaking: int
    """Summaries out of which a number about fewer than five participants was read."""
    kinds: Counter[str]
    """How many summaries had each kind of leak."""


def attack_designs(count: int, seed: int = SEED) -> Outcome:
    """Attack random designs, of those that can be fitted."""
    kinds, exported, refused, leaking, number = Counter[str](), 0, 0, 0, 0
    while exported + refused < count:
        random = np.random.default_rng([seed, number])
        number += 1
        table, formula = draw_table(random), draw_formula(random)
        try:
            text = export(table, formula, random)
        except ModelError as error:
            refused += str(error).startswith("--export-summary")
            continue
        exported += 1
        secrets = [leak for leak in attack(text, random) if is_secret(leak, table)]
        kinds.update({leak.kind for leak in secrets})
        leaking += bool(secrets)
    return Outcome(exported, refused, leaking, kinds)


def share_of_ordinary(count: int, n: int = SIZE, seed: int = SEED) -> float:
    """Share of ordinary designs whose summaries are exported."""
    exported = 0
    for number in range(count):
        random = np.random.default_rng([seed, n, number])
        table, formula = draw_ordinary(random, n)
        try:
            export(table, formula, random)
        except ModelError as error:
            echo(f"refused: {formula}: {error}")
            continue
        exported += 1
    return exported / count


def main(arguments: Sequence[str] | None = None) -> int:
    """Attack, and end with exit code 1 if anything is read."""
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("--count", type=int, default=COUNT, help="designs")
    parser.add_argument("--seed", type=int, default=SEED)
    options = parser.parse_args(arguments)
    outcome = attack_designs(options.count, options.seed)
    echo(
        f"{outcome.exported} summaries exported, {outcome.refused} refused; {outcome.leaking} leak"
    )
    for kind, number in outcome.kinds.most_common():
        echo(f"  {kind}: {number}")
    share = share_of_ordinary(ORDINARY, seed=options.seed)
    echo(f"{share:.1%} of {ORDINARY} ordinary cohorts of {SIZE} participants exported")
    demand(outcome.leaking == 0, "no number about fewer than five participants was read")
    demand(share >= LEAST, "ordinary cohorts are exported")
    return 0


if __name__ == "__main__":
    sys.exit(main())
