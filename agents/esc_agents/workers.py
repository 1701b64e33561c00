"""What processes that work for another one have in common."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any

SPAWN = get_context("spawn")  # torch's threads do not survive a fork


_stopping: Any = None  # the event of ``follow_parent``


@contextmanager
def out_of_reach() -> Iterator[None]:
    """Processes that begin in here never get Ctrl-C, which reaches a whole group of processes.

    Nor while they still import; this process gets it afterwards.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def follow_parent(stopping: Any = None) -> None:
    """End with the parent process, even where it is killed: nobody would keep what is done.

    stopping: an event of the parent's, which it sets when this process is to stop.
    """
    global _stopping
    _stopping = stopping
    threading.Thread(target=_follow, daemon=True).start()


def asked_to_stop() -> bool:
    """Whether the parent process wants this one to come to an end."""
    return _stopping is not None and _stopping.is_set()


def _follow() -> None:
    parent: Any = multiprocessing.parent_process()
    parent.join()
    os._exit(1)
