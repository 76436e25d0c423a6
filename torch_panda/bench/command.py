"""The benchmark's command line."""

import argparse
import sys
from importlib.util import find_spec
from pathlib import Path

import torch_panda
from torch_panda.bench.comparison import Absence, Result, compare, work_of
from torch_panda.bench.contenders import CONTENDERS, OURS
from torch_panda.bench.plot import plot
from torch_panda.bench.report import notes, table, write_json
from torch_panda.bench.runner import ContenderError
from torch_panda.bench.stepping import Setting
from torch_panda.info import num_cores


def _positive(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"must be an integer from 1 on, got {text}")
    return value


def _env_id(text: str) -> str:
    if text not in torch_panda.ENV_IDS:
        raise argparse.ArgumentTypeError(
            f"unknown environment id {text!r}; `python -m torch_panda info` lists all"
        )
    return text


def _new_file(text: str) -> Path:
    path = Path(text)
    if path.is_dir() or not path.parent.is_dir():
        raise argparse.ArgumentTypeError(f"must be a file in a folder, got {text}")
    return path


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``bench``."""
    others = [name for name in CONTENDERS if name != OURS]
    parser.add_argument(
        "--ids", nargs="+", type=_env_id, default=["PandaPush-v3"], metavar="ID"
    )
    parser.add_argument(
        "--num-envs", nargs="+", type=_positive, default=[16], metavar="N"
    )
    parser.add_argument(
        "--num-threads",
        type=_positive,
        help="of what runs in threads (default: one a core)",
    )
    parser.add_argument(
        "--others",
        nargs="*",
        choices=others,
        default=others,
        help="what to measure beside torch_panda (default: all that is installed)",
    )
    parser.add_argument("--rounds", type=_positive, default=7)
    parser.add_argument(
        "--steps",
        type=_positive,
        default=50,
        help="steps of each environment in a round",
    )
    parser.add_argument("--json", type=_new_file, help="where to write all figures")
    parser.add_argument("--plot", type=_new_file, help="where to draw steps per second")


def run(args: argparse.Namespace) -> None:
    """Measure, and print the table: after an error or Ctrl-C, of what there is.

    Raises:
        SystemExit: a library of the extra ``bench`` is missing, a contender failed, or
            Ctrl-C was pressed.
    """
    for library in ("tqdm", *(["matplotlib"] if args.plot else [])):
        if find_spec(library) is None:
            sys.exit(f"bench needs {library}: pip install 'torch_panda[bench]'")
    from tqdm import tqdm

    settings = [
        Setting(env_id, n, min(n, args.num_threads or num_cores()))
        for env_id in args.ids
        for n in args.num_envs
    ]
    results: list[Result] = []
    absences: list[Absence] = []
    failure: str | None = None
    total = work_of(len(settings), 1 + len(args.others), args.rounds)
    with tqdm(total=total, unit="measurement") as bar:

        def progress(what: str) -> None:
            bar.set_description(what)
            bar.update()

        for setting in settings:
            try:
                measured, missing = compare(
                    setting,
                    args.others,
                    rounds=args.rounds,
                    steps=args.steps,
                    progress=progress,
                )
            except ContenderError as error:
                failure = f"{setting}: {error}"
                break
            except KeyboardInterrupt:
                failure = "interrupted"
                break
            results += measured
            absences += missing
        bar.total = bar.n
    if failure is not None and not results:
        sys.exit(failure)
    print(table(results))
    if absences:
        print(notes(absences))
    if args.json is not None:
        write_json(args.json, results, absences)
    if args.plot is not None:
        plot(args.plot, results)
    if failure is not None:
        sys.exit(failure)
