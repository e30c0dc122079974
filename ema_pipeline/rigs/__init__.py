"""Rigs: what is known of the test object before the test. A module here with a ``RIG`` is a shipped rig."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.rigs.base import ParametricRig, RigKind, model_modes
from ema_pipeline.rigs.drawing import Drawing
from ema_pipeline.rigs.files import read_rig_file
from ema_pipeline.rigs.types import ModelMode, Parameter, Rig

__all__ = [
    "ModelMode",
    "Parameter",
    "ParametricRig",
    "Rig",
    "RigKind",
    "drawing_of",
    "load_rig",
    "model_modes",
    "rig_kinds",
    "rig_names",
]


@cache
def rig_kinds() -> dict[str, RigKind]:
    """Shipped rigs by name: every module of this package that defines ``RIG``."""
    found = {}
    for module in pkgutil.iter_modules(__path__):
        kind = getattr(importlib.import_module(f"{__name__}.{module.name}"), "RIG", None)
        if isinstance(kind, RigKind):
            found[kind.name] = kind
    return found


def rig_names() -> tuple[str, ...]:
    """Names of the shipped rigs."""
    return tuple(sorted(rig_kinds()))


def drawing_of(points: Sequence[str], complete: bool) -> Drawing | None:
    """How the rig with these DOFs is drawn; None where no shipped rig knows them, or it has no drawing.

    Parameters
    ----------
    points : sequence of str
        DOFs without sign, e.g. ``"sun.x"``.
    complete : bool
        True where they are all coordinates of a model, not only what was measured.
    """
    found = (kind.drawing(points, complete) for kind in rig_kinds().values())
    return next((drawing for drawing in found if drawing is not None), None)


def load_rig(name_or_path: str | Path) -> Rig:
    """A shipped rig by its name, or a rig file by its path.

    Raises
    ------
    EmaError
        For an unknown name, a missing file or a mistake in the file.
    """
    kinds = rig_kinds()
    text = str(name_or_path)
    if text in kinds:
        kind = kinds[text]
        return kind.make(kind.geometry, {})
    path = Path(name_or_path)
    if path.suffix == ".toml" or path.is_file():
        return read_rig_file(path, kinds)
    raise EmaError(f"no rig '{text}'{did_you_mean(text, kinds)}; or give a rig file ending in .toml")
