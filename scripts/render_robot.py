"""Render a robot description to PNG pictures: a viser page in headless Chromium.

    python scripts/render_robot.py assets/urdf/pepper/pepper.urdf --out /tmp/pepper --view front side --pose handshake

Writes OUT-VIEW.png for every view. Joints that no pose and no --joint names stay at zero, within their limits.
"""

from __future__ import annotations

import io
import math
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

# Direction from the robot to the camera (x forward, y left, z up); what to look at, as a height (a fraction of the
# robot's) or the name of a link; the height of what is seen, as a fraction of the robot's.
VIEWS: dict[str, tuple[tuple[float, float, float], float | str, float]] = {
    "front": ((1.0, 0.0, 0.08), 0.5, 1.0),
    "three-quarter": ((0.80, -0.58, 0.18), 0.5, 1.0),
    "side": ((0.0, -1.0, 0.06), 0.5, 1.0),
    "back": ((-0.85, 0.5, 0.15), 0.5, 1.0),
    "bust": ((0.92, -0.42, 0.1), 0.78, 0.52),
    "face": ((1.0, -0.22, 0.05), 0.9, 0.26),
    "top": ((0.45, -0.3, 0.85), 0.92, 0.3),
    "hand": ((0.6, -0.8, 0.35), "r_gripper", 0.22),
    "palm": ((0.35, 0.8, 0.1), "r_gripper", 0.22),
}
POSES: dict[str, dict[str, float]] = {
    "zero": {},
    "rest": {
        "RShoulderPitch": 1.45, "RShoulderRoll": -0.12, "RElbowYaw": 1.25, "RElbowRoll": 0.45,
        "LShoulderPitch": 1.45, "LShoulderRoll": 0.12, "LElbowYaw": -1.25, "LElbowRoll": -0.45,
    },
    "handshake": {
        "RShoulderPitch": 0.75, "RShoulderRoll": -0.10, "RElbowYaw": 1.35, "RElbowRoll": 0.75,
        "LShoulderPitch": 1.45, "LShoulderRoll": 0.12, "LElbowYaw": -1.25, "LElbowRoll": -0.45,
    },
    "wave": {
        "RShoulderPitch": -0.6, "RShoulderRoll": -0.55, "RElbowYaw": 1.5, "RElbowRoll": 1.1,
        "LShoulderPitch": 1.45, "LShoulderRoll": 0.12, "LElbowYaw": -1.25, "LElbowRoll": -0.45,
    },
}  # fmt: skip
CHROMIUM = (
    "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--use-gl=angle", "--use-angle=gl-egl", "--ignore-gpu-blocklist",
)  # fmt: skip


@dataclass
class Options:
    """Render a robot description to PNG pictures."""

    urdf: Annotated[Path, tyro.conf.Positional]
    """The description; package:// names are looked for beside it."""
    out: Path = Path("robot")
    """Prefix of the pictures."""
    view: tuple[Literal["front", "three-quarter", "side", "back", "bust", "face", "top", "hand", "palm"], ...] = (
        "front",
        "three-quarter",
        "side",
    )
    """Where to look from."""
    pose: Literal["zero", "rest", "handshake", "wave"] = "rest"
    """Arm pose (names of Pepper's joints; joints that the robot lacks are skipped)."""
    joint: dict[str, float] = field(default_factory=dict)
    """Further joint angles [rad], such as --joint HeadYaw 0.5."""
    size: tuple[int, int] = (720, 960)
    """Width and height in pixels."""
    dark: bool = False
    """Dark background."""
    chromium: Path = Path("/usr/bin/chromium")
    """Browser."""


def resolve(name: str, folder: Path) -> str:
    """The file behind a mesh name: package://package/rest is looked for in the folders above the description."""
    rest = name.removeprefix("file://")
    if name.startswith("package://"):
        package, _, rest = name.removeprefix("package://").partition("/")
        for parent in (folder, *folder.parents):
            for candidate in (parent / package / rest, parent / rest):
                if candidate.is_file():
                    return str(candidate)
    return str(folder / rest)


def load(urdf: Path, joints: dict[str, float]) -> Any:
    """The posed yourdfpy model; its scene's base frame is the description's root link."""
    import yourdfpy

    folder = urdf.resolve().parent
    model = yourdfpy.URDF.load(str(urdf), filename_handler=lambda fname: resolve(fname, folder))
    configuration = {}
    for name in model.actuated_joint_names:
        limit = model.joint_map[name].limit
        value = joints.get(name, 0.0)
        if limit is not None and limit.lower is not None and limit.upper is not None and limit.upper > limit.lower:
            value = min(max(value, limit.lower), limit.upper)
        configuration[name] = value
    model.update_cfg(configuration)
    return model


def floor(model: Any) -> np.ndarray:
    """Pose of the root on the floor: by the link base_footprint where there is one, else by the lowest point drawn."""
    if "base_footprint" in model.link_map:
        return np.linalg.inv(model.get_transform("base_footprint"))
    standing = np.eye(4)
    standing[2, 3] = -model.scene.bounds[0, 2]
    return standing


