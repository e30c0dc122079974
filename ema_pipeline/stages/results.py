"""Collects what the store holds of a run, for reports and screens."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TypeVar, cast

from ema_pipeline.check_result import CheckResult
from ema_pipeline.correlate.types import Comparison, Pairing
from ema_pipeline.diagnose.hysteresis_loop import HysteresisLoop
from ema_pipeline.diagnose.types import Diagnosis, Ladder, Rung
from ema_pipeline.fit.types import FitResult
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.records import Hit, Transducer
from ema_pipeline.kinds import kind_of
from ema_pipeline.kinds.continuous import NOT_DIAGNOSED
from ema_pipeline.kinds.loops import loops_of, models_of
from ema_pipeline.levels.linear import structure, structure_frfs
from ema_pipeline.levels.sentences import flagged
from ema_pipeline.loops.types import IsolatorResult
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.modal.types import NO_SYNTHESIS, ModalModel
from ema_pipeline.observations.free_run import RecordError
from ema_pipeline.report.results import ConfigurationResults, LoopResults, RunResults
from ema_pipeline.run.measured import level_study, modes_key
from ema_pipeline.run.models import diagnosed_choices, diagnosis_is_of_other_data
from ema_pipeline.run.records import count_driven
from ema_pipeline.run.types import Run
from ema_pipeline.store import ALL


def load_results(run: Run, *, synthesis: bool = True) -> RunResults:
    """Everything that has been computed so far; what is missing is None or empty.

    Without `synthesis` the FRFs that the modes give, which only figures for print show, stay where they are.
    """
    left_out = {} if synthesis else {"synthesis": NO_SYNTHESIS}
    fit = run.store.find("fit", ALL, "fit", FitResult)
    values = fitted_values(fit)
    # A run that failed half-way leaves pairs of modes that have since been replaced.
    paired = run.store.find("fit", ALL, "modes_key", str) == modes_key(run)
    configurations = []
    kind = kind_of(run.info)
    for name in run.info.configurations:
        modal = run.store.find("modal", name, "modal", ModalModel, left_out)
        levels = level_study(run, name)
        frfs = run.store.find("frf", name, "frfs", FrfSet)
        configurations.append(
            ConfigurationResults(
                name=name,
                hits=run.store.find("hits", name, "hits", tuple[Hit, ...]) or (),
                frfs=None if frfs is None else structure_frfs(frfs, levels),
                modal=modal if modal is None or levels is None else flagged(structure(modal, levels), levels),
                pairing=run.store.find("correlate", ALL, f"pairing {name}", Pairing) if paired else None,
                system=None if run.model is None or not kind.of_rig else _system(run, name, values),
                transducers=run.store.find("ingest", name, "transducers", tuple[Transducer, ...]) or (),
                base_system=run.store.find("fit", ALL, f"base system {name}", LinearSystem),
                like_parts=tuple(
                    run.store.find(stage, ALL, f"{which} {name}", LinearSystem)
                    for stage, which in (
                        ("fit", "base like parts"),
                        ("fit", "like parts"),
                        ("diagnose", "like parts"),
                    )
                ),
                system_after=run.store.find("diagnose", ALL, f"system after {name}", LinearSystem),
                levels=levels,
                driven=count_driven(run.store, name),
            )
        )
    return RunResults(
        title=run.info.title,
        rig=None if run.rig is None else run.rig.name,
        configurations=tuple(configurations),
        fit=fit,
        comparison=run.store.find("correlate", ALL, "comparison", Comparison),
        comparison_base=run.store.find("correlate", ALL, "comparison_base", Comparison),
        comparison_after=run.store.find("diagnose", ALL, "comparison_after", Comparison),
        diagnosis=_diagnosis(run),
        ladder=_own_ladder(run),
        not_diagnosed=run.store.find("diagnose", ALL, NOT_DIAGNOSED, str) or "",
        simulation=_of_records(run, "simulation", RecordError),
        hysteresis=_of_records(run, "hysteresis", HysteresisLoop),
        loops=_loops(run),
        sensitivities=run.store.find("correlate", ALL, "sensitivities", tuple[CheckResult, ...]) or (),
        deviations=tuple(
            run.store.find(stage, ALL, name, dict[str, float]) or {}
            for stage, name in (
                ("fit", "base deviations"),
                ("fit", "deviations"),
                ("diagnose", "deviations after"),
            )
        ),
        added=run.info.effects,
        diagnosed_on=run.store.find("diagnose", ALL, "on_top_of", tuple[str, ...]) or (),
        choices=run.info.choices,
        diagnosed_choices=diagnosed_choices(run),
        folder=str(run.store.folder),
        missing_files=tuple(
            part.relative_to(run.store.folder).as_posix() for part in run.store.parts() if not part.is_file()
        ),
        effect_files=tuple(map(_typed, filter(run.named_files.__contains__, run.settings.effect_files))),
        provenance=provenance(run),
        settings={
            name: _flat(json.loads(s.model_dump_json())) for name, s in run.settings.by_stage().items()
        },
    )


def _typed(file: str) -> str:
    """A file as the user would type it from here."""
    here = Path.cwd()
    return str(Path(file).relative_to(here)) if Path(file).is_relative_to(here) else file


def _diagnosis(run: Run) -> Diagnosis | None:
    """The diagnosis, with units, and with advice that its kind of data can follow."""
    found = run.store.find("diagnose", ALL, "diagnosis", Diagnosis)
    if found is None:
        return None
    found = replace(found, ladder=_with_units(found.ladder, run))
    advice = kind_of(run.info).next_measurement
    if not advice or found.verdict != "unknown_effect":
        return found
    return replace(found, next_measurement=advice)


def _own_ladder(run: Run) -> Ladder | None:
    """The ladder of added effects; that of the base model alone only while the diagnosis is of other data."""
    if not run.info.effects and not diagnosis_is_of_other_data(run):
        return None
    found = run.store.find("ladder", ALL, "ladder", Ladder)
    return None if found is None else _with_units(found, run)


def _with_units(ladder: Ladder, run: Run) -> Ladder:
    """The ladder with the units of the rig's parameters, which its data do not know."""
    units = {} if run.model is None else {name: p.unit for name, p in run.model.parameters.items()}

    def stated(rung: Rung) -> Rung:
        sizes = {n: replace(s, unit=s.unit or units.get(n, "")) for n, s in rung.parameters.items()}
        return replace(rung, parameters=sizes)

    return replace(ladder, rungs=tuple(map(stated, ladder.rungs)))


