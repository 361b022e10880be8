"""Kobo: two Pandas on one stand. The arms are the Panda's own; the stand is ours."""

from __future__ import annotations

from dataclasses import replace

from modelling.description import Joint
from modelling.palette import BLACK, DARK, GREY, LED, LIGHT
from modelling.round import band, lathe, limb
from modelling.surfaces import Piece, rim, slab
from panda import model as panda

ROOT = "stand"

HEIGHT = 0.75
"""Height of both arms' bases above the floor [m]."""
APART = 0.32
"""Each arm's base is this far from the middle [m]."""

ARMS = {"right": -APART, "left": APART}


def arm(side: str, y: float) -> list[Joint]:
    """The Panda's joints with the side before every name; its base is bolted to the stand."""
    base = Joint(f"{side}_mount", ROOT, f"{side}_{panda.link(0)}", ("0", f"{y:g}", f"{HEIGHT:g}"))
    return [base] + [
        replace(
            joint,
            name=f"{side}_{joint.name}",
            parent=f"{side}_{joint.parent}",
            child=f"{side}_{joint.child}",
            mimic=joint.mimic and f"{side}_{joint.mimic}",
        )
        for joint in panda.JOINTS
        if joint.parent != panda.ROOT
    ]


JOINTS = [joint for side, y in ARMS.items() for joint in arm(side, y)]
SHARED = {f"{side}_{link}": f"../panda/meshes/{link}.ply" for side in ARMS for link in panda.links()}


def links() -> dict[str, list[Piece]]:
    """The stand: a foot on the floor, a column, and the beam that carries both arms."""
    foot = slab(0.46, 0.40, rim(0.03, 0.08, 0.012), 0.06, DARK, 6)
    column = lathe([(0.0, 0.07), (0.105, 0.07), (0.085, 0.15), (0.085, HEIGHT - 0.10), (0.108, HEIGHT - 0.05),
                    (0.0, HEIGHT - 0.05)], LIGHT, 40, 0.01)  # fmt: skip
    ring = band(0.0865, 0.40, 0.41, LED, 40)
    beam = slab(2.0 * APART + 0.26, 0.22, rim(HEIGHT - 0.06, HEIGHT - 0.012, 0.010), 0.03, GREY, 6)
    plates = [slab(0.19, 0.19, rim(HEIGHT - 0.014, HEIGHT, 0.003), 0.02, DARK, 4).moved(shift=(-0.03, y, 0.0))
              for y in ARMS.values()]  # fmt: skip
    wheels = [
        limb([(x - 0.012, y, 0.022, 0.022), (x + 0.012, y, 0.022, 0.022)], BLACK, 4, 20)
        for x in (-0.19, 0.19)
        for y in (-0.16, 0.16)
    ]
    return {ROOT: [foot, column, ring, beam, *plates, *wheels]}
