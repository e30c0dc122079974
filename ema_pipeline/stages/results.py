"""Collects what the store holds of a run, for reports and screens."""

from __future__ import annotations

import json

from ema_pipeline.correlate.types import Comparison, Pairing
from ema_pipeline.diagnose.types import Diagnosis, Ladder
from ema_pipeline.fit.types import FitResult
from ema_pipeline.ingest.records import Hit
from ema_pipeline.levels.linear import structure
from ema_pipeline.levels.words import flagged
from ema_pipeline.loops.types import IsolatorResult
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.report.results import ConfigurationResults, RunResults
from ema_pipeline.stages.base import Run
from ema_pipeline.stages.models import fitted_modes
from ema_pipeline.stages.modes import level_study, measured_frfs
from ema_pipeline.store import ALL


def load_results(run: Run) -> RunResults:
    """Everything that has been computed so far; what is missing is None or empty."""
    fit = run.store.find("fit", ALL, "fit", FitResult)
    values = fitted_values(fit)
    configurations = []
    loops = run.info.kind == "hysteresis"
    frfs = measured_frfs(run)
    for name in run.info.configurations:
        modal, levels = run.store.find("modal", name, "modal", ModalModel), level_study(run, name)
        configurations.append(
            ConfigurationResults(
                name=name,
                hits=run.store.find("hits", name, "hits", tuple[Hit, ...]) or (),
                frfs=frfs.get(name),
                modal=modal if modal is None or levels is None else flagged(structure(modal, levels), levels),
                pairing=run.store.find("correlate", ALL, f"pairing {name}", Pairing),
                system=None if run.model is None or loops else _system(run, name, fit, values),
                levels=levels,
            )
        )
    return RunResults(
        title=run.info.title,
        rig=None if run.rig is None else run.rig.name,
        configurations=tuple(configurations),
        fit=fit,
        comparison=run.store.find("correlate", ALL, "comparison", Comparison),
        comparison_after=run.store.find("diagnose", ALL, "comparison_after", Comparison),
        diagnosis=run.store.find("diagnose", ALL, "diagnosis", Diagnosis),
        ladder=run.store.find("ladder", ALL, "ladder", Ladder),
        warnings=warnings(tuple(configurations)),
        provenance=provenance(run),
        settings={name: _flat(json.loads(s.model_dump_json())) for name, s in run.settings.items()},
    )


def _system(run: Run, name: str, fit: FitResult | None, values: dict[str, float]) -> LinearSystem:
    """The model as it was fitted, every part with its own deviation; at nominal values before the fit."""
    assert run.model is not None
    if fit is None or not fit.unknowns:
        return run.model.system(name, values)
    return fitted_modes(run, fit).system(name)


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


def warnings(configurations: tuple[ConfigurationResults, ...]) -> tuple[str, ...]:
    """Plain sentences on what a reader should be careful about."""
    found = []
    for c in configurations:
        rejected = [h for h in c.hits if not h.accepted]
        if rejected:
            found.append(f"{c.name}: {len(rejected)} of {len(c.hits)} hits were left out.")
        if c.frfs is not None:
            found += [f"{c.name}: {v.message}" for v in c.frfs.verdicts if not v.passes and v.message]
        if c.modal is not None:
            found += [f"{c.name}: {note}" for note in c.modal.notes]
    return tuple(found)


def provenance(run: Run) -> dict[str, str]:
    """Where the results come from: files with their hashes, versions, dates."""
    facts = {"raw folder": run.info.raw, "rig": run.info.rig_source or "none"}
    facts |= {f"version of {name}": version for name, version in run.info.versions.items()}
    for (stage, configuration), p in run.store.provenance().items():
        label = stage if configuration == ALL else f"{stage} ({configuration})"
        facts[f"stage {label}"] = f"{p.finished}, {p.seconds:.2f} s, key {p.key[:12]}"
    for configuration in run.info.configurations:
        stage = "loops" if run.info.kind == "hysteresis" else "ingest"
        sources = run.store.find(stage, configuration, "sources", dict[str, str]) or {}
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
