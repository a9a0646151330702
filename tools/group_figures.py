"""Draw the figures of the group level in docs/: of a tutorial, of groups that lie apart, of sites.

.venv/bin/python tools/group_figures.py

Measures some 250 participants, which takes many minutes.
"""

import re
import tempfile
from pathlib import Path

from checks import hipsta
from page_figures import COHORT
from PIL import Image

DOCS = Path(__file__).resolve().parents[1] / "docs"
IMAGES = DOCS / "images"
SITES = re.compile(r"^\| (\w+) \| ([\d.]+) \| (\d) \|$", re.MULTILINE)
FOREST = re.compile(r'<svg (viewBox="0 0 (\d+) (\d+)" role="img" aria-label="Thickness, left)')
DPI = 120  # 850 pixels of a page's width


def measure(data: Path, *options: object) -> Path:
    """Write a synthetic dataset and measure it; return the output folder."""
    hipsta("phantom", data, *options)
    out = data.with_name(f"{data.name}-out")
    hipsta(data, out, "participant", "--no-reports")
    return out


def draw_comparison(work: Path) -> None:
    """Draw the comparison of the first tutorial."""
    out = measure(work / "cohort", *COHORT)
    hipsta(work / "cohort", out, "group", "--figures")
    hipsta("figure", "group", out, "-o", IMAGES / "group-figure.png", "--dpi", 150)
    hipsta("figure", "roc", out, "-o", IMAGES / "group-roc.png", "--dpi", DPI)
    picture = Image.open(min(out.glob("group/*/figures/*sections*.png"))).convert("RGB")
    picture.thumbnail((850, 850))
    picture.save(IMAGES / "group-sections.png", optimize=True)


def draw_registration(work: Path) -> None:
    """Draw the registration of two groups whose sheets lie apart."""
    out = measure(work / "shifted", "--n-subjects", 24, "--shift", "0.1", "--seed", 1)
    hipsta(work / "shifted", out, "group")
    hipsta("figure", "registration", out, "-o", IMAGES / "group-registration.png", "--dpi", DPI)


def draw_forest(work: Path) -> None:
    """Draw the first forest plot of the tutorial of several sites, as its page shows it."""
    text = (DOCS / "tutorial-consortium.md").read_text("utf-8")
    outs = {}
    for site, thickness, seed in SITES.findall(text):
        cohort = ("--n-subjects", 40, "--thinning", "0.12")
        own = ("--site", site, "--thickness", thickness, "--seed", seed)
        outs[site] = measure(work / site.lower(), *cohort, *own)
    group = ("group", "--no-classification", "--measures", "thickness")
    template = outs["Berlin"] / "group" / "template" / "template.json"
    hipsta(work / "berlin", outs["Berlin"], *group, "--name", "template")
    for site, out in outs.items():
        summary = ("--export-summary", site, "--name", "summary", "--template", template)
        hipsta(work / site.lower(), out, *group, "thickness_mean_CA1", *summary)
    folders = [out / "group" / "summary" for out in outs.values()]
    hipsta("meta", *folders, work / "consortium")
    page = (work / "consortium" / "meta.html").read_text("utf-8")
    start = FOREST.search(page)
    if start is None:
        raise ValueError("no forest plot of thickness on the page")
    body = page[start.end() : page.index("</svg>", start.end())]
    picture = IMAGES / "consortium-forest.svg"
    style = re.search(r"<style>.*?</style>", picture.read_text("utf-8"), re.DOTALL)
    if style is None:
        raise ValueError(f"{picture} has no style, which its next version takes over")
    tag, _, rest = body.partition(">")
    namespace = f'xmlns="http://www.w3.org/2000/svg" width="{start[2]}" height="{start[3]}"'
    picture.write_text(
        f"<svg {namespace} {start[1]}{tag}>\n{style[0]}{rest}</svg>\n", encoding="utf-8"
    )


def main() -> None:
    """Draw all in a folder that is removed."""
    for draw in (draw_comparison, draw_registration, draw_forest):
        with tempfile.TemporaryDirectory() as name:
            draw(Path(name))


if __name__ == "__main__":
    main()
