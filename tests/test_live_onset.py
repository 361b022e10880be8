"""When an interaction begins and ends, on every trial at hand and on made-up hands; the thresholds' file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from mild_viz.data.demo import joint_noise
from mild_viz.data.load import load_dataset
from mild_viz.errors import UserError
from mild_viz.live.config import LiveConfig, read_live_config
from mild_viz.live.onset import CALIBRATING, INTERACTING, RETURNING, WAITING, PhaseTracker
from mild_viz.settings import Watch

RATE = 30.0


def follow(hands: np.ndarray, tracker: PhaseTracker | None = None, start: float = 0.0) -> list[str]:
    tracker = tracker or PhaseTracker(LiveConfig())
    return [tracker.update(start + frame / RATE, hand) for frame, hand in enumerate(hands)]


def resting(seconds: float) -> np.ndarray:
    return np.zeros((round(seconds * RATE), 3))


def at(distance: float, seconds: float) -> np.ndarray:
    return resting(seconds) + [distance, 0.0, 0.0]


def test_every_demo_trial_starts_with_the_hand_and_ends_with_it() -> None:
    data = load_dataset("demo")
    for trial in data.train[::2] + data.test:
        phases = follow(trial.human_arm[:, 2])
        assert trial.phase is not None
        leaves, back = np.argmax(trial.phase > 0), len(trial.phase) - np.argmax(trial.phase[::-1] > 0)
        start, end = phases.index(INTERACTING), phases.index(RETURNING)
        assert 0 < start - leaves <= 15, trial.name  # frames: half a second, of which 0.2 are the median
        assert -1 <= end - back <= 9, trial.name


def test_every_nuisi_trial_starts_after_the_hand_moves(dataset: Callable[[str], object]) -> None:
    data = dataset("nuisi")
    for trial in data.train + data.test:  # pyright: ignore[reportAttributeAccessIssue]
        hand = trial.human_arm[:, 2]
        rest = np.repeat(hand[:1], 30, axis=0) + 0.002 * np.random.default_rng(trial.index).standard_normal((30, 3))
        phases = follow(np.concatenate([rest, hand]))
        start = phases.index(INTERACTING) - 30
        away = np.linalg.norm(hand - hand[0], axis=1)
        assert start > 0 and away[: start + 1].max() > 0.02, trial.name
        assert start <= np.argmax(away > 0.1) + 3, trial.name


def test_a_resting_hand_with_tracking_error_starts_nothing() -> None:
    noise = joint_noise(np.random.default_rng(3), 4500)[:, 0]
    for joint in range(0, 20, 4):
        assert INTERACTING not in follow(noise[:, joint])


def test_calibration_waits_for_a_hand_that_rests() -> None:
    moving = np.linspace(0.0, 0.5, 45)[:, None] * [1.0, 0.0, 0.0]  # 0.33 m/s
    phases = follow(np.concatenate([moving, np.repeat(moving[-1:], 30, axis=0)]))
    assert set(phases[:45]) == {CALIBRATING}
    assert 45 <= phases.index(WAITING) <= 45 + 16


def test_one_wrong_frame_and_lost_frames_start_nothing() -> None:
    hands = resting(3.0)
    hands[40] = 0.3
    hands[50:55] = np.nan
    hands[56:60:2] = 0.3
    assert INTERACTING not in follow(hands)
    hands[70:72] = 0.3
    assert INTERACTING in follow(hands)


def test_a_slow_shift_of_weight_is_followed() -> None:
    shift = np.linspace(0.0, 0.1, round(60.0 * RATE))[:, None] * [0.0, 1.0, 0.0]
    tracker = PhaseTracker(LiveConfig())
    assert INTERACTING not in follow(np.concatenate([resting(1.0), shift]), tracker)
    assert tracker.rest is not None and 0.07 < tracker.rest[1] < 0.1


def test_the_interaction_ends_where_the_hand_comes_back_or_stays_still() -> None:
    tracker = PhaseTracker(LiveConfig())
    phases = follow(np.concatenate([resting(1.0), at(0.4, 3.0), at(0.05, 1.0)]), tracker)
    # still for two seconds away from rest: that is where the arm hangs now
    assert phases.index(RETURNING) == pytest.approx(30 + 60, abs=3) and "rest" in tracker.reason
    wave = at(0.4, 4.0) + 0.2 * np.sin(np.arange(120) / 3.0)[:, None]
    tracker = PhaseTracker(LiveConfig())
    phases = follow(np.concatenate([resting(1.0), wave, at(0.05, 1.0)]), tracker)
    assert phases.index(RETURNING) == pytest.approx(150 + 9, abs=2) and tracker.reason == "the hand is back"


def test_nothing_ends_early_and_nothing_lasts_for_ever() -> None:
    config = LiveConfig(longest=5.0)
    tracker = PhaseTracker(config)
    phases = follow(np.concatenate([resting(1.0), at(0.03, 3.0)]), tracker)
    assert phases.index(RETURNING) - phases.index(INTERACTING) == pytest.approx(config.shortest * RATE, abs=1)
    tracker = PhaseTracker(config)
    restless = at(0.4, 8.0) + 0.2 * np.sin(np.arange(240) / 3.0)[:, None]
    phases = follow(np.concatenate([resting(1.0), restless]), tracker)
    assert phases.index(RETURNING) - phases.index(INTERACTING) == pytest.approx(5.0 * RATE, abs=1)


def test_after_the_return_the_hand_is_calibrated_again() -> None:
    tracker = PhaseTracker(LiveConfig())
    follow(np.concatenate([resting(1.0), at(0.4, 0.5)]), tracker)
    assert tracker.phase == INTERACTING
    tracker.rested()  # of no meaning while it goes on
    assert tracker.phase == INTERACTING
    tracker.end("the person is gone")
    assert tracker.phase == RETURNING and follow(at(0.0, 2.0), tracker, 2.0)[-1] == RETURNING
    tracker.rested()
    assert tracker.phase == CALIBRATING and tracker.rest is None
    assert follow(at(0.2, 1.0), tracker, 5.0)[-1] == WAITING


def test_the_file_of_thresholds_is_read_strictly(tmp_path: Path) -> None:
    file = tmp_path / "live.toml"
    file.write_text("start_displacement = 0.05\ncalibration = 1\n")
    assert read_live_config(file) == LiveConfig(start_displacement=0.05, calibration=1.0)
    for text, message in (
        ("start_displacment = 0.05", "did you mean 'start_displacement'"),
        ('calibration = "long"', "calibration is 'long', expected a finite number"),
        ("calibration = 0", "calibration is 0.0; valid: a finite number above 0"),
        ("calibration = nan", "calibration"),
        ("gone_after = 0.05", "valid: above bridge"),
        ("gone_after = 0.2", "max_age"),
        ("calibration", "is not valid TOML"),
    ):
        file.write_text(text)
        with pytest.raises(UserError, match=message) as caught:
            read_live_config(file)
        assert str(file) in str(caught.value)
    with pytest.raises(UserError, match="cannot be read"):
        read_live_config(tmp_path / "none.toml")


def test_what_is_watched_has_one_default() -> None:
    assert LiveConfig().watch == Watch()


def test_every_threshold_says_its_unit() -> None:
    text = Path(LiveConfig.__module__.replace(".", "/")).with_suffix(".py")
    source = (Path(__file__).parents[1] / text).read_text()
    for field in fields(LiveConfig):
        after = source.split(f"    {field.name}: ", 1)[1].split('"""')[1]
        assert any(unit in after for unit in ("[s]", "[m]", "[m/s]", "[Hz]")), field.name
