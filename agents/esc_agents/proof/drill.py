"""Real training processes, killed and damaged in every way that a user may meet."""

from __future__ import annotations

import contextlib
import json
import os
import random
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from esc_agents.errors import say
from esc_agents.training.checkpoint import in_order
from esc_agents.training.run_directory import finished

TRAIN = [sys.executable, "-c", "from esc_agents.cli.train import main; main()"]
COMMON = [
    "--n-envs", "2", "--device", "cpu", "--evaluation.episodes", "2", "--encoder.hidden", "64",
]  # fmt: skip
RUNS = {
    "ppo": [
        "--env", "highway-fast", "--algo", "ppo", "--ppo.n-steps", "32", "--ppo.batch-size", "32",
        "--checkpoint-every", "200", "--evaluation.every", "3000", "--repr", "ap",
    ],
    "sac": [
        "--env", "lane-keeping", "--algo", "sac", "--sac.batch-size", "32",
        "--sac.buffer-size", "3000", "--sac.learning-starts", "50", "--checkpoint-every", "100",
        "--evaluation.every", "1000", "--repr", "ap",
    ],
}  # fmt: skip
SECONDS = 600  # after which a process that has not ended counts as hanging


class Failed(Exception):
    """A row did not end as it has to; says how."""


def expect(condition: object, message: str) -> None:
    if not condition:
        raise Failed(message)


@dataclass
class Drill:
    """What the rows share: a folder, the moments, and uninterrupted runs to compare with.

    count: SIGKILLs in a run; length: training steps by algorithm; seconds: what they took.
    """

    folder: Path
    moments: random.Random
    count: int
    length: dict[str, int]
    seconds: dict[str, float] = field(default_factory=dict)

    def new(self, algo: str, name: str, *more: str, steps: int | None = None) -> list[str]:
        """The command of a run in ``folder / name``."""
        run = ["--steps", str(steps or self.length[algo]), "--run-dir", str(self.folder / name)]
        return [*COMMON, *RUNS[algo], *run, *more]

    def whole(self, algo: str) -> Path:
        """The run that nothing happened to."""
        path = self.folder / f"{algo}-whole"
        if not path.exists():
            with started(self.new(algo, path.name)) as process:
                wait_for(process, "steps into")
                start = time.monotonic()
                process.communicate(timeout=SECONDS)
                self.seconds[algo] = time.monotonic() - start
            expect(process.returncode == 0, "the uninterrupted run failed")
        return path


@contextlib.contextmanager
def started(args: Sequence[str], limit: int | None = None) -> Iterator[subprocess.Popen[str]]:
    """esc-train as a process group of its own. limit: bytes that a file may have."""

    size = limit or 0

    def limited() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # an error, as of a full disk, not an end
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    process = subprocess.Popen(
        [*TRAIN, *args], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        start_new_session=True, preexec_fn=limited if limit else None,
    )  # fmt: skip
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def finish(args: Sequence[str], code: int = 0, limit: int | None = None) -> str:
    """What a run printed that has to end with ``code``."""
    with started(args, limit) as process:
        printed, _ = process.communicate(timeout=SECONDS)
    expect(process.returncode == code, f"exit code {process.returncode}, not {code}: {printed}")
    expect("Traceback" not in printed, f"a traceback: {printed}")
    return printed


def wait_for(process: subprocess.Popen[str], text: str) -> None:
    """Read on until a line with ``text``."""
    assert process.stdout
    for line in process.stdout:
        if text in line:
            return
    raise Failed(f"it ended without {text!r}")


def last_line(printed: str) -> str:
    return printed.strip().splitlines()[-1]


def kills(drill: Drill, algo: str) -> str:
    """SIGKILL at random moments; resumed each time."""
    path, count, whole = drill.folder / f"{algo}-killed", drill.count, drill.whole(algo)
    args, done, steps = drill.new(algo, path.name), 0, set()
    share = 0.8 / count  # the run must not end before the last kill, also if it is faster now
    while done < count and not finished(path):  # it may be killed after its last file
        with started(args) as process:
            wait_for(process, "steps into")
            moment = time.monotonic() + drill.moments.uniform(0, share * drill.seconds[algo])
            last = (done + 1) * share * drill.length[algo]
            while time.monotonic() < moment and _newest(path) < last:
                time.sleep(0.01)
            expect(process.poll() is None, f"the run ended after {done} kills: give it more steps")
            os.killpg(process.pid, signal.SIGKILL)
            done += 1
        steps.add(_newest(path))
        args = ["--resume", str(path)]
    if not finished(path):
        finish(args)
    same(path, whole)
    places = f"{len(steps)} places up to step {max(steps):,}"
    return f"{done} times, resumed from {places}: the same files"


