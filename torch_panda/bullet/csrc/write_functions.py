"""Writes ``functions.h``, the C declaration of the table `structs.FUNCTIONS`.

python -m torch_panda.bullet.csrc.write_functions
"""

import textwrap
from ctypes import POINTER, c_char_p, c_double, c_float, c_int, c_void_p
from pathlib import Path

from torch_panda.bullet import capi
from torch_panda.bullet.structs import FUNCTIONS

HEADER = Path(__file__).with_name("functions.h")

_C_TYPES: dict[object, str] = {
    None: "void",
    c_int: "int",
    c_double: "double",
    c_float: "float",
    c_char_p: "const char *",
    c_void_p: "handle",
    capi.Doubles: "doubles",
    capi.Floats: "float *",
    POINTER(c_int): "int *",
    POINTER(c_double): "double *",
    POINTER(c_void_p): "doubles *",
}
_START = """\
/* Bullet's functions, as write_functions.py writes them from capi.py. */

#ifndef TORCH_PANDA_FUNCTIONS_H
#define TORCH_PANDA_FUNCTIONS_H

typedef void *handle;          /* of a client, a command or a status */
typedef const double *doubles; /* input */

struct functions {
"""
_END = """
};

#endif
"""


def header() -> str:
    """Text of the header."""
    lines = []
    for name, function in FUNCTIONS.items():
        # Other types are pointers to structs, which the C files do not use.
        result, *arguments = (
            _C_TYPES.get(kind, "void *")
            for kind in (function.restype, *function.argtypes)
        )
        declaration = f"{result} (*{name})({', '.join(arguments) or 'void'});"
        lines += textwrap.wrap(
            declaration, 88, initial_indent=" " * 4, subsequent_indent=" " * 8
        )
    return _START + "\n".join(lines) + _END


if __name__ == "__main__":
    HEADER.write_text(header())
