"""Where jobs run: processes of this machine, or a Ray cluster. The results are the same."""

from __future__ import annotations

import logging
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol

from esc_agents import files, workers
from esc_agents.compare.jobs import Interrupted, Job, Post, Progress, collected
from esc_agents.errors import UserError

CONNECT_SECONDS = 15
START = "start Ray there with: ray start --head"
RETRIES = 5  # of a job whose node or process was lost
Done = Callable[[Job, BaseException | None], None]
_posts: Any = None  # of a local worker: the queue that takes its progress


class Engine(Protocol):
    """Runs jobs, as many at a time as fit."""

    def run(self, jobs: Sequence[Job], out: Path, done: Done, post: Post) -> None:
        """Calls ``done`` with every job and what it raised, ``post`` with what they report."""
        ...


class LocalEngine:
    """Processes of this machine."""

    def __init__(self, workers: int) -> None:
        self.workers = workers

    def run(self, jobs: Sequence[Job], out: Path, done: Done, post: Post) -> None:
        posts, stopping = workers.SPAWN.Queue(), workers.SPAWN.Event()
        count = min(self.workers, len(jobs))
        given = posts, stopping, list(sys.path)
        pool = ProcessPoolExecutor(count, workers.SPAWN, _start_worker, given)
        try:
            with workers.out_of_reach():
                running: dict[Future, Job] = {pool.submit(_work, job, out): job for job in jobs}
            while running:
                ended, _ = wait(running, timeout=0.5, return_when="FIRST_COMPLETED")
                for progress in _waiting(posts):
                    post(progress)
                for future in ended:
                    job, error = running.pop(future), future.exception()
                    if isinstance(error, BrokenProcessPool):
                        raise UserError(
                            "a process of the comparison died: killed, or out of memory; start "
                            "again to go on, with fewer --workers if memory was short"
                        )
                    done(job, error)
        except KeyboardInterrupt:
            stopping.set()
            raise
        finally:
            pool.shutdown(cancel_futures=True)


def _waiting(posts: Any) -> Iterator[Progress]:
    while not posts.empty():
        yield posts.get()


def _start_worker(posts: Any, stopping: Any, path: list[str]) -> None:
    global _posts
    _posts, sys.path[:] = posts, path
    # Ctrl-C reaches the whole process group; the comparison decides when its workers stop.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "setsid"):
        os.setsid()
    workers.follow_parent(stopping)


def _work(job: Job, out: Path) -> None:
    if workers.asked_to_stop():
        raise Interrupted
    job.do(out, _posts.put)


class RayEngine:
    """Ray tasks, on this machine or on a cluster.

    address: "local" starts a Ray of its own; "auto" finds one that runs here; else host:port.
    Nodes that see the output directory work in it; from others the files are collected.
    cpus: of one job. shared: whether nodes are to work in the output directory, None to find out.
    """

    def __init__(self, address: str, cpus: float, shared: bool | None = None) -> None:
        try:
            import ray
        except ImportError as error:
            raise UserError(
                "--engine ray: Ray is not installed; install it with: pip install 'esc-gym[ray]'"
            ) from error
        self.ray: Any = ray
        self.address, self.cpus, self.shared = address, cpus, shared

    def run(self, jobs: Sequence[Job], out: Path, done: Done, post: Post) -> None:
        self._connect()
        try:
            with _token(out) as token:
                self._run(jobs, out, "" if self.shared is False else token, done, post)
        finally:
            self.ray.shutdown()

    def _connect(self) -> None:
        # "local" said outright: without an address Ray looks for a cluster, also for a dead one.
        options: dict[str, Any] = {
            "address": self.address, "log_to_driver": False, "logging_level": logging.ERROR,
        }  # fmt: skip
        if self.address == "local":
            options["include_dashboard"] = False
        else:
            _check_answers(self.address)
        # What Ray warns of unless it is set: nothing changes where no GPU is asked for.
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        try:
            self.ray.init(**options)
        except (ConnectionError, RuntimeError, ValueError) as error:
            reason = str(error).splitlines()[0]
            raise UserError(f"--address {self.address}: {reason}; {START}") from error

    def _run(self, jobs: Sequence[Job], out: Path, token: str, done: Done, post: Post) -> None:
        ray = self.ray
        board = ray.remote(num_cpus=0)(_Board).remote()
        task = ray.remote(num_cpus=self.cpus, max_retries=RETRIES)(_do)
        running = {task.remote(job, out, token, board): job for job in jobs}
        while running:
            ended, _ = ray.wait(list(running), timeout=0.5)
            with suppress(ray.exceptions.RayError):
                for progress in ray.get(board.take.remote()):
                    post(progress)
            for reference in ended:
                job, error = running.pop(reference), None
                try:
                    for name, content in ray.get(reference).items():
                        (out / name).parent.mkdir(parents=True, exist_ok=True)
                        files.write_atomically(
                            out / name, lambda file, data=content: file.write(data)
                        )
                except ray.exceptions.RayTaskError as raised:
                    error = raised.cause if isinstance(raised.cause, Exception) else raised
                except ray.exceptions.RayError as raised:
                    error = UserError(f"lost {RETRIES + 1} times: {str(raised).splitlines()[0]}")
                done(job, error)


