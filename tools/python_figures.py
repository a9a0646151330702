"""Draw the figures of docs/python.md by its own code.

.venv/bin/python tools/python_figures.py
"""

import re
import tempfile
from contextlib import chdir
from pathlib import Path
from typing import Any

import matplotlib as mpl

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "python.md"


def blocks() -> list[str]:
    """List the blocks of code of the page."""
    return re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)


def main() -> None:
    """Run the blocks in a folder that is removed, and save what they draw."""
    mpl.use("agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415  (after the choice above)

    names: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        for code in blocks():
            exec(code, names)  # noqa: S102  (our own page)
    for number, name in zip(plt.get_fignums(), ("measure", None, "group"), strict=True):
        if name is not None:
            plt.figure(number).savefig(ROOT / f"docs/images/python-{name}.png", dpi=80)


if __name__ == "__main__":
    main()
