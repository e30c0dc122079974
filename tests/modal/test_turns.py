"""Shapes of sensors that are moved: the directions of the hits of every turn."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from accepted_hits import accepted
from simulate_modal import TrueSystem, records_of, simulate_hits

from ema_pipeline.dof import Dof
from ema_pipeline.frf.channels import ChannelQuality
from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.modal.identify import identify
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.modal.turns import OF_ONE_HIT, spread_of_turns

DOFS = tuple(Dof.parse(f"{body}.{axis}") for body in ("a", "b", "c") for axis in ("x", "y"))
STRUCK = (Dof.parse("a.x"), Dof.parse("b.y"))
SHAPES = np.array([[1.0, 0.4, 0.7, -0.2, 0.3, 0.9], [-0.1, 1.0, 0.05, 0.8, 0.6, 0.2]], complex)


def frfs(hits: int = 1, excitation: str = "") -> Any:
    stays, roves = ChannelQuality("stays"), ChannelQuality("roves")
    return SimpleNamespace(
        outputs=DOFS,
        inputs=STRUCK,
        hits=np.full((len(DOFS), len(STRUCK)), hits),
        channels=(stays, *[roves] * (len(DOFS) - 1)),
        excitation=excitation,
    )


def test_the_spread_is_that_of_shapes_from_hits_that_are_off_their_direction() -> None:
    """Residues of every turn, each with directions of its own, and the least-squares entry from all points struck."""
    random = np.random.default_rng(4)
    for hits in (1, 4):
        told = spread_of_turns(frfs(hits), DOFS, SHAPES)
        for r, shape in enumerate(SHAPES.real):
            along = np.array([shape[0], shape[3]])
            across = np.array([shape[1], shape[2]])
            theta = OF_ONE_HIT / np.sqrt(hits) * random.standard_normal((20_000, len(STRUCK)))
            factor = (along + theta * across) @ along / (along @ along)
            found = np.std(factor[:, None] * shape, axis=0)
            np.testing.assert_allclose(told[r, 1:], found[1:], rtol=0.03)
        assert np.all(told[:, 0] == 0)  # the sensor that stays takes part in every turn


def test_nothing_is_added_where_no_sensor_moves_no_hammer_strikes_or_nothing_is_measured_across() -> None:
    one = frfs()
    fixed = [replace(c, name=str(k)) for k, c in enumerate(one.channels)]
    assert not np.any(spread_of_turns(SimpleNamespace(**{**vars(one), "channels": fixed}), DOFS, SHAPES))  # type: ignore[arg-type]
    assert not np.any(spread_of_turns(frfs(excitation="random"), DOFS, SHAPES))
    along_x = [k for k, dof in enumerate(DOFS) if dof.direction == "x"]
    only_x = SimpleNamespace(
        outputs=[DOFS[k] for k in along_x], inputs=STRUCK[:1], hits=np.ones((3, 1), int),
        channels=[one.channels[k] for k in along_x], excitation="",
    )  # fmt: skip
    assert not np.any(spread_of_turns(only_x, only_x.outputs, SHAPES[:, along_x]))  # type: ignore[arg-type]
    unmeasured = SHAPES.copy()
    unmeasured[:, 5] = np.nan
    assert np.all(np.isfinite(spread_of_turns(one, DOFS, unmeasured)))


@pytest.mark.parametrize("seed", [4, 5])
def test_a_mode_that_every_turn_excites_otherwise_is_one_mode(seed: int) -> None:
    """Every turn's hits act across their direction as well, up to half as much."""
    system = TrueSystem(
        np.array([41.0, 83.0, 131.0, 190.0]),
        np.array([0.01, 0.012, 0.009, 0.011]),
        np.random.default_rng(3).standard_normal((4, 4)),
    )
    outputs, inputs = [0, 1, 2, 3], [0, 2, 3]
    made = simulate_hits(
        system, outputs, inputs, f_max=260, record_s=3.0, n_hits=3, rng=np.random.default_rng(11),
        force_noise=1e-3, response_noise=1e-3,
    )  # fmt: skip
    straight = estimate_frfs(accepted(records_of(made, outputs, inputs)))
    theta = 0.45 * np.random.default_rng(seed).standard_normal(straight.hits.shape)
    theta[0] = 0.0
    frf = straight.frf + theta[..., None] * np.roll(straight.frf, 1, axis=1)
    channels = (ChannelQuality("stays"), *[ChannelQuality("roves")] * (len(outputs) - 1))
    oblique = replace(straight, frf=frf)
    assert len(identify(oblique, ModalSettings()).modes) > 4, "otherwise there is nothing to tell"
    found = identify(replace(oblique, channels=channels), ModalSettings()).modes
    assert [round(m.frequency_hz) for m in found] == [41, 83, 131, 190]
