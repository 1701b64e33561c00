"""Records of earlier versions in the form of today: other lines, the same values."""

import json

from esc_agents.cli import rewrite
from esc_agents.reporting import records

CONTENT = {
    "cell": {"repr": "esc", "seed": 0},
    "returns": [0.1 + 0.2, -1e-300, 5e20, 3.0] * 20,
    "table": [[1, 2], [3.5, None]] * 20,
    "empty": {"list": [], "mapping": {}},
    "text": 'a "quoted", é',
}


def test_values_stay_and_lines_go(call, tmp_path):
    path = tmp_path / "docs" / "deep" / "old.json"
    path.parent.mkdir(parents=True)
    records.write(path, 3, CONTENT)
    old = json.loads(path.read_bytes())
    del old["mac"]  # as earlier versions wrote it
    path.write_text(json.dumps(old, indent=1))
    assert records.read(path, 3) == CONTENT
    assert call(rewrite, "docs") == (0, "1 of 1 files written anew\n", "")
    assert list(json.loads(path.read_bytes()).items()) == list(old.items())
    assert records.read(path, 3) == CONTENT
    assert len(path.read_text().splitlines()) < 15
    assert call(rewrite, "docs") == (0, "0 of 1 files written anew\n", "")


def test_signed_records_and_other_files_stay(call, tmp_path):
    records.write(tmp_path / "signed.json", 3, CONTENT)
    (tmp_path / "results.json").write_text(json.dumps([{"policy": "esc"}], indent=2))
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert call(rewrite, ".") == (0, "0 of 2 files written anew\n", "")
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_arrays_of_numbers_are_one_line(tmp_path):
    records.write(tmp_path / "a.json", 3, CONTENT)
    lines = (tmp_path / "a.json").read_text().splitlines()
    (returns,) = (line for line in lines if line.startswith(' "returns": ['))
    assert returns.count(", ") == len(CONTENT["returns"]) - 1
    assert sum("[1, 2], [3.5, null]" in line for line in lines) > 1
    assert len(lines) < 15
    assert max(len(line) for line in lines if "returns" not in line) <= 100


def test_what_cannot_be_read_is_named(call, tmp_path):
    (tmp_path / "bad.json").write_text("{")
    code, out, err = call(rewrite, ".")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "bad.json: not readable as JSON" in err
    assert call(rewrite, "nowhere")[0] == 2
