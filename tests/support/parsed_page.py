"""An HTML page taken apart, for tests of reports."""

from __future__ import annotations

from html.parser import HTMLParser

# Elements that HTML allows to stay open.
_VOID = {"meta", "img", "link", "br", "hr"}
_REFERENCES = ("src", "href", "action", "data", "poster")


class ParsedPage(HTMLParser):
    """Elements, ids and references of a page; fails where elements do not nest.

    Attributes:
        open_tags: elements that are not closed at the end.
        tags: of all elements, in order.
        ids: in order.
        references: values of all attributes that may load something.
    """

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open_tags: list[str] = []
        self.tags: list[str] = []
        self.ids: list[str] = []
        self.references: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note an element that opens."""
        self.handle_startendtag(tag, attrs)
        if tag not in _VOID:
            self.open_tags.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note an element and its attributes."""
        self.tags.append(tag)
        self.ids += [value or "" for name, value in attrs if name == "id"]
        self.references += [value or "" for name, value in attrs if name in _REFERENCES]

    def handle_endtag(self, tag: str) -> None:
        """Check that the element that opened last closes first."""
        assert self.open_tags.pop() == tag
