"""What the child processes of the program have in common."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal

PR_SET_PDEATHSIG = 1
"""Option of prctl(2): the signal that a process gets when its parent ends."""


def end_with_parent() -> None:
    """Let the kernel end this process with its parent, also where that is killed in the middle of a task."""
    with contextlib.suppress(OSError, AttributeError):  # Linux has it; elsewhere the closed pipe ends the process later
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, int(signal.SIGKILL))


def usable_processors() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, 'sched_getaffinity'):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
