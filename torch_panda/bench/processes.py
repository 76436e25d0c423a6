"""What a process and its children use, as Linux tells."""

import math
import os
import time
from pathlib import Path


def memory() -> float | None:
    """Resident memory of this process and its children [MB].

    A page that n processes share counts 1/n in each. None where it cannot be read.
    """
    if not Path("/proc/self/smaps_rollup").exists():
        return None
    return sum(_proportional_set_size(pid) for pid in _family(os.getpid())) / 1e6


def available_memory() -> float:
    """What the system can still give [MB]; infinite where it does not tell."""
    path = Path("/proc/meminfo")
    if not path.exists():
        return math.inf
    (line,) = (x for x in path.read_text().splitlines() if x.startswith("MemAvailable"))
    return int(line.split()[1]) * 1024 / 1e6


def cpu_time() -> float:
    """Processor time of this process and its living children [s].

    Of children in ticks of 10 ms, and 0 where it cannot be read.
    """
    _, *children = _family(os.getpid())
    return time.process_time() + sum(_cpu_time(pid) for pid in children)


def _family(pid: int) -> list[int]:
    children = Path(f"/proc/{pid}/task").glob("*/children")
    pids = [int(child) for file in children for child in file.read_text().split()]
    return [pid, *(one for child in pids for one in _family(child))]


def _proportional_set_size(pid: int) -> int:
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    return 1024 * next(int(s.split()[1]) for s in lines if s.startswith("Pss:"))


def _cpu_time(pid: int) -> float:
    # The second field, the program's name, may contain anything but ends with ")".
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    user, system = fields[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")
