"""What is decided on each observation: equal to the stream, within limits whatever comes, and the same again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from live_streams import RATE, demo_model, observe, stream

from mild_viz import streaming
from mild_viz.checkpoint import load_checkpoint
from mild_viz.data.load import load_dataset
from mild_viz.data.skeletons import ARM_JOINTS, to_frame, to_world
from mild_viz.live.config import LiveConfig
from mild_viz.live.controller import Decision, LiveController
from mild_viz.live.messages import Observation
from mild_viz.live.onset import CALIBRATING, INTERACTING, RETURNING, WAITING
from mild_viz.live.setup import choose_action, choose_dataset, live_placement, rested
from mild_viz.paths import default_checkpoint
from mild_viz.pipeline import control, infer
from mild_viz.robot.control.rules import fired_rules
from mild_viz.robot.model import load_robot
from mild_viz.settings import ControlSettings
from mild_viz.streaming import StreamModel
from mild_viz.trial import Trial

HANDSHAKE = 4


@pytest.fixture(scope="module")
def model() -> StreamModel:
    return demo_model()


@pytest.fixture(scope="module")
def handshake() -> Trial:
    return load_dataset("demo").test[HANDSHAKE]


def play(controller: LiveController, frames: list[Observation]) -> list[Decision | None]:
    return [controller.observe(seen, seen.received + 1e-4) for seen in frames]


def test_phases_follow_one_another_and_the_robot_is_at_rest_at_both_ends(model: StreamModel, handshake: Trial) -> None:
    controller = LiveController(model, LiveConfig())
    decisions = [each for each in play(controller, stream(handshake)) if each is not None]
    phases = [each.phase for each in decisions]
    order = [phases.index(phase) for phase in (CALIBRATING, WAITING, INTERACTING, RETURNING)]
    assert order == sorted(order) and len(decisions) == handshake.n_frames
    rest = model.controller.limits.rest
    for each in decisions[: order[2]]:
        np.testing.assert_array_equal(each.command.joints_commanded, rest)
        assert not each.command.contact and each.command.fired == 0
    moved = np.array([each.command.joints_commanded for each in decisions])
    assert np.abs(moved - rest).max() > 0.5 and any(each.command.contact for each in decisions)
    now = handshake.n_frames / RATE
    while controller.tracker.phase == RETURNING:
        controller.tick(now := now + 1 / RATE)
    assert controller.at_rest


@pytest.mark.parametrize("variant", ["v3.1", "v4"])
def test_live_gives_the_commands_of_the_stream(variant: str, handshake: Trial) -> None:
    """From the start on, the loop is nothing but `streaming.step` over the frames from `lead` before it."""
    model, config = demo_model(variant), LiveConfig().for_dataset("demo")
    frames = stream(handshake)
    decisions = play(LiveController(model, config), frames)
    start = next(n for n, each in enumerate(decisions) if each is not None and each.phase == INTERACTING)
    first = max(start - config.lead_frames(model.rate) + 1, 0)
    carry = streaming.start(model)
    rest = carry.control
    for n in range(first, start):
        carry, _ = streaming.step(model, carry, frames[n].positions)
    carry = carry._replace(control=carry.control.paused(rest))
    for n in range(start, handshake.n_frames):
        decision = decisions[n]
        assert decision is not None
        if decision.phase != INTERACTING:
            break
        seconds = frames[n].received - frames[n - 1].received
        carry, command = streaming.step(model, carry, frames[n].positions, seconds)
        assert command is not None
        for name, got, expected in zip(command._fields, decision.command, command, strict=True):
            np.testing.assert_allclose(got, expected, rtol=0, atol=1e-9, err_msg=f"{name} at {n}")
    assert n - start > 80


def test_live_gives_what_the_pipeline_gives(model: StreamModel, handshake: Trial) -> None:
    """The filter begins `lead` before the start, not with the trial, and the arm at rest: both are soon forgotten."""
    checkpoint, robot = load_checkpoint(default_checkpoint("demo")), load_robot("pepper")
    trial = replace(handshake, T_world_human=None, T_world_partner=None)  # live, nobody knows where the partner stood
    rollout = control(infer(checkpoint, trial, "v3.1"), checkpoint, robot, trial, ControlSettings())
    decisions = play(LiveController(model, LiveConfig()), stream(trial))
    rows = [(n, each.command) for n, each in enumerate(decisions) if each is not None and each.phase == INTERACTING]
    alpha = [
        np.abs(np.exp(each.log_alpha) - np.exp(rollout.inference.log_alpha_human[n - 4])).max() for n, each in rows
    ]
    joints = [np.abs(each.joints_commanded - rollout.joints_commanded[n - 4]).max() for n, each in rows]
    decoded = [np.abs(each.joints_decoded - rollout.inference.joints_decoded[n - 4]).max() for n, each in rows]
    assert max(alpha[5:]) < 1e-6 and max(decoded[5:]) < 1e-6
    assert joints[0] > 0.1 and max(joints[15:]) < 1e-6, "after half a second the arm is where it would be"


def test_frames_at_60_hz_give_nearly_the_same_as_at_30(model: StreamModel, handshake: Trial) -> None:
    arm = handshake.human_arm
    double = np.empty((2 * len(arm) - 1, 3, 3))
    double[::2], double[1::2] = arm, 0.5 * (arm[:-1] + arm[1:])
    fast = LiveController(model, LiveConfig())
    frames = [observe(each, n, period=1 / 60.0) for n, each in enumerate(double)]
    quick = {n // 2: each for n, each in enumerate(play(fast, frames)) if each is not None}
    slow = play(LiveController(model, LiveConfig()), stream(handshake))
    assert fast.counts.frames == len(double) and fast.counts.answered in (len(arm), len(arm) + 1)
    both = [
        (quick[n].command, each.command) for n, each in enumerate(slow)
        if n in quick and each is not None and each.phase == quick[n].phase == INTERACTING
    ]  # fmt: skip
    assert len(both) > 80
    assert np.median([np.abs(a.joints_decoded - b.joints_decoded).max() for a, b in both]) < 1e-9


def test_a_person_in_world_coordinates_gives_the_same(model: StreamModel, handshake: Trial) -> None:
    T = handshake.T_world_human
    body = handshake.human_skeleton
    assert T is not None and body is not None
    controller = LiveController(model, LiveConfig())
    decisions = []
    for n, positions in enumerate(body.positions):
        seen = observe(to_world(T, positions), n, names=body.joint_names, coordinates="world", clock=1e9)
        decisions.append(controller.observe(seen, seen.received))
    alone = play(LiveController(model, LiveConfig()), stream(handshake))
    both = [(a, b) for a, b in zip(decisions, alone, strict=True) if a and b and a.phase == b.phase == INTERACTING]
    assert len(both) > 80 and controller.trouble == ""
    found = both[0][0].T_world_person
    assert found is not None and np.abs(found - T).max() < 0.03  # the mean of a second, not the first frame
    apart = [np.abs(a.command.joints_decoded - b.command.joints_decoded).max() for a, b in both]
    assert np.median(apart) < 0.03
    np.testing.assert_allclose(both[0][0].samples[-1], to_frame(found, to_world(T, both[0][1].samples[-1])), atol=1e-9)


def test_world_coordinates_without_a_trunk_say_what_is_missing(model: StreamModel, handshake: Trial) -> None:
    controller = LiveController(model, LiveConfig())
    for n, arm in enumerate(handshake.human_arm):
        decision = controller.observe(observe(arm, n, coordinates="world"), n / RATE)
        assert decision is not None and decision.phase != INTERACTING
    assert "shoulders" in controller.trouble and controller.interaction == 0


def test_a_pause_holds_then_returns_and_a_new_person_is_calibrated(model: StreamModel, handshake: Trial) -> None:
    controller, config = LiveController(model, LiveConfig()), LiveConfig()
    frames = stream(handshake)
    for seen in frames[:70]:
        controller.observe(seen, seen.received)
    assert controller.tracker.phase == INTERACTING
    now, before = frames[69].received, controller.carry.control.joints.copy()
    held = [controller.tick(now + step / RATE) for step in range(3, 20)]
    assert {each.phase for each in held} == {INTERACTING} and all(not each.answers for each in held)
    assert "stale" in {rule.name for rule in fired_rules(held[-1].command.fired)}
    assert np.abs(held[-1].command.joints_commanded - before).max() < 0.3, "it stops where it is"
    for seen in frames[90:100]:  # 0.7 s later: the model goes on as after a gap in a recording
        decision = controller.observe(seen, seen.received)
        assert decision is not None and decision.answers and decision.phase == INTERACTING
    assert controller.interaction == 1
    now = frames[99].received
    away = [controller.tick(now + step / RATE) for step in range(1, round((config.gone_after + 4) * RATE))]
    assert "person is gone" in next(each.note for each in away if each.phase == RETURNING)
    assert controller.at_rest and controller.tracker.phase == CALIBRATING


def test_frames_after_a_gap_match_a_recording_with_that_gap(model: StreamModel, handshake: Trial) -> None:
    gap = slice(60, 70)
    frames = stream(handshake)
    controller = LiveController(model, LiveConfig())
    live = {n: controller.observe(frames[n], frames[n].received) for n in range(100) if not 60 <= n < 70}
    arm = handshake.human_arm.copy()
    arm[gap] = np.nan
    other = LiveController(model, LiveConfig())
    recorded = play(other, stream(replace(handshake, human_arm=arm))[:100])
    for n in range(75, 100):
        a, b = live[n], recorded[n]
        assert a is not None and b is not None and a.phase == INTERACTING
        np.testing.assert_allclose(a.command.log_alpha, b.command.log_alpha, atol=1e-9)
        np.testing.assert_allclose(a.command.joints_decoded, b.command.joints_decoded, atol=1e-9)


def test_old_frames_and_clock_jumps_are_counted(model: StreamModel, handshake: Trial) -> None:
    controller = LiveController(model, LiveConfig())
    for n, seen in enumerate(stream(handshake)[:60]):
        late = 0.2 if n == 50 else 0.0
        jumped = replace(seen, timestamp=seen.timestamp + (1e6 if n >= 30 else 0.0))
        decision = controller.observe(jumped, seen.received + late)
        assert (decision is None) == (n == 50)
    assert controller.counts.stale == 1 and controller.clock.jumps == 1
    assert controller.tracker.phase == INTERACTING


number = st.floats(-100.0, 100.0) | st.just(float("nan"))


@settings(max_examples=20, deadline=None)
@given(data=st.data(), seed=st.integers(0, 2**32 - 1))
def test_whatever_comes_commands_stay_within_limits_and_rates(data: st.DataObject, seed: int) -> None:
    """Real reaches with wild frames, pauses, jumps of clocks and untracked joints strewn in."""
    model = MODEL
    controller, rng = LiveController(model, LiveConfig()), np.random.default_rng(seed)
    arm, limits = load_dataset("demo").test[HANDSHAKE].human_arm, model.controller.limits
    now, last, sent = 0.0, limits.rest, 0.0
    for n in range(data.draw(st.integers(60, 110))):
        now += float(rng.choice([1 / 30, 1 / 60, 0.01, 0.3, 1e-4], p=[0.8, 0.1, 0.04, 0.03, 0.03]))
        positions = arm[min(n, len(arm) - 1)].copy()
        kind = rng.choice(5, p=[0.85, 0.05, 0.04, 0.03, 0.03])
        if kind == 1:
            positions = rng.uniform(-100.0, 100.0, (3, 3))
        elif kind == 2:
            positions[rng.integers(3)] = np.nan
        elif kind == 3:
            positions += rng.normal(0.0, 1.0, 3)
        if kind == 4:
            decision = controller.tick(now)
        else:
            jump = float(rng.choice([0.0, 1e6, -1e6], p=[0.98, 0.01, 0.01]))
            decision = controller.observe(Observation(now + jump, now, n, "x", ARM_JOINTS, positions, "person"), now)
        if decision is None:
            continue
        joints = decision.command.joints_commanded
        if now - sent < 1e-3:
            assert np.array_equal(joints, last), "too soon: the last command again"
            continue
        assert np.isfinite(joints).all() and (limits.lower <= joints).all() and (joints <= limits.upper).all()
        assert (np.abs(joints - last) <= limits.velocity * min(now - sent, 0.2) + 1e-9).all()
        last, sent = joints, now


MODEL = demo_model()


def test_what_is_run_follows_from_what_is_replayed(handshake: Trial) -> None:
    checkpoint = load_checkpoint(default_checkpoint("demo"))
    assert choose_dataset(None, "replay:nuisi/3") == "nuisi" and choose_dataset(None, "udp://127.0.0.1:1") == "demo"
    assert choose_dataset("yumi", "replay:nuisi/3") == "yumi"
    assert choose_action(None, "replay:demo/0", checkpoint) == "wave"
    assert choose_action(None, "udp://127.0.0.1:1", checkpoint) == "handshake"
    assert rested("replay:demo/0") == "replay:demo/0?rest=1"
    assert rested("replay:demo/0?speed=2") == "replay:demo/0?speed=2&rest=1"
    assert rested("replay:demo/0?rest=0") == "replay:demo/0?rest=0" and rested("udp://a:1") == "udp://a:1"


def test_a_model_without_a_placement_gets_one_from_the_reach() -> None:
    checkpoint, robot = load_checkpoint(default_checkpoint("yumi")), load_robot("yumi")
    placement = live_placement(checkpoint, robot, ControlSettings())
    assert 0.6 < placement.distance < 1.6 and "assumed" in placement.source
