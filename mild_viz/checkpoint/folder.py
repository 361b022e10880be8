"""Saving a checkpoint's folder, and loading it with every file checked."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from mild_viz.checkpoint.config import (
    SCHEMA_VERSION,
    Config,
    check_states,
    config_of,
    is_config,
    parse_contact_states,
    read_config,
    read_json,
    states_as_json,
)
from mild_viz.checkpoint.model import Checkpoint
from mild_viz.errors import UserError
from mild_viz.files import replace_folder, write_atomically
from mild_viz.latent.context import ContextRegression
from mild_viz.latent.hmm import HMM, check_hmm
from mild_viz.latent.interaction import InteractionModel
from mild_viz.latent.vae import VAE, make_vae
from mild_viz.settings import HUMAN_FEATURES, WINDOW, choose

WEIGHTS, CONFIG, README, CONTACT_STATES = "weights.safetensors", "config.json", "README.md", "contact_states.json"
FILES = (WEIGHTS, CONFIG, README, CONTACT_STATES)

Model = TypeVar("Model")


def _tensors(checkpoint: Checkpoint) -> dict[str, np.ndarray]:
    """Everything by name. Networks in single precision, in which they were trained; the rest in double."""
    tensors = _vae_tensors("human/", checkpoint.human_vae) | _hmm_tensors("hmm/", checkpoint.hmms)
    for variant, vae in checkpoint.robot_vaes.items():
        tensors |= _vae_tensors(f"robot/{variant}/", vae)
    for variant, models in checkpoint.own_models.items():
        for index, model in enumerate(models):
            part = f"{variant}/{index}/"
            tensors |= _vae_tensors(f"{part}human/", model.human_vae) | _vae_tensors(f"{part}robot/", model.robot_vae)
            tensors |= _hmm_tensors(f"{part}hmm/", model.hmms)
            for action, regression in model.regressions.items():
                for name in ContextRegression.__dataclass_fields__:
                    tensors[f"{part}regression/{action}/{name}"] = getattr(regression, name)
    return {name: np.ascontiguousarray(value) for name, value in tensors.items()}


def _vae_tensors(part: str, vae: VAE) -> dict[str, np.ndarray]:
    return {f"{part}{name}": value.astype(np.float32) for name, value in vae.weights.items()}


def _hmm_tensors(part: str, hmms: Mapping[str, HMM]) -> dict[str, np.ndarray]:
    names = HMM.__dataclass_fields__
    return {f"{part}{action}/{name}": getattr(hmm, name) for action, hmm in hmms.items() for name in names}


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

    def fill(built: Path) -> Model:
        try:
            save_file(tensors, built / WEIGHTS)
        except SafetensorError as error:
            raise UserError(f"{path} cannot be written: {error}; choose another place") from None
        (built / WEIGHTS).chmod(0o644)  # safetensors writes for the owner alone
        (built / CONFIG).write_text(json.dumps(config, indent=2) + "\n", encoding="utf-8")
        (built / README).write_text(readme, encoding="utf-8", errors="replace")
        try:
            return load(built)
        except UserError as error:
            raise UserError(f"{path} is left as it was, the new model is not valid: {error}") from None

    return replace_folder(path, fill)


def load_tensors(file: Path) -> dict[str, np.ndarray]:
    """The content of a safetensors file. Raises `UserError` where it is missing or damaged."""
    if not file.is_file():
        raise UserError(f"{file} is missing")
    try:
        return load_file(file)
    except Exception as error:  # besides its own error it has KeyError for a number type that NumPy lacks
        raise UserError(f"{file} is not a readable safetensors file: {type(error).__name__}: {error}") from None


def _checked(tensors: Mapping[str, np.ndarray], name: str, shape: tuple[int, ...], where: str) -> np.ndarray:
    """A tensor in double precision, or an error that names it, its shape and the expected one."""
    if name not in tensors:
        raise UserError(f"{where}: tensor '{name}' is missing")
    if tensors[name].shape != shape:
        raise UserError(f"{where}: tensor '{name}' has shape {tensors[name].shape}, expected {shape}")
    return tensors[name].astype(np.float64)


def _read_hmm(tensors: Mapping[str, np.ndarray], key: str, n_states: int, size: int, where: str) -> HMM:
    shapes = {
        "initial_probs": (n_states,), "transition_matrix": (n_states, n_states),
        "emission_means": (n_states, size), "emission_covariances": (n_states, size, size),
    }  # fmt: skip
    values = {name: _checked(tensors, f"{key}/{name}", shape, where) for name, shape in shapes.items()}
    return check_hmm(HMM(**values), f"{where}: {key}")


def _read_regression(
    tensors: Mapping[str, np.ndarray], key: str, n_states: int, latent: int, context: int, where: str
) -> ContextRegression:
    shapes = {
        "gain": (n_states, latent, context), "offset": (n_states, latent), "covariance": (n_states, latent, latent)
    }  # fmt: skip
    values = {name: _checked(tensors, f"{key}/{name}", shape, where) for name, shape in shapes.items()}
    for name, value in values.items():
        if not np.isfinite(value).all():
            raise UserError(f"{where}: tensor '{key}/{name}' has values that are not finite")
    if not np.linalg.eigvalsh(values["covariance"]).min() > 0.0:
        raise UserError(f"{where}: tensor '{key}/covariance' is not positive definite")
    return ContextRegression(**values)


def _read_own_models(
    tensors: Mapping[str, np.ndarray], config: Config, robot_input: int, where: str
) -> dict[str, tuple[InteractionModel, ...]]:
    """The models of the variants that have their own."""
    latent, states, result = config.latent_size, config.n_states, {}
    for variant, own in config.own_models.items():
        models = []
        for index in range(own.n_models):
            part = f"{variant}/{index}/"
            vaes = [
                make_vae(_part(tensors, f"{part}{agent}/"), size, config.hidden, latent, f"{where}: {part}{agent}")
                for agent, size in (("human", WINDOW * HUMAN_FEATURES), ("robot", robot_input))
            ]
            hmms = {a: _read_hmm(tensors, f"{part}hmm/{a}", states, 2 * latent, where) for a in config.actions}
            context = own.layout.size(latent)
            regressions = {
                a: _read_regression(tensors, f"{part}regression/{a}", states, latent, context, where)
                for a in config.actions
            }
            models.append(InteractionModel(vaes[0], hmms, vaes[1], own.layout, regressions))
        result[variant] = tuple(models)
    return result


def _part(tensors: Mapping[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
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
        human_vae=make_vae(_part(tensors, "human/"), WINDOW * HUMAN_FEATURES, hidden, latent, f"{file}: human"),
        hmms={
            action: _read_hmm(tensors, f"hmm/{action}", config.n_states, 2 * latent, str(file))
            for action in config.actions
        },
        robot_vaes={
            name: make_vae(_part(tensors, f"robot/{name}/"), robot_input, hidden, latent, f"{file}: robot/{name}")
            for name in config.robot_variants
        },
        robot=robot,
        own_models=_read_own_models(tensors, config, robot_input, str(file)),
        rate=config.rate,
        contact_states=config.contact_states,
        own_contact_states=config.own_contact_states,
        placement=config.placement,
        hidden=hidden,
        training=config.training,
        metrics=config.metrics,
    )
    return _with_saved_states(checkpoint)


def _read_contact_states(checkpoint: Checkpoint) -> tuple[dict[str, frozenset[int]], dict[str, Any]]:
    """The states that a person saved, of the shared HMMs by action, and of a variant's own by variant and action."""
    file = checkpoint.path / CONTACT_STATES
    if not file.is_file():
        return {}, {}
    content = read_json(file)
    own = {}
    if isinstance(content, dict):
        own = {name: content.pop(name) for name in list(content) if name in checkpoint.own_models}
    actions, states = checkpoint.actions, checkpoint.n_states
    shared = parse_contact_states(content, actions, states, str(file))
    return shared, {v: parse_contact_states(t, actions, states, f"{file}: {v}") for v, t in own.items()}


