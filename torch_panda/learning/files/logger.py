"""Logs of a run for TensorBoard and Weights & Biases, by torchrl's loggers."""

import secrets
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from torchrl.record.loggers import Logger, TensorboardLogger, WandbLogger

from torch_panda.extras import install_command
from torch_panda.learning import files

LoggerName = Literal["none", "tensorboard", "wandb"]


def check_logger(name: LoggerName) -> None:
    """Check that the library of a logger is installed.

    Raises:
        ValueError: The library is not installed.
    """
    if name != "none" and find_spec(name) is None:
        raise ValueError(f"{name} is not installed: {install_command(name)}")


def make_logger(
    name: LoggerName, out: Path, options: Mapping[str, object]
) -> Logger | None:
    """Start the log of a run, or continue the log of a resumed run.

    Args:
        name: Name of the logger; "none" means that there is no log.
        out: Folder of the run. TensorBoard's log is its folder ``tensorboard``.
        options: Options of the run, which Weights & Biases shows.

    Raises:
        OSError: A file cannot be written.
    """
    if name == "tensorboard":
        return TensorboardLogger("tensorboard", str(out))
    if name == "wandb":
        file = out / "wandb_id.txt"
        if not file.exists():
            files.prepare(file)
            files.save_text(file, secrets.token_hex(4))
        config = {key: str(value) for key, value in options.items()}
        return WandbLogger(
            out.name,
            project="torch_panda",
            save_dir=out,
            id=file.read_text(),
            config=config,
        )
    return None


def close_logger(logger: Logger) -> None:
    """Write all remaining values and close the log."""
    if isinstance(logger, WandbLogger):
        logger.experiment.finish()
    else:
        logger.experiment.close()
