"""How it is drawn: opacity, axes, ellipsoids, what is visible, camera, theme. Never reruns the pipeline."""

from __future__ import annotations

from collections.abc import Callable

import viser

from mild_viz.dashboard.scene.scene import CAMERAS
from mild_viz.dashboard.tabs.widgets import Changed, number, offer, on_person, option
from mild_viz.dashboard.view import ViewSettings
from mild_viz.errors import UserError
from mild_viz.rollout import Rollout
from mild_viz.settings import ALPHA_MODES

PCA, DIMENSIONS = "principal components", "dimensions"


class ViewTab:
    """Widgets of `ViewSettings`, and the camera presets."""

    def __init__(
        self, gui: viser.GuiApi, changed: Changed, move_camera: Callable[[viser.ClientHandle, str], None]
    ) -> None:
        default = ViewSettings()
        names = {name.capitalize(): name for name in CAMERAS}
        self._camera = gui.add_button_group("Camera", tuple(names), hint="Take this browser's camera to a preset.")
        self._theme = gui.add_dropdown("Theme", ("light", "dark"), hint="Colours of the page, for all browsers.")
        self._alpha = gui.add_dropdown(
            "Opacity by α", ALPHA_MODES, initial_value=default.alpha_mode,
            hint="Forward variable behind the opacity: of the human (as on a robot), of both, or of no observation.",
        )  # fmt: skip
        self._sigma = gui.add_slider(
            "Ellipsoid σ", 0.5, 3.0, 0.1, default.sigma, hint="Radius of the ellipsoids, in standard deviations."
        )
        self._axes = gui.add_dropdown(
            "Latent axes", (PCA, DIMENSIONS), hint="What the three axes of the latent plot are."
        )
        self._dimensions = [
            gui.add_dropdown(
                f"Axis {axis}",
                ("z0", "z1", "z2"),
                initial_value=f"z{i}",
                visible=False,
                hint=f"Latent dimension on the {axis} axis.",
            )
            for i, axis in enumerate("xyz")
        ]
        self._ghost = gui.add_checkbox(
            "Ghost", default.ghost, hint="Also draw the decoded motion, before inverse kinematics, translucent."
        )
        self._reach = gui.add_checkbox(
            "Reach volume", default.show_reach, hint="Draw how far the robot's hand reaches in every direction."
        )
        self._visible = {
            group: gui.add_checkbox(f"Show {group}", True, hint=f"Draw the {group}.")
            for group in ("human", "robot", "latent plot")
        }
        self._giver = gui.add_checkbox(
            "Show giver", default.show_giver, visible=False,
            hint="Draw the recorded giver, grey (legs schematic). Without the robot, the object too is as recorded.",
        )  # fmt: skip
        self._axis_names = ["z0", "z1", "z2"]
        """What the axes were at the last reading."""
        widgets = (self._theme, self._alpha, self._sigma, self._axes, *self._dimensions, self._ghost, self._reach)
        for handle in (*widgets, self._giver, *self._visible.values()):
            on_person(handle, changed)

        @self._camera.on_click
        def _(event: viser.GuiEvent) -> None:
            name = names.get(self._camera.value)
            if event.client is not None and name is not None:
                move_camera(event.client, name)

    def read(self) -> ViewSettings:
        """The chosen view. An axis that takes another one's dimension swaps with it."""
        by_dimension = option(self._axes) == DIMENSIONS
        for handle in self._dimensions:
            if handle.visible != by_dimension:
                handle.visible = by_dimension
        names = swapped(self._axis_names, [option(handle) for handle in self._dimensions])
        for handle, name in zip(self._dimensions, names, strict=True):
            if handle.value != name:
                handle.value = name
        self._axis_names = names
        if by_dimension and len(set(names)) < len(names):
            raise UserError(f"the axes show {', '.join(names)}; valid: three different latent dimensions")
        x, y, z = (int(name.removeprefix("z")) for name in names)
        human, robot, latent = (bool(handle.value) for handle in self._visible.values())
        return ViewSettings(
            alpha_mode=option(self._alpha),
            latent_axes=(x, y, z) if by_dimension else "pca",
            sigma=number(self._sigma),
            ghost=bool(self._ghost.value),
            show_reach=bool(self._reach.value),
            show_human=human,
            show_giver=bool(self._giver.value),
            show_robot=robot,
            show_latent=latent,
            dark=option(self._theme) == "dark",
        )

    def show(self, rollout: Rollout) -> None:
        """Offer the latent dimensions that the model has, and the giver where one was recorded in the same world."""
        self._giver.visible = rollout.T_world_partner is not None and rollout.inference.partner_skeleton is not None
        n_dimensions = rollout.inference.human_latent_mean.shape[1]
        names = [f"z{i}" for i in range(n_dimensions)]
        for handle in self._dimensions:
            offer(handle, names)
        if not set(self._axis_names) <= set(names):  # of a model with more of them
            self._axis_names = [names[min(i, n_dimensions - 1)] for i in range(len(self._dimensions))]
            for handle, name in zip(self._dimensions, self._axis_names, strict=True):
                handle.value = name


def swapped(before: list[str], wanted: list[str]) -> list[str]:
    """The axes after a choice: whoever had the dimension that an axis takes gets that axis' old one."""
    axes = list(before)
    for i, name in enumerate(wanted):
        if name != before[i]:
            if name in axes:
                axes[axes.index(name)] = axes[i]
            axes[i] = name
    return axes
