"""config.json of a checkpoint: what is written, and a strict reading of what a person may have edited."""

from __future__ import annotations

import json
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

from mild_viz.checkpoint.model import Checkpoint, RobotInterface
from mild_viz.errors import UserError
from mild_viz.latent.context import ContextLayout
from mild_viz.latent.state_models import STATE_MODELS
from mild_viz.robot.control.rules import ContactRules, parse_contact_rules, rules_as_json
from mild_viz.settings import VARIANTS, WINDOW, Placement, choose
from mild_viz.trial import ACTIONS

SCHEMA_VERSION = 1
MAX_SIZE = 100_000
"""Largest width of a layer, latent space or set of states that is read."""

Kind = TypeVar("Kind")
KINDS: dict[type, str] = {str: "a text", bool: "true or false", list: "a list [...]", dict: "an object {...}"}


@dataclass(frozen=True)
class OwnModels:
    """What config.json says of a variant with models of its own."""

    n_models: int
    layout: ContextLayout


@dataclass(frozen=True)
class Config:
    """The content of config.json, each field checked."""

    name: str
    dataset: str
    dataset_checksum: str
    hidden: tuple[int, int]
    latent_size: int
    n_states: int
    state_model: str
    actions: tuple[str, ...]
    robot: RobotInterface | None
    rate: float | None
    robot_variants: tuple[str, ...]
    """Those that have a robot VAE on the shared human side."""
    own_models: dict[str, OwnModels]
    contact_states: dict[str, frozenset[int]]
    own_contact_states: dict[str, dict[str, frozenset[int]]]
    contact_rules: dict[str, ContactRules]
    placement: Placement | None
    training: dict[str, Any]
    metrics: dict[str, Any]


def config_of(checkpoint: Checkpoint) -> dict[str, Any]:
    """What config.json says of a checkpoint."""
    return {
        "schema_version": SCHEMA_VERSION,
        "name": checkpoint.name,
        "dataset": {"name": checkpoint.dataset, "checksum": checkpoint.dataset_checksum},
        "window": WINDOW,
        "hidden": list(checkpoint.hidden),
        "latent_size": checkpoint.human_vae.latent_size,
        "n_states": checkpoint.n_states,
        "state_model": checkpoint.state_model,
        "actions": list(checkpoint.actions),
        "robot": asdict(checkpoint.robot) if checkpoint.robot else None,
        "rate": checkpoint.rate,
        "variants": {name: asdict(VARIANTS[name]) for name in (*checkpoint.robot_vaes, *checkpoint.own_models)},
        "own_models": {
            name: {"n_models": len(models), **asdict(models[0].layout)}
            for name, models in checkpoint.own_models.items()
        },
        "contact_states": states_as_json(checkpoint.contact_states),
        "own_contact_states": {
            variant: states_as_json(table) for variant, table in checkpoint.own_contact_states.items()
        },
        "contact_rules": rules_as_json(checkpoint.contact_rules),
        "placement": asdict(checkpoint.placement) if checkpoint.placement else None,
        "training": dict(checkpoint.training),
        "metrics": dict(checkpoint.metrics),
    }


def states_as_json(table: Mapping[str, frozenset[int]]) -> dict[str, list[int]]:
    """Contact states by action as JSON holds them."""
    return {action: sorted(states) for action, states in table.items()}


def read_json(file: Path) -> Any:
    """The content of a JSON file; an error names the file and what is wrong with it."""
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{file} cannot be read: {error.strerror or error}") from None
    except (ValueError, RecursionError) as error:  # no JSON, no UTF-8, a number of thousands of digits; deep nesting
        raise UserError(f"{file} is not valid JSON: {error}") from None


def _typed(value: Any, kind: type[Kind], where: str) -> Kind:
    """`value` if JSON gave it as exactly this type: nothing is converted."""
    if type(value) is not kind:
        raise UserError(f"{where} is {reprlib.repr(value)}, expected {KINDS[kind]}")
    return value


def _size(value: Any, where: str) -> int:
    if type(value) is not int or not 1 <= value <= MAX_SIZE:
        raise UserError(f"{where} is {reprlib.repr(value)}, expected a whole number from 1 to {MAX_SIZE}")
    return value


