"""Which frame of a stream is the next one: order, restarts of a sender, several senders."""

from __future__ import annotations

from typing import Literal

from mild_viz.live.messages import Observation

SILENCE = 1.0
"""After so long without a usable frame of the sender that is followed, the next one is [s]."""

REORDERING = 1.0
"""A frame that is older than the last by no more than this came late [s]; beyond, the sender's clock jumped."""

Verdict = Literal["new", "duplicated", "reordered", "foreign"]


class Order:
    """Judges frames one by one, as they arrive.

    Newer is what has the greater sequence number; between equal ones, or where a frame has none, the later
    timestamp. What is not newer is a duplicate if both are the same as the last's, else it came late, and neither
    is used.
    That would silence a sender that starts anew, or whose clock is set back. So a frame that cannot be explained by
    late delivery (older by more than `REORDERING`, or a lower number at a later time) starts a new count, once the
    frame after it continues there: one frame is lost, and one stray datagram changes nothing.

    One person of one sender is followed, the first to send a usable frame. All else is foreign until it has sent
    none for `SILENCE`.
    """

    def __init__(self) -> None:
        self._last: Observation | None = None
        self._candidate: Observation | None = None
        self.restarts = 0
        """How often the count started anew, or the sender changed."""

    def follows_another(self, source: str, received: float) -> bool:
        """Whether a frame of this source is foreign, whatever is in it; known before it is decoded."""
        return self._last is not None and self._last.source != source and not self._silent(received)

    def judge(self, seen: Observation) -> Verdict:
        """What to do with a frame; 'new': use it."""
        last = self._last
        if last is None:
            return self._take(seen)
        if (seen.source, seen.person) != (last.source, last.person):
            if not self._silent(seen.received):
                return "foreign"
            self.restarts += 1
            return self._take(seen)
        if _newer(seen, last):
            return self._take(seen)
        if (seen.sequence, seen.timestamp) == (last.sequence, last.timestamp):
            return "duplicated"
        if self._candidate is not None and _newer(seen, self._candidate):
            self.restarts += 1
            return self._take(seen)
        self._candidate = seen if _breaks(seen, last) else None
        return "reordered"

    def _take(self, seen: Observation) -> Verdict:
        self._last, self._candidate = seen, None
        return "new"

    def _silent(self, received: float) -> bool:
        return self._last is None or received - self._last.received > SILENCE


def _newer(seen: Observation, last: Observation) -> bool:
    if seen.sequence is None or last.sequence is None or seen.sequence == last.sequence:
        return seen.timestamp > last.timestamp
    return seen.sequence > last.sequence


def _breaks(seen: Observation, last: Observation) -> bool:
    """Whether a frame that is not newer is no late one either."""
    behind = last.timestamp - seen.timestamp
    return behind > REORDERING or behind < 0
