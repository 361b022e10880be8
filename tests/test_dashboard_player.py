"""The player moves the time cursor by the clock or by a person, and only while somebody watches."""

from __future__ import annotations

import asyncio
import time

import pytest

from mild_viz.dashboard.player import DOUBLE_TOGGLE, SPEEDS, Player


class Stage:
    """A player whose frames and ticks are kept."""

    def __init__(self, n_frames: int = 300, rate: float = 30.0) -> None:
        self.frames: list[int] = []
        self.ticks: list[tuple[int, bool]] = []
        self.watched = True
        self.player = Player(
            self.draw, lambda frame, playing: self.ticks.append((frame, playing)), lambda: self.watched
        )
        self.player.load(n_frames, rate, restart=True)

    def draw(self, frame: int) -> None:
        self.frames.append(frame)

    def play(self, seconds: float) -> None:
        async def run() -> None:
            task = asyncio.ensure_future(self.player.run())
            await asyncio.sleep(seconds)
            task.cancel()

        asyncio.run(run())


@pytest.mark.parametrize("speed", [0.5, 1.0, 2.0])
def test_playing_follows_the_clock(speed: float) -> None:
    stage = Stage()
    stage.player.speed = speed
    stage.player.toggle()
    stage.play(0.8)
    assert stage.player.frame == pytest.approx(0.8 * 30 * speed, abs=0.25 * 30 * speed + 1)
    assert stage.frames == sorted(set(stage.frames)), "no frame twice, none out of order"
    if speed == 1.0:
        assert max(b - a for a, b in zip(stage.frames, stage.frames[1:], strict=False)) <= 3


def test_the_scrub_bar_is_told_ten_times_a_second_at_most() -> None:
    stage = Stage()
    stage.player.toggle()
    stage.play(0.75)
    assert 3 <= len(stage.ticks) <= 9
    assert stage.ticks[-1][1]


def test_nothing_is_drawn_or_told_while_nothing_changes() -> None:
    stage = Stage()
    stage.play(0.3)
    assert stage.frames == [0] and stage.ticks == [(0, False)]


def test_time_stands_still_while_nobody_watches() -> None:
    stage = Stage()
    stage.player.toggle()
    stage.watched = False
    stage.play(0.3)
    assert stage.frames == [] and stage.player.frame == 0 and stage.player.playing


def test_loop_and_end() -> None:
    stage = Stage(n_frames=5)
    stage.player.toggle()
    stage.play(0.5)
    assert stage.player.playing and stage.frames.count(0) >= 2
    stage = Stage(n_frames=5)
    stage.player.loop = False
    stage.player.toggle()
    stage.play(0.5)
    assert not stage.player.playing and stage.player.frame == 4
    stage.player.toggle()
    assert stage.player.playing and stage.player.frame == 0, "play at the end starts again"


def test_steps_pause_and_stay_inside() -> None:
    player = Stage(n_frames=10).player
    player.toggle()
    player.step(1)
    assert not player.playing and player.frame == 1
    player.step(-5)
    assert player.frame == 0
    player.seek(99)
    assert player.frame == 9
    player.step(1)
    assert player.frame == 9


def test_playback_waits_while_the_bar_is_dragged() -> None:
    stage = Stage()
    stage.player.toggle()
    stage.player.scrub(100)
    stage.play(0.2)
    assert stage.player.playing and stage.player.frame == 100


def test_one_key_press_that_arrives_twice_toggles_once() -> None:
    player = Stage().player
    player.toggle()
    player.toggle()
    assert player.playing
    time.sleep(DOUBLE_TOGGLE * 1.5)
    player.toggle()
    assert not player.playing


def test_a_new_rollout_of_the_same_trial_keeps_the_frame() -> None:
    stage = Stage(n_frames=100)
    stage.player.seek(40)
    stage.player.load(100, 30.0, restart=False)
    assert stage.player.frame == 40
    stage.player.load(20, 30.0, restart=False)
    assert stage.player.frame == 19
    stage.player.load(100, 30.0, restart=True)
    assert stage.player.frame == 0


def test_a_frame_that_cannot_be_drawn_pauses_but_does_not_end_playback(caplog: pytest.LogCaptureFixture) -> None:
    stage = Stage()
    draw = stage.player._draw

    def fail_once(frame: int) -> None:
        stage.player._draw = draw
        raise RuntimeError("no picture")

    stage.player._draw = fail_once
    stage.player.toggle()
    stage.play(0.2)
    assert "could not be drawn" in caplog.text
    assert not stage.player.playing and stage.frames, "it went on after the failure"


def test_speeds_reach_from_a_tenth_to_four() -> None:
    assert min(SPEEDS.values()) == 0.1 and max(SPEEDS.values()) == 4.0
