"""A body turns: speed-proportional skew coupling of its x and y."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.places import bodies_in_plane, plane_rows
from ema_pipeline.mechanics.assembly import Assembly, Gyroscopic


def _places(assembly: Assembly) -> tuple[str, ...]:
    return tuple(b for b in bodies_in_plane(assembly) if b != "ring")  # the ring is held


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    x, y = plane_rows(assembly, place)
    return assembly.add(Gyroscopic(f"{place} gyroscopic", x, y, values["coefficient"]))


EFFECT = Effect(
    id="gyroscopic",
    title="skew coupling of x and y of a body that turns",
    parameters=(
        EffectParameter("coefficient", "N·s/m", 0.0, 20.0, 50.0, -1e6, 1e6, "force in x per velocity in y"),
    ),
    find_places=_places,
    edit=_edit,
    signs="pairs part into forward and backward whirl; 90° between x and y; FRFs not reciprocal",
    reference="J. Lin, R. G. Parker, J. Vib. Acoust. 121 (1999) 316-321 (gyroscopic terms)",
)
