"""Measured modes as observations: frequencies, damping ratios and shapes of every configuration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ema_pipeline.dof import Dof
from ema_pipeline.effects.base import PlacedEffect
from ema_pipeline.frf.channels import ChannelQuality
from ema_pipeline.inference import Residuals, Scatter
from ema_pipeline.ingest.defaults import CALIBRATION_STD
from ema_pipeline.observations.base import Observations
from ema_pipeline.observations.mode_data import ModeData
from ema_pipeline.observations.mode_problem import CALIBRATION, MIXING, ModeProblem
from ema_pipeline.observations.mode_rows import FREQUENCY, FREQUENCY_NOISE, SHAPE, SHAPE_NOISE, UNEVEN_DAMPING
from ema_pipeline.observations.parts import (
    DAMPING_SCATTER,
    DIRECTION_SCATTER,
    DIRECTION_STD,
    JOINT_DAMPING,
    MASS_SCATTER,
    MASS_STD,
    PART_SCATTER,
    STIFFNESS_STD,
    Dependence,
    dependence,
    has_pieces,
)
from ema_pipeline.observations.rig_model import RigModel
from ema_pipeline.observations.sensing import Sensing
from ema_pipeline.rigs.types import Rig


def scatters_of(rig: Rig) -> dict[str, Scatter]:
    """The hyper-parameters of measured modes, with the defaults that the rig states."""
    known = (
        Scatter(PART_SCATTER, "stiffness of parts", STIFFNESS_STD, 0.7, 0.04),
        # Drawings and scales are trusted more than masses deserve (fasteners, oil, cables): a wide prior.
        Scatter(MASS_SCATTER, "mass of parts", MASS_STD, 1.0, 0.02, 8.0),
        Scatter(CALIBRATION, "calibration", CALIBRATION_STD, 0.7, 0.04),
        Scatter(DAMPING_SCATTER, "ln ζ from mode to mode", rig.modal_damping_scatter, 0.5, 0.5),
        Scatter(FREQUENCY, "frequency", 3e-4, 0.7, 1e-3, 2.0, 0.2),
        Scatter(SHAPE, "shapes", 0.015, 0.5, 0.03, 1.5, 0.03),
        # Joints whose damping scatters by 30 to 60 % couple modes by 0.1 to 0.5: less than that tells of no damper.
        Scatter(UNEVEN_DAMPING, "damping from part to part", 0.3, 0.5, 1.0, 5.0, 1.0),
        # What hits have in common (drift, aim) is in their scatter, and no error of one mode against another.
        Scatter(FREQUENCY_NOISE, "stated uncertainty of frequencies", 1.0, 0.5, most=2.0),
        # Without a bound it falls to nothing where many modes agree, and those that the test hardly knows are outliers.
        Scatter(SHAPE_NOISE, "stated uncertainty of shapes", 1.0, 0.5, least=0.1),
        Scatter(MIXING, "shapes of close modes along each other", 0.01, 1.0, 0.03, 5.0),
    )
    pieces = (Scatter(DIRECTION_SCATTER, "stiffness of a bearing's directions", DIRECTION_STD, 0.7, 0.04),)
    return {s.name: s for s in (*known[:1], *(pieces if has_pieces(rig) else ()), *known[1:])}


_BESIDE_JOINTS = {
    JOINT_DAMPING: Scatter(JOINT_DAMPING, "ln of damping from joint to joint", 0.3, 0.3, 1.0, 5.0, 0.05),
    UNEVEN_DAMPING: Scatter(UNEVEN_DAMPING, "damping from part to part", 0.3, 0.5, 1.0, 5.0, 0.1),
}
"""Where every joint's damping is an unknown of its own: what uneven damping does beside that is little."""
_ABOVE = 1.3
"""Frequency, over the highest measured one, up to which modes may be near the band."""


