"""The tags of a page, for tests that ask whether it is whole."""

import re
from html.parser import HTMLParser


class Outline(HTMLParser):
    """Collects what tests ask of a page."""

    VOID = frozenset({"meta", "link", "img", "input", "br", "path", "circle", "image"})

    def __init__(self, text):
        super().__init__()
        self.tags, self.ids, self.addresses, self.headings, self.open = [], [], [], [], []
        self.unlabeled = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self.tags.append(tag)
        self.ids += [given["id"]] if "id" in given else []
        self.addresses += [v for k, v in attributes if k in {"src", "href", "data", "action"}]
        if re.fullmatch("h[1-6]", tag):
            self.headings.append(int(tag[1]))
        missing = {"img": "alt", "svg": "aria-label", "canvas": "aria-label"}.get(tag)
        if missing and not given.get(missing):
            self.unlabeled.append(tag)
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self.open.pop() == tag
