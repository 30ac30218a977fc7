"""Where machine code finds what is not part of it.

Code contains no addresses, so that it can be kept on disk. They are in the array
`@addresses` of each module, which is filled when the code is loaded: of the constants, of
the functions of branches, of the function that compiles these, and of the tables.
"""

CONSTANTS, BRANCHES, COMPILE = range(3)
_NUM_OTHERS = 3


def table(number: int) -> int:
    """The number of the address of a table."""
    return _NUM_OTHERS + number


def loaded(number: int) -> str:
    """The instruction that loads an address."""
    return f"load ptr, ptr getelementptr (ptr, ptr @addresses, i64 {number})"


def declaration(num_tables: int) -> str:
    """The array of a module."""
    size = _NUM_OTHERS + num_tables
    return f"@addresses = dso_local global [{size} x ptr] zeroinitializer"
