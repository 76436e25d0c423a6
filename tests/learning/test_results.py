"""The pages of results: commands and numbers are those of the runs beside them."""

import csv
import json
import re
from importlib.util import find_spec
from pathlib import Path

import pytest

from torch_panda.commands import refine
from torch_panda.commands.train import parse
from torch_panda.learning.evaluation import wilson_interval
from torch_panda.learning.files.run_files import fixed_options
from torch_panda.learning.options import Args
from torch_panda.learning.recipes import RECIPE

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "examples" / "results"
RUNS = RESULTS / "runs"
PAGE = (RESULTS / "README.md").read_text()
EARLIER = (RESULTS / "earlier_presets.md").read_text()
POLICIES = (ROOT / "torch_panda" / "policies" / "README.md").read_text()
# These options may differ between a command and its run: the page's seed is a
# placeholder, and runs may begin on another device.
FREE = {"seed", "device"}
ABLATION = re.compile("no-her|no-double-q")


# Parsing a command of Fetch makes its environment.
HAS_FETCH = find_spec("gymnasium_robotics") is not None


def read_commands():
    """The commands of trainings that the pages print."""
    text = re.sub(r" \\\n +", " ", PAGE + EARLIER + POLICIES)
    found = re.findall(r"(?:^python -m torch_panda |`)(train [^`#\n]+)", text, re.M)
    commands = dict.fromkeys(command.strip() for command in found)
    return [x for x in commands if HAS_FETCH or "gymnasium_robotics" not in x]


def read_options(command, algo="ddpg"):
    """The options of a command as in args.json."""
    command = re.sub(" --seed S$", "", command).replace("--algo A", f"--algo {algo}")
    return fixed_options(parse(command.split()[1:]))


def has_options(args, options):
    """Whether a run with these entries of args.json had these options."""
    return all(args[key] == value for key, value in options.items() if key not in FREE)


@pytest.fixture(scope="module")
def commands():
    """The options of each command that the pages print; with `--algo A` of each."""
    options = {}
    for command in read_commands():
        algos = ("ddpg", "td3", "sac") if "--algo A" in command else ("ddpg",)
        options[command] = [read_options(command, algo) for algo in algos]
    return options


@pytest.fixture(scope="module")
def runs():
    """The entries of args.json of the runs with a present preset, by folder."""
    # Runs of earlier versions lack the options that were added later, whose defaults
    # keep what these versions did.
    default = fixed_options(Args())
    runs = {}
    for path in sorted(RUNS.glob("*/args.json")):
        name = path.parent.name
        args = json.loads(path.read_text())
        if args["preset"] == "recipe":  # an option since, with this default
            args.setdefault("keep_unmoved", RECIPE["keep_unmoved"])
        args = default | args
        is_ablation = ABLATION.search(name)
        if args["preset"] not in ("recipe", "paper") or is_ablation:
            continue
        if HAS_FETCH or not name.startswith("Fetch"):
            runs[name] = args
    return runs


def test_every_command_has_a_run_with_its_options(commands, runs):
    missing = [
        command
        for command, options in commands.items()
        if not any(has_options(args, x) for args in runs.values() for x in options)
    ]
    assert missing == []


def test_every_run_has_a_command_with_its_options(commands, runs):
    assert len(runs) > 25
    published = [x for options in commands.values() for x in options]
    missing = [
        name
        for name, args in runs.items()
        if not any(has_options(args, options) for options in published)
    ]
    assert missing == []
    for name, args in runs.items():
        assert name.startswith(f"{args['env_id']}-{args['algo']}-")
        assert name.endswith(f"-{args['seed']}")


def test_refinements_have_the_default_options():
    default = fixed_options(refine.Args(Path("policy"), Path("out")))
    for number in (0, 1):
        folder = RUNS / f"PandaSlide-v1-ddpg-refined-{number}"
        args = json.loads((folder / "args.json").read_text())
        for key in ("steps", "updates", "batch_size", "num_envs"):
            assert args[key] == default[key]


