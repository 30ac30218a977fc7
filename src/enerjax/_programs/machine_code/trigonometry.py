"""Sine, cosine and arctangent as code for LLVM, of one number or of several at a time.

Functions of the library of the machine take one number at a time. Here sine and cosine of
an angle are one function, without branches for angles below `_LARGE`: the angle minus a
multiple of a right angle (W. J. Cody and W. Waite, 1980) goes into the polynomials of
fdlibm (Sun Microsystems, 1993). The arctangent is the rational function of Cephes (S. L.
Moshier, 1989). The results are off by less than a unit in the last place.
"""

import functools
import struct


# Beyond this angle the library of the machine computes. The multiple of a right angle that
# is subtracted is exact up to 2^20.
_LARGE = 1e5
# A right angle is the sum of these, and `_PER_RIGHT_ANGLE` is its reciprocal.
_RIGHT_ANGLE = 1.5707963267948966, 6.123233995736766e-17, -1.4973849048591833e-33
_PER_RIGHT_ANGLE = 0.6366197723675814
# Adding it rounds to whole numbers, which are then the last bits.
_ROUNDING = 6755399441055744.0
# Coefficients of x^3, x^5, ... and of x^4, x^6, ...
_SINE = (
    -1.66666666666666324348e-01,
    8.33333333332248946124e-03,
    -1.98412698298579493134e-04,
    2.75573137070700676789e-06,
    -2.50507602534068634195e-08,
    1.58969099521155010221e-10,
)
_COSINE = (
    4.16666666666666019037e-02,
    -1.38888888888741095749e-03,
    2.48015872894767294178e-05,
    -2.75573143513906633035e-07,
    2.08757232129817482790e-09,
    -1.13596475577881948265e-11,
)
# Numerator and denominator, the coefficients of x^0 first.
_ARCTANGENT = (
    (
        -6.485021904942025371773e1,
        -1.228866684490136173410e2,
        -7.500855792314704667340e1,
        -1.615753718733365076637e1,
        -8.750608600031904122785e-1,
    ),
    (
        1.945506571482613964425e2,
        4.853903996359136964868e2,
        4.328810604912902668951e2,
        1.650270098316988542046e2,
        2.485846490142306297962e1,
        1.0,
    ),
)
_TAN_67, _NEAR_ONE = 2.414213562373095048802, 0.66


@functools.cache
def functions(width: int) -> tuple[str, ...]:
    """`sincos` and `arctangent` of so many numbers, and the functions that they call."""
    real = f"<{width} x double>" if width > 1 else "double"
    suffix = f"v{width}f64" if width > 1 else "f64"
    counts = {"fma": 3, "fabs": 1, "copysign": 2}
    declared = [
        f"declare {real} @llvm.{name}.{suffix}({', '.join([real] * count)})"
        for name, count in counts.items()
    ]
    declared += [f"declare double @{name}(double) #1" for name in ("sin", "cos")]
    if width > 1:
        declared.append(f"declare i1 @llvm.vector.reduce.or.v{width}i1(<{width} x i1>)")
    return (*declared, _sincos(width), _arctangent(width))


class _Body:
    """Writes the body of a function of `width` numbers `%x`."""

    def __init__(self, width: int):
        self.width = width
        wide = lambda kind: f"<{width} x {kind}>" if width > 1 else kind
        self.real, self.whole, self.flag = map(wide, ("double", "i64", "i1"))
        self.pair = f"{{ {self.real}, {self.real} }}"
        self.suffix = f"v{width}f64" if width > 1 else "f64"
        self.lines: list[str] = []

    def say(self, text: str) -> str:
        name = f"%v{len(self.lines)}"
        self.lines.append(f"  {name} = {text}")
        return name

    def known(self, x: float) -> str:
        text = f"0x{struct.unpack('<Q', struct.pack('<d', x))[0]:016X}"
        return f"splat (double {text})" if self.width > 1 else text

    def op(self, name: str, a: str, b: str) -> str:
        return self.say(f"{name} {self.real} {a}, {b}")

    def bitwise(self, name: str, a: str, b: int | str) -> str:
        """An operation on whole numbers."""
        b = f"splat (i64 {b})" if isinstance(b, int) and self.width > 1 else str(b)
        return self.say(f"{name} {self.whole} {a}, {b}")

    def is_set(self, x: str) -> str:
        zero = "0" if self.width == 1 else "zeroinitializer"
        return self.say(f"icmp ne {self.whole} {x}, {zero}")

    def call(self, name: str, *xs: str) -> str:
        given = ", ".join(f"{self.real} {x}" for x in xs)
        return self.say(f"call {self.real} @llvm.{name}.{self.suffix}({given})")

    def fma(self, a: str, b: str, c: str) -> str:
        return self.call("fma", a, b, c)

    def polynomial(self, x: str, coefficients: tuple[float, ...]) -> str:
        *rest, total = map(self.known, coefficients)
        for c in reversed(rest):
            total = self.fma(total, x, c)
        return total

    def select(self, which: str, a: str, b: str) -> str:
        return self.say(f"select {self.flag} {which}, {self.real} {a}, {self.real} {b}")

    def as_bits(self, x: str) -> str:
        return self.say(f"bitcast {self.real} {x} to {self.whole}")

    def as_real(self, x: str) -> str:
        return self.say(f"bitcast {self.whole} {x} to {self.real}")

    def each(self, function: str, x: str) -> str:
        """A function of the library of the machine, one number at a time."""
        if self.width == 1:
            return self.say(f"call double @{function}(double {x})")
        out = "poison"
        for k in range(self.width):
            one = self.say(f"extractelement {self.real} {x}, i64 {k}")
            one = self.say(f"call double @{function}(double {one})")
            out = self.say(f"insertelement {self.real} {out}, double {one}, i64 {k}")
        return out

    def both(self, a: str, b: str) -> None:
        """Returns two results."""
        first = self.say(f"insertvalue {self.pair} poison, {self.real} {a}, 0")
        pair = self.say(f"insertvalue {self.pair} {first}, {self.real} {b}, 1")
        self.lines.append(f"  ret {self.pair} {pair}")

    def text(self, result: str, name: str) -> str:
        head = f"define internal {result} @{name}{self.width}({self.real} %x) #0 {{"
        return "\n".join([head, "entry:", *self.lines, "}", ""])


