"""The two messages of the live interface: a skeleton frame in, a joint command out (docs/live.md, docs/live/).

Both are one JSON object a message, with a version and a type. Whatever arrives from outside is checked here, once:
`decode` and `read` give a sound `Observation` or raise a `UserError`, and nothing else.
"""

from __future__ import annotations

import difflib
import json
import math
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
from jaxtyping import Float

from mild_viz.data.skeletons import ARM_JOINTS, NUITRACK_JOINTS, ZED_JOINTS
from mild_viz.errors import UserError
from mild_viz.trial import freeze_arrays

VERSION = 1
"""Of both formats. A change that an old reader would misread gives the next number."""

MAX_BYTES = 16384
"""Longest message: a whole body at full precision needs 3 kB."""

COORDINATES = ("person", "world")
"""What positions may be given in: the person's own frame (x forward, y left, z up), or one fixed z-up frame."""

JOINTS = tuple(dict.fromkeys(NUITRACK_JOINTS + ZED_JOINTS))
"""Every joint name that a frame may carry."""

MAX_DISTANCE = 100.0
"""Largest coordinate [m]. Millimetres exceed it, which is the usual mistake."""

MAX_TIMESTAMP = 1e11
"""Largest timestamp [s], on either side of zero: milliseconds since 1970 exceed it."""

MAX_SEQUENCE = 2**53 - 1
"""Largest sequence number: beyond it JSON readers that know only doubles lose count."""

MAX_PERSON = 64
"""Longest id of a person, in characters."""

_JOINT_SET = frozenset(JOINTS)
_REQUIRED = frozenset(("version", "type", "timestamp", "coordinates", "joints"))
_FIELDS = _REQUIRED | {"sequence", "person"}
_UNTRACKED = [math.nan] * 3


@dataclass(frozen=True, eq=False)
class Observation:
    """One skeleton frame, checked."""

    timestamp: float
    """Sender's clock [s]; only differences mean anything."""
    received: float
    """`time.perf_counter()` when it arrived [s]."""
    sequence: int | None
    source: str
    """Who sent it, for people: an address, or a trial."""
    names: tuple[str, ...]
    """Joints in the order of the message; `ARM_JOINTS` are among them."""
    positions: Float[np.ndarray, "K 3"]
    """[m]; NaN where a joint is not tracked."""
    coordinates: str
    """'person': in the person's own frame; 'world': in one fixed z-up frame."""
    person: str | None = None
    """Which of the people the sender sees, if it says so."""

    def __post_init__(self) -> None:
        freeze_arrays(self)


@dataclass(frozen=True, eq=False)
class JointCommand:
    """What is sent to a robot for one tick."""

    timestamp: float
    """Unix time of sending [s]."""
    sequence: int
    """Rises by one a command."""
    observed: float | None
    """Timestamp of the frame that it answers; None where no usable frame came for this tick."""
    joint_names: tuple[str, ...]
    positions: Float[np.ndarray, " J"]
    """[rad]."""
    stiffness: Float[np.ndarray, " J"]
    """Fraction of full stiffness, 0 to 1."""
    phase: str
    """What the controller is doing, for people."""
    contact: bool
    """Whether the hands are held to touch."""
    fired: tuple[str, ...]
    """Names of the rules that decided this command."""

    def __post_init__(self) -> None:
        freeze_arrays(self)


def decode(payload: bytes, received: float, source: str) -> Observation:
    """The frame in a message as it came over the wire (UTF-8 JSON), received at `time.perf_counter()` [s].

    Raises:
        UserError: for whatever is wrong with it: what was got, what was expected; never anything else.
    """
    if len(payload) > MAX_BYTES:
        raise UserError(f"the message is longer than {MAX_BYTES} bytes")
    try:
        # Not json.loads(payload): that would also guess other encodings, and let half characters through.
        message = json.loads(payload.decode("utf-8"), parse_constant=_no_constant)
    except RecursionError:
        raise UserError("the message is nested too deeply; expected: one object of plain fields") from None
    except ValueError as error:  # also what cannot be decoded, and integers beyond any size
        raise UserError(f"the message is no JSON: {str(error)[:100]}") from None
    return read(message, received, source)


def read(message: Any, received: float, source: str) -> Observation:
    """The frame in a message that is parsed already, checked as `decode` checks it."""
    if type(message) is not dict:
        raise UserError(f"the message is {_shown(message)}; expected: a JSON object")
    if not _REQUIRED <= message.keys() <= _FIELDS:
        _refuse_fields(message)
    version, kind = message["version"], message["type"]
    if type(version) not in (int, float) or version != VERSION:
        raise UserError(f"version is {_shown(version)}; this program reads version {VERSION}")
    if kind != "skeleton":
        raise UserError(f'type is {_shown(kind)}; expected: "skeleton"')
    timestamp = _number("timestamp", message["timestamp"], MAX_TIMESTAMP, "seconds")
    coordinates = message["coordinates"]
    if type(coordinates) is not str or coordinates not in COORDINATES:
        raise UserError(f"coordinates is {_shown(coordinates)}; valid: {', '.join(COORDINATES)}")
    person = message.get("person")
    if person is not None and not (
        type(person) is str and 0 < len(person) <= MAX_PERSON and person.isascii() and person.isprintable()
    ):
        raise UserError(f"person is {_shown(person)}; expected: 1 to {MAX_PERSON} printable ASCII characters, or null")
    names, positions = _joints(message["joints"])
    return Observation(
        timestamp=timestamp,
        received=received,
        sequence=_sequence(message.get("sequence")),
        source=source,
        names=names,
        positions=positions,
        coordinates=coordinates,
        person=person,
    )