class ModeObservations(Observations):
    """Measured modes of a rig's configurations.

    Parameters
    ----------
    rig : Rig
        Without effects.
    data : sequence of ModeData
    channels : dict of str to ChannelQuality, optional
        By DOF; the defaults where left out.
    shared : Dependence, optional
        Of the rig, where it is known already.
    sensors : tuple of str, optional
        DOFs whose calibration is unknown; those of `data` where left out.
    test : str
        Name of the test among several whose unknowns are shared: its drift is its own.
    own_damping : dict of str to int, optional
        How many undamped modes have a damping ratio that is an unknown of its own, see `RigModel`.
    middle_hz : float
        See `RigModel`; that of `data` where left out.
    joints : bool
        See `RigModel`.

    Attributes
    ----------
    sensing : dict
        What the sensors of a configuration read, by it and the id of its data, the positions of unknowns counted from
        the first one that is not the model's: the same for all models, so cached here by their problems.
    """

    def __init__(
        self,
        rig: Rig,
        data: Sequence[ModeData],
        channels: Mapping[str, ChannelQuality] | None = None,
        shared: Dependence | None = None,
        sensors: tuple[str, ...] = (),
        test: str = "",
        own_damping: Mapping[str, int] | None = None,
        middle_hz: float = 0.0,
        joints: bool = False,
    ) -> None:
        self.rig, self.test, self.own_damping, self.joints = rig, test, dict(own_damping or {}), joints
        self.data = tuple(d for d in data if len(d))
        self.middle_hz = middle_hz or _middle_hz(self.data)
        self.sensors = sensors or tuple(dict.fromkeys(d.point for one in data for d in one.dofs))
        self.channels = dict(channels or {})
        self.shared = shared or dependence(rig)
        self.scatters = scatters_of(rig) | (_BESIDE_JOINTS if joints else {})
        self.sensing: dict[tuple[str, int], tuple[ModeData, Sensing]] = {}
        self._has: dict[tuple[str, Dof], bool] = {}

    def channel(self, sensor: str) -> ChannelQuality:
        """What is known of the channel that measures a DOF; the defaults where nothing was stated."""
        return self.channels.get(sensor, ChannelQuality())

    def has(self, configuration: str, dof: Dof) -> bool:
        """True where the rig can be measured at `dof`; asked for every model, so cached."""
        key = (configuration, dof)
        if key not in self._has:
            self._has[key] = self.rig.knows(configuration, dof)
        return self._has[key]

    def problem(self, effects: Sequence[PlacedEffect], scales: Mapping[str, float]) -> ModeProblem:
        """See `Observations`."""
        damping = self.own_damping, self.middle_hz, self.joints
        return ModeProblem(self, RigModel(self.rig, effects, scales, self.shared, *damping))

    def suited(self, effects: Sequence[PlacedEffect]) -> ModeObservations:
        """See `Observations`: where damping or gyroscopic effects couple modes, each has a damping ratio of its own.

        How much the damping of single modes scatters then shows in the shapes of close ones, too. Where nothing couples
        them it shows in their damping ratios alone, which need no unknowns for that. Beside dampers, every joint has a
        loss of its own as well: both show in phases.
        """
        if self.joints:
            return self
        model = RigModel(self.rig, effects, {}, self.shared)
        coupled = [model.couples(d.configuration) for d in self.data]
        joints = any(by_dampers for by_dampers, _ in coupled)
        if not joints and (self.own_damping or not any(skew for _, skew in coupled)):
            return self
        own = self.own_damping or {d.configuration: self._modes_near(d) for d in self.data}
        return self._with(self.data, own, joints)

    def _modes_near(self, data: ModeData) -> int:
        """Number of undamped modes of the rig that may be in the band or near it: nominal values may be far off."""
        top = float(np.exp(np.max(data.log_frequency)))
        rig = RigModel(self.rig, (), {}, self.shared)
        return rig.count_below(data.configuration, _ABOVE * top, 2 * len(data))

    def without_lag(self) -> ModeObservations:
        """The same without imaginary parts of shapes that are compared as real ones, see `ModeData.lagging`."""
        if not any(d.lagging.any() for d in self.data):
            return self
        return self.with_data([d.without_lag() for d in self.data])

    def with_data(self, data: Sequence[ModeData]) -> ModeObservations:
        """The same rig and channels with other modes."""
        return self._with(data, self.own_damping, self.joints)

    def _with(
        self, data: Sequence[ModeData], own_damping: Mapping[str, int], joints: bool
    ) -> ModeObservations:
        known, damping = (self.channels, self.shared, self.sensors, self.test), (own_damping, self.middle_hz)
        return ModeObservations(self.rig, data, *known, *damping, joints)

    def holding_out_explained(self, found: Residuals) -> ModeObservations:
        """See `Observations`."""
        if not isinstance(found.matching, tuple) or not any(np.any(m < 0) for m in found.matching):
            return self
        return self.with_data(
            [replace(d, always=m < 0) for d, m in zip(self.data, found.matching, strict=True)]
        )

    def folds(self, count: int = 4) -> list[tuple[ModeObservations, ModeObservations]]:
        """Every `count`-th mode held out in turn, over all configurations; close modes of one group go together.

        How one of two close modes turns into the other is no linear function of what a fit to the other one tells.
        """
        total, units = 0, []
        for d in self.data:
            units.append(total + d.unit)
            total = int(np.max(units[-1])) + 1
        pairs = []
        for k in range(min(count, total)):
            kept, out = [], []
            for d, unit in zip(self.data, units, strict=True):
                held = unit % count == k
                if d.always is not None:
                    held &= ~d.always
                kept.append(d.only(~held))
                out.append(d.only(held))
            if not any(map(len, out)):  # all of it is never held out
                continue
            pairs.append((self.with_data(kept), self.with_data(out)))
        return pairs


def _middle_hz(data: Sequence[ModeData]) -> float:
    """Geometric mean of the frequencies whose damping was measured; 0 where there are fewer than two."""
    log = np.concatenate([d.log_frequency[np.isfinite(d.log_damping)] for d in data] or [np.zeros(0)])
    return float(np.exp(np.mean(log))) if len(log) > 1 else 0.0
