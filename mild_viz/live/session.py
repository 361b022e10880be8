"""A live session as a file: one JSON object a line, appended as it happens: a crash loses the last line at most.

The first line says what ran (`header`), every further one is a turn of the control loop: what was observed, what the
model said, what was decided and sent, how long it took. Numbers are exact: the shortest text that reads back as the
same double. NaN is null; infinities, which JSON lacks, are the texts "inf" and "-inf".
"""

from __future__ import annotations

import json
import math
import os
import reprlib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from mild_viz.errors import UserError
from mild_viz.live.controller import Decision
from mild_viz.live.loop import Tick
from mild_viz.live.messages import JointCommand, Observation
from mild_viz.streaming import Command

VERSION = 1
"""Of the format. A change that an old reader would misread gives the next number."""

WORDS = {"inf": math.inf, "-inf": -math.inf}

SCALARS = {
    name: kind
    for name, kind in (("log_transition", float), ("active_state", int), ("contact", bool), ("fired", int))
    if name in Command._fields
}
"""Fields of a `Command` that are no arrays."""


@dataclass(frozen=True)
class Session:
    """A recorded session."""

    path: Path
    header: dict[str, Any]
    ticks: tuple[Tick, ...]
    torn: bool
    """Whether the program was interrupted while it wrote: the last line was incomplete and is left out."""


def plain(value: Any) -> Any:
    """A value of a record as JSON can hold it, without losing a bit."""
    if isinstance(value, np.ndarray):
        return value.tolist() if np.isfinite(value).all() else plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, dict):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else ("inf" if value > 0 else "-inf")
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, frozenset):
        return sorted(value)
    return value


def to_line(record: dict[str, Any]) -> bytes:
    """One record, with its line break."""
    return json.dumps(plain(record), separators=(",", ":"), allow_nan=False).encode() + b"\n"


def tick_record(tick: Tick, names: tuple[str, ...] | None) -> dict[str, Any]:
    """A turn of the loop; `names` are the joints of the frame before, which are not written again."""
    record: dict[str, Any] = {"kind": "tick", "time": tick.time, "computing": tick.computing, "whole": tick.whole}
    if tick.seen is not None:
        seen = {field.name: getattr(tick.seen, field.name) for field in fields(tick.seen)}
        if seen["names"] == names:
            del seen["names"]
        record["seen"] = seen
    if tick.decision is not None:
        decision = {field.name: getattr(tick.decision, field.name) for field in fields(tick.decision)}
        record["decision"] = decision | {"command": tick.decision.command._asdict()}
    if tick.sent is not None:
        sent = {field.name: getattr(tick.sent, field.name) for field in fields(tick.sent)}
        del sent["joint_names"]
        record["sent"] = sent
    if tick.fault:
        record["fault"] = tick.fault
    return record


def read_session(path: Path) -> Session:
    """A session that was recorded, or is being recorded.

    Raises:
        UserError: if the file cannot be read, is no session, or is damaged, naming the line. Only a last line without
            its line break is left out: that is what a crash leaves.
    """
    try:
        with open(path, "rb") as file:
            content = file.read()
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror or error}") from None
    *lines, rest = content.split(b"\n")
    if not lines:
        raise UserError(f"{path} holds no whole line; expected a session as `mild-viz live --record` writes it")
    header = _header(_parsed(lines[0], f"{path}: line 1"), f"{path}: line 1")
    ticks: list[Tick] = []
    names: tuple[str, ...] = ()
    joint_names = tuple(header["robot"]["joint_names"])
    for number, line in enumerate(lines[1:], start=2):
        where = f"{path}: line {number}"
        record = _parsed(line, where)
        try:
            tick = _tick(record, names, joint_names)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise UserError(f"{where} is damaged: {type(error).__name__}: {reprlib.repr(str(error))}") from None
        if tick.seen is not None:
            names = tick.seen.names
        if ticks and tick.time < ticks[-1].time:
            raise UserError(f"{where} is damaged: its time {tick.time} is before that of the line before")
        ticks.append(tick)
    return Session(path, header, tuple(ticks), torn=bool(rest))


def _parsed(line: bytes, where: str) -> dict[str, Any]:
    try:
        record = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{where} is damaged: it is no JSON ({reprlib.repr(str(error))})") from None
    if type(record) is not dict:
        raise UserError(f"{where} is damaged: {reprlib.repr(record)} is no object")
    return record


