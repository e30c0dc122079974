"""The raw folder of one configuration: its channels, its blows, its record files and test.toml."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.simulate.hammer import ForceHistory, Pulse
from ema_pipeline.simulate.hits import HitDraw, HitSeries, as_struck
from ema_pipeline.simulate.recorder import clip_peak, record_channel
from ema_pipeline.simulate.response import Respond, Signals
from ema_pipeline.simulate.sensing import HAMMER, ChannelDraw, with_sensors
from ema_pipeline.simulate.settings import SimulationSettings
from ema_pipeline.simulate.writers import SUFFIX, WRITERS

BAD_HIT = re.compile(r"^(?:(?P<configuration>[^:#]+):)?(?P<dof>[^:#]+)#(?P<number>\d+)$")
BLOW_WITHIN_S = 0.01
"""Latest start of a blow after the pre-trigger."""

LONGEST_CONTACT = 1.05
"""Longest contact of a hit over the stated one; the shortest is as much shorter."""

_BOUNCE_DELAY_S = (0.006, 0.012)
_BOUNCE_SIZE = (0.25, 0.5)

Blow = tuple[Pulse, ...]
"""One hit: a pulse, and its bounce where it has one."""


@dataclass(frozen=True)
class TestFolder:
    """One configuration's test: its channels and its blows.

    Attributes
    ----------
    rig : str
        Name of the rig, for the title.
    rig_key : str
        What test.toml says of the rig; empty where a rig.toml lies beside it.
    configuration : str
    sensors, impacts : tuple of Dof
    options : SimulationSettings
    channels : dict of str to ChannelDraw
        What the channels truly are, by DOF, and for the hammer; ideal where left out.
    """

    __test__: ClassVar[bool] = False  # not a test case, whatever pytest makes of the name

    rig: str
    rig_key: str
    configuration: str
    sensors: tuple[Dof, ...]
    impacts: tuple[Dof, ...]
    options: SimulationSettings
    channels: Mapping[str, ChannelDraw] = field(default_factory=dict)

    def write(
        self,
        folder: Path,
        assembly: Assembly,
        respond: Respond,
        random: np.random.Generator,
        series: HitSeries,
    ) -> list[dict[str, Any]]:
        """Write all record files and test.toml; return file, directions and frequencies of every record."""
        o = self.options
        names = self._channel_names()
        lines = self._header(names)
        offsets = o.offset_v * random.standard_normal(len(names))
        written: list[dict[str, Any]] = []
        for impact in self.impacts:
            plan = [
                (level, first)
                for level in o.peak_force_n
                for first in range(1, o.hits + 1, o.hits_per_record)
            ]
            blows = [self._blows(impact, level, first, random) for level, first in plan]
            draws = [self._draws(assembly, series, len(record)) for record in blows]
            signals = self._signals(assembly, respond, impact, blows, draws)
            for (level, first), drawn, (force, accelerations) in zip(plan, draws, signals, strict=True):
                hits = range(first, min(first + o.hits_per_record, o.hits + 1))
                if any(self._is_bad(o.overloads, impact, k) for k in hits):
                    force = clip_peak(force)
                volts = self._volts(force, accelerations, names, offsets, random)
                stem = str(impact).replace(".", "_").replace("-", "minus_")
                file = f"{stem}_{level:g}N_{first}{SUFFIX[o.format]}"
                WRITERS[o.format](folder / file, volts, o.sample_rate_hz)
                lines += ["", "[[records]]", f'file = "{file}"', f'impact = "{impact}"']
                written.append(
                    {
                        "file": file,
                        "aim_deg": [h.aim_deg for h in drawn],
                        "frequency_factor": [h.frequency_factor for h in drawn],
                    }
                )
        (folder / "test.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
        return written

    def _signals(
        self,
        assembly: Assembly,
        respond: Respond,
        impact: Dof,
        blows: list[tuple[Blow, ...]],
        draws: list[tuple[HitDraw, ...]],
    ) -> tuple[Signals, ...]:
        """Ideal force and accelerations of every record of one point."""
        o = self.options
        length = o.hits_per_record * round(o.duration_s * o.sample_rate_hz)
        if not o.imperfections.of_hits:
            histories = tuple(
                ForceHistory(tuple(chain(*record)), o.sample_rate_hz, length) for record in blows
            )
            return respond(assembly, histories, impact, self.sensors)
        seen, places = with_sensors(assembly, self.sensors, self.channels)
        angle = self.channels[impact.point].angle_rad if impact.point in self.channels else 0.0
        records = []
        for record, drawn in zip(blows, draws, strict=True):
            parts: list[Signals] = []
            for pulses, hit in self._together(assembly, record, drawn):
                struck, place = as_struck(seen, impact, hit, angle)
                history = ForceHistory(pulses, o.sample_rate_hz, length)
                parts += respond(struck, (history,), place, places)
            force, motion = (np.sum([part[i] for part in parts], axis=0) for i in (0, 1))
            records.append((force, motion))
        return tuple(records)

    @staticmethod
    def _draws(assembly: Assembly, series: HitSeries, count: int) -> tuple[HitDraw, ...]:
        """Draws of the hits of one record; those of a nonlinear rig are alike, because they are simulated at once."""
        drawn = tuple(series.draw() for _ in range(count))
        return drawn[:1] * count if assembly.nonlinear else drawn

    @staticmethod
    def _together(
        assembly: Assembly, record: tuple[Blow, ...], drawn: tuple[HitDraw, ...]
    ) -> list[tuple[tuple[Pulse, ...], HitDraw]]:
        """Blows of one record that are simulated at once, each with its draw: one by one where responses add up."""
        if assembly.nonlinear:
            return [(tuple(chain(*record)), drawn[0])]
        return list(zip(record, drawn, strict=True))

    def _blows(self, impact: Dof, level: float, first: int, random: np.random.Generator) -> tuple[Blow, ...]:
        """The hits of one record."""
        o = self.options
        blows = []
        for i, number in enumerate(range(first, min(first + o.hits_per_record, o.hits + 1))):
            time = i * o.duration_s + o.pretrigger_s + random.uniform(0, BLOW_WITHIN_S)
            peak = level * max(0.2, 1 + o.force_spread * random.standard_normal())
            pulses = [Pulse(time, peak, o.contact_s * random.uniform(2 - LONGEST_CONTACT, LONGEST_CONTACT))]
            if self._is_bad(o.double_hits, impact, number):
                pulses.append(
                    Pulse(
                        time + random.uniform(*_BOUNCE_DELAY_S),
                        peak * random.uniform(*_BOUNCE_SIZE),
                        o.contact_s,
                    )
                )
            blows.append(tuple(pulses))
        return tuple(blows)

    def _is_bad(self, hits: tuple[str, ...], impact: Dof, number: int) -> bool:
        for text in hits:
            match = BAD_HIT.match(text)
            assert match is not None  # checked at the start
            here = match["configuration"] in (None, self.configuration)
            if here and match["dof"] == str(impact) and int(match["number"]) == number:
                return True
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
        gains = [self._gain(point) for point in (HAMMER, *(s.point for s in self.sensors))]
        signals = np.vstack([force, accelerations]) * np.array(gains)[:, None]
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

    def _gain(self, point: str) -> float:
        """Reading over truth of the channel at a point."""
        return self.channels[point].gain if point in self.channels else 1.0

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
