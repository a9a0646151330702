"""Which script makes which images of docs/, and the record of the version that made them.

``docs/figures/record.json`` has for each file: script, version, commit, hash of the code of the
package, and hash of the file.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path

from hipsta_bids import __version__
from hipsta_bids.io import files
from validation.report import commit
from validation.sources import code_of

ROOT = Path(__file__).resolve().parents[1]
RECORD = ROOT / "docs" / "figures" / "record.json"


@dataclass(frozen=True)
class Script:
    """A script of tools/ that draws."""

    patterns: Sequence[str]
    """Of the files that it writes, below docs/."""
    arguments: Sequence[str] = ()


#: Scripts by name, the fast ones first.
SCRIPTS: Mapping[str, Script] = {
    "make_measures": Script(["images/measures-*.png"], ["docs"]),
    "pet_figure": Script(["images/pet-fmri.png"]),
    "readme_figure": Script(["images/readme.png"]),
    "python_figures": Script(["images/python-*.png"]),
    "regions_figure": Script(
        ["images/regions-whole.png"], ["TEMPLATES", "docs/images/regions-whole.png"]
    ),
    "notebooks": Script(
        ["notebooks/*.ipynb"], ["docs/notebooks/measure.ipynb", "docs/notebooks/group.ipynb"]
    ),
    "page_figures": Script(["images/tutorial-report.png", "figures/reports/*.png"]),
    "group_figures": Script(["images/group-*.png", "images/consortium-forest.svg"]),
}


def drawn(name: str) -> list[Path]:
    """List the files that a script writes."""
    patterns = SCRIPTS[name].patterns
    return sorted(path for pattern in patterns for path in (ROOT / "docs").glob(pattern))


def read() -> dict[str, dict[str, str]]:
    """Read what is recorded of each file, by its name below docs/."""
    return dict(json.loads(RECORD.read_text("utf-8"))) if RECORD.is_file() else {}


def hash_of(path: Path) -> str:
    """Return the hash of a file."""
    return sha256(path.read_bytes()).hexdigest()[:12]


@cache
def package() -> str:
    """Return the hash of all code that the command runs."""
    code = code_of("hipsta_bids.cli.main", "hipsta_bids.group", "hipsta_bids.participant.run")
    return sha256(repr(sorted(code.items())).encode()).hexdigest()[:12]


def store(name: str) -> None:
    """Record the files that a script wrote just now."""
    origin = {"script": name, "version": __version__, "commit": commit(), "code": package()}
    entries = {
        path.relative_to(ROOT / "docs").as_posix(): {**origin, "file": hash_of(path)}
        for path in drawn(name)
    }
    files.write_json(RECORD, dict(sorted((read() | entries).items())))
