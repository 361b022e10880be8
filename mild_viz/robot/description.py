"""A robot description: the links and joints of a URDF file, as the file states them."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from mild_viz.errors import UserError

if TYPE_CHECKING:
    import yourdfpy

TURNING = ("revolute", "continuous")
"""Joint types that can be controlled."""

KINDS = (*TURNING, "prismatic", "fixed", "floating", "planar")
"""Joint types of a URDF; those of the last two rest at their origin."""

FIELDS = (
    # where, attribute, how many numbers, whether it must be there
    ("joint/origin", "xyz", (3,), False),
    ("joint/origin", "rpy", (3,), False),
    ("joint/axis", "xyz", (3,), False),
    ("joint/mimic", "multiplier", (1,), False),
    ("joint/mimic", "offset", (1,), False),
    ("link/visual/origin", "xyz", (3,), False),
    ("link/visual/origin", "rpy", (3,), False),
    ("link/visual/geometry/box", "size", (3,), True),
    ("link/visual/geometry/sphere", "radius", (1,), True),
    ("link/visual/geometry/cylinder", "radius", (1,), True),
    ("link/visual/geometry/cylinder", "length", (1,), True),
    ("link/visual/geometry/mesh", "scale", (1, 3), False),
    ("link/visual/material/color", "rgba", (4,), False),
    ("material/color", "rgba", (4,), False),
)
"""The numbers that are used. yourdfpy takes NaN, and too many or too few of them, without a word."""


@dataclass(frozen=True, eq=False)
class Joint:
    """One joint: the child's frame is the parent's, moved by `origin` and then turned (or slid) about `axis`."""

    name: str
    kind: str
    parent: str
    child: str
    origin: Float[np.ndarray, "4 4"]
    axis: Float[np.ndarray, "3"]
    lower: float
    """Infinite where the file states no limit [rad or m]."""
    upper: float
    velocity: float
    """Largest speed [rad/s or m/s]; infinite where the file states none."""
    mimic: tuple[str, float, float] | None
    """(joint, multiplier, offset) where this joint follows another one."""

    def motion(self, value: float) -> Float[np.ndarray, "4 4"]:
        """Pose of the child in the parent at joint value `value` [rad or m]."""
        moved = np.eye(4)
        if self.kind in TURNING:
            x, y, z = self.axis
            cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            moved[:3, :3] += np.sin(value) * cross + (1.0 - np.cos(value)) * cross @ cross
        elif self.kind == "prismatic":
            moved[:3, 3] = value * self.axis
        return self.origin @ moved


@dataclass(frozen=True, eq=False)
class Description:
    """A parsed URDF. `joints` are ordered so that parents come first."""

    path: Path
    digest: str
    """SHA-256 of the file."""
    root: str
    joints: tuple[Joint, ...]
    urdf: yourdfpy.URDF
    """The parse that the visuals are loaded from (without meshes)."""

    @property
    def links(self) -> tuple[str, ...]:
        """All links, the root first."""
        return (self.root, *(joint.child for joint in self.joints))

    def joint(self, name: str) -> Joint:
        """The joint of that name; `UserError` listing the joints that turn where there is none."""
        for joint in self.joints:
            if joint.name == name:
                return joint
        have = ", ".join(joint.name for joint in self.joints if joint.kind in TURNING and joint.mimic is None)
        raise UserError(f"{self.path} has no joint '{name}'; it has: {have or 'none that turns'}")

    def require_link(self, name: str) -> None:
        """`UserError` listing the links where there is none of that name."""
        if name not in self.links:
            raise UserError(f"{self.path} has no link '{name}'; it has: {', '.join(self.links)}")

    def placed(self, pose: Float[np.ndarray, "4 4"]) -> Description:
        """The same robot, whose root stands at `pose` in a new base frame."""
        base = f"{max(self.links, key=len)}_base"  # longer than every name that there is
        axis = np.array([1.0, 0.0, 0.0])
        fixed = Joint(f"{base}_joint", "fixed", base, self.root, pose, axis, -np.inf, np.inf, np.inf, None)
        return replace(self, root=base, joints=(fixed, *self.joints))

    def path_to(self, link: str) -> tuple[Joint, ...]:
        """Joints from the root to a link."""
        above = {joint.child: joint for joint in self.joints}
        joints = []
        while link in above:
            joints.append(above[link])
            link = above[link].parent
        return tuple(reversed(joints))

    def pose(self, link: str, chosen: dict[str, float]) -> Float[np.ndarray, "4 4"]:
        """Pose of a link in the base frame, the joints as `values` makes them of those chosen [rad or m]."""
        values, pose = self.values(chosen), np.eye(4)
        for joint in self.path_to(link):
            pose = pose @ joint.motion(values[joint.name])
        return pose

    def values(self, chosen: dict[str, float]) -> dict[str, float]:
        """Value of every joint [rad or m]: as chosen (else 0) within its limits; mimic joints follow."""
        values = {joint.name: float(np.clip(chosen.get(joint.name, 0.0), joint.lower, joint.upper))
                  for joint in self.joints if joint.mimic is None}  # fmt: skip
        for joint in self.joints:
            if joint.mimic is not None:
                source, multiplier, offset = joint.mimic
                values[joint.name] = multiplier * values.get(source, 0.0) + offset
        return values


def read_description(path: Path) -> Description:
    """Parse a URDF file. Raises `UserError` where it is no well-formed tree of links and joints."""
    import yourdfpy
    from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

    try:
        content = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}; expected a URDF description") from error
    try:
        # parsed here first, because yourdfpy would go on with whatever it can recover
        element = etree.fromstring(content, etree.XMLParser(resolve_entities=False, no_network=True))
    except etree.XMLSyntaxError as error:
        raise UserError(f"{path} is not a valid URDF description: {error}") from error
    _check_fields(path, element)
    try:
        urdf = yourdfpy.URDF.load(BytesIO(content), build_scene_graph=False, load_meshes=False)
        joints = [_convert(joint) for joint in urdf.robot.joints]
    except Exception as error:  # whatever yourdfpy stumbles over
        raise UserError(f"{path} is not a valid URDF description: {error}") from error
    links = [link.name for link in urdf.robot.links]
    _check_mimics(path, joints)
    return Description(path, hashlib.sha256(content).hexdigest(), *_sort(path, links, joints), urdf)


def _check_fields(path: Path, element: Any) -> None:
    """`UserError` naming the first name, type or number of a parsed file that cannot be used."""
    if element.tag != "robot":
        raise UserError(f"{path}: the root element is <{element.tag}>; expected a URDF description, <robot>")
    types = element.getroottree().docinfo.internalDTD
    if types is not None and (types.system_url or types.entities()):
        raise UserError(f"{path} declares XML entities; expected a URDF description without them")
    for kind in ("link", "joint"):
        names = [part.get("name") for part in element.iterfind(kind)]
        for name in names:
            if not name or names.count(name) > 1:
                raise UserError(f"{path}: {names.count(name)} <{kind}> have the name {name!r}; expected unique names")
    for joint in element.iterfind("joint"):
        for end in ("parent", "child"):
            if joint.find(end) is None or not joint.find(end).get("link"):
                raise UserError(f"{path}: joint {joint.get('name')} has no <{end}> with a link; expected one")
        if joint.get("type") not in KINDS:
            raise UserError(
                f"{path}: joint {joint.get('name')} has the type {joint.get('type')!r}; valid: {', '.join(KINDS)}"
            )
    for where, attribute, counts, required in FIELDS:
        for part in element.iterfind(where):
            if required or part.get(attribute) is not None:
                _check_numbers(path, part, attribute, counts)
    for mesh in element.iterfind("link/visual/geometry/mesh"):
        if not mesh.get("filename"):
            raise UserError(f"{path}: {_owner(mesh)}: <mesh> has no filename; expected the file of the mesh")


def _check_numbers(path: Path, part: Any, attribute: str, counts: tuple[int, ...]) -> None:
    text = part.get(attribute)
    words = (text or "").replace(",", " ").split() if attribute == "scale" else (text or "").split()
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        numbers = np.array([np.nan])
    good = len(numbers) in counts and np.isfinite(numbers).all()
    if not good or (attribute == "scale" and not numbers.all()):
        expected = " or ".join(str(count) for count in counts) + (
            " finite number" if counts == (1,) else " finite numbers"
        )
        expected += " other than 0" if attribute == "scale" else ""
        got = "missing" if text is None else f"'{text}'"
        raise UserError(f"{path}: {_owner(part)}: {attribute} of <{part.tag}> is {got}; expected {expected}")


def _owner(part: Any) -> str:
    """The link, joint or material that an element belongs to."""
    while part.getparent().tag != "robot":
        part = part.getparent()
    return f"{part.tag} {part.get('name')}"


def _check_mimics(path: Path, joints: list[Joint]) -> None:
    """`UserError` where a joint follows none, or one that itself follows another."""
    leaders = [joint.name for joint in joints if joint.mimic is None]
    for joint in joints:
        if joint.mimic is not None and joint.mimic[0] not in leaders:
            valid = [other.name for other in joints if other.mimic is None and other.kind != "fixed"]
            raise UserError(
                f"{path}: joint {joint.name} mimics '{joint.mimic[0]}'; valid, a joint that mimics no other: "
                f"{', '.join(valid) or 'none'}"
            )


def _convert(joint: yourdfpy.Joint) -> Joint:
    origin = np.eye(4) if joint.origin is None else np.asarray(joint.origin, dtype=np.float64)
    axis = np.array([1.0, 0.0, 0.0]) if joint.axis is None else np.asarray(joint.axis, dtype=np.float64)
    if joint.type in (*TURNING, "prismatic"):
        length = float(np.linalg.norm(axis))
        if not length > 0.0:
            raise ValueError(f"joint {joint.name} has the axis {axis.tolist()}")
        axis = axis / length
    lower, upper = -np.inf, np.inf
    if joint.limit is not None and joint.type in ("revolute", "prismatic"):
        lower = lower if joint.limit.lower is None else float(joint.limit.lower)
        upper = upper if joint.limit.upper is None else float(joint.limit.upper)
        if not lower <= upper:
            raise ValueError(f"joint {joint.name} has the limits {lower} to {upper}")
    velocity = np.inf
    if joint.limit is not None and joint.limit.velocity:  # 0 stands for "not stated" in many files
        velocity = abs(float(joint.limit.velocity))
    mimic = None
    if joint.mimic is not None:
        multiplier = 1.0 if joint.mimic.multiplier is None else float(joint.mimic.multiplier)
        mimic = (joint.mimic.joint or "", multiplier, float(joint.mimic.offset or 0.0))
    return Joint(joint.name, joint.type, joint.parent, joint.child, origin, axis, lower, upper, velocity, mimic)


def _sort(path: Path, links: list[str], joints: list[Joint]) -> tuple[str, tuple[Joint, ...]]:
    """Root link, and the joints with parents first; `UserError` where they form no single tree."""
    children = [joint.child for joint in joints]
    roots = [link for link in links if link not in children]
    ends = {joint.parent for joint in joints} | set(children)
    if len(roots) != 1 or len(set(children)) != len(children) or not ends <= set(links):
        raise UserError(f"{path}: the links form no single tree; roots: {', '.join(roots) or 'none'}")
    below: dict[str, list[Joint]] = {}
    for joint in joints:
        below.setdefault(joint.parent, []).append(joint)
    ordered: list[Joint] = []
    waiting = [roots[0]]
    while waiting:
        for joint in below.get(waiting.pop(), []):
            ordered.append(joint)
            waiting.append(joint.child)
    if len(ordered) != len(joints):
        raise UserError(f"{path}: the joints form a loop; expected a tree from '{roots[0]}'")
    return roots[0], tuple(ordered)
