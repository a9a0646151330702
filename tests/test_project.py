"""Guards for what no single module owns: locks, documents, and their agreement with the code."""

import ast
import json
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml
from extension_marks import PRESENT
from reference_pages import CHANGED, PAGES

import hipsta_bids
from hipsta_bids.errors import ExitCode
from hipsta_bids.extensions import NAMES
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.settings import Settings

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
LOCKS = ("requirements.lock", "requirements-dev.lock")


def canonical(requirement: str) -> str:
    """Reduce a requirement to the name of its package, as PEP 503 spells it."""
    match = re.match(r"[A-Za-z0-9._-]+", requirement)
    assert match is not None
    return re.sub(r"[-_.]+", "-", match.group()).lower()


def locked(name: str) -> dict[str, str]:
    """Version by package, from a lock."""
    lines = (ROOT / name).read_text(encoding="utf-8").splitlines()
    entries = [line.removesuffix(" \\").split("==", 1) for line in lines if "==" in line[:60]]
    # Markers differ: what one tool needs on Windows, another may need everywhere.
    return {package: rest.split(" ;")[0] for package, rest in entries if package[0].isalnum()}


def tracked_files() -> list[Path]:
    """All text files under version control, or to be."""
    git = shutil.which("git")
    if git is None or not (ROOT / ".git").exists():
        pytest.skip("not a clone: there is no list of tracked files")
    listed = subprocess.run(
        [git, "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    paths = [ROOT / name for name in listed.split("\0") if name]
    return [path for path in paths if path.is_file() and path.suffix != ".png"]


def hooks() -> list[dict[str, object]]:
    """Hooks for commits, in their order."""
    (repository,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text("utf-8"))["repos"]
    assert repository["repo"] == "local"
    return repository["hooks"]


@pytest.mark.parametrize(
    ("lock", "requirements"),
    [
        (
            "requirements.lock",
            [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["cluster"]],
        ),
        (
            "requirements-dev.lock",
            [
                *PROJECT["dependencies"],
                *PROJECT["optional-dependencies"]["dev"],
                *PROJECT["optional-dependencies"]["docs"],
            ],
        ),
    ],
)
def test_lock_covers_every_dependency(lock, requirements):
    missing = {canonical(requirement) for requirement in requirements} - locked(lock).keys()
    assert not missing, f"run `make lock`: {lock} lacks {sorted(missing)}"


@pytest.mark.parametrize("lock", LOCKS)
def test_lock_has_a_hash_for_every_package_and_no_address(lock):
    text = (ROOT / lock).read_text(encoding="utf-8")
    entries = re.split(r"\n(?=[a-z0-9])", text)[1:]
    assert len(entries) == len(locked(lock))
    assert all("--hash=sha256:" in entry for entry in entries)
    assert "://" not in text
    assert not re.search(r"^\s*-+(index|find|extra)", text, re.MULTILINE)


def test_imports_are_the_declared_dependencies():
    distributions = {
        "PIL": "pillow",
        "bids": "pybids",
        "mpl_toolkits": "matplotlib",
        "skimage": "scikit-image",
        "sklearn": "scikit-learn",
    }
    extras = PROJECT["optional-dependencies"]
    requirements = (*PROJECT["dependencies"], *extras["arrow"], *extras["transforms"])
    declared = {canonical(requirement) for requirement in requirements}
    trees = (
        ast.parse(path.read_text(encoding="utf-8")) for path in (ROOT / "hipsta_bids").rglob("*.py")
    )
    nodes = [node for tree in trees for node in ast.walk(tree)]
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)}
    own = {"hipsta_bids", "_typeshed"}  # the latter for type checkers only
    packages = {name.split(".")[0] for name in names} - sys.stdlib_module_names - own
    assert {distributions.get(name, name) for name in packages} == declared


def test_both_locks_hold_the_same_versions():
    run, dev = (locked(lock) for lock in LOCKS)
    assert run.items() <= dev.items()


def test_no_machine_paths_or_package_hosts():
    # Spelled in pieces, or this file would find itself.
    personal = "|".join(["/home" + "/", "/root" + "/", "/Users" + "/", "/work" + "/"])
    hosts = "|".join(["pypi" + r"\.org", "python" + r"hosted", "anaconda" + r"\.org"])
    pattern = re.compile(rf"(?<![\w.~*$)}}-])(?:{personal})|{hosts}")
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in tracked_files()
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
        if pattern.search(line)
    ]
    assert not found, "\n".join(found)


def test_no_segmentations_or_other_large_files_are_tracked():
    limit = 500_000  # bytes; the larger lock has 190 kB
    large = [path.name for path in tracked_files() if path.stat().st_size > limit]
    images = [path.name for path in tracked_files() if path.name.endswith((".mgz", ".nii.gz"))]
    assert not large
    assert not images


@pytest.mark.parametrize("path", sorted(ROOT.glob("docs/notebooks/*.ipynb")), ids=lambda p: p.stem)
def test_notebooks_hold_their_outputs(path):
    assert path.stat().st_size < 300_000
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    shown = [cell for cell in code if cell["outputs"]]
    assert len(shown) >= len(code) - 1  # one cell of a notebook may write a file and show nothing
    assert f"notebooks/{path.stem}.md" in (ROOT / "mkdocs.yml").read_text(encoding="utf-8")


