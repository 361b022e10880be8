"""The transition state in the whole chain: learnt from recordings, used in batch and stream, kept in the checkpoint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from mild_viz import streaming
from mild_viz.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from mild_viz.data.load import load_dataset
from mild_viz.errors import UserError
from mild_viz.latent.hmm import forward_filter, log_emission
from mild_viz.latent.interaction import InteractionModel
from mild_viz.latent.transition import TransitionState
from mild_viz.pairs import Windows, stack_windows
from mild_viz.pipeline import control, infer
from mild_viz.robot.model import RobotModel
from mild_viz.rollout import Rollout
from mild_viz.settings import ControlSettings
from mild_viz.training.transition import learn_transition_states
from mild_viz.trial import Trial
from tests.models import random_checkpoint

pytest_plugins = ["demo_fixtures"]


@pytest.fixture(scope="module")
def data() -> Windows:
    trials = load_dataset("demo").train
    return stack_windows([trial for trial in trials if trial.action in ("wave", "handshake", "parachute")], None)


@pytest.fixture(scope="module")
def learnt(model: Checkpoint, data: Windows) -> dict[str, TransitionState]:
    states = {**model.contact_states, "wave": frozenset()}
    return learn_transition_states(InteractionModel(model.human_vae, model.hmms, model.human_vae), states, data)


def with_state(model: Checkpoint, state: TransitionState) -> Checkpoint:
    return replace(model, transition_states={"handshake": state})


def run(model: Checkpoint, robot: RobotModel, trial: Trial, **settings: Any) -> Rollout:
    return control(infer(model, trial, "v3.1"), model, robot, trial, ControlSettings(**settings))


def first_low(rollout: Rollout) -> int:
    return int(np.argmax(rollout.stiffness.min(1) < 1.0))


def test_learnt_by_action_from_the_windows_of_training(
    model: Checkpoint, data: Windows, learnt: dict[str, TransitionState]
) -> None:
    """Those of the filters' own disagreement, found here step by step; an action without contact has none."""
    assert set(learnt) <= {"handshake", "parachute"} and "handshake" in learnt
    hmm, states = model.hmm("handshake"), model.contact_states["handshake"]
    human_hmm, late = hmm.marginal(slice(0, 5)), []
    for trial, action in enumerate(data.actions):
        if action != "handshake":
            continue
        human, partner = (model.human_vae.encode(x[data.rows(trial)])[0] for x in (data.human, data.partner))
        alone = forward_filter(human_hmm, log_emission(human_hmm, human))[0].argmax(1)
        both = np.concatenate([human, partner], axis=1)
        joint = forward_filter(hmm, log_emission(hmm, both))[0].argmax(1)
        n = next(n for n, state in enumerate(joint) if state in states)
        while joint[n] in states and not any(state in states for state in alone[: n + 1]):
            late.append(human[n])
            n += 1
    np.testing.assert_allclose(learnt["handshake"].mean, np.mean(late, axis=0))
    assert learnt["handshake"].contact_states == states


def test_a_checkpoint_without_it_is_controlled_as_before(
    model: Checkpoint, robot: RobotModel, handshake: Trial, learnt: dict[str, TransitionState]
) -> None:
    bare = replace(model, transition_states={})
    plain = run(bare, robot, handshake)
    assert (plain.inference.log_transition == -np.inf).all()
    eager = replace(learnt["handshake"], hazard=0.5)
    early = run(with_state(model, eager), robot, handshake)
    assert 0 < first_low(early) < first_low(plain)
    # IK and commands do not depend on it
    for name in ("contact", "joints_commanded", "target"):
        np.testing.assert_array_equal(getattr(early, name), getattr(plain, name))
    # beside other contact states than those that it leads to, it means nothing
    others = {"contact_states": frozenset({3, 4})}
    np.testing.assert_array_equal(
        run(with_state(model, eager), robot, handshake, **others).stiffness,
        run(bare, robot, handshake, **others).stiffness,
    )


@pytest.mark.parametrize("hazard", [None, 0.5])
def test_streaming_equals_batch(
    model: Checkpoint, robot: RobotModel, handshake: Trial, learnt: dict[str, TransitionState], hazard: float | None
) -> None:
    state = learnt["handshake"]
    model = with_state(model, state if hazard is None else replace(state, hazard=hazard))
    arm = handshake.human_arm.copy()
    arm[2:22], arm[70:73] = np.nan, np.nan
    trial = replace(handshake, human_arm=arm)
    rollout = run(model, robot, trial)
    log_transition = rollout.inference.log_transition
    np.testing.assert_array_equal(np.isfinite(log_transition), rollout.inference.observed)
    assert not rollout.inference.observed.all()
    if hazard is not None:  # it decides here
        assert first_low(rollout) < first_low(run(replace(model, transition_states={}), robot, trial))
    stream = streaming.stream_model(
        model, "v3.1", "handshake", robot, ControlSettings(), rollout.T_world_human, trial.rate
    )
    carry = streaming.start(stream)
    for frame, observation in enumerate(arm[: rollout.inference.n_windows + 4]):
        carry, command = streaming.step(stream, carry, observation)
        if command is not None:
            np.testing.assert_allclose(command.log_transition, log_transition[frame - 4], atol=1e-9, rtol=0)
            np.testing.assert_array_equal(command.stiffness, rollout.stiffness[frame - 4])


