"""A transform that carries the state of the environments through torchrl."""

import torch
from tensordict import TensorDictBase
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Transform, TransformedEnv

from torch_panda.envs.robot_task import RobotTaskEnv
from torch_panda.envs.state import STATE_KEY


class StateTransform(Transform):
    """Observes the state under ``state``, and lets resets start from it.

    torchrl's `TransformedEnv` and `ParallelEnv` pass only those entries on to the
    environment that its ``state_spec`` names. This transform names the state, also in
    the workers of a `ParallelEnv`::

        env = TransformedEnv(make(...), Compose(StateTransform(), StepCounter()))
        td = env.rollout(10)[..., -1]
        env.reset(td.select("state"), set_state=True)

    The state lies under a key of its own, because `StepCounter` writes a ``step_count``
    too. It has the entries of `RobotTaskEnv.get_state`, without those that only an
    exact state has: their number of actions varies.
    """

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the state to what is observed."""
        assert isinstance(observation_spec, Composite)
        observation_spec[STATE_KEY] = self._state_spec()
        return observation_spec

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        """Add the state to the entries that a reset passes on."""
        assert isinstance(input_spec, Composite)
        if input_spec["full_state_spec"] is None:
            # `device` is annotated as what its setter accepts.
            input_spec["full_state_spec"] = Composite(
                shape=input_spec.shape,
                device=input_spec.device,  # type: ignore[arg-type]
            )
        input_spec["full_state_spec", STATE_KEY] = self._state_spec()
        return input_spec

    def _step(
        self, tensordict: TensorDictBase, next_tensordict: TensorDictBase
    ) -> TensorDictBase:
        return next_tensordict.set(STATE_KEY, self._env().get_state())

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return tensordict_reset.set(STATE_KEY, self._env().get_state())

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
