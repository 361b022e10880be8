"""The baseline of Bütepage et al. (2020): inference equals torch, the stages learn, nothing reads the truth."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file
from torch import Tensor, nn

from mild_viz.checkpoint import check_checkpoint_target, load_checkpoint, save_checkpoint
from mild_viz.cli import main
from mild_viz.data.load import load_dataset
from mild_viz.errors import UserError
from mild_viz.evaluation.buetepage import (
    BUETEPAGE,
    Buetepage,
    dynamics_shapes,
    is_buetepage,
    load_buetepage,
    load_model,
    predict_windows,
    save_buetepage,
)
from mild_viz.evaluation.metrics import model_rows
from mild_viz.evaluation.report import evaluate
from mild_viz.pairs import stack_windows
from mild_viz.settings import WINDOW
from mild_viz.training.buetepage.networks import Gaussian, HumanDynamics, RobotDynamics, jensen_shannon, with_code
from mild_viz.training.buetepage.options import BuetepageOptions
from mild_viz.training.buetepage.run import train_buetepage, train_models
from mild_viz.training.buetepage.stages import make_examples, sequences
from mild_viz.trial import Trial
from tests.models import ACTIONS, PEPPER, random_checkpoint, random_vae

QUICK = BuetepageOptions(seeds=2, epochs=3, batch_trials=3)
N_ACTIONS = len(ACTIONS)


def silent(*_: Any) -> None:
    pass


def random_model(seed: int = 0, human_human: bool = False) -> Buetepage:
    rng = np.random.default_rng(seed)
    robot = None if human_human else PEPPER
    shapes = dynamics_shapes(N_ACTIONS, len(robot.joint_names) if robot else None)
    tensors = {name: rng.normal(size=shape) / np.sqrt(shape[-1]) for name, shape in shapes.items()}
    vae = random_vae(rng, 90 if human_human else 20)
    return Buetepage(Path("nowhere"), "random", "demo", "0" * 64, ACTIONS, robot, vae, tensors, rate=30.0)


@pytest.fixture(scope="module")
def few() -> list[Trial]:
    """Three demo trials of every action."""
    trials = load_dataset("demo").train
    return [trial for action in ACTIONS for trial in [t for t in trials if t.action == action][:3]]


@pytest.fixture(scope="module")
def whole() -> Trial:
    """A demo trial in which both were tracked throughout."""
    trials = load_dataset("demo").train
    return next(t for t in trials if stack_windows([t], None).complete.all())


def with_gap(trial: Trial, first: int, last: int, agent: str = "human_arm") -> Trial:
    arm = np.array(getattr(trial, agent))
    arm[first:last] = np.nan
    return replace(trial, **{agent: arm})


# networks


def test_divergences_are_torchs() -> None:
    rng = torch.Generator().manual_seed(0)
    p, q = (Gaussian(torch.randn(4, 5, generator=rng), 0.2 + torch.rand(4, 5, generator=rng)) for _ in range(2))
    normals = [torch.distributions.Normal(*g) for g in (p, q)]
    torch.testing.assert_close(p.kl(q), torch.distributions.kl_divergence(*normals))
    x = torch.randn(4, 5, generator=rng)
    torch.testing.assert_close(p.log_prob(x), normals[0].log_prob(x))
    # Jensen-Shannon, by numerical integration over a grid
    p, q = (Gaussian(torch.tensor(m), torch.tensor(s)) for m, s in ((0.0, 1.0), (1.5, 0.5)))
    grid = torch.linspace(-10, 10, 20001, dtype=torch.float64)
    densities = [torch.exp(g.log_prob(grid)) for g in (p, q)]
    middle = (densities[0] + densities[1]) / 2
    exact = sum(0.5 * torch.trapezoid(torch.special.xlogy(d, d / middle), grid) for d in densities)
    many = [Gaussian(*(part.expand(200_000) for part in g)) for g in (p, q)]
    estimate = jensen_shannon(many[0], many[1], many[0].sample(rng), many[1].sample(rng)).mean()
    assert float(estimate) == pytest.approx(float(exact), abs=3e-3) and 0.2 < float(exact) < 0.6


def test_exported_dynamics_equal_the_networks() -> None:
    """Teacher-forced networks in torch against the exported arrays, whose standardisation is folded in."""
    rng, n_steps, models = torch.Generator().manual_seed(1), 30, 3
    frames = 0.4 + 0.2 * torch.randn(n_steps, 18, generator=rng)
    code = torch.eye(N_ACTIONS)[1].expand(n_steps, -1)
    scaling = with_code(frames.mean(0), torch.full((18,), 0.2), N_ACTIONS)
    human = HumanDynamics(models, *scaling, rng)
    given = torch.cat([frames, code], dim=1).expand(models, 1, -1, -1)
    d = human.observe(given)
    assert bool((d.std > 0).all())
    for model in range(models):
        exported = human.export(model) | human.head.export(model)
        between = replace(random_model(human_human=True), tensors=exported)
        expected = human.head(d.mean).mean[model, 0].detach().double().numpy()
        windows = between.predict(ACTIONS[1], frames.double().numpy())
        np.testing.assert_allclose(windows, between.vae.decode(expected), atol=1e-5)

    robot = RobotDynamics(models, *with_code(torch.full((4,), -2.0), torch.full((4,), 0.7), N_ACTIONS + 5), rng)
    for model in range(models):
        base = random_model()
        tensors = {**base.tensors, **human.export(model), **robot.export(model)}
        controlled = replace(base, tensors=tensors)
        windows = controlled.predict(ACTIONS[1], frames.double().numpy())
        # What it predicted, fed to the network in torch, must give the same predictions.
        joints = np.concatenate([tensors["rest"][None], windows[:-1, :4]])
        read = torch.cat(
            [torch.tensor(joints, dtype=torch.float32).expand(models, 1, -1, -1), given[..., 18:], d.mean], -1
        )
        expected = controlled.vae.decode(robot(read).mean[model, 0].detach().double().numpy())
        np.testing.assert_allclose(windows, expected, atol=1e-5)


def test_prediction_equals_a_loop_of_torchs_lstm_cells() -> None:
    """The whole autoregression in double precision, by torch's own cells."""
    model = random_model(3)
    weights = {name: torch.tensor(value) for name, value in model.tensors.items()}

    def cell(name: str) -> nn.LSTMCell:
        made = nn.LSTMCell(weights[f"{name}.input_weight"].shape[1], 42, dtype=torch.float64)
        tensors = [weights[f"{name}.{key}"] for key in ("input_weight", "recurrent_weight", "bias")]
        made.load_state_dict(dict(zip(("weight_ih", "weight_hh", "bias_ih"), tensors, strict=True)), strict=False)
        nn.init.zeros_(made.bias_hh)
        return made

    def layer(name: str, x: Tensor) -> Tensor:
        return nn.functional.linear(x, weights[f"{name}.weight"], weights[f"{name}.bias"])

    human, robot = cell("human_lstm"), cell("robot_lstm")
    frames = np.random.default_rng(4).normal(size=(20, 18))
    code, joints, expected = torch.eye(N_ACTIONS, dtype=torch.float64)[2], weights["rest"], []
    human_state = robot_state = None
    for frame in torch.tensor(frames):
        human_state = human(torch.cat([frame, code])[None], human_state)
        d = layer("latent_mean", human_state[0])[0]
        robot_state = robot(torch.cat([joints, code, d])[None], robot_state)
        hidden = torch.tanh(layer("head.1", torch.tanh(layer("head.0", robot_state[0]))))
        window = model.vae.decode(layer("z_mean", hidden).detach().numpy())[0]
        joints = torch.tensor(window[:4])
        expected.append(window)
    np.testing.assert_allclose(model.predict(ACTIONS[2], frames), expected, atol=1e-10)


