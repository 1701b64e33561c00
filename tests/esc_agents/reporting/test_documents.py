"""One report, two forms: Markdown beside its pictures, and a page that needs no other file."""

from __future__ import annotations

from base64 import b64encode

from matplotlib.figure import Figure

from esc_agents.reporting.documents import Heading, Rows, Text, picture, write


def test_both_forms(tmp_path):
    blocks = [
        Text("`a < b` is **so**, see [there](x.csv) & <b>."),
        Heading("Results"),
        Rows([["name", "error"], ["esc", "**1**"], ["fp", "2"]]),
        Text("one\ntwo", bullets=True),
        picture("dots", Figure(figsize=(1, 1)), 'what "it" shows'),
    ]
    paths = write(tmp_path, "page", "A < B", blocks)
    assert [path.name for path in paths] == ["page.md", "page.html", "dots.png"]
    markdown, html = (tmp_path / f"page.{end}" for end in ("md", "html"))
    assert markdown.read_text() == (
        "# A < B\n\n`a < b` is **so**, see [there](x.csv) & <b>.\n\n## Results\n\n"
        "| name | error |\n| --- | ---: |\n| esc | **1** |\n| fp | 2 |\n\n- one\n- two\n\n"
        '![what "it" shows](dots.png)\n'
    )
    text = html.read_text()
    assert "<title>A &lt; B</title>" in text
    assert (
        '<p><code>a &lt; b</code> is <strong>so</strong>, see <a href="x.csv">there</a> &amp; '
        "&lt;b&gt;.</p>" in text
    )
    assert "<tr><td>esc</td><td><strong>1</strong></td></tr>" in text
    assert "<ul><li>one</li><li>two</li></ul>" in text
    png = (tmp_path / "dots.png").read_bytes()
    assert png.startswith(b"\x89PNG")
    source = f'src="data:image/png;base64,{b64encode(png).decode()}"'
    assert f'<img {source} alt="what &quot;it&quot; shows">' in text


def test_the_same_figure_is_the_same_file():
    first, second = (picture("x", Figure(), "nothing") for _ in range(2))
    assert first.data == second.data
