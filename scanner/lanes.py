"""Vectors of pixels for kernels: as many values as fill the widest registers twice, worked on together.

A loop over arrays is turned into vector instructions by the compiler if it is simple, and what it finds goes through
memory to the next loop. A kernel written in lanes says itself what is worked on together: samples become sums, phases
and squares without leaving the registers. Where registers are narrower, more of them make one vector; the code and its
results are the same.

Lanes exist in compiled code only: floats (float32), whole numbers (int32), short ones (int16) and masks. `+ - * /`,
comparisons, `&`, `|`, `^` and `>>` (which fills with zeros) work lane by lane, with a scalar on either side as well;
comparisons make masks, `choose` picks by them. Numba knows no such type by itself: this file teaches it one, by the
rules of its extension interface.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any, Protocol, TypeVar, cast

from llvmlite import ir  # type: ignore[import-untyped]
from numba import extending, types
from numba.core import cgutils
from numpy.typing import NDArray

LANES = 32
"""Pixels a vector. Twice the widest registers' sixteen: two chains of operations wait for each other less than one."""


class Lanes(Protocol):
    """What a kernel may do with lanes."""

    def __add__(self, other: Any) -> Lanes: ...
    def __radd__(self, other: Any) -> Lanes: ...
    def __sub__(self, other: Any) -> Lanes: ...
    def __rsub__(self, other: Any) -> Lanes: ...
    def __mul__(self, other: Any) -> Lanes: ...
    def __rmul__(self, other: Any) -> Lanes: ...
    def __truediv__(self, other: Any) -> Lanes: ...
    def __rtruediv__(self, other: Any) -> Lanes: ...
    def __lt__(self, other: Any) -> Lanes: ...
    def __le__(self, other: Any) -> Lanes: ...
    def __gt__(self, other: Any) -> Lanes: ...
    def __ge__(self, other: Any) -> Lanes: ...
    def __and__(self, other: Any) -> Lanes: ...
    def __or__(self, other: Any) -> Lanes: ...
    def __xor__(self, other: Any) -> Lanes: ...
    def __rshift__(self, other: Any) -> Lanes: ...


class _LanesType(types.Type):
    def __init__(self, kind: str, element: Any, scalar: Any, each: int = 1) -> None:
        self.kind = kind
        self.vector = ir.VectorType(element, each * LANES)
        self.scalar = scalar
        super().__init__(name=f"Lanes({kind})")


_FLOATS = _LanesType("float", ir.FloatType(), types.float32)
_WHOLE = _LanesType("whole", ir.IntType(32), types.int32)
_SHORT = _LanesType("short", ir.IntType(16), types.int16)
_MASK = _LanesType("mask", ir.IntType(1), types.boolean)
# Numba has no type hints.
_extending, _compiler = cast(Any, extending), cast(Any, cgutils)
_Model: Any = _extending.models.PrimitiveModel


@_extending.register_model(_LanesType)
class _LanesModel(_Model):  # type: ignore[misc]
    def __init__(self, manager: Any, lanes: Any) -> None:
        super().__init__(manager, lanes, lanes.vector)


# --- operators --------------------------------------------------------------------------------------------------------


def _kind_of(*given: Any) -> _LanesType | None:
    """The one kind of lanes among these types; None where there are several, or something that cannot join them."""
    found = {t.name: t for t in given if isinstance(t, _LanesType)}
    joins = all(isinstance(t, (_LanesType, types.Number, types.Boolean)) for t in given)
    return next(iter(found.values())) if joins and len(found) == 1 else None


def in_lanes(context: Any, builder: Any, value: Any, found: Any, kind: _LanesType) -> Any:
    """A value as lanes: a scalar goes to all of them."""
    if isinstance(found, _LanesType):
        return value
    scalar = context.cast(builder, value, found, kind.scalar)
    nothing, first = ir.Constant(kind.vector, ir.Undefined), ir.Constant(ir.IntType(32), 0)
    order = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(builder.insert_element(nothing, scalar, first), nothing, order)