def _newest(path: Path) -> int:
    return max((int(file.stem) for file in in_order(path / "checkpoints")), default=0)


def same(path: Path, whole: Path) -> None:
    """The results of two runs, byte by byte."""
    for name in ("policy.safetensors", "metrics.csv", "evaluations.npz", "results.json"):
        equal = (path / name).read_bytes() == (whole / name).read_bytes()
        expect(equal, f"{name} differs from that of the uninterrupted run")


def stopped(drill: Drill, name: str, steps: int = 2_000) -> Path:
    """A PPO run that was killed after its second checkpoint."""
    path = drill.folder / name
    with started(drill.new("ppo", name, steps=steps)) as process:
        wait_for(process, "steps into")
        while len(in_order(path / "checkpoints")) < 2:
            expect(process.poll() is None, "the run ended before it could be killed")
            time.sleep(0.01)
    return path


def damaged(drill: Drill, name: str, change: Callable[[bytes], bytes]) -> str:
    """The newest checkpoint changed: the one before it is taken."""
    path = stopped(drill, name)
    before, last = in_order(path / "checkpoints")
    last.write_bytes(change(last.read_bytes()))
    printed = finish(["--resume", str(path)])
    expect(f"Continuing from {before}" in printed, f"not from the one before: {printed}")
    return next(line for line in printed.splitlines() if str(last) in line)


