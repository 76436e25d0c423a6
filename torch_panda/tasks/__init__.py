"""Tasks: their scene, goals, observation, success and reward."""

from torch_panda.tasks.base import RewardType, Task
from torch_panda.tasks.flip import Flip
from torch_panda.tasks.pick_and_place import PickAndPlace
from torch_panda.tasks.push import Push
from torch_panda.tasks.reach import Reach
from torch_panda.tasks.slide import Slide
from torch_panda.tasks.stack import Stack

__all__ = [
    "Flip",
    "PickAndPlace",
    "Push",
    "Reach",
    "RewardType",
    "Slide",
    "Stack",
    "Task",
]
