"""Colours of the scene on a light and on a dark background."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from mild_viz.settings import STATE_COLORS

Rgb = tuple[int, int, int]


def rgb(color: str) -> Rgb:
    """'#RRGGBB' as three integers."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


def linear(colors: UInt8[np.ndarray, "*shape 3"]) -> UInt8[np.ndarray, "*shape 3"]:
    """Colours as viser's lines and batched meshes want them.

    The browser takes theirs as linear light and brightens them once more on the way to the screen, while
    those of all other nodes are taken as sRGB: without this, reds turn pink and faint lines white.
    """
    value = colors / 255.0
    light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return np.round(255.0 * light).astype(np.uint8)


def state_color(state: int) -> Rgb:
    """Colour of an HMM state; beyond the palette's eight it starts again."""
    return rgb(STATE_COLORS[state % len(STATE_COLORS)])


@dataclass(frozen=True)
class Palette:
    """One colour per meaning. Human is red and robot blue wherever they occur."""

    background: Rgb
    """What is painted behind the scene; faint lines are mixed towards it. The boxes of viser's labels are always
    light: on a mid-dark background they look less glaring than on the page's own near-black."""
    human: Rgb
    body: Rgb
    """Recorded joints that do not feed the model."""
    schematic: Rgb
    """Parts that were not observed."""
    schematic_opacity: float
    robot: Rgb
    prediction: Rgb
    """The decoded motion as a translucent arm."""
    dashes: Rgb
    """The predicted trajectory."""
    contact: Rgb
    distance: Rgb
    grid: Rgb
    grid_section: Rgb
    pedestal: Rgb
    object: Rgb
    """What is handed over."""
    frame: Rgb
    """Edges of the latent plot's box."""

    def faint(self, color: Rgb, share: float) -> Rgb:
        """`color` mixed with the background; `share` of it is left."""
        red, green, blue = (round(share * c + (1.0 - share) * b) for c, b in zip(color, self.background, strict=True))
        return red, green, blue


LIGHT = Palette(
    background=(255, 255, 255),
    human=rgb("#D7263D"),
    body=rgb("#6B7480"),
    schematic=rgb("#7F8DA0"),
    schematic_opacity=0.38,
    robot=rgb("#1B5FC1"),
    prediction=rgb("#58A3F5"),
    dashes=rgb("#0B2F6B"),
    contact=rgb("#009E73"),
    distance=rgb("#30343B"),
    grid=rgb("#E7EAEE"),
    grid_section=rgb("#D3D8DF"),
    pedestal=rgb("#C9CFD6"),
    object=rgb("#E0A100"),
    frame=rgb("#9AA4B1"),
)

DARK = Palette(
    background=rgb("#3A424D"),
    human=rgb("#FF5A6A"),
    body=rgb("#B4BCC7"),
    schematic=rgb("#9FB0C6"),
    schematic_opacity=0.34,
    robot=rgb("#4C8DFF"),
    prediction=rgb("#9CCBFF"),
    dashes=rgb("#C6E2FF"),
    contact=rgb("#2BD6A0"),
    distance=rgb("#E6E9EE"),
    grid=rgb("#444D59"),
    grid_section=rgb("#525C69"),
    pedestal=rgb("#5E6874"),
    object=rgb("#F2C033"),
    frame=rgb("#8792A1"),
)


CONTROLLER_COLORS: dict[str, Rgb] = {
    "base-ik": rgb("#E69F00"), "mild": rgb("#8250C8"), "mild-ik": rgb("#009E73"),
}  # fmt: skip
"""Colour of each controller's ghost where several are compared, on either background."""

SIMULATED, FORCE = rgb("#12B5CB"), rgb("#E8590C")
"""The simulated arm's ghost, and the force between the hands, on either background."""


def palette(dark: bool) -> Palette:
    """The colours that read on the page's light or dark background."""
    return DARK if dark else LIGHT