def truncated(drill: Drill) -> str:
    return damaged(drill, "truncated", lambda content: content[: len(content) // 2])


def flipped(drill: Drill) -> str:
    def flip(content: bytes) -> bytes:
        place = drill.moments.randrange(len(content) // 2, len(content))
        return content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]

    return damaged(drill, "flipped", flip)


def other_version(drill: Drill) -> str:
    path = stopped(drill, "version")
    last = in_order(path / "checkpoints")[-1]
    line, _, state = last.read_bytes().partition(b"\n")
    last.write_bytes(json.dumps(json.loads(line) | {"schema": 99}).encode() + b"\n" + state)
    printed = finish(["--resume", str(path)], code=2)
    expect("expected a checkpoint of schema" in printed, printed)
    return last_line(printed)


def somebody_elses(drill: Drill) -> str:
    path = stopped(drill, "foreign")
    last = in_order(path / "checkpoints")[-1]
    line, _, state = last.read_bytes().partition(b"\n")
    last.write_bytes(json.dumps(json.loads(line) | {"mac": "00" * 32}).encode() + b"\n" + state)
    printed = finish(["--resume", str(path)], code=2)
    expect("--trust" in printed, printed)
    finish(["--resume", str(path), "--trust"])
    return last_line(printed)


def disk_full(drill: Drill) -> str:
    """Files may not become large enough for a checkpoint: it is said, and training ends well."""
    args = drill.new("sac", "full", "--sac.buffer-size", "100000", steps=400)
    printed = finish(args, limit=2_000_000)
    lines = [line for line in printed.splitlines() if "could not be written" in line]
    expect(lines, printed)
    expect((drill.folder / "full" / "policy.safetensors").exists(), "no policy at the end")
    return lines[0]


def no_permission(drill: Drill) -> str:
    path = stopped(drill, "locked")
    path.chmod(0o500)
    try:
        if os.access(path, os.W_OK):
            return "not tried: this user may write everywhere"
        printed = finish(["--resume", str(path)], code=2)
    finally:
        path.chmod(0o700)
    return last_line(printed)


def two_processes(drill: Drill) -> str:
    path = stopped(drill, "two", steps=drill.length["ppo"])
    with started(["--resume", str(path)]) as first:
        wait_for(first, "steps into")
        printed = finish(["--resume", str(path)], code=2)
        expect(first.poll() is None, "the first one did not go on")
    expect("is in use by another process" in printed, printed)
    return last_line(printed)


def asked_to_stop(drill: Drill, name: str, number: int, times: int = 1) -> str:
    with started(drill.new("ppo", name)) as process:
        wait_for(process, "steps into")
        time.sleep(drill.moments.uniform(0.5, 2))
        for _ in range(times):
            os.killpg(process.pid, number)
            time.sleep(0.05)
        printed, _ = process.communicate(timeout=SECONDS)
    expect(process.returncode == 130, f"exit code {process.returncode}: {printed}")
    expect("Traceback" not in printed, printed)
    finish(["--resume", str(drill.folder / name)])
    same(drill.folder / name, drill.whole("ppo"))
    line = last_line(printed) if printed.strip() else "ended at once"
    return f"{line}; resumed: the same files"


def sigterm(drill: Drill) -> str:
    return asked_to_stop(drill, "sigterm", signal.SIGTERM)


def sigint_twice(drill: Drill) -> str:
    return asked_to_stop(drill, "sigint", signal.SIGINT, times=2)


def dead_worker(drill: Drill) -> str:
    with started(drill.new("ppo", "worker", "--vec", "subproc")) as process:
        wait_for(process, "steps into")
        while not in_order(drill.folder / "worker" / "checkpoints"):
            time.sleep(0.01)
        os.kill(workers(process.pid)[0], signal.SIGKILL)
        printed, _ = process.communicate(timeout=SECONDS)
    expect(process.returncode == 2 and "--resume" in printed, printed)
    finish(["--resume", str(drill.folder / "worker")])
    same(drill.folder / "worker", drill.whole("ppo"))
    return f"{last_line(printed)}; resumed: the same files"


def workers(parent: int) -> list[int]:
    """Processes of a process group that run an environment."""
    listed = subprocess.run(
        ["ps", "-eo", "pid,pgid,args"], capture_output=True, text=True, check=True
    ).stdout
    rows = [line.split(None, 2) for line in listed.splitlines()[1:]]
    found = [int(pid) for pid, group, args in rows
             if int(group) == parent and int(pid) != parent
             and re.search(r"forkserver|spawn_main", args)]  # fmt: skip
    expect(found, "no worker process found")
    return found[-1:]


def failing_environment(drill: Drill) -> str:
    """A set that overflows, where that was to be an error, in mid-training."""
    args = drill.new(
        "ppo", "raises", "--observation.max-vehicles", "9", "--observation.on-overflow", "error"
    )
    printed = finish(args, code=2)
    expect("environment" in last_line(printed) and "episode" in last_line(printed), printed)
    return last_line(printed)


def diverging(drill: Drill) -> str:
    """A learning rate with which the weights become NaN or infinite."""
    printed = finish(drill.new("ppo", "nan", "--ppo.learning-rate", "1e38"), code=2)
    expect("finite" in printed or " nan" in printed or " inf" in printed, printed)
    expect(in_order(drill.folder / "nan" / "checkpoints"), "no checkpoint from before")
    return last_line(printed)


ROWS: dict[str, Callable[[Drill], str]] = {
    "SIGKILL, PPO": lambda drill: kills(drill, "ppo"),
    "SIGKILL, SAC": lambda drill: kills(drill, "sac"),
    "SIGTERM": sigterm,
    "SIGINT twice": sigint_twice,
    "truncated checkpoint": truncated,
    "flipped bit": flipped,
    "another version's checkpoint": other_version,
    "somebody else's checkpoint": somebody_elses,
    "disk full": disk_full,
    "no write permission": no_permission,
    "two processes in one directory": two_processes,
    "worker killed": dead_worker,
    "environment that raises": failing_environment,
    "learning that diverges": diverging,
}


def go_through(
    kills: int, ppo_steps: int, sac_steps: int, seed: int, only: Sequence[str]
) -> list[str]:
    """Do the rows (``only`` some, if any are named) and say how each ended; those that failed."""
    failed = []
    with tempfile.TemporaryDirectory(prefix="drill-") as folder:
        drill = Drill(Path(folder), random.Random(seed), kills, dict(ppo=ppo_steps, sac=sac_steps))
        for name, row in ROWS.items():
            if only and name not in only:
                continue
            try:
                said = row(drill)
            except (Failed, subprocess.TimeoutExpired) as failure:
                failed.append(name)
                said = f"FAILED: {failure}"
            say(f"{name}: {said}".replace(folder, "DIR"))
    say(f"Failed: {', '.join(failed)}" if failed else "Every row ended as it has to.")
    return failed
