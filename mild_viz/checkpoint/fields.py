"""Strict reading of JSON that a person may have edited: each value as what it is expected to be, nothing converted."""

from __future__ import annotations

import json
import reprlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from mild_viz.errors import UserError

MAX_SIZE = 100_000
"""Largest width of a layer, latent space or set of states that is read."""

Kind = TypeVar("Kind")
KINDS: dict[type, str] = {str: "a text", bool: "true or false", list: "a list [...]", dict: "an object {...}"}


def read_json(file: Path) -> Any:
    """The content of a JSON file; an error names the file and what is wrong with it."""
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{file} cannot be read: {error.strerror or error}") from None
    except (ValueError, RecursionError) as error:  # no JSON, no UTF-8, a number of thousands of digits; deep nesting
        raise UserError(f"{file} is not valid JSON: {error}") from None


def typed(value: Any, kind: type[Kind], where: str) -> Kind:
    """`value` if JSON gave it as exactly this type: nothing is converted."""
    if type(value) is not kind:
        raise UserError(f"{where} is {reprlib.repr(value)}, expected {KINDS[kind]}")
    return value


def size(value: Any, where: str) -> int:
    """`value` if it is a whole number from 1 to `MAX_SIZE`."""
    if type(value) is not int or not 1 <= value <= MAX_SIZE:
        raise UserError(f"{where} is {reprlib.repr(value)}, expected a whole number from 1 to {MAX_SIZE}")
    return value


def number(value: Any, where: str) -> float:
    """`value` if it is a finite number."""
    if type(value) not in (int, float) or not abs(value) < 1e300:  # float() has no larger integers
        raise UserError(f"{where} is {reprlib.repr(value)}, expected a finite number")
    return float(value)


def point(value: Any, where: str) -> tuple[float, float, float]:
    """`value` if it is a list of three finite numbers."""
    if len(typed(value, list, where)) != 3:
        raise UserError(f"{where} is {reprlib.repr(value)}, expected three numbers")
    x, y, z = (number(entry, where) for entry in value)
    return x, y, z


def names(value: Any, where: str) -> tuple[str, ...]:
    """`value` if it lists one name or more, each once."""
    found = tuple(typed(name, str, f"{where}: an entry") for name in typed(value, list, where))
    if not found or len(set(found)) < len(found):
        raise UserError(f"{where} is {reprlib.repr(value)}, expected one name or more, each once")
    return found


def need(table: Mapping[str, Any], keys: Sequence[str], where: str) -> None:
    """Raise an error unless the table has all of the keys."""
    missing = [key for key in keys if key not in table]
    if missing:
        raise UserError(f"{where}: missing {', '.join(missing)}")
