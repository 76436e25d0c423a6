"""A transform that carries the state of the environments through torchrl."""

from contextlib import suppress

import torch
from tensordict import TensorDictBase
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Compose, EnvBase, Transform, TransformedEnv

from torch_panda.envs.robot_task import RobotTaskEnv
from torch_panda.envs.state import NESTED_STATE


class StateTransform(Transform):
    """Observes the state under ``state``, and lets resets start from it.

    torchrl's `TransformedEnv` and `ParallelEnv` pass on only the entries of a reset
    that ``state_spec`` names. This transform adds the state to ``state_spec``. It also
    works in the workers of a `ParallelEnv`. Wrapped environments start from a state
    only with ``set_state=True``. Without it, they start a new episode::

        env = TransformedEnv(make(...), Compose(StateTransform(), StepCounter()))
        td = env.rollout(10)[..., -1]
        env.reset(td.select("state"), set_state=True)

    The state is nested under ``state``, because it has an entry ``step_count``, which
    torchrl's `StepCounter` writes too. It has the entries of `RobotTaskEnv.get_state`.
    Exact states are not supported: specs have fixed shapes, but an exact state gets
    more actions with every step.
    """

    def set_container(self, container: Transform | EnvBase) -> None:
        """Tell the environment that states reach it from now on."""
        super().set_container(container)
        env: object = container
        with suppress(ValueError):  # a Compose in a Compose without an environment
            while isinstance(env, (Compose, TransformedEnv)):
                env = env.container if isinstance(env, Compose) else env.base_env
            if isinstance(env, RobotTaskEnv):
                env._has_state_transform = True

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the state to the observed entries.

        Raises:
            ValueError: The environment already has an entry ``state``.
        """
        assert isinstance(observation_spec, Composite)
        env = self._env()
        if NESTED_STATE in env.episodes.entries:
            raise ValueError(
                f"StateTransform would replace the entry {NESTED_STATE!r} that "
                f"{type(env.task).__name__} or a sensor observes: use another key"
            )
        observation_spec[NESTED_STATE] = self._state_spec()
        return observation_spec

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        """Add the state to the entries that a reset passes on."""
        assert isinstance(input_spec, Composite)
        if input_spec["full_state_spec"] is None:
            # mypy takes the type of `device` from its setter, which accepts more types.
            input_spec["full_state_spec"] = Composite(
                shape=input_spec.shape,
                device=input_spec.device,  # type: ignore[arg-type]
            )
        input_spec["full_state_spec", NESTED_STATE] = self._state_spec()
        return input_spec

    def _step(
        self, tensordict: TensorDictBase, next_tensordict: TensorDictBase
    ) -> TensorDictBase:
        return next_tensordict.set(NESTED_STATE, self._env().get_state())

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return tensordict_reset.set(NESTED_STATE, self._env().get_state())

    def _env(self) -> RobotTaskEnv:
        """The environment that the transform wraps."""
        env = self.container
        while isinstance(env, TransformedEnv):
            env = env.base_env
        if not isinstance(env, RobotTaskEnv):
            raise TypeError(
                f"StateTransform must wrap a RobotTaskEnv, got {type(env).__name__}; "
                f"in a ParallelEnv or SerialEnv, wrap the environment of each worker"
            )
        return env

    def _state_spec(self) -> Composite:
        env = self._env()
        spec = Composite(shape=env.batch_size, device=env.device)
        for key, entry in env.episodes.state_entries().items():
            shape = torch.Size((*env.batch_size, *entry.shape))
            spec[key] = Unbounded(shape, dtype=entry.dtype, device=env.device)
        return spec
