"""Hook of MkDocs: notebooks, tables of the validation and files beside docs/ become pages."""

import re
import sys
from collections.abc import Iterator
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tools")]

from notebooks import notebook_page  # noqa: E402
from validation_pages import FOLDER, appendix, site_link  # noqa: E402

#: Folder of notebooks, below docs/.
NOTEBOOKS = "notebooks"

#: Pages of the site that lie beside docs/.
BESIDE = ("CONTRIBUTING.md", "CHANGELOG.md")

#: Weights of pages in the search, by their section of the navigation: a question is answered by a
#: guide, a name by the reference. Pages without a section weigh 1.
WEIGHTS = {"First study": 3.0, "More": 3.0, "Reference": 1.5, "Explanation": 0.5}

#: Weights of other pages: tutorials, long lists, notebooks, and the tables of the validation.
LISTS = {
    "tutorial-own-data.md": 1.0,
    "tutorial-phantom.md": 1.0,
    "tutorial-consortium.md": 1.0,
    "outputs.md": 1.5,
    "CHANGELOG.md": 0.1,
    "CONTRIBUTING.md": 0.1,
    "api.md": 0.3,
    "settings-all.md": 0.5,
    NOTEBOOKS: 0.5,
    FOLDER: 0.05,
}

_LINK = re.compile(r"(?<=\]\()(?![a-z]+:|#)(?P<path>[^)#\s]+)")
#: Code in a table with a bar, which GitHub wants escaped, and MkDocs plain.
_BAR = re.compile(r"^\|.*\\\|.*$", re.MULTILINE)
_CODE = re.compile(r"`[^`\n]+`")


def on_config(config: MkDocsConfig) -> None:
    """Show pages that the navigation does not name, under its last heading."""
    text = Path(str(config.config_file_path)).read_text(encoding="utf-8")
    pages = sorted(path.name for path in Path(config.docs_dir).glob("*.md"))
    last = (config.nav or [])[-1]
    last["Explanation"] += [name for name in pages if f" {name}\n" not in text]


def on_files(files: Files, *, config: MkDocsConfig) -> None:
    """Add what pages link to beyond docs/."""
    pages = [page.content_string for page in files.documentation_pages()]
    linked = {path for text in pages for path in _beyond(text)}
    for name in sorted({*BESIDE, *linked} - {"README.md"}):
        files.append(File.generated(config, name, abs_src_path=str(ROOT / name)))
    for path in sorted((Path(config.docs_dir) / NOTEBOOKS).glob("*.ipynb")):
        text, figures = notebook_page(path)
        link = f"[This notebook as a file]({path.name}), for Jupyter.\n"
        page = f"{NOTEBOOKS}/{path.stem}.md"
        files.append(File.generated(config, page, content=f"{text}\n{link}"))
        for name, content in figures.items():
            files.append(File.generated(config, f"{NOTEBOOKS}/{name}", content=content))
    for name, page in appendix():
        files.append(File.generated(config, f"{FOLDER}/{name}", content=page))


def on_page_markdown(markdown: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links between the files of the repository into links between pages, and weigh pages."""
    del config, files
    markdown = _BAR.sub(lambda row: _CODE.sub(_without_escapes, row[0]), markdown)
    *_, section = ["", *(str(item.title) for item in page.ancestors)]
    place = page.file.src_uri.partition("/")[0]
    weight = LISTS.get(place, WEIGHTS.get(section, 1.0))
    page.meta.setdefault("search", {"boost": weight})
    if page.file.src_uri in BESIDE:
        return _LINK.sub(lambda found: found["path"].removeprefix("docs/"), markdown)
    if page.file.src_uri.startswith((f"{NOTEBOOKS}/", f"{FOLDER}/")):
        return markdown
    if page.file.src_uri.count("/"):  # a page from a folder beside docs/: its links stay there
        return _LINK.sub(r"#", markdown)
    return _LINK.sub(lambda found: _inside(found["path"]), markdown)


def _without_escapes(code: re.Match[str]) -> str:
    return code[0].replace(r"\|", "|")


def _beyond(text: str) -> Iterator[str]:
    """List the files beside docs/ that a page links to."""
    for found in _LINK.finditer(text):
        path = found["path"].removeprefix("../")
        if path != found["path"] and (ROOT / path).is_file():
            yield path


def _inside(path: str) -> str:
    if path.endswith(".ipynb"):
        return f"{path.removesuffix('.ipynb')}.md"
    if path.endswith(".tsv"):
        return site_link(path)
    return "index.md" if path == "../README.md" else path.removeprefix("../")
