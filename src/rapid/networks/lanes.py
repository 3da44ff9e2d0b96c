# pyright: basic, reportCallIssue=false, reportOptionalCall=false
# Vectors are written in numba's and LLVM's own terms, which pyright does not know.
"""Sixteen numbers at a time in compiled code: loads, arithmetic, and the products of small matrices made of them.

Numba leaves it to the compiler which loops become vector instructions, and without fast-math it may neither sum in
another order nor fuse a multiplication with an addition. Here the vectors, their order and the fusing are written
down, so the bits do not depend on what the compiler, or a processor with wider registers, makes of it.

Arrays are flat, C-contiguous and float32; a matrix in one is given by where it begins and by how far one row is from
the next, in numbers. Nothing checks the bounds.
"""

import operator

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model
from numba.np.arrayobj import make_array

from rapid.simulator.compile import kernel

LANES = 16
"""Numbers in a vector."""
_FLOAT, _INT = ir.FloatType(), ir.IntType(32)
_FLOATS, _INTS = ir.VectorType(_FLOAT, LANES), ir.VectorType(_INT, LANES)


class Vector(types.Type):
    """Numba's name for sixteen numbers; +, -, * and / work between two of them."""

    def __init__(self) -> None:
        super().__init__(name="Vector16")


_vector = Vector()


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, _FLOATS)


@infer_global(operator.add)
@infer_global(operator.sub)
@infer_global(operator.mul)
@infer_global(operator.truediv)
class _Arithmetic(ConcreteTemplate):
    cases = [signature(_vector, _vector, _vector)]  # noqa: RUF012  # numba reads the class


@lower_builtin(operator.add, _vector, _vector)
def _add(context, builder, signature, arguments):
    return builder.fadd(*arguments)


@lower_builtin(operator.sub, _vector, _vector)
def _subtract(context, builder, signature, arguments):
    return builder.fsub(*arguments)


@lower_builtin(operator.mul, _vector, _vector)
def _multiply(context, builder, signature, arguments):
    return builder.fmul(*arguments)


@lower_builtin(operator.truediv, _vector, _vector)
def _divide(context, builder, signature, arguments):
    return builder.fdiv(*arguments)


def _pointer(context, builder, signature, array, at, kind):
    data = make_array(signature.args[0])(context, builder, array).data
    return builder.bitcast(builder.gep(data, [at]), kind.as_pointer())


def _picked(builder, value, other, lanes):
    return builder.shuffle_vector(value, other, ir.Constant(ir.VectorType(_INT, len(lanes)), list(lanes)))


def _spread(builder, number):
    one = builder.insert_element(ir.Constant(_FLOATS, ir.Undefined), number, _INT(0))
    return _picked(builder, one, one, [0] * LANES)


def _called(builder, name, *arguments):
    kind = ir.FunctionType(_FLOATS, [_FLOATS] * len(arguments))
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f32"), arguments)


@intrinsic
def load(typingctx, array, at):
    """Return the numbers of an array from `at` on."""

    def generate(context, builder, signature, arguments):
        return builder.load(_pointer(context, builder, signature, *arguments, _FLOATS), align=4)

    return _vector(array, types.intp), generate


@intrinsic
def store(typingctx, array, at, vector):
    """Write a vector into an array from `at` on."""

    def generate(context, builder, signature, arguments):
        array, at, vector = arguments
        builder.store(vector, _pointer(context, builder, signature, array, at, _FLOATS), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, _vector), generate


@intrinsic
def repeat(typingctx, array, at):
    """Return one number of an array, sixteen times."""

    def generate(context, builder, signature, arguments):
        return _spread(builder, builder.load(_pointer(context, builder, signature, *arguments, _FLOAT), align=4))

    return _vector(array, types.intp), generate


@intrinsic
def spread(typingctx, number):
    """Return a number sixteen times."""

    def generate(context, builder, signature, arguments):
        return _spread(builder, *arguments)

    return _vector(types.float32), generate


@intrinsic
def fma(typingctx, a, b, c):
    """Return a * b + c, rounded once."""

    def generate(context, builder, signature, arguments):
        return _called(builder, "fma", *arguments)

    return _vector(_vector, _vector, _vector), generate


@intrinsic
def larger(typingctx, a, b):
    """Return the larger of two numbers, lane by lane; b, if it is no number."""

    def generate(context, builder, signature, arguments):
        return builder.select(builder.fcmp_ordered(">", *arguments), *arguments)

    return _vector(_vector, _vector), generate


@intrinsic
def where_positive(typingctx, a, b):
    """Return b where a is above 0, else 0."""

    def generate(context, builder, signature, arguments):
        zero = ir.Constant(_FLOATS, None)
        return builder.select(builder.fcmp_ordered(">", arguments[0], zero), arguments[1], zero)

    return _vector(_vector, _vector), generate


@intrinsic
def rectified(typingctx, a):
    """Return 0 in place of what is below 0."""

    def generate(context, builder, signature, arguments):
        zero = ir.Constant(_FLOATS, None)
        return builder.select(builder.fcmp_ordered("<", arguments[0], zero), zero, arguments[0])

    return _vector(_vector), generate


@intrinsic
def rounded(typingctx, a):
    """Return the nearest whole numbers."""

    def generate(context, builder, signature, arguments):
        return _called(builder, "rint", *arguments)

    return _vector(_vector), generate


