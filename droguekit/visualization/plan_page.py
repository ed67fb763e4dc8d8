"""A plan as one HTML page that needs nothing from outside."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path

from jinja2 import Environment, StrictUndefined

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.recipe.recipe import Recipe
from droguekit.batch.planning.recipe_plan import Plan
from droguekit.visualization.plan_figures import plan_figures

_TEMPLATE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>What {{ name }} will make</title>
<style>
body { margin: 0 auto; padding: 1.5rem; max-width: 80rem; background: #fff; color: #1c2026;
  font: 16px/1.5 system-ui, "DejaVu Sans", sans-serif; }
h1 { font-size: 1.6rem; margin: 0; }
h2 { font-size: 1.2rem; margin: 2rem 0 0.5rem; }
.panels { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 28rem), 1fr)); gap: 1.2rem; }
figure { margin: 0; }
figure img { display: block; width: 100%; height: auto; }
figcaption { color: #5b6470; font-size: 0.88rem; }
pre { overflow-x: auto; background: #f4f6f8; padding: 0.8rem; font-size: 0.82rem; line-height: 1.35; }
</style>
</head>
<body>
<h1>What {{ name }} will make</h1>
<p>{{ description }}</p>
<div class="panels">
{% for figure in figures %}
<figure><img alt="{{ figure.title }}" src="data:image/png;base64,{{ figure.data }}">
<figcaption>{{ figure.caption }}</figcaption></figure>
{% endfor %}
</div>
<h2>In numbers</h2>
<pre>{{ lines }}</pre>
</body>
</html>
"""


def write_plan_page(recipe: Recipe, planned: Plan, lines: Sequence[str], out: Path) -> None:
    """Write the page; it is replaced as a whole, or not at all.

    Args:
        recipe: that is planned.
        planned: what it will make.
        lines: what the command said.
        out: where to write.

    Raises:
        OSError: it cannot be written.
    """
    figures = [
        {"title": figure.title, "caption": figure.caption, "data": base64.b64encode(figure.png).decode("ascii")}
        for figure in plan_figures(recipe, planned)
    ]
    template = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True).from_string(_TEMPLATE)
    page = template.render(
        name=recipe.name, description=recipe.description, figures=figures, lines="\n".join(lines) + "\n"
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    write_text_atomic(out, page)