def _check_answers(address: str) -> None:
    """Raises UserError unless a Ray answers: ray.init would try for minutes.

    A Ray that is starting listens before it answers, so a host:port that listens gets
    CONNECT_SECONDS to say that it is well.
    """
    check = [sys.executable, "-m", "ray.scripts.scripts", "health-check"]
    deadline = time.monotonic() + CONNECT_SECONDS
    if address != "auto":
        host, colon, port = address.rpartition(":")
        if not colon or not port.isdecimal():
            raise UserError(f"--address: expected auto, local or host:port, got {address!r}")
        try:
            socket.create_connection((host, int(port)), timeout=CONNECT_SECONDS).close()
        except OSError as error:
            raise UserError(f"--address {address}: {error.strerror or error}; {START}") from error
        check += ["--address", address]
    # A Ray on a machine with a token asks for it, and ray.init gives it, but not this check.
    known = "RAY_AUTH_MODE" in os.environ
    modes = [os.environ] if known else [os.environ, {**os.environ, "RAY_AUTH_MODE": "token"}]
    while deadline > time.monotonic():
        for mode in modes:
            left = max(deadline - time.monotonic(), 0.1)
            with suppress(subprocess.TimeoutExpired):
                asked = subprocess.run(check, capture_output=True, timeout=left, env=mode)
                if asked.returncode == 0:
                    if mode is not os.environ:
                        _give_token()
                    return
        if address == "auto":
            break
        time.sleep(0.2)
    raise UserError(f"--address {address}: no Ray answers; {START}")


def _give_token() -> None:
    """Have this process show the machine's token, as ``ray start`` has its own do."""
    with suppress(ImportError, AttributeError):  # Rays before 2.60 have none
        from ray._private.authentication import authentication_token_setup as setup

        setup.maybe_enable_token_auth_if_token_available(warn_if_disabled=False)


@contextmanager
def _token(out: Path) -> Iterator[str]:
    """Text of a file in the output directory, by which a node knows that it sees the same one."""
    path, text = out / ".token", uuid.uuid4().hex
    path.write_text(text)
    try:
        yield text
    finally:
        path.unlink(missing_ok=True)


class _Board:
    """Takes progress from tasks until the driver asks for it."""

    def __init__(self) -> None:
        self.posts: list[Progress] = []

    def put(self, progress: Progress) -> None:
        self.posts.append(progress)

    def take(self) -> list[Progress]:
        taken, self.posts = self.posts, []
        return taken


def _do(job: Job, out: Path, token: str, board: Any) -> dict[str, bytes]:
    """A job on a node; returns its files where the node doesn't see the output directory."""

    def post(progress: Progress) -> None:
        board.put.remote(progress)

    if token and (out / ".token").exists() and (out / ".token").read_text() == token:
        job.do(out, post)
        return {}
    with tempfile.TemporaryDirectory() as folder:
        here = Path(folder)
        job.do(here, post)
        return collected(job.files(here), here)
