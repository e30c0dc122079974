"""A whole simulated campaign: raw folders to the layout that `ema run` reads, and the truth beside them."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ema_pipeline.dof import Dof
from ema_pipeline.effects.base import effect_of
from ema_pipeline.effects.library import Library, parse_sized
from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.files import refuse_existing
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.rigs import load_rig, model_modes, rig_names
from ema_pipeline.rigs.entries import LARGEST
from ema_pipeline.rigs.types import Rig
from ema_pipeline.settings import parse
from ema_pipeline.simulate.folder import BAD_HIT, BLOW_WITHIN_S, LONGEST_CONTACT, TestFolder
from ema_pipeline.simulate.hits import HitSeries
from ema_pipeline.simulate.imperfections import generator
from ema_pipeline.simulate.response import Respond, response, response_by_poles
from ema_pipeline.simulate.sensing import draw_channels
from ema_pipeline.simulate.settings import SimulationSettings
from ema_pipeline.simulate.truth import TrueRig, true_rig
from ema_pipeline.threads import single_blas_thread

TRUTH_FILE = "truth.json"

MOST_SAMPLES = 1e7
"""Per hit; a hundred times what hammer tests take."""

LEAST_CONTACT = 0.1
"""Samples; the recorder's filter spreads a shorter contact over samples with less than a tenth of its force."""


@dataclass(frozen=True)
class SimulatedCampaign:
    """What was simulated.

    Attributes
    ----------
    folder : Path
    configurations : tuple of str
    values : dict of str to float
        True values of all parameters, the effects' among them.
    records : int
        Number of record files.
    assumed : dict of str to str
        Parameters of effects that were not given and have the library's value, which shows clearly; with their units.
    """

    folder: Path
    configurations: tuple[str, ...]
    values: dict[str, float]
    records: int
    assumed: dict[str, str]


def simulate_campaign(
    out: str | Path,
    rig: Rig | str | Path = "planetary",
    *,
    configurations: Sequence[str] = (),
    effects: Sequence[str] = (),
    values: Mapping[str, float] | None = None,
    sensors: Sequence[str] = (),
    impacts: Sequence[str] = (),
    library: Library | None = None,
    respond: Respond | None = None,
    **settings: Any,
) -> SimulatedCampaign:
    """Simulate hammer tests of a rig and write them as raw folders.

    Parameters
    ----------
    out : Path
        Folder to write; it may exist but must hold no test.toml, and no file that would be replaced. Several
        configurations become its sub-folders. ``truth.json`` in it says what was simulated.
    rig : Rig, str or Path
        A rig, a shipped rig's name or a rig file (copied beside the data as ``rig.toml``).
    configurations : sequence of str
        All of the rig's where left out.
    effects : sequence of str
        ``"id@place:name=value"``, see `effects.library.parse_sized`.
    values : dict of str to float, optional
        True values of parameters; nominal (or scattered) where left out.
    sensors, impacts : sequence of str
        DOFs; those that a configuration does not have are left out there. Sensors are on every body in all
        its directions where left out, impacts on every body in turns of direction.
    library : dict of str to Effect, optional
        The shipped effects where left out.
    respond : callable, optional
        Makes the ideal signals, see `simulate.response.Respond`; exact where left out.
    **settings
        Fields of `SimulationSettings`.

    Returns
    -------
    SimulatedCampaign

    Raises
    ------
    EmaError
        For unknown names, a folder that already holds data, settings out of range, and a model that cannot be
        solved; nothing is written then.
    """
    out = Path(out)
    options = parse(SimulationSettings, settings, "simulate")
    _check_times(options)
    if out.exists() and not out.is_dir():
        raise EmaError(f"{out}: is no folder; name another")
    if any(out.glob("test.toml")) or any(out.glob("*/test.toml")):
        raise EmaError(f"{out}: holds a test already; name another folder or delete it")
    base = rig if not isinstance(rig, str | Path) else load_rig(rig)
    chosen = _known(configurations or base.configurations, base.configurations, "configuration")
    made = true_rig(base, effects, library, options)
    random = np.random.default_rng(options.seed)
    of_values = random if options.rig_seed is None else np.random.default_rng(options.rig_seed)
    true = true_values(made.rig, values or {}, options.scatter, of_values)
    _check_dofs(base, chosen, sensors, impacts)
    own_file = Path(rig) if isinstance(rig, str | Path) and str(rig) not in rig_names() else None
    tests = _tests(base, base.name if own_file is None else "", chosen, sensors, impacts, options)
    _check_bad_hits(options, tests)
    truth: dict[str, Any] = {
        "rig": base.name,
        "effects": list(effects),
        "values": true,
        "settings": options.model_dump(mode="json"),
    }
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(
        prefix=".simulated-", dir=out if out.is_dir() else out.parent
    ) as scratch:
        made_in = Path(scratch)
        if own_file is not None and own_file.resolve() != (out / "rig.toml").resolve():
            shutil.copyfile(own_file, made_in / "rig.toml")
        with single_blas_thread():
            truth["configurations"] = written = _write(made_in, tests, made, true, options, respond, random)
        if not options.imperfections.none:
            truth["imperfections"] = _drawn(made, tests, options)
        text = json.dumps(truth, indent=1, ensure_ascii=False)
        (made_in / TRUTH_FILE).write_text(text + "\n", encoding="utf-8")
        _moved(made_in, out)
    records = sum(len(c["records"]) for c in written.values())
    return SimulatedCampaign(out, tuple(chosen), true, records, _assumed(made.rig, effects, values or {}))


