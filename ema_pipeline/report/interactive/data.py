"""What the interactive figures show, as plain JSON: what was measured, and what the models make of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.types import Comparison, ModeDifference
from ema_pipeline.diagnose.types import Ladder
from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.levels.types import LevelStudy
from ema_pipeline.mechanics.partial_fractions import partial_fractions
from ema_pipeline.mechanics.system import LinearSystem, sensor_rows
from ema_pipeline.modal.assurance import auto_mac
from ema_pipeline.modal.circle import on_circle
from ema_pipeline.modal.types import CircleFit, ModalModel, Mode
from ema_pipeline.number_text import format_percent, format_value, plain
from ema_pipeline.report.diagnosis import label_words, rung_words
from ema_pipeline.report.interactive.loops import loop_model_names, loops_data, loss_data
from ema_pipeline.report.interactive.packing import POINTS, packed_cmif, packed_frfs
from ema_pipeline.report.levels import has_to_say
from ema_pipeline.report.name_text import words
from ema_pipeline.report.results import ConfigurationResults, RunResults
from ema_pipeline.report.shapes import shape_pair
from ema_pipeline.report.shown_band import places, shown_to

CIRCLES = 4
"""Nyquist circles of a mode that are shown."""

MOVED = 12
"""Parts and parameters that are shown with how far they moved."""

_MARGIN = 1.1


def measured_data(results: RunResults, points: int | None = POINTS) -> dict[str, Any]:
    """Everything that no change of the model moves.

    Parameters
    ----------
    results : RunResults
    points : int or None
        FRF lines that are kept at most over all configurations; None keeps all.
    """
    with_frfs = sum(c.frfs is not None for c in results.configurations)
    share = None if points is None else points // max(with_frfs, 1)
    return {"configurations": [_measured(c, share) for c in results.configurations]}


def model_data(results: RunResults) -> dict[str, Any]:
    """What the models say: their FRFs, differences mode by mode, pairs, shapes and the ladder."""
    return {
        "models": model_names(results),
        "frfs": {c.name: _models(results, c) for c in results.configurations if c.frfs is not None},
        "errors": _errors(results),
        "lone": _lone(results),
        "moved": _moved(results),
        "shapes": {c.name: _shapes(c) for c in results.configurations if c.modal},
        "mac": {c.name: _pairing_mac(c) for c in results.configurations if c.pairing and c.pairing.mac.size},
        "ladder": ladder_data(results.shown_ladder),
        "sweeps": _sweeps(results),
        "loops": loops_data(results.loops),
        "loss": loss_data(results.loops),
    }


def model_names(results: RunResults) -> list[str]:
    """Names of the models that stand beside each other, the base model first."""
    if results.loops is not None:
        return loop_model_names(results.loops)
    named = ["base model" if results.fit is not None else "model at nominal values"]
    if results.added:
        named.append("with " + " + ".join(map(label_words, results.added)))
    found = results.diagnosis
    if results.comparison_after is not None and found is not None and found.ladder.rungs[-1].effects:
        proposed = " + ".join(map(label_words, found.ladder.rungs[-1].effects))
        if found.ladder.rungs[-1].effects != results.added:
            named.append(f"with {proposed} (proposed)")
    return named


def compared(results: RunResults) -> list[Comparison | None]:
    """The comparisons that belong to `model_names`."""
    if results.added:
        every = [results.comparison_base, results.comparison, results.comparison_after]
    else:
        every = [results.comparison, results.comparison_after]
    return every[: len(model_names(results))]


def _systems(results: RunResults, c: ConfigurationResults) -> list[LinearSystem | None]:
    first = c.base_system if c.base_system is not None else c.system
    every = [first, c.system, c.system_after] if results.added else [first, c.system_after]
    return every[: len(model_names(results))]


def _moved(results: RunResults) -> dict[str, Any]:
    """What every model had to assume: the parts, channels and parameters that moved farthest, in σ."""
    base, current, proposed = results.deviations
    every = ([base, current, proposed] if results.added else [base, proposed])[: len(model_names(results))]
    worst: dict[str, float] = {}
    for moved in every:
        for name, z in moved.items():
            worst[name] = max(worst.get(name, 0.0), abs(z))
    names = sorted(worst, key=lambda n: -worst[n])[:MOVED]
    return {
        "names": [words(n) for n in names],
        "models": [[_number(m[n]) if n in m else None for n in names] for m in every],
    }


def _measured(c: ConfigurationResults, points: int | None) -> dict[str, Any]:
    found: dict[str, Any] = {"name": c.name, "modes": [], "frfs": None, "chart": None, "auto_mac": None}
    if c.frfs is not None:
        high = shown_up_to(c)
        found["frfs"] = packed_frfs(c.frfs, high, points)
        found["shown_to"] = shown_to(high, places(c.modal))
        found["cmif"] = packed_cmif(c.frfs, high)
    if c.modal is not None:
        modal = c.modal
        found["modes"] = [_mode(k, m) for k, m in enumerate(modal.modes)]
        found["scale"] = "N" if c.frfs is None or c.frfs.force_calibrated else "V"
        if modal.chart.order.size:
            found["chart"] = {
                "order": modal.chart.order.tolist(),
                "f": _rounded(modal.chart.frequency_hz, 6),
                "damping": _rounded(100 * modal.chart.damping_ratio, 3),
                "stable": modal.chart.stable.astype(int).tolist(),
                "mode": modal.chart.selected.tolist(),
            }
        if modal.modes and modal.dofs:
            found["auto_mac"] = _matrix(auto_mac(np.array([m.shape for m in modal.modes])))
    if c.levels is not None and c.modal is not None and has_to_say(c.levels):
        found["levels"] = _levels(c.levels, c.modal)
    return found


def shown_up_to(c: ConfigurationResults) -> float:
    """Highest frequency that FRFs are kept at, Hz; figures begin with less of it, see `shown_band`."""
    assert c.frfs is not None
    ends = [c.frfs.band_hz[1]] if c.modal is None else [c.modal.band_hz[1]]
    if c.modal is not None and c.modal.modes:
        ends.append(_MARGIN * max(m.frequency_hz for m in c.modal.modes))
    finite = [e for e in ends if math.isfinite(e)]
    return max(finite) if finite else float(c.frfs.frequency_hz[-1])


def _mode(k: int, mode: Mode) -> dict[str, Any]:
    return {
        "f": mode.frequency_hz,
        "title": f"mode {k + 1}: {format_value(mode.frequency_hz, mode.frequency_std_hz, 'Hz')}, "
        f"ζ = {format_percent(mode.damping_ratio, mode.damping_std)}",
        "circles": [_circle(mode, c) for c in mode.circles[:CIRCLES]],
    }


def _circle(mode: Mode, circle: CircleFit) -> dict[str, Any]:
    """Points, circle, and where the pole's frequency lies on it."""
    mark = None
    lines = circle.frequency_hz
    if lines.size > 1 and lines[0] <= mode.frequency_hz <= lines[-1]:
        at = on_circle(circle, mode.frequency_hz)
        mark = [at.real, at.imag]
    return {
        "name": f"{circle.output.point} ← {circle.input.point}",
        "text": f"circle: {format_value(circle.natural_frequency_hz, circle.natural_frequency_std_hz, 'Hz')}, "
        f"ζ = {format_percent(circle.damping_ratio, circle.damping_std)}, misfit {plain(100 * circle.residual, 2)} % "
        "of the radius",
        "f": _rounded(lines, 7),
        "re": _rounded(circle.points.real, 5),
        "im": _rounded(circle.points.imag, 5),
        "centre": [circle.centre.real, circle.centre.imag],
        "radius": circle.radius,
        "mark": mark,
    }


