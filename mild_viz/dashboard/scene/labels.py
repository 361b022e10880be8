"""Billboard texts of a constant size on the screen."""

from __future__ import annotations

from typing import Literal

import viser

Anchor = Literal["bottom-center", "top-center", "center-left", "center-center", "center-right"]

TITLE, CAPTION, NOTE, TICK = 1.3, 0.95, 0.95, 0.85
"""Sizes, in units of viser's 12 pixels."""


def add_label(server: viser.ViserServer, name: str, text: str, size: float, anchor: Anchor) -> viser.LabelHandle:
    """A label that always faces the viewer and is never hidden by what stands before it."""
    return server.scene.add_label(name, text, font_screen_scale=size, anchor=anchor)


def add_title(server: viser.ViserServer, root: str, title: str) -> tuple[viser.LabelHandle, viser.LabelHandle]:
    """A group's title, and its caption right below."""
    return (
        add_label(server, f"{root}/title", title, TITLE, "bottom-center"),
        add_label(server, f"{root}/caption", "", CAPTION, "top-center"),
    )
