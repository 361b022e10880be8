"""Frames at any rate become the model's; clocks that jump; the last check of a command."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mild_viz.live.guard import MOST_SECONDS, Guard
from mild_viz.live.latency import Latency
from mild_viz.live.pace import SHORTEST, Clock, Pace


def arm(time: float) -> np.ndarray:
    """A hand that moves at 1 m/s."""
    return np.full((3, 3), time)


@pytest.mark.parametrize("jitter", [0.0, 0.004])
def test_frames_at_the_models_rate_pass_as_they_are(jitter: float) -> None:
    rng = np.random.default_rng(0)
    pace = Pace(30.0, 0.1, 2.0)
    for frame in range(600):
        seen = arm(frame / 30.0)
        samples = pace.take(frame / 30.0 + jitter * rng.uniform(-1.0, 1.0), seen)
        assert len(samples) == 1 and samples[0] is seen


@pytest.mark.parametrize("rate", [20.0, 24.0, 29.0, 31.0, 45.0, 50.0, 60.0, 120.0])
def test_frames_at_other_rates_become_the_models(rate: float) -> None:
    pace = Pace(30.0, 0.1, 2.0)
    samples = [s[0, 0] for frame in range(round(20.0 * rate)) for s in pace.take(frame / rate, arm(frame / rate))]
    # a tracker that is a little slow or fast is followed, by up to 5 %
    assert len(samples) / 20.0 == pytest.approx(30.0, rel=0.035)
    # one hand at 1 m/s: the velocities that the model sees are a thirtieth of a metre a frame, as it was trained on
    assert np.mean(np.diff(samples)) == pytest.approx(1.0 / 30.0, rel=0.035)
    assert np.abs(np.diff(samples) - 1.0 / 30.0).max() < 0.6 / 30.0


def test_a_fast_tracker_gives_every_second_frame() -> None:
    pace = Pace(30.0, 0.1, 2.0)
    taken = [bool(pace.take(frame / 60.0, arm(frame / 60.0))) for frame in range(100)]
    assert taken == [frame % 2 == 0 for frame in range(100)]


def test_short_gaps_are_interpolated_and_long_ones_are_lost() -> None:
    pace = Pace(30.0, 0.1, 2.0)
    pace.take(0.0, arm(0.0))
    np.testing.assert_allclose([s[0, 0] for s in pace.take(0.1, arm(0.1))], [1 / 30, 2 / 30, 0.1])
    lost = pace.take(0.5, arm(0.5))
    assert len(lost) == 12 and all(np.isnan(sample).all() for sample in lost[:-1]) and lost[-1][0, 0] == 0.5
    assert len(pace.take(4000.0, arm(4000.0))) == 1, "after a pause the grid starts anew"


def test_a_clock_never_goes_back() -> None:
    clock = Clock(0.5)
    assert clock.time(100.0, 7.0) == 0.0
    assert clock.time(100.1, 7.11) == pytest.approx(0.1)
    assert clock.time(50.0, 7.2) == pytest.approx(0.19)  # set back: the time of arrival counts
    assert clock.time(50.1, 7.3) == pytest.approx(0.29)
    assert clock.time(9e9, 7.4) == pytest.approx(0.39)  # set forward
    assert clock.time(9e9, 7.4) == pytest.approx(0.39 + SHORTEST)
    assert clock.jumps == 3


finite = st.floats(-1e6, 1e6) | st.sampled_from([np.nan, np.inf, -np.inf])


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.lists(finite, min_size=3, max_size=3), st.floats(0.0, 10.0)), max_size=20))
def test_no_command_leaves_its_limits_whatever_is_asked_for(wanted: list[tuple[list[float], float]]) -> None:
    lower, upper, velocity = np.array([-1.0, 0.0, 0.5]), np.array([1.0, 2.0, 0.6]), np.array([1.0, 2.0, 0.5])
    guard, now, moved, last = Guard(lower, upper, velocity, np.array([0.0, 1.0, 0.55])), 0.0, 0.0, None
    for positions, passed in wanted:
        now += passed
        sent, stiffness = guard.check(np.array(positions), np.array(positions), now)
        assert ((lower <= sent) & (sent <= upper)).all() and ((stiffness >= 0.0) & (stiffness <= 1.0)).all()
        if last is not None:
            assert (np.abs(sent - last) <= velocity * min(now - moved, MOST_SECONDS) + 1e-8).all()
        if last is None or now - moved >= 1e-3:
            moved = now
        last = sent


def test_a_sound_command_passes_unchanged() -> None:
    guard = Guard(np.full(2, -1.0), np.full(2, 1.0), np.full(2, 3.0), np.zeros(2))
    for frame in range(10):
        asked = np.array([0.05, -0.05]) * frame
        sent, stiffness = guard.check(asked, np.full(2, 0.4), frame / 30.0)
        np.testing.assert_array_equal(sent, asked)
        np.testing.assert_array_equal(stiffness, 0.4)
    assert guard.refused == 0
    sent, _ = guard.check(np.array([5.0, np.nan]), np.ones(2), 10 / 30.0)
    assert guard.refused == 1 and sent[1] == -0.45 and sent[0] == pytest.approx(0.45 + 3.0 / 30.0)


def test_latencies_are_told_as_quantiles() -> None:
    latency = Latency()
    assert np.isnan(latency.whole().median)
    for i in range(1000):
        latency.add(1e-3, i * 1e-3)
    assert latency.count == 1000 and latency.computing().p99 == 1e-3
    assert latency.whole().median == pytest.approx(0.4995) and latency.whole(10).median == pytest.approx(0.9945)
    assert latency.whole().longest == 0.999
