"""An HTML page as a PDF, printed by an installed Chromium or Chrome."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from datasets_manifest.atomic import write_bytes_atomic

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
NO_BROWSER = (
    f"none of {', '.join(BROWSERS)} is on the search path; install one (apt-get install chromium), "
    "or print the page from any browser"
)
TIMEOUT_S = 120.0


def find_browser() -> str | None:
    """Path of the first browser that is installed."""
    return next((path for path in map(shutil.which, BROWSERS) if path is not None), None)


def print_pdf(page: str, out: Path, timeout_s: float = TIMEOUT_S) -> None:
    """Print a page as its style sheet wants it on paper; it is replaced as a whole, or not at all.

    Args:
        page: HTML.
        out: file to write.
        timeout_s: after which the browser is killed. [s]

    Raises:
        ValueError: there is no browser, or it did not print.
        OSError: the PDF cannot be written.
    """
    browser = find_browser()
    if browser is None:
        raise ValueError(f"{out}: a PDF needs Chromium or Chrome, and {NO_BROWSER}")
    # The folder is beside the PDF and not hidden: a sandboxed browser, as from snap, has another /tmp and sees no
    # hidden folders.
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="droguekit-print-", dir=out.parent, ignore_cleanup_errors=True) as name:
        folder = Path(name).resolve()
        source, printed = folder / "page.html", folder / "page.pdf"
        source.write_text(page, encoding="utf-8")
        told = _run(_command(browser, source, printed, folder / "profile"), timeout_s, out)
        if not printed.is_file() or not printed.read_bytes().startswith(b"%PDF-"):
            last = told.strip().splitlines()[-1:] or ["no message"]
            raise ValueError(f"{out}: {browser} printed nothing: {last[0]}")
        write_bytes_atomic(out, printed.read_bytes())


def _command(browser: str, page: Path, printed: Path, profile: Path) -> list[str]:
    # The browser does not start with its sandbox as root, as in a container. The page is our own and has no script.
    sandbox = ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
    return [
        *(browser, "--headless", *sandbox, "--disable-gpu", "--disable-dev-shm-usage", "--disable-extensions"),
        *("--no-first-run", "--disable-background-networking", "--host-resolver-rules=MAP * ~NOTFOUND"),
        *(f"--user-data-dir={profile}", "--no-pdf-header-footer", f"--print-to-pdf={printed}"),
        page.as_uri(),
    ]


def _run(command: Sequence[str], timeout_s: float, out: Path) -> str:
    """Run the browser and return its error stream."""
    # In a process group of its own, so that its child processes can be killed with it.
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True
    ) as process:
        try:
            _, told = process.communicate(timeout=timeout_s)
        except BaseException as error:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            if isinstance(error, subprocess.TimeoutExpired):
                raise ValueError(f"{out}: {command[0]} did not print within {timeout_s:g} s") from error
            raise
    return told.decode(errors="replace")
