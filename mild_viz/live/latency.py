"""How long the answer to a frame takes: the computing alone, and the whole way from its arrival."""

from __future__ import annotations

from array import array
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Times:
    """Quantiles [s]; NaN before the first answer."""

    median: float
    p99: float
    longest: float


NONE = Times(float("nan"), float("nan"), float("nan"))

SHOWN = 512
"""Answers that the figures on the page are made of."""


class Latency:
    """Times of all answers; two numbers each, so that a day takes 50 MB."""

    def __init__(self) -> None:
        self._computing = array("d")
        self._whole = array("d")

    def add(self, computing: float, whole: float) -> None:
        """Note the time [s] from taking a frame up to handing its command to the output, and from its arrival."""
        self._computing.append(computing)
        self._whole.append(whole)

    @property
    def count(self) -> int:
        return len(self._whole)

    def computing(self, last: int | None = None) -> Times:
        """Of the last so many answers, or of all."""
        return _times(self._computing, last)

    def whole(self, last: int | None = None) -> Times:
        """Of the last so many answers, or of all."""
        return _times(self._whole, last)


def _times(values: array[float], last: int | None) -> Times:
    if not len(values):
        return NONE
    chosen = np.array(values[-last:] if last else values)
    median, p99 = np.quantile(chosen, (0.5, 0.99))
    return Times(float(median), float(p99), float(chosen.max()))