def linear(rgba: np.ndarray) -> np.ndarray:
    """sRGB bytes (..., 4) -> linear bytes: what glTF expects of vertex and base colours."""
    rgb = rgba[..., :3] / 255.0
    rgb = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return np.concatenate([np.round(rgb * 255), rgba[..., 3:]], axis=-1).astype(np.uint8)


def glb(mesh: Any) -> bytes:
    """One mesh as GLB with its vertex colours, whatever its file gave: material, face or vertex colours.

    A mesh that has vertex colours only is exported without a material, which glTF defines as metal: it renders too
    dark. So it gets a plastic material, with the colours as an attribute.
    """
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    mesh = mesh.copy()
    if isinstance(mesh.visual, TextureVisuals):
        mesh.visual = mesh.visual.to_color()
    if mesh.visual.kind == "face":
        mesh.unmerge_vertices()
    colours = linear(np.asarray(mesh.visual.vertex_colors))
    plastic = PBRMaterial(baseColorFactor=[255, 255, 255, 255], metallicFactor=0.0, roughnessFactor=0.55)
    mesh.visual = TextureVisuals(material=plastic)
    mesh.visual.vertex_attributes["color"] = colours
    _ = mesh.vertex_normals  # smooth normals are exported only when they are known
    buffer = io.BytesIO()
    mesh.export(buffer, file_type="glb")
    return buffer.getvalue()


@contextmanager
def page(options: Options, port: int) -> Iterator[Any]:
    """A headless browser showing the server, with nothing but the scene."""
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as profile, sync_playwright() as playwright:
        context = playwright.chromium.launch_persistent_context(
            profile,
            executable_path=str(options.chromium),
            args=list(CHROMIUM),
            viewport={"width": options.size[0], "height": options.size[1]},
        )
        try:
            tab = context.pages[0]
            tab.goto(f"http://127.0.0.1:{port}")
            yield tab
        finally:
            context.close()


def settled_picture(tab: Any, timeout: float = 90.0) -> bytes:
    """The screenshot once two in a row are equal: the environment map fades in, and the GPU may lag by seconds."""
    deadline = time.monotonic() + timeout
    last = b""
    while time.monotonic() < deadline:
        picture = tab.screenshot()
        if picture == last:
            return picture
        last = picture
        tab.wait_for_timeout(700)
    return last


def render(options: Options) -> list[Path]:
    """Write one picture per view and return their paths."""
    import viser

    model = load(options.urdf, {**POSES[options.pose], **options.joint})
    scene = model.scene
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    server.gui.configure_theme(dark_mode=options.dark, show_logo=False)
    shade = 40 if options.dark else 205
    server.scene.set_background_image(np.full((8, 8, 3), shade, dtype=np.uint8))
    server.scene.configure_default_lights(cast_shadow=False)
    standing = floor(model)
    for index, node in enumerate(scene.graph.nodes_geometry):
        transform, geometry = scene.graph.get(node)
        mesh = scene.geometry[geometry].copy()
        mesh.apply_transform(standing @ transform)
        server.scene.add_glb(f"/robot/{index}", glb(mesh))
    height = float((standing @ [0.0, 0.0, scene.bounds[1, 2], 1.0])[2])
    server.scene.add_grid("/floor", width=4, height=4, cell_size=0.25)
    count = len(scene.graph.nodes_geometry)

    connected = threading.Event()
    server.on_client_connect(lambda _client: connected.set())
    written = []
    with page(options, server.get_port()) as tab:
        connected.wait(60)
        tab.wait_for_function(
            "n => { const m = window.__viserMutable, t = window.__viserSceneTree;"
            " return t && m && m.messageQueue.length === 0"
            " && Object.keys(t.getState()).filter(k => k.startsWith('/robot/')).length >= n }",
            arg=count,
            timeout=120_000,
        )
        tab.add_style_tag(content="* { visibility: hidden } canvas { visibility: visible }")
        client = next(iter(server.get_clients().values()))
        for view in options.view:
            direction, centre, extent = VIEWS[view]
            towards = np.asarray(direction) / np.linalg.norm(direction)
            if isinstance(centre, str):
                target = (standing @ model.get_transform(centre))[:3, 3]
            else:
                target = np.array([0.0, 0.0, centre * height])
            fov = math.radians(24)
            distance = 1.12 * extent * height / 2 / math.tan(fov / 2)
            with client.atomic():
                client.camera.up_direction = (0.0, 0.0, 1.0)
                client.camera.position = target + towards * distance
                client.camera.look_at = target
                client.camera.fov = fov
                client.camera.near = 0.05
            tab.wait_for_timeout(2500)
            path = options.out.with_name(f"{options.out.name}-{view}.png")
            path.write_bytes(settled_picture(tab))
            written.append(path)
    server.stop()
    return written


if __name__ == "__main__":
    for picture in render(tyro.cli(Options)):
        print(picture)
