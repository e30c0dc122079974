"""Separable least squares: poles and participations are searched, shapes and residual terms follow linearly.

The model of row o and reference i is

    H_oi(ω) = Σ_r [ψ_ro l_ri u(ω; s_r) + conj. pole] + residual terms of (o, i),

which keeps every residue of rank one (reciprocity, and the only way to part both modes of a repeated pole).
For given poles s and participations l the rest is linear and independent from row to row. All that the
Gauss–Newton step needs are weighted Gram matrices of a few functions of frequency, which one matrix product
gives for all FRFs.

References
----------
Golub & Pereyra, "Separable nonlinear least squares: the variable projection method and its applications",
Inverse Problems 19, 2003.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.basis import mode_columns, real_columns
from ema_pipeline.modal.data import FitData
from ema_pipeline.modal.gram_kernel import products
from ema_pipeline.threads import in_order

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]
Known = Callable[[slice], tuple[Complex, Real]]
"""Data and weights of some lines, (n_rows, n_references, n_some) each."""

LINES_AT_ONCE = 128
"""Block of lines in a Gram matrix, at least."""

PRODUCTS_AT_ONCE = 1 << 16
"""Products of columns kept at a time, 0.5 MB."""

COLUMNS_AT_ONCE = 2048
"""Lines for which the functions of frequency are made at a time: of many modes they outgrow the FRFs."""

RIDGE = 1e-12
"""Relative ridge that keeps Gram matrices of coinciding poles solvable."""


@dataclass(frozen=True)
class Estimate:
    """Nonlinear parameters: poles, and participations with their largest entry 1.

    Attributes
    ----------
    poles : complex ndarray, (n_modes,)
    participation : complex ndarray, (n_modes, n_references)
    """

    poles: Complex
    participation: Complex

    def take(self, keep: NDArray[np.bool_] | NDArray[np.intp]) -> Estimate:
        """The modes that `keep` picks."""
        return Estimate(self.poles[keep], self.participation[keep])

    def joined(self, other: Estimate) -> Estimate:
        """Modes of both, by frequency."""
        poles = np.concatenate([self.poles, other.poles])
        parts = np.concatenate([self.participation, other.participation])
        order = np.argsort(poles.imag, kind="stable")
        return Estimate(poles[order], parts[order])


@dataclass(frozen=True)
class LineSums:
    """Weighted sums over lines of functions of frequency, of every FRF by itself.

    Attributes
    ----------
    gram : ndarray, (n_frfs, n_columns, n_columns)
        Re(Eᴴ W E).
    moment : ndarray, (n_frfs, n_columns)
        Re(Eᴴ W y).
    power : ndarray, (n_frfs,)
        yᴴ W y.
    """

    gram: Real
    moment: Real
    power: Real


@dataclass(frozen=True)
class BestShapes:
    """Shapes that fit best for given poles and participations, without what a step of these needs.

    Attributes
    ----------
    shapes : complex ndarray, (n_rows, n_modes)
    normal : ndarray, (n_rows, 2·n_modes, 2·n_modes)
        Normal matrix of the shapes.
    cost : float
        Weighted sum of squares of the residual.
    sums : LineSums
        Of residual columns, then those of the modes.
    """

    shapes: Complex
    normal: Real
    cost: float
    sums: LineSums


@dataclass(frozen=True)
class LinearSolution:
    """Shapes and residual terms that fit best for given poles and participations.

    Attributes
    ----------
    shapes : complex ndarray, (n_rows, n_modes)
    gram : ndarray, (n_rows, n_reference, 4·n_modes, 4·n_modes)
        Gram matrix of mode columns and their derivatives, residual terms projected out.
    moment : ndarray, (n_rows, n_references, 4·n_modes)
        The same columns against the data.
    normal : ndarray, (n_rows, 2·n_modes, 2·n_modes)
        Normal matrix of the shapes.
    cost : float
        Weighted sum of squares of the residual.
    """

    shapes: Complex
    gram: Real
    moment: Real
    normal: Real
    cost: float


def normalised(participation: Complex) -> Complex:
    """Scale each row so that its largest entry is 1."""
    pivot = np.argmax(np.abs(participation), axis=1)
    return np.asarray(participation / participation[np.arange(len(pivot)), pivot][:, None])


def rotation(values: Complex) -> Real:
    """2 × 2 matrices that multiply (Re, Im) by complex numbers, shape (..., 2, 2)."""
    re, im = values.real, values.imag
    return np.stack([np.stack([re, -im], axis=-1), np.stack([im, re], axis=-1)], axis=-2)


def mixing(participation: Complex) -> Real:
    """Block-diagonal matrices that turn shape entries into residues, (n_references, 2M, 2M)."""
    n_modes, n_ref = participation.shape
    out = np.zeros((n_ref, n_modes, 2, n_modes, 2))
    k = np.arange(n_modes)
    out[:, k, :, k, :] = rotation(participation)
    return out.reshape(n_ref, 2 * n_modes, 2 * n_modes)


def weighted_grams(columns: Complex, weight: Real, data: Complex, first: int = 0) -> LineSums:
    """Sums over all lines; of products of two columns only those with one from `first` on, the others are 0.

    Parameters
    ----------
    columns : complex ndarray, (n_columns, n_lines)
    weight : ndarray, (n_frfs, n_lines)
    data : complex ndarray, (n_frfs, n_lines)
    first : int, optional
    """
    n = len(columns)
    one, other = np.triu_indices(n)
    one, other = one[other >= first], other[other >= first]
    packed = np.zeros((len(weight), len(one)))
    moment, power = np.zeros((len(weight), n)), np.zeros(len(weight))
    at_once = max(LINES_AT_ONCE, PRODUCTS_AT_ONCE // max(len(one), 1))
    for start in range(0, columns.shape[1], at_once):  # small blocks stay in the cache
        block = slice(start, start + at_once)
        re, im = columns.real[:, block].copy(), columns.imag[:, block].copy()
        of_pairs = np.empty((len(one), re.shape[1]))
        products(re, im, first, of_pairs)
        packed += weight[:, block] @ of_pairs.T
        known = np.ascontiguousarray(data[:, block])
        weighted = _parts(weight[:, block] * known)
        moment += weighted @ _parts(columns[:, block]).T
        power += np.einsum("fl,fl->f", weighted, _parts(known))
    gram = np.zeros((len(weight), n, n))
    gram[:, one, other] = packed
    gram[:, other, one] = packed
    return LineSums(gram, moment, power)


def solve_linear(data: FitData, weight: Real, estimate: Estimate) -> LinearSolution:
    """Best shapes and residual terms for given poles and participations.

    Parameters
    ----------
    data : FitData
    weight : ndarray, (n_rows, n_references, n_lines)
        One over variance; 0 where not measured.
    estimate : Estimate
    """
    return with_slopes(data, weight, estimate, best_shapes(data, weight, estimate))


def best_shapes(data: FitData, weight: Real, estimate: Estimate) -> BestShapes:
    """The shapes of `solve_linear` with their cost alone, in a third of its time."""
    return shapes_by_lines(data, _known(data, weight), _blocks(len(data.omega)), estimate)


def with_slopes(data: FitData, weight: Real, estimate: Estimate, best: BestShapes) -> LinearSolution:
    """All of `solve_linear` from the best shapes of the same data; a step that is not taken needs these alone."""
    m, each = len(estimate.poles), data.frf.shape[:2]
    residual, known = data.residual_columns(), _known(data, weight)
    first = len(residual) + 2 * m

    def columns(lines: slice) -> Complex:
        return np.concatenate(
            [residual[:, lines], *real_columns(data.omega[lines], estimate.poles, data.rest_s)]
        )

    sums = _line_sums(data, known, _blocks(len(data.omega)), columns, first)
    sums.gram[:, :first, :first] = best.sums.gram
    gram, moment, _ = _project_out(sums, len(residual))
    gram, moment = gram.reshape(*each, 4 * m, 4 * m), moment.reshape(*each, 4 * m)
    return LinearSolution(best.shapes, gram, moment, best.normal, best.cost)


def shapes_by_lines(data: FitData, known: Known, blocks: list[slice], estimate: Estimate) -> BestShapes:
    """`best_shapes` of many rows, whose data and weights are made some lines at a time.

    Parameters
    ----------
    data : FitData
    known : callable
        Gives data and weights, (n_rows, n_references, n_some) each, of some lines.
    blocks : list of slice
        All lines, in order.
    estimate : Estimate
    """
    m, each = len(estimate.poles), data.frf.shape[:2]
    residual = data.residual_columns()

    def columns(lines: slice) -> Complex:
        return np.concatenate(
            [residual[:, lines], mode_columns(data.omega[lines], estimate.poles, data.rest_s)]
        )

    sums = _line_sums(data, known, blocks, columns)
    gram, moment, power = _project_out(sums, len(residual))
    gram, moment = gram.reshape(*each, 2 * m, 2 * m), moment.reshape(*each, 2 * m)
    normal, right, solved = _solved(gram, moment, estimate)
    cost = float(power.sum() - np.einsum("oa,oa->", right, solved))
    return BestShapes(solved[:, 0::2] + 1j * solved[:, 1::2], normal, cost, sums)


def _line_sums(
    data: FitData, known: Known, blocks: list[slice], columns: Callable[[slice], Complex], first: int = 0
) -> LineSums:
    """`weighted_grams` of all FRFs, with columns that are made some lines at a time."""
    n_frfs = data.frf.shape[0] * data.frf.shape[1]

    def of_lines(block: slice) -> LineSums:
        frf, weight = known(block)
        return weighted_grams(columns(block), weight.reshape(n_frfs, -1), frf.reshape(n_frfs, -1), first)

    parts = in_order(of_lines, blocks)
    total = next(parts)
    for some in parts:
        total = LineSums(total.gram + some.gram, total.moment + some.moment, total.power + some.power)
    return total


def _solved(gram: Real, moment: Real, estimate: Estimate) -> tuple[Real, Real, Real]:
    """Normal matrix, right-hand side and (Re, Im) of the shapes of every row."""
    mix = mixing(estimate.participation)
    normal = np.einsum("iba,oibc,icd->oad", mix, gram, mix, optimize=True)
    right = np.einsum("iba,oib->oa", mix, moment)
    return normal, right, solve_scaled(normal, right[..., None])[..., 0]


def _project_out(sums: LineSums, count: int) -> tuple[Real, Real, Real]:
    """Gram matrices, moments and powers without the first columns, the residual terms."""
    gram, moment, power = sums.gram, sums.moment, sums.power
    side = np.concatenate([gram[:, :count, count:], moment[:, :count, None]], axis=-1)
    solved = solve_scaled(gram[:, :count, :count], side)
    gram_out = gram[:, count:, count:] - np.matmul(side[:, :, :-1].transpose(0, 2, 1), solved[:, :, :-1])
    moment_out = moment[:, count:] - np.einsum("fka,fk->fa", side[:, :, :-1], solved[:, :, -1])
    power_out = power - np.einsum("fk,fk->f", side[:, :, -1], solved[:, :, -1])
    return gram_out, moment_out, power_out


def solve_scaled(matrix: Real, right: Real) -> Real:
    """Solve symmetric systems, columns scaled to unit diagonal; rows without data give 0."""
    diagonal = np.einsum("...aa->...a", matrix)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scaled = matrix * scale[..., :, None] * scale[..., None, :]
    n = matrix.shape[-1]
    index = np.arange(n)
    scaled[..., index, index] += RIDGE + (diagonal <= 0)
    return np.asarray(np.linalg.solve(scaled, right * scale[..., None]) * scale[..., None])


@dataclass(frozen=True)
class Step:
    """Reduced normal equations of the nonlinear parameters.

    Attributes
    ----------
    information : ndarray, (n_parameters, n_parameters)
        Information matrix, shapes and residual terms eliminated.
    gradient : ndarray, (n_parameters,)
    """

    information: Real
    gradient: Real


def parameter_columns(estimate: Estimate, shapes: Complex) -> Real:
    """How each nonlinear parameter acts on the columns of a row and reference.

    Parameters are (Re s, Im s) of all modes, then (Re l, Im l) of the entries of the participations that are
    not their mode's pivot.

    Returns
    -------
    ndarray, (n_rows, n_references, 4M, n_parameters)
    """
    m, n_ref = estimate.participation.shape
    n_rows = len(shapes)
    free = free_participations(estimate)
    out = np.zeros((n_rows, n_ref, 4 * m, 2 * m + 2 * len(free)))
    residues = shapes[:, None, :] * estimate.participation.T[None]  # (rows, refs, modes)
    rot = rotation(residues)
    for r in range(m):
        out[:, :, 2 * m + 2 * r : 2 * m + 2 * r + 2, 2 * r : 2 * r + 2] = rot[:, :, r]
    for k, (r, i) in enumerate(free):
        start = 2 * m + 2 * k
        out[:, i, 2 * r : 2 * r + 2, start : start + 2] = rotation(shapes[:, r])
    return out


def free_participations(estimate: Estimate) -> list[tuple[int, int]]:
    """(mode, reference) of the participations that are searched: all but each mode's largest."""
    pivot = np.argmax(np.abs(estimate.participation), axis=1)
    m, n_ref = estimate.participation.shape
    return [(r, i) for r in range(m) for i in range(n_ref) if i != pivot[r]]


