"""v4's training: what it conditions on is what the running model conditions on; it learns, resumes and fine-tunes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mild_viz.checkpoint import RobotInterface, save_checkpoint
from mild_viz.data.load import load_dataset
from mild_viz.errors import UserError
from mild_viz.evaluation.metrics import model_rows
from mild_viz.latent.context import ContextLayout
from mild_viz.latent.interaction import InteractionModel
from mild_viz.pairs import Windows, stack_windows
from mild_viz.robot.robots import ROBOTS
from mild_viz.training import run as training_run
from mild_viz.training.human_stage import make_agents
from mild_viz.training.joint_stage import Conditioning, fit_models, train_joint_stage
from mild_viz.training.networks import BatchedVAE
from mild_viz.training.options import TrainingOptions
from mild_viz.training.outcome import mean_errors
from mild_viz.training.priors import complete_rows
from mild_viz.training.run import plan_run, train
from mild_viz.training.state import RunState
from mild_viz.trial import Trial
from tests.models import ACTIONS, random_checkpoint, random_vae

JOINTS = ROBOTS["pepper"].joint_names
QUICK = TrainingOptions(
    seeds=2, members=2, human_epochs=3, robot_epochs=3, joint_epochs=4, final_em_iterations=5, lags=(4, 9)
)
RATE = 30.0


def silent(*_: Any) -> None:
    pass


@pytest.fixture(scope="module")
def few() -> list[Trial]:
    """Three demo trials of every action."""
    trials = load_dataset("demo").train
    return [trial for action in ACTIONS for trial in [t for t in trials if t.action == action][:3]]


@pytest.fixture(scope="module")
def data(few: list[Trial]) -> Windows:
    """With two gaps that are too long to be bridged, one of them only the partner's."""
    human, partner = few[1].human_arm.copy(), few[4].partner_arm
    assert partner is not None
    human[40:70] = np.nan
    partner = partner.copy()
    partner[40:70] = np.nan
    trials = [few[0], replace(few[1], human_arm=human), *few[2:4], replace(few[4], partner_arm=partner), *few[5:]]
    found = stack_windows(trials, JOINTS)
    assert not found.complete[found.rows(1)].all() and not found.complete[found.rows(4)].all()
    return found


def test_training_conditions_as_the_running_model_does(data: Windows) -> None:
    """The batched network's conditional of every complete row is that of the exported model, run over the trial."""
    net = make_agents(complete_rows(data), False, 4, QUICK, torch.Generator().manual_seed(0))
    conditioning = Conditioning(data, ContextLayout(QUICK.lags, QUICK.clock), RATE, "cpu")
    models, alphas = fit_models(net, data, conditioning, QUICK, 3)
    conditioning.update(alphas, models)
    human = torch.tensor(complete_rows(data).human, dtype=torch.float32)
    x = net.human.standardise(human)
    rows = torch.arange(len(x))
    with torch.no_grad():
        found = conditioning.latent(net, net.human.encode(x.expand(4, -1, -1))[0], x, rows).numpy()
    # Where only the partner was lost, the running model sees a human that training leaves out.
    seen_by_both = np.isfinite(data.human).all(1) == data.complete
    for m, model in enumerate(models):
        for trial, action in enumerate(data.actions):
            of_trial = data.rows(trial)
            if not seen_by_both[of_trial].all():
                continue
            said, _ = model.advance(action, data.human[of_trial], model.start(), RATE)
            complete = data.complete[of_trial]
            mine = (conditioning.rows >= of_trial.start) & (conditioning.rows < of_trial.stop)
            np.testing.assert_allclose(found[m][mine], said.robot_mean[complete], atol=2e-4)
    assert seen_by_both[data.rows(1)].all() and not seen_by_both[data.rows(4)].all()


def test_a_gap_is_bridged_as_by_the_running_model() -> None:
    human = np.zeros((12, 90))
    human[3:6] = np.nan
    made = Windows(human, np.zeros((12, 20)), np.repeat([0, 1], [8, 4]), np.r_[0:8, 0:4], ("wave", "wave"))
    before = Conditioning(made, ContextLayout(lags=(2,)), RATE, "cpu").past[0]
    rows = np.array([0, 1, 2, 6, 7, 8, 9, 10, 11])
    #              row  0  1  2  6  7  8  9  10 11: two steps earlier, the last one seen, the first of the trial
    np.testing.assert_array_equal(rows[before], [0, 0, 0, 2, 2, 8, 8, 8, 9])


