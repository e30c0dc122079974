"""The probability that nothing is missing that the data would show."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from scipy.stats import norm

from ema_pipeline.diagnose import visible
from ema_pipeline.diagnose.types import DetectionLimit, EffectSize
from ema_pipeline.diagnose.visible import nothing_visible

LIMITS = (
    DetectionLimit("spring@a", "stiffness", 4.0, "N/m"),
    DetectionLimit("spring@b", "stiffness", float("inf"), "N/m"),
    DetectionLimit("mesh_backlash@c", "preload", 4.0, "N", largest=True),
)


def told(monkeypatch: pytest.MonkeyPatch, **sizes: EffectSize) -> float:
    """Of effects that have a probability of 0.2 each, by label and the name of their size."""

    def name(hypothesis: Any, fit: Any) -> SimpleNamespace:
        label, _, size = hypothesis.partition(".")
        return SimpleNamespace(label=label, sizes={size: sizes[hypothesis]})

    monkeypatch.setattr(visible, "named", name)
    ranked = [SimpleNamespace(hypothesis=label, fit=None) for label in sizes]
    shares = {label.partition(".")[0]: 0.2 for label in sizes}
    return nothing_visible(SimpleNamespace(ranked=ranked), shares, LIMITS)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("label", "value", "expected"),
    [
        ("spring@a.stiffness", 0.0, 2 * norm.sf(4)),
        ("spring@a.stiffness", 3.0, norm.sf(1) + norm.sf(7)),
        ("spring@a.stiffness", -3.0, norm.sf(1) + norm.sf(7)),  # on either side
        ("spring@a.stiffness", 9.0, 1.0),
        ("spring@b.stiffness", 9.0, 0.0),  # of no size would it show
        ("mesh_backlash@c.preload", 3.0, norm.cdf(1)),  # shows the more the smaller it is
        ("flexible_support@d.mass", 0.0, 1.0),  # has no limit
    ],
)
def test_an_effect_counts_with_the_share_of_its_size_beyond_its_limit(
    monkeypatch: pytest.MonkeyPatch, label: str, value: float, expected: float
) -> None:
    found = told(monkeypatch, **{label: EffectSize(value, 1.0, "")})
    assert found == pytest.approx(1 - 0.2 * expected, abs=1e-6)


def test_a_size_that_is_held_at_an_end_of_its_range_has_no_share_beyond(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert told(monkeypatch, **{"spring@a.stiffness": EffectSize(0.0, 0.0, "")}) == 1.0


def test_nothing_is_certain_without_candidates_and_less_so_with_each(monkeypatch: pytest.MonkeyPatch) -> None:
    assert told(monkeypatch) == 1.0
    both = {
        "spring@a.stiffness": EffectSize(4.0, 1.0, ""),
        "flexible_support@d.mass": EffectSize(0.0, 1.0, ""),
    }
    assert told(monkeypatch, **both) == pytest.approx(1 - 0.1 - 0.2, abs=1e-6)
