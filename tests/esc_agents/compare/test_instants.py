"""A comparison killed at any instant at which its files change: started again, it ends the same.

Of the runs themselves, training/test_instants.py says so.
"""

from __future__ import annotations

from esc_agents.compare import store
from esc_agents.compare.comparison import compare
from esc_agents.compare.grid import study_cells
from esc_agents.compare.jobs import BaselineJob, TrainJob, collected
from esc_agents.compare.report import write_report
from esc_agents.training import run_directory
from tests.esc_agents.compare.small import ENV, HereEngine, measured, small
from tests.esc_agents.instants import contents, photographed, restore

TUNING = {"steps": 32, "scales": (1.0,), "learning_rates": (1.0,)}
ONE = small(repr=("esc",), seeds=1, episodes=1, transfer={}, tuning=TUNING)
(CELL,) = study_cells(ONE)  # of one run


def test_the_beginning(tmp_path):
    def begin():
        store.begin_task(out, ONE, ENV)
        BaselineJob(ONE, ENV).do(out, lambda progress: None)

    out = tmp_path / "out"
    out.mkdir()
    with photographed(out, tmp_path / "album") as photos:
        begin()
    expected = contents(out)
    assert len(photos) == 4  # nothing, the task's folder, its task.yaml and its baselines.json
    for photo in photos:
        restore(photo, out)
        begin()
        assert contents(out) == expected


def test_the_end_of_a_run_and_the_report(tmp_path):
    out = tmp_path / "out"
    run, result = store.run_folder(out, CELL), store.path_of(out, CELL)
    out.mkdir()
    with photographed(out, tmp_path / "album") as photos:
        compare(ONE, out, HereEngine())
    whole, found, reached = contents(out), measured(out), set()
    for photo in photos:
        restore(photo, out)
        if not run_directory.finished(run):
            continue
        reached.add((result.exists(), (run / "checkpoints").exists()))
        if result.exists():  # then only the report remains
            write_report(out)
            assert contents(out) == whole
        else:
            compare(ONE, out, HereEngine())
            assert contents(out).keys() == whole.keys()
            assert measured(out) == found
    # No result and checkpoints, no result and none, a result and none: who has one is done.
    assert reached == {(False, True), (False, False), (True, False)}


def test_files_of_another_machine_end_with_what_says_that_they_are_all_there(compared):
    job = TrainJob(small(), study_cells(small())[0], 6)
    names = list(collected(job.files(compared), compared))
    run, result = (str(path.relative_to(compared)) for path in job.files(compared))
    assert names[-2:] == [f"{run}/SHA256SUMS", result]
