"""The compiled loop of `mechanics.modal_response`: modal states through time, with the nonlinear elements solved."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from ema_pipeline.mechanics.laws import FRICTION, LAWS, POLYNOMIAL

_polynomial, _, _parting = (numba.njit(law, inline="always") for law in LAWS)

_NEWTON = 60
_RINGING = 3.0
"""Friction that takes this many times the rate within a step rings from step to step, at half its strength."""

_TOLERANCE = 1e-8
_LAST, _SAME = 1e-5, 1e-10
"""A Newton step of the rate, over the velocity of friction, after which tanh follows from two terms of its series; and
relative change of a rate that leaves friction as it is."""
_WILD = 1e30
"""A force, N, that no structure has."""


class Marched(NamedTuple):
    """What `march` gives.

    Attributes
    ----------
    motion : ndarray, (n_blows, n_kept, n_outputs)
    forces : ndarray, (n_blows, m, n_steps)
        Of the elements; without steps where they were not asked for.
    failed : bool
        True where no solution was found at some step: motion and forces say nothing then.
    """

    motion: NDArray[np.float64]
    forces: NDArray[np.float64]
    failed: bool


def march(
    laws: NDArray[np.float64],
    poles: NDArray[np.complex128],
    inputs: NDArray[np.complex128],
    stretch: NDArray[np.complex128],
    outputs: NDArray[np.complex128],
    direct: NDArray[np.float64],
    force: NDArray[np.float64],
    step: float,
    keep_every: int,
    trace: bool = False,
) -> Marched:
    """Motion from rest, as the sensors read it but for what the blow itself gives an accelerometer.

    Parameters
    ----------
    laws : ndarray, (m, 4)
        Law and numbers of each element, see `Nonlinear.law`.
    poles : complex ndarray, (P,)
    inputs : complex ndarray, (n_blows + m, P)
        What a force adds to the rate of the states: of each blow, of each element.
    stretch : complex ndarray, (2m, P)
        Stretches and rates of the elements are the real parts of `stretch` times the states.
    outputs : complex ndarray, (n_outputs, P)
    direct : ndarray, (n_outputs, m)
        What the elements' forces add to the outputs at once.
    force : ndarray, (n_blows, n_steps)
        At every step; straight in between.
    step : float
        s.
    keep_every : int
        Steps per sample of the motion.
    trace : bool
        True where the forces of the elements are wanted at every step, too.

    Returns
    -------
    Marched

    Notes
    -----
    With a force that runs straight over a step, z₊ = Ez + Γ₀f + Γ₁f₊; for y = z - Γ₁f this is
    y₊ = Ey + (Γ₀ + EΓ₁)f, which needs the force at the start of the step only.
    """
    hits = len(force)
    x = poles * step
    small = np.abs(x) < 1e-4
    safe = np.where(small, 1.0, x)
    decay = np.exp(x)
    whole = np.where(small, 1 + x / 2, (decay - 1) / safe) * step
    late = np.where(small, 0.5 + x / 6, (decay - 1 - x) / safe**2) * step
    early = whole - late + decay * late
    begun, ended = inputs * early, inputs * late
    # what a force at the end of a step adds to stretches and outputs
    reach = np.einsum("sp,cp->sc", stretch, ended).real
    seen = np.einsum("op,cp->oc", outputs, ended).real
    seen[:, hits:] += direct
    steps = force.shape[1]
    kept = (steps - 1) // keep_every + 1
    result = np.zeros((hits, kept, len(outputs)))
    forces = np.zeros((hits, len(laws), steps if trace else 0))
    # one memory layout, so that one compiled loop serves all
    numbers = (
        laws, decay, begun, ended, _halves(stretch), _halves(outputs), reach, seen, force,
    )  # fmt: skip
    same = [np.ascontiguousarray(a) for a in numbers]
    solved = _march(*same, step, keep_every, result, forces)  # type: ignore[call-arg]
    return Marched(result, forces, not solved)


def _halves(rows: NDArray[np.complex128]) -> NDArray[np.float64]:
    """(n, 2P): rows that give Re(row·z) from real and imaginary parts of z."""
    return np.concatenate([rows.real, -rows.imag], axis=1)


@numba.njit(inline="always")
def _gripped(free, stop, before):  # type: ignore[no-untyped-def]
    """Friction at the end of a step over its limit, from the rate that the step would end at without it.

    In u = rate/velocity the equation is u + stop·tanh(u) = free: its left side rises and bends downwards for u > 0, so
    that a Newton step from anywhere does not end above the root. The first is from where the friction `before` puts it.
    The root would be lower where tanh(u) were u, and where it were 1.
    """
    aim, sign = (free, 1.0) if free > 0.0 else (-free, -1.0)
    least = max(aim / (1.0 + stop), aim - stop)
    u, hold = max(aim - sign * stop * before, least), 1.0
    for _ in range(_NEWTON):
        left = np.exp(-2.0 * u)  # tanh(u) is (1 - left)/(1 + left)
        more, less = 1.0 + left, 1.0 - left
        step = ((aim - u) * more - stop * less) * more / (more * more + 4.0 * stop * left)
        if abs(step) < _LAST:
            hold = less / more
            hold += (1.0 - hold * hold) * step * (1.0 - hold * step)
            break
        u = max(u + step, least)
    return sign * hold


@numba.njit(cache=True, fastmath={"reassoc", "contract", "nsz"})
def _march(  # type: ignore[no-untyped-def]
    laws,
    decay,
    begun,
    ended,
    stretch,
    outputs,
    reach,
    seen,
    force,
    step,
    keep_every,
    result,
    forces,
):
    """Fill in `result` and `forces`; False where there is no solution at some step."""
    size = len(decay)
    hits, steps = force.shape
    m = len(laws)
    channels = len(outputs)
    trace = forces.shape[2] > 0
    y = np.zeros(2 * size)
    g, d, v, solved = np.zeros(m), np.zeros(m), np.zeros(m), np.zeros(m)
    # of friction: its velocity, and the rate that it takes over that
    resolved, stop = np.ones(m), np.zeros(m)
    turn, fade = decay.imag.copy(), decay.real.copy()
    push_re, push_im = begun[hits:].real.copy(), begun[hits:].imag.copy()
    for j in range(m):
        if laws[j, 0] == FRICTION:
            taken = -reach[m + j, hits + j] * laws[j, 1]
            resolved[j] = max(laws[j, 2], taken / _RINGING)
            stop[j] = taken / resolved[j]
    for h in range(hits):
        g[:] = 0.0
        for p in range(size):  # z = 0
            y[p] = -ended[h, p].real * force[h, 0]
            y[size + p] = -ended[h, p].imag * force[h, 0]
        scale = 1e-9
        b_re, b_im = begun[h].real.copy(), begun[h].imag.copy()
        for k in range(1, steps):
            f = force[h, k - 1]
            for p in range(size):
                re, im = y[p], y[size + p]
                y[p] = fade[p] * re - turn[p] * im + b_re[p] * f
                y[size + p] = turn[p] * re + fade[p] * im + b_im[p] * f
            for j in range(m):
                if g[j] != 0.0:
                    for p in range(size):
                        y[p] += push_re[j, p] * g[j]
                        y[size + p] += push_im[j, p] * g[j]
            f = force[h, k]
            for j in range(m):
                dj, vj = reach[j, h] * f, reach[m + j, h] * f
                if laws[j, 0] == FRICTION:  # the only law that asks for the rate, and not for the stretch
                    for p in range(2 * size):
                        vj += stretch[m + j, p] * y[p]
                else:
                    for p in range(2 * size):
                        dj += stretch[j, p] * y[p]
                d[j], v[j] = dj, vj
            worst = 0.0
            solved[:] = np.inf
            for _ in range(_NEWTON):
                worst = 0.0
                for j in range(m):
                    kind = laws[j, 0]
                    n1, n2, n3 = laws[j, 1], laws[j, 2], laws[j, 3]
                    if kind == FRICTION:
                        free = v[j]
                        for i in range(m):
                            if i != j:
                                free += reach[m + j, hits + i] * g[i]
                        found, error = g[j], 0.0
                        if n1 != 0.0 and not abs(free - solved[j]) <= _SAME * abs(free):
                            found = n1 * _gripped(free / resolved[j], stop[j], g[j] / n1)
                            error = found - g[j]
                            solved[j], g[j] = free, found
                    else:
                        dj, vj = d[j], v[j]
                        for i in range(m):
                            dj += reach[j, hits + i] * g[i]
                            vj += reach[m + j, hits + i] * g[i]
                        if kind == POLYNOMIAL:
                            found, by_d, by_v = _polynomial(dj, vj, n1, n2, n3)
                        else:
                            found, by_d, by_v = _parting(dj, vj, n1, n2, n3)
                        error = found - g[j]
                        slope = by_d * reach[j, hits + j] + by_v * reach[m + j, hits + j]
                        g[j] += error / max(1.0 - slope, 0.1)
                    scale = max(scale, abs(found))
                    worst = max(worst, abs(error))
                if not worst > _TOLERANCE * scale:
                    break
            if not (worst <= 1e-4 * scale and scale < _WILD):
                return False
            if trace:
                for j in range(m):
                    forces[h, j, k] = g[j]
            if channels and k % keep_every == 0:
                at = k // keep_every
                for c in range(channels):
                    s = seen[c, h] * f
                    for j in range(m):
                        s += seen[c, hits + j] * g[j]
                    for p in range(2 * size):
                        s += outputs[c, p] * y[p]
                    result[h, at, c] = s
    return True
