"""The files in the folder of a run, which this module alone writes.

| file | content |
|---|---|
| run.lock, process.txt | lock of the process that writes into the folder, its name |
| args.json | options |
| curve.csv, curve.png | results of the evaluations |
| checkpoint.pt | policy at the last evaluation or save, for `load_policy` |
| resume.pt | state from which a run resumes bit for bit |

Only the generated data of an offline run, its video and its log come from elsewhere.
"""

import csv
import io
import json
import os
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock, Timeout
from torchrl.data import ReplayBuffer

from torch_panda.learning import files
from torch_panda.learning.agents import Agent
from torch_panda.learning.files.policy_files import save_policy
from torch_panda.learning.plots import plot_curve
from torch_panda.learning.recipes import find_changes

LOCK, PROCESS, OPTIONS = "run.lock", "process.txt", "args.json"
CURVE, PLOT = "curve.csv", "curve.png"
POLICY, STATE = "checkpoint.pt", "resume.pt"
# Options that may change when a run is resumed.
FREE_OPTIONS = {
    *("resume", "out", "device", "workers", "video", "imports", "logger"),
    "stop_when_solved",
}


@dataclass
class Progress:
    """Progress of a run.

    Attributes:
        steps: Environment steps so far, or gradient steps of an offline run.
        pretrained: Gradient steps of imitation so far.
        seconds: Time spent on stepping and learning, without evaluations.
        curve: One row for each evaluation.
        loss_sums: Each loss of the last iteration. In offline learning, the sum of the
            losses since the last evaluation.
    """

    steps: int = 0
    pretrained: int = 0
    seconds: float = 0.0
    curve: list[dict[str, float]] = field(default_factory=list)
    loss_sums: dict[str, float] = field(default_factory=dict)

    @property
    def iterated(self) -> int:
        """Steps and gradient steps of imitation so far."""
        return self.pretrained + self.steps

    @property
    def success(self) -> str:
        """The last success rate as text, such as "95%"."""
        return f"{self.curve[-1]['success']:.0%}" if self.curve else "unknown"


@dataclass
class Checkpoint:
    """The complete state of a run between two iterations.

    Demonstrations, and the data of offline learning, are not saved, only their hash. So
    a resumed run can check that they are the same.
    """

    out: Path
    args: Any  # options of the run, a dataclass
    agent: Agent
    buffers: Mapping[str, ReplayBuffer]  # by name; none in offline learning
    progress: Progress
    data_hash: str = ""  # of demonstrations or offline data; empty without both

    def save(self) -> None:
        """Write the state and the policy.

        Raises:
            OSError: A file cannot be written.
        """
        state = {
            "args": fixed_options(self.args),
            "agent": self.agent.state_dict(),
            "optimizer": self.agent.optimizer.state_dict(),
            "updates": self.agent.updates,
            "data_hash": self.data_hash,
            "random": torch.get_rng_state(),
            "cuda_random": torch.cuda.get_rng_state_all(),
            "progress": asdict(self.progress),
            **{name: buffer.state_dict() for name, buffer in self.buffers.items()},
        }
        files.save(self.out / STATE, state)
        save_policy(self.out / POLICY, self.agent, self.args.env_id)

    def load(self) -> None:
        """Restore the state that `save` wrote.

        The options must be those of the saved run. Only `total_steps` may be larger.

        Raises:
            ValueError: The file is damaged, or its run had other options, data or sizes
                of observations.
        """
        keys = (
            *("args", "agent", "optimizer", "updates", "data_hash"),
            *("random", "cuda_random", "progress", *self.buffers),
        )
        finite = ("agent", "optimizer")
        path = self.out / STATE
        # The run may go on on another device.
        state = files.read(path, "the state of a run", keys, finite=finite)
        options = fixed_options(self.args)
        # The run may be older than an option.
        saved = {**options, **state["args"]}
        steps = options.get("total_steps", 0)
        if steps > saved.get("total_steps", steps):
            saved["total_steps"] = steps
        differing = [
            f"{key} was {saved.get(key)!r} and is now {value!r}"
            for key, value in options.items()
            if saved.get(key) != value
        ]
        if differing:
            raise ValueError(
                f"cannot resume {self.out} with other options "
                f"({'; '.join(differing)}): repeat the former options"
            )
        data_hash = state["data_hash"]
        if data_hash != self.data_hash:
            raise ValueError(
                "cannot resume with other data: the run learned from data with the "
                f"hash {data_hash}, these have {self.data_hash}"
            )
        try:
            self.agent.load_state_dict(state["agent"])
        except RuntimeError:
            raise ValueError(
                f"cannot resume {self.out}: its networks have other sizes than those "
                "for the task, so the task or the version of torch_panda has changed"
            ) from None
        self.agent.optimizer.load_state_dict(state["optimizer"])
        self.agent.updates = state["updates"]
        for name, buffer in self.buffers.items():
            buffer.load_state_dict(state[name])
        for name, value in state["progress"].items():
            setattr(self.progress, name, value)
        # Last, so that nothing draws random numbers before the run continues.
        torch.set_rng_state(state["random"])
        if len(state["cuda_random"]) == torch.cuda.device_count():
            torch.cuda.set_rng_state_all(state["cuda_random"])


