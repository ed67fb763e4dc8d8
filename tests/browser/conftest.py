"""A real browser for the pages that we write: `open_page` opens one, and what comes back says what is wrong with it.

All tests of pages live in this folder. The browser is kept for one module of tests only, for while it runs no test of
the same process could start an event loop of its own.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import pytest
from playwright.sync_api import Browser, ConsoleMessage, Page, Request, sync_playwright

from droguekit.visualization.print_pdf import NO_BROWSER, find_browser
from tests.support.browsed_dataset import BrowsedDataset, browse_dataset, open_browsed
from tests.support.shared_folder import shared_folder

PHONE_PX = 360
DESKTOP_PX = 1280

# A4 less margins of 12 mm at 96 px an inch: how wide a page is when it is printed.
PRINT_PX = 703

# On a machine that is busy with other things a browser takes long to start and to answer; nothing is measured by this.
PATIENCE_MS = 180_000

# Least contrast of text, of large text (24 px, or bold from 18.66 px) and of lines: WCAG 2.1, 1.4.3 and 1.4.11.
TEXT_CONTRAST = 4.5
LARGE_TEXT_CONTRAST = 3.0
LINE_CONTRAST = 3.0

# Colours of everything that is read, each over what lies behind it. Backgrounds are blended from the page upwards.
_CONTRASTS = """
(selector) => {
  const parse = (text) => {
    const found = text.match(/rgba?\\(([^)]+)\\)/);
    if (!found) return null;
    const [r, g, b, a] = found[1].split(/[ ,/]+/).map(Number);
    return { rgb: [r, g, b], a: a === undefined || Number.isNaN(a) ? 1 : a };
  };
  const over = (top, below) => top.rgb.map((v, k) => v * top.a + below[k] * (1 - top.a));
  const chain = (element) => element ? [...chain(element.parentElement), element] : [];
  const background = (element) => chain(element).reduce((below, e) => {
    const color = parse(getComputedStyle(e).backgroundColor);
    return color ? over(color, below) : below;
  }, matchMedia("(prefers-color-scheme: dark)").matches ? [18, 18, 18] : [255, 255, 255]);
  const opacity = (element) => chain(element).reduce((a, e) => a * Number(getComputedStyle(e).opacity), 1);
  const luminance = (rgb) => rgb.map((v) => v / 255)
    .map((v) => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    .reduce((sum, v, k) => sum + v * [0.2126, 0.7152, 0.0722][k], 0);
  const ratio = (a, b) => {
    const [low, high] = [luminance(a), luminance(b)].sort((p, q) => p - q);
    return (high + 0.05) / (low + 0.05);
  };
  const measured = [];
  for (const element of document.querySelectorAll(selector)) {
    const own = [...element.childNodes].filter((n) => n.nodeType === 3)
      .map((n) => n.textContent.trim()).filter((text) => text).join(" ");
    const box = element.getBoundingClientRect();
    if (!own || box.width === 0 || box.height === 0) continue;
    const style = getComputedStyle(element);
    if (style.visibility !== "visible") continue;
    const color = parse(element instanceof SVGElement ? style.fill : style.color);
    if (!color) continue;
    color.a *= opacity(element);
    const behind = background(element);
    measured.push({
      text: own.slice(0, 80), ratio: ratio(over(color, behind), behind),
      size_px: parseFloat(style.fontSize), bold: Number(style.fontWeight) >= 700,
    });
  }
  return measured;
}
"""

_FIGURES = """
() => [...document.querySelectorAll("svg[role=img]")].map((svg) => {
  const box = svg.getBoundingClientRect();
  const sizes = [...svg.querySelectorAll("path, use, circle, image")].map((shape) => shape.getBBox());
  const texts = [...svg.querySelectorAll("text")].map((text) => text.getBoundingClientRect());
  return {
    label: svg.getAttribute("aria-label"), width_px: box.width, height_px: box.height,
    shapes: sizes.filter((size) => size.width > 0 || size.height > 0).length,
    least_text_px: Math.min(...[...svg.querySelectorAll("text")].map((text) => {
      const matrix = text.getScreenCTM();
      return parseFloat(getComputedStyle(text).fontSize) * Math.hypot(matrix.c, matrix.d);
    })),
    text_outside_px: Math.max(0, ...texts.map((text) => Math.max(box.left - text.left, text.right - box.right))),
    text_overlaps: [...svg.querySelectorAll("text")].flatMap((text, k, all) => all.slice(k + 1)
      .filter((_, m) => {
        const [a, b] = [texts[k], texts[k + 1 + m]];
        return Math.min(a.right, b.right) - Math.max(a.left, b.left) > 1
          && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 1;
      })
      .map((other) => `${text.textContent.trim()} / ${other.textContent.trim()}`)),
  };
})
"""

# What sticks out to the right of the page and cannot be scrolled to inside a box of its own.
_OVERFLOW = """
() => {
  const width = document.documentElement.clientWidth;
  const found = [];
  for (const element of document.body.querySelectorAll("*")) {
    const box = element.getBoundingClientRect();
    if (box.width === 0 || box.right <= width + 0.5) continue;
    let up = element.parentElement, held = false;
    for (; up && up !== document.body; up = up.parentElement)
      held = held || (getComputedStyle(up).overflowX !== "visible" && up.getBoundingClientRect().right <= width + 0.5);
    if (!held) found.push(`${element.tagName.toLowerCase()}#${element.id}: ${box.right - width} px`);
  }
  if (document.documentElement.scrollWidth > width) found.push(`page: ${document.documentElement.scrollWidth} px`);
  return found;
}
"""


class TextContrast(NamedTuple):
    """The contrast of a piece of text with its background by WCAG."""

    text: str
    ratio: float
    size_px: float
    bold: bool

    @property
    def is_enough(self) -> bool:
        """Whether the text can be read by level AA."""
        is_large = self.size_px >= (18.66 if self.bold else 24.0)
        return self.ratio >= (LARGE_TEXT_CONTRAST if is_large else TEXT_CONTRAST)


class DrawnFigure(NamedTuple):
    """An `<svg role="img">` as it stands on the page.

    Attributes:
        label: its `aria-label`.
        shapes: paths and the like that have an extent.
        least_text_px: size of its smallest letters, infinite without any. [px]
        text_outside_px: how far its texts reach over its sides. [px]
        text_overlaps: pairs of texts whose boxes share more than a pixel both ways.
    """

    label: str
    width_px: float
    height_px: float
    shapes: int
    least_text_px: float
    text_outside_px: float
    text_overlaps: list[str]


class PrintedPage(NamedTuple):
    """A page of a PDF. [pt]"""

    width_pt: float
    height_pt: float


@dataclass
class OpenedPage:
    """A page in the browser.

    Attributes:
        page: playwright's, for whatever else a test wants to do.
        faults: messages of the console that are no mere information, uncaught errors, failed requests.
        requests: addresses of everything that was asked for besides the page itself and `data:` in it.
    """

    page: Page
    faults: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def requests_outside(self, folder: Path) -> list[str]:
        """Requests for anything that is not a file in a folder."""
        return [url for url in self.requests if not url.startswith(folder.resolve().as_uri() + "/")]

    def figures(self) -> list[DrawnFigure]:
        """Every figure, in the order of the page."""
        return [
            DrawnFigure(**{**found, "least_text_px": found["least_text_px"] or float("inf")})
            for found in self.page.evaluate(_FIGURES)
        ]

    def contrasts(self, selector: str = "body *") -> list[TextContrast]:
        """Of every visible element with text of its own."""
        return [TextContrast(**found) for found in self.page.evaluate(_CONTRASTS, selector)]

    def overflows(self) -> list[str]:
        """What sticks out to the right of the page."""
        found: list[str] = self.page.evaluate(_OVERFLOW)
        return found

    def resize(self, width_px: int, media: Literal["screen", "print"] = "screen") -> None:
        """Set the page's width, or the style that it has on paper."""
        self.page.emulate_media(media=media)
        self.page.set_viewport_size({"width": width_px, "height": 800})

    def print_pdf(self, path: Path) -> list[PrintedPage]:
        """Print the page as its own style sheet wants it."""
        self.page.pdf(path=path, prefer_css_page_size=True, print_background=True)
        return pdf_pages(path)


