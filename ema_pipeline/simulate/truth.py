"""The true rig behind a simulated test: its parts, its effects and the damping of its modes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from ema_pipeline.effects.library import Library, parse_sized
from ema_pipeline.effects.rig import rig_with_effects
from ema_pipeline.rigs.types import Rig
from ema_pipeline.simulate.damping import damped_rig, draw_damping
from ema_pipeline.simulate.parts import draw_parts, scattered_rig
from ema_pipeline.simulate.settings import SimulationSettings


@dataclass(frozen=True)
class TrueRig:
    """A rig as it is, and what was drawn to make it so.

    Attributes
    ----------
    rig : Rig
    parts : dict of str to float
        Factor of the stiffness or mass of each part; empty where all parts are as the parameters say.
    damping : dict of str to tuple of float
        Configuration to factor of each mode's damping ratio; empty where damping follows the model.
    """

    rig: Rig
    parts: dict[str, float] = field(default_factory=dict)
    damping: dict[str, tuple[float, ...]] = field(default_factory=dict)


def true_rig(
    base: Rig, effects: Sequence[str], library: Library | None, options: SimulationSettings
) -> TrueRig:
    """The rig that is tested.

    Parts scatter before the effects act, so that a mesh loses the stated share of its own stiffness and an added
    mass weighs what it is said to weigh. Damping factors come last: they belong to the modes of the whole.

    Parameters
    ----------
    base : Rig
    effects : sequence of str
        ``"id@place:name=value"``.
    library : dict of str to Effect or None
    options : SimulationSettings
    """
    sizes = options.imperfections
    parts = draw_parts(base, sizes.part_scatter, options.seed_of_rig) if sizes.part_scatter else {}
    own = scattered_rig(base, parts) if parts else base
    rig: Rig = rig_with_effects(own, [parse_sized(e) for e in effects], library)
    damping = draw_damping(rig, sizes.damping_scatter, options.seed_of_rig) if sizes.damping_scatter else {}
    return TrueRig(damped_rig(rig, base, damping) if damping else rig, parts, damping)
