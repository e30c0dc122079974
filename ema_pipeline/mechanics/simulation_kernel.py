"""The compiled loop of `mechanics.simulation`: a structure with nonlinear elements marched under measured forces.

Classical Runge-Kutta steps of fourth order. Derivatives by parameters follow from the variational
equations, marched by the same steps: they are the exact derivatives of what the loop gives.
"""

from __future__ import annotations

import numba
import numpy as np

from ema_pipeline.mechanics.driven_system import (
    BOUC_WEN,
    FRICTION,
    MAXWELL,
    PARTING,
    POLYNOMIAL,
    SQUARE_DAMPER,
)

COLUMNS = 8
"""Derivatives that the loops take at once; a rest takes as long as all of them."""
FEW = (0,) * COLUMNS
"""As `known` of a march with just so many: a number that the compiler knows lets it unroll all loops over them."""

_SATURATED = 20.0
"""Argument from which a hyperbolic tangent is 1 to the last digit."""
_WILD = 1e12
"""Motion, in SI units, that no structure has."""


@numba.njit(inline="always")
def _law(kind, d, v, z, a, b, c, e):  # type: ignore[no-untyped-def]
    """Force of an element at stretch `d`, rate `v` and memory `z`; all derivatives.

    Returns
    -------
    tuple of float
        Force g and its derivatives by d, v, z and the four numbers; rate of z and its derivatives by the same.

    Notes
    -----
    ========================  =========================================================================
    POLYNOMIAL (a, b)         g = a·d² + b·d³
    FRICTION (a, b)           g = a·tanh(v/b)
    SQUARE_DAMPER (a)         g = a·|v|·v
    BOUC_WEN (a, b, c, e)     g = z, ż = a·(v - |v|·|z/b|ᵉ⁻¹·z/b - c·v·|z/b|ᵉ)
    PARTING (a, b, c)         g = a·(max(d + b, 0) + min(d + b + c, 0) - max(b, 0))
    MAXWELL (a, b)            g = a·(d - z), ż = (d - z)/b
    ========================  =========================================================================
    """
    g = gd = gv = gz = ga = gb = 0.0
    r = rd = rv = rz = ra = rb = rc = re = 0.0
    if kind == POLYNOMIAL:
        g = (a + b * d) * d * d
        gd = (2.0 * a + 3.0 * b * d) * d
        ga = d * d
        gb = ga * d
    elif kind == FRICTION:
        fast = abs(v * (1.0 / b))
        gap = np.exp(-2.0 * fast) if fast < _SATURATED else 0.0  # np.tanh takes three times as long
        t = (1.0 - gap) / (1.0 + gap)
        if v < 0.0:
            t = -t
        s = 1.0 - t * t
        g, gv, ga, gb = a * t, a * s / b, t, -a * s * v / (b * b)
    elif kind == SQUARE_DAMPER:
        g, gv, ga = a * abs(v) * v, 2.0 * a * abs(v), abs(v) * v
    elif kind == BOUC_WEN:
        g, gz = z, 1.0
        u = z * (1.0 / b)  # the quotient is ready before z is, and the loop waits for z
        size = abs(u)
        low = 1.0 if e == 1.0 else size ** (e - 1.0)
        drag = abs(v) + c * v if u >= 0.0 else abs(v) - c * v
        inner = v - low * drag * u
        r, ra = a * inner, inner
        rv = a * (1.0 - low * ((1.0 if v >= 0.0 else -1.0) * u + c * size))
        rz = -a * e * low * drag * (1.0 / b)
        rb = -rz * u
        rc = -a * v * low * size
        if size > 1e-12:
            re = -a * np.log(size) * low * drag * u
    elif kind == PARTING:
        over = d + b
        if over > 0.0:
            g, gd, ga, gb = a * over, a, over, a
        elif over + c < 0.0:
            g, gd, ga, gb = a * (over + c), a, over + c, a
            rc = 0.0
        if b > 0.0:
            g -= a * b
            ga -= b
            gb -= a
    else:
        g, gd, gz, ga = a * (d - z), a, -a, d - z
        r, rd, rz, rb = (d - z) / b, 1.0 / b, -1.0 / b, -(d - z) / (b * b)
    return g, gd, gv, gz, ga, gb, r, rd, rv, rz, ra, rb, rc, re