# The folders of the runs of each row with a number from a training. `{}` is the seed,
# and each name begins with "Panda".
SAMPLE = "Push-v1-ddpg-sample-efficient"
FOLDERS = {
    "Tuned for each task": {
        "Push, DDPG": "Push-v1-ddpg-{}",
        "Push, TD3": "Push-v1-td3-{}",
        "Push, SAC": "Push-v1-sac-{}",
        "PickAndPlace, DDPG": "PickAndPlace-v1-ddpg-{}",
        "PickAndPlace, no special starts, DDPG": "PickAndPlace-v1-ddpg-no-starts-{}",
        "Drawer, DDPG": "Drawer-v1-ddpg-{}",
        "Slide, DDPG": "Slide-v1-ddpg-{}",
        "Slide, points, LayerNorm, average, DDPG": "Slide-v1-ddpg-points-{}",
        "Stack, DDPG": "Stack-v1-ddpg-{}",
        "Flip, DDPG": "Flip-v1-ddpg-starts-{}",
    },
    "In fewer environment steps": {
        "Push": f"{SAMPLE}-{{}}",
        "Push, `--action-l2 0.1`": f"{SAMPLE}-faster-{{}}",
        "Push, SAC": "Push-v1-sac-sample-efficient-{}",
        "PickAndPlace": "PickAndPlace-v1-ddpg-sample-efficient-{}",
        "PickAndPlace, `--ema-rate 0`": "PickAndPlace-v1-ddpg-no-average-{}",
        "PickAndPlace, `--ema-rate 0 --action-l2 1`": (
            "PickAndPlace-v1-ddpg-large-penalty-{}"
        ),
        "Stack, special starts": "Stack-v1-ddpg-sample-efficient-{}",
    },
    "Version 3 of the tasks": {
        "Push, sample-efficient": "Push-v3-ddpg-sample-efficient-0",
        "Push, tuned": "Push-v3-ddpg-0",
        "PickAndPlace, sample-efficient": "PickAndPlace-v3-ddpg-sample-efficient-0",
        "PickAndPlace, tuned": "PickAndPlace-v3-ddpg-0",
        "Slide, tuned": "Slide-v3-ddpg-0",
        "Slide, tuned, 160,000 steps, earlier exploration": "Slide-v3-ddpg-anywhere-0",
        "Slide, tuned, 160,000 steps": "Slide-v3-ddpg-near-0",
    },
}


def read_section(title, page=EARLIER):
    """The text of a section, without the sections below it."""
    return re.search(rf"^##+ {title}\n(.*?)(?=^##|\Z)", page, re.M | re.S)[1]


def read_tables(section):
    """The rows of the tables of a section, as lists of cells without links."""
    text = re.sub(r" \(\[.*?\)\)| \(\[.*?\)[^|]*\)", "", section)
    tables = re.findall(r"(?:^\|.*\n)+", text, re.M)
    return [
        [[cell.strip() for cell in row.split("|")[1:-1]] for row in table.splitlines()]
        for table in tables
    ]


def read_percent(name, step, column="success"):
    """The success of a run in %, in its first evaluation after a number of steps."""
    with (RUNS / f"Panda{name}" / "curve.csv").open() as file:
        rows = list(csv.DictReader(file))
    later = [row for row in rows if int(row["step"]) >= step]
    assert later, f"{name} has fewer than {step} steps"
    return 100 * float(later[0][column])


def is_rounded(percent, cell):
    return abs(percent - int(cell)) <= 0.5 + 1e-4  # ties are rounded either way


def number(text):
    """The first number of a text such as "300,000 to 380,000"."""
    return int(re.match(r"[\d,]+", text)[0].replace(",", ""))


