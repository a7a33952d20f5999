"""Figures on a page of their own: one HTML file that needs nothing else."""

from __future__ import annotations

from functools import cache
from html import escape
from importlib import resources
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from plotly.graph_objects import Figure


@cache
def plotly_source() -> str:
    """Return the plot library as its package ships it."""
    return (resources.files("plotly") / "package_data" / "plotly.min.js").read_text(encoding="utf-8")


def script_json(text: str) -> str:
    """Return JSON that is safe inside a script element."""
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def figure_page(title: str, figures: Mapping[str, Figure]) -> str:
    """Return one HTML page with ``figures``, each under its name."""
    parts = [
        f"<h2>{escape(name)}</h2>\n<div></div>\n"
        f'<script type="application/json" class="figure">{script_json(str(figure.to_json()))}</script>'
        for name, figure in figures.items()
    ]
    return _PAGE.format(title=escape(title), figures="\n".join(parts), plotly=plotly_source())


_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
body {{ font: 15px/1.5 system-ui, "DejaVu Sans", sans-serif; color: #1b1f24; }}
body {{ max-width: 960px; margin: 24px auto; padding: 0 16px; }}
h1 {{ font-size: 22px; }}
h2 {{ font-size: 16px; margin: 28px 0 4px; }}
</style>
</head>
<body>
<main>
<h1>{title}</h1>
{figures}
</main>
<script>{plotly}</script>
<script>
for (const source of document.querySelectorAll("script.figure")) {{
  const figure = JSON.parse(source.textContent);
  Plotly.newPlot(source.previousElementSibling, figure.data, figure.layout, {{ displaylogo: false, responsive: true }});
}}
</script>
</body>
</html>
"""
