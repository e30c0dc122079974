"""Sizes to expect of nonlinear springs, against one mass on one spring, whose motion is known by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ema_pipeline.dof import Dof
from ema_pipeline.effects.library import shipped_effects
from ema_pipeline.levels.types import Pulses
from ema_pipeline.mechanics.assembly import Assembly, Mass
from ema_pipeline.mechanics.laws import Spring
from ema_pipeline.observations.sizes_in_hits import sized_by_hits

LIBRARY = shipped_effects()
M, RATE_HZ, IMPULSE = 2.0, 10_000.0, 0.05


def assembly(stiffness: float) -> Assembly:
    """Two masses that know nothing of each other, one of which is struck."""
    masses = [Mass(f"{b} mass", {f"{b}.x": 1.0}, M, b) for b in "ab"]
    springs = [Spring(f"{b} spring", {f"{b}.x": 1.0}, stiffness) for b in "ab"]
    return Assembly(("a.x", "b.x"), (*masses, *springs), {}, 0.01)


def hits(stiffness: float, pulses: bool = True) -> Any:
    """Two blows, the second against the first and twice as hard."""
    force = np.zeros((2, 6))
    force[0, 2:4], force[1, 2:4] = 0.25 * IMPULSE * RATE_HZ, -0.5 * IMPULSE * RATE_HZ
    struck = (Dof.parse("a.x"), Dof.parse("-a.x"))
    return SimpleNamespace(
        pulses=Pulses(struck, force, 2, RATE_HZ) if pulses else None, omega=np.sqrt([stiffness / M])
    )


@pytest.mark.parametrize("stiffness", [1e5, 1e8])
def test_a_springs_force_is_half_the_restoring_one_where_the_hardest_blow_moves_it(stiffness: float) -> None:
    """x = J/(m·ω), whatever is stiff and whatever is soft."""
    library = sized_by_hits(LIBRARY, [hits(stiffness)])
    x = IMPULSE / np.sqrt(M * stiffness)
    host = assembly(stiffness)
    for name, power in (("cubic_spring", 2), ("quadratic_spring", 1)):
        found = library[name].scales(host, "a.x")["stiffness"]
        assert found == pytest.approx(0.5 * stiffness / x**power)


def test_what_no_blow_moves_and_what_no_motion_tells_of_keeps_its_size() -> None:
    host, library = assembly(1e6), sized_by_hits(LIBRARY, [hits(1e6)])
    assert library["cubic_spring"].scales(host, "b.x") == {}
    assert library["dry_friction"] is LIBRARY["dry_friction"]
    assert library["spring"] is LIBRARY["spring"]
    # a mode far above all that was measured tells nothing
    assert sized_by_hits(LIBRARY, [hits(1e4)])["cubic_spring"].scales(host, "a.x") == {}


def test_the_library_is_left_alone_where_forces_are_not_known() -> None:
    assert sized_by_hits(LIBRARY, [hits(1e6), hits(1e6, pulses=False)]) is LIBRARY
    assert sized_by_hits(LIBRARY, []) is LIBRARY
