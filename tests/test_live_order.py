"""Which frames of a stream are used: order, duplicates, restarts, clocks that jump, several senders."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mild_viz.live.messages import Observation
from mild_viz.live.order import REORDERING, SILENCE, Order

RATE = 60.0


def seen(
    sequence: int | None, timestamp: float, received: float = 0.0, source: str = "a", person: str | None = None
) -> Observation:
    return Observation(timestamp, received, sequence, source, ("right_wrist",), np.zeros((1, 3)), "person", person)


def verdicts(*frames: Observation) -> list[str]:
    order = Order()
    return [order.judge(each) for each in frames]


@pytest.mark.parametrize("numbered", [True, False])
def test_late_and_repeated_frames_are_not_used(numbered: bool) -> None:
    frames = [seen(number if numbered else None, number / RATE) for number in (0, 1, 3, 2, 3, 3, 4, 1, 5)]
    expected = ["new", "new", "new", "reordered", "duplicated", "duplicated", "new", "reordered", "new"]
    assert verdicts(*frames) == expected


@pytest.mark.parametrize("numbered", [True, False])
def test_several_late_frames_in_their_own_order_are_no_restart(numbered: bool) -> None:
    frames = [seen(number if numbered else None, number / RATE) for number in (0, 1, 20, 2, 3, 4, 5, 21)]
    assert verdicts(*frames) == ["new"] * 3 + ["reordered"] * 4 + ["new"]


def test_numbers_decide_where_the_clock_is_coarse_or_set_back() -> None:
    frames = [seen(1, 5.0), seen(2, 5.0), seen(3, 5.0), seen(4, -100.0), seen(5, -99.9), seen(6, 1e9)]
    assert verdicts(*frames) == ["new"] * 6


def test_timestamps_decide_between_equal_numbers() -> None:
    assert verdicts(seen(0, 1.0), seen(0, 1.1), seen(0, 1.05), seen(0, 1.1)) == [
        "new",
        "new",
        "reordered",
        "duplicated",
    ]


@pytest.mark.parametrize("numbered", [True, False])
def test_a_sender_that_starts_anew_loses_one_frame(numbered: bool) -> None:
    order = Order()
    before = [seen(number if numbered else None, 1000 + number / RATE) for number in range(500, 510)]
    after = [seen(number if numbered else None, number / RATE) for number in range(10)]  # its clock from zero, too
    assert [order.judge(each) for each in before + after] == ["new"] * 10 + ["reordered"] + ["new"] * 9
    assert order.restarts == 1


def test_a_sender_whose_clock_goes_on_may_count_anew() -> None:
    before = [seen(number, number / RATE) for number in range(500, 503)]
    after = [seen(number, 20 + number / RATE) for number in range(3)]
    assert verdicts(*before, *after) == ["new"] * 3 + ["reordered", "new", "new"]


@pytest.mark.parametrize("jump", [3600.0, -3600.0, 1.5, -1.5])
def test_a_clock_that_is_set_costs_a_frame_at_most(jump: float) -> None:
    before = [seen(None, 5000 + number / RATE) for number in range(10)]
    after = [seen(None, 5000 + jump + number / RATE) for number in range(10, 20)]
    expected = ["new"] * 10 if jump > 0 else ["reordered"] + ["new"] * 9
    assert verdicts(*before, *after) == ["new"] * 10 + expected


def test_one_stray_frame_does_not_count_as_a_restart() -> None:
    order = Order()
    frames = [seen(number, number / RATE) for number in range(1000)]
    stray = seen(2, 2 / RATE)
    stream = [*frames[900:950], stray, *frames[950:970], stray, stray, *frames[970:]]
    assert [order.judge(each) for each in stream].count("new") == 100
    assert order.restarts == 0


def test_the_first_sender_is_followed_until_it_is_silent() -> None:
    order = Order()
    assert order.judge(seen(10, 10.0, received=0.0)) == "new"
    assert order.follows_another("b", 0.5) and not order.follows_another("a", 0.5)
    assert order.judge(seen(1, 1.0, received=0.5, source="b")) == "foreign"
    assert order.judge(seen(11, 10.1, received=0.6)) == "new"
    assert order.judge(seen(2, 2.0, received=0.6 + SILENCE, source="b")) == "foreign"
    assert not order.follows_another("b", 0.7 + SILENCE)
    assert order.judge(seen(3, 3.0, received=0.7 + SILENCE, source="b")) == "new"
    assert order.judge(seen(12, 10.2, received=0.8 + SILENCE)) == "foreign"
    assert order.restarts == 1


def test_a_sender_that_only_repeats_itself_counts_as_silent() -> None:
    order = Order()
    for tick in range(200):
        assert order.judge(seen(10, 10.0, received=tick / RATE)) == ("duplicated" if tick else "new")
    assert order.judge(seen(0, 0.0, received=200 / RATE, source="b")) == "new"


def test_one_of_several_people_is_followed() -> None:
    order = Order()
    for number in range(5):
        assert order.judge(seen(2 * number, number / RATE, number / RATE, person="1")) == "new"
        assert order.judge(seen(2 * number + 1, number / RATE, number / RATE, person="2")) == "foreign"
    assert order.judge(seen(99, 3.0, received=3.0, person="2")) == "new"


NUMBERS = st.none() | st.integers(0, 2**53 - 1) | st.integers(0, 200)
TIMES = st.floats(-1e11, 1e11) | st.floats(0, 10)


@given(st.lists(st.tuples(NUMBERS, TIMES), max_size=12), NUMBERS, TIMES, st.booleans())
@settings(max_examples=300, deadline=None)
def test_a_steady_sender_is_heard_soon_whatever_was_before(
    before: list[tuple[int | None, float]], number: int | None, timestamp: float, again: bool
) -> None:
    """Nothing that was received can silence a sender for longer than the time in which late frames are told."""
    order, received = Order(), 0.0
    for earlier in before:
        order.judge(seen(*earlier, received=received))
        received += 1 / RATE
    judged = []
    for tick in range(int(REORDERING * RATE) + 10):
        # Timestamps far from zero are coarse: a step of 1/64 s is exact at any of them.
        each = seen(None if number is None else number % 2**50 + tick, round(timestamp) + tick / 64, received)
        judged.append(order.judge(each))
        received += 1 / RATE
    first = judged.index("new")
    assert first <= REORDERING * 64 + 2
    # At most once more does the count break off: where what is new by its number is old by its time.
    assert judged[first:].count("reordered") <= 1 and judged[-1] == "new"
