"""The control loop: it goes on whatever happens around it, and nothing reaches it."""

from __future__ import annotations

import gc
import os
import sys
import time
from dataclasses import replace
from itertools import count

import numpy as np
import pytest
from live_streams import ListInput, ListOutput, demo_model, stream

from mild_viz.data.load import load_dataset
from mild_viz.live.config import LiveConfig
from mild_viz.live.controller import STOPPED, LiveController
from mild_viz.live.loop import FAULT, LiveLoop, Tick
from mild_viz.live.messages import JointCommand, Observation
from mild_viz.live.onset import INTERACTING
from mild_viz.live.priority import CONTROL, real_time
from mild_viz.live.setup import make_guard, warm_up
from mild_viz.streaming import StreamModel

HANDSHAKE = 4


@pytest.fixture(scope="module")
def model() -> StreamModel:
    model = demo_model()
    warm_up(model, LiveConfig())
    return model


@pytest.fixture
def frames() -> list[Observation]:
    return stream(load_dataset("demo").test[HANDSHAKE])


def make_loop(model: StreamModel, source: ListInput, *witnesses: object) -> tuple[LiveLoop, list[JointCommand]]:
    output = ListOutput()
    loop = LiveLoop(
        LiveController(model, LiveConfig()),
        source,
        output,
        make_guard(model),
        tuple(witnesses),  # pyright: ignore
    )
    return loop, output.sent


def never() -> bool:
    return False


def test_every_frame_is_answered_and_the_arm_ends_at_rest(model: StreamModel, frames: list[Observation]) -> None:
    ticks: list[Tick] = []
    loop, sent = make_loop(model, ListInput(frames), ticks.append)
    loop.run(never)
    assert loop.latency.count == len(frames) and loop.faults == 0 and loop.guard.refused == 0
    assert [command.sequence for command in sent] == list(range(1, len(sent) + 1))
    assert {command.joint_names for command in sent} == {model.robot.chain.joint_names}
    assert {command.phase for command in sent} >= {"calibrating", "waiting", "interacting", "returning"}
    np.testing.assert_allclose(sent[-1].positions, model.controller.limits.rest, atol=0.01)
    answers = [tick for tick in ticks if tick.sent is not None and tick.seen is not None]
    for tick in answers:
        assert tick.sent is not None and tick.seen is not None and tick.sent.observed == tick.seen.timestamp
        assert 0.0 < tick.computing <= tick.whole
    assert all(command.observed is None for command in sent[len(frames) :])


