"""A rig whose elements are changed after it has assembled them: the true rig behind a model."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial

from ema_pipeline.effects.rig import rig_with_effects
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.rigs.base import Build, ParametricRig
from ema_pipeline.rigs.types import Rig

Change = Callable[[str, Assembly], Assembly]
"""``change(configuration, assembly) -> assembly``"""


def altered(rig: Rig, change: Change) -> ParametricRig:
    """A rig like another one, but for what `change` does to its assemblies."""
    like = rig if isinstance(rig, ParametricRig) else rig_with_effects(rig, [])
    return dataclasses.replace(like, build=partial(_build, like.build, change))


def _build(build: Build, change: Change, configuration: str, values: Mapping[str, float]) -> Assembly:
    return change(configuration, build(configuration, values))
