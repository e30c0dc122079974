"""What to be careful about in a run, one sentence each, the most serious first."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from enum import IntEnum

from ema_pipeline.check_result import CheckResult
from ema_pipeline.diagnose.sentences import not_explained
from ema_pipeline.fit.types import ErrorSweep, FitResult, ParameterEstimate
from ema_pipeline.frf.channel_faults import EXCHANGED, REVERSED, SENSITIVITY
from ema_pipeline.frf.points import POINT
from ema_pipeline.frf.signs import SIGN
from ema_pipeline.modal.types import GROWS
from ema_pipeline.number_text import below, format_value, plain
from ema_pipeline.report.name_text import words
from ema_pipeline.report.results import ConfigurationResults, RunResults
from ema_pipeline.report.thresholds import FAR_SIGMA, LOW_MAC

SAME_KIND = 2
"""Cautions of one kind that are written out; the rest is counted."""

_RINGING = 0.03
"""Share of a response left at the end of its record from which what is cut off biases modes beyond their uncertainty:
at 7 % a frequency was fifteen standard deviations off."""

_DOF_OR_NUMBER = re.compile(r"-?\b[A-Za-z]\w*\.[a-z]\w*|[\d.]*\d")


class Weight(IntEnum):
    """What a caution puts in doubt, from everything to a detail."""

    SENSOR = 0
    MISFIT = 1
    LEFT_OUT = 2
    VALUE = 3
    PAIR = 4
    SCALE = 5
    MODE = 6
    SCATTER = 7
    SWEEP = 8


def cautions(results: RunResults, lightest: Weight = Weight.SWEEP) -> tuple[str, ...]:
    """What to be careful about, one sentence each, the most serious first.

    Parameters
    ----------
    results : RunResults
    lightest : Weight
        Lighter ones are not told.
    """
    found = sorted((pair for pair in _all(results) if pair[0] <= lightest), key=lambda pair: pair[0])
    return _without_repeats([_sentence(text) for _, text in found])


def suspicions(results: RunResults) -> tuple[str, ...]:
    """Hits and channels that cannot be right: their point, sign, sensitivity or unit contradicts the rest of the test.

    Hits go first, as they make channels look wrong; what the model says of single channels goes before what two of them
    say of each other.
    """
    return tuple(map(_sentence, [*_suspected_hits(results), *_suspected_channels(results)]))


def suspect(results: RunResults) -> str:
    """``"A hit"`` or ``"A sensor"``, what is suspected first; empty for nothing."""
    if _suspected_hits(results):
        return "A hit"
    return "A sensor" if _suspected_channels(results) else ""


def _suspected_hits(results: RunResults) -> list[str]:
    return [
        _where(results, c) + v.message
        for c in results.configurations
        if c.frfs is not None
        for v in c.frfs.verdicts
        if not v.passes and v.check in (SIGN, POINT)
    ]


def _suspected_channels(results: RunResults) -> list[str]:
    found = [v.message for v in results.sensitivities]
    if not found:
        for c in results.configurations:
            verdicts = () if c.frfs is None else c.frfs.verdicts
            found += [_where(results, c) + v.message for v in verdicts if not v.passes and _of_sensor(v)]
    for c in results.configurations:
        peaks = [v for h in c.hits for v in h.verdicts if v.check == "force peak" and not v.passes]
        found += [_where(results, c) + v.message for v in peaks[:1]]
    return found


def identified_words(p: ParameterEstimate, provisional: bool) -> str:
    """``"identified by the data"`` or why not, see `RunResults.provisional`."""
    if p.identified and provisional:
        return "provisional: the model does not explain the data"
    if p.identified:
        return "identified by the data"
    if p.free:
        return "not identified by the data" + (f": {p.note}" if p.note else "")
    return "not narrowed by the data: its tolerance determines it"


def _where(results: RunResults, c: ConfigurationResults) -> str:
    """The configuration, where there are several."""
    return f"{c.name}: " if len(results.configurations) > 1 else ""


def _of_sensor(v: CheckResult) -> bool:
    """True for a check that a wrong sign, sensitivity or DOF fails."""
    return v.check in (SENSITIVITY, EXCHANGED) or (v.check == "driving point" and v.value > REVERSED)


def _all(results: RunResults) -> Iterator[tuple[Weight, str]]:
    for text in suspicions(results):
        yield Weight.SENSOR, text
    if results.missing_files:
        yield Weight.LEFT_OUT, _lost(results)
    if results.not_diagnosed:
        yield Weight.MISFIT, f"Nothing was diagnosed: {results.not_diagnosed}"
    if results.fit is not None:
        found = None if results.diagnosis_is_old else results.diagnosis
        # as the verdict states it, unless it is the fit alone that fails
        error = results.fit.error if found is None or found.error <= found.error_limit else found.error
        yield from _of_fit(results.fit, error, results.provisional)
    for c in results.configurations:
        for weight, text in _of_configuration(c):
            yield weight, _where(results, c) + text


def _lost(results: RunResults) -> str:
    """Files of results that were left behind or deleted, and how they are made anew."""
    first, *more = results.missing_files
    also = f" and {len(more)} more" if more else ""
    return (
        f"{first}{also} {'are' if more else 'is'} not in the folder, and what rests on that is left out below: "
        f"copy folder {results.folder} as a whole, or make it anew with ema run"
    )


def _of_fit(fit: FitResult, error: float, provisional: bool) -> Iterator[tuple[Weight, str]]:
    """Of the fitted values; `error` is that of the model."""
    if provisional:
        yield (
            Weight.MISFIT,
            f"{not_explained(plain(error, 3), error)}: fitted values and their uncertainties are provisional",
        )
    for p in fit.parameters.values():
        value = format_value(p.value, p.std, p.unit)
        if p.free and not p.identified:
            told = f"{words(p.name)} ({value}) is {identified_words(p, provisional)}. Do not quote it as a result."
            yield Weight.VALUE, told
        elif not provisional and math.isfinite(p.shift_z) and abs(p.shift_z) > FAR_SIGMA:
            yield (
                Weight.VALUE,
                f"{words(p.name)} was fitted to {value}, {abs(p.shift_z):.1f} tolerances from "
                f"its nominal {format_value(p.nominal, p.prior_std, p.unit)}: check the nominal value.",
            )
    for text in _flat_sweeps(fit.sweeps):
        yield Weight.SWEEP, text


def _of_configuration(c: ConfigurationResults) -> Iterator[tuple[Weight, str]]:
    yield from ((Weight.LEFT_OUT, text) for text in left_out(c))
    if ringing := _undecayed(c):
        yield Weight.VALUE, ringing
    if c.frfs is not None:
        if not c.frfs.force_calibrated:
            what = "force" if c.frfs.excitation else "hammer"
            yield Weight.SCALE, f"the {what} is not calibrated: FRFs and shapes have no absolute scale"
        for v in c.frfs.verdicts:
            if not v.passes and not _of_sensor(v) and v.check not in (SIGN, POINT):
                weight = Weight.PAIR if v.check == "driving point" else Weight.SCATTER
                yield weight, v.message or f"{v.check} fails"
        singles = int((c.frfs.hits == 1).sum())
        if singles:
            rests = "FRF rests" if singles == 1 else "FRFs rest"
            what = "average" if c.frfs.excitation else "hit"
            yield Weight.SCATTER, f"{singles} {rests} on one {what}: no coherence and no scatter to judge by"
    if c.modal is not None:
        growing = ", ".join(f"{x.frequency_hz:.5g}" for x in c.modal.left_out if x.reason == GROWS)
        if growing:
            told = f"left out at {growing} Hz: {GROWS}; correct exponential_window_rad_s in test.toml (0 if none)"
            yield Weight.LEFT_OUT, told
        if not c.modal.scaled and c.modal.dofs:
            yield Weight.SCALE, c.modal.scaling_note or "shapes are unscaled: no driving point"
        yield from ((Weight.SENSOR, note) for note in c.modal.sensor_notes)
        yield from ((Weight.MODE, note) for note in c.modal.notes if note != c.modal.scaling_note)
    if c.pairing is not None:
        for u in c.pairing.unpaired_measured:
            where = f"measured mode {u.index + 1} at {u.frequency_hz:.5g} Hz"
            yield Weight.PAIR, f"{where} has no model partner: {u.reason}"
        weak = [p for p in c.pairing.pairs if p.mac < LOW_MAC]
        if weak:
            named = ", ".join(f"{p.measured_frequency_hz:.5g} Hz ({below(p.mac, LOW_MAC)})" for p in weak[:6])
            more = f" and {len(weak) - 6} more" if len(weak) > 6 else ""
            yield Weight.PAIR, f"doubtful pairs with MAC under {LOW_MAC}: {named}{more}"


def left_out(c: ConfigurationResults) -> list[str]:
    """What was dropped, or should be: hits with the first reason, copies, channels with the hits that lack them."""
    rejected = [h for h in c.hits if not h.accepted]
    lines = []
    if rejected:
        lines.append(
            f"{len(rejected)} of {len(c.hits)} hits {'was' if len(rejected) == 1 else 'were'} left out, "
            f"{'' if len(rejected) == 1 else 'first '}{rejected[0].file}: {rejected[0].reason}"
        )
    copies = [v for h in c.hits for v in h.verdicts if v.check == "copy" and not v.passes]
    lines += list(dict.fromkeys(v.message for v in copies))
    dropped: dict[str, list[CheckResult]] = {}
    used = [h for h in c.hits if h.accepted]
    for h in used:
        for name in sorted(h.rejected_channels):
            dropped.setdefault(name, []).append(
                next(
                    v
                    for v in h.verdicts
                    if v.channel == name and v.consequence == "reject_channel" and not v.passes
                )
            )
    for name, verdicts in dropped.items():
        lines.append(
            f"channel '{name}' was left out of {len(verdicts)} of {len(used)} hits: {verdicts[0].message}"
        )
    return lines


def _undecayed(c: ConfigurationResults) -> str:
    """That most hits were still ringing at the end of their records; empty where they were not, or a window was."""
    used = [h for h in c.hits if h.accepted]
    worst_of_hits = (max(h.undecayed, key=lambda v: v.value) for h in used if h.rings_on)
    ringing = [v for v in worst_of_hits if v.value > _RINGING]
    if 2 * len(ringing) <= len(used) or (c.frfs is not None and c.frfs.response_decay_rad_s):
        return ""
    worst = max(ringing, key=lambda v: v.value)
    return (
        f"{len(ringing)} of {len(used)} hits still ring at the end of their records ({worst.message}): the fit of "
        "modes takes that into account, but their damping is known less well"
    )


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


def _without_repeats(lines: Iterable[str]) -> tuple[str, ...]:
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


def _sentence(text: str) -> str:
    text = text.strip()
    return text if text.endswith((".", "!", "?")) else text + "."
