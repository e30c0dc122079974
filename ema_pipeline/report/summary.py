"""The run in plain words: what was found, what was fitted, and what to be careful about."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from ema_pipeline.fit.types import ErrorSweep, FitResult, ParameterEstimate
from ema_pipeline.report import diagnosis
from ema_pipeline.report.levels import has_to_say
from ema_pipeline.report.limits import FAR_SIGMA, LOW_MAC, POOR_ERROR
from ema_pipeline.report.numbers import below, format_value, plain, words
from ema_pipeline.report.results import ConfigurationResults, RunResults

SAME_KIND = 2
"""Cautions of one kind that are written out; the rest is counted."""

TOLD = 6
"""Narrowed parameters that are named."""

_DOF_OR_NUMBER = re.compile(r"-?\b[A-Za-z]\w*\.[a-z]\w*|[\d.]*\d")


def findings(results: RunResults) -> tuple[str, ...]:
    """What was measured and how well the model follows it, one sentence each."""
    lines = [] if results.diagnosis is None else [diagnosis.compact(results.diagnosis)]
    lines += [_measured(c) for c in results.configurations]
    lines += [
        f"{c.name}: {c.levels.summary}" for c in results.configurations if c.levels and has_to_say(c.levels)
    ]
    if not lines:
        lines = ["Nothing has been analysed yet."]
    compared, fit = results.comparison, results.fit
    if fit is not None:
        lines.append(
            f"The fit uses {fit.data_count} data; its error is {plain(fit.error, 3)}, "
            f"the error function ε is {plain(fit.frequency_error, 3)}."
        )
        lines += _narrowed(fit)
    if compared is not None and math.isfinite(compared.error):
        size = plain(compared.error, 3)
        verdict = None if results.diagnosis is None else results.diagnosis.verdict
        if compared.error <= POOR_ERROR and verdict in ("effect", "ambiguous"):
            lines.append(
                f"Model and measurement differ by {size} standard uncertainties (root mean square); "
                "what would bring them nearer stands above."
            )
        elif compared.error <= POOR_ERROR:
            lines.append(
                f"Model and measurement differ by {size} standard uncertainties (root mean square): "
                "the model explains the data about as well as the data can tell."
            )
        else:
            lines.append(
                f"Model and measurement differ by {size} standard uncertainties (root mean square): "
                "more than the measurement's uncertainty explains."
            )
            lines += _worst(results)
    return tuple(lines)


def stiffnesses(fit: FitResult) -> tuple[ParameterEstimate, ...]:
    """The parameters that a reader wants first: the free ones, or else the mesh stiffnesses."""
    free = tuple(p for p in fit.parameters.values() if p.free)
    return free or tuple(p for p in fit.parameters.values() if "mesh_stiffness" in p.name)


def _narrowed(fit: FitResult) -> list[str]:
    """Where no parameter is free: which of those with tolerances the data say something of."""
    known = [p for p in fit.parameters.values() if math.isfinite(p.prior_std)]
    if stiffnesses(fit) or not known:
        return []
    told = sorted((p for p in known if p.identified), key=lambda p: p.std / p.prior_std)
    if not told:
        return [
            f"The {len(known)} parameters are not identified one by one by these data: their tolerances decide."
        ]
    named = ", ".join(f"{words(p.name)} {format_value(p.value, p.std, p.unit)}" for p in told[:TOLD])
    more = f" and {len(told) - TOLD} more" if len(told) > TOLD else ""
    left = len(known) - len(told)
    rest = f"; the other {left} are not identified one by one, their tolerances decide" if left else ""
    return [f"Of {len(known)} parameters with tolerances the data narrow {named}{more}{rest}."]


def fails(fit: FitResult) -> bool:
    """True where the model does not fit, so that its values hold only for a model that lacks nothing."""
    return fit.error > POOR_ERROR


def identified_words(p: ParameterEstimate, fit: FitResult) -> str:
    """``"identified by the data"`` or why not."""
    if p.identified and fails(fit):
        return "provisional: the model does not explain the data"
    if p.identified:
        return "identified by the data"
    if p.free:
        return "not identified by the data" + (f": {p.note}" if p.note else "")
    return "not narrowed by the data: its tolerance decides"


def cautions(results: RunResults) -> tuple[str, ...]:
    """What to be careful about, one sentence each, the gravest first."""
    lines: list[str] = []
    fit = results.fit
    if fit is not None:
        if fails(fit):
            lines.append(
                f"The model does not explain the data (error {plain(fit.error, 3)}): "
                "fitted values and their uncertainties are provisional"
            )
        for p in fit.parameters.values():
            value = format_value(p.value, p.std, p.unit)
            if p.free and not p.identified:
                lines.append(
                    f"{words(p.name)} ({value}) is {identified_words(p, fit)}. Do not quote it as a result."
                )
            elif math.isfinite(p.shift_z) and abs(p.shift_z) > FAR_SIGMA:
                lines.append(
                    f"{words(p.name)} was fitted to {value}, {abs(p.shift_z):.1f} tolerances from "
                    f"its nominal {format_value(p.nominal, p.prior_std, p.unit)}: check the nominal value."
                )
        lines += _flat_sweeps(fit.sweeps)
    for c in results.configurations:
        lines += [f"{c.name}: {text}" for text in _cautions_of(c)]
    lines += results.warnings
    return _without_repeats([_sentence(line) for line in lines])


def _measured(c: ConfigurationResults) -> str:
    used = sum(h.accepted for h in c.hits)
    text = f"{c.name}: {used} of {len(c.hits)} hits used" if c.hits else f"{c.name}:"
    if c.frfs is not None:
        text += (
            f"{',' if c.hits else ''} {len(c.frfs.outputs)} responses × {len(c.frfs.inputs)} impact points"
        )
    if c.modal is None:
        return text + "; no modes identified yet."
    low, high = c.modal.band_hz
    text += "; " if c.hits or c.frfs is not None else " "
    text += _count(len(c.modal.modes), "mode")
    text += f" between {low:.4g} and {high:.5g} Hz" if math.isfinite(high) else " from a table"
    if c.pairing is not None:
        text += f", {len(c.pairing.pairs)} of them paired with the model"
    return text + "."


def _cautions_of(c: ConfigurationResults) -> list[str]:
    lines = []
    rejected = sum(not h.accepted for h in c.hits)
    if rejected:
        lines.append(f"{rejected} of {len(c.hits)} hits were left out")
    if c.frfs is not None:
        singles = int((c.frfs.hits == 1).sum())
        if singles:
            lines.append(
                f"{_count(singles, 'FRF')} rest on one hit: no coherence and no scatter to judge them by"
            )
        if not c.frfs.force_calibrated:
            lines.append("the hammer is not calibrated: FRFs and shapes have no absolute scale")
        lines += [v.message or f"{v.check} fails" for v in c.frfs.verdicts if not v.passes][:5]
    if c.modal is not None:
        if not c.modal.scaled and c.modal.dofs:
            lines.append(f"shapes are not mass-normalised: {c.modal.scaling_note or 'no driving point'}")
        lines += c.modal.notes
    if c.pairing is not None:
        lines += [
            f"measured mode {u.index + 1} at {u.frequency_hz:.5g} Hz has no model partner: {u.reason}"
            for u in c.pairing.unpaired_measured
        ]
        weak = [p for p in c.pairing.pairs if p.mac < LOW_MAC]
        if weak:
            named = ", ".join(f"{p.measured_frequency_hz:.5g} Hz ({below(p.mac, LOW_MAC)})" for p in weak[:6])
            more = f" and {len(weak) - 6} more" if len(weak) > 6 else ""
            lines.append(f"doubtful pairs with MAC under {LOW_MAC}: {named}{more}")
    return lines


def _flat_sweeps(sweeps: Sequence[ErrorSweep]) -> list[str]:
    """One sentence per stiffness whose error function determines nothing, over all its sweeps."""
    groups: dict[tuple[str, str], list[ErrorSweep]] = {}
    for s in sweeps:
        if not s.identified:
            groups.setdefault((s.parameter, s.configuration), []).append(s)
    lines = []
    for (parameter, configuration), mine in groups.items():
        counts = " or ".join(str(n) for n in sorted({s.mode_count for s in mine}))
        lines.append(
            f"ε of {words(parameter)} ({configuration}) determines nothing with {counts} modes: "
            f"{_flat_words(mine)}"
        )
    return lines


def _flat_words(sweeps: Sequence[ErrorSweep]) -> str:
    """How much ε changes over the sweeps, or why its minimum means nothing."""
    flat = [s for s in sweeps if s.note.startswith("flat")]
    if len(flat) == len(sweeps):
        changes = [
            100 * float((s.error.max() - s.error.min()) / max(float(s.error.min()), 1e-300)) for s in sweeps
        ]
        low, high = plain(min(changes), 2), plain(max(changes), 2)
        return f"it changes by {low if low == high else f'{low}–{high}'} % over the sweep"
    return "; ".join(dict.fromkeys(s.note for s in sweeps))


def _worst(results: RunResults) -> list[str]:
    compared = results.comparison
    assert compared is not None
    lines = []
    modes = [
        (abs(z), what, m)
        for m in compared.modes
        for what, z in (("frequency", m.frequency_z), ("damping", m.damping_z), ("shape", m.shape_z))
        if math.isfinite(z) and abs(z) > FAR_SIGMA
    ]
    if modes:
        z, what, m = max(modes, key=lambda t: t[0])
        lines.append(
            f"Largest difference in a mode: {what} of {m.measured_frequency_hz:.5g} Hz, "
            f"{m.configuration}, {plain(z, 2)}σ."
        )
    dofs = [d for d in compared.dofs if math.isfinite(d.z) and d.z > FAR_SIGMA]
    if dofs:
        d = max(dofs, key=lambda d: d.z)
        lines.append(f"Largest difference in shape: at {d.dof}, {d.configuration}, {plain(d.z, 2)}σ.")
    return lines


def _without_repeats(lines: list[str]) -> tuple[str, ...]:
    """Lines that differ only in DOFs and numbers are a kind: its first `SAME_KIND` lines stand for all."""
    kinds: dict[str, list[str]] = {}
    for line in dict.fromkeys(lines):
        kinds.setdefault(_DOF_OR_NUMBER.sub("#", line), []).append(line)
    shown = []
    for mine in kinds.values():
        rest = len(mine) - SAME_KIND
        shown += mine[:SAME_KIND] if rest > 1 else mine
        if rest > 1:
            shown[-1] += f" ({rest} more of this kind.)"
    return tuple(shown)


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}{'' if n == 1 else 's'}"


def _sentence(text: str) -> str:
    text = text.strip()
    return text if text.endswith((".", "!", "?")) else text + "."
