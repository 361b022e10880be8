"""Our checkpoint format: a folder with weights.safetensors, config.json, README.md and contact_states.json."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from mild_viz.errors import UserError
from mild_viz.files import write_atomically
from mild_viz.latent.hmm import HMM, check_hmm
from mild_viz.latent.vae import VAE, make_vae
from mild_viz.settings import VARIANTS, WINDOW, Placement, Variant, choose
from mild_viz.trial import ACTIONS

SCHEMA_VERSION = 1
WEIGHTS, CONFIG, README, CONTACT_STATES = "weights.safetensors", "config.json", "README.md", "contact_states.json"
FILES = (WEIGHTS, CONFIG, README, CONTACT_STATES)
FEATURES = 18
"""Human features of one frame: three arm joints, position and velocity."""


@dataclass(frozen=True)
class RobotInterface:
    """The robot that a model was trained for: its joints in the order of the model's output."""

    name: str
    joint_names: tuple[str, ...]
    end_effector: str


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A trained model: one human VAE and, per action, one HMM; one robot VAE per variant."""

    path: Path
    name: str
    dataset: str
    dataset_checksum: str
    human_vae: VAE
    hmms: Mapping[str, HMM]
    robot_vaes: Mapping[str, VAE]
    robot: RobotInterface | None
    """None for a human-human model: the partner is then the second human."""
    contact_states: Mapping[str, frozenset[int]] = field(default_factory=dict)
    """States in which the partners touch, by action."""
    placement: Placement | None = None
    hidden: tuple[int, int] = (40, 20)
    training: Mapping[str, Any] = field(default_factory=dict)
    """The command, seed and settings that made it."""
    metrics: Mapping[str, Any] = field(default_factory=dict)

    @property
    def variants(self) -> tuple[str, ...]:
        return tuple(self.robot_vaes)

    @property
    def actions(self) -> tuple[str, ...]:
        return tuple(self.hmms)

    @property
    def n_states(self) -> int:
        return next(iter(self.hmms.values())).n_states

    def hmm(self, action: str) -> HMM:
        choose(f"checkpoint {self.name}: action", action, self.actions)
        return self.hmms[action]

    def robot_vae(self, variant: str) -> VAE:
        choose(f"checkpoint {self.name}: variant", variant, self.variants)
        return self.robot_vaes[variant]

    def for_robot(self) -> RobotInterface:
        """The robot interface, or an error if this is a human-human model."""
        if self.robot is None:
            raise UserError(
                f"checkpoint {self.name} is a human-human model and drives no robot; train --stage hri first"
            )
        return self.robot


def _tensors(checkpoint: Checkpoint) -> dict[str, np.ndarray]:
    tensors = {f"human/{name}": value for name, value in checkpoint.human_vae.weights.items()}
    for action, hmm in checkpoint.hmms.items():
        for name in HMM.__dataclass_fields__:
            tensors[f"hmm/{action}/{name}"] = getattr(hmm, name)
    for variant, vae in checkpoint.robot_vaes.items():
        tensors |= {f"robot/{variant}/{name}": value for name, value in vae.weights.items()}
    return {name: np.ascontiguousarray(value) for name, value in tensors.items()}


def _config(checkpoint: Checkpoint) -> dict[str, Any]:
    return {
        "schema_version": SCHEMA_VERSION,
        "name": checkpoint.name,
        "dataset": {"name": checkpoint.dataset, "checksum": checkpoint.dataset_checksum},
        "window": WINDOW,
        "hidden": list(checkpoint.hidden),
        "latent_size": checkpoint.human_vae.latent_size,
        "n_states": checkpoint.n_states,
        "actions": list(checkpoint.actions),
        "robot": asdict(checkpoint.robot) if checkpoint.robot else None,
        "variants": {name: asdict(VARIANTS[name]) for name in checkpoint.variants},
        "contact_states": {action: sorted(states) for action, states in checkpoint.contact_states.items()},
        "placement": asdict(checkpoint.placement) if checkpoint.placement else None,
        "training": dict(checkpoint.training),
        "metrics": dict(checkpoint.metrics),
    }


def _read_json(file: Path) -> Any:
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{file} cannot be read: {error.strerror or error}") from None
    except (ValueError, RecursionError) as error:  # no JSON, no UTF-8, a number of thousands of digits; deep nesting
        raise UserError(f"{file} is not valid JSON: {error}") from None


def check_checkpoint_target(out: Path) -> None:
    """Refuse a place where saving a checkpoint would delete anything else: the folder is replaced whole.

    Raises:
        UserError: unless `out` is absent, an empty folder, or holds nothing but a checkpoint's own files.
    """
    advice = "choose a new folder with --out"
    try:
        found = {entry.name: entry.is_file() for entry in out.iterdir()}
    except FileNotFoundError:
        return
    except OSError as error:
        raise UserError(f"{out} cannot be a checkpoint folder: {error.strerror or error}; {advice}") from None
    others = sorted(name for name, is_file in found.items() if name not in FILES or not is_file)
    if others:
        raise UserError(
            f"{out} is not a checkpoint folder: besides a checkpoint's files it holds {', '.join(others[:5])}"
            f"{' and more' if len(others) > 5 else ''}, which would be deleted; {advice}"
        )
    if not found:
        return
    config = _read_json(out / CONFIG) if CONFIG in found else None
    if not isinstance(config, dict) or config.get("schema_version") != SCHEMA_VERSION:
        raise UserError(
            f"{out} is not a checkpoint folder: it holds {', '.join(sorted(found))}, but no {CONFIG} "
            f"with schema_version {SCHEMA_VERSION}; {advice}"
        )


def save_checkpoint(checkpoint: Checkpoint, path: Path, readme: str) -> Checkpoint:
    """Write a checkpoint's folder, and return it as loaded from there.

    It is built beside its place, loaded to see that it is valid, and then moved there whole. An older
    checkpoint there is replaced, contact_states.json that a person saved in it included: it names states
    of the old model.

    Raises:
        UserError: if `path` holds anything else, cannot be written, or the model is not valid; `path` is
            then as it was.
    """
    check_checkpoint_target(path)
    try:
        target = path.resolve()
        target.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{target.name[:50]}.", dir=target.parent))
        built, old = work / "new", work / "old"
        try:
            built.mkdir()
            save_file(_tensors(checkpoint), built / WEIGHTS)
            (built / WEIGHTS).chmod(0o644)  # safetensors writes for the owner alone
            (built / CONFIG).write_text(json.dumps(_config(checkpoint), indent=2) + "\n", encoding="utf-8")
            (built / README).write_text(readme, encoding="utf-8")
            try:
                loaded = load_checkpoint(built)
            except UserError as error:
                raise UserError(f"{path} is left as it was, the new model is not valid: {error}") from None
            if target.exists():
                os.replace(target, old)
            try:
                os.replace(built, target)
            except OSError:
                if old.exists():
                    os.replace(old, target)
                raise
        finally:
            shutil.rmtree(work, ignore_errors=True)
    except (OSError, SafetensorError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"{path} cannot be written: {reason}; choose another place") from None
    return replace(loaded, path=path)


def _read_config(path: Path) -> dict[str, Any]:
    file = path / CONFIG
    if not path.is_dir() or not file.is_file():
        raise UserError(
            f"{path} is not a checkpoint: expected a folder with {CONFIG} and {WEIGHTS}, "
            "as written by `mild-viz train` or `mild-viz import-published`"
        )
    config = _read_json(file)
    if not isinstance(config, dict):
        raise UserError(f"{file} is not a JSON object")
    version = config.get("schema_version")
    if version != SCHEMA_VERSION:
        raise UserError(f"{file}: schema_version is {version!r}, this program reads {SCHEMA_VERSION}")
    needed = ("name", "dataset", "window", "hidden", "latent_size", "n_states", "actions", "robot", "variants")
    missing = [key for key in needed if key not in config]
    if missing:
        raise UserError(f"{file}: missing {', '.join(missing)}")
    if config["window"] != WINDOW:
        raise UserError(f"{file}: window is {config['window']} observations, this program works with {WINDOW}")
    return config


def _read_hmm(tensors: Mapping[str, np.ndarray], action: str, n_states: int, size: int, where: str) -> HMM:
    shapes = {
        "initial_probs": (n_states,), "transition_matrix": (n_states, n_states),
        "emission_means": (n_states, size), "emission_covariances": (n_states, size, size),
    }  # fmt: skip
    values = {}
    for name, shape in shapes.items():
        key = f"hmm/{action}/{name}"
        if key not in tensors:
            raise UserError(f"{where}: tensor '{key}' is missing")
        if tensors[key].shape != shape:
            raise UserError(f"{where}: tensor '{key}' has shape {tensors[key].shape}, expected {shape}")
        values[name] = tensors[key].astype(np.float64)
    return check_hmm(HMM(**values), f"{where}: hmm/{action}")


def _part(tensors: Mapping[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint's folder; every tensor is checked against config.json.

    Raises:
        UserError: naming the file, the field or tensor, what was found and what was expected.
    """
    config = _read_config(path)
    file = path / WEIGHTS
    if not file.is_file():
        raise UserError(f"{file} is missing")
    try:
        tensors = load_file(file)
    except (SafetensorError, OSError) as error:
        raise UserError(f"{file} is not a readable safetensors file: {error}") from None
    try:
        hidden = (int(config["hidden"][0]), int(config["hidden"][1]))
        latent, n_states = int(config["latent_size"]), int(config["n_states"])
        robot = config["robot"]
        if robot is not None:
            robot = RobotInterface(str(robot["name"]), tuple(robot["joint_names"]), str(robot["end_effector"]))
        placement = Placement(**config["placement"]) if config.get("placement") else None
        actions = [choose(f"{path / CONFIG}: action", action, ACTIONS) for action in config["actions"]]
        variants = [choose(f"{path / CONFIG}: variant", name, list(VARIANTS)) for name in config["variants"]]
        contact = {action: frozenset(map(int, states)) for action, states in config.get("contact_states", {}).items()}
        dataset, checksum = str(config["dataset"]["name"]), str(config["dataset"].get("checksum", ""))
    except (TypeError, KeyError, ValueError, IndexError) as error:
        raise UserError(f"{path / CONFIG} is malformed: {type(error).__name__}: {error}") from None
    for name in variants:
        row = Variant(**config["variants"][name])
        if replace(row, summary="") != replace(VARIANTS[name], summary=""):
            raise UserError(f"{path / CONFIG}: variant '{name}' was trained as {row}, here it means {VARIANTS[name]}")
    robot_input = WINDOW * (len(robot.joint_names) if robot else FEATURES)
    human_vae = make_vae(_part(tensors, "human/"), WINDOW * FEATURES, hidden, latent, f"{file}: human")
    checkpoint = Checkpoint(
        path=path,
        name=str(config["name"]),
        dataset=dataset,
        dataset_checksum=checksum,
        human_vae=human_vae,
        hmms={action: _read_hmm(tensors, action, n_states, 2 * latent, str(file)) for action in actions},
        robot_vaes={
            name: make_vae(_part(tensors, f"robot/{name}/"), robot_input, hidden, latent, f"{file}: robot/{name}")
            for name in variants
        },
        robot=robot,
        contact_states=contact,
        placement=placement,
        hidden=hidden,
        training=config.get("training", {}),
        metrics=config.get("metrics", {}),
    )
    return replace(checkpoint, contact_states={**contact, **_read_contact_states(checkpoint)})


