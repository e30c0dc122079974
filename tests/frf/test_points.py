"""Hits listed under another point than the one that was struck."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from frf_hits import RATE, half_sine, hit_of
from simulate_hits import modal_response

from ema_pipeline.check_result import CheckResult
from ema_pipeline.dof import Dof
from ema_pipeline.frf import estimate_frfs
from ema_pipeline.frf.channel_faults import EXCHANGED, SENSITIVITY
from ema_pipeline.ingest.records import HitSamples

FREQUENCIES = np.array([52.0, 83.0, 131.0])
SHAPES = np.array([[1.0, 0.8, 0.6], [0.9, -0.2, -1.0], [0.7, -1.0, 0.5]])
"""Of three modes at p0.z, p1.z and p2.z."""


def poles(drift: float = 0.0, damping: float = 0.01) -> np.ndarray:
    return 2 * np.pi * FREQUENCIES * (1 + drift) * (-damping + 1j * np.sqrt(1 - damping**2))


def hit(listed: int, struck: int, number: int, *, sensors: int = 3, drift: float = 0.0) -> HitSamples:
    """A blow on one point that is listed under one, with as many sensors."""
    force = half_sine(2048, 60, 4, 100.0 + 10 * number)
    rng = np.random.default_rng(number)
    rows = [
        modal_response(force, RATE, poles(drift), SHAPES[:, k] * SHAPES[:, struck]) for k in range(sensors)
    ]
    rows = [row + 1e-3 * np.abs(rows[0]).max() * rng.standard_normal(2048) for row in rows]
    made = hit_of(force, np.array(rows), file=f"hit{number}.csv")
    return replace(made, hit=replace(made.hit, impact=Dof.parse(f"p{listed}.z")))


def points(hits: Sequence[HitSamples]) -> dict[str, CheckResult]:
    return {v.channel: v for v in estimate_frfs(hits).verdicts if v.check == "point"}


def test_hits_of_their_points_pass() -> None:
    found = points([hit(p, p, 3 * p + k) for p in range(3) for k in range(3)])
    assert set(found) == {"p0.z", "p1.z", "p2.z"}
    assert all(v.passes and v.value > 0.98 for v in found.values())


@pytest.mark.parametrize("hits_each", [2, 3])
def test_a_hit_listed_under_another_point_is_named_with_its_own(hits_each: int) -> None:
    hits = [hit(p, p, 3 * p + k) for p in range(3) for k in range(hits_each)]
    hits[0] = hit(0, 2, 0)
    found = points(hits)
    assert [p for p, v in found.items() if not v.passes] == ["p0.z"]
    assert found["p0.z"].message == (
        "hit0.csv#1 is listed under p0.z, but like the hits on p2.z: correct 'impact' in test.toml, or leave it out"
    )


def test_two_hits_that_are_exchanged_are_both_named() -> None:
    hits = [hit(p, p, 3 * p + k) for p in range(2) for k in range(3)]
    hits[1], hits[4] = hit(0, 1, 1), hit(1, 0, 4)
    found = points(hits)
    assert found["p0.z"].message.startswith("hit1.csv#1 is listed under p0.z, but like the hits on p1.z:")
    assert found["p1.z"].message.startswith("hit4.csv#1 is listed under p1.z, but like the hits on p0.z:")


def test_channels_are_not_suspected_for_hits_of_another_point() -> None:
    hits = [hit(p, p, 3 * p + k) for p in range(2) for k in range(3)]
    hits[1], hits[4] = hit(0, 1, 1), hit(1, 0, 4)
    assert not any(v.check in (SENSITIVITY, EXCHANGED) for v in estimate_frfs(hits).verdicts)


def test_resonances_that_move_from_hit_to_hit_are_no_other_point() -> None:
    drifts = (0.0, 0.03, -0.03)  # by three half-power half-widths, either way
    found = points([hit(p, p, 3 * p + k, drift=d) for p in range(3) for k, d in enumerate(drifts)])
    assert all(v.passes for v in found.values())
    assert min(v.value for v in found.values()) < 0.6


def test_one_sensor_or_one_hit_tells_of_no_point() -> None:
    assert not points([hit(p, p, 3 * p + k, sensors=1) for p in range(2) for k in range(2)])
    assert not points([hit(p, p, p) for p in range(3)])


def test_hits_that_match_no_point_are_not_given_another() -> None:
    hits = [hit(p, p, 3 * p + k) for p in range(2) for k in range(3)]
    hits[0] = hit(0, 2, 0)  # p2.z was struck once only, and is not listed
    found = points(hits)
    assert found["p0.z"].value < 0.5
    assert found["p0.z"].passes
