"""What an effect is: physics that a base model may be missing, as an edit of the model's elements."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.laws import Nonlinear
from ema_pipeline.rigs.types import Parameter, Rig


@dataclass(frozen=True)
class EffectParameter:
    """A parameter of an effect.

    Attributes
    ----------
    name, unit : str
    null : float
        Value at which the effect is absent (or, as for an angle, does not matter).
    start : float
        Value of a clearly visible effect, from which a fit starts.
    scale : float
        Standard deviation of the prior about `null`: the size to expect where the effect is there.
    minimum, maximum : float
        Range in which the effect makes sense.
    description : str
        What the number means.
    below : float
        Prior probability that it is below `null`, where it can be: to be less of something is as usual as to be more,
        but a mass that is missing is seldom one that was taken off.
    """

    name: str
    unit: str
    null: float
    start: float
    scale: float
    minimum: float
    maximum: float
    description: str = ""
    below: float = 0.5


def _library_scales(assembly: Assembly, place: str) -> Mapping[str, float]:
    return {}


def _any_size(assembly: Assembly, place: str) -> Mapping[str, float]:
    return {}


def _no_other_place(assembly: Assembly, place: str) -> bool:
    return False


@dataclass(frozen=True)
class Effect:
    """A piece of physics that a base model may be missing.

    Attributes
    ----------
    id : str
        Name in ``id@place``.
    title : str
        What it is, in a few words.
    parameters : tuple of EffectParameter
    find_places : callable
        ``find_places(assembly) -> tuple of str``: where the effect can sit, found by the names of DOFs and
        elements, so that it works on any rig that has them.
    edit : callable
        ``edit(assembly, place, values) -> Assembly`` with all parameters in `values`.
    signs : str
        How it shows in measured data.
    reference : str
        Where it is described.
    linear : bool
        False where the response is not proportional to the force.
    other_places : callable
        ``other_places(assembly, place)``: True for places that are valid but too many to be listed.
    generic : bool
        True where the effect is known from no rig in particular: a rig's own name for the same physics comes first.
    scales : callable
        ``scales(assembly, place) -> dict``: prior 1 σ of sizes that depend on the rig; the parameters' own where left
        out.
    least : callable
        ``least(assembly, place) -> dict``: smallest sizes that the rig leaves possible, where that is more than the
        parameters' own range says: a spring that is not there cannot be lost.
    records_only : bool
        True for an effect that is sought in records of continuous excitation only.
    records_order : int, optional
        Where given, the effect is sought in records of continuous excitation at every DOF and between any two bodies,
        as generic effects are, and this is its place among them: what is simplest to say comes first. Generic effects
        that do not give it come last, by their ids.
    elsewhere : Effect, optional
        The same physics, under the same id, with the parameters that it has at places where this effect cannot sit.
    """

    id: str
    title: str
    parameters: tuple[EffectParameter, ...]
    find_places: Callable[[Assembly], tuple[str, ...]]
    edit: Callable[[Assembly, str, Mapping[str, float]], Assembly]
    signs: str
    reference: str = ""
    linear: bool = True
    other_places: Callable[[Assembly, str], bool] = _no_other_place
    generic: bool = False
    scales: Callable[[Assembly, str], Mapping[str, float]] = _library_scales
    least: Callable[[Assembly, str], Mapping[str, float]] = _any_size
    records_only: bool = False
    records_order: int | None = None
    elsewhere: Effect | None = None

    def places(self, rig: Rig, configuration: str) -> tuple[str, ...]:
        """Places of `rig` where the effect can sit in this configuration."""
        return self.find_places(rig.assembly(configuration))

    def at(self, assembly: Assembly, place: str) -> Effect:
        """The effect as it is at `place`: itself, or its form for other places."""
        if (
            self.elsewhere is not None
            and not self.fits(assembly, place)
            and self.elsewhere.fits(assembly, place)
        ):
            return self.elsewhere
        return self

    def possible(self, assembly: Assembly, place: str) -> Effect:
        """The effect with the range of sizes that the rig leaves possible at `place`."""
        least = self.least(assembly, place)
        if not least:
            return self
        narrowed = [replace(p, minimum=max(p.minimum, least.get(p.name, p.minimum))) for p in self.parameters]
        return replace(self, parameters=tuple(narrowed))

    def fits(self, assembly: Assembly, place: str) -> bool:
        """True where the effect can sit at `place`."""
        return place in self.find_places(assembly) or self.other_places(assembly, place)

    def values(self, given: Mapping[str, float] | None = None) -> dict[str, float]:
        """All parameters, null where not given; EmaError for an unknown name or a value out of range."""
        complete = {p.name: p.null for p in self.parameters}
        for name, value in (given or {}).items():
            if name not in complete:
                raise EmaError(f"effect '{self.id}' has no parameter '{name}'{did_you_mean(name, complete)}")
            parameter = next(p for p in self.parameters if p.name == name)
            # `not` catches NaN as well.
            if value != parameter.null and not parameter.minimum <= value <= parameter.maximum:
                raise EmaError(
                    f"effect '{self.id}': {name} = {value:g} {parameter.unit} lies outside "
                    f"{parameter.minimum:g} … {parameter.maximum:g}"
                )
            complete[name] = float(value)
        return complete

    def apply(self, assembly: Assembly, place: str, values: Mapping[str, float] | None = None) -> Assembly:
        """The assembly with the effect at `place`; parameters that are left out are null.

        Raises
        ------
        EmaError
            If the effect cannot sit there, or for unknown parameters and values out of range.
        """
        if not self.fits(assembly, place):
            raise EmaError(
                f"effect '{self.id}' cannot sit at '{place}'{did_you_mean(place, self.find_places(assembly))}"
            )
        return self.edit(assembly, place, self.values(values))


def effect_of(parameter: str) -> str:
    """``id@place`` of a rig's parameter that belongs to an effect, as `PlacedEffect.parameter_name` wrote it; else "".

    Places have dots, too: ``spring@m1`` is another effect than ``spring@m1.x``.
    """
    return parameter.rpartition(".")[0]


@dataclass(frozen=True)
class PlacedEffect:
    """An effect at a place, written ``id@place``."""

    effect: Effect
    place: str

    @property
    def label(self) -> str:
        """``id@place``."""
        return f"{self.effect.id}@{self.place}"

    def hosted(self, assembly: Assembly) -> tuple[PlacedEffect, dict[str, float]]:
        """With the range of sizes that a rig leaves possible at its place, and their prior 1 σ by name."""
        possible = PlacedEffect(self.effect.possible(assembly, self.place), self.place)
        return possible, dict(self.effect.scales(assembly, self.place))

    def nonlinear_of(self, assembly: Assembly) -> tuple[Nonlinear, ...]:
        """Nonlinear elements that an assembly gets with it, at the sizes from which fits begin; none where it has no
        such place.
        """
        if not self.effect.fits(assembly, self.place):
            return ()
        known = {e.name for e in assembly.nonlinear}
        edited = self.effect.edit(assembly, self.place, {p.name: p.start for p in self.effect.parameters})
        return tuple(e for e in edited.nonlinear if e.name not in known)

    def parameter_name(self, name: str) -> str:
        """Name of an effect's parameter among a rig's: ``id@place.name``."""
        return f"{self.label}.{name}"

    def parameters(self, values: Mapping[str, float] | None = None) -> dict[str, Parameter]:
        """The effect's parameters as free parameters of a rig; `start` values where not given."""
        self.effect.values(values)
        given = values or {}
        return {
            self.parameter_name(p.name): Parameter(
                name=self.parameter_name(p.name),
                value=float(given.get(p.name, p.start)),
                unit=p.unit,
                minimum=p.minimum,
                maximum=p.maximum,
                free=True,
            )
            for p in self.effect.parameters
        }
