"""The diagnosis in plain sentences."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.diagnose.fitting import Fitted
from ema_pipeline.diagnose.types import NOT_TOLD, OUT_OF_TOLERANCE, EffectSize, Ladder

_NAMED = 4
"""Hits that a sentence names; a count stands for the rest."""


def why(base: Fitted, fitted: Fitted, measured: Mapping[str, MeasuredModes], signs: str) -> str:
    """Two sentences: the effect's tell-tale signs, and the modes whose misfit fell most."""
    names = [(c, float(f)) for c, m in measured.items() if len(m) for f in m.frequency_hz]
    cap = 1e4
    before = np.where(np.isfinite(base.costs), np.minimum(base.costs, cap), cap)
    after = np.where(np.isfinite(fitted.costs), np.minimum(fitted.costs, cap), cap)
    fall = before - after
    order = np.argsort(-fall)[:3]
    parts = [f"{names[i][1]:.1f} Hz ({names[i][0]})" for i in order if fall[i] > 0.5]
    gain = base.objective - fitted.objective
    eased = base.prior_cost - fitted.prior_cost
    if gain > 0 and eased > 0.5 * gain:
        second = (
            "Without it the measured modes push the rig's parameters out of their tolerances "
            f"(their squared shifts add up to {base.prior_cost:.1f}, with it to {fitted.prior_cost:.1f})."
        )
    elif parts:
        second = f"The misfit falls most at {', '.join(parts)}."
    else:
        second = "No mode is fitted better with it."
    return f"Its signs: {signs}. {second}"


def size_text(sizes: Mapping[str, EffectSize]) -> str:
    """``fraction 0.350 ± 0.002, …``."""
    return ", ".join(f"{n.rpartition('.')[2]} {_one_size(s)}" for n, s in sizes.items())


def _one_size(s: EffectSize) -> str:
    if not s.told:
        return NOT_TOLD
    return f"{s.value:.4g} ± {s.std:.2g}{'' if s.unit in ('', '1') else ' ' + s.unit}"


def compared_text(ladder: Ladder) -> str:
    """A remark where not all of the hits, or only the first part of each, was compared; else empty."""
    if ladder.left_out:
        names = list(ladder.left_out[:_NAMED])
        if more := len(ladder.left_out) - len(names):
            names.append(f"{more} more")
        return (
            f"{len(ladder.left_out)} {'hits are' if len(ladder.left_out) > 1 else 'hit is'} left out "
            f"({', '.join(names)}): the motion hangs on the last thousandth of the force, as where parts strike again "
            "and again, and cannot be foretold."
        )
    if np.isfinite(ladder.compared_s):
        return (
            f"Only the first {1e3 * ladder.compared_s:.0f} ms of each hit are compared: in longer windows no model "
            "follows the measured motion, as where parts strike or stick."
        )
    return ""


def label_text(label: str) -> str:
    """A label as a phrase."""
    effect, _, place = label.partition("@")
    if effect == OUT_OF_TOLERANCE:
        return f"parameter {place} out of tolerance"
    return f"{effect.replace('_', ' ')} at {place}"
