"""The latent plot: trajectories of human and robot, and one ellipsoid per state and agent."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import viser
from jaxtyping import Bool, Float

from mild_viz.dashboard.scene.labels import CAPTION, TICK, add_label, add_title
from mild_viz.dashboard.scene.layout import PLOT_SIZE, PLOT_TURN, VIEWER, Layout, picture_axes
from mild_viz.dashboard.scene.palette import Palette, linear, state_color
from mild_viz.dashboard.scene.projection import Projection, magnified, make_projection
from mild_viz.dashboard.view import ViewSettings
from mild_viz.rollout import Inference

ROOT = "/latent"
HALF = 0.5 * PLOT_SIZE

TRAIL = 30
"""Windows of the past that are drawn bold."""

DASH = 0.022
"""Length of a dash of the predicted trajectory, and of the gap after it [m]."""

OPACITY_FLOOR, OPACITY_RANGE = 0.16, 0.56
"""An inactive state stays findable; a fully active one still shows what is inside it."""

TEXT_SIZE = (0.10, 0.085)
"""Room that a state's name takes on a small screen [m]."""

AGENTS = ("human", "robot")
TRACES = ("human", "truth", "prediction")

Segments = Float[np.ndarray, "_ 2 3"]


@dataclass(frozen=True, eq=False)
class LatentFrames:
    """What the latent view draws of one rollout, in the box's coordinates [m]."""

    traces: dict[str, Float[np.ndarray, "N 3"]]
    """Points of each of `TRACES`; a gap repeats the last point, `known` says where there is one."""
    known: dict[str, bool]
    lines: dict[str, Segments]
    """The whole trajectory of each trace; the prediction's is dashed."""
    ellipsoids: dict[str, tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S 4"], Float[np.ndarray, "S 3"]]]
    labels: Float[np.ndarray, "A S 3"]
    """Where the states' names stand, per agent: at the ellipsoids, moved a little where they would overlap."""
    visited: Bool[np.ndarray, " S"]
    """Whether the state is ever active; only these are named."""
    opacity: Float[np.ndarray, "N S"]
    projection: Projection
    magnification: float
    """How often the robot's latents are enlarged (`projection.magnified`)."""


def latent_frames(inference: Inference, view: ViewSettings) -> LatentFrames:
    """Project everything once for the whole rollout."""
    inference, magnification = magnified(inference)
    projection = make_projection(inference, view.latent_axes)
    latent = {
        "human": inference.human_latent_mean,
        "truth": inference.robot_latent_truth,
        "prediction": inference.robot_latent_mean,
    }
    raw = {name: np.clip(projection.points(values), -1.1 * HALF, 1.1 * HALF) for name, values in latent.items()}
    solid = {name: segments(points) for name, points in raw.items()}
    alpha = np.exp(inference.log_alpha(view.alpha_mode))
    ellipsoids = {
        "human": projection.ellipsoids(inference.human_state_means, inference.human_state_covariances, view.sigma),
        "robot": projection.ellipsoids(inference.robot_state_means, inference.robot_state_covariances, view.sigma),
    }
    visited = np.isin(np.arange(inference.n_states), inference.active_state)
    labels = np.stack([ellipsoids[agent][0] for agent in AGENTS])
    labels[:, visited] = spread(labels[:, visited].reshape(-1, 3)).reshape(len(AGENTS), -1, 3)
    return LatentFrames(
        traces={name: filled(points) for name, points in raw.items()},
        known={name: len(lines) > 0 for name, lines in solid.items()},
        lines={**solid, "prediction": dashed(solid["prediction"])},
        ellipsoids=ellipsoids,
        labels=labels,
        visited=visited,
        # Two digits: a change that nobody sees sends nothing.
        opacity=np.round(OPACITY_FLOOR + OPACITY_RANGE * alpha, 2),
        projection=projection,
        magnification=magnification,
    )


class LatentView:
    """Draws `LatentFrames` inside a box that stands beside the dyad."""

    def __init__(self, server: viser.ViserServer, colors: Palette) -> None:
        self._server = server
        self._frame = server.scene.add_frame(ROOT, show_axes=False)
        self._title, self._caption = add_title(server, ROOT, "Latent space")
        self._axis_labels = [add_label(server, f"{ROOT}/axis{i}", "", CAPTION, "center-center") for i in range(3)]
        self._heads = {
            name: server.scene.add_icosphere(
                f"{ROOT}/now_{name}", radius=0.024 if name != "prediction" else 0.019, subdivisions=3,
                cast_shadow=False, receive_shadow=False,
            )
            for name in TRACES
        }  # fmt: skip
        self._ellipsoids: dict[str, list[viser.IcosphereHandle]] = {agent: [] for agent in AGENTS}
        self._state_labels: dict[str, list[viser.LabelHandle]] = {agent: [] for agent in AGENTS}
        self._frames: LatentFrames | None = None
        self._colors = colors

    def show(self, frames: LatentFrames, layout: Layout, colors: Palette, visible: bool) -> None:
        """Take over a rollout's arrays."""
        drawn, self._frames, self._colors = (self._frames, self._colors), frames, colors
        self._frame.visible = visible
        self._frame.position = layout.plot_centre
        half_yaw = 0.5 * layout.plot_yaw
        self._frame.wxyz = np.array([np.cos(half_yaw), 0.0, 0.0, np.sin(half_yaw)])
        if drawn[0] is frames and drawn[1] is colors:
            return
        self._draw_box(frames, colors)
        self._draw_traces(frames, colors)
        self._draw_states(frames)

    def set_frame(self, n: int) -> None:
        """Show frame n."""
        frames = self._frames
        if frames is None:
            return
        past = np.clip(np.arange(n - TRAIL, n + 1), 0, None)
        for name in TRACES:
            if not frames.known[name]:
                continue
            points = frames.traces[name]
            self._heads[name].position = points[n]
            path = points[past]
            self._trails[name].points = np.stack([path[:-1], path[1:]], axis=1)
        opacity = frames.opacity[n].tolist()
        for agent in AGENTS:
            for handle, value in zip(self._ellipsoids[agent], opacity, strict=True):
                handle.opacity = value

    def _draw_box(self, frames: LatentFrames, colors: Palette) -> None:
        projection, truth = frames.projection, frames.known["truth"]
        step, ticks = projection.ticks()
        lines = [grid_lines(ticks), box_edges()]
        tints = [np.tile(colors.grid_section, (len(lines[0]), 2, 1)), np.tile(colors.frame, (len(lines[1]), 2, 1))]
        self._line("box", np.concatenate(lines), np.concatenate(tints).astype(np.uint8), 1.0)
        offset = HALF + 0.085
        # The upright axis carries its name high: at half height it would meet the note beside the human's hips.
        spots = ((0.0, -offset, -offset), (offset, 0.0, -offset), (-offset, -offset, 0.55 * HALF))
        for handle, text, spot in zip(self._axis_labels, projection.labels, spots, strict=True):
            handle.text, handle.position = text, spot
        self._title.position = self._caption.position = (0.0, 0.0, HALF + 0.16)
        enlarged = f", robot ×{frames.magnification:g}" if frames.magnification > 1.0 else ""
        self._caption.text = (
            f"human red, {'true robot blue, ' if truth else ''}predicted dashed · grid {step:g}{enlarged}"
        )

    def _draw_traces(self, frames: LatentFrames, colors: Palette) -> None:
        tints = {"human": colors.human, "truth": colors.robot, "prediction": colors.dashes}
        self._trails = {}
        for name in TRACES:
            share, thickness = (0.9, 1.9) if name == "prediction" else (0.5, 1.4)
            faint = colors.faint(tints[name], share)
            self._line(f"path_{name}", frames.lines[name], np.array(faint, dtype=np.uint8), thickness)
            fade = np.linspace(0.35, 1.0, TRAIL + 1)
            shades = np.array([colors.faint(tints[name], float(share)) for share in fade], dtype=np.uint8)
            self._trails[name] = self._line(
                f"trail_{name}", np.zeros((TRAIL, 2, 3)), np.stack([shades[:-1], shades[1:]], axis=1), 4.0
            )
            self._heads[name].color = tints[name]
            self._heads[name].visible = self._trails[name].visible = frames.known[name]

    def _draw_states(self, frames: LatentFrames) -> None:
        n_states = frames.opacity.shape[1]
        for agent, spots in zip(AGENTS, frames.labels, strict=True):
            handles, labels = self._ellipsoids[agent], self._state_labels[agent]
            while len(handles) > n_states:
                handles.pop().remove()
                labels.pop().remove()
            for state in range(len(handles), n_states):
                handles.append(
                    self._server.scene.add_icosphere(
                        f"{ROOT}/{agent}/state{state}", color=state_color(state), opacity=OPACITY_FLOOR,
                        subdivisions=4 if agent == "human" else 2, flat_shading=agent == "robot",
                        cast_shadow=False, receive_shadow=False,
                    )
                )  # fmt: skip
                name = f"{ROOT}/{agent}/label{state}"
                labels.append(add_label(self._server, name, f"{agent[0]}{state}", TICK, "center-center"))
            centres, wxyzs, radii = frames.ellipsoids[agent]
            for state, (handle, text) in enumerate(zip(handles, labels, strict=True)):
                handle.position, handle.wxyz = centres[state], wxyzs[state]
                handle.scale = tuple(radii[state].tolist())
                text.position, text.visible = spots[state], bool(frames.visited[state])

    def _line(self, name: str, points: Segments, colors: np.ndarray, thickness: float) -> viser.LineSegmentsHandle:
        """One colour (3,), or one for each end of each piece (K, 2, 3)."""
        return self._server.scene.add_line_segments(
            f"{ROOT}/{name}",
            points,
            colors if colors.ndim == 1 else linear(colors),
            thickness=thickness,
            thickness_units="screen",
        )


def segments(points: Float[np.ndarray, "N 3"]) -> Segments:
    """Line pieces between neighbouring points that both exist."""
    pairs = np.stack([points[:-1], points[1:]], axis=1)
    return pairs[np.isfinite(pairs).all((1, 2))]


def dashed(pieces: Segments) -> Segments:
    """Every second stretch of `DASH` along the line."""
    length = np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=1)
    start = np.concatenate([[0.0], np.cumsum(length)[:-1]]) if len(pieces) else length
    dashes = []
    for piece, begin, extent in zip(pieces, start, length, strict=True):
        if extent <= 1e-9:
            continue
        edges = np.arange(np.floor(begin / DASH), np.ceil((begin + extent) / DASH) + 1.0)
        for edge in edges[edges % 2 == 0]:
            low, high = max(edge * DASH, begin), min((edge + 1.0) * DASH, begin + extent)
            if high > low:
                shares = (np.array([low, high]) - begin) / extent
                dashes.append(piece[0] + shares[:, None] * (piece[1] - piece[0]))
    return np.array(dashes).reshape(-1, 2, 3)


