"""Configs in TOML, read strictly: a misspelt key is an error with the nearest valid one, never a default."""

from __future__ import annotations

import math
import reprlib
import sys
from collections.abc import Collection, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

from mild_viz.errors import UserError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

KINDS: dict[Any, str] = {int: "a whole number", float: "a finite number", str: "a text", bool: "true or false"}


def read_toml(file: Path) -> dict[str, Any]:
    """The content of a TOML file; an error names the file, and the line where it is not TOML."""
    try:
        return tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{file} cannot be read: {error.strerror or error}") from None
    except (ValueError, RecursionError) as error:  # no TOML, no UTF-8; deep nesting
        raise UserError(f"{file} is not valid TOML: {error}") from None


def check_keys(table: Mapping[str, Any], valid: Collection[str], where: str) -> None:
    """Refuse a key that means nothing, and suggest the nearest that does."""
    for key in table:
        if key not in valid:
            near = get_close_matches(key, valid, 1)
            hint = f"did you mean '{near[0]}'? " if near else ""
            raise UserError(f"{where}: unknown key '{key}'; {hint}valid: {', '.join(sorted(valid))}")


def converted(value: Any, hint: Any, where: str) -> Any:
    """`value`, as TOML gave it, as the annotated type `hint`; only a whole number becomes another (a float)."""
    kind, inner = get_origin(hint) or hint, get_args(hint)
    if kind in (Union, UnionType):  # X | None: TOML has no null, a key is left out
        return converted(value, next(arg for arg in inner if arg is not type(None)), where)
    if kind is Literal:
        if value not in inner:
            raise UserError(f"{where} is {reprlib.repr(value)}; valid: {', '.join(map(str, inner))}")
        return value
    if kind in (tuple, Sequence):
        fixed = kind is tuple and Ellipsis not in inner
        if type(value) is not list or (fixed and len(value) != len(inner)):
            raise UserError(
                f"{where} is {reprlib.repr(value)}, expected a list{f' of {len(inner)}' if fixed else ''}: [...]"
            )
        hints = inner if fixed else inner[:1] * len(value)
        return tuple(converted(entry, of, f"{where}: an entry") for entry, of in zip(value, hints, strict=True))
    if kind is float and type(value) in (int, float) and math.isfinite(value):
        return float(value)
    if kind is Path and type(value) is str:
        return Path(value).expanduser()
    if kind is float or type(value) is not kind:
        raise UserError(f"{where} is {reprlib.repr(value)}, expected {KINDS.get(kind, KINDS[str])}")
    return value