def write_results(
    out: Path, rows: list[dict[str, float]], agent: Agent, env_id: str, *, xlabel: str
) -> None:
    """Write the curve, its picture and the evaluated policy.

    Args:
        out: Folder of the run.
        rows: Rows of the curve, one for each evaluation.
        agent: The agent.
        env_id: Id of the environment, which is also the title of the picture.
        xlabel: Meaning of the column ``step``.

    Raises:
        OSError: A file cannot be written.
    """
    fields = {key: None for row in rows for key in row}
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, fieldnames=list(fields))
    writer.writeheader()
    writer.writerows(rows)
    files.save_text(out / CURVE, text.getvalue())
    plot_curve(rows, env_id, out / PLOT, xlabel=xlabel)
    save_policy(out / POLICY, agent, env_id)


def fixed_options(args: Any) -> dict[str, Any]:  # noqa: ANN401 (a dataclass)
    """Return the options that may not change when a run is resumed, as JSON values."""
    options = json.loads(json.dumps(asdict(args), default=str))
    return {key: value for key, value in options.items() if key not in FREE_OPTIONS}


def write_options(
    out: Path,
    args: Any,  # noqa: ANN401 (a dataclass)
    default: Any,  # noqa: ANN401 (the same dataclass)
    *,
    resume: bool = False,
    **more: str,
) -> None:
    """Make the folder of a run, and write its options into args.json.

    Its entry ``changed`` has the options that differ from ``default``, for the legends
    of plots. The entries ``more`` are written too. If a run is resumed, its file keeps
    its entries, such as a label, and gets the new value of ``total_steps``.

    Raises:
        OSError: The file cannot be written.
    """
    path = out / OPTIONS
    if resume and path.exists():
        options = json.loads(path.read_text()) | fixed_options(args)
    else:
        options = {**more, **asdict(args), "changed": find_changes(args, default)}
    out.mkdir(parents=True, exist_ok=True)
    files.save_text(path, json.dumps(options, default=str, indent=2))


def check_folder(out: Path, *, resume: bool) -> None:
    """Check that a run can start in a folder, or be resumed there.

    Raises:
        ValueError: There is no run to resume, a new run would overwrite another one, or
            another process uses the folder.
    """
    if out.exists() and not out.is_dir():
        raise ValueError(f"out must be a folder, got the file {out}")
    if (out / LOCK).exists():
        with lock_folder(out):
            pass  # no other process has the lock
    if resume and not (out / STATE).exists():
        raise ValueError(
            f"there is no run to resume in {out}: start it without --resume"
        )
    if not resume and any((out / name).exists() for name in (STATE, CURVE, POLICY)):
        raise ValueError(
            f"{out} holds a run: continue it with --resume, remove it, or choose "
            "another folder with --out"
        )


@contextmanager
def lock_folder(out: Path) -> Iterator[None]:
    """Context manager that makes the folder of a run, and locks it.

    Other processes cannot lock the folder meanwhile. The operating system releases the
    lock even if the process is killed.

    Raises:
        ValueError: Another process has the lock. The error names the process.
        OSError: The folder cannot be written to.
    """
    out.mkdir(parents=True, exist_ok=True)
    lock, process = FileLock(out / LOCK), out / PROCESS
    try:
        lock.acquire(timeout=0)
    except Timeout:
        name = process.read_text() if process.exists() else "another process"
        raise ValueError(
            f"{name} writes into {out}: stop that process first, or choose another "
            "folder with --out"
        ) from None
    try:
        files.save_text(process, f"process {os.getpid()} on {socket.gethostname()}")
        yield
    finally:
        process.unlink(missing_ok=True)
        lock.release()
