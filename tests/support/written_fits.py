"""Fits and hypotheses written down by hand, for tests of what the search does with them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from ema_pipeline.inference import Residuals, Unknowns
from ema_pipeline.observations.fitting import Fit

PENALTY = 6.0
"""Cost of a mode without a partner."""
NO_DATA: Any = SimpleNamespace(linearised=False)


def hypothesis(
    label: str, generic: bool = False, sizes: int = 1, extends: bool = False, directed: bool = False
) -> Any:
    parameters = [SimpleNamespace(name=f"s{k + 1}") for k in range(sizes)]
    placed = SimpleNamespace(
        label=label,
        effect=SimpleNamespace(parameters=parameters, linear=True),
        parameter_name=lambda name: f"{label}.{name}",
    )
    starts = [{f"{label}.s1": 0.5}, {f"{label}.s1": -0.5}]
    return SimpleNamespace(
        label=label,
        generic=generic,
        placed=placed,
        size_cannot_be_zero=extends,
        has_direction=directed,
        begun=(),
        starts=lambda: starts,
    )


def law(label: str) -> Any:
    """A nonlinear effect that is sought in forces in time."""
    one = hypothesis(label, generic=True)
    one.placed.effect.linear = False
    one.begun = tuple(one.starts())
    return one


def score(gain: float, size: float = 0.0) -> Any:
    return SimpleNamespace(gain=gain, size=np.array([size]), std=1.0)


def fit(name: str, log_evidence: float, **more: Any) -> Fit:
    known = {"scatters": {}, "x": np.zeros(1)} | more
    posterior: Any = SimpleNamespace(log_evidence=log_evidence, **known)
    model: Any = SimpleNamespace(name=name)
    return Fit(model, posterior)


class Parabola:
    """A problem of two unknowns and sizes, the residual their distance from a point.

    Where there is a `partner_from`, a mode has no partner until the last size is that or further out.
    """

    def __init__(
        self,
        names: tuple[str, ...],
        sizes: tuple[str, ...],
        at: np.ndarray | None = None,
        partner_from: float | None = None,
    ) -> None:
        scatter = tuple("part" if n.startswith("part") else "" for n in names)
        n = len(names)
        self.unknowns = Unknowns(names, np.ones(n), scatter, np.full(n, -1.9), np.full(n, 1.9))
        self.sizes = dict.fromkeys(sizes)
        self.at, self.partner_from = np.zeros(n) if at is None else at, partner_from

    def residuals(self, x: np.ndarray, scatters: object, **how: Any) -> Residuals:
        assert how == {"heat": 30.0, "derivatives": False}
        penalty = self.unpaired(x, scatters, 30.0)
        return Residuals((x - self.at) / how["heat"], np.zeros((0, len(x))), penalty=penalty)

    def unpaired(self, x: np.ndarray, scatters: object, heat: float) -> float:
        lost = self.partner_from is not None and x[-1] / self.partner_from < 1
        return PENALTY if lost else 0.0

    def begun(self, x: np.ndarray, scatters: object) -> list[np.ndarray]:
        return []

    def tuned(self, x: np.ndarray, name: str) -> list[float]:
        return []

    def start(self) -> np.ndarray:
        return self.at


def with_model(name: str, problem: Parabola, x: list[float], log_evidence: float = 0.0) -> Fit:
    posterior: Any = SimpleNamespace(
        unknowns=problem.unknowns,
        x=np.array(x),
        log_evidence=log_evidence,
        scatters={"part": 1.0},
        cost=5.0,
        prior_std=np.ones(len(x)),
        residuals=SimpleNamespace(unexplained=0),
    )
    model: Any = SimpleNamespace(name=name, problem=lambda observations: problem)
    return Fit(model, posterior)


def found_of(**values: float) -> dict[str, tuple[Any, Fit]]:
    """Hypotheses, and fits of these log evidences."""
    return {name: (hypothesis(name), fit(name, value)) for name, value in values.items()}
