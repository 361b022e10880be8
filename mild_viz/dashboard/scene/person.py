"""One person's body: recorded limbs, and schematic parts for what was not recorded."""

from __future__ import annotations

import numpy as np
import viser
from jaxtyping import Bool, Float, UInt8

from mild_viz.dashboard.scene import body
from mild_viz.dashboard.scene.figure import Figure
from mild_viz.dashboard.scene.palette import Palette, linear
from mild_viz.dashboard.scene.shapes import Mesh, ball, limb, quaternion_from_matrix

FAINT = 0.75
"""A faint person's opacity, as a share of the schematic parts'."""


class PersonView:
    """Draws one figure under a frame that stands where the person stands."""

    def __init__(self, server: viser.ViserServer, root: str, colors: Palette, faint: bool = False) -> None:
        self._server, self._root = server, root
        self._colors = colors
        self._faint = faint
        self._frame = server.scene.add_frame(root, show_axes=False)
        self._figure: Figure | None = None
        self._schematic: dict[str, viser.MeshHandle] = {}
        self._ground: tuple[Figure, float, bytes] | None = None

    def show(
        self, figure: Figure, T_world_person: Float[np.ndarray, "4 4"], floor: float, colors: Palette, visible: bool
    ) -> None:
        """Take over a figure; recorded parts become new nodes only where their number changes."""
        self._frame.visible = visible
        self._frame.position = T_world_person[:3, 3]
        self._frame.wxyz = quaternion_from_matrix(T_world_person[None, :3, :3])[0]
        last, last_colors, self._figure, self._colors = self._figure, self._colors, figure, colors
        if last is None or last.limb_feeds.tolist() != figure.limb_feeds.tolist():
            if last is not None:  # nodes replaced under their names would be drawn with the old count for a moment
                self._limbs.remove()
                self._balls.remove()
            self._add_observed(figure)
        if last is None or last.height != figure.height or last.whole != figure.whole:
            self._add_part("torso", body.torso(figure.height))
            self._add_part("head", body.head(figure.height))
            self._add_part("left_arm", None if figure.whole else body.left_arm(figure.height))
        ground = (figure, floor, T_world_person.tobytes())
        if ground != self._ground:
            self._ground = ground
            self._add_part("support", None if figure.soles is not None else support(figure, T_world_person, floor))
        if figure is not last or colors is not last_colors:
            self._recolor()
            if "left_arm" in self._schematic:
                self._schematic["left_arm"].position = figure.shoulders

    def hide(self) -> None:
        """Draw nobody."""
        self._frame.visible = False

    def set_frame(self, n: int) -> None:
        """Show frame n."""
        figure = self._figure
        if figure is None or not self._frame.visible:
            return
        self._limbs.batched_positions = figure.limb_positions[n]
        self._limbs.batched_wxyzs = figure.limb_wxyzs[n]
        self._limbs.batched_scales = figure.limb_scales[n]
        self._balls.batched_positions = figure.ball_positions[n]
        self._balls.batched_scales = figure.ball_scales[n]
        torso, head = self._schematic["torso"], self._schematic["head"]
        torso.wxyz = head.wxyz = figure.torso_poses[n, :4]
        torso.position = figure.torso_poses[n, 4:]
        head.position = figure.head_positions[n]

    def _opacity(self, colors: Palette) -> float:
        return colors.schematic_opacity * (FAINT if self._faint else 1.0)

    def _add_observed(self, figure: Figure) -> None:
        scene, still = self._server.scene, np.array([1.0, 0.0, 0.0, 0.0])
        opacity = self._opacity(self._colors) if self._faint else None
        self._limbs = scene.add_batched_meshes_simple(
            f"{self._root}/limbs", *limb(), batched_wxyzs=figure.limb_wxyzs[0],
            batched_positions=figure.limb_positions[0], batched_scales=figure.limb_scales[0], opacity=opacity,
            lod="off", cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        self._balls = scene.add_batched_meshes_simple(
            f"{self._root}/joints", *ball(), batched_wxyzs=np.tile(still, (len(figure.ball_feeds), 1)),
            batched_positions=figure.ball_positions[0], batched_scales=figure.ball_scales[0], opacity=opacity,
            lod="off", cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def _add_part(self, name: str, mesh: Mesh | None) -> None:
        """Add, replace or take away one schematic part."""
        last = self._schematic.pop(name, None)
        if mesh is None:
            if last is not None:
                last.remove()
            return
        self._schematic[name] = self._server.scene.add_mesh_simple(
            f"{self._root}/schematic/{name}", *mesh, color=self._colors.schematic, opacity=self._opacity(self._colors),
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def _recolor(self) -> None:
        figure, colors = self._figure, self._colors
        assert figure is not None
        for handle, feeds in ((self._limbs, figure.limb_feeds), (self._balls, figure.ball_feeds)):
            handle.batched_colors = part_colors(feeds & (not self._faint), colors)
        for part in self._schematic.values():
            part.color, part.opacity = colors.schematic, self._opacity(colors)


def support(figure: Figure, T_world_person: Float[np.ndarray, "4 4"], floor: float) -> Mesh | None:
    """Legs or a stand, upright in world, in the person's frame."""
    R, t = T_world_person[:3, :3], T_world_person[:3, 3]
    pelvis = R @ (figure.shoulders - [0.0, 0.0, body.PELVIS_SHARE * figure.height]) + t
    left = R[:, 1] * [1.0, 1.0, 0.0]
    mesh = body.support(pelvis, left / np.linalg.norm(left), floor, figure.height)
    return None if mesh is None else ((mesh[0] - t) @ R, mesh[1])


def part_colors(feeds: Bool[np.ndarray, " P"], colors: Palette) -> UInt8[np.ndarray, "P 3"]:
    """The arm that feeds the model stands out."""
    return linear(np.where(feeds[:, None], colors.human, colors.body).astype(np.uint8))
