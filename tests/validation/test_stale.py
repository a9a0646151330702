"""No claim rests on a record of other code than this, and no image is of another version."""

import json

import pytest
from claims import FOLDER, read_claims
from figure_record import ROOT, SCRIPTS, drawn, hash_of, package, read

from hipsta_bids import __version__
from validation.report import BENCHMARKS, SUITES, stale

#: A version in development shows stale suites on its page; a release has none.
RELEASE, _, DEVELOPMENT = __version__.partition(".dev")
of_a_release = pytest.mark.skipif(bool(DEVELOPMENT), reason="takes a release, as 1.0.0")

#: Records that numbers of pages come from.
CLAIMED = sorted(
    {
        source.partition("|")[0].partition("--")[0].strip()
        for page in ("README.md", "docs/validation.md")
        for claim in read_claims(page)
        for source in claim["numbers"]
    }
)


def test_claims_are_of_suites_and_benchmarks():
    assert len(CLAIMED) > 1
    assert set(CLAIMED) <= {*SUITES, *BENCHMARKS}


@of_a_release
@pytest.mark.parametrize("name", CLAIMED)
def test_the_record_of_a_claim_is_of_this_code(name):
    record = json.loads((FOLDER / f"{name}.json").read_text("utf-8"))
    assert stale(name, record) == [], f"run `{record['command']}` again, then tools/make-docs"


@pytest.mark.parametrize("name", SCRIPTS)
def test_images_are_of_this_version(name):
    record = read()
    for path in drawn(name):
        entry = record.get(path.relative_to(ROOT / "docs").as_posix(), {})
        version = str(entry.get("version")).partition(".dev")[0]
        is_same = bool(DEVELOPMENT) or entry.get("code") == package()
        assert (version, is_same) == (RELEASE, True), f"run tools/make-figures {name}"
        assert entry["file"] == hash_of(path), f"changed by hand: run tools/make-figures {name}"
