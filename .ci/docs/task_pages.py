"""Writes one page per task of the Panda, from the registry, docstrings and guides.

`task.md` is the template of a page.
"""

import inspect
import io
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from string import Template
from types import FunctionType, MethodType
from typing import NamedTuple

import torch
from PIL import Image

import torch_panda
from torch_panda import Camera, Panda, Robot, Task
from torch_panda.registry import FAMILIES, Family, Registration
from torch_panda.tasks.base import SAMPLERS

ROOT = Path(__file__).parents[2]
TEMPLATE = Template(Path(__file__).with_name("task.md").read_text())
POLICIES = "torch_panda/policies/README.md"
LEARNING = "torch_panda/learning/README.md"

# Sizes of quantities; the others have 3 numbers.
SIZES = {"number": 1, "quaternion": 4, "cube_quaternion": 4}
ROBOT_ENTRIES = (
    (3, "position of the end-effector, the point between the fingers"),
    (3, "velocity of the end-effector"),
    (1, "distance between the fingers"),
)
V3_NOTE = (
    "The column `-v3` has the values that `-v3` changes. The [guide of the tasks]"
    "(../guides/torch_panda/tasks/README.md) has their sources."
)
SIZE = (300, 360)  # height and width of each of the two pictures [pixels]


def families() -> dict[str, Family]:
    """The tasks of the Panda by name."""
    return {x.task.__name__: x for x in FAMILIES if x.robot is Panda}


def write_page(name: str) -> str:
    """Markdown of the page of a task."""
    first, *_ = registrations = tuple(families()[name].registrations())
    versions = [x for x in registrations if re.fullmatch(f"Panda{name}-v.", x.env_id)]
    policies = [f"`{version.env_id}`" for version in versions]
    task, robot = first.make_task(), first.make_robot()
    success_distance = describe(task.success_distance, Task.success_distance)
    has_v3 = len(versions) > 1
    return TEMPLATE.substitute(
        name=name,
        env_id=first.env_id,
        description=read_doc(type(task)).split("\n\nArgs:")[0],
        ids=", ".join(f"`{x.env_id}`" for x in registrations),
        goal_dim=task.goal_dim,
        achieved_goal=describe(task.achieved_goal),
        goal_entries=goal_entries(task, robot),
        action=action_rows(registrations),
        observation=observation_rows(task, robot),
        distance=describe(task.distance, Task.distance) or "Euclidean.",
        success_distance=success_distance and f" It compares: {success_distance}",
        start=start_lines(task),
        end=end_of_episodes(versions),
        and_versions=" and versions" if has_v3 else "",
        versions=V3_NOTE if has_v3 else "",
        options=option_rows(versions),
        expert=select_rows(LEARNING, [name], "^expert in"),
        policies=select_rows(POLICIES, policies, "^success"),
        training=select_rows(POLICIES, policies, "^(command|run)$"),
    )


def draw_picture(name: str) -> bytes:
    """A picture of the start and the end of an episode of the shipped policy, WebP.

    Raises:
        ValueError: None of the first four episodes succeeds.
    """
    env_id = f"Panda{name}-v1"
    policy = torch_panda.load_policy(env_id)
    with torch_panda.make(env_id, num_envs=4, seed=0) as env, torch.no_grad():
        td = env.reset()
        unsolved = ~td["success"]
        goals = env.task.marker_pose(td["desired_goal"])[:, 0, :3]
        starts = [draw(env, index, goal) for index, goal in enumerate(goals)]
        for _ in range(env.max_episode_steps):
            td = env.step(policy(td))["next"]
        solved = (td["success"] & unsolved).flatten().nonzero().flatten().tolist()
        if not solved:
            raise ValueError(f"the policy of {env_id} fails in all episodes of seed 0")
        index = solved[0]
        pictures = starts[index], draw(env, index, goals[index])
    height, width = SIZE
    both = Image.new("RGB", (2 * width, height))
    for column, picture in enumerate(pictures):
        both.paste(picture, (column * width, 0))
    file = io.BytesIO()
    both.save(file, "WEBP", quality=90)
    return file.getvalue()


def draw(env: torch_panda.RobotTaskEnv, index: int, goal: torch.Tensor) -> Image.Image:
    """A picture of an environment, with the middle between arm and goal in its centre.

    It is drawn twice as large as `SIZE`, for smooth edges.
    """
    target = float(goal[0]) / 2, float(goal[1]) / 2, 0.2
    camera = Camera(target, distance=1.1, yaw=50, pitch=-35)
    pixels = env.render(index, camera=camera, size=(2 * SIZE[0], 2 * SIZE[1]))
    picture = Image.fromarray(pixels.numpy())
    return picture.resize(SIZE[::-1], Image.Resampling.LANCZOS)


# ---- docstrings ----------------------------------------------------------------


def read_doc(item: object) -> str:
    """Docstring of a class or a method as Markdown, also of one that inherits it."""
    return (inspect.getdoc(item) or "").replace("<", "&lt;").replace("``", "`")


def describe(method: MethodType, base: FunctionType | None = None) -> str:
    """A method's docstring in one line, without shapes; "" if ``base`` has it."""
    if method.__func__ is base:
        return ""
    return " ".join(re.sub(r", \([^)]*\)", "", read_doc(method)).split())


def read_arguments(item: type) -> dict[str, str]:
    """Description of each argument in the docstring of a class."""
    section = read_doc(item).partition("Args:\n")[2].partition("\n\n")[0]
    pairs = re.findall(r"^    (\w+): (.+(?:\n        .+)*)", section, re.MULTILINE)
    return {name: " ".join(text.split()) for name, text in pairs}