def newton_step(estimate: Estimate, solution: LinearSolution) -> Step:
    """Gauss–Newton information matrix and gradient at the best linear solution."""
    m = len(estimate.poles)
    mix = mixing(estimate.participation)
    z = parameter_columns(estimate, solution.shapes)
    gz = np.matmul(solution.gram, z)
    jj = np.tensordot(z, gz, axes=([0, 1, 2], [0, 1, 2]))
    cross = np.einsum("iba,oibp->oap", mix, gz[:, :, : 2 * m], optimize=True)
    eliminated = solve_scaled(solution.normal, cross)
    information = jj - np.tensordot(cross, eliminated, axes=([0, 1], [0, 1]))
    psi = np.stack([solution.shapes.real, solution.shapes.imag], axis=-1).reshape(len(solution.shapes), 2 * m)
    coefficients = np.einsum("iab,ob->oia", mix, psi)
    misfit = solution.moment - np.einsum("oiab,oib->oia", solution.gram[..., : 2 * m], coefficients)
    gradient = np.einsum("oiap,oia->p", z, misfit, optimize=True)
    return Step(0.5 * (information + information.T), gradient)


def moved(estimate: Estimate, change: Real) -> Estimate:
    """Estimate after a change of its parameters."""
    m = len(estimate.poles)
    poles = estimate.poles + change[0 : 2 * m : 2] + 1j * change[1 : 2 * m : 2]
    participation = estimate.participation.copy()
    for k, (r, i) in enumerate(free_participations(estimate)):
        participation[r, i] += change[2 * m + 2 * k] + 1j * change[2 * m + 2 * k + 1]
    return Estimate(poles, participation)