def _header(record: dict[str, Any], where: str) -> dict[str, Any]:
    if record.get("kind") != "session" or "version" not in record:
        raise UserError(f"{where} begins no session; expected what `mild-viz live --record` writes")
    if record["version"] != VERSION:
        raise UserError(f"{where}: version is {reprlib.repr(record['version'])}; this program reads version {VERSION}")
    try:
        names = record["robot"]["joint_names"]
        valid = type(names) is list and all(type(name) is str for name in names)
        valid &= {"checkpoint", "variant", "action", "rate", "control", "config", "T_world_human"} <= record.keys()
    except (KeyError, TypeError):
        valid = False
    if not valid:
        raise UserError(f"{where} is damaged: it does not say what ran")
    return record


def _array(value: Any, *shape: int) -> np.ndarray:
    """Numbers back from JSON; `shape` where it is known."""
    array = np.array(_numbers(value), dtype=np.float64)
    if shape and (array.ndim != len(shape) or any(n != m for n, m in zip(shape, array.shape, strict=True))):
        raise ValueError(f"shape {array.shape}")
    return array


def _numbers(value: Any) -> Any:
    if type(value) is list:
        return [_numbers(each) for each in value]
    if value is None:
        return math.nan
    if type(value) is str:
        return WORDS[value]
    if type(value) not in (int, float):
        raise TypeError(reprlib.repr(value))
    return float(value)


def _tick(record: dict[str, Any], names: tuple[str, ...], joint_names: tuple[str, ...]) -> Tick:
    if record["kind"] != "tick":
        raise ValueError(f"kind {record['kind']}")
    seen, decision, sent = (record.get(key) for key in ("seen", "decision", "sent"))
    return Tick(
        time=_number(record["time"]),
        seen=None if seen is None else _seen(seen, names),
        decision=None if decision is None else _decision(decision, len(joint_names)),
        sent=None if sent is None else _sent(sent, joint_names),
        computing=_number(record["computing"]),
        whole=_numbers(record["whole"]),
        fault=_text(record.get("fault", "")),
    )


def _seen(seen: dict[str, Any], names: tuple[str, ...]) -> Observation:
    names = tuple(_text(name) for name in seen["names"]) if "names" in seen else names
    return Observation(
        **{
            **seen,
            "timestamp": _number(seen["timestamp"]),
            "received": _number(seen["received"]),
            "source": _text(seen["source"]),
            "coordinates": _text(seen["coordinates"]),
            "names": names,
            "positions": _array(seen["positions"], len(names), 3),
        }
    )


def _decision(decision: dict[str, Any], n_joints: int) -> Decision:
    said = decision["command"]
    values: dict[str, Any] = {
        name: _scalar(said[name], SCALARS[name]) if name in SCALARS else _array(said[name]) for name in said
    }
    command = Command(**values)
    if command.joints_commanded.shape != (n_joints,):
        raise ValueError(f"{command.joints_commanded.shape} joints")
    samples = tuple(_array(sample, 3, 3) for sample in decision["samples"])
    person = decision["T_world_person"]
    found = None if person is None else _array(person, 4, 4)
    return Decision(**{**decision, "command": command, "samples": samples, "T_world_person": found})


def _sent(sent: dict[str, Any], joint_names: tuple[str, ...]) -> JointCommand:
    arrays = {name: _array(sent[name], len(joint_names)) for name in ("positions", "stiffness")}
    return JointCommand(**{**sent, **arrays, "joint_names": joint_names, "fired": tuple(sent["fired"])})


def _number(value: Any) -> float:
    if type(value) not in (int, float):
        raise TypeError(f"{reprlib.repr(value)} is no number")
    return float(value)


def _scalar(value: Any, kind: type) -> Any:
    if kind is float:
        return _numbers(value)
    if type(value) is not kind:
        raise TypeError(f"{reprlib.repr(value)} is no {kind.__name__}")
    return value


def _text(value: Any) -> str:
    if type(value) is not str:
        raise TypeError(f"{reprlib.repr(value)} is no text")
    return value


def open_session_file(path: Path, header: dict[str, Any]) -> int:
    """A new file with its first line, to append to. Raises UserError where there is one already, or none can be."""
    try:
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | getattr(os, "O_BINARY", 0), 0o644)
    except FileExistsError:
        raise UserError(f"{path} exists and is not overwritten; choose another name, or remove it") from None
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror or error}; choose another place") from None
    line = to_line({"kind": "session", "version": VERSION, **header})
    try:
        written = os.write(file, line)
        reason = "the disk is full"
    except OSError as error:
        written, reason = 0, error.strerror or str(error)
    if written != len(line):
        os.close(file)
        path.unlink(missing_ok=True)
        raise UserError(f"{path} cannot be written: {reason}; choose another place")
    return file
