"""The report of a comparison: its numbers, its words, and the page in a real browser."""

import csv
import html
import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest
from PIL import Image, ImageSequence

from esc_agents.compare import store
from esc_agents.compare.fairness import differences
from esc_agents.compare.films import together
from esc_agents.compare.grid import Candidate, Cell
from esc_agents.compare.report import load, write_report
from esc_agents.compare.store import Tuned
from esc_agents.errors import UserError
from tests.esc_agents.compare.small import ENV, baselines, result, small

TASK = f"{ENV}-ppo"
BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("chrome")


class Tables(HTMLParser):
    """The cells of every table of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tables: list[list[list[str]]] = []
        self.images: list[dict] = []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")
        elif tag == "img":
            self.images.append(dict(attrs))

    def handle_data(self, data):
        if self.tables and self.tables[-1] and self.tables[-1][-1]:
            self.tables[-1][-1][-1] += data.strip("\n")

    def titled(self, *columns):
        return [t for t in self.tables if t[0][: len(columns)] == list(columns)]


def rows_of(path):
    return list(csv.DictReader(path.read_text().splitlines()))


def shown(row, name, form):
    """A number of summary.csv as the page shows it."""
    value, low, high = (float(row[f"{name}{end}"]) for end in ("", "_low", "_high"))
    return f"{value:{form}}" + ("" if low == high else f" [{low:{form}}, {high:{form}}]")


def test_the_page_says_what_the_csv_says(compared):
    page = Tables((compared / "report.html").read_text())
    (table,) = page.titled("", "runs", "return")
    rows = rows_of(compared / "summary.csv")
    assert len(rows) == len(table) - 1 == 2 + 2 + 6  # representations, planner and IDM/MOBIL, blind
    for cells, row in zip(table[1:], rows, strict=True):
        assert cells[0] == row["driver"]
        assert cells[2] == shown(row, "return", ".2f")
        assert cells[4] == shown(row, "collisions", ".0%")
        assert cells[5] == f"{float(row['speed']):.1f}"
        assert cells[6] == f"{float(row['progress']):.0f}"
        if row["runs"]:
            assert (cells[1], cells[3]) == (row["runs"], shown(row, "iqm", ".2f"))


def test_the_csv_says_what_the_results_say(compared):
    rows = rows_of(compared / "runs.csv")
    found = {
        (row["repr"], row["seed"], row["trained_in"], row["driven_in"]): float(row["return"])
        for row in rows
    }
    results = store.results(compared / TASK)
    # Own traffic, other traffic and shuffled, of four runs and of two trained elsewhere.
    assert len(found) == len(rows) == 3 * (4 + 2)
    for run in results:
        key = (run.cell.repr, str(run.cell.seed), run.cell.traffic)
        for traffic, drives in {**run.drives, "shuffled": run.shuffled}.items():
            assert found[(*key, traffic)] == sum(e.reward for e in drives) / len(drives)


def test_markdown_links_to_what_is_there(compared):
    text = (compared / "report.md").read_text()
    names = re.findall(r"\]\(([^)]+)\)", text)
    assert {"summary.csv", "runs.csv", "bars.png", "curves.png"} < set(names)
    assert all((compared / name).exists() for name in names)


def test_one_animation_for_each_scenario(compared):
    with Image.open(compared / f"drive-{TASK}.gif") as film:
        assert sum(1 for _ in ImageSequence.Iterator(film)) > 10
        assert film.width == 640


CHECK = """
<script>
addEventListener("load", () => {
  const images = [...document.images].map(i => [i.naturalWidth, i.alt]);
  const root = document.documentElement;
  const found = {images, wide: root.scrollWidth, screen: innerWidth};
  document.body.textContent = "found:" + JSON.stringify(found) + ":end";
});
</script>
"""


@pytest.mark.skipif(BROWSER is None, reason="no Chromium here")
@pytest.mark.parametrize("width", [500, 1280])  # headless Chromium has no narrower window
def test_the_page_opens_in_a_browser(compared, tmp_path, width):
    page = tmp_path / "report.html"
    page.write_text((compared / "report.html").read_text() + CHECK)
    command = [
        str(BROWSER), "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run",
        "--disable-background-networking", "--disable-component-update", "--disable-sync",
        f"--user-data-dir={tmp_path / 'profile'}", f"--window-size={width},900",
        "--enable-logging=stderr", "--dump-dom", page.as_uri(),
    ]  # fmt: skip
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert "CONSOLE" not in ended.stderr
    found = json.loads(html.unescape(ended.stdout.split("found:")[-1].split(":end")[0]))
    assert len(found["images"]) == 5  # improvement, bars, curves, transfer, film
    for loaded, alt in found["images"]:
        assert loaded > 0
        assert alt
    assert found["wide"] <= found["screen"]  # wide tables scroll by themselves


def test_nothing_on_the_page_comes_from_elsewhere(compared):
    text = (compared / "report.html").read_text()
    assert not re.search(r"""(src|href)\s*=\s*["']?(https?:|//)""", text)
    assert all(image["src"].startswith("data:image/") for image in Tables(text).images)


