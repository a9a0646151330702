"""Every page and figure of every command, and what a missing template costs."""

import pytest
from every_page import COMMANDS, GROUP, check_pages, words, write_inputs
from extension_marks import needs
from jinja2 import PackageLoader, TemplateNotFound

from hipsta_bids.cli.main import main
from hipsta_bids.errors import ExitCode
from hipsta_bids.reports import page


@pytest.fixture(scope="module", autouse=True)
def without_pages():
    """Let runs make pages here."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("every page")
    write_inputs(path)
    return path


@pytest.mark.parametrize("case", COMMANDS, ids=[command for command, *_ in COMMANDS])
def test_every_page_is_made(folder, monkeypatch, capsys, case):
    """In this order: later commands read what earlier ones write."""
    command, code, made = case
    monkeypatch.chdir(folder)
    ended = main(words(command))
    said = "".join(capsys.readouterr())
    assert ended == code, said
    check_pages(folder, said, made)


@pytest.fixture
def lose(monkeypatch):
    """Take a template out of the package."""

    def take(name):
        read = PackageLoader.get_source

        def without(self, environment, template):
            if template == name:
                raise TemplateNotFound(template)
            return read(self, environment, template)

        monkeypatch.setattr(PackageLoader, "get_source", without)
        monkeypatch.setattr(page, "_environment", page._environment.__wrapped__)  # none is kept

    return take


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(
            ("labels labels/shared", "participant.html", "labels/shared/measures.tsv"),
            marks=needs("visits"),
        ),
        pytest.param(
            ("labels labels/shared", "cohort.html", "labels/shared/measures.tsv"),
            marks=needs("visits"),
        ),
        (f"{GROUP} --name a", "group/model.html", "cohort/out/group/a/peaks.tsv"),
        pytest.param(("meta ", "meta/sites.html", "meta/meta/sites.tsv"), marks=needs("consortia")),
        pytest.param(
            ("compare ", "comparison/found.html", "compared/agreement.tsv"),
            marks=needs("agreement"),
        ),
    ],
)
def test_a_page_that_cannot_be_made_is_told_by_the_exit_code(
    folder, monkeypatch, capsys, lose, case
):
    start, template, results = case
    command = next(command for command, *_ in COMMANDS if command.startswith(start))
    monkeypatch.chdir(folder)
    for path in (*folder.glob("labels/shared/*.html"), folder / results):
        path.unlink()
    lose(template)
    assert main(words(command)) == ExitCode.INTERNAL
    assert template in capsys.readouterr().err
    assert (folder / results).exists()
