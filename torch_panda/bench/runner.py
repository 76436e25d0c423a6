"""Each contender lives in a process of its own, and is told when to run."""

import multiprocessing
import os
import time
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from typing import Any

import torch

from torch_panda.bench.contenders import CONTENDERS
from torch_panda.bench.processes import memory
from torch_panda.bench.stepping import Setting, Speed
from torch_panda.closing import Closing

_RESETS = 5


class ContenderError(RuntimeError):
    """A contender's process failed."""


@dataclass(frozen=True)
class Footprint:
    """What environments cost before they step, each of them.

    Attributes:
        creation: [s], imports not counted.
        memory: [MB] of all processes together, shared pages counted once; None where
            the system does not tell.
        reset: [s].
    """

    creation: float
    memory: float | None
    reset: float


class Runner(Closing):
    """A contender in its own process.

    Args:
        name: one of `CONTENDERS`.
        setting: what it runs.

    Raises:
        ContenderError: it could not be made.
    """

    def __init__(self, name: str, setting: Setting) -> None:
        self._name = name
        # Forked from a server that has imported all: no threads' locks are copied, and
        # imports take their time once. Not a daemon: contenders start processes.
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload([__name__])
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, name, setting))
        self._process.start()
        theirs.close()
        try:
            self.footprint: Footprint = self._receive()
        except BaseException:
            self.close()
            raise

    def measure(self, steps: int) -> Speed:
        """Speed of all environments over some steps of each.

        Raises:
            ContenderError: it failed.
        """
        self._pipe.send(steps)
        speed: Speed = self._receive()
        return speed

    def close(self) -> None:
        """End the process."""
        self._pipe.close()
        self._process.join(timeout=30)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def _receive(self) -> Any:  # noqa: ANN401 (what the process sends)
        try:
            answer = self._pipe.recv()
        except (EOFError, ConnectionResetError):
            self._process.join()
            answer = RuntimeError(f"its process ended ({self._process.exitcode})")
        if isinstance(answer, Exception):
            raise ContenderError(f"{self._name}: {answer}")
        return answer


def _serve(pipe: Connection, name: str, setting: Setting) -> None:
    """Make a contender, send its footprint, then its speed as often as asked."""
    torch.set_num_threads(1)
    # pybullet prints on stdout whenever it loads a robot.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    entry = CONTENDERS[name]
    try:
        # One environment is made before, so that imports are not counted.
        first = entry.make(replace(setting, num_envs=1, num_threads=1))
        before, start = memory(), time.perf_counter()
        contender = entry.make(setting)
        created = time.perf_counter()
        after = memory()
        for _ in range(_RESETS):
            contender.reset()
        reset = (time.perf_counter() - created) / _RESETS
        n = setting.num_envs
        footprint = Footprint(
            creation=(created - start) / n,
            memory=(after - before) / n if after and before else None,
            reset=reset / n,
        )
        first.close()
        pipe.send(footprint)
        while True:
            try:
                steps = pipe.recv()
            except EOFError:
                break
            pipe.send(contender.measure(setting.num_envs, steps))
        contender.close()
        # Without the seconds that the interpreter takes to free what it has imported.
        os._exit(0)
    except Exception as error:
        # Any error of any contender: as text, since not all can be pickled.
        pipe.send(RuntimeError(f"{type(error).__name__}: {error}"))