R = TypeVar("R", RecordError, HysteresisLoop)


def _of_records(run: Run, name: str, kind: type[R]) -> tuple[R, ...]:
    """What simulated records give of the model that the user made, or else of the one that the diagnosis proposes."""
    stages = ("ladder", "diagnose") if run.info.effects else ("diagnose",)
    for stage in stages:
        found = run.store.find(stage, ALL, name, tuple[kind, ...])  # type: ignore[valid-type]
        if found is not None:
            return cast("tuple[R, ...]", found)
    return ()


def _loops(run: Run) -> LoopResults | None:
    """Loops of all configurations; None in tests of another kind and before they were identified."""
    if not all(run.store.key("loops", name) for name in run.info.configurations):
        return None
    return LoopResults(isolators(run), loops_of(run), models_of(run))


def _system(run: Run, name: str, values: dict[str, float]) -> LinearSystem:
    """The model as it was fitted, every part with its own deviation; at nominal values before the fit."""
    assert run.model is not None
    fitted = run.store.find("fit", ALL, f"system {name}", LinearSystem)
    return run.model.system(name, values) if fitted is None else fitted


def isolators(run: Run) -> dict[str, IsolatorResult]:
    """Identified isolators of hysteresis tests, by configuration."""
    return {
        name: run.store.load("loops", name, "isolator", IsolatorResult) for name in run.info.configurations
    }


def fitted_values(fit: FitResult | None) -> dict[str, float]:
    """Parameter values that the fit found; empty before the fit, so that nominal values are taken."""
    if fit is None:
        return {}
    return {name: p.value for name, p in fit.parameters.items()}


def provenance(run: Run) -> dict[str, str]:
    """Where the results come from: files with their hashes, versions, dates."""
    facts = {"raw folder": run.info.raw, "rig": run.info.rig_source or "none"}
    facts |= {f"version of {name}": version for name, version in run.info.versions.items()}
    for (stage, configuration), p in run.store.provenance().items():
        label = stage if configuration == ALL else f"{stage} ({configuration})"
        facts[f"stage {label}"] = f"{p.finished}, {p.seconds:.2f} s, key {p.key[:12]}"
    for configuration in run.info.configurations:
        first = kind_of(run.info).measures[0]
        sources = run.store.find(first, configuration, "sources", dict[str, str]) or {}
        for file, digest in sources.items():
            facts[f"SHA-256 of {configuration}/{file}"] = digest
    return facts


def _flat(settings: dict[str, object], prefix: str = "") -> dict[str, str]:
    flat: dict[str, str] = {}
    for key, value in settings.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = json.dumps(value)
    return flat