def test_it_learns_and_its_gradient_reaches_the_humans_encoder(few: list[Trial], data: Windows) -> None:
    history: list[dict[str, float]] = []
    options = replace(QUICK, joint_epochs=14, beta=0.0)
    seeds = train_joint_stage(data, RATE, options, lambda *told: history.append(told[3]))
    assert [len(models) for models in seeds] == [2, 2]
    assert history[0]["conditional"] == 0.0 and history[-1]["conditional"] < 0.5 * history[1]["conditional"]
    held = [trial for trial in load_dataset("demo").test if trial.action in ACTIONS]
    test = stack_windows(held, JOINTS)
    usable = complete_rows(data)
    errors, constant = [], []
    for trial, action in enumerate(test.actions):
        rows, complete = test.rows(trial), test.complete[test.rows(trial)]
        decoded = np.mean([m.advance(action, test.human[rows], m.start(), RATE)[0].decoded for m in seeds[0]], axis=0)
        of = np.array([data.actions[t] == action for t in usable.trial])
        errors.append(((decoded - test.partner[rows])[complete] ** 2).mean())
        constant.append(((usable.partner[of].mean(0) - test.partner[rows])[complete] ** 2).mean())
    assert np.mean(errors) < 0.5 * np.mean(constant)

    net = make_agents(usable, False, 4, QUICK, torch.Generator().manual_seed(0))
    conditioning = Conditioning(data, ContextLayout(QUICK.lags, QUICK.clock), RATE, "cpu")
    models, alphas = fit_models(net, data, conditioning, QUICK, 2)
    conditioning.update(alphas, models)
    x = net.human.standardise(torch.tensor(usable.human[:50], dtype=torch.float32))
    net.partner.decode(
        conditioning.latent(net, net.human.encode(x.expand(4, -1, -1))[0], x, torch.arange(50))
    ).square().sum().backward()
    gradient = net.human.weights["encoder/0/weight"].grad
    assert gradient is not None and gradient.abs().max() > 0


class Interrupted(Exception):
    pass


def test_a_killed_run_goes_on_to_the_same_result(data: Windows, tmp_path: Path) -> None:
    def kill(_: str, epoch: int, *__: Any) -> None:
        if epoch == 2:
            raise Interrupted

    whole = train_joint_stage(data, RATE, QUICK, silent)
    with RunState(tmp_path / "run", {}, QUICK, resume=False) as state, pytest.raises(Interrupted):
        train_joint_stage(data, RATE, QUICK, kill, state)
    with RunState(tmp_path / "run", {}, QUICK, resume=True) as state:
        resumed = train_joint_stage(data, RATE, QUICK, silent, state)
    for one, two in zip(sum(whole, []), sum(resumed, []), strict=True):
        for name, value in one.robot_vae.weights.items():
            np.testing.assert_array_equal(value, two.robot_vae.weights[name], err_msg=name)
        np.testing.assert_array_equal(one.regressions["wave"].gain, two.regressions["wave"].gain)


# --- the whole run


def small_dataset(few: list[Trial], **changes: Any) -> Any:
    whole = load_dataset("demo")
    return replace(whole, **{"train": tuple(few), "test": whole.test[::4], **changes})


def test_a_run_with_v4_keeps_its_models_contact_and_figures(
    few: list[Trial], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training_run, "load_dataset", lambda _: small_dataset(few))
    made = train("demo", "hri", ("v1", "v4"), QUICK, tmp_path / "both")
    assert made.variants == ("v1", "v4") and len(made.members("v4")) == 2 and made.rate == RATE
    assert made.contact_states_of("v4", "handshake") and not made.contact_states_of("v4", "wave")
    # v4 has seen the trials that were held out to choose a seed by: it is not scored on them
    assert set(made.metrics["held_out"][0]) == {"v1"} and len(made.metrics["test_seeds"]) == 2
    assert {row["model"] for row in made.metrics["test"]} == {"v1", "v4"}
    kept = train("demo", "hri", ("v4",), replace(QUICK, joint_held_out=True), tmp_path / "kept")
    assert set(kept.metrics["held_out"][0]) == {"v4"} and kept.variants == ("v4",)
    assert "v4 is fitted to the held-out trials" in (tmp_path / "both" / "README.md").read_text()

    human = train("demo", "hhi", ("v4",), QUICK, tmp_path / "human")
    assert human.robot is None and human.variants == ("v1", "v4")
    assert human.members("v4")[0].robot_vae.input_size == 90


