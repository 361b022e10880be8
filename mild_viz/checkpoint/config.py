"""config.json of a checkpoint: what is written, and a strict reading of what a person may have edited."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mild_viz.checkpoint.fields import MAX_SIZE, names, need, number, point, read_json, size, typed
from mild_viz.checkpoint.model import Checkpoint, RobotInterface
from mild_viz.errors import UserError
from mild_viz.latent.context import ContextLayout
from mild_viz.latent.state_models import STATE_MODELS
from mild_viz.robot.control.rules import ContactRules, parse_contact_rules, rules_as_json
from mild_viz.robot.placement import Meeting
from mild_viz.robot.workspace import Box, Workspace
from mild_viz.settings import VARIANTS, WINDOW, Placement, choose
from mild_viz.trial import ACTIONS, ARM_POINTS, HAND_POINTS

SCHEMA_VERSION = 1


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
    points: tuple[str, ...]
    rate: float | None
    robot_variants: tuple[str, ...]
    """Those that have a robot VAE on the shared human side."""
    own_models: dict[str, OwnModels]
    contact_states: dict[str, frozenset[int]]
    own_contact_states: dict[str, dict[str, frozenset[int]]]
    contact_rules: dict[str, ContactRules]
    placement: Placement | None
    meeting: Meeting | None
    workspace: Workspace | None
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
        "points": list(checkpoint.points),
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
        "meeting": asdict(checkpoint.meeting) if checkpoint.meeting else None,
        "workspace": [asdict(box) for box in checkpoint.workspace] if checkpoint.workspace else None,
        "training": dict(checkpoint.training),
        "metrics": dict(checkpoint.metrics),
    }


def states_as_json(table: Mapping[str, frozenset[int]]) -> dict[str, list[int]]:
    """Contact states by action as JSON holds them."""
    return {action: sorted(states) for action, states in table.items()}


def check_states(states: frozenset[int], action: str, actions: Sequence[str], n_states: int, where: str) -> None:
    """Raise an error unless the model has this action and these states."""
    choose(f"{where}: action", action, list(actions))
    bad = sorted(state for state in states if not 0 <= state < n_states)
    if bad:
        raise UserError(f"{where}: {action}: states {reprlib.repr(bad)} do not exist; valid: 0 to {n_states - 1}")


def parse_contact_states(value: Any, actions: Sequence[str], n_states: int, where: str) -> dict[str, frozenset[int]]:
    """A table of action: [states], as config.json and contact_states.json hold it."""
    result = {}
    for action, states in typed(value, dict, where).items():
        if any(type(state) is not int for state in typed(states, list, f"{where}: {action}")):
            raise UserError(f"{where}: {action} is {reprlib.repr(states)}, expected whole numbers 0 to {n_states - 1}")
        result[action] = frozenset(states)
        check_states(result[action], action, actions, n_states, where)
    return result


def _state_model(value: Any, where: str) -> str:
    return choose(where, typed(value, str, where), list(STATE_MODELS))


def parse_robot(value: Any, where: str) -> RobotInterface | None:
    """The robot that a model drives, as config.json holds it."""
    if value is None:
        return None
    need(typed(value, dict, where), ("name", "joint_names", "end_effector"), where)
    joints = names(value["joint_names"], f"{where}.joint_names")
    name, end = (typed(value[key], str, f"{where}.{key}") for key in ("name", "end_effector"))
    return RobotInterface(name, joints, end)


def _variants(value: Any, robot: RobotInterface | None, where: str) -> tuple[str, ...]:
    for name, row in typed(value, dict, where).items():
        expected = asdict(VARIANTS[choose(where, name, list(VARIANTS))])
        meant, found = ({**table, "summary": ""} for table in (expected, typed(row, dict, f"{where}.{name}")))
        if found != meant:
            raise UserError(f"{where}.{name} was trained as {reprlib.repr(row)}, here it means {expected}")
    if robot is not None and not value:
        raise UserError(f"{where} is empty; a model that drives {robot.name} has one or more of: {', '.join(VARIANTS)}")
    return tuple(value)


def _own_models(value: Any, variants: Sequence[str], where: str) -> dict[str, OwnModels]:
    """The table of the variants with models of their own, which are those of `variants` that the table says so of."""
    table = typed(value, dict, where)
    expected = [name for name in variants if VARIANTS[name].own_models]
    if sorted(table) != sorted(expected):
        raise UserError(
            f"{where} is about {', '.join(table) or 'nothing'}, expected {', '.join(expected) or 'nothing'}"
        )
    result = {}
    for name, row in table.items():
        need(typed(row, dict, f"{where}.{name}"), ("n_models", "lags", "clock"), f"{where}.{name}")
        lags = tuple(size(lag, f"{where}.{name}.lags") for lag in typed(row["lags"], list, f"{where}.{name}.lags"))
        try:
            layout = ContextLayout(lags, number(row["clock"], f"{where}.{name}.clock"))
        except UserError as error:
            raise UserError(f"{where}.{name}: {error}") from None
        result[name] = OwnModels(size(row["n_models"], f"{where}.{name}.n_models"), layout)
    return result


def _rate(value: Any, where: str) -> float | None:
    if value is None:
        return None
    rate = number(value, where)
    if not 0.0 < rate <= MAX_SIZE:
        raise UserError(f"{where} is {rate}, expected frames a second, above 0")
    return rate


def _placement(value: Any, where: str) -> Placement | None:
    if value is None:
        return None
    numbers = ("distance", "lateral", "height")
    need(typed(value, dict, where), numbers, where)
    unknown = sorted(value.keys() - Placement.__dataclass_fields__.keys())
    if unknown:
        raise UserError(f"{where}: {', '.join(unknown)} unknown; valid: {', '.join(Placement.__dataclass_fields__)}")
    distance, lateral, height = (number(value[key], f"{where}.{key}") for key in numbers)
    source = typed(value.get("source", "chosen"), str, f"{where}.source")
    estimated = typed(value.get("estimated", False), bool, f"{where}.estimated")
    try:
        return Placement(distance, lateral, height, source, estimated)
    except UserError as error:
        raise UserError(f"{where}: {error}") from None


def _meeting(value: Any, where: str) -> Meeting | None:
    if value is None:
        return None
    need(typed(value, dict, where), ("partner", "human", "source"), where)
    points = {key: point(value[key], f"{where}.{key}") for key in ("partner", "human")}
    try:
        return Meeting(**points, source=typed(value["source"], str, f"{where}.source"))
    except UserError as error:
        raise UserError(f"{where}: {error}") from None


def _workspace(value: Any, points: Sequence[str], where: str) -> Workspace | None:
    if value is None and points != HAND_POINTS:
        return None
    found = typed(value, list, where)
    if points != HAND_POINTS or len(found) != len(HAND_POINTS):
        raise UserError(f"{where} is {reprlib.repr(value)}, expected a box for each of {', '.join(HAND_POINTS)}")
    boxes = []
    for index, box in enumerate(found):
        place = f"{where}[{index}]"
        need(typed(box, dict, place), ("lower", "upper"), place)
        try:
            boxes.append(Box(*(point(box[key], f"{place}.{key}") for key in ("lower", "upper"))))
        except UserError as error:
            raise UserError(f"{place}: {error}") from None
    return tuple(boxes)


def is_config(config: Any) -> bool:
    """Whether this is the content of a config.json that this program wrote."""
    return isinstance(config, dict) and config.get("schema_version") == SCHEMA_VERSION


def read_config(file: Path) -> Config:
    """Read and check config.json.

    Raises:
        UserError: naming the field, what was found and what was expected.
    """
    config = typed(read_json(file), dict, str(file))
    if (kind := config.get("kind")) is not None:
        raise UserError(
            f"{file}: this is a model of kind {reprlib.repr(kind)}, expected a MILD checkpoint as written by "
            "`mild-viz train`; models of other kinds can be measured with `mild-viz evaluate`"
        )
    if not is_config(config):
        found = reprlib.repr(config.get("schema_version"))
        raise UserError(f"{file}: schema_version is {found}, this program reads {SCHEMA_VERSION}")
    needed = ("name", "dataset", "window", "hidden", "latent_size", "n_states", "actions", "robot", "variants")
    need(config, needed, str(file))
    if config["window"] != WINDOW:
        found = reprlib.repr(config["window"])
        raise UserError(f"{file}: window is {found} observations, this program works with {WINDOW}")
    hidden = typed(config["hidden"], list, f"{file}: hidden")
    if len(hidden) != 2:
        raise UserError(f"{file}: hidden is {reprlib.repr(hidden)}, expected the widths of two layers")
    dataset = typed(config["dataset"], dict, f"{file}: dataset")
    need(dataset, ("name",), f"{file}: dataset")
    n_states = size(config["n_states"], f"{file}: n_states")
    actions = names(config["actions"], f"{file}: actions")
    for action in actions:
        choose(f"{file}: action", action, ACTIONS)
    robot = parse_robot(config["robot"], f"{file}: robot")
    points = names(config.get("points", list(ARM_POINTS)), f"{file}: points")
    if points not in (ARM_POINTS, HAND_POINTS):
        valid = " or ".join(", ".join(known) for known in (ARM_POINTS, HAND_POINTS))
        raise UserError(f"{file}: points is {list(points)}, expected {valid}")
    contact = parse_contact_states(config.get("contact_states", {}), actions, n_states, f"{file}: contact_states")
    variants = _variants(config["variants"], robot, f"{file}: variants")
    own_models = _own_models(config.get("own_models", {}), variants, f"{file}: own_models")
    own_contact = {}
    for variant, table in typed(config.get("own_contact_states", {}), dict, f"{file}: own_contact_states").items():
        choose(f"{file}: own_contact_states", variant, list(own_models))
        own_contact[variant] = parse_contact_states(table, actions, n_states, f"{file}: own_contact_states.{variant}")
    return Config(
        name=typed(config["name"], str, f"{file}: name"),
        dataset=typed(dataset["name"], str, f"{file}: dataset.name"),
        dataset_checksum=typed(dataset.get("checksum", ""), str, f"{file}: dataset.checksum"),
        hidden=(size(hidden[0], f"{file}: hidden"), size(hidden[1], f"{file}: hidden")),
        latent_size=size(config["latent_size"], f"{file}: latent_size"),
        n_states=n_states,
        state_model=_state_model(config.get("state_model", "hmm"), f"{file}: state_model"),
        actions=actions,
        robot=robot,
        points=points,
        rate=_rate(config.get("rate"), f"{file}: rate"),
        robot_variants=tuple(name for name in variants if name not in own_models),
        own_models=own_models,
        contact_states=contact,
        own_contact_states=own_contact,
        contact_rules=parse_contact_rules(config.get("contact_rules", {}), actions, f"{file}: contact_rules"),
        placement=_placement(config.get("placement"), f"{file}: placement"),
        workspace=_workspace(config.get("workspace"), points, f"{file}: workspace"),
        meeting=_meeting(config.get("meeting"), f"{file}: meeting"),
        training=typed(config.get("training", {}), dict, f"{file}: training"),
        metrics=typed(config.get("metrics", {}), dict, f"{file}: metrics"),
    )
