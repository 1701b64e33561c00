"""What processes that work for another one have in common."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from multiprocessing import get_context
from typing import Any

SPAWN = get_context("spawn")  # torch's threads do not survive a fork


def follow_parent(stopping: Any = None) -> None:
    """End with the parent process, even where it is killed: nobody would keep what is done.

    stopping: an event of the parent's, upon which this process gets SIGINT.
    """
    threading.Thread(target=_follow, args=(stopping,), daemon=True).start()


def _follow(stopping: Any) -> None:
    parent: Any = multiprocessing.parent_process()
    while parent.is_alive():
        if stopping is None:
            parent.join()
        elif stopping.wait(0.5):
            os.kill(os.getpid(), signal.SIGINT)
            parent.join()
    os._exit(1)