def _read_contact_states(checkpoint: Checkpoint) -> dict[str, frozenset[int]]:
    """The states that a person saved, if any."""
    file = checkpoint.path / CONTACT_STATES
    if not file.is_file():
        return {}
    try:
        saved = json.loads(file.read_text())
        result = {action: frozenset(map(int, states)) for action, states in saved.items()}
    except (json.JSONDecodeError, UnicodeDecodeError, AttributeError, TypeError, ValueError) as error:
        raise UserError(f"{file} is not a table of action: [states]: {error}") from None
    for action, states in result.items():
        _check_states(checkpoint, action, states, str(file))
    return result


def _check_states(checkpoint: Checkpoint, action: str, states: frozenset[int], where: str) -> None:
    choose(f"{where}: action", action, checkpoint.actions)
    bad = [state for state in states if not 0 <= state < checkpoint.n_states]
    if bad:
        raise UserError(f"{where}: {action}: states {bad} do not exist; valid: 0 to {checkpoint.n_states - 1}")


def save_contact_states(checkpoint: Checkpoint, action: str, states: frozenset[int]) -> Checkpoint:
    """Make `states` the default contact states of an action, in the checkpoint's own small JSON file.

    Weights and config.json are never touched. Returns the checkpoint with the new default.
    """
    _check_states(checkpoint, action, states, f"checkpoint {checkpoint.name}")
    saved = {**_read_contact_states(checkpoint), action: states}
    file = checkpoint.path / CONTACT_STATES
    text = json.dumps({key: sorted(value) for key, value in saved.items()}, indent=2) + "\n"
    write_atomically(file, lambda temporary: temporary.write_text(text))
    return replace(checkpoint, contact_states={**checkpoint.contact_states, action: states})
