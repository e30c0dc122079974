"""A whole simulated campaign: raw folders to the layout that `ema run` reads, and the truth beside them."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.effects.library import Library, parse_sized
from ema_pipeline.effects.rig import rig_with_effects
from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.rigs import load_rig, model_modes, rig_names
from ema_pipeline.rigs.types import Rig
from ema_pipeline.settings import parse
from ema_pipeline.simulate.hammer import ForceHistory, Pulse
from ema_pipeline.simulate.recorder import clip_peak, record_channel
from ema_pipeline.simulate.response import Respond, response
from ema_pipeline.simulate.settings import SimulationSettings
from ema_pipeline.simulate.writers import SUFFIX, WRITERS
from ema_pipeline.threads import single_blas_thread

TRUTH_FILE = "truth.json"
_BOUNCE_DELAY_S = (0.006, 0.012)
_BOUNCE_SIZE = (0.25, 0.5)
_HIT = re.compile(r"^(?:(?P<configuration>[^:#]+):)?(?P<dof>[^:#]+)#(?P<number>\d+)$")


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
    """

    folder: Path
    configurations: tuple[str, ...]
    values: dict[str, float]
    records: int


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
    respond: Respond = response,
    **settings: Any,
) -> SimulatedCampaign:
    """Simulate hammer tests of a rig and write them as raw folders.

    Parameters
    ----------
    out : Path
        Folder to write; it may exist but must hold no test.toml. Several configurations become its
        sub-folders. ``truth.json`` in it says what was simulated.
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
    respond : callable
        Makes the ideal signals, see `simulate.response.Respond`.
    **settings
        Fields of `SimulationSettings`.

    Returns
    -------
    SimulatedCampaign

    Raises
    ------
    EmaError
        For unknown names, a folder that already holds data, and settings out of range.
    """
    out = Path(out)
    options = parse(SimulationSettings, settings, "simulate")
    if any(out.glob("test.toml")) or any(out.glob("*/test.toml")):
        raise EmaError(f"{out}: holds a test already; name another folder or delete it")
    base = rig if not isinstance(rig, str | Path) else load_rig(rig)
    chosen = _known(configurations or base.configurations, base.configurations, "configuration")
    truth_rig = rig_with_effects(base, [parse_sized(e) for e in effects], library)
    random = np.random.default_rng(options.seed)
    true = true_values(truth_rig, values or {}, options.scatter, random)
    _check_bad_hits(options, chosen)

    out.mkdir(parents=True, exist_ok=True)
    rig_name = base.name
    if isinstance(rig, str | Path) and str(rig) not in rig_names():
        shutil.copyfile(rig, out / "rig.toml")
        rig_name = ""
    truth: dict[str, Any] = {
        "rig": base.name,
        "effects": list(effects),
        "values": true,
        "settings": options.model_dump(mode="json"),
        "configurations": {},
    }
    records = 0
    _check_dofs(base, chosen, (*sensors, *impacts))
    with single_blas_thread():
        for configuration in chosen:
            folder = out / configuration if len(chosen) > 1 else out
            folder.mkdir(exist_ok=True)
            plain = base.assembly(configuration)
            places = _places(sensors, plain) or default_sensors(plain)
            points = _places(impacts, plain) or default_impacts(places)
            test = _Test(base.name, rig_name, configuration, folder, places, points, options)
            records += test.write(truth_rig.assembly(configuration, true), respond, random)
            modes = model_modes(truth_rig, configuration, true)
            truth["configurations"][configuration] = {
                "modes": [
                    {"frequency_hz": m.frequency_hz, "damping_ratio": m.damping_ratio, "family": m.family}
                    for m in modes
                ]
            }
    (out / TRUTH_FILE).write_text(json.dumps(truth, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return SimulatedCampaign(out, tuple(chosen), true, records)


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
    result = {}
    for name, p in rig.parameters.items():
        deviation = 1 + scatter * p.tolerance * float(np.clip(random.standard_normal(), -3, 3))
        result[name] = float(values.get(name, np.clip(p.value * deviation, p.minimum, p.maximum)))
    return result


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


@dataclass(frozen=True)
class _Test:
    """One configuration's test: its folder, its channels and its blows."""

    rig: str
    rig_key: str
    configuration: str
    folder: Path
    sensors: tuple[Dof, ...]
    impacts: tuple[Dof, ...]
    options: SimulationSettings

    def write(self, assembly: Assembly, respond: Respond, random: np.random.Generator) -> int:
        """Write all record files and test.toml; return the number of records."""
        o = self.options
        names = self._channel_names()
        lines = self._header(names)
        offsets = o.offset_v * random.standard_normal(len(names))
        count = 0
        for impact in self.impacts:
            plan = [
                (level, first)
                for level in o.peak_force_n
                for first in range(1, o.hits + 1, o.hits_per_record)
            ]
            blows = [self._pulses(impact, level, first, random) for level, first in plan]
            longest = o.hits_per_record * round(o.duration_s * o.sample_rate_hz)
            histories = tuple(ForceHistory(p, o.sample_rate_hz, longest) for p in blows)
            signals = respond(assembly, histories, impact, self.sensors)
            for (level, first), (force, accelerations) in zip(plan, signals, strict=True):
                hits = range(first, min(first + o.hits_per_record, o.hits + 1))
                if any(self._is_bad(o.overloads, impact, k) for k in hits):
                    force = clip_peak(force)
                volts = self._volts(force, accelerations, names, offsets, random)
                stem = str(impact).replace(".", "_").replace("-", "minus_")
                file = f"{stem}_{level:g}N_{first}{SUFFIX[o.format]}"
                WRITERS[o.format](self.folder / file, volts, o.sample_rate_hz)
                lines += ["", "[[records]]", f'file = "{file}"', f'impact = "{impact}"']
                count += 1
        (self.folder / "test.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
        return count

    def _pulses(
        self, impact: Dof, level: float, first: int, random: np.random.Generator
    ) -> tuple[Pulse, ...]:
        o = self.options
        pulses = []
        for i, number in enumerate(range(first, min(first + o.hits_per_record, o.hits + 1))):
            time = i * o.duration_s + o.pretrigger_s + random.uniform(0, 0.01)
            peak = level * max(0.2, 1 + o.force_spread * random.standard_normal())
            pulses.append(Pulse(time, peak, o.contact_s * random.uniform(0.95, 1.05)))
            if self._is_bad(o.double_hits, impact, number):
                pulses.append(
                    Pulse(
                        time + random.uniform(*_BOUNCE_DELAY_S),
                        peak * random.uniform(*_BOUNCE_SIZE),
                        o.contact_s,
                    )
                )
        return tuple(pulses)

    def _is_bad(self, hits: tuple[str, ...], impact: Dof, number: int) -> bool:
        for text in hits:
            match = _HIT.match(text)
            assert match is not None  # checked at the start
            if match["dof"] == str(impact) and int(match["number"]) == number:
                return match["configuration"] in (None, self.configuration)
        return False

    def _channel_names(self) -> tuple[str, ...]:
        named = ("hammer", *(s.point.replace(".", "_") for s in self.sensors))
        if self.options.format == "wav":
            return tuple(f"ch{i}" for i in range(1, len(named) + 1))
        return named

    def _volts(
        self,
        force: NDArray[np.float64],
        accelerations: NDArray[np.float64],
        names: tuple[str, ...],
        offsets: NDArray[np.float64],
        random: np.random.Generator,
    ) -> dict[str, NDArray[np.float64]]:
        o = self.options
        signals = np.vstack([force, accelerations])
        return {
            name: record_channel(
                signals[i],
                o.hammer_sensitivity_mv if i == 0 else o.accelerometer_sensitivity_mv,
                o.force_noise_n if i == 0 else o.acceleration_noise,
                float(offsets[i]),
                o.converter_bits,
                o.converter_range_v,
                random,
            )
            for i, name in enumerate(names)
        }

    def _header(self, names: tuple[str, ...]) -> list[str]:
        o = self.options
        lines = ["schema = 1", f'title = "Simulated {self.rig} rig, {self.configuration}"']
        if self.rig_key:
            lines.append(f'rig = "{self.rig_key}"')
        lines += [f'configuration = "{self.configuration}"', f"sample_rate_hz = {o.sample_rate_hz}"]
        for i, name in enumerate(names):
            force = i == 0
            sensitivity = o.hammer_sensitivity_mv if force else o.accelerometer_sensitivity_mv
            lines += [
                "",
                "[[channels]]",
                f'name = "{name}"',
                f'quantity = "{"force" if force else "acceleration"}"',
                f'unit = "{"N" if force else "m/s^2"}"',
                f"sensitivity_mv = {sensitivity}",
                f"full_scale_v = {o.converter_range_v}",
            ]
            if not force:
                lines.append(f'dof = "{self.sensors[i - 1]}"')
        return lines


def _known(names: Sequence[str], known: Sequence[str], what: str) -> list[str]:
    for name in names:
        if name not in known:
            raise EmaError(f"no {what} '{name}'{did_you_mean(name, known)}")
    return list(names)


def _places(texts: Sequence[str], assembly: Assembly) -> tuple[Dof, ...]:
    """The DOFs that this configuration has."""
    return tuple(d for d in map(Dof.parse, texts) if assembly.has_dof(d.point))


def _check_dofs(rig: Rig, configurations: Sequence[str], texts: Sequence[str]) -> None:
    for dof in map(Dof.parse, texts):
        if not any(rig.knows(c, dof) for c in configurations):
            rig.assembly(configurations[0]).row(dof.point)  # raises with a hint


def _check_bad_hits(options: SimulationSettings, configurations: Sequence[str]) -> None:
    for text in (*options.double_hits, *options.overloads):
        match = _HIT.match(text)
        if match is None:
            raise EmaError(f"hit '{text}' is not of the form [configuration:]dof#number, e.g. 'sun.y#2'")
        if match["configuration"] is not None:
            _known([match["configuration"]], configurations, "configuration")
        if not 1 <= int(match["number"]) <= options.hits:
            raise EmaError(f"hit '{text}': there are {options.hits} hits per point, numbered from 1")
