"""The page of numbers, and the tasks and robots of the ids -v1 and -v3."""

import ast
import re
from pathlib import Path

import pytest

import torch_panda
from tests.ids import PHYSICS_IDS
from torch_panda.bullet.shapes import BLUE, RED
from torch_panda.registry import find_registration

PAGE = Path(torch_panda.__file__).parent / "tasks" / "README.md"
COLORS = {"red": RED, "blue": BLUE}


def read_value(cell):
    code = re.match(r"`(.+?)`", cell)
    return ast.literal_eval(code[1]) if code else COLORS[cell]


def rows_of_the_page():
    """(task, argument): (value in -v1, value in -v3), of tasks and of robots."""
    row = r"^\| ([\w, ]+): `(\w+)`.*? \| (.+?) \| .+? \| (.+?) \|$"
    tables = PAGE.read_text().split("| argument of the robot |")
    return tuple(
        {
            (task, argument): (read_value(v1), read_value(v3))
            for tasks, argument, v1, v3 in re.findall(row, table, re.MULTILINE)
            for task in tasks.split(", ")
        }
        for table in tables
    )


def differences_in_the_code():
    """The same of the registered ids."""
    found = ({}, {})
    for env_id in PHYSICS_IDS:
        new = find_registration(env_id)
        if not env_id.endswith("-v3") or "Joints" in env_id:
            continue
        old = find_registration(env_id.replace("-v3", "-v1"))
        task_name = type(new.make_task()).__name__
        pairs = (
            (old.make_task(), new.make_task()),
            (old.make_robot(), new.make_robot()),
        )
        for differences, (first, second) in zip(found, pairs, strict=True):
            for name, value in vars(second).items():
                if not name.startswith("_") and value != vars(first)[name]:
                    differences[task_name, name] = (vars(first)[name], value)
    return found


def test_the_page_lists_all_arguments_that_differ():
    assert rows_of_the_page() == differences_in_the_code()


@pytest.mark.parametrize("task", ["Reach", "Push", "Slide", "PickAndPlace", "Stack"])
def test_the_defaults_of_a_task_are_those_of_v1(task):
    made = find_registration(f"Panda{task}-v1").make_task()
    assert vars(made) == vars(type(made)())