def test_license_is_whole():
    text = (ROOT / "LICENSE").read_text(encoding="utf-8")
    assert "GNU AFFERO GENERAL PUBLIC LICENSE\n                       Version 3" in text
    assert "\n  17. Interpretation of Sections 15 and 16.\n" in text
    assert text.rstrip().endswith("<https://www.gnu.org/licenses/>.")


def test_changelog_names_this_version():
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"\n## [{hipsta_bids.__version__}]" in changelog


def test_citation_file_is_complete_and_up_to_date():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    # What the schema of version 1.2.0 requires.
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()
    assert citation["cff-version"] == "1.2.0"
    assert str(citation["version"]) == hipsta_bids.__version__
    assert citation["license"] == PROJECT["license"]
    assert all({"type", "title", "authors"} <= entry.keys() for entry in citation["references"])


def test_exit_codes_are_listed():
    page = (ROOT / "docs" / "command-line.md").read_text(encoding="utf-8")
    section = page.split("## Exit codes")[1].split("\n## ")[0]
    codes = {int(code) for code in re.findall(r"^\|(\d+) \|", section, re.MULTILINE)}
    signals = {128 + 2, 128 + 15}  # SIGINT and SIGTERM, as shells report them
    assert codes == set(ExitCode) | signals


def test_readme_is_short():
    words = README.split("\n## More\n")[0].split()
    assert len(words) <= 350
    assert len(README.split()) <= 600


def test_the_guide_has_the_time_of_the_page_on_cost():
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    seconds = re.search(r"\| ([\d.]+) s, median of twelve \|", page)
    assert seconds is not None
    guide = (ROOT / "docs" / "running.md").read_text(encoding="utf-8")
    assert f"{seconds[1]} s of processor time (median of twelve" in guide


def test_figures_are_small_and_licensed():
    figures = ROOT / "docs" / "images"
    assert "docs/images/readme.png" in README
    for name in ("readme", "regions-whole"):
        assert (figures / f"{name}.png").stat().st_size < 200_000
    license_ = (figures / "regions-whole.LICENSE.txt").read_text(encoding="utf-8")
    assert "Khan Computational Imaging Lab" in license_
    assert "WITHOUT WARRANTY OF ANY KIND" in license_
    page = (ROOT / "docs" / "regions.md").read_text(encoding="utf-8")
    assert page.index("regions-whole.png") < page.index("regions-whole.LICENSE.txt")


@pytest.mark.parametrize(
    "page",
    [
        "README.md",
        "CONTRIBUTING.md",
        *(f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md"))),
    ],
)
def test_links_lead_somewhere(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    targets = re.findall(r"\]\(([^)#]+)", text)
    local = [target for target in targets if "://" not in target]
    missing = [target for target in local if not (ROOT / page).parent.joinpath(target).exists()]
    assert not missing


@pytest.mark.parametrize("name", PAGES)
def test_pages_say_what_the_code_says(name):
    written = (ROOT / "docs" / name).read_text(encoding="utf-8")
    assert written == PAGES[name](), "run tools/make-docs"


def test_each_setting_is_on_one_of_two_pages():
    levels = (Settings(), GroupSettings())
    known = [f"`{stage}.{name}`" for level in levels for stage, table in level for name, _ in table]
    changed, others = (
        re.findall(r"`\w+\.\w+`", re.sub(r" \|.*", "", text, flags=re.MULTILINE))
        for text in (PAGES["settings.md"](), PAGES["settings-all.md"]())
    )
    assert sorted([*changed, *others]) == sorted(known)
    assert len(changed) == sum(len(names.split()) for names in CHANGED.values()) <= 40


def test_hooks_run_what_lint_runs():
    recipe = (ROOT / "Makefile").read_text(encoding="utf-8").partition("\nlint: ")[2]
    commands = re.findall(r"^\t(.+)", recipe.partition("\n\n")[0], re.MULTILINE)
    *checks, subject = hooks()
    assert [hook["entry"] for hook in checks] == [
        re.sub(r'"\$\(BIN\)/(.+?)"', r".venv/bin/\1", command) for command in commands
    ]
    assert {hook["language"] for hook in checks} == {"system"}  # versions of the lock, no network
    assert (subject["language"], subject["stages"]) == ("pygrep", ["commit-msg"])


@pytest.mark.parametrize(
    ("message", "refused"),
    [
        ("x" * 65, False),
        ("x" * 66, True),
        ("Say it briefly\n\n" + "a body is longer " * 9, False),
        ("fixup! " + "x" * 65, False),
    ],
)
def test_long_subjects_of_commits_are_refused(message, refused):
    assert bool(re.search(hooks()[-1]["entry"], message, re.MULTILINE | re.DOTALL)) == refused


def test_contributing_is_short():
    assert len((ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").split()) <= 900


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", "docs/architecture.md"])
def test_paths_of_the_code_exist(page):
    code = re.findall(r"`([\w./-]+)`", (ROOT / page).read_text(encoding="utf-8"))
    paths = {text for text in code if re.search(r"/$|/.*\.(py|toml|js|html)$|^tools/", text)}
    paths -= {"inputs/mytool.py", "shared/"}  # an example, and data beside the clone
    absent = tuple(f"extensions/{name}/" for name in set(NAMES) - PRESENT)  # were deleted
    paths -= {path for path in paths if path.startswith(absent)}
    assert paths
    folders = ("", "hipsta_bids", "hipsta_bids/group", "hipsta_bids/reports")
    places = [ROOT / folder for folder in (*folders, "hipsta_bids/reports/templates")]
    missing = [path for path in sorted(paths) if not any((root / path).exists() for root in places)]
    assert not missing