def build(out: Path, results, **floors):
    store.begin_task(out, small(transfer={}), ENV)
    store.write_baselines(out / TASK, baselines(**floors))
    for run in results:
        store.write(out, run)
    write_report(out)
    return (out / "report.md").read_text()


def test_wins_losses_and_what_is_no_better_than_blind(tmp_path):
    scores = {"esc": [5.0, 5.1, 5.2], "fp": [8.0, 8.1, 8.2], "ap": [0.0, 0.1, 0.3]}
    text = build(
        tmp_path, [result(r, s, [x]) for r, xs in scores.items() for s, x in enumerate(xs)]
    )
    assert f"**esc against fp**: loses in 1 ({ENV}, PPO)." in text
    assert f"**esc against ap**: wins in 1 ({ENV}, PPO)." in text
    assert "not clearly above the best blind policy (always IDLE, 0.00 [-2.48, 2.48]): ap." in text
    assert "| **fp** | 3 | 8.10 " in text  # the best is bold


def test_a_rival_that_did_not_run_everywhere_is_not_dropped(tmp_path):
    store.begin_task(tmp_path, small(env=("exit-v0",), transfer={}), "exit-v0")
    store.write_baselines(tmp_path / "exit-v0-ppo", baselines())
    store.write(tmp_path, result("esc", 0, [5.0], env="exit-v0"))
    text = build(tmp_path, [result("esc", 0, [5.0]), result("fp", 0, [3.0])])
    assert "| esc | 0.50 |  |" in text
    assert "| fp |  | 100% |" in text


def test_as_many_steps_as_the_scenario_says(tmp_path):
    store.begin_task(tmp_path, small(steps=None, transfer={}), ENV)
    store.write_baselines(tmp_path / TASK, baselines())
    run = result("esc", 0, [5.0])
    store.write(tmp_path, replace(run, config=run.config | {"steps": 12_345}))
    write_report(tmp_path)
    assert "12,345 training steps, seeds 0" in (tmp_path / "report.md").read_text()


def test_everything_above_blind(tmp_path):
    text = build(tmp_path, [result("esc", s, [9.0 + s]) for s in range(3)])
    assert "every representation is above the best blind policy" in text


def test_unfair_differences_are_said(tmp_path):
    runs = [result("esc", 0, [1.0]), result("fp", 0, [1.0]), result("fp", 1, [1.0])]
    runs[1] = replace(runs[1], parameters=(1200, 2200), slots=5)
    runs[2] = replace(runs[2], config={**runs[2].config, "n_envs": 99})
    text = build(tmp_path, runs)
    for note in (
        "fp has 120% of ESC's parameters", "fp sees at most the Z=5 vehicles nearest, the others "
        "up to N=20", "different numbers of runs, 1 to 2", "fp, seed 1 differs in n_envs",
    ):  # fmt: skip
        assert note in text
    assert [*differences(load(tmp_path)[0])]


def test_equal_conditions_are_said_too(tmp_path):
    old, new = (result(r, 0, [1.0]) for r in ("esc", "fp"))
    assert "value_warmup" not in old.config["ppo"]  # a field that came later, 0 by default
    new = replace(new, config={**new.config, "ppo": {"value_warmup": 0}})
    assert "Nothing else differs." in build(tmp_path, [old, new])


def test_the_tuning_is_shown(tmp_path):
    for scale, rewards in {1.0: [1.0, 2.0], 0.1: [3.0, 4.0]}.items():
        cell = Cell(ENV, "ppo", "esc", 1000, candidate=Candidate(1.0, scale), tuning=True)
        store.write(tmp_path, Tuned(cell, rewards, 1.0, {}))
    text = build(tmp_path, [result("esc", 0, [1.0], candidate=Candidate(1.0, 0.1))])
    assert "| esc | 1.50 | **3.50** |" in text


def test_own_representations_have_a_place(tmp_path):
    assert "| **own.mod:Net** | 1 |" in build(tmp_path, [result("own.mod:Net", 0, [1.0])])


def test_no_results(tmp_path):
    with pytest.raises(UserError, match="expected results of esc-compare"):
        write_report(tmp_path)


def test_films_side_by_side_or_above_each_other():
    def film(width, height, frames):
        return [Image.new("RGB", (width, height), (i, 0, 0)) for i in range(frames)]

    wide = together({"esc": film(600, 150, 30), "fp": film(600, 150, 15)}, rate=5)
    assert len(wide) == 30  # as long as the longer one
    assert wide[0].size == (640, 2 * (160 + 18))
    tall = together({name: film(300, 300, 200) for name in ("esc", "fp", "ap", "mean")}, rate=15)
    assert len(tall) == 12 * 5  # twelve seconds, five frames each
    assert tall[0].size == (3 * 213, 2 * (213 + 18))
