"""Tasks: scene, goals, observation, success and reward."""

from torch_panda.tasks.base import (
    OBJECT_LAYOUT,
    Bodies,
    GoalEntries,
    ObjectState,
    Quantity,
    RewardType,
    Start,
    Task,
    object_observation,
)
from torch_panda.tasks.drawer import Drawer
from torch_panda.tasks.flip import Flip
from torch_panda.tasks.peg_insertion import PegInsertion
from torch_panda.tasks.pick_and_place import PickAndPlace
from torch_panda.tasks.push import Push
from torch_panda.tasks.reach import Reach
from torch_panda.tasks.slide import Slide
from torch_panda.tasks.stack import Stack
from torch_panda.tasks.table import create_table

__all__ = [
    "OBJECT_LAYOUT",
    "Bodies",
    "Drawer",
    "Flip",
    "GoalEntries",
    "ObjectState",
    "PegInsertion",
    "PickAndPlace",
    "Push",
    "Quantity",
    "Reach",
    "RewardType",
    "Slide",
    "Stack",
    "Start",
    "Task",
    "create_table",
    "object_observation",
]