def _with_saved_states(checkpoint: Checkpoint) -> Checkpoint:
    """The checkpoint with what a person saved in the place of its own defaults."""
    shared, own = _read_contact_states(checkpoint)
    before = checkpoint.own_contact_states
    return replace(
        checkpoint,
        contact_states={**checkpoint.contact_states, **shared},
        own_contact_states={**before, **{v: {**before.get(v, {}), **table} for v, table in own.items()}},
    )


def save_contact_states(checkpoint: Checkpoint, variant: str, action: str, states: frozenset[int]) -> Checkpoint:
    """Make `states` the default contact states of an action, in the checkpoint's own small JSON file.

    They hold for all variants that share the HMMs, or for the one that has its own. Weights and config.json are never
    touched. Returns the checkpoint with the new default.
    """
    check_states(states, action, checkpoint.actions, checkpoint.n_states, f"checkpoint {checkpoint.name}")
    choose(f"checkpoint {checkpoint.name}: variant", variant, checkpoint.variants)
    shared, own = _read_contact_states(checkpoint)
    if variant in checkpoint.own_models:
        own = {**own, variant: {**own.get(variant, {}), action: states}}
    else:
        shared = {**shared, action: states}
    content = states_as_json(shared) | {name: states_as_json(table) for name, table in own.items()}
    text = json.dumps(content, indent=2) + "\n"
    write_atomically(checkpoint.path / CONTACT_STATES, lambda temporary: temporary.write_text(text))
    return _with_saved_states(checkpoint)
