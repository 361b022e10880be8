"""Reading widgets back: viser accepts any value that a browser sends, so everything is checked here."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import viser

from mild_viz.errors import UserError

Changed = Callable[[], None]


def on_person(handle: Any, changed: Changed) -> None:
    """Call `changed` when a person moves the widget; what the program sets itself has no client."""

    @handle.on_update
    def _(event: viser.GuiEvent) -> None:
        if event.client_id is not None:
            changed()


def number(handle: viser.GuiSliderHandle[float] | viser.GuiSliderHandle[int]) -> float:
    """A slider's value, within its range; a value outside is put back to the nearest end."""
    value = float(handle.value)
    if not math.isfinite(value):
        raise UserError(f"{handle.label} is {value}; valid: {handle.min:g} to {handle.max:g}")
    clipped = min(max(value, float(handle.min)), float(handle.max))
    if clipped != value:
        handle.value = type(handle.value)(clipped)  # pyright: ignore[reportAttributeAccessIssue]
    return clipped


def option(handle: viser.GuiDropdownHandle[Any]) -> str:
    """A dropdown's value, one of its options; anything else is put back to the first one, with a message."""
    value = str(handle.value)
    if value not in handle.options:
        handle.value = handle.options[0]
        raise UserError(f"{handle.label} '{value}' is unknown; valid: {', '.join(handle.options)}")
    return value


def offer(handle: viser.GuiDropdownHandle[Any], options: Iterable[str], value: str | None = None) -> None:
    """Make these the options (sent only if they differ), and select `value`, or else what was selected, if possible."""
    options = tuple(options)
    keep = handle.value if value is None else value
    if handle.options != options:
        handle.options = options
    handle.value = keep if keep in options else options[0]


def set_content(handle: viser.GuiHtmlHandle, content: str) -> None:
    """Change a snippet of HTML, if it differs."""
    if handle.content != content:
        handle.content = content


def sentence(text: str) -> str:
    """With a capital and a full stop."""
    return f"{text[:1].upper()}{text[1:].rstrip('.')}." if text else ""


def widget_id(handle: Any) -> str:
    """The id of the widget's element in the page, for its style; viser has no public name for it."""
    return handle._impl.uuid