# prediction


@pytest.mark.parametrize("human_human", [False, True])
def test_a_prediction_reads_only_what_was_observed(few: list[Trial], human_human: bool) -> None:
    model = random_model(human_human=human_human)
    data = stack_windows(few, None if human_human else PEPPER.joint_names)
    predicted = predict_windows(model, data)
    other_truth = replace(data, partner=np.random.default_rng(0).normal(size=data.partner.shape))
    np.testing.assert_array_equal(predict_windows(model, other_truth), predicted)
    # a later frame changes nothing before it, an earlier one what follows
    rows = data.rows(1)
    human = data.human.copy()
    human[rows.start + 50] += 0.5
    moved = predict_windows(model, replace(data, human=human))
    changed = np.flatnonzero((moved != predicted).any(1) & np.isfinite(predicted).all(1))
    assert changed[0] == rows.start + 50 and changed[-1] < rows.stop and len(changed) > 10


def test_gaps_are_skipped(whole: Trial) -> None:
    model = random_model()
    plain, gap = (stack_windows([trial], PEPPER.joint_names) for trial in (whole, with_gap(whole, 60, 100)))
    missing = np.logical_or.reduce(np.isnan(gap.human), axis=1)
    assert 20 < missing.sum() < 60 and not missing[-1]
    predicted = predict_windows(model, gap)
    np.testing.assert_array_equal(np.isnan(predicted).any(1), missing)
    skipped = model.predict(whole.action, gap.human[~missing, -18:])
    np.testing.assert_array_equal(predicted[~missing], skipped)
    np.testing.assert_array_equal(predicted[:50], predict_windows(model, plain)[:50])