def _models(results: RunResults, c: ConfigurationResults) -> list[dict[str, Any]]:
    """FRFs of every model, with every part's own deviation (``own``) and with like parts alike (``alike``)."""
    assert c.frfs is not None
    base, current, proposed = c.like_parts
    alike = ([base, current, proposed] if results.added else [base, proposed])[: len(model_names(results))]
    return [
        {
            "own": None if own is None else _fractions(own, c.frfs),
            "alike": None if like is None else _fractions(like, c.frfs),
        }
        for own, like in zip_longest(_systems(results, c), alike)
    ]


def _fractions(system: LinearSystem, frfs: FrfSet) -> dict[str, Any] | None:
    """A model's FRFs as sums over its poles; DOFs that it does not have give no FRF."""
    outputs, inputs = (_known_rows(system, dofs) for dofs in (frfs.outputs, frfs.inputs))
    try:
        found = partial_fractions(system, np.nan_to_num(outputs), np.nan_to_num(inputs))
    except (EmaError, np.linalg.LinAlgError):
        return None
    scale = np.ones(len(inputs))
    if not frfs.force_calibrated:  # volts have a scale of their own: that which fits best
        step = max(1, frfs.frequency_hz.size // 400)
        lines = slice(step, None, step)
        f = frfs.frequency_hz[lines]
        model = np.abs((2 * np.pi * f) ** 2 * found.receptance(f))
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.abs(frfs.accelerance(lines)) / model
        ratio[~np.isfinite(ratio)] = np.nan
        scale = np.nan_to_num(np.nanmedian(ratio, axis=(0, 2)), nan=1.0)
    there = [[bool(np.isfinite(row).all()) for row in rows] for rows in (outputs, inputs)]
    return {
        "poles": _complex(found.poles),
        "outputs": [
            _complex(row) if known else None for row, known in zip(found.outputs, there[0], strict=True)
        ],
        "inputs": [
            _complex(row * s) if known else None
            for row, known, s in zip(found.inputs, there[1], scale, strict=True)
        ],
    }


def _known_rows(system: LinearSystem, dofs: Sequence[Dof]) -> NDArray[np.float64]:
    """Rows of DOFs, NaN where the system has none."""
    rows = []
    for dof in dofs:
        known = dof.point in system.dofs or dof.point in system.sensors
        rows.append(sensor_rows(system, [dof])[0] if known else np.full(len(system.dofs), np.nan))
    return np.array(rows).reshape(len(rows), len(system.dofs))


def _errors(results: RunResults) -> dict[str, Any]:
    """Differences mode by mode in σ, for every model; modes are those of the first comparison that has them."""
    every = compared(results)
    keys: dict[tuple[str, int], str] = {}
    order = [c.name for c in results.configurations]
    for comparison in every:
        for m in comparison.modes if comparison else ():
            keys.setdefault(
                (m.configuration, m.measured), f"{m.measured + 1}: {m.measured_frequency_hz:.5g} Hz"
            )
    sorted_keys = sorted(keys, key=lambda k: (order.index(k[0]) if k[0] in order else 0, k[1]))
    quantities: Mapping[str, str] = {"frequency": "frequency_z", "damping": "damping_z", "shape": "shape_z"}
    models = []
    for comparison in every:
        by_mode = {(m.configuration, m.measured): m for m in (comparison.modes if comparison else ())}
        models.append(
            {q: [_z(by_mode.get(k), field) for k in sorted_keys] for q, field in quantities.items()}
        )
    several = len(order) > 1
    return {
        "modes": [[k[0], keys[k]] if several else ["", keys[k]] for k in sorted_keys],
        "models": models,
        "error": [None if c is None else _number(c.error) for c in every],
    }


def _lone(results: RunResults) -> list[list[Any]]:
    several = len(results.configurations) > 1
    return [
        [c.name if several else "", f"{u.index + 1}: {u.frequency_hz:.5g} Hz", u.reason]
        for c in results.configurations
        if c.pairing is not None
        for u in c.pairing.unpaired_measured
    ]


def _z(mode: ModeDifference | None, field: str) -> float | None:
    return None if mode is None else _number(abs(getattr(mode, field)))


def _shapes(c: ConfigurationResults) -> list[dict[str, Any]]:
    """Measured and model shape of every mode, over the measured DOFs."""
    assert c.modal is not None
    if not c.modal.dofs:
        return []
    found = []
    for k in range(len(c.modal.modes)):
        pair = shape_pair(c, k)
        model = None
        if pair.model is not None:
            model = [_number(pair.model.get(d, complex("nan")).real) for d in pair.measured]
        found.append(
            {
                "dofs": list(pair.measured),
                "value": [_number(v.real) for v in pair.measured.values()],
                "std": [_number(pair.std[d]) for d in pair.measured],
                "model": model,
            }
        )
    return found


def _pairing_mac(c: ConfigurationResults) -> dict[str, Any]:
    assert c.pairing is not None
    return {
        "values": _matrix(c.pairing.mac),
        "model": [f"{k + 1}: {m.frequency_hz:.5g}" for k, m in enumerate(c.pairing.model_modes)],
        "pairs": [[p.measured, p.model] for p in c.pairing.pairs],
    }


def ladder_data(ladder: Ladder | None) -> list[dict[str, Any]]:
    """One entry per rung: what it adds, and its errors."""
    if ladder is None:
        return []
    befores: list[tuple[str, ...]] = [(), *(r.effects for r in ladder.rungs[:-1])]
    return [
        {
            "name": rung_words(before, r.effects),
            "error": _number(r.error),
            "held": _number(r.heldout_error),
            "unexplained": r.unexplained,
        }
        for before, r in zip(befores, ladder.rungs, strict=True)
    ]


def _levels(study: LevelStudy, modal: ModalModel) -> list[dict[str, Any]]:
    force = np.array([level.force_n for level in study.levels])
    found = []
    for m in study.modes:
        base = m.frequency_hz[np.isfinite(m.frequency_hz)]
        if len(study.levels) < 2 or not base.size:
            continue
        change = 100 * (m.frequency_hz / base[0] - 1)
        std = 100 * m.frequency_std_hz / base[0]
        title = (
            f"mode {m.mode + 1}, {modal.modes[m.mode].frequency_hz:.5g} Hz"
            if m.mode < len(modal.modes)
            else ""
        )
        found.append(
            {
                "title": title + (f": {m.trend}" if m.trend else ""),
                "depends": bool(m.depends),
                "force": _rounded(force, 4),
                "change": _rounded(change, 4),
                "std": _rounded(std, 3),
            }
        )
    return found


def _sweeps(results: RunResults) -> list[dict[str, Any]]:
    if results.fit is None:
        return []
    return [
        {
            "text": f"{words(s.parameter)}, {s.configuration}, {s.mode_count} modes",
            "x": _rounded(s.values, 5),
            "y": _rounded(s.error, 5),
        }
        for s in results.fit.sweeps
    ]


def _number(value: float) -> float | None:
    return float(f"{value:.5g}") if math.isfinite(value) else None


def _rounded(values: NDArray[np.float64], figures: int) -> list[float | None]:
    return [float(f"{v:.{figures}g}") if math.isfinite(v) else None for v in values]


def _matrix(values: NDArray[np.float64]) -> list[list[float | None]]:
    return [_rounded(row, 4) for row in values]


def _complex(values: NDArray[np.complex128]) -> list[list[float]]:
    return [[float(f"{v:.9g}") for v in part] for part in (values.real, values.imag)]
