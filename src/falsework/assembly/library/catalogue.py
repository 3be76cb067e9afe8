"""Catalogue of built-in structures: generators, parameter ranges and descriptions."""

from __future__ import annotations

import inspect
import math
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, ParamSpec

from falsework.assembly.library.blocks import Blocks
from falsework.assembly.model import DENSITY, FRICTION, Assembly
from falsework.errors import InputError

P = ParamSpec("P")
Number = int | float


@dataclass(frozen=True)
class Range:
    """Annotation of a generator's parameter: its meaning and its valid range."""

    minimum: Number
    maximum: Number
    meaning: str
    unit: str = ""


@dataclass(frozen=True)
class Parameter:
    """One parameter of a built-in structure, as data."""

    name: str
    kind: type[int] | type[float]
    default: Number
    minimum: Number
    maximum: Number
    meaning: str
    unit: str = ""

    def check(self, value: Any, owner: str) -> Number:
        """Return the value as the parameter's kind."""
        text = isinstance(value, str)
        try:
            number = float(value) if not isinstance(value, bool) else math.nan
        except (TypeError, ValueError, OverflowError):
            number = math.nan
        whole = number.is_integer() and not (text and not value.strip().lstrip("+-").isdecimal())
        fits = self.minimum <= number <= self.maximum
        if not fits or (self.kind is int and not whole):
            raise InputError(f"{owner}: {self.name} is {value if text else repr(value)}; give {self.range_text}")
        return self.kind(number)

    @property
    def range_text(self) -> str:
        """Description of the valid values, such as `a whole number from 3 to 1000`."""
        noun = "a whole number" if self.kind is int else "a number"
        return f"{noun} from {self.minimum} to {self.maximum}{self.unit and ' ' + self.unit} ({self.meaning})"


@dataclass(frozen=True, eq=False, repr=False)
class Structure(Generic[P]):
    """A built-in structure; call it with its parameters to make the assembly.

    `generate` makes the meshes alone, `__call__` the assembly with the default density and friction.
    """

    name: str
    description: str
    details: tuple[Parameter, ...]
    """Parameters with ranges and units, in order."""
    generator: Callable[P, Blocks]

    def __repr__(self) -> str:
        return f"<built-in structure {self.name}>"

    @property
    def parameters(self) -> dict[str, Number]:
        """Names of the parameters and their defaults."""
        return {parameter.name: parameter.default for parameter in self.details}

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> Assembly:
        """Make the assembly."""
        return self.make(self._bind(*args, **kwargs))

    def generate(self, *args: P.args, **kwargs: P.kwargs) -> Blocks:
        """Make the meshes and their boundary mask; raises like `__call__`."""
        return self._blocks(self.checked(self._bind(*args, **kwargs)))

    def make(
        self, values: Mapping[str, Any], *, density: float | None = None, friction: float | None = None
    ) -> Assembly:
        """Make the assembly from values by name; the name that it gets builds it again.

        Args:
            values: by parameter; those left out take their defaults.
            density: kg/m3; `DENSITY` if not given.
            friction: coefficient; `FRICTION` if not given.
        """
        values = self.checked(values)
        defaults = {**self.parameters, "density": DENSITY, "friction": FRICTION}
        density = DENSITY if density is None else density
        friction = FRICTION if friction is None else friction
        chosen = {**values, "density": density, "friction": friction}
        changes = ",".join(f"{name}={value}" for name, value in chosen.items() if value != defaults[name])
        name = f"{self.name}:{changes}" if changes else self.name
        blocks = self._blocks(values)
        return Assembly.from_meshes(
            blocks.meshes, boundary=blocks.boundary, density=density, friction=friction, name=name
        )

    def checked(self, values: Mapping[str, Any]) -> dict[str, Number]:
        """Fill in defaults and check types and ranges."""
        unknown = [name for name in values if name not in self.parameters]
        if unknown:
            raise InputError(f"{self.name} has no parameter {unknown[0]!r}; it has {', '.join(self.parameters)}")
        return {entry.name: entry.check(values.get(entry.name, entry.default), self.name) for entry in self.details}

    def _blocks(self, values: dict[str, Number]) -> Blocks:
        try:
            return self.generator(**values)  # type: ignore[call-arg]
        except InputError as error:
            raise InputError(f"{self.name}: {error}") from None

    def _bind(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        if len(args) > len(self.details):
            raise InputError(f"{self.name} takes {len(self.details)} parameters, not {len(args)}")
        named = {entry.name: value for entry, value in zip(self.details, args, strict=False)}
        twice = named.keys() & kwargs.keys()
        if twice:
            raise InputError(f"{self.name}: {min(twice)} is given twice")
        return {**named, **kwargs}


def structure(name: str) -> Callable[[Callable[P, Blocks]], Structure[P]]:
    """Turn a generator into a built-in structure.

    Every parameter of the generator is annotated `Annotated[int or float, Range(...)]` and has a default;
    the first line of its docstring is the description in the catalogue. Errors that the generator raises
    get the structure's name in front.
    """

    def wrap(generator: Callable[P, Blocks]) -> Structure[P]:
        hints = typing.get_type_hints(generator, include_extras=True)
        details = []
        for key, entry in inspect.signature(generator).parameters.items():
            kind, limits = typing.get_args(hints[key])
            details.append(
                Parameter(key, kind, entry.default, limits.minimum, limits.maximum, limits.meaning, limits.unit)
            )
        about = inspect.cleandoc(generator.__doc__ or name)
        made = Structure(name, about.splitlines()[0], tuple(details), generator)
        lines = [f"    {entry.name}: {entry.range_text}; {entry.default} if not given." for entry in details]
        object.__setattr__(made, "__doc__", "\n".join([about, "", "Args:", *lines]))
        return made

    return wrap