def synthesis(data: FitData, estimate: Estimate, shapes: Complex) -> Complex:
    """What the modes alone add to the FRFs, (n_rows, n_references, n_lines)."""
    residues = _parts(shapes[:, None, :] * estimate.participation.T[None])
    out = np.empty(data.frf.shape, dtype=np.complex128)
    for block in _blocks(len(data.omega)):
        columns = mode_columns(data.omega[block], estimate.poles, data.rest_s)
        out[..., block] = _summed(residues, columns)
    return out


def _parts(values: Complex) -> Real:
    """Real and imaginary parts side by side, (..., 2·n): products with real matrices then cost half."""
    return np.ascontiguousarray(values).view(np.float64)


def _summed(coefficients: Real, columns: Complex) -> Complex:
    """Sums of columns with real coefficients, (..., n_columns) to (..., n_lines)."""
    return np.asarray((coefficients @ _parts(columns)).view(np.complex128))


def _known(data: FitData, weight: Real) -> Known:
    return lambda lines: (data.frf[..., lines], weight[..., lines])


def _blocks(n_lines: int) -> list[slice]:
    return [slice(k, min(k + COLUMNS_AT_ONCE, n_lines)) for k in range(0, n_lines, COLUMNS_AT_ONCE)]


def residual_fit(data: FitData, weight: Real, modes: Complex) -> Complex:
    """Best residual terms for what the modes leave over, (n_rows, n_references, n_lines)."""
    columns = data.residual_columns()
    n_lines = data.frf.shape[-1]
    sums = weighted_grams(columns, weight.reshape(-1, n_lines), (data.frf - modes).reshape(-1, n_lines))
    coefficients = solve_scaled(sums.gram, sums.moment[..., None])[..., 0]
    return _summed(coefficients, columns).reshape(data.frf.shape)