def _number(value: Any, where: str) -> float:
    if type(value) not in (int, float) or not abs(value) < 1e300:  # float() has no larger integers
        raise UserError(f"{where} is {reprlib.repr(value)}, expected a finite number")
    return float(value)


def _names(value: Any, where: str) -> tuple[str, ...]:
    names = tuple(_typed(name, str, f"{where}: an entry") for name in _typed(value, list, where))
    if not names or len(set(names)) < len(names):
        raise UserError(f"{where} is {reprlib.repr(value)}, expected one name or more, each once")
    return names


def _need(table: Mapping[str, Any], keys: Sequence[str], where: str) -> None:
    missing = [key for key in keys if key not in table]
    if missing:
        raise UserError(f"{where}: missing {', '.join(missing)}")


def check_states(states: frozenset[int], action: str, actions: Sequence[str], n_states: int, where: str) -> None:
    """Raise an error unless the model has this action and these states."""
    choose(f"{where}: action", action, list(actions))
    bad = sorted(state for state in states if not 0 <= state < n_states)
    if bad:
        raise UserError(f"{where}: {action}: states {reprlib.repr(bad)} do not exist; valid: 0 to {n_states - 1}")


def parse_contact_states(value: Any, actions: Sequence[str], n_states: int, where: str) -> dict[str, frozenset[int]]:
    """A table of action: [states], as config.json and contact_states.json hold it."""
    result = {}
    for action, states in _typed(value, dict, where).items():
        if any(type(state) is not int for state in _typed(states, list, f"{where}: {action}")):
            raise UserError(f"{where}: {action} is {reprlib.repr(states)}, expected whole numbers 0 to {n_states - 1}")
        result[action] = frozenset(states)
        check_states(result[action], action, actions, n_states, where)
    return result


def _state_model(value: Any, where: str) -> str:
    return choose(where, _typed(value, str, where), list(STATE_MODELS))


def parse_robot(value: Any, where: str) -> RobotInterface | None:
    """The robot that a model drives, as config.json holds it."""
    if value is None:
        return None
    _need(_typed(value, dict, where), ("name", "joint_names", "end_effector"), where)
    joints = _names(value["joint_names"], f"{where}.joint_names")
    name, end = (_typed(value[key], str, f"{where}.{key}") for key in ("name", "end_effector"))
    return RobotInterface(name, joints, end)


def _variants(value: Any, robot: RobotInterface | None, where: str) -> tuple[str, ...]:
    for name, row in _typed(value, dict, where).items():
        expected = asdict(VARIANTS[choose(where, name, list(VARIANTS))])
        meant, found = ({**table, "summary": ""} for table in (expected, _typed(row, dict, f"{where}.{name}")))
        if found != meant:
            raise UserError(f"{where}.{name} was trained as {reprlib.repr(row)}, here it means {expected}")
    if robot is not None and not value:
        raise UserError(f"{where} is empty; a model that drives {robot.name} has one or more of: {', '.join(VARIANTS)}")
    return tuple(value)


def _own_models(value: Any, variants: Sequence[str], where: str) -> dict[str, OwnModels]:
    """The table of the variants with models of their own, which are those of `variants` that the table says so of."""
    table = _typed(value, dict, where)
    expected = [name for name in variants if VARIANTS[name].own_models]
    if sorted(table) != sorted(expected):
        raise UserError(
            f"{where} is about {', '.join(table) or 'nothing'}, expected {', '.join(expected) or 'nothing'}"
        )
    result = {}
    for name, row in table.items():
        _need(_typed(row, dict, f"{where}.{name}"), ("n_models", "lags", "clock"), f"{where}.{name}")
        lags = tuple(_size(lag, f"{where}.{name}.lags") for lag in _typed(row["lags"], list, f"{where}.{name}.lags"))
        try:
            layout = ContextLayout(lags, _number(row["clock"], f"{where}.{name}.clock"))
        except UserError as error:
            raise UserError(f"{where}.{name}: {error}") from None
        result[name] = OwnModels(_size(row["n_models"], f"{where}.{name}.n_models"), layout)
    return result


def _rate(value: Any, where: str) -> float | None:
    if value is None:
        return None
    rate = _number(value, where)
    if not 0.0 < rate <= MAX_SIZE:
        raise UserError(f"{where} is {rate}, expected frames a second, above 0")
    return rate


