"""Tables as people have them: each is read as a careful person would, or refused in one line.

Each trap spoils the table of one cohort. What is read is held to an ordinary least-squares fit of
the careful person's table; what is refused names the line or the column.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
import pytest
import statsmodels.formula.api as smf
from small_cohorts import place_of, table

from hipsta_bids.cli.main import main
from hipsta_bids.io import files

#: Exit codes of a table or a model that is refused.
REFUSED = (64, 65, 66)
#: One measure, without classification and page.
QUICK = ("--align", "none", "--measures", "volume", "--no-classification", "--no-reports")


@dataclass(frozen=True, kw_only=True)
class Trap:
    """A table, what a careful person would read in it, or why it is refused."""

    name: str
    spoil: Callable[[str], str | bytes] = str
    """From the text of participants.tsv to that of the spoiled table."""
    files: dict[str, str] = field(default_factory=dict)
    """Other files of the dataset; ``{data}`` in options is its folder."""
    options: tuple[str, ...] = ()
    careful: Callable[[pd.DataFrame], pd.DataFrame] = lambda frame: frame
    """From the true table (participant_id, group, age, sex) to the one that is meant."""
    levels: tuple[str, str] = ("CN", "AD")
    """Names of the groups CN and AD in the table."""
    factor: str = "group"
    reference: str = "CN"
    """The group that is the reference."""
    added: str = ""
    """Terms of the model besides group, age and sex."""
    says: str = ""
    """What the terminal says, as a regular expression."""
    refused: str = ""
    """The line of a refusal, as a regular expression; empty if the table is read."""


def swap(*pairs: tuple[str, str]) -> Callable[[str], str]:
    """Replace texts of the table."""

    def spoil(text: str) -> str:
        for old, new in pairs:
            assert old in text
            text = text.replace(old, new)
        return text

    return spoil


def groups(control: str, patient: str, column: str = "group") -> Callable[[str], str]:
    """Rename levels and the column of the groups."""
    return swap(("\tCN", f"\t{control}"), ("\tAD", f"\t{patient}"), ("group", column))


def ids(change: Callable[[int], str]) -> Callable[[str], str]:
    """Write other labels of participants."""
    return lambda text: re.sub(r"sub-(\d+)", lambda match: change(int(match[1])), text)


def line(number: int, change: Callable[[str], str]) -> Callable[[str], str]:
    """Change a line of the table."""

    def spoil(text: str) -> str:
        lines = text.splitlines()
        lines[number - 1] = change(lines[number - 1])
        return "\n".join(lines) + "\n"

    return spoil


def cell(number: int, column: int, value: str) -> Callable[[str], str]:
    """Change a cell of a line."""

    def change(text: str) -> str:
        cells = text.split("\t")
        cells[column] = value
        return "\t".join(cells)

    return line(number, change)


def column(name: str, value: Callable[[int], str]) -> Callable[[str], str]:
    """Add a column; values by number of the participant."""

    def spoil(text: str) -> str:
        header, *rows = text.splitlines()
        added = [f"{row}\t{value(number)}" for number, row in enumerate(rows, start=1)]
        return "\n".join([f"{header}\t{name}", *added]) + "\n"

    return spoil


def ages(change: Callable[[float], str]) -> Callable[[str], str]:
    """Write other ages."""
    return lambda text: re.sub(
        r"\t(\d+\.\d)\t", lambda match: f"\t{change(float(match[1]))}\t", text
    )


def without(*numbers: int) -> Callable[[pd.DataFrame], pd.DataFrame]:
    """Exclude participants from the true table."""
    labels = [f"sub-{number:02d}" for number in numbers]
    return lambda frame: frame[~frame.participant_id.isin(labels)]


def with_column(
    name: str, value: Callable[[int], object]
) -> Callable[[pd.DataFrame], pd.DataFrame]:
    """Add a column to the true table."""
    return lambda frame: frame.assign(**{name: [value(n) for n in range(1, len(frame) + 1)]})


def drug(number):
    return ("none", "donepezil", "memantine")[number % 3]


def education(number):
    return 9 + number * 7 % 12


def score(number):
    return -1.0 if number % 7 == 0 else round(2 * float(np.sin(number)) - 0.1, 1)


def missing(*numbers, code):
    """Years of education, with a code of missing values for some."""
    return column("education", lambda n: code if n in numbers else str(education(n)))


LEVELS = '{"group": {"Levels": {"1": "healthy", "2": "ill"}}}'
MISSING = '{"education": {"MissingValues": [-4]}}'
DRUG = ("--formula", "~ group + age + sex + drug")
EDUCATION = ("--formula", "~ group + age + sex + education")
SCORE = ("--formula", "~ group + age + sex + score")
SEX = '{"sex": {"Levels": {"1": "M", "2": "F"}}}'

TRAPS = (
    # Signs and references.
    Trap(
        name="groups in another column",
        spoil=groups("CN", "AD", "diag"),
        options=("--formula", "~ diag + age + sex"),
        factor="diag",
        says=r"diag CN \(control\)",
    ),
    Trap(
        name="control word in a phrase",
        spoil=groups("healthy control", "AD"),
        levels=("healthy control", "AD"),
        says=r"group healthy control \(control\)",
    ),
    Trap(
        name="German levels",
        spoil=groups("Gesund", "Alzheimer"),
        levels=("Gesund", "Alzheimer"),
    ),
    Trap(
        name="negated level",
        spoil=groups("non-demented", "demented"),
        levels=("non-demented", "demented"),
    ),
    Trap(
        name="levels without a control word",
        spoil=groups("zebra", "aardvark"),
        levels=("zebra", "aardvark"),
        reference="AD",
        says=r"group aardvark \(first in order\).*change with --reference",
    ),
    Trap(
        name="codes that a sidecar explains",
        spoil=groups("2", "1"),
        files={"participants.json": LEVELS.replace("1", "0").replace("2", "1").replace("0", "2")},
        levels=("healthy", "ill"),
    ),
    Trap(
        name="codes 1 and 2 of groups",
        spoil=groups("1", "2"),
        levels=("1", "2"),
        says=r"group 1 \(first in order\)",
    ),
    Trap(
        name="truth values of groups",
        spoil=groups("FALSE", "TRUE"),
        levels=("FALSE", "TRUE"),
    ),
    Trap(name="reference of the user", options=("--reference", "group=AD"), reference="AD"),
    Trap(
        name="reference in the formula",
        options=("--formula", "~ C(group, contr.treatment('AD')) + age + sex"),
        reference="AD",
    ),
    Trap(
        name="sexes as codes that a sidecar explains",
        spoil=swap(("\tM\n", "\t1\n"), ("\tF\n", "\t2\n")),
        files={"participants.json": SEX},
    ),
    # Participants.
    Trap(name="zeros lost", spoil=ids(str), says="sub-1 is read as sub-01 .9 labels alike"),
    Trap(name="prefix without zeros", spoil=ids(lambda n: f"sub-{n}"), says="9 labels alike"),
    Trap(name="three digits", spoil=ids(lambda n: f"sub-{n:03d}"), says="30 labels alike"),
    Trap(name="numbers with decimals", spoil=ids(lambda n: f"{n}.0"), says="labels alike"),
    Trap(name="prefix in capitals", spoil=ids(lambda n: f"SUB-{n:02d}"), says="labels alike"),
    Trap(name="blanks round labels", spoil=ids(lambda n: f" sub-{n:02d} ")),
    Trap(
        name="two labels that may be one",
        spoil=ids(lambda n: "sub-1" if n == 2 else f"sub-{n:02d}"),
        refused=r"participants.tsv: sub-01 and sub-1 may be sub-01",
    ),
    Trap(
        name="labels with a site before the number",
        spoil=ids(lambda n: f"sub-SD_{n:02d}"),
        refused="participants.tsv: names none of the participants here; it has sub-SD_01",
    ),
    Trap(
        name="labels as dates",
        spoil=ids(lambda n: f"{n}-Mar" if n < 6 else f"sub-{n:02d}"),
        refused="has no row of 5 of 30 participants: sub-01, sub-02",
    ),
    Trap(
        name="rows lacking",
        spoil=lambda text: "".join(text.splitlines(keepends=True)[:-4]),
        refused=r"has no row of 4 of 30 participants: sub-27, sub-28.*--allow-missing",
    ),
    Trap(
        name="rows lacking, allowed",
        spoil=lambda text: "".join(text.splitlines(keepends=True)[:-4]),
        options=("--allow-missing",),
        careful=without(27, 28, 29, 30),
        says="has no row of sub-27, sub-28",
    ),
    Trap(
        name="a row twice",
        spoil=lambda text: text + text.splitlines()[3] + "\n",
        refused="participants.tsv: sub-03 occur more than once",
    ),
    Trap(
        name="rows of screening failures",
        spoil=lambda text: text + "sub-77\tCN\tn/a\tn/a\nsub-78\tMCI\t70.0\tF\n",
    ),
    Trap(
        name="labels of another table",
        files={
            "more.tsv": "participant_id\tdrug\n"
            + "".join(f"{n}\t{drug(n)}\n" for n in range(1, 31))
        },
        options=("--covariates", "{data}/more.tsv", *DRUG),
        careful=with_column("drug", drug),
        added=" + drug",
        says="more.tsv: sub-1 is read as sub-01",
    ),
    Trap(
        name="exclusions in another spelling",
        files={"drop.tsv": "participant_id\themi\n3\tn/a\nsub-7\tlh\n7\tright\n"},
        options=("--exclude", "{data}/drop.tsv"),
        careful=without(3, 7),
        says=r"drop.tsv: 3 is read as 03 \(2 labels alike\)",
    ),
    Trap(
        name="exclusions of nobody",
        files={"drop.tsv": "participant_id\nsub-3a\n"},
        options=("--exclude", "{data}/drop.tsv"),
        refused="drop.tsv: matches no hemisphere here: sub-3a; correct the labels",
    ),
    Trap(
        name="exclusions of a side that is none",
        files={"drop.tsv": "participant_id\themi\nsub-03\tboth\n"},
        options=("--exclude", "{data}/drop.tsv"),
        refused="drop.tsv: line 2: hemi 'both' is not L or R",
    ),
    Trap(
        name="exclusions that may be of two",
        files={"drop.tsv": "participant_id\n1\n001\n"},
        options=("--exclude", "{data}/drop.tsv"),
        refused="drop.tsv: 1 and 001 may be 01",
    ),
    # Missing values.
    Trap(
        name="a level none",
        spoil=column("drug", drug),
        options=DRUG,
        careful=with_column("drug", drug),
        added=" + drug",
    ),
    Trap(
        name="codes -4 of missing values",
        spoil=missing(4, 20, code="-4"),
        options=EDUCATION,
        refused=r"education.*-4.*2.*MissingValues",
    ),
    Trap(
        name="code -1 of missing values",
        spoil=missing(4, code="-1"),
        options=EDUCATION,
        refused=r"education.*-1",
    ),
    Trap(
        name="codes that a sidecar declares",
        spoil=missing(4, 20, code="-4"),
        files={"participants.json": MISSING},
        options=(*EDUCATION, "--allow-missing"),
        careful=lambda frame: without(4, 20)(with_column("education", education)(frame)),
        added=" + education",
    ),
    Trap(
        name="scores of -1",
        spoil=column("score", lambda n: str(score(n))),
        options=SCORE,
        careful=with_column("score", score),
        added=" + score",
    ),
    *(
        Trap(
            name=f"missing values {code!r}",
            spoil=missing(4, 20, code=code),
            options=(*EDUCATION, "--allow-missing"),
            careful=lambda frame: without(4, 20)(with_column("education", education)(frame)),
            added=" + education",
        )
        for code in ("-9999", "#N/A", ".", "-")
    ),
    *(
        Trap(
            name=f"a code {code}",
            spoil=missing(4, 20, code=code),
            options=EDUCATION,
            refused=rf"education.*sub-04 \({re.escape(f'{float(code):g}')}\)",
        )
        for code in ("999", "9999", "-2147483648", "77777")
    ),
    Trap(
        name="ages with decimal commas",
        spoil=ages(lambda age: f"{age:.1f}".replace(".", ",")),
        refused="column 'age' holds decimal commas, as sub-01",
    ),
    Trap(name="an age above a limit", spoil=cell(6, 2, "89+"), refused=r"age.*'89\+'"),
    Trap(name="ages with a unit", spoil=ages(lambda age: f"{age:.1f}y"), refused="in 'age': 55.1y"),
    Trap(
        name="ages in months",
        spoil=ages(lambda age: f"{12 * age:.1f}"),
        careful=lambda frame: frame.assign(age=12 * frame.age),
    ),
    Trap(name="an age in months", spoil=cell(4, 2, "674"), refused="age.*674"),
    Trap(
        name="a minus sign of print",
        spoil=column("score", lambda n: str(score(n)).replace("-", "\u2212")),
        options=SCORE,
        careful=with_column("score", score),
        added=" + score",
    ),
    # Rows.
    Trap(name="trailing tabs", spoil=swap(("\n", "\t\n"))),
    Trap(name="trailing tab in rows only", spoil=swap(("M\n", "M\t\n"), ("F\n", "F\t\n"))),
    Trap(name="blank lines", spoil=lambda text: text + "\n\n \n"),
    Trap(name="byte-order mark", spoil=lambda text: b"\xef\xbb\xbf" + text.encode()),
    Trap(name="lines of Windows", spoil=swap(("\n", "\r\n"))),
    Trap(name="lines of old Macs", spoil=swap(("\n", "\r"))),
    Trap(
        name="a short row",
        spoil=line(5, lambda row: row.rsplit("\t", 1)[0]),
        refused="line 5 has 3 cells, the header 4",
    ),
    Trap(
        name="a long row",
        spoil=line(7, lambda row: f"{row}\tx"),
        refused="line 7 has 5 cells, the header 4",
    ),
    Trap(
        name="a row with blanks for a tab",
        spoil=line(9, lambda row: row.replace("\t", "  ", 1)),
        refused="line 9 has 3 cells, the header 4",
    ),
    Trap(name="commas for tabs", spoil=swap(("\t", ",")), refused="participants.tsv.*tabs"),
    Trap(name="semicolons for tabs", spoil=swap(("\t", ";")), refused="participants.tsv.*tabs"),
    Trap(
        name="UTF-16", spoil=lambda text: text.encode("utf-16"), refused="participants.tsv.*UTF-8"
    ),
    Trap(name="a column twice", spoil=swap(("age", "sex")), refused="participants.tsv.*sex"),
    Trap(
        name="quotes",
        spoil=lambda text: re.sub(r"[^\t\n]+", lambda m: f'"{m[0]}"', text),
    ),
    Trap(
        name="names of rows",
        spoil=lambda text: re.sub(r"\nsub", "\n1\tsub", text),
        refused="line 2 has 5 cells, the header 4",
    ),
    Trap(
        name="header in capitals",
        spoil=swap(("participant_id", "Participant_ID")),
        refused="no column participant_id",
    ),
    Trap(name="header only", spoil=lambda text: text.splitlines()[0] + "\n", refused="has no rows"),
    # Levels.
    Trap(
        name="two spellings of a sex",
        spoil=swap(("\t55.5\tM", "\t55.5\tmale"), ("\t79.4\tM", "\t79.4\tmale")),
        refused=r"levels of 'sex' are several spellings: 'M' \(\d+\), 'male' \(2\)",
    ),
    Trap(
        name="levels in capitals and not",
        spoil=cell(3, 1, "cn"),
        refused="group.*'CN' \\(15\\), 'cn' \\(1\\)",
    ),
    Trap(name="blanks inside levels", spoil=cell(3, 1, "C N"), refused="group.*capitals or blanks"),
    Trap(
        name="blanks round levels",
        spoil=cell(3, 1, "CN "),
    ),
    Trap(name="no-break space after a level", spoil=cell(3, 1, "CN\u00a0")),
    Trap(
        name="a level of two participants",
        spoil=lambda text: cell(3, 1, "MCI")(cell(4, 1, "MCI")(text)),
        refused="group.*MCI.*2",
    ),
    Trap(name="one group only", spoil=swap(("\tAD", "\tCN")), refused="group"),
    Trap(
        name="a column of the model lacking",
        spoil=swap(("group", "dx")),
        options=("--formula", "~ group + age + sex"),
        refused="group",
    ),
    Trap(
        name="levels that are numbers",
        spoil=column("site", lambda n: str(n % 3 + 1)),
        options=("--formula", "~ group + age + sex + site"),
        careful=with_column("site", lambda n: f"s{n % 3}"),
        added=" + site",
    ),
)


def written_truth(trap, clean):
    """Fit the careful person's table: participants by name of group, and the contrast."""
    frame = trap.careful(clean)
    other = "AD" if trap.reference == "CN" else "CN"
    term = f"C(group, Treatment('{trap.reference}'))"
    fit = smf.ols(f"volume ~ {term} + age + sex{trap.added}", frame).fit()
    names = dict(zip(("CN", "AD"), trap.levels, strict=True))
    counts = frame.group.map(names).value_counts().to_dict()
    return counts, f"{names[trap.reference]}-{names[other]}", -fit.params[f"{term}[T.{other}]"]


