"""The pages of results: commands and numbers are those of the runs beside them."""

import csv
import json
import re
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import get_args

import pytest

import torch_panda
from torch_panda.commands.train import parse
from torch_panda.learning.agents.hyperparameters import OfflineAlgo
from torch_panda.learning.evaluation import evaluate_episodes, wilson_interval
from torch_panda.learning.files.run_files import fixed_options
from torch_panda.learning.options import Args
from torch_panda.learning.recipes import RECIPE

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "examples" / "results"
RUNS = RESULTS / "runs"
PAGE = (RESULTS / "README.md").read_text()
HELPED = (RESULTS / "what_helped.md").read_text()
OFFLINE = (RESULTS / "offline.md").read_text()
README = (ROOT / "README.md").read_text()
POLICIES = (ROOT / "torch_panda" / "policies" / "README.md").read_text()
# These options may differ between a command and its run: the page's seed is a
# placeholder, and runs may begin on another device.
FREE = {"seed", "device"}
# These offline agents have three seeds and published policies.
BEST_OFFLINE = ("gcivl", "qrl")
# Parsing a command of Fetch makes its environment.
HAS_FETCH = find_spec("gymnasium_robotics") is not None


def read_commands():
    """The commands of trainings that the pages print."""
    text = re.sub(r" \\\n +", " ", PAGE + HELPED + POLICIES + OFFLINE)
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
        algos: tuple[str, ...] = ("ddpg",)
        if "--algo A" in command:
            is_offline = "--offline" in command
            algos = get_args(OfflineAlgo) if is_offline else ("ddpg", "td3", "sac")
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
        presets = ("recipe", "paper", "offline")
        if args["preset"] not in presets or "no-her" in name:
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


FOLDER = r"`(Panda\w+-v\d-[\w-]+-)S`"


def test_every_run_is_on_a_page(runs):
    pages = PAGE + HELPED + POLICIES
    names = {path.name for path in RUNS.iterdir()}
    # The folders of a command's runs are not named.
    named = {name for name in names if not name.startswith("Fetch")} - set(runs)
    missing = [
        x for x in named if not re.search(x.rstrip("0123456789") + r"[S\d]", pages)
    ]
    assert missing == []
    for stem in re.findall(FOLDER, HELPED):
        assert any(re.fullmatch(rf"{stem}\d", name) for name in names), stem
    assert {*re.findall(r"\bruns/(Panda[\w-]+-v\d[\w-]+)", PAGE + POLICIES)} <= names


def read_section(title, page=HELPED):
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
    """The success of a run in %, in its first evaluation after a number of steps.

    Imitation takes 0 steps. Its last evaluation is the one after the training.
    """
    with (RUNS / name / "curve.csv").open() as file:
        rows = list(csv.DictReader(file))
    later = [row for row in rows if int(row["step"]) >= step]
    assert later, f"{name} has fewer than {step} steps"
    return 100 * float(later[0 if step else -1][column])


def is_rounded(percent, cell):
    return abs(percent - int(cell)) <= 0.5 + 1e-4  # ties are rounded either way


def number(text):
    """The first number of a text such as "300,000 to 380,000"."""
    return int(re.match(r"[\d,]+", text)[0].replace(",", ""))


def read_seeds(text):
    """The seeds of a cell such as "0 to 2", "0 and 1" or "1"."""
    first, last = re.findall(r"\d", text)[0], re.findall(r"\d", text)[-1]
    return list(range(int(first), int(last) + 1))


def read_numbers(cell):
    """The numbers of a cell, as texts without their intervals."""
    return re.sub(r" \[.*?\]", "", cell).split(", ") if cell else []