def _placement(value: Any, where: str) -> Placement | None:
    if value is None:
        return None
    numbers = ("distance", "lateral", "height")
    _need(_typed(value, dict, where), numbers, where)
    unknown = sorted(value.keys() - Placement.__dataclass_fields__.keys())
    if unknown:
        raise UserError(f"{where}: {', '.join(unknown)} unknown; valid: {', '.join(Placement.__dataclass_fields__)}")
    distance, lateral, height = (_number(value[key], f"{where}.{key}") for key in numbers)
    source = _typed(value.get("source", "chosen"), str, f"{where}.source")
    estimated = _typed(value.get("estimated", False), bool, f"{where}.estimated")
    try:
        return Placement(distance, lateral, height, source, estimated)
    except UserError as error:
        raise UserError(f"{where}: {error}") from None


def is_config(config: Any) -> bool:
    """Whether this is the content of a config.json that this program wrote."""
    return isinstance(config, dict) and config.get("schema_version") == SCHEMA_VERSION


def read_config(file: Path) -> Config:
    """Read and check config.json.

    Raises:
        UserError: naming the field, what was found and what was expected.
    """
    config = _typed(read_json(file), dict, str(file))
    if (kind := config.get("kind")) is not None:
        raise UserError(
            f"{file}: this is a model of kind {reprlib.repr(kind)}, expected a MILD checkpoint as written by "
            "`mild-viz train`; models of other kinds can be measured with `mild-viz evaluate`"
        )
    if not is_config(config):
        found = reprlib.repr(config.get("schema_version"))
        raise UserError(f"{file}: schema_version is {found}, this program reads {SCHEMA_VERSION}")
    needed = ("name", "dataset", "window", "hidden", "latent_size", "n_states", "actions", "robot", "variants")
    _need(config, needed, str(file))
    if config["window"] != WINDOW:
        found = reprlib.repr(config["window"])
        raise UserError(f"{file}: window is {found} observations, this program works with {WINDOW}")
    hidden = _typed(config["hidden"], list, f"{file}: hidden")
    if len(hidden) != 2:
        raise UserError(f"{file}: hidden is {reprlib.repr(hidden)}, expected the widths of two layers")
    dataset = _typed(config["dataset"], dict, f"{file}: dataset")
    _need(dataset, ("name",), f"{file}: dataset")
    n_states = _size(config["n_states"], f"{file}: n_states")
    actions = _names(config["actions"], f"{file}: actions")
    for action in actions:
        choose(f"{file}: action", action, ACTIONS)
    robot = parse_robot(config["robot"], f"{file}: robot")
    contact = parse_contact_states(config.get("contact_states", {}), actions, n_states, f"{file}: contact_states")
    variants = _variants(config["variants"], robot, f"{file}: variants")
    own_models = _own_models(config.get("own_models", {}), variants, f"{file}: own_models")
    own_contact = {}
    for variant, table in _typed(config.get("own_contact_states", {}), dict, f"{file}: own_contact_states").items():
        choose(f"{file}: own_contact_states", variant, list(own_models))
        own_contact[variant] = parse_contact_states(table, actions, n_states, f"{file}: own_contact_states.{variant}")
    return Config(
        name=_typed(config["name"], str, f"{file}: name"),
        dataset=_typed(dataset["name"], str, f"{file}: dataset.name"),
        dataset_checksum=_typed(dataset.get("checksum", ""), str, f"{file}: dataset.checksum"),
        hidden=(_size(hidden[0], f"{file}: hidden"), _size(hidden[1], f"{file}: hidden")),
        latent_size=_size(config["latent_size"], f"{file}: latent_size"),
        n_states=n_states,
        state_model=_state_model(config.get("state_model", "hmm"), f"{file}: state_model"),
        actions=actions,
        robot=robot,
        rate=_rate(config.get("rate"), f"{file}: rate"),
        robot_variants=tuple(name for name in variants if name not in own_models),
        own_models=own_models,
        contact_states=contact,
        own_contact_states=own_contact,
        contact_rules=parse_contact_rules(config.get("contact_rules", {}), actions, f"{file}: contact_rules"),
        placement=_placement(config.get("placement"), f"{file}: placement"),
        training=_typed(config.get("training", {}), dict, f"{file}: training"),
        metrics=_typed(config.get("metrics", {}), dict, f"{file}: metrics"),
    )
