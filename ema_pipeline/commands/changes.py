"""Two tests: what changed, and MAC."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ema_pipeline.commands.options import EffectFiles, Json, Quiet, RigOption
from ema_pipeline.commands.screen import progress, show, show_json

if TYPE_CHECKING:
    from ema_pipeline.observations.pair import RepeatSettings

NO_RIG = "none"

RigOrNone = Annotated[
    str | None,
    typer.Option(
        "--rig",
        "-r",
        metavar="RIG",
        help="Name of a rig, or a rig file (.toml); the tests' own if left out; 'none' compares mode by mode.",
    ),
]
TestA = Annotated[Path, typer.Argument(metavar="A", help="Results folder or raw folder.")]
TestB = Annotated[Path, typer.Argument(metavar="B", help="Results folder or raw folder.")]


def changes(
    a: TestA,
    b: TestB,
    rig: RigOrNone = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for the answer; results/changes_A_B if left out."),
    ] = None,
    repeat: Annotated[
        list[str] | None,
        typer.Option(
            "--repeat",
            metavar="KEY=VALUE",
            help="How well tests repeat, 1 σ, learned about frequency=1e-4, damping=0.01, shape=0.003 if left out. "
            "May be repeated.",
        ),
    ] = None,
    effect_file: EffectFiles = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Say what changed from test A to test B: effect, place, size, or 'the same within what these tests can show'.

    With a rig, by --rig or of the tests themselves, both are fitted as one problem, in which parts, sensors and
    calibration are the same. Without one modes are matched and compared one by one.
    """
    from ema_pipeline.answers import CHANGES_FILE, check_answer_folder
    from ema_pipeline.changes.page import write_page
    from ema_pipeline.changes.tables import limits_text, notes, short_modes_table, verdict_text
    from ema_pipeline.changes.two_tests import changes_content, compare_runs, open_test, write_changes
    from ema_pipeline.report.terminal import sentence, text_table

    repeats, by_rig = _repeats(repeat or []), rig != NO_RIG
    rig = rig if by_rig else None
    folder = out or Path("results") / f"changes_{a.resolve().name}_{b.resolve().name}"
    check_answer_folder(folder, CHANGES_FILE)
    with progress(quiet) as show_stage:
        run_a = open_test(a, rig, folder / "A", show_stage, effect_file or [])
        run_b = open_test(b, rig, folder / "B", show_stage, effect_file or [])
        if show_stage is None:
            found = compare_runs(run_a, run_b, repeat=repeats, by_rig=by_rig)
        else:
            with show_stage("changes") as report_progress:
                found = compare_runs(run_a, run_b, report_progress, repeats, by_rig)
    folder.mkdir(parents=True, exist_ok=True)
    written = write_changes(found, folder)
    page = write_page(found, run_a, run_b, folder)
    if json:
        show_json(changes_content(found))
    elif not quiet:
        show(sentence(verdict_text(found)))
        if found.physics is not None and found.physics.diagnosis.detection_limits and found.verdict == "same":
            show(sentence(limits_text(found.physics.diagnosis)))
        show(text_table(short_modes_table(found), "Modes: A and B"))
        for note in notes(found):
            show(sentence(note))
        show(f"Report: {page}; {written}")


def _repeats(texts: list[str]) -> RepeatSettings:
    from ema_pipeline.observations.pair import RepeatSettings
    from ema_pipeline.run.settings import toml_value
    from ema_pipeline.settings import parse

    pairs = [text.partition("=") for text in texts]
    return parse(
        RepeatSettings, {name.strip(): toml_value(value.strip()) for name, _, value in pairs}, "--repeat"
    )


def mac(
    a: TestA,
    b: Annotated[Path | None, typer.Argument(metavar="[B]", help="The model of A if left out.")] = None,
    rig: RigOption = None,
    json: Json = False,
) -> None:
    """Show the MAC of the modes of test A with those of test B, or with those of the rig's model."""
    import tempfile

    from ema_pipeline.changes.matrices import mac_with_model, mac_with_test
    from ema_pipeline.changes.tables import mac_table
    from ema_pipeline.changes.two_tests import open_test
    from ema_pipeline.report.terminal import matrix_table

    with tempfile.TemporaryDirectory(prefix="ema-mac-") as scratch, progress(True) as show_stage:
        run_a = open_test(a, rig, Path(scratch) / "A", show_stage)
        if b is None:
            found = mac_with_model(run_a)
        else:
            found = mac_with_test(run_a, open_test(b, rig, Path(scratch) / "B", show_stage))
    if json:
        show_json({"configurations": [m.content() for m in found]})
        return
    for m in found:
        show(matrix_table(mac_table(m), f"MAC, {m.configuration}: A down, {m.other} across"))