def test_recordings_of_a_robot_need_no_second_human(
    few: list[Trial], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def recorded(trial: Trial) -> Trial:
        joints = stack_robot(trial)
        return replace(trial, partner_arm=None, partner_skeleton=None, robot_joints=joints, robot_joint_names=JOINTS)

    trials = [recorded(trial) for trial in few]
    monkeypatch.setattr(training_run, "load_dataset", lambda _: small_dataset(few, train=tuple(trials)))
    made = train("demo", "hri", ("v1", "v3.1", "v4"), QUICK, tmp_path / "model")
    assert made.variants == ("v1", "v3.1", "v4") and made.placement is None
    with pytest.raises(UserError, match="'demo' has no second human; valid for it: --stage hri"):
        train("demo", "hhi", ("v1",), QUICK, tmp_path / "human")


def stack_robot(trial: Trial) -> np.ndarray:
    """Joints that a robot's log would hold: the retargeted ones, without gaps."""
    from mild_viz.pairs import robot_truth

    truth = robot_truth(trial, JOINTS)
    return np.nan_to_num(truth, nan=float(np.nanmean(truth)))


# --- fine-tuning


def test_a_loaded_network_is_the_model_that_it_was_given() -> None:
    vae = random_vae(np.random.default_rng(0), 20)
    x = np.random.default_rng(1).normal(2.0, 3.0, size=(30, 20))
    net = BatchedVAE(3, torch.full((20,), 2.0), torch.full((20,), 3.0), (40, 20), 5, torch.Generator().manual_seed(0))
    before = net.export(1)
    net.load(vae, 0)
    np.testing.assert_array_equal(net.export(1).encode(x)[0], before.encode(x)[0])
    net.load(vae)
    for model in range(3):
        np.testing.assert_allclose(net.export(model).encode(x)[0], vae.encode(x)[0], atol=1e-4)
        np.testing.assert_allclose(net.export(model).decode(x[:, :5]), vae.decode(x[:, :5]), atol=1e-3)


def test_fine_tuning_starts_from_the_given_model(
    few: list[Trial], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training_run, "load_dataset", lambda _: small_dataset(few))
    first = train("demo", "hri", ("v3.1", "v4"), replace(QUICK, human_epochs=12, robot_epochs=12), tmp_path / "first")
    gentle = replace(QUICK, human_epochs=1, robot_epochs=1, joint_epochs=1, learning_rate=1e-7, peak_learning_rate=1e-6)
    tuned = train("demo", "hri", ("v3.1", "v4"), gentle, tmp_path / "tuned", init=first.path)
    fresh = train("demo", "hri", ("v3.1", "v4"), gentle, tmp_path / "fresh")
    np.testing.assert_allclose(
        tuned.human_vae.weights["encoder.0.weight"], first.human_vae.weights["encoder.0.weight"], atol=1e-3
    )
    errors = {name: mean_errors(model_rows(model, few)) for name, model in (("tuned", tuned), ("fresh", fresh))}
    assert errors["tuned"]["v3.1"] < 0.5 * errors["fresh"]["v3.1"]
    assert tuned.training["run"]["init"] == str(first.path)
    with pytest.raises(UserError, match=r"hidden is \(40, 20\), this run has \(30, 20\); they must be equal"):
        plan_run("demo", "hri", ("v1",), replace(QUICK, hidden=(30, 20)), first.path)


# --- what is watched, and where it runs


def test_losses_and_held_out_errors_go_to_tensorboard(
    few: list[Trial], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    monkeypatch.setattr(training_run, "load_dataset", lambda _: small_dataset(few))
    options = replace(QUICK, joint_held_out=True)
    train("demo", "hri", ("v3.1", "v4"), options, tmp_path / "model", tensorboard=tmp_path / "log", quiet=True)
    log = EventAccumulator(str(tmp_path / "log"))
    log.Reload()
    scalars = log.Tags()["scalars"]
    for stage in ("human", "robot", "joint"):
        assert {f"{stage}/reconstruction", f"{stage}/kl", f"{stage}/held_out"} <= set(scalars)
    steps = [event.step for event in log.Scalars("joint/conditional")]
    assert steps == list(range(1, QUICK.joint_epochs + 1))
    assert all(np.isfinite(event.value) and event.value > 0 for event in log.Scalars("robot/held_out"))


@pytest.mark.skipif(torch.cuda.is_available(), reason="about machines without a GPU")
def test_a_missing_gpu_is_named() -> None:
    with pytest.raises(UserError, match="device 'cuda' is not here: torch finds no GPU that it can use"):
        plan_run("demo", "hri", ("v1",), replace(QUICK, device="cuda"))
    with pytest.raises(UserError, match="device 'tpu' is unknown; valid: cpu, cuda"):
        replace(QUICK, device="tpu")


def test_the_folds_hold_out_every_trial_once(few: list[Trial]) -> None:
    held = [training_run.hold_out(few, 1, fold)[1] for fold in range(3)]
    names = [trial.name for trials in held for trial in trials]
    assert sorted(names) == sorted(trial.name for trial in few)
    assert [t.name for t in training_run.hold_out(few, 1)[1]] == [t.name for t in held[2]]


# --- recordings that cannot be learnt from


def bad_trial(few: list[Trial], change: str) -> Trial:
    trial = few[1]
    if change == "short":
        arm = trial.human_arm[:9]
        return Trial("demo", "train", 1, "wave", RATE, arm, trial.partner_arm[:9])  # pyright: ignore[reportOptionalSubscript]
    if change == "nan":
        joints = stack_robot(trial).copy()
        joints[7, 2] = np.nan
        return replace(trial, robot_joints=joints, robot_joint_names=JOINTS)
    arm = trial.human_arm.copy()
    arm[3:5, 0, 0] = np.inf
    return replace(trial, human_arm=arm)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("short", r"trial demo/train/1 has 9 frames, which is less than two windows; expected at least 10"),
        ("nan", r"trial demo/train/1: robot_joints is not a number at frame 7; expected finite values"),
        ("inf", r"trial demo/train/1: human_points is not a number at frame 3 and 1 more"),
    ],
)
def test_a_trial_that_cannot_be_learnt_from_is_named(
    few: list[Trial], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: str, message: str
) -> None:
    trials = (few[0], bad_trial(few, change), *few[2:])
    monkeypatch.setattr(training_run, "load_dataset", lambda _: small_dataset(few, train=trials))
    with pytest.raises(UserError, match=message):
        train("demo", "hri", ("v1",), QUICK, tmp_path / "model")
    assert not list(tmp_path.iterdir())


