"""Where a misfit is and what it acts like, whatever the library includes."""

from __future__ import annotations

from collections.abc import Iterable

from ema_pipeline.diagnose.score import Score
from ema_pipeline.diagnose.types import Localisation

_SHOWN = 5
_KINDS = {
    "spring": "stiffness",
    "mass": "mass",
    "damper": "viscous damping",
    "hysteretic_damping": "hysteretic damping",
}


def localise(found: Iterable[Score]) -> tuple[Localisation, ...]:
    """Springs, masses and dampers at the places that promise most, best first; one kind for each place."""
    places: dict[str, Localisation] = {}
    for score in sorted(found, key=lambda s: -s.gain):
        for name in score.hypothesis.names:
            kind = _KINDS.get(name.placed.effect.id)
            if kind is None or score.gain <= 0 or name.placed.place in places:
                continue
            p = name.placed.effect.parameters[0]
            scale = (
                name.scales.get(p.name, p.scale) * score.hypothesis.representative.relative / name.relative
            )
            places[name.placed.place] = Localisation(
                name.placed.place, kind, float(score.size[0]) * scale, score.gain
            )
            break
    return tuple(places.values())[:_SHOWN]
