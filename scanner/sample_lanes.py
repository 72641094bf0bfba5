"""Lines of samples for kernels: twice as many pixels as `scanner.lanes` has, each in the type that frames have.

Grey levels that are only compared need no more bits than they came with: a cache line of 8-bit ones fills one of the
widest registers. Beside `scanner.lanes`, in compiled code only as those; a line goes to lanes through memory, where
kernels keep a few of them.

Samples have no sign: `-` gives what is left of 2^8 or 2^16, and `+` loses what goes beyond. `+ - |`, comparisons,
`least` and `greatest` work sample by sample, with whole numbers on either side as well.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any, Protocol, cast

from llvmlite import ir  # type: ignore[import-untyped]
from numba import extending, types
from numba.core import cgutils
from numpy.typing import NDArray

from scanner.lanes import FLOATS, LANES, Lanes, address_of, fetch_soon, greatest, intrinsic, least, pointer_to

_CACHE_LINE = 64

LINE = 2 * LANES
"""Samples a line."""


class Line(Protocol):
    """What a kernel may do with a line of samples, or with a mask of one (`&` and `|`)."""

    def __add__(self, other: Any) -> Line: ...
    def __sub__(self, other: Any) -> Line: ...
    def __and__(self, other: Any) -> Line: ...
    def __or__(self, other: Any) -> Line: ...
    def __xor__(self, other: Any) -> Line: ...
    def __lt__(self, other: Any) -> Line: ...
    def __le__(self, other: Any) -> Line: ...
    def __gt__(self, other: Any) -> Line: ...
    def __ge__(self, other: Any) -> Line: ...


class _LineType(types.Type):
    def __init__(self, bits: int) -> None:
        self.bits = bits
        self.vector = ir.VectorType(ir.IntType(bits), LINE)
        super().__init__(name=f"Line({bits})")


_LINES = {bits: _LineType(bits) for bits in (8, 16)}
_MASK = _LineType(1)
# Numba has no type hints.
_extending, _compiler = cast(Any, extending), cast(Any, cgutils)
_Model: Any = _extending.models.PrimitiveModel


@_extending.register_model(_LineType)
class _LineModel(_Model):  # type: ignore[misc]
    def __init__(self, manager: Any, line: Any) -> None:
        super().__init__(manager, line, line.vector)


# --- operators --------------------------------------------------------------------------------------------------------


def _kind_of(*given: Any) -> Any:
    """The one kind of lines among these types; None where there are several, or something that cannot join them."""
    found = {t.name: t for t in given if isinstance(t, _LineType)}
    joins = all(isinstance(t, (_LineType, types.Integer)) for t in given)
    return next(iter(found.values())) if joins and len(found) == 1 else None


def _in_line(context: Any, builder: Any, value: Any, found: Any, kind: Any) -> Any:
    """A value as a line: a whole number goes to all samples."""
    if isinstance(found, _LineType):
        return value
    scalar = context.cast(builder, value, found, types.Integer.from_bitwidth(kind.bits, False))
    nothing, first = ir.Constant(kind.vector, ir.Undefined), ir.Constant(ir.IntType(32), 0)
    order = ir.Constant(ir.VectorType(ir.IntType(32), LINE), [0] * LINE)
    return builder.shuffle_vector(builder.insert_element(nothing, scalar, first), nothing, order)


def _teach(operation: Any, make: Callable[[Any, Any, Any], Any], result: Any = None, masks: bool = False) -> None:
    """Give lines an operation of two: make(builder, a, b), whose result is a line as they are, or `result`."""

    def typer_of(context: Any) -> Any:
        def typer(a: Any, b: Any) -> Any:
            kind = _kind_of(a, b)
            return None if kind is None or (kind is _MASK and not masks) else result or kind

        return typer

    def lower(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        kind = _kind_of(*signature.args)
        return make(
            builder, *(_in_line(context, builder, v, t, kind) for v, t in zip(values, signature.args, strict=True))
        )

    _extending.type_callable(operation)(typer_of)
    for pair in ((_LineType, _LineType), (_LineType, types.Integer), (types.Integer, _LineType)):
        _extending.lower_builtin(operation, *pair)(lower)


def _compare(sign: str) -> Callable[[Any, Any, Any], Any]:
    return lambda builder, a, b: builder.icmp_unsigned(sign, a, b)


def _extreme(sign: str) -> Callable[[Any, Any, Any], Any]:
    return lambda builder, a, b: builder.select(builder.icmp_unsigned(sign, a, b), a, b)


def _saturating(name: str) -> Callable[[Any, Any, Any], Any]:
    def make(builder: Any, a: Any, b: Any) -> Any:
        kind = ir.FunctionType(a.type, [a.type, a.type])
        function = f"llvm.{name}.sat.v{LINE}i{a.type.element.width}"
        return builder.call(_compiler.get_or_insert_function(builder.module, kind, function), [a, b])

    return make


def less(a: Any, b: Any) -> Line:
    """a - b, and 0 where b is larger."""
    raise NotImplementedError("for kernels")


def more(a: Any, b: Any) -> Line:
    """a + b, and the largest sample there is where it would be beyond."""
    raise NotImplementedError("for kernels")


_teach(operator.add, lambda builder, a, b: builder.add(a, b))
_teach(operator.sub, lambda builder, a, b: builder.sub(a, b))
_teach(operator.xor, lambda builder, a, b: builder.xor(a, b), masks=True)
_teach(operator.and_, lambda builder, a, b: builder.and_(a, b), masks=True)
_teach(operator.or_, lambda builder, a, b: builder.or_(a, b), masks=True)
for _relation, _sign in ((operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">=")):
    _teach(_relation, _compare(_sign), _MASK)
_teach(least, _extreme("<"))
_teach(greatest, _extreme(">"))
_teach(less, _saturating("usub"))
_teach(more, _saturating("uadd"))


# --- functions --------------------------------------------------------------------------------------------------------


def _pick(context: Any, mask: Any, a: Any, b: Any) -> Any:
    kind = _kind_of(a, b)

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        picked = [_in_line(context, builder, v, t, kind) for v, t in zip(values[1:], signature.args[1:], strict=True)]
        return builder.select(values[0], *picked)

    return (kind(mask, a, b), generate) if mask is _MASK and kind is not None else None


pick: Callable[[Any, Any, Any], Line] = intrinsic(_pick)
"""pick(mask, a, b): a where the mask is set, b elsewhere; one of them may be a whole number."""


def _all_the_same(context: Any, number: Any, like: Any) -> Any:
    kind = _LINES[like.dtype.bitwidth]

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return _in_line(context, builder, values[0], number, kind)

    return kind(number, like), generate


all_the_same: Callable[[int, NDArray[Any]], Line] = intrinsic(_all_the_same)
"""all_the_same(number, like): a line of it, of samples as those of the array `like`."""


def _count_of(context: Any, mask: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.ctpop(builder.bitcast(values[0], ir.IntType(LINE)))

    return (types.int64(mask), generate) if mask is _MASK else None


count_of: Callable[[Line], int] = intrinsic(_count_of)
"""At how many samples a mask is set."""


# --- memory -----------------------------------------------------------------------------------------------------------


def _line_of(context: Any, addresses: Any, frame: Any, pixel: Any, like: Any) -> Any:
    kind = _LINES[like.dtype.bitwidth]

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        address = address_of(context, builder, signature, values)
        return builder.load(builder.inttoptr(address, kind.vector.as_pointer()), align=kind.bits // 8)

    return kind(addresses, types.intp, types.intp, like), generate


line_of: Callable[[NDArray[Any], int, int, NDArray[Any]], Line] = intrinsic(_line_of)
"""line_of(addresses, n, pixel, like): grey levels of the n-th frame from a pixel on; as `scanner.lanes.samples`."""


def _expect_line(context: Any, addresses: Any, frame: Any, pixel: Any, like: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        first = address_of(context, builder, signature, values)
        for at in range(0, LINE * like.dtype.bitwidth // 8, _CACHE_LINE):
            fetch_soon(builder, builder.add(first, ir.Constant(first.type, at)))
        return context.get_dummy_value()

    return types.void(addresses, types.intp, types.intp, like), generate


expect_line: Callable[[NDArray[Any], int, int, NDArray[Any]], None] = intrinsic(_expect_line)
"""expect_line(addresses, n, pixel, like): as `scanner.lanes.expect`, for all that `line_of` reads."""


def _line_at(context: Any, array: Any, at: Any) -> Any:
    kind = _LINES[array.dtype.bitwidth]

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.load(
            pointer_to(context, builder, array, values[0], values[1], kind.vector), align=kind.bits // 8
        )

    return kind(array, types.intp), generate


line_at: Callable[[NDArray[Any], int], Line] = intrinsic(_line_at)
"""line_at(row, at): samples from row[at] on, of a (n,) array of uint8 or uint16. Nothing checks that they are there."""


def _keep_line(context: Any, array: Any, at: Any, line: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        row, first, value = values
        builder.store(value, pointer_to(context, builder, array, row, first, value.type), align=line.bits // 8)
        return context.get_dummy_value()

    fits = isinstance(line, _LineType) and line.bits == array.dtype.bitwidth
    return (types.void(array, types.intp, line), generate) if fits else None


keep_line: Callable[[NDArray[Any], int, Line], None] = intrinsic(_keep_line)
"""keep_line(row, at, line): a line into a (n,) array of its type. See `line_at`."""


def _keeping(change: Callable[[Any, Any, int], Any]) -> Any:
    """Keep words of two halves, after change(builder, words, their bits)."""

    def keep(context: Any, array: Any, at: Any, low: Any, high: Any) -> Any:
        bits = array.dtype.bitwidth

        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            row, first, below, above = values
            words = ir.VectorType(ir.IntType(bits), LINE)
            if bits > low.bits:
                shift = ir.Constant(words, [low.bits] * LINE)
                below = builder.or_(builder.zext(below, words), builder.shl(builder.zext(above, words), shift))
            pointer = pointer_to(context, builder, array, row, first, words)
            builder.store(change(builder, below, bits), pointer, align=bits // 8)
            return context.get_dummy_value()

        fits = low == high and isinstance(low, _LineType) and bits in (low.bits, 2 * low.bits)
        return (types.void(array, types.intp, low, high), generate) if fits else None

    return intrinsic(keep)


def _summed(builder: Any, words: Any, bits: int) -> Any:
    step = bits // 2
    while step:
        words = builder.xor(words, builder.lshr(words, ir.Constant(words.type, [step] * LINE)))
        step //= 2
    return words


keep_words: Callable[[NDArray[Any], int, Line, Line], None] = _keeping(lambda builder, words, bits: words)
"""keep_words(row, at, low, high): numbers whose halves these are into a (n,) array of unsigned ones of twice the bits;
into one of as many bits the low halves alone."""

keep_gray: Callable[[NDArray[Any], int, Line, Line], None] = _keeping(_summed)
"""keep_gray(row, at, low, high): as `keep_words`, of words of a Gray code their numbers: each bit is the sum of all of
the word's from the highest to it."""


def _floats_at(context: Any, array: Any, at: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        vector = ir.VectorType(ir.IntType(array.dtype.bitwidth), LANES)
        pointer = pointer_to(context, builder, array, values[0], values[1], vector)
        whole = ir.VectorType(ir.IntType(32), LANES)
        found = builder.load(pointer, align=array.dtype.bitwidth // 8)
        return builder.sitofp(found if vector == whole else builder.zext(found, whole), FLOATS.vector)

    return FLOATS(array, types.intp), generate


floats_at: Callable[[NDArray[Any], int], Lanes] = intrinsic(_floats_at)
"""floats_at(row, at): the numbers from row[at] on, of a (n,) array of unsigned ones below 2^31, as lanes of floats."""