def _moved(made_in: Path, out: Path) -> None:
    """Move all files to a folder, unless one of them would replace another."""
    files = sorted(path.relative_to(made_in) for path in made_in.rglob("*") if path.is_file())
    refuse_existing((out / file for file in files), "name another folder, or remove it")
    for file in files:
        (out / file).parent.mkdir(parents=True, exist_ok=True)
        (made_in / file).replace(out / file)


def _assumed(rig: Rig, effects: Sequence[str], values: Mapping[str, float]) -> dict[str, str]:
    given = set(values)
    for label, sizes in map(parse_sized, effects):
        effect, _, place = (text.strip() for text in label.partition("@"))
        given |= {f"{effect}@{place}.{name}" for name in sizes}
    return {name: p.unit for name, p in rig.parameters.items() if effect_of(name) and name not in given}


def true_values(
    rig: Rig, values: Mapping[str, float], scatter: float, random: np.random.Generator
) -> dict[str, float]:
    """Values of all parameters: as given, else nominal and scattered by their tolerances within their bounds.

    One random number is drawn per parameter in any case, so that giving one value leaves the others as
    they are.
    """
    for name in values:
        if name not in rig.parameters:
            raise EmaError(f"rig '{rig.name}' has no parameter '{name}'{did_you_mean(name, rig.parameters)}")
        _check_value(name, values[name])
    result = {}
    for name, p in rig.parameters.items():
        deviation = 1 + scatter * p.tolerance * float(np.clip(random.standard_normal(), -3, 3))
        result[name] = float(values.get(name, np.clip(p.value * deviation, p.minimum, p.maximum)))
    return result


