"""Training: the batched network, the frozen-stage reduction, held-out choice, resuming, and that it learns."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mild_viz.checkpoint import load_checkpoint
from mild_viz.data.load import load_dataset
from mild_viz.errors import UserError
from mild_viz.evaluation.metrics import model_rows
from mild_viz.latent.gmr import condition
from mild_viz.latent.hmm import unobserved_forward
from mild_viz.latent.interaction import InteractionModel
from mild_viz.latent.vae import VAE
from mild_viz.pairs import Windows, stack_windows
from mild_viz.robot.robots import ROBOTS
from mild_viz.settings import PAPER_VARIANTS, VARIANTS
from mild_viz.training import run as training_run
from mild_viz.training.human_stage import HumanModel, train_human_stage
from mild_viz.training.networks import BatchedVAE, gaussian_kl, standard_kl
from mild_viz.training.options import TrainingOptions
from mild_viz.training.outcome import choose_seed, mean_errors
from mild_viz.training.priors import complete_rows, prior_states
from mild_viz.training.robot_stage import conditional_factors, train_robot_stage
from mild_viz.training.run import hold_out, train
from mild_viz.training.state import RunState
from mild_viz.training.transition import learn_transition_states
from tests.disk import full_disk
from tests.models import ACTIONS, random_checkpoint

JOINTS = ROBOTS["pepper"].joint_names
QUICK = TrainingOptions(seeds=2, human_epochs=3, robot_epochs=3, final_em_iterations=5)


def quick(seeds: int, epochs: int, **others: Any) -> TrainingOptions:
    return TrainingOptions(
        seeds=seeds, human_epochs=epochs, robot_epochs=epochs, joint_epochs=epochs, members=2, **others
    )


def silent(*_: Any) -> None:
    pass


@pytest.fixture(scope="module")
def few() -> list[Any]:
    """Three demo trials of every action."""
    trials = load_dataset("demo").train
    return [trial for action in ACTIONS for trial in [t for t in trials if t.action == action][:3]]


@pytest.fixture(scope="module")
def human_data(few: list[Any]) -> Windows:
    return stack_windows(few, None)


@pytest.fixture(scope="module")
def humans(human_data: Windows) -> list[HumanModel]:
    return train_human_stage(human_data, QUICK, silent)


def test_exported_vae_equals_the_batched_network() -> None:
    rng = torch.Generator().manual_seed(0)
    x = 3 + 2 * torch.randn(7, 20, generator=rng)
    net = BatchedVAE(3, x.mean(0), torch.full((20,), 1.7), (40, 20), 5, rng)
    for model in range(3):
        vae = net.export(model)
        mean, log_std = net.encode(net.standardise(x).expand(3, -1, -1))
        np.testing.assert_allclose(vae.encode(x.double().numpy())[0], mean[model].detach().numpy(), atol=1e-5)
        np.testing.assert_allclose(vae.encode(x.double().numpy())[1], log_std[model].exp().detach().numpy(), atol=1e-5)
        decoded = net.decode(mean)[model] * 1.7 + x.mean(0)
        np.testing.assert_allclose(
            vae.decode(mean[model].detach().double().numpy()), decoded.detach().numpy(), atol=1e-4
        )


def test_kl_is_torchs() -> None:
    rng = torch.Generator().manual_seed(1)
    mean, log_std = torch.randn(4, 5, generator=rng), 0.3 * torch.randn(4, 5, generator=rng)
    root = torch.randn(4, 5, 5, generator=rng)
    covariance = root @ root.mT + torch.eye(5)
    prior_mean = torch.randn(4, 5, generator=rng)
    ours = gaussian_kl(mean, log_std, prior_mean, covariance.inverse(), covariance.logdet())
    q = torch.distributions.MultivariateNormal(mean, torch.diag_embed(torch.exp(2 * log_std)))
    p = torch.distributions.MultivariateNormal(prior_mean, covariance)
    torch.testing.assert_close(ours, torch.distributions.kl_divergence(q, p), atol=1e-4, rtol=1e-4)
    standard = torch.distributions.MultivariateNormal(torch.zeros(5), torch.eye(5))
    torch.testing.assert_close(standard_kl(mean, log_std), torch.distributions.kl_divergence(q, standard))


def test_prior_states_follow_the_unobserved_forward_variable(humans: list[HumanModel], human_data: Windows) -> None:
    states = prior_states(humans[0].hmms, human_data)
    rows = human_data.rows(4)
    expected = unobserved_forward(humans[0].hmms[human_data.actions[4]], rows.stop - rows.start).argmax(1)
    np.testing.assert_array_equal(states[rows], expected)


@pytest.mark.parametrize("variant", ["v2.1", "v2.2", "v3.1", "v3.2"])
def test_training_samples_have_the_papers_distribution(
    humans: list[HumanModel], human_data: Windows, variant: str
) -> None:
    data = complete_rows(human_data)
    centre, factor = conditional_factors(humans[0], data, VARIANTS[variant])
    row = 200
    trial, step = int(data.trial[row]), int(data.step[row])
    hmm = humans[0].hmms[data.actions[trial]]
    log_alpha = unobserved_forward(hmm, step + 1)[step:]
    mean, std = humans[0].vae.encode(data.human[row : row + 1])
    posterior = std if VARIANTS[variant].posterior_covariance else None
    expected, covariance = condition(hmm, mean, log_alpha, posterior)
    np.testing.assert_allclose(centre[row], expected[0], atol=1e-10)
    if VARIANTS[variant].conditional_training == "conditional-samples":
        np.testing.assert_allclose(factor[row] @ factor[row].T, covariance[0], atol=1e-5)
    else:  # conditioned samples of the posterior, by brute force
        eps = np.random.default_rng(0).normal(size=(50, 5))
        brute, _ = condition(
            hmm,
            mean + std * eps,
            np.repeat(log_alpha, 50, axis=0),
            None if posterior is None else np.repeat(std, 50, axis=0),
        )
        np.testing.assert_allclose(centre[row] + eps @ factor[row].T, brute, atol=1e-9)


def test_seeds_differ_and_a_seed_repeats(human_data: Windows, humans: list[HumanModel]) -> None:
    again = train_human_stage(human_data, QUICK, silent)
    for one, two in zip(humans, again, strict=True):
        np.testing.assert_array_equal(one.vae.weights["output.weight"], two.vae.weights["output.weight"])
    assert not np.allclose(humans[0].vae.weights["output.weight"], humans[1].vae.weights["output.weight"])


def test_conditional_training_lowers_the_error_of_conditioned_predictions(
    few: list[Any], humans: list[HumanModel]
) -> None:
    data = stack_windows(few, JOINTS)
    options = replace(QUICK, robot_epochs=12)
    robots = train_robot_stage(data, humans, ("v1", "v3.1"), options, silent)
    usable = complete_rows(data)
    for human, robot in zip(humans, robots, strict=True):
        centre, _ = conditional_factors(human, usable, VARIANTS["v3.1"])
        errors = {name: ((vae.decode(centre) - usable.partner) ** 2).mean() for name, vae in robot.items()}
        constant = ((usable.partner.mean(0) - usable.partner) ** 2).mean()
        assert errors["v3.1"] < constant and errors["v3.1"] < errors["v1"]


class Interrupted(Exception):
    pass


@pytest.mark.parametrize("stage", ["human", "robot"])
def test_a_killed_run_goes_on_to_the_same_result(
    few: list[Any], human_data: Windows, tmp_path: Path, stage: str
) -> None:
    def go(state: RunState, progress: Any) -> list[Any]:
        humans = train_human_stage(human_data, QUICK, progress, state)
        return train_robot_stage(stack_windows(few, JOINTS), humans, ("v3.1",), QUICK, progress, state)

    def kill(name: str, epoch: int, *_: Any) -> None:
        if name == stage and epoch == 2:
            raise Interrupted

    undisturbed = RunState(tmp_path / "whole", {}, QUICK, resume=False)
    whole = go(undisturbed, silent)
    undisturbed.finish()
    state = RunState(tmp_path / "killed", {}, QUICK, resume=False)
    with pytest.raises(Interrupted):
        go(state, kill)
    with pytest.raises(UserError, match="held by another run"):
        RunState(tmp_path / "killed", {}, QUICK, resume=True)
    state.release()  # as the end of the process does, however it ends
    with pytest.raises(UserError, match="unfinished run: go on with --resume"):
        RunState(tmp_path / "killed", {}, QUICK, resume=False)
    again = RunState(tmp_path / "killed", {}, QUICK, resume=True)
    resumed = go(again, silent)
    again.finish()
    for one, two in zip(whole, resumed, strict=True):
        for name, value in one["v3.1"].weights.items():
            np.testing.assert_array_equal(value, two["v3.1"].weights[name], err_msg=name)


def test_resuming_something_else_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="nothing to resume"):
        RunState(tmp_path / "run", {"dataset": "demo"}, QUICK, resume=True)
    RunState(tmp_path / "run", {"dataset": "demo"}, QUICK, resume=False).release()
    with pytest.raises(UserError, match="dataset was demo, asked for is nuisi"):
        RunState(tmp_path / "run", {"dataset": "nuisi"}, QUICK, resume=True)


def test_held_out_trials_are_the_last_of_every_action() -> None:
    trials = load_dataset("demo").train
    fit, held = hold_out(trials, 1)
    assert {trial.action for trial in held} == set(ACTIONS)
    assert len(held) == 4 and len(fit) == len(trials) - 4
    assert not {trial.index for trial in fit} & {trial.index for trial in held}
    assert hold_out(trials[:2], 1) == (list(trials[:2]), [])


def test_the_seed_is_chosen_by_held_out_error() -> None:
    held = hold_out(load_dataset("demo").train, 1)[1]
    candidates = [random_checkpoint(seed) for seed in range(3)]
    scores = [mean_errors(model_rows(candidate, held)) for candidate in candidates]
    best = choose_seed(scores)
    means = [np.mean([score[v] for v in PAPER_VARIANTS if v != "v1"]) for score in scores]
    assert best == int(np.argmin(means)) and len(scores) == 3


def test_the_command_writes_a_checkpoint_and_never_chooses_by_the_test_split(
    tmp_path: Path, few: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = load_dataset("demo")
    small = replace(whole, train=tuple(few), test=whole.test[::4])
    monkeypatch.setattr(training_run, "load_dataset", lambda _: small)
    out = tmp_path / "runs" / "model"
    made = train("demo", "hri", ("v3.1", "v1"), quick(2, 2), out, command="a command")
    assert made.variants == ("v3.1", "v1") and made.placement is not None and made.placement.estimated
    assert set(made.contact_states) == set(ACTIONS)
    assert made.contact_states["wave"] == frozenset() and made.contact_states["handshake"]
    fit = stack_windows(hold_out(few, TrainingOptions().held_out)[0], None)
    fitted = InteractionModel(made.human_vae, made.hmms, made.human_vae)
    states = learn_transition_states(fitted, made.contact_states, fit)
    assert states and made.transition_states.keys() == states.keys()
    for action, state in states.items():
        np.testing.assert_allclose(
            made.transition_states[action].mean, state.mean, atol=1e-4
        )  # saved weights are rounded
    config = json.loads((out / "config.json").read_text())
    assert config["training"]["command"] == "a command" and config["rate"] == 30.0
    assert config["dataset"] == {"name": "demo", "checksum": whole.checksum}
    assert len(config["metrics"]["held_out"]) == 2
    assert [p.name for p in out.parent.iterdir()] == ["model"]

    shuffled = replace(small, test=tuple(reversed(whole.test[1::4])))
    monkeypatch.setattr(training_run, "load_dataset", lambda _: shuffled)
    again = train("demo", "hri", ("v3.1", "v1"), quick(2, 2), tmp_path / "again")
    assert (again.path / "weights.safetensors").read_bytes() == (out / "weights.safetensors").read_bytes()

    human = train("demo", "hhi", ("v1",), quick(1, 1), tmp_path / "human")
    assert human.robot is None and load_checkpoint(human.path).variants == ("v1",)


def test_wrong_options_are_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="stage 'all' is unknown; valid: hhi, hri"):
        train("demo", "all", out=tmp_path / "x")
    with pytest.raises(UserError, match="variant 'v7' is unknown"):
        train("demo", variants=("v7",), out=tmp_path / "x")
    with pytest.raises(UserError, match="seeds is 0; valid: 1 to 256"):
        train("demo", options=TrainingOptions(seeds=0), out=tmp_path / "x")
    (tmp_path / "notes.txt").write_text("precious")
    with pytest.raises(UserError, match="notes"):
        train("demo", out=tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


def test_a_damaged_state_is_named(tmp_path: Path) -> None:
    state = RunState(tmp_path / "run", {}, QUICK, resume=False)
    (state.folder / "human.pt").write_bytes(b"half a fi")
    with pytest.raises(UserError, match=r"human\.pt is damaged"):
        state.load("human")
    state.release()
    (state.folder / "run.json").write_text("[]")
    with pytest.raises(UserError, match=r"run\.json is damaged"):
        RunState(tmp_path / "run", {}, QUICK, resume=True)


def test_a_full_disk_leaves_the_last_state(tmp_path: Path) -> None:
    with RunState(tmp_path / "run", {}, QUICK, resume=False) as state:
        state.save("human", {"epoch": 1})
        with full_disk(1000), pytest.raises(UserError, match=r"human\.pt cannot be written"):
            state.save("human", {"epoch": 2, "net": torch.zeros(1000)})
        assert state.load("human") == {"epoch": 1}
        assert sorted(path.name for path in state.folder.iterdir()) == ["human.pt", "lock", "run.json"]


def test_a_diverged_seed_is_never_chosen() -> None:
    held = hold_out(load_dataset("demo").train, 1)[1]
    good = random_checkpoint(0)
    weights = {name: np.full_like(value, np.nan) for name, value in good.members("v3.1")[0].robot_vae.weights.items()}
    broken = replace(good, robot_vaes={**good.robot_vaes, "v3.1": VAE(weights)})
    bad, fine = (mean_errors(model_rows(candidate, held)) for candidate in (broken, good))
    assert choose_seed([bad, fine]) == 1
    with pytest.raises(UserError, match="every seed diverged"):
        choose_seed([bad, bad])


def test_recordings_without_contact_or_without_any_window(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = load_dataset("demo")
    waves = replace(whole, train=tuple(t for t in whole.train if t.action == "wave")[:3], test=whole.test)
    monkeypatch.setattr(training_run, "load_dataset", lambda _: waves)
    made = train("demo", "hri", ("v3.1",), quick(1, 1), tmp_path / "waves")
    assert made.placement is None and made.actions == ("wave",)
    assert "note: no training trial shows handshake, rocket, parachute" in capsys.readouterr().err

    unseen = [replace(t, human_arm=np.full_like(t.human_arm, np.nan)) for t in waves.train]
    monkeypatch.setattr(training_run, "load_dataset", lambda _: replace(waves, train=tuple(unseen)))
    with pytest.raises(UserError, match="action 'wave' has no complete window"):
        train("demo", "hri", ("v3.1",), quick(1, 1), tmp_path / "unseen")
    assert [p.name for p in tmp_path.iterdir()] == ["waves"]
