"""What is taken from a results folder: report, fitted rig, and FRFs, modes and shapes for other programs."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ema_pipeline.errors import EmaError
from ema_pipeline.files import refuse_existing, replace_file
from ema_pipeline.fit.types import FitResult
from ema_pipeline.kinds import kind_of, stages_of
from ema_pipeline.pipeline import ShowStage
from ema_pipeline.run.opening import existing_run
from ema_pipeline.run.types import Run
from ema_pipeline.store import ALL, Store


def report_path(out: Path) -> Path:
    """The report of a results folder.

    Raises
    ------
    EmaError
        If there is none.
    """
    path = Store.existing(out).folder / "report.html"
    if not path.is_file():
        raise EmaError(f"{path}: there is no report yet; write it with 'ema report {out}'")
    return path.resolve()


def check_rig_file(run: Run, file: Path) -> None:
    """Whether the model of a run can be saved as this rig file, before it is fitted.

    Raises
    ------
    EmaError
        If the model is not fitted to modes, or the file exists already.
    """
    if "fit" not in stages_of(run):
        words = kind_of(run.info).words
        raise EmaError(f"{file}: models of {words} are not saved; copy the values that 'ema fit' shows")
    refuse_existing([file], "name another file")


def save_rig(run: Run, file: Path) -> None:
    """Write the fitted model of a run as a rig file.

    Raises
    ------
    EmaError
        If the model is not fitted to modes, nothing has been fitted yet, the file exists already, or it cannot be
        written.
    """
    from ema_pipeline.fit.saved_rig import saved_rig

    check_rig_file(run, file)
    fit = run.store.load("fit", ALL, "fit", FitResult)
    heads = [f"Fitted by ema to {run.info.raw}; tolerances are the values' own uncertainties, 1 sigma."]
    if fit.error > fit.error_limit:
        heads.append(f"Provisional: the model does not explain the data (error {fit.error:.3g}).")
    try:
        replace_file(file, saved_rig(run.info.rig, fit, heads))
    except OSError as error:
        raise EmaError(f"{file}: cannot be written ({error.strerror}); name another file") from None


def draw_plots(run: Run, show: ShowStage | None = None) -> Path:
    """Draw every figure of a run for print, as PNG and SVG; returns their folder."""
    from ema_pipeline.stages.report import draw

    if show is None:
        return draw(run)
    with show("plots") as progress:
        return draw(run, progress)


def write_pages(run: Run, show: ShowStage | None = None) -> Path:
    """Write the report of a run for print, ``report.pdf``; returns its path.

    Raises
    ------
    EmaError
        For force-displacement loops, which have no such pages.
    """
    from ema_pipeline.stages.report import paper

    kind = kind_of(run.info)
    if "modal" not in kind.measures:
        raise EmaError(
            f"{run.store.folder}: reports of {kind.words} have no PDF; print report.html from the browser"
        )
    if show is None:
        return paper(run)
    with show("pdf") as progress:
        return paper(run, progress)


def export_results(out: Path, to: Path | None = None, effect_files: Iterable[str] = ()) -> list[Path]:
    """Write FRFs, modes and shapes of every configuration as universal file and as CSV.

    Parameters
    ----------
    out : Path
        Results folder.
    to : Path, optional
        Folder to write. Left out, it is ``out/export``, which belongs to the results: its files are replaced.
    effect_files : iterable of str
        Python files with the user's own effects.

    Raises
    ------
    EmaError
        If nothing has been identified yet, a file exists already in `to`, or the folder cannot be written.
    """
    from ema_pipeline.exchange.tables import shapes_table, write_frf_csv, write_table
    from ema_pipeline.exchange.uff import write_uff
    from ema_pipeline.run.measured import measured_frfs, modes_of_structure

    run = existing_run(out, effect_files)
    kind = kind_of(run.info)
    if "modal" not in kind.measures:
        raise EmaError(f"{out}: {kind.words} have neither FRFs nor modes to export; see summary.json")
    measured = measured_frfs(run)
    folder, names = to or out / "export", run.info.configurations
    ends = {name: (".uff", "_shapes.csv", *(["_frfs.csv"] if name in measured else [])) for name in names}
    files = {name: [folder / f"{name}{end}" for end in ends[name]] for name in names}
    written = [path for paths in files.values() for path in paths]
    if to is not None:
        refuse_existing(written)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise EmaError(f"{folder}: cannot be written ({error.strerror}); name another folder") from None
    for name in names:
        modal, (uff, shapes, *frfs) = modes_of_structure(run, name), files[name]
        write_uff(uff, measured.get(name), modal)
        write_table(shapes, shapes_table(modal, name))
        for path in frfs:
            write_frf_csv(path, measured[name])
    return written
