"""Raw folders: their hits judged, their description drafted, a test simulated."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ema_pipeline.describe import DEFAULT_PIPELINE, checked_rig
from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.campaign import read_campaign
from ema_pipeline.ingest.load import load_records
from ema_pipeline.ingest.records import Hit
from ema_pipeline.number_text import format_value
from ema_pipeline.run.settings import PipelineSettings, load_pipeline, toml_value
from ema_pipeline.settings import parse

if TYPE_CHECKING:
    from ema_pipeline.ingest.description import TestDescription
    from ema_pipeline.simulate.campaign import SimulatedCampaign


def check_raw(raw: Path, overrides: Iterable[str] = ()) -> dict[str, tuple[Hit, ...]]:
    """Hits of every configuration of a raw folder with their verdicts; nothing is written."""
    from ema_pipeline.ingest.hit_checks import hits_of_test

    settings = load_pipeline(DEFAULT_PIPELINE, overrides)
    tests: dict[str, list[TestDescription]] = {}
    for test in read_campaign(raw).tests:
        tests.setdefault(test.configuration or "default", []).append(test)
    return {
        name: hits_of_test(list(load_records(*parts, limits=settings.ingest)), settings.hits)
        for name, parts in tests.items()
    }


def check_records(raw: Path, overrides: Iterable[str] = ()) -> list[str] | None:
    """A line on every record of a test without hits, or None for hits; EmaError for a record that is not right."""
    tests, settings = read_campaign(raw).tests, load_pipeline(DEFAULT_PIPELINE, overrides)
    told = {"continuous": _driven_lines, "hysteresis": _loop_lines}
    if any(t.kind not in told for t in tests):
        return None
    return [line for test in tests for line in told[test.kind](test, settings)]


def _driven_lines(test: TestDescription, settings: PipelineSettings) -> Iterator[str]:
    from ema_pipeline.ingest.driven import load_driven

    for r in load_driven(test, settings.ingest):
        periods = r.n_samples // r.period if r.period else 0
        period = "" if not periods else ", 1 period" if periods == 1 else f", {periods} periods"
        level = ", ".join(f"{c.name} {np.std(f):.3g} N" for c, f in zip(r.forces, r.force, strict=True))
        yield (
            f"{r.name}: {r.n_samples} samples at {r.sample_rate_hz:.6g} Hz{period}, "
            f"{r.excitation or 'continuous'}, {r.use.replace('_', ' ')}; force {level} (root mean square)"
        )


def _loop_lines(test: TestDescription, settings: PipelineSettings) -> Iterator[str]:
    from ema_pipeline.loops.read import load_loops

    for loop in load_loops(test, settings.loops):
        yield (
            f"{loop.name}: {loop.cycles} cycles at {loop.frequency_hz:.4g} Hz, amplitude {loop.amplitude_m:.3g} m, "
            f"force up to {np.max(np.abs(loop.force)):.3g} N, "
            f"{format_value(loop.energy_j, loop.energy_std_j, 'J')} lost per cycle"
        )


def draft_raw(raw: Path, overrides: Iterable[str] = ()) -> list[Path]:
    """Draft test.toml from what the record files of a folder say; returns the files written."""
    from ema_pipeline.ingest.draft import write_drafts

    return write_drafts(raw, load_pipeline(DEFAULT_PIPELINE, overrides).ingest)


def simulate_raw(
    out: Path,
    rig: str,
    *,
    configurations: list[str],
    effects: list[str],
    effect_files: list[str],
    values: list[str],
    sensors: list[str],
    impacts: list[str],
    settings: list[str],
) -> SimulatedCampaign:
    """Simulate a campaign; values and settings are given as ``"name=value"``."""
    from ema_pipeline.effects.library import effect_library
    from ema_pipeline.simulate.campaign import simulate_campaign
    from ema_pipeline.simulate.settings import SimulationSettings

    named = _named_values(settings, "--set")
    parse(SimulationSettings, named, "simulate")  # else --set sensors=… would stand for the option --sensor
    return simulate_campaign(
        out,
        rig,
        configurations=configurations,
        effects=effects,
        values=_named_values(values, "--value"),
        sensors=sensors,
        impacts=impacts,
        library=effect_library(effect_files, checked_rig(rig)),
        **named,
    )


def _named_values(texts: list[str], option: str) -> dict[str, Any]:
    named = {}
    for text in texts:
        name, sign, value = text.partition("=")
        if not sign or not name.strip():
            raise EmaError(f"{option} {text}: is not of the form name=value")
        named[name.strip()] = toml_value(value.strip())
    return named
