"""What a fit is worth: the factors of its evidence beside the likelihood (Laplace's approximation)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.residuals import shape_fit
from ema_pipeline.diagnose.hypotheses import Extra
from ema_pipeline.fit.solve import FitProblem, Optimum
from ema_pipeline.modal.segment import MAX_DAMPING_RATIO

_VISIBLE = 0.02
_INSIDE = 0.01
_DEPENDENT = 1e-3
"""Singular value below which directions of coinciding modes count as one."""


def occam(
    problem: FitProblem, found: Optimum, covariance: NDArray[np.float64], added: Sequence[Extra]
) -> float:
    """Laplace's factor: how much of the prior's volume the posterior fills, as -2 log.

    Parameters with a tolerance have a standard normal prior in their coordinate; logarithms are spread evenly
    between their bounds; sizes of effects follow a Cauchy distribution about null (half of one where they have
    one sign), which leaves room for effects larger than expected. The logarithm of a parameter out of its
    tolerance has such tails as well, in units of that tolerance (a weighed mass is less often off by a factor than a
    bearing's stiffness), and a density that vanishes at the nominal value (V. E. Johnson, D. Rossell, J. R. Stat.
    Soc. B 72 (2010) 143-170).
    """
    space = problem.space
    total = 0.0
    by_name = {e.name: e for e in added}
    hessian = np.linalg.inv(covariance)
    for i, c in enumerate(space.coordinates):
        if c.kind == "prior":
            total += np.log(2 * np.pi)
            continue
        e = by_name.get(c.parameter.name)
        if c.kind == "log" and e is not None and e.scale > 0:
            z2 = ((float(found.x[i]) - np.log(e.null)) / e.scale) ** 2
            # nothing at the nominal value itself: inside the tolerance it is the base model that speaks
            total += 2 * np.log(0.5 * np.pi * e.scale * (1 + z2) ** 2 / max(z2, _INSIDE))
            hessian[i, i] += 2 / (e.scale**2 * (1 + z2))
            continue
        if c.kind == "log" or e is None or e.scale == 0:
            width = space.high[i] - space.low[i]
            total += 2 * np.log(width) if np.isfinite(width) else 0.0
            continue
        scale = e.scale / c.scale
        z = (c.value(float(found.x[i])) - e.null) / e.scale
        total += 2 * np.log(np.pi * scale * (1 + z**2)) - (2 * np.log(2) if e.one_sided else 0.0)
        hessian[i, i] += 2 / scale**2
    _, logdet = np.linalg.slogdet(hessian)
    return float(total + logdet - len(space.names) * np.log(2 * np.pi))


def mixing_volume(problem: FitProblem, found: Optimum) -> float:
    """Occam's factor of the mixing of near modes, as -2 log.

    Modes that nearly coincide may exchange their shapes (see `correlate.residuals`). A model that puts a further
    mode beside a measured one thereby gets a free shape to fit noise with. Integrated over the mixing amplitudes,
    this freedom costs log det(1 + BᴴB/d²), once for the real and once for the imaginary parts. Modes that coincide may
    turn into each other wholly, but not become larger than they are: their amplitudes are of the size of the mode's
    own, or every split of a pair, however small, would seem a gain.
    """
    total, start = 0.0, 0
    x, mixing = found.x, problem.settings.mode_mixing
    for e, pairs, modes in zip(problem.evidence, problem.assignments(x), problem.modes(x), strict=True):
        has = np.flatnonzero(pairs >= 0)
        share = found.inlier[start : start + pairs.size][has]
        start += pairs.size
        fit = shape_fit(e, pairs, modes, mixing)
        if fit is None:
            continue
        whole = fit.price[0] * mixing * modes.omega[0, pairs[has]] ** 2
        alike = np.abs(fit.penalty[0]) <= whole[:, None]
        b = _orthonormal_alike(fit.weighted[0], modes.directions[0], alike)
        own = (fit.weighted[0] @ (fit.amplitudes[0] * alike)[:, :, None])[..., 0]
        own = own / np.maximum(np.linalg.norm(own, axis=1, keepdims=True), 1e-30)
        # the mode's own shape is no freedom: its scale is fixed by the comparison
        b = b - own[:, :, None] * (own.conj()[:, None, :] @ b)
        b = b / np.maximum(np.abs(fit.penalty[0]), whole[:, None])[:, None, :]
        # det(1 + BᴴB) = det(1 + BBᴴ), of the size of the sensors
        _, logdet = np.linalg.slogdet(np.eye(b.shape[1]) + b @ b.conj().swapaxes(1, 2))
        total += (2.0 if np.any(e.shapes.imag) else 1.0) * float(share @ logdet)
    return total


def _orthonormal_alike(
    shapes: NDArray[np.float64] | NDArray[np.complex128],
    directions: NDArray[np.float64] | NDArray[np.complex128],
    alike: NDArray[np.bool_],
) -> NDArray[np.float64] | NDArray[np.complex128]:
    """Shapes (R, m, n) with an orthonormal basis for the modes that coincide with each measured one.

    The solver of a damped system returns any basis of these, and no volume may depend on which.
    """
    if not np.iscomplexobj(directions):
        return shapes
    made = shapes.copy()
    for r in np.flatnonzero(np.sum(alike, axis=1) > 1):
        _, s, vh = np.linalg.svd(directions[:, alike[r]], full_matrices=False)
        turned = (vh.conj().T / np.maximum(s, _DEPENDENT)) @ vh
        made[r][:, alike[r]] = shapes[r][:, alike[r]] @ turned
    return made


def lonely_cost(problem: FitProblem, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Squared distance of every measured frequency from the nearest model mode without partner, (R,)."""
    parts = []
    for e, pairs, modes in zip(problem.evidence, problem.assignments(x), problem.modes(x), strict=True):
        omega = modes.omega[0]
        free = np.ones(omega.size, dtype=bool)
        free[pairs[pairs >= 0]] = False
        free &= omega > 1.0
        if not np.any(free):
            free = omega > 1.0
        relative = np.abs(omega[free][None, :] / e.omega[:, None] - 1)
        parts.append((np.min(relative, axis=1) / e.relative_std) ** 2)
    return np.concatenate(parts)


def missed_modes(problem: FitProblem, x: NDArray[np.float64]) -> int:
    """Model modes inside the band, moving sensors and struck points, that no measured mode is paired with.

    Motions that hardly ring, rigid bodies on dampers among them, are none that an identification could give.
    """
    count = 0
    for e, pairs, modes in zip(problem.evidence, problem.assignments(x), problem.modes(x), strict=True):
        m = e.measured
        if m.band_hz is None or not m.dofs:
            continue
        f = modes.omega[0] / (2 * np.pi)
        at = np.abs(e.rows @ modes.shapes[0])
        seen = np.sqrt(np.sum(at**2, axis=0))
        points = [i for i, d in enumerate(m.dofs) if any(d.point == r.point for r in m.references)]
        struck = np.max(at[points], axis=0) if points else seen
        inside = (f > 1.1 * max(m.band_hz[0], 1.0)) & (f < m.band_hz[1] / 1.05)
        shows = (seen > _VISIBLE * np.max(seen)) & (struck > _VISIBLE * np.max(struck))
        shows &= np.abs(modes.damping_ratio[0]) < MAX_DAMPING_RATIO
        free = np.ones(f.size, dtype=bool)
        free[pairs[pairs >= 0]] = False
        count += int(np.sum(inside & shows & free))
    return count
