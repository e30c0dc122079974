"""Records of continuous excitation as observations: the model driven by the measured force, its response compared.

A response is compared line by line of its Fourier transform. Each band of frequency has a noise of its own, learned
with everything else, and so is a share of the response itself: noise in the measured force is the larger the nearer a
resonance, so that peaks tell less of the model than their height above the rest promises. The state
at the start of a record is unknown; a periodic record is compared with the steady response.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from ema_pipeline.effects.base import PlacedEffect
from ema_pipeline.effects.generic import is_place, place_rows
from ema_pipeline.errors import EmaError
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.inference import Scatter
from ema_pipeline.ingest.driven import DrivenRecord
from ema_pipeline.mechanics.driven_system import DrivenSystem, Slopes
from ema_pipeline.mechanics.simulation import FINE, Sensors, substeps_for
from ema_pipeline.observations.base import Observations
from ema_pipeline.observations.linear_start import linear_start
from ema_pipeline.observations.parts import DAMPING
from ema_pipeline.observations.record_data import BANDS, DISCREPANCY, SHARE, RecordData
from ema_pipeline.observations.record_model import Basis, RecordModel, loosened
from ema_pipeline.observations.record_motion import Motion, simulated
from ema_pipeline.observations.record_problem import Lines, RecordProblem
from ema_pipeline.observations.rig_model import RigModel
from ema_pipeline.observations.typical import Typical
from ema_pipeline.rigs.types import Rig

MOST_COORDINATES = 5
"""Coordinates of a model up to which its records are simulated."""
_WIDE = 10.0
"""Noise, in units of the discrepancy, with which fits begin: a linear model of a nonlinear rig misses a tenth."""
_MOST_NOISE = 1e3
_LITTLE = 0.3
"""Median of the share of a response that no model explains, in units of the discrepancy."""
_SET_UP = 0.1
"""Mean of a displacement, as a share of its root mean square, from which its zero is arbitrary."""
_RIGID = 1e-9
"""Squared frequency, over the highest, below which a mode is a rigid motion."""
_SLOWEST = 0.5
"""Frequency, over the lowest natural one, below which integrated accelerations are noise."""
_NO_ZERO = 1e-6
"""Prior 1 σ of a zero, in units of the discrepancy, up to which the zero is known."""
_LEAST_SAMPLES = 1024
"""Samples of every response, in windows, that hypotheses are compared on however many responses there are."""
_CYCLES = 4
"""Cycles in a window: a model off by an eighth in frequency gets out of step by half a cycle."""
_HEADROOM = 1.3
"""Factor by which effects may raise the highest natural frequency before steps become coarser than meant."""


class RecordObservations(Observations):
    """Records of one configuration of a rig.

    Parameters
    ----------
    rig : Rig
        Without effects.
    configuration : str
    records : sequence of DrivenRecord or RecordData
        What the model is fitted to.
    held_out : sequence of DrivenRecord or RecordData
        What it is judged by.
    frfs : FrfSet
        Of the same test: where the search for the linear values begins.
    basis : Basis, optional
        Of other records of the same test: unknowns and their units are then the same.
    like : RecordObservations, optional
        What these records are a part of: sizes to expect and noise are then counted in its units.
    modal : bool
        True where the rig was made of identified modes: effects can sit where sensors are only.
    phase : float
        By which the highest mode may turn in one step, rad.

    Raises
    ------
    EmaError
        Without records to fit, and for a rig that lacks a measured DOF.
    """

    slow = True

    def __init__(
        self,
        rig: Rig,
        configuration: str,
        records: Sequence[DrivenRecord | RecordData],
        held_out: Sequence[DrivenRecord | RecordData] = (),
        frfs: FrfSet | None = None,
        basis: Basis | None = None,
        like: RecordObservations | None = None,
        modal: bool = False,
        phase: float = FINE,
    ) -> None:
        if not records:
            raise EmaError('no record to fit; give at least one use = "fit"')
        self.rig, self.configuration = rig, configuration
        self.data = tuple(r if isinstance(r, RecordData) else RecordData.of(r) for r in records)
        self.held_out = tuple(held_out)
        self.basis = basis or _basis(rig, configuration, [d.record for d in self.data], frfs)
        self.like, self.modal, self.phase = like, modal, phase
        self.scatters = self._scatters()
        self.finds_states = (
            False  # True where states at the start are found from the first samples, not fitted
        )
        self.last_prediction: tuple[RecordProblem, NDArray[np.float64], list[Lines]] | None = (
            None  # what a problem of these records predicted last, with derivatives, and where
        )

    @cached_property
    def sample_rate_hz(self) -> float:
        """Of all records."""
        return self.data[0].record.sample_rate_hz

    @cached_property
    def rms(self) -> NDArray[np.float64]:
        """Root mean square of every response over the records that models are fitted to, (n_outputs,)."""
        if self.like is not None:
            return self.like.rms
        return np.asarray(np.sqrt(np.mean([d.rms**2 for d in self.data], axis=0)))

    def _scatters(self) -> dict[str, Scatter]:
        """The noise of every response in every band, in units of the discrepancy."""
        width = self.sample_rate_hz / 2 / BANDS
        found = {}
        for o, dof in enumerate(self.basis.outputs):
            for b in range(BANDS):
                title = f"what no model explains at {dof.point}, {b * width:.4g} to {(b + 1) * width:.4g} Hz"
                name = self.noise_name(o, b)
                found[name] = Scatter(name, title, 1.0, 1.5, _WIDE, _MOST_NOISE)
        title = (
            "share of every line of a response that no model explains, e.g. because of noise in the force, %"
        )
        found[SHARE] = Scatter(SHARE, title, _LITTLE, 1.5, 1.0, _MOST_NOISE)
        return found

    def noise_name(self, output: int, band: int) -> str:
        """Name of the scatter of one response in one band."""
        return f"noise of {self.basis.outputs[output].point} in band {band + 1}"

    @cached_property
    def linear_model(self) -> RecordModel:
        """The rig without effects."""
        return RecordModel(self.basis, (), {})

    @cached_property
    def substeps(self) -> int:
        """Steps per sample."""
        linear = self.linear_model.linear(self.linear_model.start())
        return substeps_for(linear, self.sample_rate_hz, self.phase / _HEADROOM)

    def scaled(self, placed: PlacedEffect) -> PlacedEffect:
        """An effect with the starts and prior scales of its sizes as these records suggest, if they can."""
        assembly = self.basis.rig.assembly(self.configuration)
        if placed.place not in assembly.bodies and not is_place(assembly, placed.place):
            return placed
        return self.typical(placed.place).scaled(placed)

    def typical(self, place: str) -> Typical:
        """Motion and restoring force at a place, of the linear model at the start of the search."""
        if self.like is not None:
            return self.like.typical(place)
        states, mass = self._linear_motion
        n = len(mass)
        assembly = self.basis.rig.assembly(self.configuration)
        found = []
        for row in place_rows(assembly, place):
            v = np.array([row.get(d, 0.0) for d in assembly.dofs])
            x = float(np.std(states[:, :n] @ v))
            rate = float(np.std(states[:, n : 2 * n] @ v))
            moved = 1 / float(v @ np.linalg.solve(mass, v))
            omega = rate / max(x, 1e-300)
            found.append((x, omega, moved * omega**2 * x))
        x, omega, force = max(found)
        root = np.sqrt(2)
        return Typical(root * max(x, 1e-300), max(omega, 1e-300), root * max(force, 1e-300))

    @cached_property
    def _linear_motion(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """States of the linear model in the first record, and its mass matrix."""
        model = self.linear_model
        x = model.start()
        system = model.driven(x)
        found = self.motion(self.data[0], system, np.zeros((len(self.data[0].starts), system.size)))
        if found is None:
            if self.modal:
                raise EmaError(
                    "the response of the identified modes grows without bound; check the FRFs: a sensor that "
                    "drifts or has a wrong unit produces spurious modes. Leave it out, or give a rig file with --rig"
                )
            raise EmaError(f"rig '{self.rig.name}' without effects grows without bound; check its elements")
        return found.states.reshape(-1, system.size), model.linear(x).mass

    @cached_property
    def begin_scale(self) -> NDArray[np.float64]:
        """Size of every displacement and velocity, (2n,): 1 σ of the unknown states at the start of records."""
        if self.like is not None:
            return self.like.begin_scale
        states, mass = self._linear_motion
        return np.asarray(np.maximum(np.std(states[:, : 2 * len(mass)], axis=0), 1e-300))

    @cached_property
    def lowest_hz(self) -> float:
        """Lowest natural frequency of the linear model, rigid motion aside."""
        if self.like is not None:
            return self.like.lowest_hz
        linear = self.linear_model.linear(self.linear_model.start())
        squares = scipy.linalg.eigh(linear.stiffness, linear.mass, eigvals_only=True)
        return float(np.sqrt(np.min(squares[squares > _RIGID * np.max(squares)]))) / (2 * np.pi)

    def suggested(self, data: RecordData) -> NDArray[np.float64]:
        """State at the start of every window that the sensors suggest, (n_windows, 2n): 0 for what they do not see.

        Of a whole record it is rest: its ends are no place to integrate.
        """
        if not data.windowed:
            return np.zeros((1, len(self.begin_scale)))
        known: dict[float, NDArray[np.float64]] = data.__dict__.setdefault("_suggested", {})
        slowest = _SLOWEST * self.lowest_hz
        if slowest not in known:
            x, v = data.motion(slowest)
            x = x - np.where(self.basis.zero_std > _NO_ZERO, np.mean(x, axis=1), 0.0)[:, None]
            back = np.linalg.pinv(self.basis.rows[1])
            known[slowest] = np.concatenate([back @ x[:, data.starts], back @ v[:, data.starts]]).T
        return known[slowest]

    def in_windows(self, samples: int) -> RecordObservations:
        """The same test with all records in windows of a few cycles, about so many samples of all responses together.

        A simulation that runs through a long record is out of step with the measured motion wherever the model is not
        yet right, so that a fit of it has many local optima. Within a few cycles from a state near the measured one no
        model gets far out of step. Known as multiple shooting.

        References
        ----------
        H. G. Bock, Recent advances in parameter identification techniques for O.D.E., *Numerical Treatment of Inverse
        Problems in Differential and Integral Equations* (1983).
        """
        held_out = [d if isinstance(d, RecordData) else RecordData.of(d) for d in self.held_out]
        return self.with_records(self._windows(self.data, samples), self._windows(held_out, samples))

    def _windows(self, records: Sequence[RecordData], samples: int) -> list[RecordData]:
        found = []
        share = max(samples // len(self.basis.outputs), _LEAST_SAMPLES) // max(len(records), 1)
        for data in records:
            x, v = data.motion(_SLOWEST * self.lowest_hz)
            ratio = np.std(v, axis=1) / np.maximum(np.std(x, axis=1), 1e-300)
            length = round(_CYCLES * 2 * np.pi * self.sample_rate_hz / max(float(np.median(ratio)), 1e-300))
            found.append(data.windows(length, share))
        return found

    @cached_property
    def slowest_rad_s(self) -> float:
        """Least decay rate of a mode of the linear model, halved."""
        system = self.linear_model.driven(self.linear_model.start())
        n = len(system.stiffness)
        first_order = np.block([[np.zeros((n, n)), np.eye(n)], [-system.stiffness, -system.damping]])
        return 0.5 * float(np.min(np.abs(np.linalg.eigvals(first_order).real)))

    @cached_property
    def sensors(self) -> Sensors:
        """What the response channels read."""
        return Sensors(self.basis.rows[1], self.basis.quantities)

    def motion(
        self, data: RecordData, system: DrivenSystem, begin: NDArray[np.float64], slopes: Slopes | None = None
    ) -> Motion | None:
        """What a system does in one record; None where its motion grows without bound."""
        return simulated(data, self.substeps, self.slowest_rad_s, self.sensors, system, begin, slopes)

    def problem(self, effects: Sequence[PlacedEffect], scales: Mapping[str, float]) -> RecordProblem:
        """See `Observations`."""
        return RecordProblem(self, RecordModel(self.basis, [self.scaled(e) for e in effects], scales))

    def with_records(
        self,
        records: Sequence[DrivenRecord | RecordData],
        held_out: Sequence[DrivenRecord | RecordData],
        basis: Basis | None = None,
        phase: float | None = None,
    ) -> RecordObservations:
        """The same test with other records, or pieces of them."""
        used = basis or self.basis
        return RecordObservations(
            self.rig, self.configuration, records, held_out, None, used, self.like or self, self.modal,
            phase or self.phase,
        )  # fmt: skip

    def folds(self) -> Sequence[tuple[RecordObservations, RecordObservations]]:
        """The records that the test holds out; none where it holds out none."""
        return self._folds

    @cached_property
    def _folds(self) -> tuple[tuple[RecordObservations, RecordObservations], ...]:
        if not self.held_out:
            return ()
        other = self.with_records(self.held_out, ())
        other.finds_states = True
        return ((self, other),)


def _basis(rig: Rig, configuration: str, records: Sequence[DrivenRecord], frfs: FrfSet | None) -> Basis:
    first = records[0]
    rig, shared, loose = loosened(rig, configuration)
    model = RigModel(rig, (), {}, shared)
    damping = DAMPING if model.has_ratio else ""
    centre = {} if frfs is None else linear_start(model, configuration, list(loose), damping, frfs)
    return Basis(
        rig=rig,
        configuration=configuration,
        shared=shared,
        loose=loose,
        inputs=tuple(replace(f.dof, sign=1) for f in first.forces),
        outputs=tuple(replace(c.dof, sign=1) for c in first.channels),
        quantities=tuple(c.quantity for c in first.channels),
        calibration=(
            *((f.name, f.calibration_std) for f in first.forces),
            *((c.name, c.calibration_std) for c in first.channels),
        ),
        force_rms=np.std(np.concatenate([r.force for r in records], axis=1), axis=1),
        zero_std=_zero_std(np.concatenate([r.responses for r in records], axis=1)),
        centre=centre,
    )


def _zero_std(responses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Prior 1 σ of what responses read at rest: nothing where their mean is small, else as large as that mean.

    A displacement with a small mean counts from the position at rest, and its mean tells of springs that differ
    between pull and push. With a large one it counts from wherever the sensor was set up.
    """
    mean, rms = np.abs(np.mean(responses, axis=1)), np.std(responses, axis=1)
    return np.asarray(np.where(mean > _SET_UP * rms, mean / np.maximum(DISCREPANCY * rms, 1e-300), 1e-9))
