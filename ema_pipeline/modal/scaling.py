"""From fitted shapes and participations to mode shapes over the union of outputs and inputs.

The accelerance residue of a mode is Q = s²A, and reciprocity says A = φφᵀ/(2jω_d). A DOF that is both hit and
measured ties the shape at the rows to the participation at the references and fixes the scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.dof import Dof

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]

_ACROSS = 0.03
"""Share of a mode's largest motion that sensors across it and hits off their direction show at a driving point: between
those of good and of normal laboratories. Near a node it is more than what moves along the hit."""


@dataclass(frozen=True)
class ScaledShapes:
    """Shapes over all DOFs.

    Attributes
    ----------
    dofs : tuple of Dof
    shapes : complex ndarray, (n_modes, n_dofs)
    stds, own_stds : ndarray, (n_modes, n_dofs)
        The latter without what all entries of a mode have in common. The scale multiplies what was measured, and
        divides what was only hit.
    scale_std : ndarray, (n_modes,)
        Relative standard deviation of the scale; NaN where unscaled.
    """

    dofs: tuple[Dof, ...]
    shapes: Complex
    stds: Real
    own_stds: Real
    scale_std: Real


def scale_shapes(
    rows: tuple[Dof, ...],
    references: tuple[Dof, ...],
    poles: Complex,
    shapes: Complex,
    shape_stds: Real,
    shape_own: Real,
    participation: Complex,
    participation_stds: Real,
    *,
    calibrated: bool,
) -> ScaledShapes:
    """Mass-normalised shapes where a driving point is shared; else the rows' shapes with largest entry 1.

    Parameters
    ----------
    rows, references : tuple of Dof
    poles : complex ndarray, (n_modes,)
    shapes, shape_stds, shape_own : (n_modes, n_rows)
        NaN where not measured; the last one is the share of the variance that entries do not have in common.
    participation, participation_stds : (n_modes, n_references)
    calibrated : bool
        False for a force in volts: shapes over the union are then only normalised to 1.
    """
    shared = [
        (rows.index(d), k)
        for k, d in enumerate(references)
        if d in rows and not np.isnan(shapes[:, rows.index(d)]).all()
    ]
    extra = [k for k, d in enumerate(references) if d not in rows] if shared else []
    dofs = (*rows, *(references[k] for k in extra))
    n_modes = len(poles)
    out = np.full((n_modes, len(dofs)), np.nan, dtype=np.complex128)
    stds, own_stds = (np.full((n_modes, len(dofs)), np.nan) for _ in range(2))
    scale_std = np.full(n_modes, np.nan)
    for r in range(n_modes):
        phi, std = shapes[r].copy(), shape_stds[r].copy()
        own = std * np.sqrt(shape_own[r])
        if shared:
            factor = 2j * poles[r].imag / poles[r] ** 2
            kappa, relative = _row_scale(
                shared, phi, std, factor * participation[r], np.abs(factor) * participation_stds[r]
            )
            phi, std, own, scale_std[r] = phi * kappa, std * abs(kappa), own * abs(kappa), relative
            ref = factor * participation[r] / kappa
            ref_std = np.abs(factor / kappa) * participation_stds[r]
            std = np.hypot(std, np.abs(phi) * relative)
            for o, k in shared:  # the same number seen twice: φ_d² = product, errors halve
                std[o] = (
                    0.5 * np.hypot(shape_stds[r, o] * abs(kappa), ref_std[k]) if len(shared) == 1 else std[o]
                )
            off = np.abs(ref[extra]) * relative
            own = np.concatenate([np.minimum(own, std), np.hypot(ref_std[extra], 2 * off)])
            phi = np.concatenate([phi, ref[extra]])
            std = np.concatenate([std, np.hypot(ref_std[extra], off)])
        both = _normalised(phi, np.stack([std, own]), keep_scale=bool(shared) and calibrated)
        out[r], (stds[r], own_stds[r]) = both
    if not calibrated:
        scale_std[:] = np.nan
    return ScaledShapes(dofs, out, stds, own_stds, scale_std)


def _row_scale(
    shared: list[tuple[int, int]], shape: Complex, shape_std: Real, part: Complex, part_std: Real
) -> tuple[complex, float]:
    """κ with κ²·shape = participation at the shared DOFs, and its relative standard deviation."""
    a = np.array([shape[o] for o, _ in shared])
    b = np.array([part[k] for _, k in shared])
    sa = np.hypot([shape_std[o] for o, _ in shared], _ACROSS * np.nanmax(np.abs(shape)))
    sb = np.hypot([part_std[k] for _, k in shared], _ACROSS * np.nanmax(np.abs(part)))
    ok = np.isfinite(a)
    a, b, sa, sb = a[ok], b[ok], sa[ok], sb[ok]
    power = np.sqrt(np.sum(np.abs(b) ** 2) / max(np.sum(np.abs(a) ** 2), 1e-300))
    weight = 1.0 / np.maximum((power * sa) ** 2 + sb**2, 1e-300)
    strength = float(np.sum(weight * np.abs(a) ** 2))
    kappa2 = np.sum(weight * b * a.conj()) / max(strength, 1e-300)
    relative = 0.5 / np.sqrt(max(strength, 1e-300)) / max(abs(kappa2), 1e-300)
    return complex(np.sqrt(kappa2)), float(relative)


def _normalised(phi: Complex, stds: Real, *, keep_scale: bool) -> tuple[Complex, Real]:
    """Sign by the largest entry; largest entry 1 where the scale is unknown. `stds` may have several rows."""
    largest = phi[np.nanargmax(np.abs(phi))]
    if keep_scale:
        return (phi if largest.real >= 0 else -phi), stds
    return phi / largest, stds / abs(largest)


def scaling_note(has_shared: bool, calibrated: bool) -> str:
    """Why shapes are unscaled; empty where they are scaled."""
    if not calibrated:
        return "shapes are unscaled: the hammer signal is in volts; state its sensitivity_mv to scale them"
    if not has_shared:
        return (
            "shapes are unscaled: no driving point; measure the response at one point that is hit, in the "
            "direction of the hit"
        )
    return ""
