"""Errors for attributes of panda-gym's environments that ours do not have."""

from typing import NoReturn

from torch_panda.arguments import check_no_option
from torch_panda.envs import RobotTaskEnv
from torch_panda.gymnasium_envs.rendering import CAMERA_FIELDS

_TORCH_ENV = "env.unwrapped.torch_env"
_STATE = (
    f"{_TORCH_ENV}.get_state(exact=True), and reset(options={{'state': state}}) to "
    "return to it"
)
# The replacement of each attribute, for its error.
_REPLACEMENTS = {
    "sim": f"{_TORCH_ENV}, which has get_state() and episodes.simulation",
    "task": f"{_TORCH_ENV}.task",
    "robot": f"{_TORCH_ENV}.robot",
    "save_state": _STATE,
    "restore_state": _STATE,
    "remove_state": "nothing: a state is an object, which Python frees",
} | {
    name: f"the argument {name} of gymnasium.make, or "
    f"render_camera=torch_panda.Camera({field}=...)"
    for name, field in CAMERA_FIELDS.items()
}


class PandaGymErrors:
    """Names the replacement of an attribute that only panda-gym has."""

    torch_env: RobotTaskEnv

    def __getattr__(self, name: str) -> NoReturn:
        """Raise an error; Python calls this method for missing attributes only."""
        message = f"{type(self).__name__!r} object has no attribute {name!r}"
        if name in _REPLACEMENTS:
            message += f": use {_REPLACEMENTS[name]}"
        raise AttributeError(message)

    def __setattr__(self, name: str, value: object) -> None:
        """Refuse attributes of panda-gym, and options of the task and the robot."""
        if name in _REPLACEMENTS:
            self.__getattr__(name)
        if "torch_env" in vars(self):
            env = self.torch_env
            check_no_option(name, _TORCH_ENV, task=env.task, robot=env.robot)
        super().__setattr__(name, value)
