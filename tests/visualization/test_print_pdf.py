"""Printing by a browser: none, one that fails, one that hangs, and a real one."""

from __future__ import annotations

import os
import re
import select
import stat
from pathlib import Path

import pytest

from droguekit.visualization.print_pdf import find_browser, print_pdf

PAGE = '<!DOCTYPE html><html lang="en"><title>t</title><style>@page { size: A4 }</style><p>one page</p></html>'


@pytest.fixture
def fake_browser(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A program of the browser's name, alone on the search path beside the shell's."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}/usr/bin{os.pathsep}/bin")
    program = folder / "chromium"
    program.write_text("#!/bin/sh\n", encoding="utf-8")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    return program


def test_without_a_browser_one_line_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert find_browser() is None
    with pytest.raises(ValueError, match=r"out\.pdf: a PDF needs Chromium or Chrome.*install one") as caught:
        print_pdf(PAGE, tmp_path / "out.pdf")
    assert "\n" not in str(caught.value)


def test_what_the_browser_says_is_told(tmp_path: Path, fake_browser: Path) -> None:
    fake_browser.write_text("#!/bin/sh\necho first >&2\necho cannot open display >&2\nexit 1\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"printed nothing: cannot open display$"):
        print_pdf(PAGE, tmp_path / "out.pdf")
    assert not (tmp_path / "out.pdf").exists()


def test_what_is_no_pdf_is_not_kept(tmp_path: Path, fake_browser: Path) -> None:
    fake_browser.write_text(
        '#!/bin/sh\nfor a; do case $a in --print-to-pdf=*) echo oops > "${a#--print-to-pdf=}";; esac; done\n',
        encoding="utf-8",
    )
    (tmp_path / "out.pdf").write_text("from before", encoding="utf-8")
    with pytest.raises(ValueError, match="printed nothing: no message"):
        print_pdf(PAGE, tmp_path / "out.pdf")
    assert (tmp_path / "out.pdf").read_text(encoding="utf-8") == "from before"


def test_a_browser_that_hangs_is_ended_with_its_children(tmp_path: Path, fake_browser: Path) -> None:
    note = tmp_path / "child"
    fake_browser.write_text(
        f'#!/bin/sh\nsleep 1000 &\necho $! > "{note}.part" && mv "{note}.part" "{note}"\nwait\n', encoding="utf-8"
    )
    # On a busy machine it may take longer than that until the child is there to be ended.
    for timeout_s in (2.0, 30.0):
        with pytest.raises(ValueError, match=f"did not print within {timeout_s:g} s"):
            print_pdf(PAGE, tmp_path / "out.pdf", timeout_s=timeout_s)
        if note.exists():
            break
    assert _ends(int(note.read_text(encoding="utf-8")))
    assert [path.name for path in tmp_path.glob("droguekit-print-*")] == []


def _ends(process: int) -> bool:
    """Whether a process is gone, or goes within half a minute; one that nobody has fetched yet counts as gone."""
    try:
        descriptor = os.pidfd_open(process)
    except ProcessLookupError:
        return True
    try:
        ready, _, _ = select.select([descriptor], [], [], 30)
        return bool(ready)
    finally:
        os.close(descriptor)


@pytest.mark.skipif(find_browser() is None, reason="no chromium on the search path: apt-get install chromium")
def test_a_page_becomes_a_pdf(tmp_path: Path) -> None:
    out = tmp_path / "new & other" / "out.pdf"
    print_pdf(PAGE, out)
    assert list(out.parent.iterdir()) == [out]
    data = out.read_bytes()
    assert data.startswith(b"%PDF-")
    assert re.search(rb"/Count\s+1\b", data)
