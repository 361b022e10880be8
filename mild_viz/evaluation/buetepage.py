"""The baseline of Bütepage et al. (2020) as the paper's authors configured it: our implementation, in NumPy.

    human frame, action -> LSTM -> latent d                      (human dynamics)
    robot joints, action, d -> LSTM -> tanh layers -> z -> robot VAE's decoder      (robot dynamics)
    or, between humans, d -> tanh layers of the partner -> z -> human VAE's decoder

Every row observes one frame, the newest of its human window (frame t + 4), and predicts the partner's next window
(frames t + 5 to t + 9), as MILD does. The robot's joints are never observed: a row reads the first frame of the window
that the row before it predicted, and the first row reads the rest pose, the mean over training trials of the first
frame that is predicted.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.special import expit

from mild_viz.checkpoint import CONFIG, Checkpoint, RobotInterface, load_checkpoint
from mild_viz.checkpoint.config import SCHEMA_VERSION, parse_robot
from mild_viz.checkpoint.fields import read_json
from mild_viz.checkpoint.folder import WEIGHTS, load_tensors, save_folder
from mild_viz.errors import UserError
from mild_viz.latent.vae import VAE, checked_tensors, make_vae
from mild_viz.pairs import Windows
from mild_viz.settings import ARM_FEATURES, WINDOW, choose
from mild_viz.trial import ACTIONS, ARM_POINTS

BUETEPAGE = "buetepage"
"""Name of the model in tables, and `kind` in its config.json."""

VAE_HIDDEN = (40, 20)
LATENT_SIZE = 5
LSTM_SIZE = 42
DYNAMICS_LATENT_SIZE = 5
"""Size of d."""
HUMAN_LAYERS = (5, 5)
ROBOT_LAYERS = (40, 40)
"""Widths of the tanh layers before z."""

State = tuple[np.ndarray, np.ndarray]
"""Hidden and cell vector of an LSTM."""


@dataclass(frozen=True, eq=False)
class LSTM:
    """A long short-term memory of H units; G = 4 H gates in the order input, forget, cell, output (as torch's)."""

    input_weight: Float[np.ndarray, "G I"]
    recurrent_weight: Float[np.ndarray, "G H"]
    bias: Float[np.ndarray, " G"]

    def start(self) -> State:
        n_hidden = self.recurrent_weight.shape[1]
        return np.zeros(n_hidden), np.zeros(n_hidden)

    def step(self, x: Float[np.ndarray, " I"], state: State) -> State:
        """The state after one more input."""
        hidden, cell = state
        gates = self.input_weight @ x + self.recurrent_weight @ hidden + self.bias
        enter, keep, new, leave = gates.reshape(4, -1)
        cell = expit(keep) * cell + expit(enter) * np.tanh(new)
        return expit(leave) * np.tanh(cell), cell


@dataclass(frozen=True, eq=False)
class Layers:
    """Affine layers with tanh between them, none after the last."""

    weights: tuple[Float[np.ndarray, "..."], ...]
    biases: tuple[Float[np.ndarray, "..."], ...]

    def __call__(self, x: Float[np.ndarray, " I"]) -> Float[np.ndarray, " O"]:
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = np.tanh(weight @ x + bias)
        return self.weights[-1] @ x + self.biases[-1]


@dataclass(frozen=True, eq=False)
class Buetepage:
    """A trained baseline: what a prediction needs of it."""

    path: Path
    name: str
    dataset: str
    dataset_checksum: str
    actions: tuple[str, ...]
    """In the order of the one-hot code."""
    robot: RobotInterface | None
    """None where the partner is the second human."""
    vae: VAE
    """Of the predicted partner."""
    tensors: Mapping[str, Float[np.ndarray, "..."]]
    """Weights of the dynamics by name, as `dynamics_shapes` lists them."""
    rate: float
    """Frames a second of the trials that it was trained on [Hz]."""
    training: Mapping[str, Any] = field(default_factory=dict)
    metrics: Mapping[str, Any] = field(default_factory=dict)

    points = ARM_POINTS
    """What it reads of the human."""

    @property
    def variants(self) -> tuple[str, ...]:
        """What it is called in a table of errors."""
        return (BUETEPAGE,)

    def _lstm(self, name: str) -> LSTM:
        return LSTM(*(self.tensors[f"{name}.{tensor}"] for tensor in ("input_weight", "recurrent_weight", "bias")))

    def _layers(self, *names: str) -> Layers:
        weights, biases = (tuple(self.tensors[f"{name}.{kind}"] for name in names) for kind in ("weight", "bias"))
        return Layers(weights, biases)

    def predict(self, action: str, frames: Float[np.ndarray, "N 18"]) -> Float[np.ndarray, "N Y"]:
        """Partner windows after each of the human frames of one trial, in the order in which they were observed."""
        choose(f"model {self.name}: action", action, self.actions)
        label = np.array([float(of == action) for of in self.actions])
        human, dynamics_latent, head = self._lstm("human_lstm"), self._layers("latent_mean"), self._layers(*HEAD)
        robot = self._lstm("robot_lstm") if self.robot else None
        human_state, robot_state = human.start(), robot.start() if robot else human.start()
        joints = self.tensors["rest"] if robot else np.empty(0)
        predicted = np.empty((len(frames), self.vae.input_size))
        for n, frame in enumerate(frames):
            human_state = human.step(np.concatenate([frame, label]), human_state)
            d = dynamics_latent(human_state[0])
            if robot:
                robot_state = robot.step(np.concatenate([joints, label, d]), robot_state)
                d = robot_state[0]
            predicted[n] = self.vae.decode(head(d)[None])[0]
            joints = predicted[n, : len(joints)]
        return predicted


HEAD = ("head.0", "head.1", "z_mean")


def predict_windows(model: Buetepage, data: Windows) -> Float[np.ndarray, "R Y"]:
    """Partner windows that the baseline predicts from the newest frame of every human window.

    A row whose human window has a gap is NaN, and the recurrent networks skip it.
    """
    predicted = np.full_like(data.partner, np.nan)
    observed = np.logical_and.reduce(np.isfinite(data.human), axis=1)
    for trial, action in enumerate(data.actions):
        rows = np.arange(len(observed))[data.rows(trial)]
        rows = rows[observed[rows]]
        predicted[rows] = model.predict(action, data.human[rows, -ARM_FEATURES:])
    return predicted


def dynamics_shapes(n_actions: int, n_joints: int | None) -> dict[str, tuple[int, ...]]:
    """Shape of every tensor of the dynamics; `n_joints` is None where the partner is a human."""
    gates = 4 * LSTM_SIZE
    shapes: dict[str, tuple[int, ...]] = {
        "human_lstm.input_weight": (gates, ARM_FEATURES + n_actions),
        "human_lstm.recurrent_weight": (gates, LSTM_SIZE),
        "human_lstm.bias": (gates,),
        "latent_mean.weight": (DYNAMICS_LATENT_SIZE, LSTM_SIZE),
        "latent_mean.bias": (DYNAMICS_LATENT_SIZE,),
    }
    if n_joints is not None:
        shapes |= {
            "robot_lstm.input_weight": (gates, n_joints + n_actions + DYNAMICS_LATENT_SIZE),
            "robot_lstm.recurrent_weight": (gates, LSTM_SIZE),
            "robot_lstm.bias": (gates,),
            "rest": (n_joints,),
        }
    widths = (DYNAMICS_LATENT_SIZE, *HUMAN_LAYERS) if n_joints is None else (LSTM_SIZE, *ROBOT_LAYERS)
    for name, before, after in zip(HEAD, widths, (*widths[1:], LATENT_SIZE), strict=True):
        shapes |= {f"{name}.weight": (after, before), f"{name}.bias": (after,)}
    return shapes


def is_buetepage(path: Path) -> bool:
    """Whether a folder holds a baseline, and not a MILD checkpoint (or anything else, which loading will name)."""
    try:
        config = json.loads((path / CONFIG).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(config, dict) and config.get("kind") == BUETEPAGE


def load_model(path: Path) -> Checkpoint | Buetepage:
    """A MILD checkpoint or a baseline, whichever the folder holds."""
    return load_buetepage(path) if is_buetepage(path) else load_checkpoint(path)


def save_buetepage(model: Buetepage, path: Path, readme: str) -> Buetepage:
    """Write a baseline's folder, whole or not at all, and return it as loaded. See `checkpoint.folder.save_folder`."""
    config = {
        "schema_version": SCHEMA_VERSION,
        "kind": BUETEPAGE,
        "name": model.name,
        "dataset": {"name": model.dataset, "checksum": model.dataset_checksum},
        "actions": list(model.actions),
        "robot": asdict(model.robot) if model.robot else None,
        "rate": model.rate,
        "training": dict(model.training),
        "metrics": dict(model.metrics),
    }
    tensors = {f"vae/{name}": value for name, value in model.vae.weights.items()}
    tensors = {name: np.ascontiguousarray(value) for name, value in (tensors | dict(model.tensors)).items()}
    return replace(save_folder(path, tensors, config, readme, load_buetepage), path=path)


CONFIG_FIELDS = {
    "name": (str, "a text"),
    "dataset": (dict, "an object {...}"),
    "actions": (list, "a list [...]"),
    "rate": (float, "a number of frames a second, such as 30.0"),
    "training": (dict, "an object {...}"),
    "metrics": (dict, "an object {...}"),
}


def load_buetepage(path: Path) -> Buetepage:
    """Read a baseline's folder; every tensor is checked against config.json.

    Raises:
        UserError: naming the file, the field or tensor, what was found and what was expected.
    """
    file = path / CONFIG
    config = read_json(file)
    if not isinstance(config, dict) or config.get("kind") != BUETEPAGE:
        raise UserError(f"{path} is no model of kind '{BUETEPAGE}', as written by `mild-viz train-baseline`")
    if config.get("schema_version") != SCHEMA_VERSION:
        found = config.get("schema_version")
        raise UserError(f"{file}: schema_version is {found!r}, this program reads {SCHEMA_VERSION}")
    for key, (kind, expected) in CONFIG_FIELDS.items():
        if not isinstance(config.get(key), kind):
            raise UserError(f"{file}: {key} is {config.get(key)!r}, expected {expected}")
    actions = tuple(choose(f"{file}: action", str(action), ACTIONS) for action in config["actions"])
    if not actions or len(set(actions)) < len(actions):
        raise UserError(f"{file}: actions is {list(actions)}, expected one action or more, each once")
    for key in ("name", "checksum"):
        if not isinstance(config["dataset"].get(key), str):
            raise UserError(f"{file}: dataset.{key} is {config['dataset'].get(key)!r}, expected a text")
    robot = parse_robot(config.get("robot"), f"{file}: robot")
    weights = path / WEIGHTS
    tensors = load_tensors(weights)
    of_vae = {name.removeprefix("vae/"): tensor for name, tensor in tensors.items() if name.startswith("vae/")}
    n_joints = len(robot.joint_names) if robot else None
    input_size = WINDOW * (ARM_FEATURES if n_joints is None else n_joints)
    return Buetepage(
        path=path,
        name=config["name"],
        dataset=config["dataset"]["name"],
        dataset_checksum=config["dataset"]["checksum"],
        actions=actions,
        robot=robot,
        vae=make_vae(of_vae, input_size, VAE_HIDDEN, LATENT_SIZE, f"{weights}: vae"),
        tensors=checked_tensors(tensors, dynamics_shapes(len(actions), n_joints), str(weights)),
        rate=config["rate"],
        training=config["training"],
        metrics=config["metrics"],
    )
