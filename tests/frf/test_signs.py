"""Signs of single hits: what cancels in the average is told, what may have either sign is not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from frf_hits import POLES, RATE, half_sine, hit_of, residues
from simulate_hits import modal_response

from ema_pipeline.check_result import CheckResult
from ema_pipeline.frf import FrfSettings, estimate_frfs
from ema_pipeline.ingest.records import HitSamples


def hit(number: int, sizes: tuple[float, ...] = (1.0, 1.0), noise: float = 1e-3) -> HitSamples:
    """A blow on p0.z; one response per size, of the same structure."""
    force = half_sine(2048, 60, 4, 100.0 + 10 * number)
    rng = np.random.default_rng(number)
    full = [modal_response(force, RATE, POLES, residues(k)) for k in range(len(sizes))]
    rows = [
        s * x + noise * np.abs(full[0]).max() * rng.standard_normal(2048)
        for s, x in zip(sizes, full, strict=True)
    ]
    return hit_of(force, np.array(rows), file=f"hit{number}.csv")


def described(one: HitSamples, channel: str, **dof: Any) -> HitSamples:
    """The same hit with another DOF of a channel."""
    channels = tuple(replace(c, dof=replace(c.dof, **dof)) if c.name == channel else c for c in one.channels)
    return replace(one, channels=channels)


def signs(hits: list[HitSamples]) -> dict[str, CheckResult]:
    return {v.channel: v for v in estimate_frfs(hits).verdicts if v.check == "sign"}


def test_hits_of_one_sign_pass() -> None:
    found = signs([hit(1), hit(2), hit(3)])
    assert set(found) == {"p0.z over p0.z", "p1.z over p0.z"}
    assert all(v.passes and v.value > 0.95 for v in found.values())


def test_a_response_reversed_in_one_of_two_hits_is_told_although_the_average_vanishes() -> None:
    found = signs([hit(1), hit(2, (-1.0, 1.0))])
    assert not found["p0.z over p0.z"].passes
    assert found["p1.z over p0.z"].passes
    assert found["p0.z over p0.z"].message.startswith(
        "hits of p0.z over p0.z have opposite signs (hit2.csv#1 and hit1.csv#1): look up direction and cable"
    )


@pytest.mark.parametrize("odd", [1, 2, 3, 4])
def test_the_hit_that_differs_from_most_is_named_first(odd: int) -> None:
    hits = [hit(k, (-1.0, 1.0) if k == odd else (1.0, 1.0)) for k in (1, 2, 3, 4)]
    assert f"(hit{odd}.csv#1 and " in signs(hits)["p0.z over p0.z"].message


def test_a_hammer_reversed_in_one_hit_reverses_all_channels() -> None:
    turned = hit(2)
    assert not any(v.passes for v in signs([hit(1), replace(turned, force=-turned.force)]).values())


def test_signs_that_the_description_states_are_no_fault() -> None:
    turned = hit(2, (-1.0, 1.0))
    assert all(v.passes for v in signs([hit(1), described(turned, "a0", sign=-1)]).values())


def test_a_response_across_the_blow_may_change_its_sign() -> None:
    assert "p1.z over p0.z" not in signs([hit(1, (1.0, 0.02)), hit(2, (1.0, -0.02))])


def test_a_sensor_across_the_blow_reads_more_of_an_oblique_one_than_a_sensor_along_it() -> None:
    """More than a fifth of the largest response may change its sign with the aim; along the blow it may not."""
    for size in (0.25, 0.45):
        hits = [hit(1, (1.0, size)), hit(2, (1.0, -size))]
        assert not signs(hits)["p1.z over p0.z"].passes
        assert "p1.x over p0.z" not in signs([described(h, "a1", direction="x") for h in hits])
    hits = [hit(1, (1.0, 0.6)), hit(2, (1.0, -0.6))]
    assert not signs([described(h, "a1", direction="x") for h in hits])["p1.x over p0.z"].passes


def test_noise_has_no_sign() -> None:
    pairs = [
        signs([hit(k, (1.0, 0.0), noise=0.3), hit(k + 1, (1.0, 0.0), noise=0.3)]) for k in range(1, 60, 2)
    ]
    assert all(v.passes for found in pairs for v in found.values())


def test_a_mode_that_has_moved_by_more_than_its_width_is_not_reversed() -> None:
    force = half_sine(2048, 60, 4, 100.0)
    hits = []
    for k, shift in enumerate((0.95, 1.0, 1.06)):
        pole = np.array([-3 + 2j * np.pi * 80 * shift])
        hits.append(
            hit_of(force, modal_response(force, RATE, pole, np.array([80j]))[None], file=f"hit{k}.csv")
        )
    assert signs(hits)["p0.z over p0.z"].passes


def test_without_coherence_there_are_no_checks() -> None:
    assert estimate_frfs([hit(1), hit(2, (-1.0, 1.0))], FrfSettings(), coherence=False).verdicts == ()
