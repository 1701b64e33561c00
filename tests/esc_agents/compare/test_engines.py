"""Engines against the same comparison in this process; Ray is a real one, started here."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from esc_agents import workers
from esc_agents.compare.comparison import compare
from esc_agents.compare.engines import LocalEngine, RayEngine, _check_answers
from esc_agents.compare.jobs import Interrupted, Progress, session
from esc_agents.errors import UserError
from esc_agents.training.callbacks import StopOnSignal
from tests.esc_agents.compare.small import measured, small


@dataclass(frozen=True)
class Writes:
    """A job that says where it ran, after a while."""

    name: str
    seconds: float = 0.0
    fails: bool = False

    def files(self, out: Path) -> list[Path]:
        return [out / "found" / self.name]

    def do(self, out: Path, post: Any) -> None:
        post(Progress(self.name, 7))
        time.sleep(self.seconds)
        if self.fails:
            raise UserError(f"{self.name} cannot be done")
        (out / "found").mkdir(exist_ok=True)
        (out / "found" / self.name).write_text(f"{os.getpid()} {out}")


class Heard:
    """What an engine said."""

    def __init__(self) -> None:
        self.ended: dict[str, Exception | None] = {}
        self.posts: list[Progress] = []

    def done(self, job: Any, error: Exception | None) -> None:
        self.ended[job.name] = error


def run(engine: Any, jobs: list[Writes], out: Path) -> Heard:
    heard = Heard()
    engine.run(jobs, out, heard.done, heard.posts.append)
    return heard


def check_all(heard: Heard, jobs: list[Writes], out: Path) -> None:
    assert set(heard.ended) == {job.name for job in jobs}
    assert {post.name for post in heard.posts} <= set(heard.ended)
    for job in jobs:
        error = heard.ended[job.name]
        assert (str(error) if error else None) == (
            f"{job.name} cannot be done" if job.fails else None
        )
        assert (out / "found" / job.name).exists() != job.fails


JOBS = [Writes("a", 0.5), Writes("b", fails=True), Writes("c"), Writes("d", 0.5)]


def test_local_processes(tmp_path):
    heard = run(LocalEngine(2), JOBS, tmp_path)
    check_all(heard, JOBS, tmp_path)
    assert heard.posts
    pids = {(tmp_path / "found" / name).read_text().split()[0] for name in ("a", "d")}
    assert str(os.getpid()) not in pids


@dataclass(frozen=True)
class Dies(Writes):
    def do(self, out: Path, post: Any) -> None:
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.slow
def test_a_local_process_that_dies_is_told(tmp_path):
    with pytest.raises(UserError, match="a process of the comparison died"):
        run(LocalEngine(1), [Dies("x")], tmp_path)


@dataclass(frozen=True)
class Trains(Writes):
    """As training does: goes on until it is to stop, then saves; ``seconds`` are before."""

    def do(self, out: Path, post: Any) -> None:
        post(Progress(self.name, 0))
        time.sleep(self.seconds)
        with StopOnSignal() as stop:
            while not stop():
                time.sleep(0.05)
        (out / self.name).touch()
        raise Interrupted


@pytest.mark.parametrize("delay", [0.0, 3.0], ids=["in training", "before training begins"])
def test_an_interrupted_comparison_lets_running_jobs_save_and_begins_no_others(tmp_path, delay):
    def interrupt(progress: Progress) -> None:
        raise KeyboardInterrupt

    jobs = [Trains(name, delay) for name in "abc"]
    with pytest.raises(KeyboardInterrupt):
        LocalEngine(1).run(jobs, tmp_path, Heard().done, interrupt)
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


@pytest.fixture
def quiet_ray(monkeypatch):
    """Ray's warnings about itself are not ours."""
    pytest.importorskip("ray")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    monkeypatch.setenv("RAY_DISABLE_IMPORT_WARNING", "1")
    # Rays of other tests leave a token in the home directory, at any time.
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_ray_with_and_without_a_shared_directory(tmp_path, quiet_ray, monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")  # a cluster that is gone is not asked
    for shared in (None, False):
        out = tmp_path / str(shared)
        out.mkdir()
        heard = run(RayEngine("local", 1, shared), JOBS, out)
        check_all(heard, JOBS, out)
        where = (out / "found" / "a").read_text().split()[1]
        assert (where == str(out)) == (shared is None)
        assert not (out / ".token").exists()


@contextlib.contextmanager
def node(*options: str):
    """``ray start`` in a process group of its own, which ends with the block."""
    command = [sys.executable, "-m", "ray.scripts.scripts", "start", "--block", "--num-cpus=1"]
    process = subprocess.Popen(
        [*command, "--disable-usage-stats", *options], start_new_session=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        yield process
    finally:
        kill(process)


def kill(process: subprocess.Popen) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


def wait_for(address: str) -> None:
    """Until the Ray there is well; on a busy machine that takes longer than users are made wait."""
    deadline = time.monotonic() + 180
    while True:
        try:
            return _check_answers(address)
        except UserError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.5)


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_two_nodes_of_which_one_is_killed(compared, tmp_path, quiet_ray):
    """A whole comparison on two nodes on loopback; one is lost in mid-run, and no result is."""
    port = free_port()
    address, out = f"127.0.0.1:{port}", tmp_path / "out"
    with node("--head", f"--port={port}", "--include-dashboard=false") as head:
        wait_for(address)
        with node(f"--address={address}") as second:

            def lose() -> None:
                while not list(out.glob("*/results/*.json")):
                    time.sleep(0.05)
                kill(second)

            killer = threading.Thread(target=lose, daemon=True)
            killer.start()
            compare(small(), out, RayEngine(address, 1))
            killer.join(timeout=10)
            assert second.poll() is not None
            assert head.poll() is None
    assert measured(out) == measured(compared)


@pytest.mark.parametrize("address", ["nowhere", "127.0.0.1:x", "127.0.0.1:1"])
def test_addresses_that_are_none_or_do_not_answer(tmp_path, address, quiet_ray):
    start = time.monotonic()
    with pytest.raises(UserError, match=f"--address.*{address}"):
        run(RayEngine(address, 1), JOBS, tmp_path)
    assert time.monotonic() - start < 30


@pytest.mark.filterwarnings("default")
def test_an_address_where_something_else_answers(tmp_path, quiet_ray, monkeypatch):
    monkeypatch.setattr("esc_agents.compare.engines.CONNECT_SECONDS", 3)
    with socket.socket() as deaf:
        deaf.bind(("127.0.0.1", 0))
        deaf.listen()
        address = f"127.0.0.1:{deaf.getsockname()[1]}"
        with pytest.raises(UserError, match=rf"--address {address}: no Ray answers"):
            run(RayEngine(address, 1), JOBS, tmp_path)


def test_a_ray_that_listens_before_it_is_well_is_waited_for(monkeypatch):
    asked = []

    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")

    def check(command, **options):
        asked.append(command)
        return subprocess.CompletedProcess(command, returncode=int(len(asked) < 3))

    monkeypatch.setattr(subprocess, "run", check)
    with socket.socket() as starting:
        starting.bind(("127.0.0.1", 0))
        starting.listen()
        _check_answers(f"127.0.0.1:{starting.getsockname()[1]}")
    assert len(asked) == 3


def test_a_ray_that_wants_the_token_of_this_machine_gets_it(monkeypatch):
    asked, given = [], []

    def check(command, env, **options):
        asked.append(env.get("RAY_AUTH_MODE"))
        return subprocess.CompletedProcess(command, returncode=int(asked[-1] != "token"))

    monkeypatch.delenv("RAY_AUTH_MODE", raising=False)
    monkeypatch.setattr(subprocess, "run", check)
    monkeypatch.setattr("esc_agents.compare.engines._give_token", lambda: given.append(True))
    with socket.socket() as ray:
        ray.bind(("127.0.0.1", 0))
        ray.listen()
        _check_answers(f"127.0.0.1:{ray.getsockname()[1]}")
    assert (asked, given) == ([None, "token"], [True])


@pytest.mark.filterwarnings("default")
def test_auto_without_a_ray_here(tmp_path, quiet_ray, monkeypatch):
    monkeypatch.setattr("esc_agents.compare.engines.CONNECT_SECONDS", 5)
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")  # where auto looks first
    with pytest.raises(UserError, match=r"--address auto: no Ray answers; .*ray start --head"):
        run(RayEngine("auto", 1), JOBS, tmp_path)


def test_without_ray_installed(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match=r"Ray is not installed.*esc-gym\[ray\]"):
        RayEngine("local", 1)


def test_a_run_took_what_its_interrupted_sessions_took_too(tmp_path, monkeypatch):
    now = [100.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])

    def stopped():
        now[0] += 7
        raise Interrupted

    with pytest.raises(Interrupted), session(tmp_path / "run"):
        stopped()
    for expected in (7 + 3, 3):  # the second time of a run that is done anew
        with session(tmp_path / "run") as seconds:
            now[0] += 3
            assert seconds() == expected


@dataclass(frozen=True)
class Masked(Writes):
    """Says whether Ctrl-C can reach its process, from its first instant on."""

    def do(self, out: Path, post: Any) -> None:
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, [])
        (out / self.name).write_text(str(signal.SIGINT in blocked))


def test_ctrl_c_reaches_no_worker_and_the_comparison_afterwards(tmp_path):
    run(LocalEngine(1), [Masked("a")], tmp_path)
    assert (tmp_path / "a").read_text() == "True"
    reached = []
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # in the background: none
    with pytest.raises(KeyboardInterrupt), workers.out_of_reach():
        reached += [signal.raise_signal(signal.SIGINT), "here"]
    signal.signal(signal.SIGINT, before)
    assert reached[-1] == "here"
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])
