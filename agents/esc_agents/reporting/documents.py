"""A report as Markdown and as one HTML page, from the same blocks.

Text may hold `code`, **bold** and [links](target), and nothing else of Markdown.
"""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from io import BytesIO
from pathlib import Path
from string import Template

from matplotlib.figure import Figure

from esc_agents import files
from esc_agents.reporting.tables import markdown


@dataclass(frozen=True)
class Heading:
    """Opens a section."""

    text: str

    def markdown(self) -> str:
        return f"## {self.text}"

    def html(self) -> str:
        return f"<h2>{_inline(self.text)}</h2>"


@dataclass(frozen=True)
class Text:
    """A paragraph, or with ``bullets`` an item for each line."""

    text: str
    bullets: bool = False

    def markdown(self) -> str:
        return (
            "\n".join(f"- {line}" for line in self.text.split("\n")) if self.bullets else self.text
        )

    def html(self) -> str:
        if not self.bullets:
            return f"<p>{_inline(self.text)}</p>"
        items = "".join(f"<li>{_inline(line)}</li>" for line in self.text.split("\n"))
        return f"<ul>{items}</ul>"


@dataclass(frozen=True)
class Rows:
    """A table: the header, then the rows; all but the first column are numbers."""

    rows: Sequence[Sequence[str]]

    def markdown(self) -> str:
        return markdown(self.rows)

    def html(self) -> str:
        header, *body = self.rows
        head = "".join(f'<th scope="col">{_inline(cell)}</th>' for cell in header)
        lines = ["".join(f"<td>{_inline(cell)}</td>" for cell in row) for row in body]
        rows = "\n".join(f"<tr>{line}</tr>" for line in lines)
        return (
            f'<div class="wide"><table><thead><tr>{head}</tr></thead>\n<tbody>{rows}</tbody>'
            "</table></div>"
        )


@dataclass(frozen=True)
class Image:
    """An image, also written as a file. alt: what it shows, for those who don't see it."""

    file: str
    data: bytes
    alt: str

    def markdown(self) -> str:
        return f"![{self.alt}]({self.file})"

    def html(self) -> str:
        source = f"data:image/{Path(self.file).suffix[1:]};base64,{b64encode(self.data).decode()}"
        return f'<img src="{source}" alt="{escape(self.alt)}">'


def picture(name: str, figure: Figure, alt: str) -> Image:
    """A figure as ``name``.png."""
    image = BytesIO()
    # Without the version of matplotlib in it, the same figure is the same file.
    figure.savefig(image, format="png", dpi=150, metadata={"Software": None})
    return Image(f"{name}.png", image.getvalue(), alt)


Block = Heading | Text | Rows | Image

PAGE = Template("""\
<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<link rel="icon" href="data:,">
<style>
body { font: 16px/1.55 system-ui, sans-serif; color: #1b1f24; max-width: 68rem; margin: auto;
       padding: 1rem; }
h1, h2 { line-height: 1.2; }
h2 { margin-top: 2.5rem; }
p, li { max-width: 46rem; }
img { max-width: 100%; height: auto; margin: 1rem 0; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.86rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.25rem 0.6rem; text-align: right; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; position: sticky; left: 0;
                                 background: inherit; }
table, tr { background: #fff; }
thead th { border-bottom: 2px solid #1b1f24; white-space: normal; vertical-align: bottom; }
tbody tr:nth-child(even) { background: #f3f5f7; }
code { background: #f3f5f7; padding: 0.1rem 0.3rem; border-radius: 3px; overflow-wrap: anywhere; }
</style>
</head>
<body>
<h1>$title</h1>
$body
</body>
</html>
""")


def write(folder: Path, name: str, title: str, blocks: Sequence[Block]) -> list[Path]:
    """Write ``name``.md with its pictures, and ``name``.html, which needs no other file."""
    paths = [folder / f"{name}.md", folder / f"{name}.html"]
    for block in blocks:
        if isinstance(block, Image):
            data = block.data
            paths.append(folder / block.file)
            files.write_atomically(paths[-1], lambda file, data=data: file.write(data))
    text = "\n\n".join([f"# {title}", *(block.markdown() for block in blocks)])
    files.write_text(paths[0], text + "\n")
    body = "\n".join(block.html() for block in blocks)
    files.write_text(paths[1], PAGE.substitute(title=escape(title), body=body))
    return paths


_INLINE = [
    (re.compile(r"`([^`]+)`"), r"<code>\1</code>"),
    (re.compile(r"\*\*([^*]+)\*\*"), r"<strong>\1</strong>"),
    (re.compile(r"\[([^]]+)\]\(([^)]+)\)"), r'<a href="\2">\1</a>'),
]


def _inline(text: str) -> str:
    text = escape(text)
    for pattern, replacement in _INLINE:
        text = pattern.sub(replacement, text)
    return text
