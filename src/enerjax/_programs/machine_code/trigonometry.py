"""Sine, cosine and arctangent as code for LLVM, of one number or of several at a time.

Functions of the library of the machine take one number at a time. Here sine and cosine of
an angle are one function, without branches for angles below `_LARGE`: the angle minus a
multiple of a right angle (W. J. Cody and W. Waite, 1980) goes into the polynomials of
fdlibm (Sun Microsystems, 1993). The arctangent is the rational function of Cephes (S. L.
Moshier, 1989). The results are off by less than a unit in the last place.
"""

import functools

from .instructions import Instructions


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
    declared: set[str] = set()
    texts = _Body(width, declared).sincos(), _Body(width, declared).arctangent()
    return (*sorted(declared), *texts)


class _Body(Instructions):
    """Writes a function of `%x`; unlike those of kernels, its operations stay as they are,
    because it computes their rounding errors."""

    def __init__(self, width: int, declared: set[str]):
        super().__init__(width, declared)
        self._real, self._whole = self._t("f8"), self._t("i8")
        self._pair = f"{{ {self._real}, {self._real} }}"

    def sincos(self) -> str:
        """Returns the sine and the cosine."""
        size = self._abs("f8", None, "%x")
        # Infinite angles and NaN are far too.
        far = self._say(f"fcmp uge {self._real} {size}, {self._number(_LARGE)}")
        if self.vector > 1:
            any_of, flags = f"@llvm.vector.reduce.or.v{self.vector}i1", self._t("b1")
            self.declared.add(f"declare i1 {any_of}({flags})")
            far = self._say(f"call i1 {any_of}({flags} {far})")
        self.lines += [f"  br i1 {far}, label %far, label %near", "near:"]
        self._return_both(*self._sine_and_cosine())
        self.lines.append("far:")
        self._return_both(*(self._called(name, "f8", ["%x"]) for name in ("sin", "cos")))
        return self._text(self._pair, "sincos")

    def _sine_and_cosine(self) -> tuple[str, str]:
        op, fma, known = self._op, self._fma, self._number
        shifted = fma("%x", known(_PER_RIGHT_ANGLE), known(_ROUNDING))
        count = op("fsub", shifted, known(_ROUNDING))
        most, more, least = (known(-part) for part in _RIGHT_ANGLE)
        coarse = fma(count, most, "%x")
        # Their sum is the angle: `rest` has the rounding errors.
        part = op("fmul", count, more)
        angle = op("fadd", coarse, part)
        rest = op("fadd", op("fsub", coarse, angle), part)
        rest = op("fadd", rest, fma(count, more, self._neg("f8", None, part)))
        rest = fma(count, least, rest)
        square = op("fmul", angle, angle)
        cube = op("fmul", angle, square)
        sine = op("fadd", angle, fma(self._polynomial(square, _SINE), cube, rest))
        # Zero keeps its sign.
        sine = self._intrinsic("copysign", "f8", sine, angle)
        half = op("fmul", square, known(0.5))
        near_one = op("fsub", known(1.0), half)
        left = op("fsub", op("fsub", known(1.0), near_one), half)
        left = op("fsub", left, op("fmul", angle, rest))
        fourth = op("fmul", square, square)
        left = fma(self._polynomial(square, _COSINE), fourth, left)
        cosine = op("fadd", near_one, left)
        # The quadrant is in the last two bits. A cosine is a sine in the next quadrant.
        quadrant = self._as_bits(shifted)
        odd = self._is_set(self._bitwise("and", quadrant, 1))
        after = self._bitwise("add", quadrant, 1)
        return (
            self._with_sign_of(self._either(odd, cosine, sine), quadrant),
            self._with_sign_of(self._either(odd, sine, cosine), after),
        )

    def _with_sign_of(self, x: str, quadrant: str) -> str:
        """`x`, or `-x` in the third and fourth quadrants."""
        sign = self._bitwise("shl", self._bitwise("and", quadrant, 2), 62)
        bits = self._say(f"xor {self._whole} {self._as_bits(x)}, {sign}")
        return self._say(f"bitcast {self._whole} {bits} to {self._real}")

    def arctangent(self) -> str:
        op, known, either = self._op, self._number, self._either
        size = self._abs("f8", None, "%x")
        steep = self._say(f"fcmp ogt {self._real} {size}, {known(_TAN_67)}")
        middle = self._say(f"fcmp ogt {self._real} {size}, {known(_NEAR_ONE)}")
        # The arctangent of -1 / x is a right angle less, that of (x - 1) / (x + 1) half of
        # it.
        one, zero = known(1.0), known(0.0)
        above = either(steep, known(-1.0), either(middle, op("fsub", size, one), size))
        below = either(steep, size, either(middle, op("fadd", size, one), one))
        x = op("fdiv", above, below)
        square = op("fmul", x, x)
        ratio = op("fdiv", *(self._polynomial(square, c) for c in _ARCTANGENT))
        angle = self._fma(op("fmul", x, square), ratio, x)
        main, rest = (
            either(steep, known(part), either(middle, known(0.5 * part), zero))
            for part in _RIGHT_ANGLE[:2]
        )
        angle = op("fadd", main, op("fadd", angle, rest))
        signed = self._intrinsic("copysign", "f8", angle, "%x")
        self.lines.append(f"  ret {self._real} {signed}")
        return self._text(self._real, "arctangent")

    def _number(self, x: float) -> str:
        return self._known(x, "f8")

    def _op(self, name: str, a: str, b: str) -> str:
        return self._say(f"{name} {self._real} {a}, {b}")

    def _fma(self, a: str, b: str, c: str) -> str:
        return self._intrinsic("fma", "f8", a, b, c)

    def _polynomial(self, x: str, coefficients: tuple[float, ...]) -> str:
        *rest, total = map(self._number, coefficients)
        for c in reversed(rest):
            total = self._fma(total, x, c)
        return total

    def _either(self, which: str, a: str, b: str) -> str:
        return self._select("f8", None, which, a, b)

    def _as_bits(self, x: str) -> str:
        return self._say(f"bitcast {self._real} {x} to {self._whole}")

    def _bitwise(self, name: str, a: str, b: int) -> str:
        """An operation on whole numbers."""
        return self._say(f"{name} {self._whole} {a}, {self._known(b, 'i8')}")

    def _is_set(self, x: str) -> str:
        return self._say(f"icmp ne {self._whole} {x}, {self._known(0, 'i8')}")

    def _return_both(self, a: str, b: str) -> None:
        first = self._say(f"insertvalue {self._pair} poison, {self._real} {a}, 0")
        pair = self._say(f"insertvalue {self._pair} {first}, {self._real} {b}, 1")
        self.lines.append(f"  ret {self._pair} {pair}")

    def _text(self, result: str, name: str) -> str:
        head = f"define internal {result} @{name}{self.vector}({self._real} %x) #0 {{"
        return "\n".join([head, "entry:", *self.lines, "}", ""])
