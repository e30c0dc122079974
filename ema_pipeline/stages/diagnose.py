"""Modes and model → which physics the model is missing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.diagnose.hypotheses import Hypothesis, make_rig
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.rigs.types import Rig
from ema_pipeline.stages.base import Progress, Run, code_fingerprint
from ema_pipeline.stages.correlate import correlate
from ema_pipeline.stages.modes import measured_modes

NAME = "diagnose"
NEEDS = ("frf", "modal")
USES = ("levels", "loops")
PER_CONFIGURATION = False
NEEDS_RIG = True


def inputs(run: Run, configuration: str) -> str:
    """The user's own effects take part."""
    return run.effect_hashes()


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Fit every effect of the library on top of the model as it stands, and judge what the data support."""
    from ema_pipeline.diagnose import diagnose

    settings = cast(DiagnoseSettings, run.settings[NAME])
    model = run.require_model(NAME)
    measured = measured_modes(run)
    frfs = {name: f for name in measured if (f := run.store.find("frf", name, "frfs", FrfSet)) is not None}
    limits, tell = own_thresholds(run, settings, model, measured, progress)
    found = diagnose(model, measured, settings, run.library, tell, failed_checks(run), limits, frfs)
    results: dict[str, object] = {"diagnosis": found, "on_top_of": run.info.effects}
    top = found.ladder.rungs[-1]
    if top.effects:
        mended = make_rig(model, Hypothesis(top.effects), run.library, settings.parameter_range)
        values = {name: size.value for name, size in top.parameters.items()}
        _, results["comparison_after"] = correlate(run, mended, values)
    return results


def own_thresholds(
    run: Run,
    settings: DiagnoseSettings,
    model: Rig,
    measured: Mapping[str, MeasuredModes],
    progress: Progress,
) -> tuple[dict[str, float] | None, Progress]:
    """Thresholds from this test's own fitted null where the settings ask for it, and progress of what is left."""
    from ema_pipeline.diagnose import bootstrap

    if not settings.bootstrap:
        return None, progress
    share = settings.bootstrap / (settings.bootstrap + 1)
    limits = bootstrap.own_thresholds(
        model,
        measured,
        settings,
        run.library,
        run.store.folder / "bootstrap.jsonl",
        code_fingerprint() + run.effect_hashes(),
        lambda done, text: progress(share * done, text),
    )
    return limits, lambda done, text="": progress(share + (1 - share) * done, text)


def failed_checks(run: Run) -> tuple[str, ...]:
    """What the checks on the FRFs found, for a reader who might otherwise blame the model."""
    found = []
    for name in run.info.configurations:
        frfs = run.store.find("frf", name, "frfs", FrfSet)
        verdicts = () if frfs is None else frfs.verdicts
        found += [f"{name}: {v.message}" for v in verdicts if not v.passes and v.message]
    return tuple(found)
