"""What `mkdocs build` needs besides the pages of docs/: those that stand outside of it, and the examples as pages.

The studies' READMEs, results, the changelog and CONTRIBUTING stay where a reader of the repository looks for them.
This hook of mkdocs adds them to the built pages, makes a page of every script and notebook of docs/examples, and
rewrites the links between all of them.
"""

from __future__ import annotations

import json
import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
OUTSIDE = ("CHANGELOG.md", "CONTRIBUTING.md", "studies/*/*.md", "tests/fuzz/RESULTS.md")
EXAMPLES = "examples"
# Lines of code are wider than a page between two columns.
WIDE = "---\nhide: [toc]\n---\n\n"
LINK = re.compile(r"\]\(([^)#:]+)(#[^)]*)?\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages outside of docs/ under their path in the repository, and pages of the examples."""
    for pattern in OUTSIDE:
        for page in sorted(ROOT.glob(pattern)):
            name = page.relative_to(ROOT).as_posix()
            files.append(File.generated(config, name, abs_src_path=str(page)))
    for example in sorted((ROOT / "docs" / EXAMPLES).iterdir()):
        if example.suffix in (".py", ".ipynb"):
            name, text = f"{EXAMPLES}/{example.name}.md", example.read_text(encoding="utf-8")
            content = (
                _script_page(example.name, text) if example.suffix == ".py" else _notebook_page(example.name, text)
            )
            files.append(File.generated(config, name, content=WIDE + content))
    return files


def _script_page(name: str, text: str) -> str:
    """A script, which begins with its own description."""
    return f"# {name}\n\n{_block(text)}\n\n{_download(name)}"


def _notebook_page(name: str, text: str) -> str:
    """The cells of a notebook, which is kept without outputs."""
    parts = []
    for cell in json.loads(text)["cells"]:
        source = "".join(cell["source"])
        parts.append(_block(source) if cell["cell_type"] == "code" else source)
    return "\n\n".join([*parts, _download(name)])


def _block(code: str) -> str:
    return f"```python\n{code.strip()}\n```"


def _download(name: str) -> str:
    return f"[Download {name}]({name})\n"


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links between repository paths into links between built pages."""
    built = page.file.src_uri
    source = built if (ROOT / built).is_file() else f"docs/{built}"

    def rewritten(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), link[1])).removeprefix("docs/")
        # An example has a page; only that page leads to the file itself.
        if f"{target}.md" != built and files.get_file_from_path(f"{target}.md") is not None:
            target += ".md"
        relative = posixpath.relpath(target, posixpath.dirname(built) or ".")
        return f"]({relative}{link[2] or ''})"

    return LINK.sub(rewritten, markdown)
