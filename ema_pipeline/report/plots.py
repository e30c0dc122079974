"""Figures for print: which a run has, drawn on demand as PNG and SVG."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from matplotlib.figure import Figure

from ema_pipeline.files import replace_file
from ema_pipeline.frf.overview import representative_frfs
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.report import style
from ema_pipeline.report.figures import (
    comparison,
    diagnosis,
    fit,
    frf,
    levels,
    mac,
    modes,
    nyquist,
    shapes,
)
from ema_pipeline.report.levels import has_to_say
from ema_pipeline.report.name_text import slug
from ema_pipeline.report.results import ConfigurationResults, RunResults
from ema_pipeline.report.shapes import drawing_for

LEVEL_SHEETS = 8
"""Modes that move with the force and get a sheet of their own."""

Format = Literal["png", "svg"]
Progress = Callable[[int, int, str], None]
"""Called with the number of figures done, their total, and the name of the one just drawn."""


@dataclass(frozen=True)
class FigureSpec:
    """A figure before it is drawn.

    Attributes
    ----------
    name : str
        Stem of its file names; stays the same from run to run.
    section : str
        Part of the report, e.g. ``"frf"``, ``"nyquist"``.
    configuration : str
        Empty for figures over all configurations.
    caption : str
        What it shows, in words; the text for readers who cannot see it.
    draw : callable
        Returns the figure.
    """

    name: str
    section: str
    configuration: str
    caption: str
    draw: Callable[[], Figure]


@dataclass(frozen=True)
class Plot:
    """A drawn figure: the bytes of its files by format."""

    spec: FigureSpec
    files: dict[Format, bytes]


def figure_specs(results: RunResults) -> tuple[FigureSpec, ...]:
    """All figures that these results allow, in the order of the report."""
    specs: list[FigureSpec] = [*_diagnosed(results)]
    for configuration in results.configurations:
        specs += _measured(configuration)
    specs += _fitted(results)
    return tuple(specs)


def render(
    results: RunResults, formats: Collection[Format] = ("png", "svg"), progress: Progress | None = None
) -> tuple[Plot, ...]:
    """Draw all figures.

    Parameters
    ----------
    results : RunResults
    formats : collection of {"png", "svg"}
    progress : callable or None
    """
    specs = figure_specs(results)
    plots = []
    for number, spec in enumerate(specs, start=1):
        plots.append(_render(spec, formats))
        if progress is not None:
            progress(number, len(specs), spec.name)
    return tuple(plots)


def write_plots(
    results: RunResults, folder: str | Path, progress: Progress | None = None
) -> tuple[Plot, ...]:
    """Draw all figures and write each as ``<name>.png`` and ``<name>.svg`` into `folder`.

    Figures of an earlier run that this one no longer has are removed (those that ``figures.txt`` names).

    """
    target = Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    index = target / "figures.txt"
    before = set(index.read_text(encoding="utf-8").split()) if index.is_file() else set()
    plots = render(results, progress=progress)
    names = []
    for plot in plots:
        for suffix, content in plot.files.items():
            names.append(f"{plot.spec.name}.{suffix}")
            replace_file(target / names[-1], content)
    for stale in before - set(names):
        # names come from a file that a user can edit: never leave the folder
        if Path(stale).name == stale and stale.endswith((".png", ".svg")):
            (target / stale).unlink(missing_ok=True)
    replace_file(index, "\n".join(names) + "\n")
    return plots


def _render(spec: FigureSpec, formats: Collection[Format]) -> Plot:
    figure = spec.draw()
    files: dict[Format, bytes] = {}
    if "png" in formats:
        files["png"] = style.png(figure)
    if "svg" in formats:
        files["svg"] = style.svg(figure)
    return Plot(spec, files)


def _chunks(count: int, size: int) -> Iterator[list[int]]:
    for start in range(0, count, size):
        yield list(range(start, min(start + size, count)))


def _diagnosed(results: RunResults) -> Iterator[FigureSpec]:
    found, ladder = results.diagnosis, results.shown_ladder
    if found is not None and results.comparison is not None and results.comparison.modes:
        yield FigureSpec(
            "diagnosis_where",
            "diagnosis",
            "",
            "Where the model fails: the largest difference of every mode, and of the shapes on the rig's drawing",
            partial(
                diagnosis.where_it_fails,
                results.comparison,
                [drawing_for(c) for c in results.configurations],
                {c.name: c.pairing.unpaired_measured for c in results.configurations if c.pairing},
                results.comparison_after,
            ),
        )
    if found is not None:
        yield FigureSpec(
            "diagnosis_candidates",
            "diagnosis",
            "",
            "What may be missing: probabilities of the candidates and of nothing missing",
            partial(diagnosis.candidate_probabilities, found),
        )
    if ladder is not None and ladder.rungs:
        yield FigureSpec(
            "diagnosis_ladder",
            "diagnosis",
            "",
            "Error of the models rung by rung, on the data fitted and on data held out",
            partial(diagnosis.ladder_errors, ladder),
        )


def _measured(configuration: ConfigurationResults) -> Iterator[FigureSpec]:
    frfs, modal, pairing = configuration.frfs, configuration.modal, configuration.pairing
    name = configuration.name
    stem = slug(name)
    if frfs is not None:
        picks = representative_frfs(frfs)
        for n, chunk in enumerate(_chunks(len(picks), frf.FRFS_PER_SHEET), start=1):
            chosen = [picks[k] for k in chunk]
            which = " and ".join(f"{frfs.outputs[o].point} ← {frfs.inputs[i].point}" for o, i in chosen)
            yield FigureSpec(
                f"{stem}_frf_{n}",
                "frf",
                name,
                f"FRFs {which}: magnitude, phase and coherence, with the modal model",
                partial(frf.frf_sheet, frfs, modal, chosen),
            )
        yield FigureSpec(
            f"{stem}_frf_all",
            "frf",
            name,
            "All FRFs over one another, and the complex mode indicator function",
            partial(frf.frf_overview, frfs, modal),
        )
    if modal is None:
        return
    calibrated = frfs.force_calibrated if frfs is not None else True
    for i, mode in enumerate(modal.modes):
        if mode.circles:
            caption = f"Nyquist circles of mode {i + 1} at {mode.frequency_hz:.5g} Hz in its best FRFs"
            draw = partial(nyquist.nyquist_sheet, modal, i, calibrated)
            yield FigureSpec(f"{stem}_nyquist_{i + 1:02d}", "nyquist", name, caption, draw)
    yield from _levels(configuration, modal, stem)
    if modal.chart.order.size or frfs is not None:
        yield FigureSpec(
            f"{stem}_stabilisation",
            "stabilisation",
            name,
            "Stabilisation chart: poles of all model orders over the CMIF",
            partial(modes.stabilisation_chart, modal, frfs),
        )
    if modal.modes:
        yield FigureSpec(
            f"{stem}_modes",
            "modes",
            name,
            "Natural frequencies and damping ratios with their uncertainty",
            partial(modes.modes_overview, modal),
        )
    if modal.modes and modal.dofs:
        yield FigureSpec(
            f"{stem}_mac_measured",
            "pairing",
            name,
            "MAC of the measured modes with each other",
            partial(mac.auto_mac_matrix, modal),
        )
    if pairing is not None:
        yield FigureSpec(
            f"{stem}_pairing",
            "pairing",
            name,
            "Measured against model frequencies of the pairs, and their deviation",
            partial(mac.pairing_plot, pairing, modal),
        )
        yield FigureSpec(
            f"{stem}_mac_model",
            "pairing",
            name,
            "MAC of measured with model modes; pairs are framed",
            partial(mac.pairing_mac_matrix, pairing, modal),
        )
    yield from _shapes(configuration, stem)


def _levels(configuration: ConfigurationResults, modal: ModalModel, stem: str) -> Iterator[FigureSpec]:
    study = configuration.levels
    if study is None or not has_to_say(study):
        return
    if len(study.levels) > 1:
        yield FigureSpec(
            f"{stem}_levels",
            "levels",
            configuration.name,
            "Change of every mode's frequency and damping with the force, from the softest level",
            partial(levels.all_modes, study, modal),
        )
    moving = [k for k, m in enumerate(study.modes) if m.depends][:LEVEL_SHEETS]
    for k in moving:
        yield FigureSpec(
            f"{stem}_levels_mode_{study.modes[k].mode + 1:02d}",
            "levels",
            configuration.name,
            levels.caption(study, modal, k),
            partial(levels.moving_mode, study, modal, k),
        )


def _shapes(configuration: ConfigurationResults, stem: str) -> Iterator[FigureSpec]:
    modal = configuration.modal
    assert modal is not None
    drawing = drawing_for(configuration)
    size = shapes.DRAWN_MODES_PER_SHEET if drawing else shapes.STEM_MODES_PER_SHEET
    for n, chunk in enumerate(_chunks(len(modal.modes), size), start=1):
        caption = f"Shapes of modes {chunk[0] + 1} to {chunk[-1] + 1}"
        if drawing is not None:
            yield FigureSpec(
                f"{stem}_shapes_{n}",
                "shapes",
                configuration.name,
                caption + " on the moved rig",
                partial(shapes.drawn_shapes, configuration, drawing, chunk),
            )
        else:
            yield FigureSpec(
                f"{stem}_shapes_{n}",
                "shapes",
                configuration.name,
                caption + " over the DOFs",
                partial(shapes.stem_shapes, configuration, chunk),
            )


def _fitted(results: RunResults) -> Iterator[FigureSpec]:
    found, compared = results.fit, results.comparison
    if found is not None:
        if found.sweeps:
            yield FigureSpec(
                "error_function",
                "error_function",
                "",
                "Error function ε over the mesh stiffnesses",
                partial(fit.error_sweeps, found.sweeps),
            )
        yield FigureSpec(
            "fit_parameters",
            "fit",
            "",
            "Fitted parameters against their nominal values and tolerances",
            partial(fit.parameter_forest, found),
        )
        if len(found.names) > 1:
            yield FigureSpec(
                "fit_correlation",
                "fit",
                "",
                "Correlation of the fitted parameters",
                partial(fit.correlation_matrix, found),
            )
    if compared is None:
        return
    if compared.modes:
        yield FigureSpec(
            "comparison_modes",
            "comparison",
            "",
            "Frequency, damping and shape differences per mode, in σ",
            partial(comparison.mode_differences, compared.modes),
        )
    drawings = {c.name: drawing_for(c) for c in results.configurations}
    for name in dict.fromkeys(d.configuration for d in compared.dofs):
        mine = [d for d in compared.dofs if d.configuration == name]
        yield FigureSpec(
            f"comparison_{slug(name)}_dofs",
            "comparison",
            name,
            f"{name}: shape difference per DOF, in σ",
            partial(comparison.dof_differences, mine, drawings.get(name)),
        )
    for name in dict.fromkeys(b.configuration for b in compared.bands):
        yield FigureSpec(
            f"comparison_{slug(name)}_frfs",
            "comparison",
            name,
            f"{name}: FRF difference per band, in σ",
            partial(comparison.band_differences, compared.bands, name),
        )
