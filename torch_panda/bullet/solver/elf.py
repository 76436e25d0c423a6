"""Symbols of an ELF file, also those that the file does not export."""

import mmap
import struct
from collections.abc import Iterable
from typing import NamedTuple

_SECTION_TABLE = struct.Struct("<40xQ10xHH")  # e_shoff, e_shentsize, e_shnum
_SECTION = struct.Struct("<4xI16xQQI")  # sh_type, sh_offset, sh_size, sh_link
_SYMBOL = struct.Struct("<IBBHQQ")  # st_name, ..., st_value, st_size
_SYMBOL_TABLE = 2  # SHT_SYMTAB
_MAGIC = b"\x7fELF\x02\x01"  # 64 bits, little-endian


class Symbol(NamedTuple):
    """A symbol: its address relative to the load address, and its size in bytes."""

    address: int
    size: int


def read_symbols(path: str, names: Iterable[str]) -> dict[str, Symbol]:
    """Read symbols from the ``.symtab`` of a shared library.

    Args:
        path: Path of the library.
        names: Mangled names of the symbols.

    Returns:
        The symbols by name. Names that the library does not have are left out.

    Raises:
        ValueError: The file is not a 64-bit ELF file, or its ``.symtab`` was stripped.
    """
    with (
        open(path, "rb") as file,
        mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data,
    ):
        if data[: len(_MAGIC)] != _MAGIC:
            raise ValueError(f"{path} is not a 64-bit ELF file")
        table, entry_size, count = _SECTION_TABLE.unpack_from(data)
        sections = [
            _SECTION.unpack_from(data, table + i * entry_size) for i in range(count)
        ]
        tables = [section for section in sections if section[0] == _SYMBOL_TABLE]
        if not tables:
            raise ValueError(f"{path} has no .symtab")
        _, offset, size, strings = tables[0]
        symbols = data[offset : offset + size]
        _, offset, size, _ = sections[strings]
        text = data[offset : offset + size]
    # A symbol holds the offset of its name in the text. Search the text for the names
    # and compare offsets, which is faster than decoding the name of every symbol.
    wanted = {text.find(b"\0%b\0" % name.encode()) + 1: name for name in names}
    return {
        wanted[name]: Symbol(address, size)
        for name, _, _, _, address, size in _SYMBOL.iter_unpack(symbols)
        if name in wanted and name != 0
    }
