"""A comparison killed at any instant at which its files change: started again, it ends the same."""

from __future__ import annotations

from esc_agents.compare import store
from esc_agents.compare.comparison import compare
from esc_agents.compare.grid import study_cells
from esc_agents.compare.jobs import TrainJob, collected
from esc_agents.training import run_directory
from tests.esc_agents.compare.small import HereEngine, measured, small
from tests.esc_agents.instants import contents, photographed, restore

TUNING = {"steps": 32, "scales": (1.0,), "learning_rates": (1.0,)}
ONE = small(repr=("esc",), seeds=1, transfer={}, tuning=TUNING)  # one run of the study
(CELL,) = study_cells(ONE)


def test_a_cell_and_the_report(tmp_path):
    """Of the run itself, training/test_instants.py says the same."""
    out = tmp_path / "out"
    run, result = store.run_folder(out, CELL), store.path_of(out, CELL)
    out.mkdir()
    with photographed(out, tmp_path / "album") as photos:
        compare(ONE, out, HereEngine())
    names, found, report = contents(out).keys(), measured(out), report_of(out)
    reached = set()
    for photo in photos:
        restore(photo, out)
        finished, known = run_directory.finished(run), result.exists()
        if run.exists() and not finished:
            continue
        reached.add((finished, known, (run / "checkpoints").exists()))
        engine = HereEngine()
        compare(ONE, out, engine)
        assert (f"{CELL.task}/{CELL.name}" in engine.names) != known
        assert contents(out).keys() == names
        assert measured(out) == found
        if known:
            assert report_of(out) == report
    # Nothing; a run with its checkpoints, then without, then with a result.
    assert reached == {
        (False, False, False), (True, False, True), (True, False, False), (True, True, False),
    }  # fmt: skip


def report_of(out):
    """Its files, byte for byte."""
    return {path.name: path.read_bytes() for path in out.iterdir()
            if path.suffix in {".md", ".html", ".csv", ".png", ".gif"}}  # fmt: skip


def test_files_of_another_machine_end_with_what_says_that_they_are_all_there(compared):
    job = TrainJob(small(), study_cells(small())[0], 6)
    names = list(collected(job.files(compared), compared))
    run, result = (str(path.relative_to(compared)) for path in job.files(compared))
    assert names[-2:] == [f"{run}/SHA256SUMS", result]
