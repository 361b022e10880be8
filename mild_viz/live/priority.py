"""Priority of a thread, where the system grants it: on a busy machine it decides on the latency.

With two cores and eight busy processes, 99 % of sleeps of 1/60 s were late by up to 14 ms without, and by 0.06 ms with
it. It takes root, the capability CAP_SYS_NICE, or a limit (`rtprio` in /etc/security/limits.conf); without, nothing
changes. Linux leaves other programs 5 % of the time even if such a thread never slept, and ours sleeps nearly always.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

CONTROL, HELPER = 10, 5
"""Of the control thread, and of those that write for it: one that is held up with the interpreter holds it up."""


@contextmanager
def real_time(level: int) -> Iterator[bool]:
    """Run this thread before all ordinary ones, if we may; gives whether that is so. What it starts is ordinary."""
    if not hasattr(os, "sched_setscheduler"):
        yield False
        return
    before, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(level))
    except OSError:
        yield False
        return
    try:
        yield True
    finally:
        os.sched_setscheduler(0, before, parameters)
