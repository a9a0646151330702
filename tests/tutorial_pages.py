"""What the pages of tutorials show: their commands, and what these print.

The whole of the tutorials takes minutes: ``tools/test-tutorials`` runs it, which sets
HIPSTA_BIDS_TUTORIALS.
"""

import os
import re
import shlex

import pytest

whole = pytest.mark.skipif(
    os.environ.get("HIPSTA_BIDS_TUTORIALS") != "required", reason="run tools/test-tutorials"
)


def blocks(page):
    """Contents of the fenced blocks, also of those in tabs."""
    found = re.findall(r"^( *)```\n(.*?)^ *```$", page, re.MULTILINE | re.DOTALL)
    return [re.sub(f"^{indent}", "", text, flags=re.MULTILINE) for indent, text in found]


def commands(page):
    """List command lines with the block that follows each: what it prints, if it is no command."""
    every = blocks(page)
    for text, following in zip(every, [*every[1:], ""], strict=True):
        if text.startswith("hipsta-bids"):
            printed = "" if following.startswith("hipsta-bids") else following
            yield shlex.split(text.replace("\\\n", " "))[1:], printed


def plain(text):
    """One blank between words, and no seconds: those are the machine's."""
    return " ".join(re.sub(r"\d+\.\d s\b", "", text).split())


def check_printed(shown, printed):
    """Each line that a page shows is the beginning of a line that was printed."""
    lines = [plain(line) for line in printed.splitlines()]
    for line in shown.splitlines():
        if line.strip() not in {"...", ""}:
            assert any(one.startswith(plain(line)) for one in lines), line