@numba.njit(inline="always")
def _copy(values, out):  # type: ignore[no-untyped-def]
    """`out[:] = values`, which takes the compiler seconds: it makes the words of an error that there cannot be."""
    for i in range(values.shape[0]):
        out[i] = values[i]


@numba.njit(inline="always")
def _copy_rows(values, out):  # type: ignore[no-untyped-def]
    """`_copy` of two axes."""
    for i in range(values.shape[0]):
        for c in range(values.shape[1]):
            out[i, c] = values[i, c]


@numba.njit(inline="always")
def march(stiffness, damping, inputs, push, rows, kinds, numbers, force, begin, step, every, out):  # type: ignore[no-untyped-def]
    """March the states from `begin`; False where the motion grows without bound.

    Parameters
    ----------
    stiffness, damping : ndarray, (n, n)
        M⁻¹K and M⁻¹C of the linear elements.
    inputs : ndarray, (n, n_inputs)
        M⁻¹ times the rows of the forces.
    push : ndarray, (n, m)
        M⁻¹ times the rows of the nonlinear elements.
    rows : ndarray, (m, n)
    kinds : ndarray of int, (m,)
    numbers : ndarray, (m, 4)
    force : ndarray, (2·n_steps + 1, n_inputs)
        At the ends and middles of the steps, N.
    begin : ndarray, (2n + m,)
        Displacements, velocities, memories.
    step : float
        s.
    every : int
        Steps per kept sample.
    out : ndarray, (n_kept, 2n + m)
        Overwritten.
    """
    n, m = stiffness.shape[0], kinds.shape[0]
    size, ins = 2 * n + m, inputs.shape[1]
    s, at, total, rate = begin.copy(), begin.copy(), np.zeros(size), np.zeros(size)
    g = np.zeros(m)
    _copy(s, out[0])
    steps = (force.shape[0] - 1) // 2
    for k in range(steps):
        total[:] = 0.0
        _copy(s, at)
        for stage in range(4):
            half = 2 * k + (0 if stage == 0 else (2 if stage == 3 else 1))
            for j in range(m):
                d = v = 0.0
                for i in range(n):
                    d += rows[j, i] * at[i]
                    v += rows[j, i] * at[n + i]
                found = _law(
                    kinds[j], d, v, at[2 * n + j], numbers[j, 0], numbers[j, 1], numbers[j, 2], numbers[j, 3]
                )
                g[j] = found[0]
                rate[2 * n + j] = found[6]
            for i in range(n):
                total_force = 0.0
                for q in range(ins):
                    total_force += inputs[i, q] * force[half, q]
                for q in range(n):
                    total_force -= stiffness[i, q] * at[q] + damping[i, q] * at[n + q]
                for j in range(m):
                    total_force -= push[i, j] * g[j]
                rate[i] = at[n + i]
                rate[n + i] = total_force
            weight = 1.0 if stage == 0 or stage == 3 else 2.0
            ahead = 0.5 * step if stage < 2 else step
            for i in range(size):
                total[i] += weight * rate[i]
                at[i] = s[i] + ahead * rate[i]
        wild = 0.0
        for i in range(size):
            s[i] += step / 6.0 * total[i]
            wild = max(wild, abs(s[i]))
        if not wild < _WILD:
            return False
        if (k + 1) % every == 0:
            _copy(s, out[(k + 1) // every])
    return True


@numba.njit(inline="always")
def march_with_slopes(  # type: ignore[no-untyped-def]
    stiffness,
    damping,
    inputs,
    push,
    rows,
    kinds,
    numbers,
    force,
    begin,
    step,
    every,
    d_stiffness,
    d_damping,
    d_inputs,
    d_push,
    d_numbers,
    d_begin,
    known,
    out,
    d_out,
):
    """`march` with the derivatives by p parameters.

    Parameters
    ----------
    stiffness, damping, inputs, push, rows, kinds, numbers, force, begin, step, every, out
        As in `march`.
    d_stiffness, d_damping : ndarray, (n, n, p)
    d_inputs : ndarray, (n, n_inputs, p)
    d_push : ndarray, (n, m, p)
    d_numbers : ndarray, (m, 4, p)
    d_begin : ndarray, (2n + m, p)
    known : tuple of int
        As many numbers as there are derivatives, or none.
    d_out : ndarray, (n_kept, 2n + m, p)
        Overwritten.
    """
    n, m = stiffness.shape[0], kinds.shape[0]
    size, ins, p = 2 * n + m, inputs.shape[1], len(known) if len(known) > 0 else d_begin.shape[1]
    s, at, total, rate = begin.copy(), begin.copy(), np.zeros(size), np.zeros(size)
    t, t_at = d_begin.copy(), d_begin.copy()
    t_total, t_rate = np.zeros((size, p)), np.zeros((size, p))
    g = np.zeros(m)
    t_g, t_d, t_v = np.zeros((m, p)), np.zeros(p), np.zeros(p)
    fed = np.any(d_inputs != 0.0)
    moved, pushed = np.zeros((n, n), dtype=np.bool_), np.zeros((n, m), dtype=np.bool_)
    for i in range(n):
        for q in range(n):
            moved[i, q] = np.any(d_stiffness[i, q] != 0.0) or np.any(d_damping[i, q] != 0.0)
        for j in range(m):
            pushed[i, j] = np.any(d_push[i, j] != 0.0)
    _copy(s, out[0])
    _copy_rows(t, d_out[0])
    steps = (force.shape[0] - 1) // 2
    for k in range(steps):
        total[:] = 0.0
        t_total[:] = 0.0
        _copy(s, at)
        _copy_rows(t, t_at)
        for stage in range(4):
            half = 2 * k + (0 if stage == 0 else (2 if stage == 3 else 1))
            for j in range(m):
                d = v = 0.0
                t_d[:] = 0.0
                t_v[:] = 0.0
                for i in range(n):
                    row = rows[j, i]
                    if row != 0.0:
                        d += row * at[i]
                        v += row * at[n + i]
                        for c in range(p):
                            t_d[c] += row * t_at[i, c]
                            t_v[c] += row * t_at[n + i, c]
                f, fd, fv, fz, fa, fb, r, rd, rv, rz, ra, rb, rc, re = _law(
                    kinds[j], d, v, at[2 * n + j], numbers[j, 0], numbers[j, 1], numbers[j, 2], numbers[j, 3]
                )
                g[j] = f
                rate[2 * n + j] = r
                for c in range(p):
                    t_g[j, c] = fd * t_d[c] + fv * t_v[c] + fa * d_numbers[j, 0, c] + fb * d_numbers[j, 1, c]
                if kinds[j] == BOUC_WEN or kinds[j] == MAXWELL:  # those with a memory
                    for c in range(p):
                        t_z = t_at[2 * n + j, c]
                        t_g[j, c] += fz * t_z
                        t_rate[2 * n + j, c] = (
                            rd * t_d[c]
                            + rv * t_v[c]
                            + rz * t_z
                            + ra * d_numbers[j, 0, c]
                            + rb * d_numbers[j, 1, c]
                            + rc * d_numbers[j, 2, c]
                            + re * d_numbers[j, 3, c]
                        )
            for i in range(n):
                total_force = 0.0
                for c in range(p):
                    t_rate[i, c] = t_at[n + i, c]
                    t_rate[n + i, c] = 0.0
                for q in range(ins):
                    total_force += inputs[i, q] * force[half, q]
                    if fed:
                        for c in range(p):
                            t_rate[n + i, c] += d_inputs[i, q, c] * force[half, q]
                for q in range(n):
                    by_d, by_v = stiffness[i, q], damping[i, q]
                    x, y = at[q], at[n + q]
                    total_force -= by_d * x + by_v * y
                    if by_d != 0.0 or by_v != 0.0:
                        for c in range(p):
                            t_rate[n + i, c] -= by_d * t_at[q, c] + by_v * t_at[n + q, c]
                    if moved[i, q]:
                        for c in range(p):
                            t_rate[n + i, c] -= d_stiffness[i, q, c] * x + d_damping[i, q, c] * y
                for j in range(m):
                    total_force -= push[i, j] * g[j]
                    if push[i, j] != 0.0:
                        for c in range(p):
                            t_rate[n + i, c] -= push[i, j] * t_g[j, c]
                    if pushed[i, j]:
                        for c in range(p):
                            t_rate[n + i, c] -= d_push[i, j, c] * g[j]
                rate[i] = at[n + i]
                rate[n + i] = total_force
            weight = 1.0 if stage == 0 or stage == 3 else 2.0
            ahead = 0.5 * step if stage < 2 else step
            for i in range(size):
                total[i] += weight * rate[i]
                at[i] = s[i] + ahead * rate[i]
                for c in range(p):
                    t_total[i, c] += weight * t_rate[i, c]
                    t_at[i, c] = t[i, c] + ahead * t_rate[i, c]
        wild = 0.0
        for i in range(size):
            s[i] += step / 6.0 * total[i]
            wild = max(wild, abs(s[i]))
            for c in range(p):
                t[i, c] += step / 6.0 * t_total[i, c]
        if not wild < _WILD:
            return False
        if (k + 1) % every == 0:
            _copy(s, out[(k + 1) // every])
            _copy_rows(t, d_out[(k + 1) // every])
    return True


@numba.njit(inline="always")
def _march_one(  # type: ignore[no-untyped-def]
    stiffness, damping, inputs, push, rows, kinds, numbers, force, begin, step, every, out, memory
):  # fmt: skip
    """`march` of one coordinate in a third to two thirds of the time: its motion stays in registers.

    `memory` is the number of the one element that has a memory, or of any where none has.
    """
    m, ins = kinds.shape[0], inputs.shape[1]
    spring, damper = stiffness[0, 0], damping[0, 0]
    for k in range(out.shape[0]):
        _copy(begin, out[k])
    x, v, z = begin[0], begin[1], begin[2 + memory] if m > 0 else 0.0
    for k in range((force.shape[0] - 1) // 2):
        x_at, v_at, z_at = x, v, z
        x_total = v_total = z_total = 0.0
        for stage in range(4):
            half = 2 * k + (0 if stage == 0 else (2 if stage == 3 else 1))
            rate, z_rate = -spring * x_at - damper * v_at, 0.0
            for q in range(ins):
                rate += inputs[0, q] * force[half, q]
            for j in range(m):
                row = rows[j, 0]
                found = _law(
                    kinds[j], row * x_at, row * v_at, z_at,
                    numbers[j, 0], numbers[j, 1], numbers[j, 2], numbers[j, 3],
                )  # fmt: skip
                rate -= push[0, j] * found[0]
                z_rate += found[6]
            weight = 1.0 if stage == 0 or stage == 3 else 2.0
            ahead = 0.5 * step if stage < 2 else step
            x_total += weight * v_at
            v_total += weight * rate
            z_total += weight * z_rate
            x_at, v_at, z_at = x + ahead * v_at, v + ahead * rate, z + ahead * z_rate
        x += step / 6.0 * x_total
        v += step / 6.0 * v_total
        z += step / 6.0 * z_total
        if not max(abs(x), abs(v), abs(z)) < _WILD:
            return False
        if (k + 1) % every == 0:
            at = (k + 1) // every
            out[at, 0], out[at, 1] = x, v
            if m > 0:
                out[at, 2 + memory] = z
    return True


@numba.njit(cache=True, fastmath={"reassoc", "contract", "nsz"})
def march_windows(stiffness, damping, inputs, push, rows, kinds, numbers, force, begin, step, every, out):  # type: ignore[no-untyped-def]
    """`march` for every force (n_windows, ...), from `begin` (n_windows, 2n + m) into `out`; False where one fails."""
    remembers = (kinds == BOUC_WEN) | (kinds == MAXWELL)
    if len(stiffness) == 1 and np.sum(remembers) <= 1:
        memory = np.argmax(remembers) if len(kinds) > 0 else 0
        for w in range(len(force)):
            if not _march_one(
                stiffness, damping, inputs, push, rows, kinds, numbers, force[w], begin[w], step, every, out[w],
                memory,
            ):  # fmt: skip
                return False
        return True
    for w in range(len(force)):
        if not march(
            stiffness, damping, inputs, push, rows, kinds, numbers, force[w], begin[w], step, every, out[w]
        ):
            return False
    return True


@numba.njit(cache=True, fastmath={"reassoc", "contract", "nsz"})
def march_windows_with_slopes(  # type: ignore[no-untyped-def]
    stiffness,
    damping,
    inputs,
    push,
    rows,
    kinds,
    numbers,
    force,
    begin,
    step,
    every,
    d_stiffness,
    d_damping,
    d_inputs,
    d_push,
    d_numbers,
    d_begin,
    known,
    out,
    d_out,
):
    """`march_with_slopes` for every force, as `march_windows` does it."""
    for w in range(len(force)):
        if not march_with_slopes(
            stiffness, damping, inputs, push, rows, kinds, numbers, force[w], begin[w], step, every,
            d_stiffness, d_damping, d_inputs, d_push, d_numbers, d_begin[w], known, out[w], d_out[w],
        ):  # fmt: skip
            return False
    return True


@numba.njit(cache=True)
def accelerations(  # type: ignore[no-untyped-def]
    stiffness,
    damping,
    inputs,
    push,
    rows,
    kinds,
    numbers,
    force,
    states,
    tangent,
    d_stiffness,
    d_damping,
    d_inputs,
    d_push,
    d_numbers,
):
    """Accelerations at states (n_samples, 2n + m) and their derivatives; arguments as of `march_with_slopes`.

    Parameters
    ----------
    force : ndarray, (n_samples, n_inputs)
    states : ndarray, (n_samples, 2n + m)
    tangent : ndarray, (n_samples, 2n + m, p)

    Returns
    -------
    tuple of ndarray
        (n_samples, n) and (n_samples, n, p).
    """
    n, m, ins = stiffness.shape[0], kinds.shape[0], inputs.shape[1]
    count, p = states.shape[0], tangent.shape[2]
    found, slope = np.zeros((count, n)), np.zeros((count, n, p))
    t_g = np.zeros(p)
    for k in range(count):
        s, t = states[k], tangent[k]
        for i in range(n):
            for q in range(ins):
                found[k, i] += inputs[i, q] * force[k, q]
                for c in range(p):
                    slope[k, i, c] += d_inputs[i, q, c] * force[k, q]
            for q in range(n):
                found[k, i] -= stiffness[i, q] * s[q] + damping[i, q] * s[n + q]
                for c in range(p):
                    slope[k, i, c] -= (
                        stiffness[i, q] * t[q, c]
                        + damping[i, q] * t[n + q, c]
                        + d_stiffness[i, q, c] * s[q]
                        + d_damping[i, q, c] * s[n + q]
                    )
        for j in range(m):
            d = v = 0.0
            for i in range(n):
                d += rows[j, i] * s[i]
                v += rows[j, i] * s[n + i]
            f, fd, fv, fz, fa, fb, _, _, _, _, _, _, _, _ = _law(
                kinds[j], d, v, s[2 * n + j], numbers[j, 0], numbers[j, 1], numbers[j, 2], numbers[j, 3]
            )
            for c in range(p):
                t_g[c] = fz * t[2 * n + j, c] + fa * d_numbers[j, 0, c] + fb * d_numbers[j, 1, c]
                for i in range(n):
                    t_g[c] += rows[j, i] * (fd * t[i, c] + fv * t[n + i, c])
            for i in range(n):
                found[k, i] -= push[i, j] * f
                for c in range(p):
                    slope[k, i, c] -= push[i, j] * t_g[c] + d_push[i, j, c] * f
    return found, slope