def test_an_action_that_was_not_trained_is_named(few: list[Trial]) -> None:
    with pytest.raises(UserError, match="action 'handover' is unknown; valid: wave"):
        random_model().predict("handover", np.zeros((3, 18)))


# training


def test_examples_are_the_windows_in_order(few: list[Trial], whole: Trial) -> None:
    trials = [whole, with_gap(few[1], 60, 100), with_gap(few[3], 0, 30, "partner_arm")]
    windows = stack_windows(trials, PEPPER.joint_names)
    data = make_examples(trials, windows, ACTIONS)
    used = np.flatnonzero(windows.complete)
    assert data.observed.shape[0] == 2 and len(data.partner_window) <= len(used) < len(windows.step)
    assert all(torch.isfinite(part).all() for part in (data.observed, data.next_window, data.partner_window))
    rows, mask = data.rows[1], data.mask[1]
    assert torch.equal(rows[mask], torch.arange(int(rows[0]), int(rows[0]) + int(mask.sum())))
    assert data.action[rows[0]].tolist() == [float(action == trials[1].action) for action in ACTIONS]
    # Without a gap, row n of the first trial observes frame n + 4, and its next window begins with frame n + 5.
    arm, row = trials[0].partner_arm, 20
    assert arm is not None
    np.testing.assert_allclose(data.observed[1, row, :9], arm[row + WINDOW - 1].reshape(9), rtol=1e-6)
    np.testing.assert_allclose(data.next_window[1, row, :9], arm[row + WINDOW].reshape(9), rtol=1e-6)
    seen = [int(i) for some, there in sequences(data, 2, torch.Generator().manual_seed(0)) for i in some[there]]
    assert sorted(seen) == list(range(len(data.partner_window)))


@pytest.mark.parametrize("robot", [PEPPER, None])
def test_every_stage_learns(few: list[Trial], robot: Any) -> None:
    losses: dict[str, list[float]] = {}

    def record(stage: str, *_: Any) -> None:
        losses.setdefault(stage, []).append(sum(_[-1].values()))

    trials = [with_gap(few[0], 60, 100), *few[1:]]
    trained = train_models(trials, ACTIONS, robot, replace(QUICK, learning_rate=5e-3), record)
    assert list(losses) == ["human VAE", "human dynamics", "robot VAE", "robot dynamics"][: 4 if robot else 2]
    assert all(of[-1] < 0.9 * of[0] for of in losses.values()), losses
    for vae, tensors in trained:
        model = replace(random_model(human_human=robot is None), vae=vae, tensors=tensors)
        rows = model_rows(model, trials)
        assert [row.model for row in rows] == [BUETEPAGE] * N_ACTIONS
        assert all(np.isfinite(row.mse_mean) for row in rows)


