"""Light, floor, and the pedestal that lifts the robot to a standing person."""

from __future__ import annotations

import numpy as np
import viser
from jaxtyping import Float

from mild_viz.dashboard.scene.palette import Palette
from mild_viz.dashboard.scene.shapes import Mesh, loft

LOWEST_PEDESTAL = 0.03
"""A smaller step between floor and robot [m] is not worth a pedestal."""


TALL, NARROW = 0.6, 0.25
"""A pedestal from this height on [m], under a robot that reaches less far from its axis, is a stand."""


class GroundView:
    """What the figures stand on."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        server.scene.set_up_direction("+z")
        light(server)
        self._pedestal: viser.MeshHandle | None = None
        self._shown: tuple[float, float, Palette, bool] | None = None

    def show(self, floor: float, robot: Float[np.ndarray, "2 3"], colors: Palette, robot_visible: bool) -> None:
        """A floor at this height, and a pedestal up to the robot, of these bounds [m]; it goes with the robot."""
        robot_bottom, footprint = float(robot[0, 2]), float(np.abs(robot[:, :2]).max())
        shown = (floor, robot_bottom, colors, robot_visible)
        if shown == self._shown:
            return
        if self._shown is None or self._shown[2] != colors:
            self._server.scene.set_background_image(np.full((2, 2, 3), colors.background, dtype=np.uint8), format="png")
        self._shown = shown
        self._server.scene.add_grid(
            "/ground/floor", 14.0, 14.0, plane="xy", cell_size=0.25, section_size=1.0, cell_color=colors.grid,
            section_color=colors.grid_section, cell_thickness=0.6, section_thickness=1.0, fade_distance=11.0,
            fade_strength=2.0, fade_from="camera", shadow_opacity=0.0, position=(0.0, 0.0, floor),
        )  # fmt: skip
        if self._pedestal is not None:
            self._pedestal.remove()
            self._pedestal = None
        if robot_visible and robot_bottom - floor > LOWEST_PEDESTAL:
            self._pedestal = self._server.scene.add_mesh_simple(
                "/ground/pedestal", *pedestal(floor, robot_bottom, footprint), color=colors.pedestal, cast_shadow=False,
                receive_shadow=False,
            )  # fmt: skip


def light(server: viser.ViserServer) -> None:
    """Soft light from all sides and a key light from the viewer's side, without shadows.

    viser's default light comes from straight above at full strength: white robots lose their shape in it.
    """
    scene = server.scene
    scene.configure_default_lights(enabled=False, cast_shadow=False)
    scene.configure_environment_map("studio", environment_intensity=0.35)
    scene.add_light_hemisphere("/ground/sky", sky_color=(255, 255, 255), ground_color=(150, 155, 165), intensity=0.55)
    scene.add_light_directional("/ground/key", intensity=1.5, position=(1.0, -2.2, 3.0))
    scene.add_light_directional("/ground/fill", intensity=0.35, position=(-2.5, -1.0, 1.5))


def pedestal(floor: float, top: float, footprint: float) -> Mesh:
    """A round podium with a softened edge, or a slim stand where it is tall and the robot narrow [m]."""
    edge, wide = 0.012, 0.345
    if top - floor > TALL and footprint < NARROW:
        plate, post = footprint + 0.04, 0.07
        radius = np.array([wide, wide, wide - edge, post + 0.03, post, post, plate - 0.02, plate, plate, plate - edge])
        z = np.array([0.0, 0.03, 0.03 + edge, 0.05, 0.08, -0.09, -0.05, -0.04, -edge, 0.0])
        z += np.where(np.arange(len(z)) < 5, floor, top)
    else:
        radius = np.array([wide, wide, wide - edge])
        z = np.array([floor, top - edge, top])
    zero = np.zeros(len(z))
    return loft(np.stack([z, radius, radius, zero, zero], 1), sides=72)