def test_a_partner_that_never_moves_is_named(few: list[Trial], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    still = [
        replace(t, partner_arm=None, robot_joints=np.full((t.n_frames, 4), 0.3), robot_joint_names=JOINTS) for t in few
    ]
    monkeypatch.setattr(training_run, "load_dataset", lambda _: small_dataset(few, train=tuple(still)))
    with pytest.raises(UserError, match="RShoulderPitch, .* never moved in the .* training trials"):
        train("demo", "hri", ("v1",), QUICK, tmp_path / "model")


def test_trials_of_different_rates_are_refused(
    few: list[Trial], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trials = (replace(few[0], rate=20.0), *few[1:])
    monkeypatch.setattr(training_run, "load_dataset", lambda _: small_dataset(few, train=trials))
    with pytest.raises(UserError, match=r"trials of different rates: \[20.0, 30.0\] Hz; expected one rate"):
        train("demo", "hri", ("v1",), QUICK, tmp_path / "model")


def test_a_trial_of_another_rate_is_refused_by_the_pipeline() -> None:
    from mild_viz.pipeline import infer

    trial = replace(load_dataset("demo").test[0], rate=20.0)
    with pytest.raises(UserError, match="random was trained on 30 Hz, trial demo/test/0 has 20 Hz"):
        infer(random_checkpoint(), trial, "v1")


def test_models_of_v4_share_their_layout(data: Windows) -> None:
    ((model, *_), *_) = train_joint_stage(data, RATE, replace(QUICK, joint_epochs=1), silent)
    assert isinstance(model, InteractionModel) and model.layout == ContextLayout(QUICK.lags, QUICK.clock)


def test_fine_tuned_members_start_from_different_ones(data: Windows) -> None:
    first = random_checkpoint(n_own=2).members("v4")
    net = make_agents(complete_rows(data), False, 4, QUICK, torch.Generator().manual_seed(0), first)
    for m in range(4):
        found, meant = net.human.export(m).weights["posterior_mean.weight"], first[m % 2].human_vae.weights
        np.testing.assert_allclose(found, meant["posterior_mean.weight"], atol=1e-6)


def test_a_robot_of_other_joints_starts_afresh(
    few: list[Trial], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training_run, "load_dataset", lambda _: small_dataset(few))
    other = replace(random_checkpoint(), robot_vaes={"v3.1": random_vae(np.random.default_rng(0), 35)})
    start = replace(other, robot=RobotInterface("panda", ROBOTS["panda"].joint_names, ROBOTS["panda"].end_effector))
    folder = save_checkpoint(start, tmp_path / "panda", "for a test").path
    made = train("demo", "hri", ("v3.1",), QUICK, tmp_path / "model", init=folder, quiet=True)
    assert made.members("v3.1")[0].robot_vae.input_size == 20


def test_every_trial_is_checked_before_anything_is_trained(
    few: list[Trial], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    test = load_dataset("demo").test
    short = Trial("demo", "test", 3, "wave", RATE, test[0].human_arm[:8], test[0].partner_arm[:8])  # pyright: ignore[reportOptionalSubscript]
    for tests, message in (((short,), "trial demo/test/3 has 8 frames"), ((), "has no test trial of handshake, ")):
        monkeypatch.setattr(training_run, "load_dataset", lambda _, tests=tests: small_dataset(few, test=tests))
        with pytest.raises(UserError, match=message):
            train("demo", "hri", ("v1",), QUICK, tmp_path / "model")
    assert not list(tmp_path.iterdir())
