"""A self-contained HTML page: its frame and style, sections, tables and embedded figures."""

import base64
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

MEDIA_TYPES = {".png": "image/png", ".svg": "image/svg+xml"}
STYLE = """
:root { color-scheme: light; }
body { margin: 0 auto; padding: 1rem 1.2rem 3rem; max-width: 70rem; background: #fff; color: #1b1b1b;
  font: 1rem/1.5 system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
h1 { font-size: 1.7rem; line-height: 1.25; margin: 0.6rem 0; }
h2 { font-size: 1.3rem; margin: 2.4rem 0 0.6rem; border-bottom: 2px solid #0072b2; }
h3 { font-size: 1.05rem; margin: 1.4rem 0 0.4rem; }
p, figcaption, li { max-width: 48rem; }
a { color: #005a8c; }
nav a { display: inline-block; margin-right: 1rem; }
.lead { font-size: 1.15rem; font-weight: 600; }
.missing { border-left: 4px solid #e69f00; padding-left: 0.7rem; }
.scroll { overflow-x: auto; margin: 0.8rem 0; }
table { border-collapse: separate; border-spacing: 0; font-size: 0.9rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; font-weight: 600; padding-bottom: 0.3rem; }
th, td { padding: 0.25rem 0.7rem; border-bottom: 1px solid #d8d8d8; text-align: right; white-space: nowrap;
  vertical-align: top; }
th:first-child { text-align: left; position: sticky; left: 0; background: #fff; }
thead th { border-bottom: 1px solid #444; }
thead th[colspan] { text-align: center; }
td small { display: block; color: #555; }
code { font-size: 0.88em; background: #f3f3f3; padding: 0 0.2em; overflow-wrap: anywhere; }
pre { background: #f3f3f3; padding: 0.7rem; white-space: pre-wrap; }
pre code { padding: 0; }
figure { margin: 1rem 0; break-inside: avoid; }
figure img { max-width: 100%; height: auto; display: block; }
figcaption { font-size: 0.9rem; color: #333; margin-top: 0.3rem; }
.grid { display: grid; gap: 0.5rem 1.2rem; grid-template-columns: repeat(auto-fit, minmax(min(20rem, 100%), 1fr)); }
.grid figure { margin: 0.3rem 0; }
@media (max-width: 48rem) {
  body { padding: 0.6rem 0.7rem 2rem; }
  .scroll img { max-width: none; width: 46rem; }
}
@media print {
  body { max-width: none; font-size: 9pt; padding: 0; }
  .scroll { overflow: visible; }
  table { font-size: 7.5pt; break-inside: avoid; }
  nav { display: none; }
}
"""


def page(title: str, body: str, style: str = STYLE) -> str:
    """A whole document."""
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>{style}</style>
</head>
<body>
<h1>{escape(title)}</h1>
{body}
</body>
</html>
"""


def section(name: str, title: str, *parts: str) -> str:
    """A section that `#name` leads to."""
    return "\n".join((f'<section id="{name}">', f"<h2>{escape(title)}</h2>", *parts, "</section>"))


def paragraph(text: str) -> str:
    """Plain text."""
    return f"<p>{escape(text)}</p>"


def missing(text: str) -> str:
    """What the report cannot show, and why."""
    return f'<p class="missing">{escape(text)}</p>'


def table(
    caption: str,
    columns: Sequence[str],
    rows: Iterable[Sequence[str]],
    groups: Sequence[tuple[str, int]] = (),
) -> str:
    """A table whose first column names the rows; other cells are HTML.

    Args:
        groups: headings over so many columns each, after the first one.
    """
    heads = [f'<th scope="col">{escape(column)}</th>' for column in columns]
    above = "".join(f'<th scope="colgroup" colspan="{span}">{escape(label)}</th>' for label, span in groups)
    lines = [
        f'<div class="scroll" role="region" tabindex="0" aria-label="{escape(caption)}">',
        f"<table><caption>{escape(caption)}</caption>",
        "<thead>",
        f"<tr><td></td>{above}</tr>" if groups else "",
        f"<tr>{''.join(heads)}</tr>",
        "</thead>",
        "<tbody>",
    ]
    for label, *cells in rows:
        lines.append(
            f'<tr><th scope="row">{escape(label)}</th>{"".join(f"<td>{cell}</td>" for cell in cells)}</tr>'
        )
    return "\n".join((*lines, "</tbody></table>", "</div>"))


def figure(path: Path, description: str, caption: str, wide: bool = False) -> str:
    """An image file within the page.

    Args:
        description: for those who do not see it; wide: on a small screen it is scrolled, not shrunk.
    """
    data = base64.b64encode(path.read_bytes()).decode()
    image = f'<img src="data:{MEDIA_TYPES[path.suffix]};base64,{data}" alt="{escape(description)}">'
    if wide:
        image = (
            f'<div class="scroll" role="region" tabindex="0" aria-label="{escape(description)}">{image}</div>'
        )
    return f"<figure>{image}<figcaption>{escape(caption)}</figcaption></figure>"


def grid(*figures: str) -> str:
    """Figures side by side where the screen is wide enough."""
    return f'<div class="grid">{"".join(figures)}</div>'


def link(path: str) -> str:
    """A link to a file beside the page."""
    return f'<a href="{escape(path)}"><code>{escape(path)}</code></a>'


def commands(lines: Sequence[str]) -> str:
    """Commands for a shell, a line each."""
    return f"<pre><code>{escape(chr(10).join(lines))}</code></pre>"