def read_successes(row):
    """(folder, seed, success) for each success in a row."""
    folders = re.findall(FOLDER, row.get("folder", row.get("folders")))
    columns = {key: folders[0] for key in ("success", "with") if key in row}
    if "without" in row:
        columns["without"] = folders[1]
    for column, folder in columns.items():
        numbers = zip(read_seeds(row["seeds"]), read_numbers(row[column]), strict=True)
        yield from ((folder, *entry) for entry in numbers)
    for column in row:
        if column.startswith("seed "):
            for text in read_numbers(row[column]):
                yield folders[0], int(column[-1]), text


TITLES = re.findall(r"^##+ (.*)", HELPED, re.M)


def read_rows():
    """The rows of the tables that give steps, seeds and the folders of the runs."""
    for title in TITLES:
        for header, _, *rows in read_tables(read_section(title)):
            if "steps" in header and {"folder", "folders"} & {*header}:
                yield from (dict(zip(header, row, strict=True)) for row in rows)


def test_numbers_of_trainings_are_in_the_curves():
    """A whole number is from the training. For the others, the run must exist."""
    compared = 0
    for row in read_rows():
        step = number(row["steps"])
        for folder, seed, success in read_successes(row):
            percent = read_percent(f"{folder}{seed}", step)
            if success.isdigit():
                assert is_rounded(percent, success), (folder, seed, step)
                compared += 1
    assert compared > 70


def test_numbers_of_offline_learning_are_in_the_curves():
    ((header, _, *rows),) = read_tables(read_section("A million transitions", OFFLINE))
    data = {
        "Push, noisy": ("Push", "noisy"),
        "Push, play": ("Push", "play"),
        "Push, play without noise": ("Push", "play-no-noise"),
        "PickAndPlace, noisy": ("PickAndPlace", "noisy"),
        "PickAndPlace, play": ("PickAndPlace", "play"),
    }
    assert {row[0].strip("`") for row in rows} == {*get_args(OfflineAlgo)}
    for name, *cells in rows:
        agent = name.strip("`")
        for title, cell in zip(header[1:], cells, strict=True):
            task, kind = data[title]
            if cell == "-":
                assert not [*RUNS.glob(f"Panda{task}-v1-{agent}-{kind}-?")]
                continue
            seeds = cell.split(", ")
            is_repeated = agent in BEST_OFFLINE and kind != "play-no-noise"
            assert len(seeds) == (3 if is_repeated else 1)
            for seed, numbers in enumerate(seeds):
                run = f"Panda{task}-v1-{agent}-{kind}-{seed}"
                for number, column in zip(
                    numbers.split(" / "), ("success", "fixed_success"), strict=True
                ):
                    assert is_rounded(read_percent(run, 30_000, column), number), run


@pytest.mark.parametrize("agent", BEST_OFFLINE)
@pytest.mark.parametrize("kind", ["noisy", "play"])
@pytest.mark.parametrize("task", ["Push", "PickAndPlace"])
def test_policies_of_the_best_offline_agents_are_published(agent, kind, task):
    folder = RUNS / f"Panda{task}-v1-{agent}-{kind}-0"
    with closing(torch_panda.make(f"Panda{task}-v1", num_envs=8, seed=0)) as env:
        result = evaluate_episodes(env, torch_panda.load_policy(folder), 8)
    assert result.success.float().mean() >= 0.75


def test_reach_is_learned_in_all_runs():
    folders = [x for x in RUNS.glob("PandaReach-v1-*") if "no-her" not in x.name]
    assert len(folders) > 15
    for folder in folders:
        with (folder / "curve.csv").open() as file:
            rows = [row for row in csv.DictReader(file) if int(row["step"]) >= 1_200]
        assert {float(row["success"]) for row in rows} == {1.0}