@pytest.mark.parametrize("where", ["controller", "output", "witness", "input"])
def test_a_fault_of_our_own_holds_the_arm_and_ends_nothing(
    model: StreamModel, frames: list[Observation], where: str, monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    turns = count()

    def fail(*_: object) -> None:
        if 80 <= next(turns) < 83:  # in contact
            raise RuntimeError("made to fail")

    source = ListInput(frames)
    loop, sent = make_loop(model, source, fail if where == "witness" else lambda _: None)
    target, name = {
        "controller": (loop.controller, "observe"), "output": (loop.output, "send"), "input": (source, "poll"),
        "witness": (loop, "faults"),
    }[where]  # fmt: skip
    if where != "witness":
        original = getattr(target, name)

        def failing(*arguments: object) -> object:
            fail()
            return original(*arguments)

        monkeypatch.setattr(target, name, failing)
    loop.run(never)
    assert loop.faults == 3 and loop.last_fault == "RuntimeError: made to fail"
    assert sum("fault in the control loop" in record.message for record in caplog.records) == 3
    held = [n for n, command in enumerate(sent) if FAULT in command.fired]
    assert len(held) == (3 if where == "controller" else 0)
    for n in held:
        np.testing.assert_array_equal(sent[n].positions, sent[n - 1].positions)
        np.testing.assert_array_equal(sent[n].stiffness, sent[n - 1].stiffness)
        assert sent[n].contact and sent[n - 1].contact and sent[n].stiffness.max() < 1.0
        assert sent[n].observed is None
    assert len(sent) > 150 and np.isfinite([command.positions for command in sent]).all()
    np.testing.assert_allclose(sent[-1].positions, model.controller.limits.rest, atol=0.01)


def test_a_broken_model_never_reaches_the_robot(
    model: StreamModel, frames: list[Observation], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the chain commands, what leaves is within the robot's own limits, and no faster than its joints are."""
    loop, sent = make_loop(model, ListInput(frames[:100], pause=0.002))
    rng, original = np.random.default_rng(0), loop.controller.observe

    def wild(seen: Observation, now: float) -> object:
        decision = original(seen, now)
        if decision is None:
            return None
        joints = rng.choice([np.nan, np.inf, -1e9, 1e9, 0.3], 4)
        return replace(decision, command=decision.command._replace(joints_commanded=joints, stiffness=joints))

    monkeypatch.setattr(loop.controller, "observe", wild)
    loop.run(never)
    chain, positions = model.robot.chain, np.array([command.positions for command in sent])
    assert loop.guard.refused > 90
    assert (positions >= chain.lower).all() and (positions <= chain.upper).all()
    stiffness = np.array([command.stiffness for command in sent])
    assert (stiffness >= 0.0).all() and (stiffness <= 1.0).all()
    times = np.array([command.timestamp for command in sent])
    fastest = np.abs(np.diff(positions, axis=0)) / np.maximum(np.diff(times), 1e-3)[:, None]
    assert np.median(fastest.max(1)) < 1.3 * model.controller.limits.velocity.max()


def test_when_frames_stop_the_arm_holds_and_later_rests(model: StreamModel, frames: list[Observation]) -> None:
    silence = [None] * 75  # 2.5 s
    loop, sent = make_loop(model, ListInput([*frames[:80], *silence, *frames[:10]], pause=0.01))
    started = time.perf_counter()
    loop.run(never)
    assert loop.controller.interaction == 1 and loop.controller.counts.held >= 60
    alone = [command for command in sent if command.observed is None]
    assert {"stale"} <= set().union(*(command.fired for command in alone))
    assert {command.phase for command in alone} >= {"interacting", "returning"}
    assert "person is gone" in loop.controller.tracker.reason
    # a period apart, as they would come
    assert len(alone) / (time.perf_counter() - started) < 40.0


def test_no_garbage_is_collected_while_interacting(model: StreamModel, frames: list[Observation]) -> None:
    phases, collections = [], []
    loop, _ = make_loop(model, ListInput(frames), lambda tick: phases.append(loop.controller.tracker.phase))

    def note(phase: str, _info: object) -> None:
        if phase == "start":
            collections.append(loop.controller.tracker.phase)

    gc.callbacks.append(note)
    interval = sys.getswitchinterval()
    try:
        loop.run(never)
    finally:
        gc.callbacks.remove(note)
    assert INTERACTING in phases and INTERACTING not in collections
    assert len(collections) >= 2, "before, and after the interaction"
    assert gc.isenabled() and sys.getswitchinterval() == interval


@pytest.mark.skipif(not hasattr(os, "sched_getscheduler"), reason="the system has no such priorities")
def test_priority_is_raised_where_we_may_and_given_back(monkeypatch: pytest.MonkeyPatch) -> None:
    before = os.sched_getscheduler(0)
    with real_time(CONTROL) as raised:
        now = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
        assert now == (os.SCHED_FIFO if raised else before)
    assert os.sched_getscheduler(0) == before

    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with real_time(CONTROL) as raised:
        assert not raised and os.sched_getscheduler(0) == before


def test_it_stops_when_told_and_after_its_time(model: StreamModel, frames: list[Observation]) -> None:
    loop, sent = make_loop(model, ListInput([None] * 10_000))
    started = time.perf_counter()
    loop.run(never, duration=0.5)
    assert 0.4 < time.perf_counter() - started < 2.0 and len(sent) > 5
    turns = count()
    loop, sent = make_loop(model, ListInput(frames, pause=0.005))
    loop.run(lambda: next(turns) > 75)
    assert loop.controller.tracker.reason == STOPPED
    assert 75 < len(sent) < 180, "the arm goes to rest first"
    np.testing.assert_allclose(sent[-1].positions, model.controller.limits.rest, atol=0.01)
