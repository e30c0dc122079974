"""Where a misfit acts, and like what: candidates of stiffness, mass and damping at every DOF and pair of DOFs.

Every measured mode is completed to a full shape u that fits its sensors and, loosely, the model's equation of
motion. An element along a row v would add force along v in proportion to v·u: constant over frequency for a
stiffness, as -ω² for a mass. How much of the residual each would take away, the base parameters following along, is
the score. Damping is told by the damping ratios: an element changes that of mode r by c·|v·φ|²/(2ω) when viscous,
by h·|v·φ|²/(2ω²) when hysteretic.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.residuals import modal_basis
from ema_pipeline.diagnose.fitting import Case, Fitted
from ema_pipeline.diagnose.hypotheses import Hypothesis
from ema_pipeline.diagnose.stray import strong_unexplained
from ema_pipeline.diagnose.types import EXTRA_COORDINATE, Localisation
from ema_pipeline.fit.evidence import Dataset
from ema_pipeline.fit.latent import LatentObjective
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.fit.solve import FitProblem

_LOOSE_TAU = 0.02


def localise(
    case: Case, hypothesis: Hypothesis, fit: FitSettings, values: Mapping[str, float], most: int = 5
) -> tuple[Localisation, ...]:
    """The places where one more element would take most of the misfit away.

    Parameters
    ----------
    case : Case
    hypothesis : Hypothesis
        The model that fails.
    fit : FitSettings
    values : mapping of parameter to value
        Its optimum.
    most : int
        Number of places returned.
    """
    problem = case.problem(hypothesis, fit)
    x = problem.space.point(values)
    dofs = list(dict.fromkeys(d for e in problem.evidence for d in e.family.system.dofs))
    rows = _rows(dofs)
    found = _dynamic(problem, x, rows) + _damping(problem, x, rows)
    found.sort(key=lambda item: -item.score)
    return tuple(found[:most])


def extra_coordinates(case: Case, model: Fitted) -> tuple[Localisation, ...]:
    """Where a test shows more modes than the model has: something there moves by itself.

    A mode that the model has and the test has not is one that was moved, and speaks against it.
    """
    stray = strong_unexplained(case, model)
    if len(stray) <= model.missed:
        return ()
    outlier = float(np.max(case.problem(model.hypothesis, case.settings.fit).mixture().outlier_cost))
    return tuple(Localisation(m.place, EXTRA_COORDINATE, m.frequency_hz, outlier) for m in stray)


def _rows(dofs: list[str]) -> dict[str, dict[str, float]]:
    single = {d: {d: 1.0} for d in dofs}
    pairs = {
        f"{a}-{b}": {a: 1.0, b: -1.0}
        for a, b in combinations(dofs, 2)
        if a.rpartition(".")[0] != b.rpartition(".")[0]
    }
    return {**single, **pairs}


def _vectors(e: Dataset, rows: Mapping[str, Mapping[str, float]]) -> NDArray[np.float64]:
    """Rows over the coordinates of one configuration, (n_rows, n); zero where it lacks a DOF."""
    index = {d: i for i, d in enumerate(e.family.system.dofs)}
    out = np.zeros((len(rows), len(index)))
    for k, row in enumerate(rows.values()):
        if all(d in index for d in row):
            for d, v in row.items():
                out[k, index[d]] = v
    return out


def _dynamic(
    problem: FitProblem, x: NDArray[np.float64], rows: Mapping[str, Mapping[str, float]]
) -> list[Localisation]:
    """Scores of springs at all rows and of masses at single DOFs."""
    objective = LatentObjective(problem.evidence, _LOOSE_TAU)
    prior = problem.space.has_prior.astype(float)
    n, k = x.size, len(rows)
    singles = [i for i, name in enumerate(rows) if "-" not in name]
    total = n + k + len(singles)
    normal, gradient = np.zeros((total, total)), np.zeros(total)
    for e, solved in zip(objective.evidence, objective.solved(x), strict=True):
        if not e.has_shapes:
            continue
        by = e.family.derivatives(x)
        v = _vectors(e, rows)
        outer = v[:, :, None] * v[:, None, :]
        zero_k, zero_m = np.zeros_like(outer), np.zeros_like(outer[singles])
        elements = replace(
            by,
            mass=np.concatenate([by.mass, zero_k, outer[singles]]),
            stiffness=np.concatenate([by.stiffness, outer, zero_m]),
        )
        # Far modes are held at a bounded weight: one wild mode must not say all.
        part, slope = solved.terms(e, elements, 1 / (1 + solved.costs / e.counts))
        normal += part
        gradient += slope
    normal[:n, :n] += np.diag(prior + 1e-9)
    gradient[:n] += prior * x
    inner = np.linalg.solve(normal[:n, :n], np.column_stack([gradient[:n], normal[:n, n:]]))
    left_gradient = gradient[n:] - normal[n:, :n] @ inner[:, 0]
    left = np.diag(normal)[n:] - np.einsum("ij,ji->i", normal[n:, :n], inner[:, 1:])
    valid = left > 1e-6 * np.maximum(np.diag(normal)[n:], 1e-300)
    size = np.where(valid, -left_gradient / np.where(valid, left, 1.0), 0.0)
    score = np.where(valid, left_gradient**2 / np.where(valid, left, 1.0), 0.0)
    names = list(rows)
    result = [Localisation(names[i], "stiffness", float(size[i]), float(score[i])) for i in range(k)]
    result += [
        Localisation(names[i], "mass", float(size[k + j]), float(score[k + j])) for j, i in enumerate(singles)
    ]
    return result


def _damping(
    problem: FitProblem, x: NDArray[np.float64], rows: Mapping[str, Mapping[str, float]]
) -> list[Localisation]:
    """Scores of viscous and hysteretic dampers from the damping ratios of the paired modes."""
    left: list[NDArray[np.float64]] = []
    viscous: list[NDArray[np.float64]] = []
    hysteretic: list[NDArray[np.float64]] = []
    for e, pairs in zip(problem.evidence, problem.assignments(x), strict=True):
        basis = modal_basis(e.family.at(x[None]))
        omega = np.sqrt(np.maximum(basis.eigenvalues[0], 1e-12))
        use = (pairs >= 0) & (e.damping_weight > 0)
        if not np.any(use):
            continue
        k, w = pairs[use], e.damping_weight[use]
        base = float(problem.space.named(x).get("modal_damping_ratio", np.median(e.damping[use])))
        left.append((e.damping[use] - base) * w)
        motion = (_vectors(e, rows) @ basis.shapes[0][:, k]) ** 2
        viscous.append(motion / (2 * omega[k]) * w)
        hysteretic.append(motion / (2 * omega[k] ** 2) * w)
    if not left:
        return []
    r = np.concatenate(left)
    weight = 1 / (1 + r**2 / 100)
    result = []
    for word, parts in (("viscous damping", viscous), ("hysteretic damping", hysteretic)):
        a = np.concatenate(parts, axis=1)
        curvature = np.sum(weight * a**2, axis=1)
        slope = a @ (weight * r)
        valid = curvature > 0
        size = np.where(valid, slope / np.where(valid, curvature, 1.0), 0.0)
        score = np.where(valid & (slope > 0), slope**2 / np.where(valid, curvature, 1.0), 0.0)
        result += [Localisation(name, word, float(size[i]), float(score[i])) for i, name in enumerate(rows)]
    return result
