"""What `mkdocs build` needs besides docs/: pages of the repository that stand outside of it.

The studies' READMEs and results, the changelog and CONTRIBUTING stay where a reader of the repository looks for them.
This hook of mkdocs adds them to the built pages and rewrites the links between them and docs/.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
OUTSIDE = ("CHANGELOG.md", "CONTRIBUTING.md", "studies/*/*.md")
LINK = re.compile(r"\]\(([^)#:]+)(#[^)]*)?\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages outside of docs/ under their path in the repository."""
    for pattern in OUTSIDE:
        for page in sorted(ROOT.glob(pattern)):
            name = page.relative_to(ROOT).as_posix()
            files.append(File.generated(config, name, abs_src_path=str(page)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links between repository paths into links between built pages."""
    built = page.file.src_uri
    source = built if (ROOT / built).is_file() else f"docs/{built}"

    def rewritten(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), link[1]))
        relative = posixpath.relpath(target.removeprefix("docs/"), posixpath.dirname(built) or ".")
        return f"]({relative}{link[2] or ''})"

    return LINK.sub(rewritten, markdown)