# the checkpoint's folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    state = TransitionState(np.arange(5.0), np.diag(np.arange(1.0, 6.0)), 0.03, frozenset({2, 3}))
    path = tmp_path / "model"
    save_checkpoint(replace(random_checkpoint(), transition_states={"handshake": state}), path, "# model\n")
    return path


def test_what_is_saved_is_loaded(folder: Path) -> None:
    (action, state), *others = load_checkpoint(folder).transition_states.items()
    assert (action, state.hazard, state.contact_states, others) == ("handshake", 0.03, frozenset({2, 3}), [])
    np.testing.assert_array_equal(state.mean, np.arange(5.0))
    np.testing.assert_array_equal(state.covariance, np.diag(np.arange(1.0, 6.0)))


def edit_tensors(folder: Path, edit: Callable[[dict[str, np.ndarray]], None]) -> None:
    tensors = load_file(folder / "weights.safetensors")
    edit(tensors)
    save_file(tensors, folder / "weights.safetensors")


def test_a_checkpoint_from_before_is_read(folder: Path) -> None:
    edit_tensors(folder, lambda tensors: [tensors.pop(name) for name in list(tensors) if "transition/" in name])  # pyright: ignore[reportArgumentType]
    assert load_checkpoint(folder).transition_state_of("v3.1", "handshake") is None


def test_a_variant_with_models_of_its_own_has_its_own(tmp_path: Path) -> None:
    state = TransitionState(np.zeros(5), np.eye(5), 0.1, frozenset({1}))
    model = random_checkpoint(n_own=2)
    own = replace(model.own_models["v4"][0], transition_states={"rocket": state})
    model = replace(model, own_models={"v4": (own, model.own_models["v4"][1])})
    loaded = save_checkpoint(model, tmp_path / "model", "")
    found = loaded.transition_state_of("v4", "rocket")
    assert found is not None and (found.hazard, found.contact_states) == (0.1, frozenset({1}))
    assert loaded.transition_state_of("v4", "handshake") is loaded.transition_state_of("v3.1", "rocket") is None


def spoil(key: str, value: np.ndarray) -> Callable[[dict[str, np.ndarray]], None]:
    return lambda tensors: tensors.update({f"transition/handshake/{key}": value})


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda tensors: tensors.__delitem__("transition/handshake/mean"), "'transition/handshake/mean' is missing"),
        (spoil("mean", np.zeros(4)), r"'transition/handshake/mean' has shape \(4,\), expected \(5,\)"),
        (spoil("covariance", np.eye(4)), r"covariance' has shape \(4, 4\), expected \(5, 5\)"),
        (spoil("mean", np.full(5, np.nan)), "transition/handshake: .* not finite"),
        (spoil("covariance", np.diag([1.0, 1, 1, 1, np.inf])), "transition/handshake: .* not finite"),
        (spoil("covariance", np.diag([1.0, 1, 1, 1, -1])), "transition/handshake: .* not positive definite"),
        (spoil("covariance", np.eye(5) + np.eye(5, k=1)), "transition/handshake: .* not symmetric"),
        (spoil("hazard", np.ones(1)), r"transition/handshake: hazard is 1\.0; valid: a number between 0 and 1"),
        (spoil("hazard", np.zeros(1)), r"transition/handshake: hazard is 0\.0; valid: a number between 0 and 1"),
        (spoil("hazard", np.array([np.nan])), "transition/handshake: hazard is nan; valid: a number between 0 and 1"),
        (spoil("contact_states", np.array([0, 1])), r"contact_states' has shape \(2,\), expected \(6,\)"),
        (spoil("contact_states", np.full(6, 0.5)), r"contact_states' is \[0\.5 .*\], expected 0 or 1"),
        (spoil("contact_states", np.zeros(6)), "transition/handshake: no contact states; expected one or more"),
    ],
)
def test_wrong_tensors_are_named(folder: Path, edit: Callable[[dict[str, np.ndarray]], None], message: str) -> None:
    edit_tensors(folder, edit)
    with pytest.raises(UserError, match=rf"weights\.safetensors: .*{message}"):
        load_checkpoint(folder)
