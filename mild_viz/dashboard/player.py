"""Playback: one coroutine on viser's event loop moves the time cursor of whatever is shown."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Callable

MIN_PERIOD, MAX_PERIOD = 1.0 / 35.0, 1.0 / 30.0
"""Time between two looks at the clock [s]. In between, the player sleeps until the next frame is due, so that
a 30 Hz recording is drawn 30 times a second without a frame left out; fast playback leaves frames out."""
TICK_PERIOD = 0.1
"""Time between two updates of the scrub bar and the cursor [s]."""
SCRUB_HOLD = 0.4
"""How long playback waits after the scrub bar was moved [s], so that it does not run away under the mouse."""
DOUBLE_TOGGLE = 0.08
"""Two toggles within this time are one: Space on the focused Play button arrives as a key and as a click [s]."""

SPEEDS = {"0.1×": 0.1, "0.25×": 0.25, "0.5×": 0.5, "1×": 1.0, "2×": 2.0, "4×": 4.0}

log = logging.getLogger(__name__)


class Player:
    """The time cursor: frame `frame` of `n_frames`, moved by the clock or by a person.

    `draw(frame)` is called from the loop whenever the frame changed, `tick(frame, playing)` at most ten times a second
    when either changed. While nobody watches, time stands still.
    The methods may be called from any thread.
    """

    def __init__(
        self,
        draw: Callable[[int], object],
        tick: Callable[[int, bool], object],
        watched: Callable[[], bool],
        loop: bool = True,
    ) -> None:
        self._draw, self._tick, self._watched = draw, tick, watched
        self._lock = threading.Lock()
        self._position = 0.0
        self._held_until = self._last_toggle = float("-inf")
        self._drawn: int | None = None
        self._told: tuple[int, bool] | None = None
        self.n_frames = 1
        self.rate = 30.0
        self.loop = loop
        self.speed = 1.0
        self.playing = False

    @property
    def frame(self) -> int:
        return min(int(self._position), self.n_frames - 1)

    def load(self, n_frames: int, rate: float, restart: bool) -> None:
        """Play something else: `n_frames` at `rate` a second. The frame stays where it is unless `restart`."""
        with self._lock:
            self.n_frames, self.rate = max(n_frames, 1), rate
            self._position = 0.0 if restart else min(self._position, self.n_frames - 1.0)
            self._drawn = self._told = None

    def toggle(self) -> None:
        """Play or pause; at the end, play starts again from the first frame."""
        with self._lock:
            now = time.monotonic()
            if now - self._last_toggle < DOUBLE_TOGGLE:
                return
            self._last_toggle = now
            self.playing = not self.playing
            if self.playing and self.frame >= self.n_frames - 1:
                self._position = 0.0

    def step(self, frames: int) -> None:
        """Pause, and move by some frames."""
        with self._lock:
            self.playing = False
            self._move(self.frame + frames)

    def seek(self, frame: int) -> None:
        """Go to a frame; playback goes on from there."""
        with self._lock:
            self._move(frame)

    def scrub(self, frame: int) -> None:
        """Go to a frame while the scrub bar is dragged: playback waits until it is let go."""
        with self._lock:
            self._held_until = time.monotonic() + SCRUB_HOLD
            self._move(frame)

    def _move(self, frame: int) -> None:
        self._position = float(min(max(frame, 0), self.n_frames - 1))

    def _advance(self, seconds: float) -> None:
        with self._lock:
            if not self.playing or time.monotonic() < self._held_until:
                return
            position = self._position + seconds * self.rate * self.speed
            if position >= self.n_frames:
                # The last frame stays for as long as any other.
                self.playing = self.loop
                position = position % self.n_frames if self.loop else self.n_frames - 1.0
            self._position = position

    def _wait(self) -> float:
        """Time until the next frame is due [s]."""
        if not self.playing:
            return MAX_PERIOD
        due = (int(self._position) + 1 - self._position) / (self.rate * self.speed)
        return min(max(due, MIN_PERIOD), MAX_PERIOD)

    async def run(self) -> None:
        """Play for ever. Run it on viser's loop: a thread of its own would cost more and draw no smoother."""
        before = next_tick = time.monotonic()
        while True:
            await asyncio.sleep(self._wait())
            now = time.monotonic()
            elapsed, before = now - before, now
            if not self._watched():
                continue
            try:
                # A stall (a sleeping laptop) must not become a jump through the trial.
                self._advance(min(elapsed, 0.25))
                frame = self.frame
                if frame != self._drawn:
                    self._draw(frame)
                    self._drawn = frame
                if now >= next_tick and self._told != (frame, self.playing):
                    self._told, next_tick = (frame, self.playing), now + TICK_PERIOD
                    self._tick(frame, self.playing)
            except Exception:  # one bad frame must not end playback for good
                log.exception("playback: frame %d could not be drawn", self.frame)
                self.playing = False
