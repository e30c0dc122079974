"""Where the effects of an isolator sit: beside the spring that is named ``isolator spring``."""

from __future__ import annotations

from ema_pipeline.mechanics.assembly import Assembly, Row, Spring

_SPRING = " spring"


def isolators(assembly: Assembly) -> tuple[str, ...]:
    """``isolator`` for a spring called ``isolator spring``."""
    return tuple(e.name.removesuffix(_SPRING) for e in assembly.springs(suffix=f"isolator{_SPRING}"))


def isolator_spring(place: str) -> str:
    """Name of the isolator's spring."""
    return place + _SPRING


def isolator_row(assembly: Assembly, place: str) -> Row:
    """Stretch of the isolator."""
    spring = assembly.named(isolator_spring(place))
    assert isinstance(spring, Spring)
    return spring.row
