"""What the benchmark compares: this package, its limit, and other vector environments.

Others are told apart by what is installed, and are imported only when they are made.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec

import gymnasium
from torchrl.envs import GymEnv, ParallelEnv

import torch_panda
from torch_panda.bench.stepping import (
    BareBulletContender,
    Contender,
    Setting,
    TorchRLContender,
    VectorEnvContender,
)
from torch_panda.bullet.native import loop_name

# Workers are forked, as Gymnasium does by default on Linux: that is how they start
# fastest and share most memory.
_START_METHOD = "fork"
_FETCH_TASKS = ("Reach", "Push", "Slide", "PickAndPlace")


def _make_env(
    setting: Setting, physics: torch_panda.PhysicsName = "exact"
) -> torch_panda.RobotTaskEnv:
    return torch_panda.make(
        setting.env_id,
        num_envs=setting.num_envs,
        num_threads=setting.num_threads,
        seed=0,
        physics=physics,
    )


def _make_ours(physics: torch_panda.PhysicsName, setting: Setting) -> Contender:
    return TorchRLContender(_make_env(setting, physics))


def _make_bare_bullet(setting: Setting) -> Contender:
    return BareBulletContender(_make_env(setting))


def _panda_gym_id(setting: Setting) -> str:
    major = version("panda-gym").split(".")[0]
    return f"panda_gym:{setting.env_id.rsplit('-', 1)[0]}-v{major}"


def _fetch_id(setting: Setting) -> str:
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    prefix = f"Fetch{setting.task}"
    versions = [
        spec.version or 0 for spec in gymnasium.registry.values() if spec.name == prefix
    ]
    return f"gymnasium_robotics:{prefix}-v{max(versions)}"


def _make_envpool(setting: Setting) -> Contender:
    import envpool

    prefix = f"Fetch{setting.task}-v"
    versions = [
        int(name.removeprefix(prefix))
        for name in envpool.list_all_envs()
        if name.startswith(prefix)
    ]
    env = envpool.make(
        f"{prefix}{max(versions)}",
        env_type="gymnasium",
        num_envs=setting.num_envs,
        num_threads=setting.num_threads,
    )
    action_dim = gymnasium.spaces.flatdim(env.action_space)
    return VectorEnvContender(env, setting.num_envs, action_dim)


def _make_async_vector(get_id: Callable[[Setting], str], setting: Setting) -> Contender:
    make_env = partial(gymnasium.make, get_id(setting))
    env = gymnasium.vector.AsyncVectorEnv(
        [make_env] * setting.num_envs, context=_START_METHOD
    )
    action_dim = gymnasium.spaces.flatdim(env.single_action_space)
    return VectorEnvContender(env, setting.num_envs, action_dim)


def _make_subproc_vec(setting: Setting) -> Contender:
    from stable_baselines3.common.vec_env import SubprocVecEnv

    make_env = partial(gymnasium.make, _panda_gym_id(setting))
    env = SubprocVecEnv([make_env] * setting.num_envs, start_method=_START_METHOD)
    action_dim = gymnasium.spaces.flatdim(env.action_space)
    return VectorEnvContender(env, setting.num_envs, action_dim)


def _make_parallel(setting: Setting) -> Contender:
    make_env = partial(GymEnv, _panda_gym_id(setting))
    return TorchRLContender(
        ParallelEnv(setting.num_envs, make_env, mp_start_method=_START_METHOD)
    )


@dataclass(frozen=True)
class Entry:
    """A contender by name.

    Attributes:
        title: how the table calls it.
        make: makes it.
        memory: what one of its environments takes, about [MB].
        needs: modules that must be installed.
        is_native: whether it is the loop that was compiled.
        is_fetch: whether it runs the Fetch robot's task of the same name.
    """

    title: str
    make: Callable[[Setting], Contender]
    memory: float
    needs: tuple[str, ...] = ()
    is_native: bool = False
    is_fetch: bool = False

    def why_not(self, setting: Setting, memory: float) -> str | None:
        """Why it cannot be measured here, with so much memory [MB]; None: it can."""
        if self.is_native and loop_name() != "native":
            return "torch_panda was installed without its native loop"
        if self.is_fetch and (setting.task not in _FETCH_TASKS or setting.is_joints):
            return f"Fetch has no task like {setting.env_id}"
        missing = [module for module in self.needs if find_spec(module) is None]
        if missing:
            return f"{' and '.join(missing)} not installed"
        needed = self.memory * setting.num_envs
        if needed > memory:
            return (
                f"{setting.num_envs} environments need about {needed / 1000:.1f} GB, "
                f"{memory / 1000:.1f} GB are free"
            )
        return None


OURS = "torch_panda"
CONTENDERS: dict[str, Entry] = {
    OURS: Entry("torch_panda", partial(_make_ours, "exact"), memory=45),
    "fast": Entry(
        'torch_panda, physics="fast"', partial(_make_ours, "fast"), memory=45
    ),
    "bare-bullet": Entry(
        "bare Bullet, C threads", _make_bare_bullet, memory=45, is_native=True
    ),
    "async": Entry(
        "panda-gym, AsyncVectorEnv",
        partial(_make_async_vector, _panda_gym_id),
        memory=115,
        needs=("panda_gym",),
    ),
    "sb3": Entry(
        "panda-gym, SB3 SubprocVecEnv",
        _make_subproc_vec,
        memory=155,
        needs=("panda_gym", "stable_baselines3"),
    ),
    "parallel": Entry(
        "panda-gym, torchrl ParallelEnv",
        _make_parallel,
        memory=115,
        needs=("panda_gym",),
    ),
    "fetch": Entry(
        "Fetch (MuJoCo), AsyncVectorEnv",
        partial(_make_async_vector, _fetch_id),
        memory=50,
        needs=("gymnasium_robotics",),
        is_fetch=True,
    ),
    "envpool": Entry(
        "Fetch (MuJoCo), EnvPool",
        _make_envpool,
        memory=10,
        needs=("envpool",),
        is_fetch=True,
    ),
}
