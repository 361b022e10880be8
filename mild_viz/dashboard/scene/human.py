"""The human: what was observed is solid, what was not is a faint schematic person."""

from __future__ import annotations

import numpy as np
import viser
from jaxtyping import Bool, Float, UInt8

from mild_viz.dashboard.scene import body
from mild_viz.dashboard.scene.figure import Figure
from mild_viz.dashboard.scene.labels import NOTE, add_label, add_title
from mild_viz.dashboard.scene.layout import TITLE_GAP
from mild_viz.dashboard.scene.palette import Palette, linear
from mild_viz.dashboard.scene.shapes import Mesh, ball, limb, quaternion_from_matrix

ROOT = "/human"


class HumanView:
    """Draws one figure under a frame that stands where the human stands."""

    def __init__(self, server: viser.ViserServer, colors: Palette) -> None:
        self._server = server
        self._colors = colors
        self._frame = server.scene.add_frame(ROOT, show_axes=False)
        self._title, self._caption = add_title(server, ROOT, "Human")
        self._lost = add_label(server, f"{ROOT}/lost", "tracking lost", NOTE, "center-center")
        self._figure: Figure | None = None
        self._schematic: dict[str, viser.MeshHandle] = {}
        self._ground: tuple[Figure, float, bytes] | None = None

    def show(
        self,
        figure: Figure,
        T_world_human: Float[np.ndarray, "4 4"],
        floor: float,
        colors: Palette,
        visible: bool,
        tracked: Bool[np.ndarray, " N"],
    ) -> None:
        """Take over a figure; observed parts become new nodes only where their number changes."""
        self._tracked = tracked
        self._frame.visible = visible
        self._frame.position = T_world_human[:3, 3]
        self._frame.wxyz = quaternion_from_matrix(T_world_human[None, :3, :3])[0]
        last, last_colors, self._figure, self._colors = self._figure, self._colors, figure, colors
        if last is None or last.limb_feeds.tolist() != figure.limb_feeds.tolist():
            if last is not None:  # nodes replaced under their names would be drawn with the old count for a moment
                self._limbs.remove()
                self._balls.remove()
            self._limbs, self._balls = add_observed(self._server, ROOT, figure)
        if last is None or last.height != figure.height or last.whole != figure.whole:
            self._add_part("torso", body.torso(figure.height))
            self._add_part("head", body.head(figure.height))
            self._add_part("left_arm", None if figure.whole else body.left_arm(figure.height))
        ground = (figure, floor, T_world_human.tobytes())
        if ground != self._ground:
            self._ground = ground
            self._add_part("support", None if figure.soles is not None else support(figure, T_world_human, floor))
        if figure is not last or colors is not last_colors:
            self._recolor()
            self._place_labels(figure)

    def set_frame(self, n: int) -> None:
        """Show frame n."""
        figure = self._figure
        if figure is None:
            return
        pose_observed(self._limbs, self._balls, figure, n)
        torso, head = self._schematic["torso"], self._schematic["head"]
        torso.wxyz = head.wxyz = figure.torso_poses[n, :4]
        torso.position = figure.torso_poses[n, 4:]
        head.position = figure.head_positions[n]
        self._lost.visible = not bool(self._tracked[n])
        if figure.walks:
            self._title.position = self._caption.position = figure.crowns[n] + [0.0, 0.0, TITLE_GAP]

    def _add_part(self, name: str, mesh: Mesh | None) -> None:
        """Add, replace or take away one schematic part."""
        last = self._schematic.pop(name, None)
        if mesh is None:
            if last is not None:
                last.remove()
            return
        self._schematic[name] = self._server.scene.add_mesh_simple(
            f"{ROOT}/schematic/{name}", *mesh, color=self._colors.schematic, opacity=self._colors.schematic_opacity,
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def _recolor(self) -> None:
        figure, colors = self._figure, self._colors
        assert figure is not None
        self._limbs.batched_colors = part_colors(figure.limb_feeds, colors)
        self._balls.batched_colors = part_colors(figure.ball_feeds, colors)
        for part in self._schematic.values():
            part.color, part.opacity = colors.schematic, colors.schematic_opacity

    def _place_labels(self, figure: Figure) -> None:
        middle, height = figure.shoulders, figure.height
        self._title.position = self._caption.position = figure.crowns[0] + [0.0, 0.0, TITLE_GAP]
        self._lost.position = middle + [0.0, 0.0, -0.14 * height]
        whole = "red arm: model input" if figure.soles is not None else "red arm: model input, pale: schematic"
        self._caption.text = whole if figure.whole else "right arm observed, rest schematic"
        if "left_arm" in self._schematic:
            self._schematic["left_arm"].position = middle


def add_observed(
    server: viser.ViserServer, root: str, figure: Figure, opacity: float | None = None
) -> tuple[viser.BatchedMeshHandle, viser.BatchedMeshHandle]:
    """The recorded limbs and joints of a figure, under a frame named `root`."""
    scene, still = server.scene, np.array([1.0, 0.0, 0.0, 0.0])
    limbs = scene.add_batched_meshes_simple(
        f"{root}/limbs", *limb(), batched_wxyzs=figure.limb_wxyzs[0], batched_positions=figure.limb_positions[0],
        batched_scales=figure.limb_scales[0], lod="off", opacity=opacity, cast_shadow=False, receive_shadow=False,
    )  # fmt: skip
    balls = scene.add_batched_meshes_simple(
        f"{root}/joints", *ball(), batched_wxyzs=np.tile(still, (len(figure.ball_feeds), 1)),
        batched_positions=figure.ball_positions[0], batched_scales=figure.ball_scales[0], lod="off", opacity=opacity,
        cast_shadow=False, receive_shadow=False,
    )  # fmt: skip
    return limbs, balls


def pose_observed(limbs: viser.BatchedMeshHandle, balls: viser.BatchedMeshHandle, figure: Figure, n: int) -> None:
    """Put the recorded limbs and joints where they were in frame n."""
    limbs.batched_positions, limbs.batched_wxyzs = figure.limb_positions[n], figure.limb_wxyzs[n]
    limbs.batched_scales = figure.limb_scales[n]
    balls.batched_positions, balls.batched_scales = figure.ball_positions[n], figure.ball_scales[n]


def support(
    figure: Figure, T_world_human: Float[np.ndarray, "4 4"], floor: float, shortest: float = 0.85
) -> Mesh | None:
    """Legs or a stand, upright in world, in the human's frame."""
    R, t = T_world_human[:3, :3], T_world_human[:3, 3]
    pelvis = R @ (figure.shoulders - [0.0, 0.0, body.PELVIS_SHARE * figure.height]) + t
    left = R[:, 1] * [1.0, 1.0, 0.0]
    mesh = body.support(pelvis, left / np.linalg.norm(left), floor, figure.height, shortest)
    return None if mesh is None else ((mesh[0] - t) @ R, mesh[1])


def part_colors(feeds: Bool[np.ndarray, " P"], colors: Palette) -> UInt8[np.ndarray, "P 3"]:
    """The arm that feeds the model stands out."""
    return linear(np.where(feeds[:, None], colors.human, colors.body).astype(np.uint8))
