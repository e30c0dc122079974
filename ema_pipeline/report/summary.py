"""The run in plain sentences: what was found, what was fitted, and what to be careful about."""

from __future__ import annotations

import math

from ema_pipeline.correlate.types import Pairing
from ema_pipeline.fit.types import FitResult, ParameterEstimate
from ema_pipeline.inference import ERROR_LIMIT
from ema_pipeline.number_text import counted, format_value, plain
from ema_pipeline.report import diagnosis
from ema_pipeline.report.cautions import cautions, identified_words, suspect, suspicions
from ema_pipeline.report.commands import command
from ema_pipeline.report.levels import has_to_say
from ema_pipeline.report.name_text import words
from ema_pipeline.report.results import ConfigurationResults, RunResults
from ema_pipeline.report.simulation import error_lines, loop_words
from ema_pipeline.report.thresholds import FAR_SIGMA, LOW_MAC

__all__ = ["cautions", "findings", "identified_words", "stiffnesses"]

TOLD = 6
"""Narrowed parameters that are named."""
_SAME_ERROR = 1.01
"""The ladder's error over the fit's up to which both are the same, but for where their searches end."""


def findings(results: RunResults) -> tuple[str, ...]:
    """What was measured and how well the model follows it, one sentence each."""
    lines: list[str] = []
    if doubted := suspect(results):
        lines.append(
            f"{doubted} is suspected, see the cautions: all that follows is valid only if it is right."
        )
    if results.diagnosis is not None:
        lines += [] if not results.diagnosis_is_old else [changed_words(results)]
        lines.append(diagnosis.compact(results.diagnosis))
    lines += [_measured(c) for c in results.configurations]
    lines += [f"{line}." for line in error_lines(results.simulation)]
    lines += [loop_words(loop) for loop in results.hysteresis]
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
        lines += _other_error(results, fit)
        lines += _narrowed(fit)
    if compared is not None and math.isfinite(compared.error):
        size = plain(compared.error, 3)
        verdict = None if results.diagnosis is None else results.diagnosis.verdict
        explained = compared.error <= (ERROR_LIMIT if fit is None else fit.error_limit)
        if explained and verdict in ("effect", "ambiguous"):
            lines.append(
                f"Model and measurement differ by {size} standard uncertainties (root mean square); "
                "the diagnosis above says what would reduce this."
            )
        elif explained and verdict == "unknown_effect" and not results.diagnosis_is_old:
            lines.append(
                f"Model and measurement differ by {size} standard uncertainties (root mean square); "
                "the diagnosis above says why the model fails all the same."
            )
        elif explained:
            lines.append(
                f"Model and measurement differ by {size} standard uncertainties (root mean square): "
                "the model explains the data to within their uncertainty."
            )
        else:
            lines.append(
                f"Model and measurement differ by {size} standard uncertainties (root mean square): "
                "more than the measurement's uncertainty explains."
            )
            lines += _worst(results)
    return tuple(lines)


def changed_words(results: RunResults) -> str:
    """What was added or taken out since the diagnosis, and what that brought."""
    named = " and ".join(diagnosis.label_words(x) for x in results.added)
    error = "" if results.fit is None else f" (error {plain(results.fit.error, 3)})"
    now = f"The model now includes {named}{error}" if named else f"The model now has no added effects{error}"
    if results.added == results.diagnosed_on:
        changed = f"Other hits or modes were chosen{error}"
        return f"{changed}; the diagnosis is older: 'ema diagnose' repeats it."
    before = " and ".join(diagnosis.label_words(x) for x in results.diagnosed_on)
    of = f"the model with {before}" if before else "the base model"
    return f"{now}; the diagnosis is of {of}: 'ema diagnose' repeats it."


def commands_left(results: RunResults, out: str) -> tuple[str, ...]:
    """What to type next: what the diagnosis proposes, or after a change the diagnosis again, or the change back.

    None without a diagnosis, and where a hit or a sensor is suspected: the test comes first.
    """
    if results.diagnosis is None or suspicions(results):
        return ()
    files = results.effect_files
    if not results.diagnosis_is_old:
        return diagnosis.next_commands(results.diagnosis, out, results.added, files)
    back = [command("remove", out, results.added[-1], effect_files=files)] if results.added else []
    return (command("diagnose", out, effect_files=files), *back)


def _other_error(results: RunResults, fit: FitResult) -> list[str]:
    """Why the ladder states another error than the fit for the same model; nothing where it does not."""
    ladder, rung = results.shown_ladder, results.current_rung
    if ladder is None or rung is None or not diagnosis.of_modes(ladder):
        return []
    if not rung.error > _SAME_ERROR * fit.error:
        return []
    of_hits = any(c.levels is not None and c.levels.hit_modes is not None for c in results.configurations)
    hits = ", and single hits count, too" if of_hits else ""
    return [
        f"Diagnosis and ladder state an error of {plain(rung.error, 3)} for this model: in them no part deviates "
        f"further than similar ones scatter{hits}."
    ]


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
            f"The {len(known)} parameters are not identified individually by these data: their tolerances "
            "determine them."
        ]
    named = ", ".join(f"{words(p.name)} {format_value(p.value, p.std, p.unit)}" for p in told[:TOLD])
    more = f" and {len(told) - TOLD} more" if len(told) > TOLD else ""
    left = len(known) - len(told)
    rest = (
        f"; the other {left} are not identified individually, their tolerances determine them" if left else ""
    )
    return [f"Of {len(known)} parameters with tolerances the data narrow {named}{more}{rest}."]


def _measured(c: ConfigurationResults) -> str:
    used = sum(h.accepted for h in c.hits)
    text = f"{c.name}: {used} of {len(c.hits)} hits used" if c.hits else f"{c.name}:"
    if c.frfs is not None:
        text += (
            f"{',' if c.hits else ''} {counted(len(c.frfs.outputs), 'response')} × "
            f"{counted(len(c.frfs.inputs), 'force' if c.frfs.excitation else 'impact point')}"
        )
    if c.modal is None:
        return text + "; no modes identified yet."
    low, high = c.modal.band_hz
    text += "; " if c.hits or c.frfs is not None else " "
    text += counted(len(c.modal.modes), "mode")
    text += f" between {low:.4g} and {high:.5g} Hz" if math.isfinite(high) else " from a table"
    if c.pairing is not None:
        text += f", {paired_words(c.pairing)}"
    return text + "."


def paired_words(pairing: Pairing) -> str:
    """How many modes have a model partner, and how many of these pairs are doubtful."""
    weak = sum(p.mac < LOW_MAC for p in pairing.pairs)
    doubtful = f", {weak} of these doubtfully" if weak else ""
    return f"{len(pairing.pairs)} of them paired with the model{doubtful}"


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
