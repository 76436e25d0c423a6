"""The benchmark command, run in small."""

from importlib.util import find_spec
from types import SimpleNamespace

import gymnasium
import pytest

import torch_panda
from torch_panda.__main__ import main
from torch_panda.commands import bench


def table_rows(output):
    lines = [line for line in output.splitlines() if line.startswith("| ")][1:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


@pytest.mark.slow
def test_bench_prints_a_table_and_draws_a_plot(tmp_path, capsys):
    picture = tmp_path / "speed.png"
    options = ["--num-envs", "2", "1", "--num-threads", "2", "--rounds", "2"]
    options += ["--steps", "5", "--others", "bare-bullet", "--plot", str(picture)]
    main(["bench", *options])
    rows = table_rows(capsys.readouterr().out)
    names = ["torch_panda", "bare Bullet, C threads"]
    # Threads beyond the number of environments would have nothing to do.
    expected = [["PandaPush-v3", n, n, name] for n in ("2", "1") for name in names]
    assert [row[:4] for row in rows] == expected
    numbers = [float(cell.partition(" ")[0]) for row in rows for cell in row[4:]]
    assert all(number > 0 for number in numbers)
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name in ("sb3", "parallel")))
        for name in bench.CONTENDERS
    ],
)
def test_every_installed_contender_can_step(name):
    setting = bench.Setting("PandaReach-v3", num_envs=2, num_threads=1)
    try:
        contender = bench.CONTENDERS[name].make(setting)
    except ModuleNotFoundError as error:
        pytest.skip(str(error))
    contender.step()
    contender.close()


def test_the_table_knows_the_length_of_a_step():
    physics = torch_panda.PhysicsParams()
    lengths = {bench.OURS: physics.timestep * physics.n_substeps}
    panda_gym = gymnasium.make("panda_gym:PandaReach-v3").unwrapped
    lengths["async"] = lengths["sb3"] = lengths["parallel"] = panda_gym.sim.dt
    panda_gym.close()
    if find_spec("gymnasium_robotics") is not None:
        setting = bench.Setting("PandaReach-v3", num_envs=1, num_threads=1)
        lengths["fetch"] = bench._make_fetch_env(setting).unwrapped.dt
    if find_spec("envpool") is not None:
        import envpool

        config = envpool.make_spec("PandaPickCube-v1").config
        lengths["envpool-panda"] = config.ctrl_dt
    expected = {name: bench.CONTENDERS[name].step_length for name in lengths}
    assert lengths == pytest.approx(expected)


def test_a_measurement_counts_the_simulated_time_of_all_environments(monkeypatch):
    now = 0.0  # time in seconds, which only `make` and `step` spend

    def spend(seconds):
        nonlocal now
        now += seconds

    def make(setting):
        spend(2.0)
        return bench.Environments(lambda: spend(0.5), lambda: None)

    clock = SimpleNamespace(perf_counter=lambda: now)
    monkeypatch.setattr(bench, "time", clock)
    monkeypatch.setattr(bench, "_cpu_time", lambda: 2 * now)
    monkeypatch.setattr(bench, "_memory", lambda: 10 * now)
    monkeypatch.setattr(bench.os, "dup2", lambda *files: None)
    contender = bench.Contender("fake", make, step_length=0.05)
    monkeypatch.setitem(bench.CONTENDERS, "fake", contender)
    measured = bench._measure_here("fake", bench.Setting("PandaPush-v3", 4, 1), steps=5)
    assert measured == bench.Measurement(4 * 0.1, 4 * 0.05, 2.0 / 4, 20.0 / 4)


def test_results_are_kept_when_a_later_turn_fails(monkeypatch, capsys):
    turns = iter(
        [
            bench.Measurement(200.0, 100.0, 0.05, 44.0),
            bench.Measurement(100.0, 50.0, 0.01, 14.0),
            bench.Measurement(300.0, 150.0, 0.05, 44.0),
            RuntimeError("out of memory"),
            KeyboardInterrupt(),
        ]
    )

    def measure(*args):
        turn = next(turns)
        if isinstance(turn, BaseException):
            raise turn
        return turn

    monkeypatch.setattr(bench, "measure", measure)
    main(["bench", "--others", "envpool-panda", "--rounds", "5"])
    output = capsys.readouterr().out
    ours, panda = table_rows(output)
    assert ours[4:6] == ["6250 (5000 to 7500)", "250 (200 to 300)"]
    # A step of this contender is half as long.
    assert panda[4:6] == ["5000 (5000 to 5000)", "100 (100 to 100)"]
    assert panda[6] == "2.00 (2.00 to 2.00)"
    assert "EnvPool failed: RuntimeError: out of memory" in output
    assert "interrupted" in output
