"""What does a released policy of Crafter reach in Crafter itself, the Python package ``crafter``?

    python -m examples.crafter_itself
    python -m examples.crafter_itself --env crafter --episodes 100

The policy was trained in this project's world, which differs from the package in its maps and in where its
mobs appear. Here it acts in the package, with sampled actions under the prompt (g^M) of all achievements,
and each episode has a world of its own. The package is stepped from Python, a step of it and of the policy
after the other. Printed are the mean return with its standard error over episodes, Crafter's score, and how
many episodes unlocked each achievement.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator

import numpy as np
from tqdm import tqdm

import envs
import mgpo_jax as mgpo
from envs.crafter.official import CrafterEpisode
from envs.errors import UsageError
from envs.official import Played, play
from experiments.runtime import configure
from experiments.store.statistics import mean_log_success
from experiments.store.tables import table


def episodes(name: str, num: int, first_seed: int = 0) -> Iterator[Played]:
    """Episodes of the released policy of a world, in the package's worlds of as many seeds."""
    env, policy = envs.make(name), mgpo.load_policy(name)
    task = mgpo.test_tasks(name)
    goal = np.asarray(env.task_goal(task))  # the same in all worlds
    for seed in range(first_seed, first_seed + num):
        actor = mgpo.Actor(policy, goal[None], greedy=False, seed=seed)
        yield play(actor, CrafterEpisode(seed, env.spec.horizon))


def report(found: list[Played], goal_names: tuple[str, ...], horizon: int) -> str:
    """What episodes reached, as Markdown."""
    returns = np.array([episode.return_ for episode in found])
    shares = [np.mean([name in episode.reached for episode in found]) for name in goal_names]
    error = returns.std(ddof=1) / np.sqrt(len(returns)) if len(returns) > 1 else np.nan
    rows = [
        ["episodes", str(len(found))],
        ["return, mean ± standard error", f"{returns.mean():.2f} ± {error:.2f}"],
        ["standard deviation of returns", f"{returns.std():.2f}"],
        ["highest return", f"{returns.max():.1f}"],
        ["score", f"{mean_log_success(shares):.1f}"],
        ["achieved", f"{100 * np.mean(shares):.1f} %"],
        ["steps", f"{np.mean([episode.length for episode in found]):.0f}"],
        ["died before the horizon", f"{100 * np.mean([e.length < horizon for e in found]):.0f} %"],
    ]
    rows += [[name, f"{100 * share:.0f} %"] for name, share in zip(goal_names, shares, strict=True)]
    return table(("in Crafter itself", ""), rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument(
        "--env", choices=("crafter-symbolic", "crafter"), default="crafter-symbolic"
    )
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0, help="the seed of the first world")
    args = parser.parse_args()
    played = episodes(args.env, args.episodes, args.seed)
    found = list(tqdm(played, total=args.episodes, disable=None))
    env = envs.make(args.env)
    print(report(found, env.goal_names, env.spec.horizon))


if __name__ == "__main__":
    configure()
    try:
        main()
    except (ImportError, UsageError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