# ---- parts of a page -----------------------------------------------------------


def goal_entries(task: Task, robot: Robot) -> str:
    """Indices of the achieved goal in the observation."""
    part, indices = task.goal_entries
    offset = robot.observation_dim if part == "task" else 0
    return ", ".join(str(offset + index) for index in indices)


def start_lines(task: Task) -> str:
    """A line for each function of the task that draws a part of the start."""
    lines = [
        describe(getattr(task, name), getattr(Task, name))
        for name in ("sample_start", *SAMPLERS)
    ]
    return "\n".join(f"- {line.removeprefix('Draw ')}" for line in lines if line)


def entry_rows(parts: list[tuple[int | str, ...]], before: str = "") -> str:
    """Rows of a table: the entries of each part, which has a size and a meaning."""
    rows, start = [], 0
    for size, *cells in parts:
        entries = f"{start}:{start + size}" if size > 1 else str(start)
        rows.append(f"{before}| {entries} | {' | '.join(cells)} |")
        start += size
    return "\n".join(rows)


def observation_rows(task: Task, robot: Robot) -> str:
    """Rows of the entries, whose meanings stand in the docstring of `observation`.

    Raises:
        ValueError: The docstring has more or fewer meanings than the layout.
    """
    meanings = re.findall(r"Returns:\s+\([^)]*\): (.+)\.", describe(task.observation))
    names = meanings[0].split("; ") if meanings else []
    sizes = (SIZES.get(quantity, 3) for quantity in task.observation_layout)
    of_robot = ROBOT_ENTRIES if robot.has_free_gripper else ROBOT_ENTRIES[:2]
    return entry_rows([*of_robot, *zip(sizes, names, strict=True)])


def action_rows(registrations: tuple[Registration, ...]) -> str:
    """Rows of the entries of an action, without and with control of the joints."""
    robots = {
        robot.control_type: robot for robot in (x.make_robot() for x in registrations)
    }
    hand, arm = robots["ee"], robots["joints"]
    fingers = (1, "opens (positive) or closes the fingers", "0.2 m")
    free = [fingers] if hand.has_free_gripper else []
    of_hand = (3, "moves the end-effector along x, y, z", f"{hand.action_scale} m")
    of_arm = (
        arm.num_arm_joints,
        "turns the joints of the arm",
        f"{arm.action_scale} rad",
    )
    without_joints = entry_rows([of_hand, *free], before="| without `Joints` ")
    with_joints = entry_rows([of_arm, *free], before="| with `Joints` ")
    return f"{without_joints}\n{with_joints}"


def end_of_episodes(versions: list[Registration]) -> str:
    """Sentences that say when the episodes of a task end."""
    text = f"An episode is `truncated` after {versions[0].max_episode_steps} steps."
    if any(x.terminate_on_success for x in versions):
        return f"{text} In `-v3`, success ends an episode as `terminated`."
    return f"{text} Success does not end it."


def option_rows(versions: list[Registration]) -> str:
    """A table of the task's options, and those of the robot that -v3 changes."""
    lines = []
    tasks = [version.make_task() for version in versions]
    for name, meaning in read_arguments(type(tasks[0])).items():
        values = [vars(task)[name] for task in tasks]
        lines.append([f"`{name}`", meaning, *map(repr, values)])
    robots = [version.make_robot() for version in versions]
    for name, meaning in read_arguments(Panda).items():
        values = [vars(robot).get(name) for robot in robots]
        if len(set(values)) > 1:
            lines.append([f"`{name}` of the robot", meaning, *map(repr, values)])
    names = [f"`-{version.env_id[-2:]}`" for version in versions]
    rows = [
        [name, meaning, f"`{first}`", *(f"`{x}`" if x != first else "" for x in others)]
        for name, meaning, first, *others in lines
    ]
    return format_table(Table(["option", "meaning", *names], rows))


# ---- tables of the guides ------------------------------------------------------


class Table(NamedTuple):
    """A table of a guide: the cells of its header and of its rows."""

    header: list[str]
    rows: list[list[str]]


def format_table(table: Table) -> str:
    """Markdown of a table."""
    lines = (table.header, ["---"] * len(table.header), *table.rows)
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def read_tables(page: str) -> Iterator[Table]:
    """The tables of a guide, with links that are valid in the folder of the pages."""

    def move_link(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(page), link[2]))
        if (ROOT / target).is_dir():  # not a part of the documentation
            return f"{link[1]} (`{target}`)"
        return f"[{link[1]}](../guides/{target})"

    text = (ROOT / page).read_text()
    text = re.sub(r"\[([^]]+)\]\((?!https?:)([^)]+)\)", move_link, text)
    for lines in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        header, _, *rows = (
            [cell.strip() for cell in line.strip().strip("|").split("|")]
            for line in lines.splitlines()
        )
        yield Table(header, rows)


def select_rows(page: str, names: list[str], column: str) -> str:
    """The rows with these first cells, of tables that have a column with this name.

    Raises:
        ValueError: A name has no such row.
    """
    found, missing = [], {*names}
    for header, rows in read_tables(page):
        rows = [row for row in rows if row[0] in names]
        if rows and any(re.search(column, cell) for cell in header):
            found.append(format_table(Table(header, rows)))
            missing -= {row[0] for row in rows}
    if missing:
        raise ValueError(f"{page} has no table with {missing} and column {column!r}")
    return "\n\n".join(found)