@pytest.fixture(scope="module")
def clean(written):
    """The true table, with the volumes of the left side."""
    frame = table(written / "bids" / "participants.tsv")
    place = [place_of(written / "out", label[4:], "L") for label in frame.participant_id]
    volumes = [float(table(one.path("summary")).volume.iloc[0]) for one in place]
    return frame.assign(volume=volumes)


@pytest.mark.usefixtures("without_figures")
@pytest.mark.parametrize("trap", TRAPS, ids=lambda trap: trap.name)
def test_a_table_is_read_right_or_refused_in_one_line(written, clean, tmp_path, capsys, trap):
    content = trap.spoil((written / "bids" / "participants.tsv").read_text())
    content = content.encode() if isinstance(content, str) else content
    (tmp_path / "participants.tsv").write_bytes(content)
    for name, text in trap.files.items():
        (tmp_path / name).write_text(text)
    options = [text.format(data=tmp_path) for text in trap.options]
    name = "".join(filter(str.isalnum, trap.name))
    code = main([str(tmp_path), str(written / "out"), "group", *QUICK, "--name", name, *options])
    printed = capsys.readouterr()
    folder = written / "out" / "group" / name
    if trap.refused:
        assert code in REFUSED
        assert not folder.exists()
        assert printed.err.count("\n") == 1
        assert re.search(trap.refused, printed.err), printed.err
        return
    assert code == 0, printed.err
    assert re.search(trap.says, printed.out), printed.out
    counts, contrast, estimate = written_truth(trap, clean)
    covariates = pd.DataFrame(files.read_tsv(folder / "covariates.tsv"))
    assert covariates[trap.factor].value_counts().to_dict() == counts
    rows = table(folder / "measures.tsv").query("hemi == 'L'")
    row = rows.set_index("contrast").loc[contrast]
    assert row.n == sum(counts.values())
    assert row.estimate == pytest.approx(estimate, rel=1e-7)