def test_recorded_joints_are_learnt_without_a_second_human(few: list[Trial]) -> None:
    """As HRI-Yumi: one human, and joints whose places are far apart."""
    rng = np.random.default_rng(0)
    robot = replace(PEPPER, name="other", joint_names=("a", "b"))

    def recorded(trial: Trial) -> Trial:
        joints = np.cumsum(rng.normal(size=(trial.n_frames, 2)), axis=0) * 0.02 + [-5.0, 1.0]
        return replace(trial, partner_arm=None, robot_joints=joints, robot_joint_names=robot.joint_names)

    trials = [recorded(trial) for trial in few]
    vae, tensors = train_models(trials, ACTIONS, robot, replace(QUICK, seeds=1), silent)[0]
    model = replace(random_model(), robot=robot, vae=vae, tensors=tensors)
    np.testing.assert_allclose(tensors["rest"], [-5.0, 1.0], atol=0.2)
    predicted = predict_windows(model, stack_windows(trials, robot.joint_names))
    np.testing.assert_allclose(np.nanmean(predicted.reshape(-1, WINDOW, 2), axis=(0, 1)), [-5.0, 1.0], atol=0.5)


def test_a_seed_repeats_and_seeds_differ(few: list[Trial]) -> None:
    options = replace(QUICK, epochs=1)
    (first, other), (again, _) = (train_models(few[::3], ACTIONS, PEPPER, options, silent) for _ in range(2))
    (changed, _) = train_models(few[::3], ACTIONS, PEPPER, replace(options, seed=1), silent)
    for name, value in first[1].items():
        np.testing.assert_array_equal(value, again[1][name])
        if name != "rest":
            assert (value != other[1][name]).any() and (value != changed[1][name]).any()


# the folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return save_buetepage(random_model(), tmp_path / "model", "# model\n").path


@pytest.mark.parametrize("human_human", [False, True])
def test_what_is_saved_is_loaded(tmp_path: Path, human_human: bool) -> None:
    original = replace(random_model(human_human=human_human), training={"seed": 3})
    loaded = save_buetepage(original, tmp_path / "model", "")
    assert loaded.path == tmp_path / "model" and loaded.training == {"seed": 3} and loaded.robot == original.robot
    frames = np.random.default_rng(0).normal(size=(5, 18))
    np.testing.assert_array_equal(loaded.predict("rocket", frames), original.predict("rocket", frames))


def test_each_kind_of_folder_is_loaded_as_what_it_is(folder: Path, tmp_path: Path) -> None:
    mild = save_checkpoint(random_checkpoint(), tmp_path / "mild", "").path
    assert is_buetepage(folder) and not is_buetepage(mild) and not is_buetepage(tmp_path / "none")
    assert isinstance(load_model(folder), Buetepage) and not isinstance(load_model(mild), Buetepage)
    with pytest.raises(UserError, match=r"model of kind 'buetepage', expected a MILD checkpoint"):
        load_checkpoint(folder)
    with pytest.raises(UserError, match=r"mild is no model of kind 'buetepage'"):
        load_buetepage(mild)
    check_checkpoint_target(folder)
    (folder / "thesis.txt").write_text("precious")
    with pytest.raises(UserError, match="besides a checkpoint's files it holds thesis.txt"):
        save_buetepage(random_model(), folder, "")


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("actions", ["wave", "jump"], "action 'jump' is unknown"),
        ("actions", ["wave", "wave"], "expected one action or more, each once"),
        ("actions", ["wave"], r"human_lstm.input_weight' has shape \(168, 22\), expected \(168, 19\)"),
        ("schema_version", 7, "schema_version is 7, this program reads 1"),
        ("robot", {"name": "pepper"}, "robot: missing joint_names"),
        ("robot", None, r"tensor 'encoder.0.weight' has shape \(40, 20\), expected \(40, 90\)"),
        ("rate", "fast", "rate is 'fast', expected a number"),
        ("training", 5, r"training is 5, expected an object"),
        ("dataset", {"name": "demo"}, "dataset.checksum is None, expected a text"),
    ],
)
def test_a_bad_config_is_named(folder: Path, field: str, value: Any, message: str) -> None:
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**config, field: value}))
    with pytest.raises(UserError, match=message):
        load_buetepage(folder)


