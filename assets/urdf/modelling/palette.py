"""Colours of the shells, joints and lights: sRGB bytes."""

from __future__ import annotations

from modelling.surfaces import Colour

WHITE: Colour = (236, 237, 240)
LIGHT: Colour = (196, 198, 204)
GREY: Colour = (132, 135, 142)
DARK: Colour = (70, 72, 79)
BLACK: Colour = (10, 10, 12)
SCREEN: Colour = (16, 19, 27)
LED: Colour = (86, 178, 235)