def _teach(operation: Any, results: dict[str, _LanesType], make: Callable[[Any, Any, Any, bool], Any]) -> None:
    """Give lanes an operation of two: what kinds it takes to what, and make(builder, a, b, are floats)."""

    def typer_of(context: Any) -> Any:
        def typer(a: Any, b: Any) -> Any:
            kind = _kind_of(a, b)
            return None if kind is None else results.get(kind.kind)

        return typer

    def lower(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        kind = cast(_LanesType, _kind_of(*signature.args))
        a, b = (in_lanes(context, builder, v, t, kind) for v, t in zip(values, signature.args, strict=True))
        return make(builder, a, b, kind is _FLOATS)

    _extending.type_callable(operation)(typer_of)
    for pair in ((_LanesType, _LanesType), (_LanesType, types.Number), (types.Number, _LanesType)):
        _extending.lower_builtin(operation, *pair)(lower)


def _instruction(of_floats: str, of_whole: str) -> Callable[[Any, Any, Any, bool], Any]:
    return lambda builder, a, b, floating: getattr(builder, of_floats if floating else of_whole)(a, b)


def _compare(sign: str) -> Callable[[Any, Any, Any, bool], Any]:
    return lambda builder, a, b, floating: (builder.fcmp_ordered if floating else builder.icmp_signed)(sign, a, b)


def _extreme(sign: str) -> Callable[[Any, Any, Any, bool], Any]:
    return lambda builder, a, b, floating: builder.select(_compare(sign)(builder, a, b, floating), a, b)


def least(a: Any, b: Any) -> Lanes:
    """The smaller of each two; b where one is NaN."""
    raise NotImplementedError("for kernels")


def greatest(a: Any, b: Any) -> Lanes:
    """The larger of each two; b where one is NaN."""
    raise NotImplementedError("for kernels")


_NUMBERS = {"float": _FLOATS, "whole": _WHOLE, "short": _SHORT}
_TO_MASKS = dict.fromkeys(_NUMBERS, _MASK)
for _plain, _in_place, _floating, _whole in (
    (operator.add, operator.iadd, "fadd", "add"),
    (operator.sub, operator.isub, "fsub", "sub"),
    (operator.mul, operator.imul, "fmul", "mul"),
):
    _teach(_plain, _NUMBERS, _instruction(_floating, _whole))
    _teach(_in_place, _NUMBERS, _instruction(_floating, _whole))
_teach(operator.truediv, {"float": _FLOATS}, _instruction("fdiv", "sdiv"))
for _relation, _sign in ((operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">=")):
    _teach(_relation, _TO_MASKS, _compare(_sign))
_BITS = {"whole": _WHOLE, "short": _SHORT}
_teach(operator.and_, {"mask": _MASK, **_BITS}, _instruction("and_", "and_"))
_teach(operator.or_, {"mask": _MASK, **_BITS}, _instruction("or_", "or_"))
_teach(operator.xor, _BITS, _instruction("xor", "xor"))
_teach(operator.rshift, _BITS, _instruction("lshr", "lshr"))
_teach(least, _NUMBERS, _extreme("<"))
_teach(greatest, _NUMBERS, _extreme(">"))


# --- functions --------------------------------------------------------------------------------------------------------

_F = TypeVar("_F", bound=Callable[..., Any])


def _intrinsic(function: Callable[..., Any]) -> Any:
    return _extending.intrinsic(function)


FLOATS, WHOLE, MASK, LanesType, intrinsic = _FLOATS, _WHOLE, _MASK, _LanesType, _intrinsic
"""For more functions of lanes: `scanner.across_lanes`, `scanner.lane_quads`, `scanner.lane_memory`."""


def _call(builder: Any, name: str, values: Any) -> Any:
    """One of LLVM's functions of floats to floats."""
    kind = ir.FunctionType(_FLOATS.vector, [_FLOATS.vector] * len(values))
    return builder.call(_compiler.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f32"), values)


def _of_floats(name: str) -> Callable[[Lanes], Lanes]:
    def one(context: Any, x: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            return _call(builder, name, values)

        return (_FLOATS(x), generate) if x is _FLOATS else None

    return cast(Callable[[Lanes], Lanes], _intrinsic(one))


nearest = _of_floats("rint")
"""To whole numbers, halves to even ones."""
root = _of_floats("sqrt")
magnitude = _of_floats("fabs")


def _choose(context: Any, mask: Any, a: Any, b: Any) -> Any:
    kind = _kind_of(a, b) or (_FLOATS if isinstance(a, types.Float) else _WHOLE)

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        picked = [in_lanes(context, builder, v, t, kind) for v, t in zip(values[1:], signature.args[1:], strict=True)]
        return builder.select(values[0], *picked)

    return (kind(mask, a, b), generate) if mask is _MASK else None


choose: Callable[[Any, Any, Any], Lanes] = _intrinsic(_choose)
"""choose(mask, a, b): a where the mask is set, b elsewhere; either may be a scalar."""


def _multiply_add(context: Any, a: Any, b: Any, c: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        three = [in_lanes(context, builder, v, t, _FLOATS) for v, t in zip(values, signature.args, strict=True)]
        return _call(builder, "fmuladd", three)

    return (_FLOATS(a, b, c), generate) if _kind_of(a, b, c) is _FLOATS else None


multiply_add: Callable[[Any, Any, Any], Lanes] = _intrinsic(_multiply_add)
"""a b + c in one instruction, where the machine has one, even if a b is used elsewhere."""


def _copy_sign(context: Any, x: Any, sign: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return _call(builder, "copysign", values)

    return (_FLOATS(x, sign), generate) if x is _FLOATS and sign is _FLOATS else None


with_sign: Callable[[Lanes, Lanes], Lanes] = _intrinsic(_copy_sign)
"""The magnitude of the first with the sign of the second."""


def _converted(kind: _LanesType, conversions: dict[str, str]) -> Callable[[Any], Lanes]:
    def one(context: Any, x: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            found = signature.args[0]
            if isinstance(found, _LanesType):
                return values[0] if found is kind else getattr(builder, conversions[found.kind])(values[0], kind.vector)
            return in_lanes(context, builder, values[0], found, kind)

        return kind(x), generate

    return cast(Callable[[Any], Lanes], _intrinsic(one))


floats = _converted(_FLOATS, {"whole": "sitofp", "short": "sitofp"})
"""Whole or short numbers, or a scalar for all lanes, as floats."""
whole = _converted(_WHOLE, {"float": "fptosi", "short": "sext"})
"""Floats without their fraction, short numbers, or a scalar for all lanes, as whole numbers."""
word = _converted(_WHOLE, {"short": "zext"})
"""Short or whole numbers that are words of bits, without a sign, as whole numbers."""


def _as_samples(context: Any, x: Any, like: Any) -> Any:
    kind = _SHORT if like.dtype.bitwidth == 8 else _WHOLE

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        if x is _FLOATS:
            return builder.fptosi(values[0], kind.vector)
        return in_lanes(context, builder, values[0], x, kind)

    return kind(x, like), generate


as_samples: Callable[[Any, NDArray[Any]], Lanes] = _intrinsic(_as_samples)
"""as_samples(x, like): floats without their fraction, or a scalar for all lanes, of the kind that `samples` are."""


def _power_of_two(context: Any, exponent: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        bias, place = (ir.Constant(_WHOLE.vector, [n] * LANES) for n in (127, 23))
        return builder.bitcast(builder.shl(builder.add(values[0], bias), place), _FLOATS.vector)

    return (_FLOATS(exponent), generate) if exponent is _WHOLE else None


power_of_two: Callable[[Lanes], Lanes] = _intrinsic(_power_of_two)
"""2^n as floats for whole n of -126 .. 127."""


def _any_of(context: Any, mask: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        bits = ir.IntType(LANES)
        return builder.icmp_unsigned("!=", builder.bitcast(values[0], bits), ir.Constant(bits, 0))

    return (types.boolean(mask), generate) if mask is _MASK else None


any_of: Callable[[Lanes], bool] = _intrinsic(_any_of)
"""Whether the mask is set anywhere."""


def _all_of(context: Any, mask: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        bits = ir.IntType(LANES)
        return builder.icmp_unsigned("==", builder.bitcast(values[0], bits), ir.Constant(bits, -1))

    return (types.boolean(mask), generate) if mask is _MASK else None


all_of: Callable[[Lanes], bool] = _intrinsic(_all_of)
"""Whether the mask is set everywhere."""


def _lowest(context: Any, values: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind, name = ir.FunctionType(ir.FloatType(), [_FLOATS.vector]), f"llvm.vector.reduce.fmin.v{LANES}f32"
        return builder.call(_compiler.get_or_insert_function(builder.module, kind, name), arguments)

    return (types.float32(values), generate) if values is _FLOATS else None


lowest: Callable[[Lanes], Any] = _intrinsic(_lowest)
"""The least number of all lanes, as one float; NaN is none."""


# --- memory -----------------------------------------------------------------------------------------------------------


def pointer_to(context: Any, builder: Any, array: Any, value: Any, at: Any, vector: Any) -> Any:
    """Where a vector of that type begins at an element of an array, of (array's type, array, element)."""
    data = context.make_array(array)(context, builder, value).data
    return builder.bitcast(builder.gep(data, [at]), vector.as_pointer())


def address_of(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    """Where the frame's pixel lies, of (addresses, n, pixel, like)."""
    table = context.make_array(signature.args[0])(context, builder, values[0]).data
    bytes_each = ir.Constant(values[2].type, signature.args[3].dtype.bitwidth // 8)
    return builder.add(builder.load(builder.gep(table, [values[1]])), builder.mul(values[2], bytes_each))


def _samples(context: Any, addresses: Any, frame: Any, pixel: Any, like: Any) -> Any:
    bits = like.dtype.bitwidth
    kind = _SHORT if bits == 8 else _WHOLE

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        vector = ir.VectorType(ir.IntType(bits), LANES)
        pointer = builder.inttoptr(address_of(context, builder, signature, values), vector.as_pointer())
        return builder.zext(builder.load(pointer, align=bits // 8), kind.vector)

    return kind(addresses, types.intp, types.intp, like), generate


samples: Callable[[NDArray[Any], int, int, NDArray[Any]], Lanes] = _intrinsic(_samples)
"""samples(addresses, n, pixel, like): grey levels of the n-th frame from a pixel on; see `scanner.decode.addresses`.

Those of 8 bits are short numbers, of which 128 may be added up; all others whole numbers."""


def fetch_soon(builder: Any, address: Any) -> None:
    """Have the processor fetch the cache line of an address into its second cache; it never faults."""
    # llvm.prefetch(pointer, read, to the second-level cache, data).
    pointer, integer = _compiler.voidptr_t, ir.IntType(32)
    kind = ir.FunctionType(ir.VoidType(), [pointer, integer, integer, integer])
    call = _compiler.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
    options = [ir.Constant(integer, value) for value in (0, 2, 1)]
    builder.call(call, [builder.inttoptr(address, pointer), *options])


def _expect(context: Any, addresses: Any, frame: Any, pixel: Any, like: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        fetch_soon(builder, address_of(context, builder, signature, values))
        return context.get_dummy_value()

    return types.void(addresses, types.intp, types.intp, like), generate


expect: Callable[[NDArray[Any], int, int, NDArray[Any]], None] = _intrinsic(_expect)
"""expect(addresses, n, pixel, like): have the processor fetch the cache line of that pixel, wherever it lies.

Into its second cache: of frames that lie a multiple of a page apart, the first has room for a dozen lines only."""


def _load(context: Any, array: Any, at: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.load(
            pointer_to(context, builder, signature.args[0], values[0], values[1], _FLOATS.vector), align=4
        )

    return _FLOATS(array, types.intp), generate


load: Callable[[NDArray[Any], int], Lanes] = _intrinsic(_load)
"""load(row, at): floats from row[at] on, of a (n,) float32 array. Nothing checks that there are as many."""


def _store(context: Any, array: Any, at: Any, lanes: Any) -> Any:
    bits = array.dtype.bitwidth

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        row, first, value = values
        if lanes is not _FLOATS and bits < lanes.scalar.bitwidth:
            value = builder.trunc(value, ir.VectorType(ir.IntType(bits), LANES))
        pointer = pointer_to(context, builder, signature.args[0], row, first, value.type)
        builder.store(value, pointer, align=bits // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), generate


store: Callable[[NDArray[Any], int, Lanes], None] = _intrinsic(_store)
"""store(row, at, lanes): floats into a (n,) float32 array, whole or short numbers into one of as many bits, or uint8.

See `load`."""
