"""The stream between and after observations: what is sent when none comes, and what a pause leaves behind."""

from __future__ import annotations

import numpy as np
import pytest

from mild_viz import streaming
from mild_viz.checkpoint import Checkpoint, load_checkpoint
from mild_viz.data.load import load_dataset
from mild_viz.errors import UserError
from mild_viz.paths import default_checkpoint
from mild_viz.robot.control import rules
from mild_viz.robot.control.kernels import RETURN_SPEED
from mild_viz.robot.control.rules import fired_rules
from mild_viz.robot.model import load_robot
from mild_viz.settings import ControlSettings
from mild_viz.streaming import Carry, Command, StreamModel
from mild_viz.trial import Trial

T_FACING = np.diag([-1.0, -1.0, 1.0, 1.0])
T_FACING[:3, 3] = [0.7, -0.1, 0.1]


@pytest.fixture(scope="module")
def model() -> Checkpoint:
    return load_checkpoint(default_checkpoint("demo"))


@pytest.fixture(scope="module")
def handshake() -> Trial:
    return next(trial for trial in load_dataset("demo").test if trial.action == "handshake")


@pytest.fixture
def stream(model: Checkpoint) -> StreamModel:
    return streaming.stream_model(
        model, "v3.1", "handshake", load_robot("pepper"), ControlSettings(), T_FACING, rate=30.0
    )


def fed(stream: StreamModel, arms: np.ndarray) -> tuple[Carry, Command]:
    carry, command = streaming.start(stream), None
    for arm in arms:
        carry, command = streaming.step(stream, carry, arm)
    assert command is not None
    return carry, command


def test_another_rate_than_the_models_is_refused(model: Checkpoint) -> None:
    robot, settings = load_robot("pepper"), ControlSettings()
    with pytest.raises(UserError, match="was trained on 30 Hz, the stream has 60 Hz; valid: observations at 30 Hz"):
        streaming.stream_model(model, "v3.1", "handshake", robot, settings, T_FACING, 60.0)
    with pytest.raises(UserError, match="the stream has nan Hz"):
        streaming.stream_model(model, "v3.1", "handshake", robot, settings, T_FACING, float("nan"))
    streaming.stream_model(model, "v3.1", "handshake", robot, settings, T_FACING, 29.97)


def test_before_the_first_observation_the_robot_rests(stream: StreamModel) -> None:
    carry = streaming.start(stream)
    for _ in range(200):
        carry, command = streaming.idle(stream, carry, 0.02)
        np.testing.assert_array_equal(command.joints_commanded, stream.controller.limits.rest)
        assert command.active_state == -1 and np.isnan(command.joints_decoded).all() and not command.contact
    assert [rule.name for rule in fired_rules(command.fired)] == ["missing", "gone"]


def test_without_observations_it_stops_and_then_returns_to_rest(stream: StreamModel, handshake: Trial) -> None:
    carry, last = fed(stream, handshake.human_arm[:80])
    far = np.abs(last.joints_commanded - stream.controller.limits.rest).max()
    assert far > 0.3
    path, names = [last.joints_commanded], []
    for _ in range(300):
        carry, command = streaming.idle(stream, carry, 1 / 60)
        path.append(command.joints_commanded)
        names.append([rule.name for rule in fired_rules(command.fired) if rule.safety])
        np.testing.assert_array_equal(command.joints_decoded, last.joints_decoded)
        assert command.active_state == last.active_state
    moved = np.abs(np.diff(path, axis=0)).max(1) * 60.0
    still = np.flatnonzero(moved == 0.0)
    assert still[0] <= 8 and (moved[still[0] : 89] == 0.0).all()
    assert 0.9 * RETURN_SPEED < moved[90:].max() <= RETURN_SPEED + 1e-9
    np.testing.assert_allclose(path[-1], stream.controller.limits.rest, atol=1e-9)
    assert names[5] == ["missing"] and names[40] == ["missing", "stale"] and names[-1] == ["missing", "gone"]
    assert command.stiffness[0] == 1.0  # whoever was there is gone


def test_after_a_long_pause_the_first_window_is_filled_anew(stream: StreamModel, handshake: Trial) -> None:
    """No velocity is taken across the pause, and five windows reach back into it."""
    for pause, broken in ((0.1, False), (1.0, True)):
        carry, _ = fed(stream, handshake.human_arm[:80])
        carry, _ = streaming.idle(stream, carry, pause)
        observed = []
        lost, _ = streaming.step(stream, carry, np.full((3, 3), np.nan))
        # what was seen before a long pause bridges no gap after it
        assert np.isnan(lost.features[-1, :9]).all() == broken
        for arm in handshake.human_arm[110:120]:
            first = not observed
            carry, command = streaming.step(stream, carry, arm)
            assert not first or (carry.features[-1, 9:] == 0.0).all() == broken, "no velocity across the pause"
            assert command is not None
            observed.append(bool(np.isfinite(command.log_transition)))
        assert observed == ([False] * 4 + [True] * 6 if broken else [True] * 10)


def test_a_short_time_since_the_last_command_moves_it_less(stream: StreamModel, handshake: Trial) -> None:
    """The limits are about the time that the robot has, whatever the clock says."""
    carry, last = fed(stream, handshake.human_arm[:30])
    limits, moved, nan = stream.controller.limits, {}, float("nan")
    for seconds in (None, 1 / 30, 0.004, 0.0, -3.0, nan, float("inf"), 5.0):
        _, command = streaming.step(stream, carry, handshake.human_arm[75], seconds)
        assert command is not None
        moved[seconds] = np.abs(command.joints_commanded - last.joints_commanded)
    np.testing.assert_array_equal(moved[None], moved[1 / 30])
    assert (moved[0.004] <= 0.004 * limits.velocity + 1e-12).all() and moved[0.004].max() < moved[None].max()
    for seconds in (0.0, -3.0, nan, float("inf")):
        assert (moved[seconds] == 0.0).all()
    assert (moved[5.0] <= 0.2 * limits.velocity + 1e-12).all()


def test_an_observation_with_a_missing_joint_is_told(stream: StreamModel, handshake: Trial) -> None:
    arm = handshake.human_arm[80].copy()
    arm[1, 2] = np.nan
    _, command = streaming.step(stream, fed(stream, handshake.human_arm[:80])[0], arm)
    assert command is not None and (command.fired >> rules.MISSING) & 1