def test_numbers_of_trainings_without_rewards_are_in_the_curves():
    (table,) = read_tables(read_section("Without any reward"))
    for row in table[2:-1]:  # the numbers in the last row are from 1,000 episodes
        step = number(row[0])
        for seed, cell in enumerate(row[1].split(", ")):
            assert is_rounded(read_percent(f"PandaPush-v3-crl-{seed}", step), cell)
        for cell, column in zip(row[2:], ("ever_success", "success"), strict=True):
            percent = read_percent("PandaPush-v1-crl-0", step, column)
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
    found = re.findall(interval, PAGE + HELPED)
    assert len(found) > 80
    found.remove(("82.4", "81.9", "82.8"))  # Flip's expert has 24,000 episodes
    for share, *ends in found:
        interval = wilson_interval(round(10 * float(share)), 1_000)
        assert [f"{100 * end:.1f}" for end in interval] == ends, share


def test_numbers_of_1000_episodes_stand_beside_their_command():
    for title in re.findall(r"^##+ (.*)", PAGE, re.M):
        section = read_section(title, PAGE)
        rows = [row for row in section.splitlines() if row.startswith("|")]
        has_numbers = any(re.search(r"\d\.\d( \[| to | \|)", row) for row in rows)
        # The summary points to the command below it.
        assert not has_numbers or "--episodes 1000" in section or title == "Summary"


RETURNS = read_section("Returns compared with published agents", PAGE)
RECIPE_TASKS = ("Reach", "Push", "PickAndPlace", "Drawer")


def read_cells(text, name):
    """The cells of the first row with this text in its first cell."""
    row = re.search(rf"^\| {name} \|(.*)\|$", text, re.M)
    return [cell.strip() for cell in row[1].split("|")]


def read_recipe_row(name):
    """Steps, minutes and success of each seed of a task, in the table of the recipe."""
    steps, minutes, *seeds = read_cells(read_section("One recipe", PAGE), name)
    return steps, minutes, [cell.split()[0] for cell in seeds if cell]


def read_range(cell):
    """The numbers of a cell such as "98.8 to 99.5"."""
    return {float(x) for x in re.findall(r"\d+(?:\.\d)?", cell)}


def limits(seeds):
    """The smallest and the largest number of texts."""
    return {min(map(float, seeds)), max(map(float, seeds))}


@pytest.mark.parametrize("task", RECIPE_TASKS)
def test_the_readme_has_the_numbers_of_the_results(task):
    steps, minutes, seeds = read_recipe_row(task)
    _, success, *others, _ = read_cells(README, task)
    assert read_range(success) == limits(seeds)
    assert others == [steps, str(len(seeds)), minutes]
    version, success, number, summary_steps, _ = read_cells(PAGE, task)
    assert version == "`-v1`"
    assert read_range(success) == limits(seeds)
    assert (number, summary_steps) == (str(len(seeds)), steps)
    policy = read_cells(POLICIES, f"`Panda{task}-v1`")
    assert (policy[0], policy[3]) == (f"{seeds[0]} %", steps)


@pytest.mark.parametrize(
    ("task", "row"),
    [("Slide", "Slide, the same"), ("Stack", "Stack")],
)
def test_the_readme_has_the_numbers_of_a_single_seed(task, row):
    steps, minutes, (success,) = read_recipe_row(row)
    _, *cells, _ = read_cells(README, task)
    assert cells == [success, steps, "1", minutes]
    policy = read_cells(POLICIES, f"`Panda{task}-v1`")
    assert (policy[0], policy[3]) == (f"{success} %", steps)
    (ours,) = re.findall(
        rf"^\| {task}(?: \(.*?\))? \| .*? \| ([\d,]+) \|", RETURNS, re.M
    )
    assert ours == steps


@pytest.mark.parametrize("row", ["Reach-v3", "Push-v3", "PickAndPlace-v3"])
def test_the_summary_has_the_numbers_of_version_3(row):
    steps, _, seeds = read_recipe_row(row)
    task = row.split("-v3")[0]
    following = read_section("Summary", PAGE).split(f"| {task} |")[1]
    row = re.search(r"\| `-v3` \| (.*) \| (\d+) \| (\S+) \| the recipe", following)
    assert read_range(row[1]) == limits(seeds)
    assert (row[2], row[3]) == (str(len(seeds)), steps)
