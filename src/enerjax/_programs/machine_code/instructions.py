"""The operations of the graph in the language of LLVM."""

import struct
from typing import Any

import numpy as np

from .graph import Node


TYPES = {
    "f8": "double",
    "f4": "float",
    "b1": "i1",
    **{f"{kind}{n}": f"i{8 * n}" for kind in "iu" for n in (1, 2, 4, 8)},
}


class Instructions:
    """Writes instructions for values that are single numbers, or vectors of them.

    - `vector`: the number of entries of a value; 1 for single numbers.
    - `lines`: what has been written.
    - `declared`: the functions that are called: declarations, and the text of some.
    """

    def __init__(self, vector: int, declared: set[str]):
        self.vector, self.declared = vector, declared
        self.lines: list[str] = []
        self._count = 0

    def _t(self, dtype: str) -> str:
        kind = TYPES[dtype]
        return f"<{self.vector} x {kind}>" if self.vector > 1 else kind

    def _new(self) -> str:
        self._count += 1
        return f"%v{self._count}"

    def _say(self, text: str) -> str:
        name = self._new()
        self.lines.append(f"  {name} = {text}")
        return name

    def _known(self, x: Any, dtype: str) -> str:
        text = literal(x, dtype)
        return f"splat ({TYPES[dtype]} {text})" if self.vector > 1 else text

    def _spread(self, x: str, kind: str) -> str:
        """A single number in every entry of a vector."""
        if self.vector == 1:
            return x
        vector = f"<{self.vector} x {kind}>"
        one = self._say(f"insertelement {vector} poison, {kind} {x}, i64 0")
        return self._say(
            f"shufflevector {vector} {one}, {vector} poison, "
            f"<{self.vector} x i32> zeroinitializer"
        )

    def _joined(self, xs: list[str], kind: str) -> str:
        """Single numbers as a vector."""
        if self.vector == 1:
            return xs[0]
        out, vector = "poison", f"<{self.vector} x {kind}>"
        for k, x in enumerate(xs):
            out = self._say(f"insertelement {vector} {out}, {kind} {x}, i64 {k}")
        return out

    def _element(self, x: str, kind: str, k: int) -> str:
        if self.vector == 1:
            return x
        return self._say(f"extractelement <{self.vector} x {kind}> {x}, i64 {k}")

    def _operation(self, node: Node, xs: list[str]) -> str:
        return getattr(self, f"_{node.op}")(node.dtype, node, *xs)

    def _add(self, dtype, node, a, b):
        return self._arithmetic("add", dtype, a, b)

    def _sub(self, dtype, node, a, b):
        return self._arithmetic("sub", dtype, a, b)

    def _mul(self, dtype, node, a, b):
        return self._arithmetic("mul", dtype, a, b)

    def _arithmetic(self, op, dtype, a, b):
        if dtype == "b1":
            op = "and" if op == "mul" else "or" if op == "add" else "xor"
            return self._say(f"{op} {self._t(dtype)} {a}, {b}")
        name = f"f{op} contract" if dtype[0] == "f" else op
        return self._say(f"{name} {self._t(dtype)} {a}, {b}")

    def _div(self, dtype, node, a, b):
        if dtype[0] == "f":
            return self._say(f"fdiv {self._t(dtype)} {a}, {b}")
        return self._whole_division("div", dtype, a, b)

    def _rem(self, dtype, node, a, b):
        if dtype[0] == "f":
            return self._called("fmod", dtype, (a, b))
        return self._whole_division("rem", dtype, a, b)

    def _whole_division(self, op, dtype, a, b):
        """Division by zero, or of the least number by -1, would end the process."""
        t, mask, is_signed = self._t(dtype), self._t("b1"), dtype[0] == "i"
        zero, one = self._known(0, dtype), self._known(1, dtype)
        minus = self._known(-1 if is_signed else 2 ** (8 * int(dtype[1])) - 1, dtype)
        is_zero = self._say(f"icmp eq {t} {b}, {zero}")
        safe = self._say(f"select {mask} {is_zero}, {t} {one}, {t} {b}")
        if is_signed:
            is_minus = self._say(f"icmp eq {t} {b}, {minus}")
            safe = self._say(f"select {mask} {is_minus}, {t} {one}, {t} {safe}")
            out = self._say(f"s{op} {t} {a}, {safe}")
            negative = self._say(f"sub {t} {zero}, {a}") if op == "div" else zero
            out = self._say(f"select {mask} {is_minus}, {t} {negative}, {t} {out}")
        else:
            out = self._say(f"u{op} {t} {a}, {safe}")
        other = minus if op == "div" else a
        return self._say(f"select {mask} {is_zero}, {t} {other}, {t} {out}")

    def _neg(self, dtype, node, x):
        if dtype[0] == "f":
            return self._say(f"fneg {self._t(dtype)} {x}")
        return self._say(f"sub {self._t(dtype)} {self._known(0, dtype)}, {x}")

    def _abs(self, dtype, node, x):
        if dtype[0] == "f":
            return self._intrinsic("fabs", dtype, x)
        return self._intrinsic("abs", dtype, x, more=", i1 false")

    def _max(self, dtype, node, a, b):
        return self._extreme("max", dtype, a, b)

    def _min(self, dtype, node, a, b):
        return self._extreme("min", dtype, a, b)

    def _extreme(self, op, dtype, a, b):
        if dtype == "b1":
            return self._say(f"{'or' if op == 'max' else 'and'} {self._t(dtype)} {a}, {b}")
        if dtype[0] == "f":
            return self._intrinsic(f"{op}imum", dtype, a, b)
        return self._intrinsic(f"{'s' if dtype[0] == 'i' else 'u'}{op}", dtype, a, b)

    def _sqrt(self, dtype, node, x):
        return self._intrinsic("sqrt", dtype, x)

    def _floor(self, dtype, node, x):
        return self._intrinsic("floor", dtype, x)

    def _ceil(self, dtype, node, x):
        return self._intrinsic("ceil", dtype, x)

    def _rint(self, dtype, node, x):
        return self._intrinsic("roundeven", dtype, x)

    def _intrinsic(self, name, dtype, *xs, more=""):
        t = self._t(dtype)
        suffix = (f"v{self.vector}" if self.vector > 1 else "") + (
            {"f8": "f64", "f4": "f32"}.get(dtype) or TYPES[dtype]
        )
        whole = f"@llvm.{name}.{suffix}"
        types = ", ".join([t] * len(xs)) + (", i1" if more else "")
        self.declared.add(f"declare {t} {whole}({types})")
        given = ", ".join(f"{t} {x}" for x in xs) + more
        return self._say(f"call {t} {whole}({given})")

    def _and(self, dtype, node, a, b):
        return self._say(f"and {self._t(dtype)} {a}, {b}")

    def _or(self, dtype, node, a, b):
        return self._say(f"or {self._t(dtype)} {a}, {b}")

    def _xor(self, dtype, node, a, b):
        return self._say(f"xor {self._t(dtype)} {a}, {b}")

    def _shl(self, dtype, node, a, b):
        return self._shifted("shl", dtype, a, b)

    def _lshr(self, dtype, node, a, b):
        return self._shifted("lshr", dtype, a, b)

    def _ashr(self, dtype, node, a, b):
        return self._shifted("ashr", dtype, a, b)

    def _shifted(self, op, dtype, a, b):
        """A shift by the size of the type or more is not defined by LLVM."""
        t, size = self._t(dtype), 8 * int(dtype[1])
        last, zero = self._known(size - 1, dtype), self._known(0, dtype)
        fits = self._say(f"icmp ule {t} {b}, {last}")
        least = self._say(f"select {self._t('b1')} {fits}, {t} {b}, {t} {last}")
        shifted = self._say(f"{op} {t} {a}, {least}")
        if op == "ashr":
            return shifted
        return self._say(f"select {self._t('b1')} {fits}, {t} {shifted}, {t} {zero}")

    def _not(self, dtype, node, x):
        ones = True if dtype == "b1" else -1
        return self._say(f"xor {self._t(dtype)} {x}, {self._known(ones, dtype)}")

    def _select(self, dtype, node, which, a, b):
        t, mask = self._t(dtype), self._t("b1")
        return self._say(f"select {mask} {which}, {t} {a}, {t} {b}")

    def _cmp(self, dtype, node, a, b):
        how, of = node.extra
        if of[0] == "f":
            text = f"fcmp {'une' if how == 'ne' else 'o' + how}"
        else:
            sign = "" if how in ("eq", "ne") else "s" if of[0] == "i" else "u"
            text = f"icmp {sign}{how}"
        return self._say(f"{text} {self._t(of)} {a}, {b}")

    def _convert(self, dtype, node, x):
        of = node.extra
        t, from_type = self._t(dtype), self._t(of)
        if of[0] == "f" and dtype[0] == "f":
            return self._say(
                f"{'fpext' if dtype == 'f8' else 'fptrunc'} {from_type} {x} to {t}"
            )
        if of[0] == "f":
            if dtype == "b1":
                return self._say(f"fcmp une {from_type} {x}, {self._known(0.0, of)}")
            return self._saturated(dtype, of, x)
        if dtype[0] == "f":
            how = "sitofp" if of[0] == "i" else "uitofp"
            return self._say(f"{how} {from_type} {x} to {t}")
        if dtype == "b1":
            return self._say(f"icmp ne {from_type} {x}, {self._known(0, of)}")
        old, new = (1 if k == "b1" else 8 * int(k[1]) for k in (of, dtype))
        if old == new:
            return x
        how = "trunc" if new < old else "sext" if of[0] == "i" else "zext"
        return self._say(f"{how} {from_type} {x} to {t}")

    def _bits(self, dtype, node, x):
        return self._say(f"bitcast {self._t(node.extra)} {x} to {self._t(dtype)}")

    def _saturated(self, dtype, of, x):
        t, from_type = self._t(dtype), self._t(of)
        suffix = f"v{self.vector}" if self.vector > 1 else ""
        source = {"f8": "f64", "f4": "f32"}[of]
        sign = "s" if dtype[0] == "i" else "u"
        name = f"@llvm.fpto{sign}i.sat.{suffix}{TYPES[dtype]}.{suffix}{source}"
        self.declared.add(f"declare {t} {name}({from_type})")
        return self._say(f"call {t} {name}({from_type} {x})")

    def _call(self, dtype, node, *xs):
        return self._called(node.extra, dtype, xs)

    def _called(self, name, dtype, xs):
        """A function of the library of the machine."""
        kind = TYPES[dtype]
        whole = f"@{name}" + ("f" if dtype == "f4" else "")
        types = ", ".join([kind] * len(xs))
        self.declared.add(f"declare {kind} {whole}({types}) #1")
        if self.vector == 1:
            given = ", ".join(f"{kind} {x}" for x in xs)
            return self._say(f"call {kind} {whole}({given})")
        out = "poison"
        for k in range(self.vector):
            ones = [
                self._say(f"extractelement <{self.vector} x {kind}> {x}, i64 {k}")
                for x in xs
            ]
            given = ", ".join(f"{kind} {x}" for x in ones)
            one = self._say(f"call {kind} {whole}({given})")
            out = self._say(
                f"insertelement <{self.vector} x {kind}> {out}, {kind} {one}, i64 {k}"
            )
        return out

    def _neutral(self, node: Node) -> str:
        dtype, op = node.dtype, node.op.split()[1]
        kind = TYPES[dtype]
        if op in ("add", "or", "xor"):
            x = 0
        elif op == "mul":
            x = 1
        elif op == "and":
            x = True if dtype == "b1" else -1
        elif dtype[0] == "f":
            x = float("-inf") if op == "max" else float("inf")
        elif dtype == "b1":
            x = op == "min"
        else:
            info = np.iinfo(dtype)
            x = int(info.min if op == "max" else info.max)
        text = literal(x, dtype)
        return f"splat ({kind} {text})" if self.vector > 1 else text


def literal(x: Any, dtype: str) -> str:
    """A known number in the language of LLVM."""
    if dtype[0] == "f":
        number = float(x)
        if dtype == "f4":
            number = float(np.float32(number))
        if number != number:
            number = float("nan")
        bits = struct.unpack("<Q", struct.pack("<d", number))[0]
        return f"0x{bits:016X}"
    if dtype == "b1":
        return "true" if x else "false"
    return str(int(x))
