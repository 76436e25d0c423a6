"""Policies on a grid of masses and frictions."""

import shutil
from pathlib import Path

import matplotlib.pyplot as plt
import pytest
import robustness
import torch

import torch_panda
from torch_panda import Randomization

POLICY = Path(__file__).parents[2] / "torch_panda" / "policies" / "PandaPush-v1.pt"


def test_draws_a_grid(tmp_path, capsys):
    out = tmp_path / "grid.png"
    args = robustness.Args(
        [POLICY], masses=(1.0, 2.0), frictions=(1.0,), episodes=2, out=out
    )
    robustness.main(args)
    assert "PandaPush-v1:" in capsys.readouterr().out
    assert out.stat().st_size > 1000


def test_policies_of_one_name_are_all_drawn(tmp_path, monkeypatch, capsys):
    runs = [tmp_path / name / "checkpoint.pt" for name in ("a", "b")]
    for run in runs:
        run.parent.mkdir()
        shutil.copy(POLICY, run)
    figures = []
    monkeypatch.setattr(plt, "close", figures.append)
    args = robustness.Args(
        [*runs, POLICY, runs[0]],
        masses=(1.0,),
        frictions=(1.0,),
        episodes=1,
        out=tmp_path / "grid.png",
    )
    robustness.main(args)
    names = ["a/checkpoint", "b/checkpoint", "PandaPush-v1", "a/checkpoint"]
    titles = [axes.get_title() for axes in figures[0].axes]
    assert [title for title in titles if title] == names
    output = capsys.readouterr().out
    assert [line.split(":")[0] for line in output.splitlines()] == names
    monkeypatch.undo()
    plt.close(figures[0])


def test_a_format_that_is_none_is_refused_before_playing(tmp_path, monkeypatch):
    monkeypatch.setattr(robustness, "success_grid", lambda *_: pytest.fail("played"))
    message = r"^out must end in one of .*\.png, .*, got 'grid\.foo'$"
    with pytest.raises(ValueError, match=message):
        robustness.main(robustness.Args([POLICY], out=tmp_path / "grid.foo"))


@pytest.mark.parametrize("name", ["grid", "grid.pdf", "grid.PNG"])
def test_other_formats_are_accepted(name):
    robustness.check_format(Path(name))


def test_cells_differ_in_physics_only():
    factors = torch.tensor([[1.0, 1.0], [1.0, 1.0], [100.0, 100.0]])

    class Spy(torch.nn.Module):
        seen: list = []  # noqa: RUF012

        def forward(self, td):
            self.seen.append(td["desired_goal"].clone())
            error = td["achieved_goal"] - td["observation"][:, :3]
            return td.set("action", (10 * error).clamp(-1, 1))

    with torch_panda.make(
        "PandaPush-v1",
        num_envs=3,
        seed=0,
        randomize=Randomization(object_mass=(1, 2), object_friction=(1, 2)),
    ) as env:
        spy = Spy()
        success = robustness.success_grid(env, spy, factors, episodes=1)
        cube = env.episodes.simulation.scene.objects[0]
        masses = [client.mass(cube) for client in env.episodes.simulation.clients]
        found = env.get_state()["object_pose"]
    assert masses == pytest.approx([2.0, 2.0, 200.0])
    assert (spy.seen[0] == spy.seen[0][0]).all()
    assert torch.equal(found[0], found[1]) and not torch.equal(found[0], found[2])
    assert success.shape == (3,)


def test_an_episode_that_ends_early_leaves_the_others_their_time():
    factors = torch.tensor([[1.0, 1.0], [0.5, 1.0], [2.0, 1.0]])

    def play(cells):
        with torch_panda.make(
            "PandaPush-v3",
            num_envs=len(cells),
            seed=0,
            randomize=Randomization(object_mass=(0.5, 2), object_friction=(1, 1)),
        ) as env:
            policy = torch_panda.load_policy(POLICY)
            return robustness.success_grid(env, policy, cells, episodes=4).tolist()

    alone = [play(cell[None])[0] for cell in factors]
    assert play(factors) == alone
    assert alone[0] > 0.5
