"""Vectors of numbers as a type of numba, and the operations that kernels have on them.

Each operation is one instruction of LLVM, which cuts vectors into the registers of the processor at hand. Kernels name
operations by `stability.cpu.products.Operation`, since this module imports numba.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.core.typing.templates import infer, make_intrinsic_template
from numba.extending import models, register_model

Typed = tuple[Any, Callable[..., Any]]
"""Signature of a call, and the function that writes its instruction."""


class Vector(types.Type):
    """Type of a vector of `width` numbers in double precision."""

    def __init__(self, width: int) -> None:
        super().__init__(f"Vector({width})")
        self.register = ir.VectorType(ir.DoubleType(), width)


@register_model(Vector)
class VectorModel(models.PrimitiveModel):
    """Vectors as LLVM has them."""

    def __init__(self, manager: Any, kind: Vector) -> None:
        super().__init__(manager, kind, kind.register)


def load(vector: Vector) -> Callable[..., Typed]:
    """`load(array, place)`: the numbers from an entry of a contiguous array on."""

    def write(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return builder.load(_address(context, builder, signature.args[0], given[0], given[1], vector.register), align=8)

    return lambda _, array, place: (vector(array, types.int64), write)


def spread(vector: Vector) -> Callable[..., Typed]:
    """`spread(array, place)`: an entry of a contiguous array in every place of a vector."""

    def write(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        number = builder.load(
            _address(context, builder, signature.args[0], given[0], given[1], ir.DoubleType()), align=8
        )
        first = builder.insert_element(vector.register(ir.Undefined), number, ir.IntType(32)(0))
        return builder.shuffle_vector(first, first, ir.VectorType(ir.IntType(32), vector.register.count)(None))

    return lambda _, array, place: (vector(array, types.int64), write)


def store(vector: Vector) -> Callable[..., Typed]:
    """`store(value, array, place)`: write a vector from an entry of a contiguous array on."""

    def write(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        place = _address(context, builder, signature.args[1], given[1], given[2], vector.register)
        builder.store(given[0], place, align=8)
        return context.get_dummy_value()

    return lambda _, value, array, place: (types.void(vector, array, types.int64), write)


def zeros(vector: Vector) -> Callable[..., Typed]:
    """`zeros()`: a vector of zeros."""
    return lambda _: (vector(), lambda *_: vector.register(None))


def add(vector: Vector) -> Callable[..., Typed]:
    """`add(total, one, other)`: `total + one other`, by one instruction where the processor has it."""

    def write(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return builder.fadd(given[0], builder.fmul(*given[1:], flags=("fast",)), flags=("fast",))

    return lambda _, total, one, other: (vector(vector, vector, vector), write)


def subtract(vector: Vector) -> Callable[..., Typed]:
    """`subtract(total, one, other)`: `total - one other`, as `add`."""

    def write(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return builder.fsub(given[0], builder.fmul(*given[1:], flags=("fast",)), flags=("fast",))

    return lambda _, total, one, other: (vector(vector, vector, vector), write)


def function_type(name: str, width: int) -> Any:
    """Return the type of an operation of this module, by which numba knows it."""
    template = make_intrinsic_template(object(), globals()[name](Vector(width)), f"{name}{width}")
    infer(template)
    return types.Function(template)


def _address(context: Any, builder: Any, kind: Any, array: Any, place: Any, entry: Any) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [place]), entry.as_pointer())
