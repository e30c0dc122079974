"""Modes that are lost to rounding, and rigid-body modes, which are not."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from ema_pipeline.mechanics.assembly import Assembly, Mass, Spring, difference
from ema_pipeline.mechanics.rounding import lost_to_rounding
from ema_pipeline.rigs import load_rig, rig_names


def chain(links: Sequence[float], masses: Sequence[float], ground: float) -> Assembly:
    """Masses in a row, with springs between them and one from the first to ground."""
    rows = [{f"b{i}.x": 1.0} for i in range(len(masses))]
    pairs = zip(rows, rows[1:], links, strict=False)
    elements = [Mass(f"mass {i}", row, m) for i, (row, m) in enumerate(zip(rows, masses, strict=True))]
    springs = [Spring(f"link {i}", difference(a, b), k) for i, (a, b, k) in enumerate(pairs)]
    dofs = tuple(d for row in rows for d in row)
    return Assembly(dofs, (*elements, *springs, Spring("ground", rows[0], ground)))


@pytest.mark.parametrize("ground", [0.0, 1e5])
def test_the_link_or_mass_that_hides_the_lowest_modes_is_named(ground: float) -> None:
    for stiff in (1e18, 1e20, 1e25):
        lost = lost_to_rounding(chain([1e5, stiff, 1e5], [1.0, 2.0, 1.0, 3.0], ground))
        assert lost is not None
        assert lost.name == "link 1"
    lost = lost_to_rounding(chain([1e5, 1e5, 1e5], [1.0, 1e-20, 1.0, 3.0], ground))
    assert lost is not None
    assert lost.name == "mass 1"


@pytest.mark.parametrize("ground", [0.0, 1e-3, 1e5])
def test_free_rigs_and_stiff_links_that_can_be_computed_pass(ground: float) -> None:
    for stiff in (1e5, 1e8, 1e14):
        assert lost_to_rounding(chain([1e5, stiff, 1e5], [1.0, 2.0, 1.0, 3.0], ground)) is None
    assert lost_to_rounding(chain([1e5] * 99, [1e-3] * 100, ground)) is None
    assert lost_to_rounding(chain([1e25] * 3, [1e-3] * 4, 0.0)) is None  # nothing soft beside it
    assert lost_to_rounding(chain([], [1.0], ground)) is None


def test_springs_that_cancel_leave_a_rigid_body_mode() -> None:
    free = chain([1e5], [1.0, 2.0], 1e5)
    ground = free.named("ground")
    assert isinstance(ground, Spring)
    assert lost_to_rounding(free.add(Spring("against", ground.row, -1e5))) is None


def test_shipped_rigs_pass() -> None:
    for name in rig_names():
        rig = load_rig(name)
        assert all(lost_to_rounding(rig.assembly(c)) is None for c in rig.configurations)