def encode(command: JointCommand) -> bytes:
    """A command as it goes over the wire (UTF-8 JSON, no line break).

    Raises:
        UserError: if a number of it is not finite: a robot must never get one.
    """
    message = {
        "version": VERSION,
        "type": "command",
        "timestamp": command.timestamp,
        "sequence": command.sequence,
        "observed": command.observed,
        "positions": dict(zip(command.joint_names, command.positions.tolist(), strict=True)),
        "stiffness": dict(zip(command.joint_names, command.stiffness.tolist(), strict=True)),
        "phase": command.phase,
        "contact": command.contact,
        "fired": command.fired,
    }
    try:
        return json.dumps(message, separators=(",", ":"), allow_nan=False).encode()
    except ValueError:
        raise UserError(f"command {command.sequence} holds a number that is not finite; nothing is sent") from None


def _joints(joints: Any) -> tuple[tuple[str, ...], Float[np.ndarray, "K 3"]]:
    """Names and positions [m] of the field `joints`."""
    if type(joints) is not dict:
        raise UserError(f"joints is {_shown(joints)}; expected: an object, name to [x, y, z] in metres or null")
    if not joints.keys() <= _JOINT_SET:
        _refuse_joints(joints)
    for name in ARM_JOINTS:
        if name not in joints:
            raise UserError(f"joints has no '{name}'; required: {', '.join(ARM_JOINTS)} (null where not tracked)")
    flat: list[float] = []
    for name, point in joints.items():
        if point is None:
            flat += _UNTRACKED
        elif type(point) is not list or len(point) != 3:
            raise UserError(f"joint '{name}' is {_shown(point)}; expected: [x, y, z] in metres, or null")
        else:
            for value in point:
                if type(value) not in (float, int) or not -MAX_DISTANCE <= value <= MAX_DISTANCE:
                    _number(f"a coordinate of joint '{name}'", value, MAX_DISTANCE, "metres")
            flat += point
    positions = np.array(flat, np.float64).reshape(-1, 3)
    positions.flags.writeable = False
    return tuple(joints), positions


def _number(field: str, value: Any, largest: float, unit: str) -> float:
    """A number of one field, refused unless it is finite and within ± `largest`."""
    if type(value) not in (float, int):
        raise UserError(f"{field} is {_shown(value)}; expected: a number in {unit}")
    if not -largest <= value <= largest:  # false for NaN too
        raise UserError(f"{field} is {_shown(value)}; expected: {unit}, within ±{largest:g}")
    return float(value)


def _sequence(value: Any) -> int | None:
    whole = type(value) is int or (type(value) is float and value.is_integer())
    if value is not None and not (whole and 0 <= value <= MAX_SEQUENCE):
        raise UserError(f"sequence is {_shown(value)}; expected: a whole number from 0 to 2^53 - 1, or null")
    return None if value is None else int(value)


def _refuse_fields(message: dict[str, Any]) -> NoReturn:
    unknown = next((name for name in message if name not in _FIELDS), None)
    if unknown is not None:
        raise UserError(f"field {_shown(unknown)} is unknown{_nearest(unknown, sorted(_FIELDS))}")
    missing = ", ".join(sorted(_REQUIRED - message.keys()))
    raise UserError(f"the message lacks: {missing}; a frame has: {', '.join(sorted(_REQUIRED))}")


def _refuse_joints(joints: dict[str, Any]) -> NoReturn:
    unknown = next(name for name in joints if name not in _JOINT_SET)
    raise UserError(f"joint {_shown(unknown)} is unknown{_nearest(unknown, list(JOINTS))}")


def _nearest(name: str, valid: list[str]) -> str:
    # Cut off: the comparison takes time with the square of the length, which a stranger chooses.
    close = difflib.get_close_matches(name[:40].lower().replace(" ", "_"), valid, n=1, cutoff=0.5)
    return f"; did you mean '{close[0]}'?" if close else f"; valid: {', '.join(valid)}"


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no JSON number; null stands for a joint that is not tracked")


def _shown(value: Any) -> str:
    """A value for a message: short, printable on any terminal, and never expanded where it nests."""
    if type(value) in (dict, list):
        return f"{'an object' if type(value) is dict else 'an array'} of {len(value)}"
    if type(value) is int and value.bit_length() > 100:  # as text it may be longer than Python agrees to write
        return "a huge number"
    text = json.dumps(value[:40] if type(value) is str else value)
    return text if type(value) is not str or len(value) <= 40 else f"{text}…"