def filled(points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Gaps repeat the last point, so that a trail has a constant number of pieces."""
    seen = np.isfinite(points).all(1)
    if not seen.any():
        return np.zeros_like(points)
    last = np.maximum.accumulate(np.where(seen, np.arange(len(points)), -1))
    return points[np.where(last < 0, seen.argmax(), last)]


def spread(spots: Float[np.ndarray, "K 3"], steps: int = 150) -> Float[np.ndarray, "K 3"]:
    """Push texts apart that would overlap as seen from the dyad's viewer, within the plane of the picture."""
    right, up = picture_axes(towards_viewer())
    spots = spots.copy()
    # Ties are broken by order: equal places would otherwise push in no direction.
    spots += 1e-4 * np.arange(len(spots))[:, None] * (right + up)
    for _ in range(steps):
        apart = spots[:, None] - spots[None]
        across, high = apart @ right, apart @ up
        overlap = np.minimum(TEXT_SIZE[0] - np.abs(across), TEXT_SIZE[1] - np.abs(high))
        np.fill_diagonal(overlap, 0.0)
        if not (overlap > 1e-3).any():
            break
        push = 0.25 * np.maximum(overlap, 0.0)
        sideways = TEXT_SIZE[0] - np.abs(across) < TEXT_SIZE[1] - np.abs(high)
        spots += np.outer(np.where(sideways, push * np.sign(across), 0.0).sum(1), right)
        spots += np.outer(np.where(sideways, 0.0, push * np.sign(high)).sum(1), up)
    return spots


def towards_viewer() -> Float[np.ndarray, " 3"]:
    """From the box to the viewer, in the box's coordinates."""
    x, y, z = VIEWER
    turn = complex(np.cos(PLOT_TURN), -np.sin(PLOT_TURN))
    level = complex(x, y) * turn
    return np.array([level.real, level.imag, z])


def grid_lines(ticks: list[Float[np.ndarray, " _"]]) -> Segments:
    """Lines on the three planes behind the trajectories: floor (low z), low x, high y."""
    low, high = -HALF, HALF
    lines = []
    for x in ticks[0].tolist():
        lines += [[(x, low, low), (x, high, low)], [(x, high, low), (x, high, high)]]
    for y in ticks[1].tolist():
        lines += [[(low, y, low), (high, y, low)], [(low, y, low), (low, y, high)]]
    for z in ticks[2].tolist():
        lines += [[(low, low, z), (low, high, z)], [(low, high, z), (high, high, z)]]
    return np.array(lines).reshape(-1, 2, 3)


def box_edges() -> Segments:
    """Edges of the three planes."""
    a, b = -HALF, HALF
    return np.array([
        [(a, a, a), (b, a, a)], [(b, a, a), (b, b, a)], [(a, a, a), (a, b, a)], [(a, b, a), (b, b, a)],
        [(a, a, a), (a, a, b)], [(a, b, a), (a, b, b)], [(b, b, a), (b, b, b)], [(a, a, b), (a, b, b)],
        [(a, b, b), (b, b, b)],
    ])  # fmt: skip