@pytest.mark.parametrize("title", ["Tuned for each task", "In fewer environment steps"])
def test_numbers_of_trainings_are_in_the_curves(title):
    """A whole number is from the training. For the others, the run must exist."""
    header, _, *rows = read_tables(read_section(title))[-1]
    steps_column, first_seed = header.index("environment steps"), header.index("seed 0")
    compared = 0
    for row in rows:
        task, step = ", ".join(row[:steps_column]), number(row[steps_column])
        if task.startswith("Reach"):
            continue
        for seed, cell in enumerate(row[first_seed:]):
            if cell:
                name = FOLDERS[title][task].format(seed)
                if (task, step) == ("PickAndPlace", 100_000):
                    name = "PickAndPlace-v1-ddpg-sample-efficient-longer-2"
                percent = read_percent(name, step)
                assert not cell.isdigit() or is_rounded(percent, cell), (name, step)
                compared += cell.isdigit()
    assert compared >= 15


def test_reach_is_learned_in_all_runs():
    folders = [x for x in RUNS.glob("PandaReach-v1-*") if not ABLATION.search(x.name)]
    assert len(folders) > 15
    for folder in folders:
        with (folder / "curve.csv").open() as file:
            rows = [row for row in csv.DictReader(file) if int(row["step"]) >= 1_200]
        assert {float(row["success"]) for row in rows} == {1.0}


def test_numbers_of_trainings_in_version_3_are_in_the_curves():
    header, _, *rows = read_tables(read_section("Version 3 of the tasks"))[-1]
    steps = [number(cell) for cell in header[2:-1]]
    for row in rows:
        name = FOLDERS["Version 3 of the tasks"][", ".join(row[:2])]
        for step, cell in zip(steps, row[2:-1], strict=True):
            assert is_rounded(read_percent(name, step), cell), (name, step)
        if row[-1]:
            percent, last = row[-1].split(" at ")
            assert is_rounded(read_percent(name, number(last)), percent), name


def test_numbers_of_trainings_without_rewards_are_in_the_curves():
    (table,) = read_tables(read_section("Without any reward"))
    for row in table[2:-1]:  # the numbers in the last row are from 1,000 episodes
        step = number(row[0])
        for seed, cell in enumerate(row[1].split(", ")):
            assert is_rounded(read_percent(f"Push-v3-crl-{seed}", step), cell)
        for cell, column in zip(row[2:], ("ever_success", "success"), strict=True):
            percent = read_percent("Push-v1-crl-0", step, column)
            assert not cell or is_rounded(percent, cell)


def test_the_number_of_imitation_on_slide_is_in_its_curve():
    table, _ = read_tables(read_section("Learned by imitation", PAGE))
    (cell,) = [row[4] for row in table if row[0] == "Slide"]
    path = RUNS / "PandaSlide-v1-ddpg-imitation-0" / "curve.csv"
    with path.open() as file:
        *_, last = csv.DictReader(file)
    assert is_rounded(100 * float(last["success"]), cell)


def test_intervals_are_those_of_1000_episodes():
    interval = r"(?<![-\d.])(\d+\.\d) \[(\d+\.\d), (\d+\.\d)\]"
    found = re.findall(interval, PAGE + EARLIER)
    assert len(found) > 90
    found.remove(("82.4", "81.9", "82.8"))  # Flip's expert has 24,000 episodes
    for share, *ends in found:
        interval = wilson_interval(round(10 * float(share)), 1_000)
        assert [f"{100 * end:.1f}" for end in interval] == ends, share


PAGES = {"results": PAGE, "earlier presets": EARLIER}


@pytest.mark.parametrize("page", PAGES)
def test_numbers_of_1000_episodes_stand_beside_their_command(page):
    for title in re.findall(r"^##+ (.*)", PAGES[page], re.M):
        section = read_section(title, PAGES[page])
        rows = [row for row in section.splitlines() if row.startswith("|")]
        has_numbers = any(re.search(r"\d\.\d( \[| to | \|)", row) for row in rows)
        # The summary points to the command below it.
        assert not has_numbers or "--episodes 1000" in section or title == "Summary"