OpenPage = Callable[..., OpenedPage]


def pdf_pages(path: Path) -> list[PrintedPage]:
    """The pages of a PDF whose page objects are not compressed, as Chromium writes them."""
    data = path.read_bytes()
    assert data.startswith(b"%PDF-") and data.rstrip().endswith(b"%%EOF")
    boxes = [
        re.search(rb"/MediaBox\s*\[\s*[\d.]+\s+[\d.]+\s+([\d.]+)\s+([\d.]+)\s*\]", body)
        for body in re.findall(rb"<<(?:(?!endobj).)*?/Type\s*/Page\b(?:(?!endobj).)*endobj", data, re.DOTALL)
    ]
    return [PrintedPage(float(box[1]), float(box[2])) for box in boxes if box is not None]


@pytest.fixture(scope="session")
def chromium_path() -> str:
    """The installed browser."""
    found = find_browser()
    if found is None:
        pytest.skip(NO_BROWSER)
    return found


@pytest.fixture(scope="module")
def browser(chromium_path: str) -> Iterator[Browser]:
    """A browser without a window and without a way out of this machine."""
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(
            executable_path=chromium_path,
            args=["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"],
            timeout=PATIENCE_MS,
        )
        yield running
        running.close()


@pytest.fixture
def open_page(browser: Browser) -> Iterator[OpenPage]:
    """`open_page(path, width_px=..., scheme="light" or "dark")`: an `OpenedPage` of an HTML file."""
    contexts: list[Any] = []

    def opened(path: Path, width_px: int = DESKTOP_PX, scheme: Literal["light", "dark"] = "light") -> OpenedPage:
        context = browser.new_context(
            viewport={"width": width_px, "height": 800}, color_scheme=scheme, reduced_motion="reduce", offline=True
        )
        contexts.append(context)
        context.set_default_timeout(PATIENCE_MS)
        page, url = context.new_page(), path.resolve().as_uri()
        result = OpenedPage(page)

        def note_message(message: ConsoleMessage) -> None:
            if message.type in ("error", "warning", "assert"):
                result.faults.append(f"console {message.type}: {message.text}")

        def note_request(request: Request) -> None:
            if request.url.split("#")[0] != url and not request.url.startswith(("data:", "blob:")):
                result.requests.append(request.url)

        page.on("console", note_message)
        page.on("request", note_request)
        page.on("pageerror", lambda error: result.faults.append(f"uncaught: {error}"))
        page.on("requestfailed", lambda request: result.faults.append(f"failed: {request.url[:200]}"))
        page.goto(url, wait_until="load")
        return result

    yield opened
    for context in contexts:
        context.close()


@pytest.fixture(scope="session")
def browsed(tmp_path_factory: pytest.TempPathFactory) -> BrowsedDataset:
    """Twelve pairs with estimates of several methods, and their page; to be read only (copy it to damage it)."""
    name = "<b>&amp; 'page\" #1%20"
    shared = shared_folder(tmp_path_factory, "browsed", lambda folder: browse_dataset(folder / name))
    return open_browsed(shared / name)
