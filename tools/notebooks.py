"""Runs a notebook of docs/ and writes it as a page: text, code, what the code prints, figures.

As in Jupyter, the value of a cell's last expression is shown, figures that are open at its end are
drawn, and lines that begin with ``!`` go to the shell. A warning is an error.

.venv/bin/python tools/notebooks.py docs/notebooks/NAME.ipynb ...    runs them, and shows nothing
"""

import ast
import json
import os
import re
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import chdir, redirect_stdout
from html import escape
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pandas as pd

_DPI = 90
_SHELL_LINE = re.compile(r"^!(.*)$", re.MULTILINE)


def run_notebook(path: Path) -> tuple[str, dict[str, bytes]]:
    """Run all cells in a folder of their own; return the page in Markdown, and figures by name."""
    mpl.use("agg")
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    names: dict[str, Any] = {"__name__": "__main__", "_shell": _shell}
    parts: list[str] = []
    figures: dict[str, bytes] = {}
    with tempfile.TemporaryDirectory() as folder, chdir(folder), warnings.catch_warnings():
        warnings.simplefilter("error")
        for number, cell in enumerate(cells, start=1):
            text = "".join(cell["source"])
            if cell["cell_type"] == "markdown":
                parts.append(text)
                continue
            parts.append(f"```python\n{text}\n```")
            try:
                parts += _outputs(text, names)
            except Exception as error:
                error.add_note(f"{path.name}, cell {number}")
                raise
            for content in _figures():
                figures[f"{path.stem}-{len(figures) + 1}.png"] = content
                parts.append(f"![Figure that the code above draws]({list(figures)[-1]})")
    return "\n\n".join(parts) + "\n", figures


def notebook_text(path: Path) -> str:
    """All cells as Markdown, without running them."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    texts = ("".join(cell["source"]) for cell in cells)
    shown = (
        text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```"
        for cell, text in zip(cells, texts, strict=True)
    )
    return "\n\n".join(shown) + "\n"


def _outputs(text: str, names: dict[str, Any]) -> Iterator[str]:
    """Run a cell; yield what it printed, and the value of its last expression."""
    tree = ast.parse(_SHELL_LINE.sub(lambda line: f"_shell({line[1]!r})", text))
    last = tree.body[-1] if tree.body else None
    shown = isinstance(last, ast.Expr) and not text.rstrip().endswith(";")
    value = None
    with redirect_stdout(StringIO()) as printed:
        exec(compile(ast.Module(tree.body[:-1] if shown else tree.body, []), "cell", "exec"), names)  # noqa: S102  (our own notebooks)
        if shown and isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "cell", "eval"), names)  # noqa: S307
    if printed.getvalue():
        yield _block(printed.getvalue())
    if isinstance(value, pd.DataFrame):
        table = value.to_html(border=0).replace(' class="dataframe"', "")
        yield f'<div class="output">{table}</div>'
    elif value is not None:
        yield _block(repr(value))


def _block(text: str) -> str:
    return f'<pre class="output">{escape(text.rstrip())}</pre>'


def _shell(command: str) -> None:
    """Run a line of a shell with the programs of this environment."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}"
    done = subprocess.run(  # noqa: S602  (our own notebooks)
        command,
        shell=True,
        check=False,
        capture_output=True,
        text=True,
        env=os.environ | {"PATH": path},
    )
    if done.returncode:
        raise RuntimeError(f"{command}: exit code {done.returncode}\n{done.stdout}{done.stderr}")
    sys.stdout.write(done.stdout + done.stderr)


def _figures() -> Iterator[bytes]:
    """Yield open figures as PNG, and close them."""
    from matplotlib import pyplot as plt  # noqa: PLC0415  (after the choice of the backend)

    for number in plt.get_fignums():
        content = BytesIO()
        plt.figure(number).savefig(content, format="png", dpi=_DPI, bbox_inches="tight")
        yield content.getvalue()
    plt.close("all")


if __name__ == "__main__":
    for name in sys.argv[1:]:
        run_notebook(Path(name).resolve())
        sys.stdout.write(f"{name}\n")
