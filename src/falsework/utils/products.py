"""Products of small dense matrices in vector registers, as operations that kernels call.

numba keeps sums over a small matrix in memory, since it cannot tell that its arrays do not overlap. Here they are
written in LLVM's intermediate code for vectors of eight numbers, which LLVM cuts into those of the processor at hand.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

ROWS = 6
"""Rows of a product."""
LANES = 8
"""Columns that are computed at once; what is left of an even number of columns takes half as many, and a quarter."""


class Operation:
    """Function that kernels call and that is written in intermediate code, without a value."""

    def __call__(self, *arguments: Any) -> None:
        """Refuse to run outside of a kernel."""
        raise TypeError(f"{type(self).__name__} is part of kernels; call a kernel that uses it")

    @cached_property
    def _numba_type_(self) -> Any:
        from numba.core import types
        from numba.core.typing.templates import infer, make_intrinsic_template

        def answer(kinds: Sequence[Any]) -> tuple[Any, Callable[..., Any]]:
            words = [types.int64 if isinstance(kind, types.Integer) else kind for kind in kinds]
            return types.void(*words), self._write

        template = make_intrinsic_template(self, self._define(answer), type(self).__name__)
        infer(template)
        return types.Function(template)

    def _define(self, answer: Callable[[Sequence[Any]], Any]) -> Callable[..., Any]:
        """Return a function whose arguments name those of the operation, and that passes their types on."""
        raise NotImplementedError

    def _write(self, context: Any, builder: Any, signature: Any, given: Sequence[Any]) -> Any:
        """Write the intermediate code of one call."""
        raise NotImplementedError


class Product(Operation):
    """`out + sign left^T right`, or without the first term, written to the six rows of `out`.

    The operation takes `left`, `right` and `out`, each as an array, the place of its first entry and the distance of
    its rows; then the rows of `left` and `right` in sixes, at least one, and the number of columns of `right` and
    `out`, which is even. `left` has six columns. Without the first term `out` may be `right`, if that has six rows.
    """

    def __init__(self, sign: int, *, adds: bool = True) -> None:
        self.sign, self.adds = sign, adds

    def _define(self, answer: Callable[[Sequence[Any]], Any]) -> Callable[..., Any]:
        def define(_, left, place, wide, right, place_right, wide_right, out, place_out, wide_out, sixes, columns):
            return answer((left, place, wide, right, place_right, wide_right, out, place_out, wide_out, sixes, columns))

        return define

    def _write(self, context: Any, builder: Any, signature: Any, given: Sequence[Any]) -> Any:
        code = _Writer(context, builder)
        strip = self._strip(code, signature.args, given[:9], given[9])
        whole = builder.and_(given[10], code.word(-LANES))
        code.when(whole, lambda: code.count(whole, LANES, lambda column: strip(LANES, column)))
        for width in (LANES // 2, LANES // 4):
            some = builder.and_(given[10], code.word(width))
            code.when(some, lambda width=width, column=whole: strip(width, column))
            whole = builder.add(whole, some)
        return context.get_dummy_value()

    def _strip(
        self, code: _Writer, kinds: Sequence[Any], given: Sequence[Any], sixes: Any
    ) -> Callable[[int, Any], None]:
        """Return a function that writes the product for so many columns from one on."""
        left, right, out = (code.address(kinds[k], given[k], given[k + 1]) for k in (0, 3, 6))
        wide, wide_right, wide_out = given[2], given[5], given[8]

        def strip(width: int, column: Any) -> None:
            places = [code.after(out, column, code.times(r, wide_out)) for r in range(ROWS)]
            first = [code.load(place, width) if self.adds else code.zeros(width) for place in places]

            def term(six: Any, sums: Sequence[Any]) -> Sequence[Any]:
                start = code.after(left, code.times(code.times(ROWS, six), wide))
                other = code.after(right, column, code.times(code.times(ROWS, six), wide_right))
                for _ in range(ROWS):
                    others = code.load(other, width)
                    factors = [code.spread(code.after(start, code.word(r)), width) for r in range(ROWS)]
                    sums = [code.add(*three, others, self.sign) for three in zip(sums, factors, strict=True)]
                    start, other = code.after(start, wide), code.after(other, wide_right)
                return sums

            for place, total in zip(places, code.loop(sixes, first, term), strict=True):
                code.store(total, place)

        return strip


class SquareProduct(Product):
    """The same for six rows of `left` and eight columns of `right`, without the last two arguments."""

    def _define(self, answer: Callable[[Sequence[Any]], Any]) -> Callable[..., Any]:
        def define(_, left, place, wide, right, place_right, wide_right, out, place_out, wide_out):
            return answer((left, place, wide, right, place_right, wide_right, out, place_out, wide_out))

        return define

    def _write(self, context: Any, builder: Any, signature: Any, given: Sequence[Any]) -> Any:
        code = _Writer(context, builder)
        self._strip(code, signature.args, given, 1)(LANES, code.word(0))
        return context.get_dummy_value()


class Congruence(Operation):
    """`out = sum over points of B k^T B^T`, with three rows of `B^T` and a matrix `k` of 3 x 3 for each point.

    The operation takes the rows of eight numbers, of which the first six count, and the first point in them; the
    matrices, each in nine numbers, from the first point on; the number of points, at least one; and `out`, six rows of
    eight numbers.
    """

    def _define(self, answer: Callable[[Sequence[Any]], Any]) -> Callable[..., Any]:
        def define(_, rows, point, matrices, points, out):
            return answer((rows, point, matrices, points, out))

        return define

    def _write(self, context: Any, builder: Any, signature: Any, given: Sequence[Any]) -> Any:
        code = _Writer(context, builder)
        kinds, (rows, point, matrices, points, out) = signature.args, given
        rows = code.address(kinds[0], rows, builder.mul(point, code.word(3 * LANES)))
        matrices, out = (code.address(kinds[k], given[k], code.word(0)) for k in (2, 4))

        def term(row: Any, sums: Sequence[Any]) -> Sequence[Any]:
            basis = code.after(rows, builder.mul(row, code.word(3 * LANES)))
            entries = code.after(matrices, builder.mul(row, code.word(9)))
            axes = [code.load(code.after(basis, code.word(LANES * i)), LANES) for i in range(3)]
            for i in range(3):
                image = code.zeros(LANES)
                for k in range(3):  # column `i` of the matrix: the transposed one acts
                    image = code.add(image, code.spread(code.after(entries, code.word(3 * k + i)), LANES), axes[k])
                factors = [code.spread(code.after(basis, code.word(LANES * i + r)), LANES) for r in range(ROWS)]
                sums = [code.add(total, factor, image) for total, factor in zip(sums, factors, strict=True)]
            return sums

        sums = code.loop(points, [code.zeros(LANES)] * ROWS, term)
        for r, total in enumerate(sums):
            code.store(total, code.after(out, code.word(LANES * r)))
        return context.get_dummy_value()


class _Writer:
    """Writer of intermediate code for vectors of numbers and for loops over them."""

    def __init__(self, context: Any, builder: Any) -> None:
        from llvmlite import ir

        self._ir, self._context, self._builder = ir, context, builder
        self._word = ir.IntType(64)

    def word(self, value: int) -> Any:
        return self._ir.Constant(self._word, value)

    def zeros(self, width: int) -> Any:
        return self._ir.Constant(self._vector(width), [0.0] * width)

    def address(self, kind: Any, array: Any, place: Any) -> Any:
        """Return the address of an entry of a contiguous array."""
        return self.after(self._context.make_array(kind)(self._context, self._builder, array).data, place)

    def after(self, base: Any, *offsets: Any) -> Any:
        for offset in offsets:
            base = self._builder.gep(base, [offset])
        return base

    def times(self, number: Any, distance: Any) -> Any:
        return self._builder.mul(self.word(number) if isinstance(number, int) else number, distance)

    def load(self, place: Any, width: int) -> Any:
        return self._builder.load(self._builder.bitcast(place, self._vector(width).as_pointer()), align=8)

    def store(self, value: Any, place: Any) -> None:
        self._builder.store(value, self._builder.bitcast(place, value.type.as_pointer()), align=8)

    def spread(self, place: Any, width: int) -> Any:
        """Return a number in all lanes of a vector."""
        lane = self._ir.IntType(32)
        none, first = self._ir.Constant(self._vector(width), self._ir.Undefined), self._ir.Constant(lane, 0)
        single = self._builder.insert_element(none, self._builder.load(place, align=8), first)
        mask = self._ir.Constant(self._ir.VectorType(lane, width), [0] * width)
        return self._builder.shuffle_vector(single, none, mask)

    def add(self, total: Any, one: Any, other: Any, sign: int = 1) -> Any:
        """Return `total + sign one other`; LLVM makes one instruction of it where there is one."""
        product = self._builder.fmul(one, other, flags=("fast",))
        return (self._builder.fadd if sign > 0 else self._builder.fsub)(total, product, flags=("fast",))

    def loop(
        self, count: Any, first: Sequence[Any], term: Callable[[Any, Sequence[Any]], Sequence[Any]]
    ) -> Sequence[Any]:
        """Return what `term` makes of values, `count` times, at least once; it takes the number of the turn.

        Where the count is known here, there is no loop in the code.
        """
        if isinstance(count, int):
            for turn in range(count):
                first = term(self.word(turn), first)
            return first
        builder, before = self._builder, self._builder.block
        body, done = builder.append_basic_block(), builder.append_basic_block()
        builder.branch(body)
        builder.position_at_end(body)
        turn = builder.phi(self._word)
        values = [builder.phi(value.type) for value in first]
        ends = list(term(turn, values))
        after = builder.add(turn, self.word(1))
        for node, begin, end in ((turn, self.word(0), after), *zip(values, first, ends, strict=True)):
            node.add_incoming(begin, before)
            node.add_incoming(end, builder.block)
        builder.cbranch(builder.icmp_signed("<", after, count), body, done)
        builder.position_at_end(done)
        return ends

    def count(self, end: Any, stride: int, write: Callable[[Any], None]) -> None:
        """Write code for 0, `stride`, ... below `end`, which is more than 0."""
        builder, before = self._builder, self._builder.block
        body, done = builder.append_basic_block(), builder.append_basic_block()
        builder.branch(body)
        builder.position_at_end(body)
        number = builder.phi(self._word)
        write(number)
        after = builder.add(number, self.word(stride))
        number.add_incoming(self.word(0), before)
        number.add_incoming(after, builder.block)
        builder.cbranch(builder.icmp_signed("<", after, end), body, done)
        builder.position_at_end(done)

    def when(self, number: Any, write: Callable[[], None]) -> None:
        """Write code that runs where a number is not 0."""
        builder = self._builder
        then, done = builder.append_basic_block(), builder.append_basic_block()
        builder.cbranch(builder.icmp_signed("!=", number, self.word(0)), then, done)
        builder.position_at_end(then)
        write()
        builder.branch(done)
        builder.position_at_end(done)

    def _vector(self, width: int) -> Any:
        return self._ir.VectorType(self._ir.DoubleType(), width)
