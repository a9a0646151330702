"""Hash every output file of the program, so that two versions of the code can be compared.

The package that is imported is the one on ``PYTHONPATH``, so that one script serves both sides:

    .venv/bin/python tools/outputs.py > after.txt
    PYTHONPATH=../before .venv/bin/python tools/outputs.py > before.txt
    diff before.txt after.txt

Times, memory, versions, absolute paths and white space between tags are masked.
"""

import argparse
import gzip
import hashlib
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from pathlib import Path

from hipsta_bids import __version__
from hipsta_bids.cli.main import main as run_command
from hipsta_bids.io import files

_NEAR = (folder / "shared" / "data" for folder in Path(__file__).resolve().parents)
SHARED = next((folder for folder in _NEAR if folder.is_dir()), Path("shared"))

#: Participants of the cohort, each with two sessions.
PEOPLE = 26

#: Settings of the group level that keep the runs short.
QUICK = """\
[classification]
repeats = 1
folds = 3
[registration]
group_permutations = 99
[norms]
least_participants = 50
least_site = 10
"""

#: Numbers that differ from run to run, by the ends of their keys in JSON.
_SPENT = re.compile(
    r'("[a-z_]*(?:seconds|time|_s|_mb|memory|cpu|duration|settings_hash)": )(?:[-+.\de]+|"\w+")'
)
_DATE = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(?::\d\d(?:\.\d+)?)?(?:Z|[+-]\d\d:?\d\d)?")
_TABLE_SPENT = re.compile(r"^seconds|(?:_s|_mb|seconds|memory|cpu|started|ended|log|_hash)$")


def demo(folder: Path) -> None:
    """Run the demonstration."""
    command("demo", folder / "demo")


def shared(folder: Path) -> None:
    """Run the participant level on the shared labels, if they are there."""
    for name in ("cobralab", "hippunfold"):
        if (SHARED / name).is_dir():
            command((SHARED / name).resolve(), folder / "shared" / name, "participant")


def group(folder: Path) -> None:
    """Ask each question of the group level of one cohort of phantoms with two sessions."""
    data, out = write_cohort(folder / "group")
    settings = folder / "group.toml"
    settings.write_text(QUICK, encoding="utf-8")

    def ask(name: str, *options: object) -> None:
        folders = (data, out)  # of the cohort that is current
        command(*folders, "group", "--settings", settings, "--name", name, *options)

    ask("default", "--contrast", "group[patient]-group[control]")
    ask("spline", "--age-model", "spline")
    ask("longitudinal", "--longitudinal")
    ask("paired", "--paired", "1", "2")
    ask("harmonize", "--harmonize", "site", "--asymmetry")
    ask("normative", "--normative", "group=control")
    pattern = "sub-{subject}/ses-{session}/anat/*hemi-{hemi}_*desc-exterior_curv.shape.gii"
    ask("maps", "--maps", f"other={out}/{pattern}", "--measures", "thickness", "other")
    ask("joint", "--joint", "thickness", "curvature", "--permutations", "200")
    ask("tfce", "--correction", "permutation-tfce", "--permutations", "200", "--n-procs", "1")
    ask("trial", "--retest", "--power", "thinning=5%")
    ask("planned", "--retest", "--power", "thinning=5%", "--visits", "0,12,24")
    data, out = write_people(data, out)
    ask("norms", "--fit-norms", "--measures", "thickness", "thickness_mean", "volume")
    ask("scores", "--norms", out / "group" / "norms" / "norms.json")
    sites: list[str] = []
    shared_template: list[object] = []
    for session, site in enumerate(("one", "two"), 1):
        people = [f"{session}{number:02d}" for number in range(1, PEOPLE + 1)]
        export = ("--export-summary", site, "--participant-label", *people)
        ask(f"site-{site}", *export, *shared_template)
        shared_template = ["--template", out / "group" / "site-one" / "template.json"]
        sites.append(f"{site}={out}/group/site-{site}/summary.json")
    command("meta", *sites, folder / "group" / "meta")
    analyses = (out / "group" / name for name in ("site-one", "site-two"))
    command("compare", *analyses, folder / "group" / "both")


CASES: dict[str, Callable[[Path], None]] = {"demo": demo, "shared": shared, "group": group}


