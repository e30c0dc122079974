"""A viscous damper beside an isolator's spring."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.isolators import isolator_row, isolators
from ema_pipeline.mechanics.assembly import Assembly, Damper


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    return assembly.add(Damper(f"{place} damper", isolator_row(assembly, place), values["coefficient"]))


EFFECT = Effect(
    id="viscous_damping",
    title="viscous damper beside the isolator's spring",
    parameters=(EffectParameter("coefficient", "N·s/m", 0.0, 40.0, 50.0, 0.0, 1e6, "damping coefficient"),),
    find_places=isolators,
    edit=_edit,
    signs="energy per cycle grows with frequency and with the square of the amplitude",
    reference="F. Mezghani et al., Experimental characterization of metal-mesh isolators, Eqs. 6-8",
)