def _check_value(name: str, value: object) -> None:
    """EmaError for a true value that is no number, or one that no model can be computed with."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
        raise EmaError(f"value of parameter '{name}' = {value}: give a number of at most {LARGEST:g} in size")


def default_sensors(assembly: Assembly) -> tuple[Dof, ...]:
    """Every body in x, y and u as far as it has them, otherwise in all its coordinates."""
    found: list[Dof] = []
    for body in assembly.bodies:
        plane = [Dof(body, d) for d in ("x", "y", "u") if assembly.has_dof(f"{body}.{d}")]
        found += plane or [Dof.parse(c) for c in assembly.coordinates(body)]
    return tuple(found)


def default_impacts(sensors: tuple[Dof, ...]) -> tuple[Dof, ...]:
    """One blow per body, in turns of its directions, so that all directions are struck somewhere."""
    bodies = dict.fromkeys(s.body for s in sensors)
    result = []
    for i, body in enumerate(bodies):
        own = [s for s in sensors if s.body == body]
        result.append(own[i % len(own)])
    return tuple(result)


def _tests(
    base: Rig,
    rig_key: str,
    configurations: Sequence[str],
    sensors: Sequence[str],
    impacts: Sequence[str],
    options: SimulationSettings,
) -> tuple[TestFolder, ...]:
    """The test of each configuration, all with the same sensors."""
    tests = []
    for configuration in configurations:
        places = _sensors_of(base, configuration, sensors)
        points = _places(impacts, base.assembly(configuration)) or default_impacts(places)
        tests.append(TestFolder(base.name, rig_key, configuration, places, points, options))
    if options.imperfections.none:
        return tuple(tests)
    measured = [dof.point for c in base.configurations for dof in _sensors_of(base, c, sensors)]
    channels = draw_channels(measured, options.imperfections, options.seed_of_rig)
    return tuple(replace(test, channels=channels) for test in tests)


def _sensors_of(base: Rig, configuration: str, sensors: Sequence[str]) -> tuple[Dof, ...]:
    plain = base.assembly(configuration)
    return _places(sensors, plain) or default_sensors(plain)


def _write(
    out: Path,
    tests: Sequence[TestFolder],
    made: TrueRig,
    true: Mapping[str, float],
    options: SimulationSettings,
    respond: Respond | None,
    random: np.random.Generator,
) -> dict[str, Any]:
    """Write all tests; return modes and hits by configuration."""
    sizes = options.imperfections
    respond = respond or (response if sizes.none else response_by_poles)
    written = {}
    for test in tests:
        folder = out / test.configuration if len(tests) > 1 else out
        folder.mkdir(exist_ok=True)
        number = made.rig.configurations.index(test.configuration)
        series = HitSeries(sizes, options.drift_kind, generator(options.seed, "hits", number))
        hits = test.write(folder, made.rig.assembly(test.configuration, true), respond, random, series)
        written[test.configuration] = _test_truth(made.rig, test, true, hits)
    return written


def _drawn(made: TrueRig, tests: Sequence[TestFolder], options: SimulationSettings) -> dict[str, Any]:
    """What was drawn for the whole campaign."""
    return {
        **asdict(options.imperfections),
        "parts": made.parts,
        "damping_factors": made.damping,
        "channels": {point: asdict(channel) for point, channel in tests[0].channels.items()},
    }


def _test_truth(
    rig: Rig, test: TestFolder, true: Mapping[str, float], written: list[dict[str, Any]]
) -> dict[str, Any]:
    """Modes and records of one configuration."""
    modes = [
        {"frequency_hz": m.frequency_hz, "damping_ratio": m.damping_ratio, "family": m.family}
        for m in model_modes(rig, test.configuration, true)
    ]
    return {"modes": modes, "records": written}


def _known(names: Sequence[str], known: Sequence[str], what: str) -> list[str]:
    for name in names:
        if name not in known:
            raise EmaError(f"no {what} '{name}'{did_you_mean(name, known)}")
    _check_once(names, what)
    return list(names)


def _check_once(names: Sequence[str], what: str) -> None:
    for name in names:
        if names.count(name) > 1:
            raise EmaError(f"{what} '{name}' is named twice; name it once")


def _places(texts: Sequence[str], assembly: Assembly) -> tuple[Dof, ...]:
    """The DOFs that this configuration has."""
    return tuple(d for d in map(Dof.parse, texts) if assembly.has_dof(d.point))


def _check_dofs(
    rig: Rig, configurations: Sequence[str], sensors: Sequence[str], impacts: Sequence[str]
) -> None:
    for dof in map(Dof.parse, (*sensors, *impacts)):
        if not any(rig.knows(c, dof) for c in configurations):
            rig.assembly(configurations[0]).row(dof.point)  # raises with a hint
    _check_once([Dof.parse(text).point for text in sensors], "sensor")  # its channel is named by the point
    _check_once(impacts, "impact")


def _check_times(options: SimulationSettings) -> None:
    """EmaError for records that are too long, or that do not hold the blow."""
    rate, duration, contact = options.sample_rate_hz, options.duration_s, options.contact_s
    samples = rate * duration
    if samples > MOST_SAMPLES:
        raise EmaError(
            f"simulate: sample_rate_hz = {rate:g} and duration_s = {duration:g} make {samples:.3g} samples per hit, "
            f"{MOST_SAMPLES:g} at most; lower one of them"
        )
    if rate * contact < LEAST_CONTACT:
        raise EmaError(
            f"simulate: contact_s = {contact:g} is too short for sample_rate_hz = {rate:g}: hardly any of the force "
            "would be recorded; raise one of them"
        )
    latest = options.pretrigger_s + BLOW_WITHIN_S + LONGEST_CONTACT * contact
    if duration <= latest:
        raise EmaError(
            f"simulate: duration_s = {duration:g} ends before the blow does, {latest:.3g} s after the start; raise it, "
            "or lower pretrigger_s or contact_s"
        )


def _check_bad_hits(options: SimulationSettings, tests: Sequence[TestFolder]) -> None:
    """EmaError for a hit that no test has."""
    for text in (*options.double_hits, *options.overloads):
        match = BAD_HIT.match(text)
        if match is None:
            raise EmaError(f"hit '{text}' is not of the form [configuration:]dof#number, e.g. 'sun.y#2'")
        if match["configuration"] is not None:
            _known([match["configuration"]], [t.configuration for t in tests], "configuration")
        if not 1 <= int(match["number"]) <= options.hits:
            raise EmaError(f"hit '{text}': there are {options.hits} hits per point, numbered from 1")
        asked = [t for t in tests if match["configuration"] in (None, t.configuration)]
        struck = dict.fromkeys(str(dof) for t in asked for dof in t.impacts)
        if match["dof"] not in struck:
            raise EmaError(f"hit '{text}': no hit is on {match['dof']}; they are on {', '.join(struck)}")