def write_cohort(folder: Path) -> tuple[Path, Path]:
    """Write and measure phantoms; the second half of them become the first half's next session."""
    data = folder / "bids"
    command("phantom", data, "--n-subjects", 2 * PEOPLE, "--seed", 5)
    visits = sorted((data / "derivatives" / "freesurfer").glob("sub-*"))
    for number, visit in enumerate(visits):
        person = visits[number % PEOPLE].name
        visit.rename(visit.with_name(f"{person}_ses-{1 + number // PEOPLE}"))
    rows = files.read_tsv(data / "participants.tsv")[:PEOPLE]
    for number, row in enumerate(rows):
        ages = (float(row["age"]), float(row["age"]) + 1.5)
        label = row["participant_id"]
        files.write_tsv(
            data / label / f"{label}_sessions.tsv",
            ["session_id", "age"],
            [[f"ses-{i}", f"{age:.1f}"] for i, age in enumerate(ages, 1)],
        )
        row.pop("age")
        row["group"] = ("control", "patient")[number % 2]
    files.write_tsv(data / "participants.tsv", list(rows[0]), [list(row.values()) for row in rows])
    out = folder / "hipsta_bids"
    command(data, out, "participant")
    return data, out


def write_people(data: Path, out: Path) -> tuple[Path, Path]:
    """Copy the results of a cohort as if each visit were a participant with one visit."""
    people, results = data.with_name("people"), out.with_name("people_hipsta_bids")
    for path in out.rglob("sub-*_ses-*"):
        label, session = path.name.split("_")[:2]
        person = label.replace("sub-", f"sub-{session.removeprefix('ses-')}")
        if path.is_file() and path.parent.name == "anat":
            name = path.name.replace(f"{label}_{session}", person)
            files.write_bytes(results / person / "anat" / name, path.read_bytes())
    for name in ("dataset_description.json", "desc-settings.json"):
        files.write_bytes(results / name, (out / name).read_bytes())
    rows = []
    for row in files.read_tsv(data / "participants.tsv"):
        label = row["participant_id"]
        for visit in files.read_tsv(data / label / f"{label}_sessions.tsv"):
            number = visit["session_id"].removeprefix("ses-")
            person = label.replace("sub-", f"sub-{number}")
            rows.append({**row, "participant_id": person, "age": visit["age"]})
    files.write_tsv(
        people / "participants.tsv", list(rows[0]), [list(row.values()) for row in rows]
    )
    return people, results


def command(*arguments: object) -> None:
    """Run a command; its exit code and messages go to standard error."""
    words = [str(word) for word in arguments]
    with redirect_stdout(sys.stderr):
        code = run_command(words)
    sys.stderr.write(f"exit code {code}: hipsta-bids {' '.join(words)}\n")


def hashed(folder: Path) -> Iterator[str]:
    """Hash each file below a folder, one line each."""
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        if path.parent.name == "logs":
            continue
        content = masked(path, str(folder.resolve()))
        digest = hashlib.sha256(content).hexdigest()[:16]
        yield f"{digest}  {path.relative_to(folder)}"


def masked(path: Path, root: str) -> bytes:
    """Read a file without what differs from run to run."""
    content = path.read_bytes()
    if path.suffix == ".gz":
        return gzip.decompress(content)
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        return content
    shared = str(SHARED.resolve())
    for found, mask in ((root, "FOLDER"), (shared, "SHARED"), (__version__, "VERSION")):
        text = text.replace(found, mask)
    text = _DATE.sub("DATE", _SPENT.sub(r"\1SPENT", text))
    if path.suffix == ".tsv":
        text = _without_times(text)
    if path.suffix == ".html":
        text = re.sub(r"\s*(</?[a-zA-Z][^>]*>)\s*", r"\1", re.sub(r"\s+", " ", text))
    return text.encode()


def _without_times(text: str) -> str:
    """Drop the columns of a table that say how long something took, and how much memory."""
    lines = [line.split("\t") for line in text.splitlines()]
    keep = [i for i, name in enumerate(lines[0] if lines else []) if not _TABLE_SPENT.search(name)]
    return "\n".join("\t".join(line[i] for i in keep if i < len(line)) for line in lines)


def main() -> None:
    """Run the cases, and print the hashes."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--case", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="write the outputs here")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.keep or Path(scratch)
        for name in options.case:
            CASES[name](folder)
        sys.stdout.writelines(f"{line}\n" for line in hashed(folder))


if __name__ == "__main__":
    main()
