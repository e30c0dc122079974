"""Node numbers and directions of universal files for DOFs with names."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from ema_pipeline.dof import Dof

DIRECTIONS = {"x": 1, "y": 2, "z": 3, "rx": 4, "ry": 5, "rz": 6}
"""Directions of the global frame as universal files number them (dataset 58, record 6)."""


@dataclass(frozen=True)
class NodeTable:
    """Which node and direction stands for which DOF.

    Attributes
    ----------
    nodes : dict of str to int
        Name of a body, or of a local frame on it (``"planet1 local"``), to node number.
    body : dict of str to str
        The same names to the body.
    dofs : dict of str to tuple of int
        DOF without sign, ``"sun.x"``, to (node, direction 1…6).
    """

    nodes: dict[str, int]
    body: dict[str, str]
    dofs: dict[str, tuple[int, int]]


def node_table(dofs: Iterable[Dof]) -> NodeTable:
    """Number the bodies of DOFs.

    A body keeps the number that ends its name (``point07``) where all bodies have one and no two the same;
    otherwise bodies are numbered from 1 in order of appearance. Directions x, y, z and rx, ry, rz are those
    of the global frame. Any other (radial ``zeta``, tangential ``eta``, arc length ``u``) would be misread
    there: these get a node of their own at the same place, with directions 1, 2, 3 in order of appearance.
    """
    known = list(dofs)
    bodies = list(dict.fromkeys(d.body for d in known))
    ends = [re.search(r"\d+$", body) for body in bodies]
    own = [int(m.group()) for m in ends if m]
    keeps = len(own) == len(bodies) == len(set(own)) and min(own, default=0) > 0
    nodes = dict(zip(bodies, own if keeps else range(1, len(bodies) + 1), strict=True))
    body = {b: b for b in bodies}
    places: dict[str, tuple[int, int]] = {}
    local: dict[str, list[str]] = {}
    for dof in known:
        if dof.direction in DIRECTIONS:
            places[dof.point] = (nodes[dof.body], DIRECTIONS[dof.direction])
            continue
        directions = local.setdefault(dof.body, [])
        if dof.direction not in directions:
            directions.append(dof.direction)
        frame, direction = divmod(directions.index(dof.direction), 3)
        name = f"{dof.body} local" + (f" {frame + 1}" if frame else "")
        if name not in nodes:
            nodes[name] = max(nodes.values()) + 1
            body[name] = dof.body
        places[dof.point] = (nodes[name], direction + 1)
    return NodeTable(nodes=nodes, body=body, dofs=places)