def test_bad_weights_are_named(folder: Path) -> None:
    file = folder / "weights.safetensors"
    tensors = load_file(file)
    del tensors["rest"]
    save_file(tensors, file)
    with pytest.raises(UserError, match=r"weights\.safetensors: tensor 'rest' is missing"):
        load_buetepage(folder)
    file.write_bytes(b"nothing")
    with pytest.raises(UserError, match="is not a readable safetensors file"):
        load_buetepage(folder)
    file.unlink()
    with pytest.raises(UserError, match="weights.safetensors is missing"):
        load_buetepage(folder)


# the command


def test_the_command_trains_a_model_that_is_evaluated(
    tmp_path: Path, few: list[Trial], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source = load_dataset("demo")
    small = replace(source, train=tuple(few), test=source.test[::4])
    monkeypatch.setattr("mild_viz.training.run.load_dataset", lambda _: small)
    out = tmp_path / "made"
    assert main(["train-baseline", "--out", str(out), "--seeds", "2", "--epochs", "1", "--seed", "5"]) == 0
    assert f"mild-viz evaluate --checkpoint {out} --dataset demo" in capsys.readouterr().out
    model = load_buetepage(out)
    assert model.dataset_checksum == source.checksum and model.robot == PEPPER
    assert model.training["command"].endswith(f"--seeds 2 --epochs 1 --seed 5 --out {out}")
    assert len(model.training["held_out_trials"]) == N_ACTIONS and len(model.metrics["test_seeds"]) == 2
    assert model.metrics["held_out"][model.training["chosen"]] == min(model.metrics["held_out"])
    assert model.metrics["test"] == model.metrics["test_seeds"][model.training["chosen"]]
    # beside a MILD checkpoint, on the same windows
    mild = save_checkpoint(random_checkpoint(), tmp_path / "mild", "").path
    monkeypatch.setattr("mild_viz.evaluation.report.load_dataset", lambda _: small)
    result = evaluate([mild, out], "demo")
    rows = {(row.model, row.action): row for row in result.rows}
    for of in model.metrics["test"]:
        measured, beside = rows[BUETEPAGE, of["action"]], rows["v3.1", of["action"]]
        assert measured.mse_mean == of["mse_mean"] and measured.checkpoint == "made"
        assert (measured.n_windows, measured.n_trials) == (beside.n_windows, beside.n_trials)
    assert {(one.model, one.statistic, one.n_runs) for one in result.over_runs} == {
        (BUETEPAGE, "best", 2), (BUETEPAGE, "median", 2)
    }  # fmt: skip
    assert "our implementation" in (out / "README.md").read_text().lower()


def test_options_out_of_range_are_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="seeds is 0; valid: 1 to 256"):
        train_buetepage("demo", out=tmp_path / "model", seeds=0)
    with pytest.raises(UserError, match="epochs is 0; valid: 1 to"):
        train_buetepage("demo", out=tmp_path / "model", epochs=0)


def test_a_dataset_without_a_second_human_is_named(tmp_path: Path, dataset: Any) -> None:
    dataset("yumi")
    with pytest.raises(UserError, match="has no second human"):
        train_buetepage("yumi", out=tmp_path / "model", human_human=True)
