"""Records a session: the control thread hands over what happened, a thread of its own writes it."""

from __future__ import annotations

import os
import queue
import threading
import time
from pathlib import Path
from typing import Any

from mild_viz.live.loop import Tick
from mild_viz.live.priority import HELPER, real_time
from mild_viz.live.session import open_session_file, tick_record, to_line

QUEUED = 600
"""Turns of the loop that may wait to be written: ten seconds at 60 Hz."""

SYNC_PERIOD = 1.0
"""Time between two requests that the system bring the file to the disk [s]: a power failure loses no more."""


class Recorder:
    """A witness of the control loop. If the disk fails or is too slow, recording stops and says so; control goes on.

    What is in the file is then whole up to there: a gap would be a session that never was.
    """

    def __init__(self, path: Path, header: dict[str, Any]) -> None:
        self._file = open_session_file(path, header)
        self._path = path
        self._queue: queue.SimpleQueue[Tick | None] = queue.SimpleQueue()
        self.trouble = ""
        """Why recording stopped; empty while all is well."""
        self.written = 0
        """Turns of the loop in the file."""
        self._thread = threading.Thread(target=self._work, name="mild_viz session", daemon=True)
        self._thread.start()

    def __call__(self, tick: Tick) -> None:
        """Hand over one turn of the loop. Neither waits nor raises."""
        if self.trouble:
            return
        if self._queue.qsize() >= QUEUED:
            self.trouble = f"recording to {self._path} stopped: the disk is too slow"
            return
        self._queue.put(tick)

    def close(self) -> None:
        """Write what is handed over, and end."""
        self._queue.put(None)
        self._thread.join(timeout=5.0)

    def _work(self) -> None:
        with real_time(HELPER):
            self._record()

    def _record(self) -> None:
        names, synced = None, time.monotonic()
        try:
            while (tick := self._queue.get()) is not None:
                self._write(to_line(tick_record(tick, names)))
                names = names if tick.seen is None else tick.seen.names
                self.written += 1
                if time.monotonic() - synced > SYNC_PERIOD:
                    os.fdatasync(self._file) if hasattr(os, "fdatasync") else os.fsync(self._file)
                    synced = time.monotonic()
        except OSError as error:
            self.trouble = f"recording to {self._path} stopped: {error.strerror or error}"
        except Exception as error:  # whatever it is, it must be seen
            self.trouble = f"recording to {self._path} stopped: {type(error).__name__}: {error}"
        finally:
            os.close(self._file)

    def _write(self, line: bytes) -> None:
        """One line, whole: on a full disk the system takes a part of it, which the reader leaves out."""
        if os.write(self._file, line) != len(line):
            raise OSError("the disk is full")
