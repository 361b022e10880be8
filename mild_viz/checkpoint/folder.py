"""Saving a checkpoint's folder, and loading it with every file checked."""

from __future__ import annotations

import json
from collections.abc import Callable
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
    states_as_json,
)
from mild_viz.checkpoint.fields import read_json
from mild_viz.checkpoint.model import Checkpoint
from mild_viz.checkpoint.tensors import read_parts, tensors_of
from mild_viz.errors import UserError
from mild_viz.files import replace_folder, write_atomically
from mild_viz.settings import choose

WEIGHTS, CONFIG, README, CONTACT_STATES = "weights.safetensors", "config.json", "README.md", "contact_states.json"
FILES = (WEIGHTS, CONFIG, README, CONTACT_STATES)

Model = TypeVar("Model")


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
    loaded = save_folder(path, tensors_of(checkpoint), config_of(checkpoint), readme, load_checkpoint)
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
    parts = read_parts(load_tensors(file), config, str(file))
    checkpoint = Checkpoint(
        path=path,
        name=config.name,
        dataset=config.dataset,
        dataset_checksum=config.dataset_checksum,
        human_vae=parts.human_vae,
        hmms=parts.hmms,
        robot_vaes=parts.robot_vaes,
        robot=config.robot,
        own_models=parts.own_models,
        points=config.points,
        rate=config.rate,
        contact_states=config.contact_states,
        own_contact_states=config.own_contact_states,
        contact_rules=config.contact_rules,
        transition_states=parts.transition_states,
        placement=config.placement,
        meeting=config.meeting,
        workspace=config.workspace,
        hidden=config.hidden,
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