def _sincos(width: int) -> str:
    b = _Body(width)
    size = b.call("fabs", "%x")
    # Infinite angles and NaN are far too.
    far = b.say(f"fcmp uge {b.real} {size}, {b.known(_LARGE)}")
    if width > 1:
        far = b.say(f"call i1 @llvm.vector.reduce.or.v{width}i1({b.flag} {far})")
    b.lines += [f"  br i1 {far}, label %far, label %near", "near:"]
    b.both(*_sine_and_cosine(b))
    b.lines.append("far:")
    b.both(b.each("sin", "%x"), b.each("cos", "%x"))
    return b.text(b.pair, "sincos")


def _sine_and_cosine(b: _Body) -> tuple[str, str]:
    shifted = b.fma("%x", b.known(_PER_RIGHT_ANGLE), b.known(_ROUNDING))
    count = b.op("fsub", shifted, b.known(_ROUNDING))
    most, more, least = (b.known(-part) for part in _RIGHT_ANGLE)
    coarse = b.fma(count, most, "%x")
    # Their sum is the angle: `rest` has the rounding errors.
    part = b.op("fmul", count, more)
    angle = b.op("fadd", coarse, part)
    rest = b.op("fadd", b.op("fsub", coarse, angle), part)
    rest = b.op("fadd", rest, b.fma(count, more, b.say(f"fneg {b.real} {part}")))
    rest = b.fma(count, least, rest)
    square = b.op("fmul", angle, angle)
    cube = b.op("fmul", angle, square)
    sine = b.op("fadd", angle, b.fma(b.polynomial(square, _SINE), cube, rest))
    # Zero keeps its sign.
    sine = b.call("copysign", sine, angle)
    half = b.op("fmul", square, b.known(0.5))
    near_one = b.op("fsub", b.known(1.0), half)
    left = b.op("fsub", b.op("fsub", b.known(1.0), near_one), half)
    left = b.op("fsub", left, b.op("fmul", angle, rest))
    fourth = b.op("fmul", square, square)
    cosine = b.op("fadd", near_one, b.fma(b.polynomial(square, _COSINE), fourth, left))
    # The quadrant is in the last two bits. A cosine is a sine in the next quadrant.
    quadrant = b.as_bits(shifted)
    odd = b.is_set(b.bitwise("and", quadrant, 1))
    after = b.bitwise("add", quadrant, 1)
    return (
        _with_sign_of(b, b.select(odd, cosine, sine), quadrant),
        _with_sign_of(b, b.select(odd, sine, cosine), after),
    )


def _with_sign_of(b: _Body, x: str, quadrant: str) -> str:
    """`x`, or `-x` in the third and fourth quadrants."""
    sign = b.bitwise("shl", b.bitwise("and", quadrant, 2), 62)
    return b.as_real(b.bitwise("xor", b.as_bits(x), sign))


def _arctangent(width: int) -> str:
    b = _Body(width)
    size = b.call("fabs", "%x")
    steep = b.say(f"fcmp ogt {b.real} {size}, {b.known(_TAN_67)}")
    middle = b.say(f"fcmp ogt {b.real} {size}, {b.known(_NEAR_ONE)}")
    # The arctangent of -1 / x is a right angle less, that of (x - 1) / (x + 1) half of it.
    one, zero = b.known(1.0), b.known(0.0)
    above = b.select(steep, b.known(-1.0), b.select(middle, b.op("fsub", size, one), size))
    below = b.select(steep, size, b.select(middle, b.op("fadd", size, one), one))
    x = b.op("fdiv", above, below)
    square = b.op("fmul", x, x)
    ratio = b.op("fdiv", *(b.polynomial(square, c) for c in _ARCTANGENT))
    angle = b.fma(b.op("fmul", x, square), ratio, x)
    main, rest = (
        b.select(steep, b.known(part), b.select(middle, b.known(0.5 * part), zero))
        for part in _RIGHT_ANGLE[:2]
    )
    angle = b.op("fadd", main, b.op("fadd", angle, rest))
    b.lines.append(f"  ret {b.real} {b.call('copysign', angle, '%x')}")
    return b.text(b.real, "arctangent")
