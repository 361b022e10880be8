"""Both kinds of hidden-state model through the product: training, checkpoint, batch, stream, evaluation."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from mild_viz import cli, paths, streaming
from mild_viz.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from mild_viz.data.load import load_dataset
from mild_viz.errors import UserError
from mild_viz.evaluation.metrics import model_rows
from mild_viz.latent.hmm import HMM
from mild_viz.latent.hsmm import HSMM
from mild_viz.latent.state_models import STATE_MODELS, state_model_of
from mild_viz.pipeline import control, infer
from mild_viz.robot.model import load_robot
from mild_viz.settings import ControlSettings
from mild_viz.training import run as training_run
from mild_viz.training.options import TrainingOptions
from tests.models import ACTIONS, random_checkpoint, random_hmm, random_hsmm


def random_model(name: str) -> Checkpoint:
    return random_checkpoint(model={"hmm": random_hmm, "hsmm": random_hsmm}[name])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    save_checkpoint(random_model("hsmm"), tmp_path / "model", "")
    return tmp_path / "model"


@pytest.mark.parametrize("name", STATE_MODELS)
def test_what_is_saved_is_loaded(tmp_path: Path, name: str) -> None:
    original = random_model(name)
    save_checkpoint(original, tmp_path / "model", "")
    loaded = load_checkpoint(tmp_path / "model")
    assert original.state_model == loaded.state_model == name
    assert json.loads((tmp_path / "model" / "config.json").read_text())["state_model"] == name
    for action in original.actions:
        for tensor in STATE_MODELS[name].kind.__dataclass_fields__:
            np.testing.assert_array_equal(getattr(loaded.hmm(action), tensor), getattr(original.hmm(action), tensor))


def test_a_config_that_names_no_state_model_is_an_hmms(tmp_path: Path) -> None:
    folder = Path(shutil.copytree(paths.default_checkpoint("demo"), tmp_path / "older"))
    config = json.loads((folder / "config.json").read_text())
    assert config.pop("state_model") == "hmm"
    (folder / "config.json").write_text(json.dumps(config))
    assert load_checkpoint(folder).state_model == "hmm"


@pytest.mark.parametrize(
    ("value", "message"), [("arhmm", "state_model 'arhmm' is unknown; valid: hmm, hsmm"), (2, "state_model is 2, exp")]
)
def test_a_wrong_state_model_is_named(folder: Path, value: object, message: str) -> None:
    file = folder / "config.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "state_model": value}))
    with pytest.raises(UserError, match=message):
        load_checkpoint(folder)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda tensors: tensors.pop("hmm/wave/duration_means"), "'hmm/wave/duration_means' is missing"),
        (lambda t: t.update({"hmm/wave/duration_stds": np.ones(5)}), r"duration_stds' has shape \(5,\), expected \(6,"),
        (lambda t: t.update({"hmm/wave/duration_stds": np.zeros(6)}), "hmm/wave: duration_stds are .* valid: 0.001"),
        (lambda t: t.update({"hmm/wave/duration_means": np.full(6, np.nan)}), "duration_means has values that are not"),
        (lambda t: t.update({"hmm/wave/transition_matrix": np.full((6, 6), 1 / 6)}), r"\[0, 1, 2, 3, 4\] follow them"),
    ],
)
def test_wrong_tensors_are_named(folder: Path, edit: Callable[[dict], object], message: str) -> None:
    tensors = load_file(folder / "weights.safetensors")
    edit(tensors)
    save_file(tensors, folder / "weights.safetensors")
    with pytest.raises(UserError, match=message):
        load_checkpoint(folder)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Checkpoint:
    """A semi-Markov model by the command, on few demo trials."""
    whole, out = load_dataset("demo"), tmp_path_factory.mktemp("trained") / "model"
    few = tuple(t for action in ACTIONS for t in [t for t in whole.train if t.action == action][:4])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training_run, "load_dataset", lambda _: replace(whole, train=few, test=whole.test[::4]))
        command = "train --dataset demo --variant v3.2 --seeds 2 --epochs 5 --state-model hsmm --out"
        cli.main([*command.split(), str(out)])
    return load_checkpoint(out)


def test_the_command_trains_durations(trained: Checkpoint) -> None:
    assert trained.state_model == "hsmm"
    assert trained.training["options"]["state_model"] == "hsmm"
    assert "--state-model hsmm" in trained.training["command"]
    for action in trained.actions:
        hmm = trained.hmm(action)
        assert isinstance(hmm, HSMM) and state_model_of(hmm) == "hsmm"
        assert np.ptp(hmm.duration_means) > 1.0  # they are no longer the equal split's
    assert all(np.isfinite(row.mse_mean) for row in model_rows(trained, load_dataset("demo").test[::4]))
    with pytest.raises(UserError, match="state_model 'arhmm' is unknown; valid: hmm, hsmm"):
        TrainingOptions(state_model="arhmm")


def test_streaming_equals_batch(trained: Checkpoint) -> None:
    trial = next(t for t in load_dataset("demo").test if t.action == "handshake")
    arm = trial.human_arm.copy()
    arm[70:73], arm[100:130] = np.nan, np.nan
    trial, robot = replace(trial, human_arm=arm), load_robot("pepper")
    inference = infer(trained, trial, "v3.2")
    rollout = control(inference, trained, robot, trial, ControlSettings())
    stream = streaming.stream_model(
        trained, "v3.2", trial.action, robot, ControlSettings(), rollout.T_world_human, trial.rate
    )
    carry = streaming.start(stream)
    for frame, seen in enumerate(arm[: inference.n_windows + 4]):
        carry, command = streaming.step(stream, carry, seen)
        if command is None:
            continue
        n = frame - 4
        for name, array in (
            ("log_alpha", inference.log_alpha_human),
            ("joints_decoded", inference.joints_decoded),
            ("joints_commanded", rollout.joints_commanded),
        ):
            np.testing.assert_allclose(getattr(command, name), array[n], atol=1e-9, rtol=0, err_msg=f"{name} at {n}")
    assert rollout.state_occupancy.sum() == pytest.approx(1.0)
    for alpha in (inference.log_alpha_human, inference.log_alpha_joint, inference.log_alpha_unobserved):
        np.testing.assert_allclose(np.exp(alpha).sum(1), 1.0, atol=1e-12)


def test_a_marginal_keeps_the_kind() -> None:
    for name, entry in STATE_MODELS.items():
        joint = random_model(name).hmm("wave")
        part: HMM = joint.marginal(slice(0, 5))
        assert type(part) is entry.kind and part.emission_means.shape == (6, 5)
