"""Every example runs, in a process of its own, as a reader would start it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
SMALL = {
    "accelerate.py": [],
    "wrap_an_env.py": [],
    "extractor_in_sb3.py": ["64"],
    "look_ahead.py": [],
    "train_sac.py": ["32", "run"],
    "new_representation.py": ["128", "run"],
}
TRAIN_YAML = "import sys; from esc_agents.cli.train import main; main()"


def start(folder: Path, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": f"{ROOT}:{ROOT / 'agents'}"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    return done.stdout


def test_none_is_missing():
    assert {path.name for path in EXAMPLES.glob("*.py")} == set(SMALL)
    for path in EXAMPLES.iterdir():
        if path.is_file():
            assert len(path.read_text().splitlines()) <= 40, path.name


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow) if "run" in SMALL[name] else name
        for name in sorted(SMALL)
    ],
)
def test_example(name, tmp_path):
    output = start(tmp_path, str(EXAMPLES / name), *SMALL[name])
    assert output
    if "run" in SMALL[name]:
        assert (tmp_path / "run" / "results.json").is_file()


@pytest.mark.slow
def test_scenario_by_yaml(tmp_path):
    start(
        tmp_path, "-c", TRAIN_YAML, "--config", str(EXAMPLES / "new_scenario.yaml"),
        "--steps", "512", "--evaluation.episodes", "1", "--run-dir", "run",
    )  # fmt: skip
    assert (tmp_path / "run" / "model.zip").is_file()
