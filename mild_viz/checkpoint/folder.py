"""Saving a checkpoint's folder, and loading it with every file checked."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from mild_viz.checkpoint.config import (
    SCHEMA_VERSION,
    check_states,
    config_of,
    is_config,
    parse_contact_states,
    read_config,
    read_json,
)
from mild_viz.checkpoint.model import Checkpoint
from mild_viz.errors import UserError
from mild_viz.files import write_atomically
from mild_viz.latent.hmm import HMM, check_hmm
from mild_viz.latent.vae import make_vae
from mild_viz.settings import HUMAN_FEATURES, WINDOW

WEIGHTS, CONFIG, README, CONTACT_STATES = "weights.safetensors", "config.json", "README.md", "contact_states.json"
FILES = (WEIGHTS, CONFIG, README, CONTACT_STATES)

Model = TypeVar("Model")


def _tensors(checkpoint: Checkpoint) -> dict[str, np.ndarray]:
    tensors = {f"human/{name}": value for name, value in checkpoint.human_vae.weights.items()}
    for action, hmm in checkpoint.hmms.items():
        for name in HMM.__dataclass_fields__:
            tensors[f"hmm/{action}/{name}"] = getattr(hmm, name)
    for variant, vae in checkpoint.robot_vaes.items():
        tensors |= {f"robot/{variant}/{name}": value for name, value in vae.weights.items()}
    return {name: np.ascontiguousarray(value) for name, value in tensors.items()}


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
    config = read_json(out / CONFIG) if CONFIG in found else None
    if not is_config(config):
        raise UserError(
            f"{out} is not a checkpoint folder: it holds {', '.join(sorted(found))}, but no {CONFIG} "
            f"with schema_version {SCHEMA_VERSION}; {advice}"
        )


def save_checkpoint(checkpoint: Checkpoint, path: Path, readme: str) -> Checkpoint:
    """Write a checkpoint's folder, and return it as loaded from there. See `save_folder` for its errors."""
    loaded = save_folder(path, _tensors(checkpoint), config_of(checkpoint), readme, load_checkpoint)
    return replace(loaded, path=path)


def save_folder(
    path: Path, tensors: dict[str, np.ndarray], config: dict[str, Any], readme: str, load: Callable[[Path], Model]
) -> Model:
    """Write a model's folder, and return it as `load` reads it.

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
            save_file(tensors, built / WEIGHTS)
            (built / WEIGHTS).chmod(0o644)  # safetensors writes for the owner alone
            (built / CONFIG).write_text(json.dumps(config, indent=2) + "\n", encoding="utf-8")
            (built / README).write_text(readme, encoding="utf-8", errors="replace")
            try:
                loaded = load(built)
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
    return loaded


def load_tensors(file: Path) -> dict[str, np.ndarray]:
    """The content of a safetensors file. Raises `UserError` where it is missing or damaged."""
    if not file.is_file():
        raise UserError(f"{file} is missing")
    try:
        return load_file(file)
    except Exception as error:  # besides its own error it has KeyError for a number type that NumPy lacks
        raise UserError(f"{file} is not a readable safetensors file: {type(error).__name__}: {error}") from None


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


def part(tensors: Mapping[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint's folder; every tensor is checked against config.json.

    Raises:
        UserError: naming the file, the field or tensor, what was found and what was expected.
    """
    file, config_file = path / WEIGHTS, path / CONFIG
    try:
        present = config_file.is_file()
    except OSError as error:  # such as a name that is too long
        raise UserError(f"{path} cannot be read: {error.strerror or error}") from None
    if not present:
        raise UserError(
            f"{path} is not a checkpoint: expected a folder with {CONFIG} and {WEIGHTS}, "
            "as written by `mild-viz train` or `mild-viz import-published`"
        )
    config = read_config(config_file)
    tensors = load_tensors(file)
    hidden, latent, robot = config.hidden, config.latent_size, config.robot
    robot_input = WINDOW * (len(robot.joint_names) if robot else HUMAN_FEATURES)
    checkpoint = Checkpoint(
        path=path,
        name=config.name,
        dataset=config.dataset,
        dataset_checksum=config.dataset_checksum,
        human_vae=make_vae(part(tensors, "human/"), WINDOW * HUMAN_FEATURES, hidden, latent, f"{file}: human"),
        hmms={action: _read_hmm(tensors, action, config.n_states, 2 * latent, str(file)) for action in config.actions},
        robot_vaes={
            name: make_vae(part(tensors, f"robot/{name}/"), robot_input, hidden, latent, f"{file}: robot/{name}")
            for name in config.variants
        },
        robot=robot,
        contact_states=config.contact_states,
        placement=config.placement,
        hidden=hidden,
        training=config.training,
        metrics=config.metrics,
    )
    return replace(checkpoint, contact_states={**config.contact_states, **_read_contact_states(checkpoint)})


def _read_contact_states(checkpoint: Checkpoint) -> dict[str, frozenset[int]]:
    """The states that a person saved, if any."""
    file = checkpoint.path / CONTACT_STATES
    if not file.is_file():
        return {}
    return parse_contact_states(read_json(file), checkpoint.actions, checkpoint.n_states, str(file))


def save_contact_states(checkpoint: Checkpoint, action: str, states: frozenset[int]) -> Checkpoint:
    """Make `states` the default contact states of an action, in the checkpoint's own small JSON file.

    Weights and config.json are never touched. Returns the checkpoint with the new default.
    """
    check_states(states, action, checkpoint.actions, checkpoint.n_states, f"checkpoint {checkpoint.name}")
    saved = {**_read_contact_states(checkpoint), action: states}
    file = checkpoint.path / CONTACT_STATES
    text = json.dumps({key: sorted(value) for key, value in saved.items()}, indent=2) + "\n"
    write_atomically(file, lambda temporary: temporary.write_text(text))
    return replace(checkpoint, contact_states={**checkpoint.contact_states, action: states})