@intrinsic
def power_of_two(typingctx, a):
    """Return 2 to the power of whole numbers within -126..127, put together from its bits."""

    def generate(context, builder, signature, arguments):
        bias, places = (ir.Constant(_INTS, [number] * LANES) for number in (127, 23))
        power = builder.fptosi(arguments[0], _INTS)
        return builder.bitcast(builder.shl(builder.add(power, bias), places), _FLOATS)

    return _vector(_vector), generate


@intrinsic
def total(typingctx, a):
    """Return the sum of a vector's numbers, halves first."""

    def generate(context, builder, signature, arguments):
        (value,), width = arguments, LANES
        while width > 1:
            width //= 2
            low, high = (_picked(builder, value, value, range(first, first + width)) for first in (0, width))
            value = builder.fadd(low, high)
        return builder.extract_element(value, _INT(0))

    return types.float32(_vector), generate


@intrinsic
def _turn(typingctx, out, out_at, out_row, given, at, row, rows):
    """Write eight rows of eight numbers as columns; where there are only so many rows, the last is taken again."""
    size = 8
    kind = ir.VectorType(_FLOAT, size)

    def generate(context, builder, signature, arguments):
        out, out_at, out_row, given, at, row, rows = arguments
        last, taken = builder.sub(rows, rows.type(1)), []
        for i in range(size):
            line = rows.type(i)
            line = builder.select(builder.icmp_signed("<", line, last), line, last)
            data = make_array(signature.args[3])(context, builder, given).data
            place = builder.gep(data, [builder.add(at, builder.mul(line, row))])
            taken.append(builder.load(builder.bitcast(place, kind.as_pointer()), align=4))
        # Three times every two vectors exchange halves: of four numbers, of two, of one.
        for half in (4, 2, 1):
            low = [lane + (size - half if lane & half else 0) for lane in range(size)]
            high = [lane + (size if lane & half else half) for lane in range(size)]
            for i in range(size):
                if not i & half:
                    first, other = taken[i], taken[i + half]
                    taken[i], taken[i + half] = (_picked(builder, first, other, lanes) for lanes in (low, high))
        for i, value in enumerate(taken):
            data = make_array(signature.args[0])(context, builder, out).data
            place = builder.gep(data, [builder.add(out_at, builder.mul(out_row.type(i), out_row))])
            builder.store(value, builder.bitcast(place, kind.as_pointer()), align=4)
        return context.get_dummy_value()

    whole = types.intp
    return types.void(out, whole, whole, given, whole, whole, whole), generate


@kernel
def transpose(out, out_at, out_row, given, at, row, rows, columns):
    """Write a matrix of so many rows and columns as its transpose; columns come in eights.

    Rows are filled up to eights by repeating the last one.
    """
    for i in range(0, rows, 8):
        for j in range(0, columns, 8):
            _turn(out, out_at + j * out_row + i, out_row, given, at + i * row + j, row, rows - i)


@kernel
def multiply(
    out, out_at, out_row, start, start_at, start_row, left, left_at, left_row, left_column, right, right_at, right_row,
    rows, columns, terms,
):  # fmt: skip
    """Write start + left @ right, where left has so many rows and `terms` columns, and right `columns`, in sixteens.

    With `left_row` and `left_column` exchanged left is read as its transpose. `start` may be `out` itself, or one row
    for all with a `start_row` of 0.
    """
    for j in range(0, columns, LANES):
        i = 0
        while i < rows:
            if i + 4 > rows:
                if rows < 4 or start_row:
                    break
                # Again with some of the rows before, which gives them what they have.
                i = rows - 4
            a, b, c = left_at + i * left_row, left_at + (i + 1) * left_row, left_at + (i + 2) * left_row
            d, right_k = left_at + (i + 3) * left_row, right_at + j
            s = start_at + i * start_row + j
            sum_a, sum_b = load(start, s), load(start, s + start_row)
            sum_c, sum_d = load(start, s + 2 * start_row), load(start, s + 3 * start_row)
            for _ in range(terms):
                factor = load(right, right_k)
                sum_a = fma(repeat(left, a), factor, sum_a)
                sum_b = fma(repeat(left, b), factor, sum_b)
                sum_c = fma(repeat(left, c), factor, sum_c)
                sum_d = fma(repeat(left, d), factor, sum_d)
                a, b, c, d = a + left_column, b + left_column, c + left_column, d + left_column
                right_k += right_row
            o = out_at + i * out_row + j
            store(out, o, sum_a)
            store(out, o + out_row, sum_b)
            store(out, o + 2 * out_row, sum_c)
            store(out, o + 3 * out_row, sum_d)
            i += 4
        while i < rows:
            one = load(start, start_at + i * start_row + j)
            for k in range(terms):
                factor = load(right, right_at + k * right_row + j)
                one = fma(repeat(left, left_at + i * left_row + k * left_column), factor, one)
            store(out, out_at + i * out_row + j, one)
            i += 1


@kernel
def add_columns(out, out_at, given, at, row, rows, columns):
    """Add to a row the sum of so many rows; columns come in sixteens."""
    for j in range(0, columns, LANES):
        found, first = load(out, out_at + j), at + j
        for _ in range(rows // 4):
            second, fourth = first + row, first + 3 * row
            found = found + (
                (load(given, first) + load(given, second)) + (load(given, second + row) + load(given, fourth))
            )
            first = fourth + row
        for _ in range(rows % 4):
            found = found + load(given, first)
            first += row
        store(out, out_at + j, found)
