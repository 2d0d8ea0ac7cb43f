# %% [markdown]
# # A tour: from an unseen maze to its shortest way
#
# A policy that is trained once is led through a maze that it has never seen: first by prompts that we write by hand, then
# by two optimizers that search a prompt. No weight changes. It takes about 90
# seconds of CPU time, most of them for compilation.
#
# This notebook is `docs/tour.py`. Change that file and make the notebook of it, with its outputs, by
#
#     jupytext --to ipynb docs/tour.py && jupyter execute --inplace docs/tour.ipynb

# %%
import os

import jax
import matplotlib.pyplot as plt
import numpy as np

import mgpo_jax as mgpo
from envs.maze.pictures import draw_maze, reached_counts, walk_of

EPISODES = int(os.environ.get("TOUR_EPISODES", "100"))  # the budget of each search
METHODS = os.environ.get("TOUR_METHODS", "ucb plan").split()

# %% [markdown]
# ## A policy and a maze
#
# The released policy saw 100,000 demonstrations in other mazes. A task is a maze and a target; this is one of the 50 test
# tasks. The policy starts at S and has to reach T. It sees where it is and how far it could walk in each of the four
# directions, not the map.

# %%
env = mgpo.make("maze15")
policy = mgpo.load_policy("maze15")
tasks = jax.tree.map(lambda leaf: leaf[5:6], mgpo.test_tasks("maze15"))
maze, target = np.asarray(tasks.maze[0]), np.asarray(tasks.goal[0])
task = jax.tree.map(lambda leaf: leaf[0], tasks)

_, ax = plt.subplots(figsize=(2.6, 2.6))
draw_maze(ax, maze, env.start, target)
print("target (row, column):", target)
print("return of a shortest way:", round(float(env.optimal_return(task)), 2))

# %% [markdown]
# ## Prompts by hand
#
# A prompt is a list of goals. In this world a goal is a cell, as row and column divided by 15, and the last goal is always
# the target. `follow` plays one episode in which the policy takes its likeliest action at every step, and draws where it
# went.


# %%
def follow(*cells):
    """Play an episode under these cells and then the target as prompt, and draw it."""
    goals = np.array([*cells, target], np.float32) / env.side
    prompt = mgpo.prompt_of(goals, policy.config.max_prompt_length)
    query = mgpo.Query(prompt, greedy=np.array(True))
    episodes = mgpo.play(jax.random.key(0), env, policy, task, query, num=1)
    episode = jax.tree.map(lambda leaf: leaf[0], episodes)
    _, ax = plt.subplots(figsize=(2.6, 2.8))
    way = walk_of(episode, env.side, env.start)
    draw_maze(ax, maze, env.start, target, goals, paths=[way])
    ax.set_title(f"{len(way) - 1} steps, return {episode.return_:.2f}", fontsize=9)


follow()

# %% [markdown]
# The target alone is the shortest prompt. The policy tries the nearest branch first, turns back at its end, and arrives
# through the top of the maze, after 37 steps instead of 19.

# %%
follow((10, 1))

# %% [markdown]
# One goal before the target, the corner at row 10 and column 1, shows it the way on the left. Two steps are still wasted: at
# the end of the passage it walks one row too far up.

# %%
follow((5, 1))

# %% [markdown]
# A goal further up the same way, at row 5, has the same effect. A prompt need not name every turn.

# %%
follow((1, 13))

# %% [markdown]
# A goal in the wrong place leads the policy away: it looks for the way to the upper right corner, gives up in the dead end
# there, and then goes for the target all the same, after 51 steps.
#
# ## Let UCB search
#
# UCB is the paper's optimizer. It takes every prompt as an arm of a bandit. New prompts are drawn from the goals that the
# best episode so far has passed. Three searches with different random numbers, each of 100 episodes:

# %%
searches = {
    method: mgpo.adapt(
        "maze15", policy, tasks, method=method, seeds=3, episodes=EPISODES, eval_every=5
    )
    for method in METHODS
}
for method, outcome in searches.items():
    print(
        f"{method}: return of the best prompt of each search",
        outcome.eval_returns[:, 0, -1].round(2),
    )

# %% [markdown]
# The second optimizer is our own, `plan`. It keeps a map of all that its episodes have seen and rehearses prompts in it
# before it spends an episode. The learning curves show what the best prompt so far is worth, in episodes outside of the
# search. The line is the mean of three searches, the band reaches from the worst to the best.

# %%
_, ax = plt.subplots(figsize=(4.6, 2.8), layout="constrained")
for method, outcome in searches.items():
    worth = outcome.eval_returns[:, 0]
    ax.plot(outcome.eval_episodes, worth.mean(axis=0), label=method)
    ax.fill_between(outcome.eval_episodes, worth.min(axis=0), worth.max(axis=0), alpha=0.2)
ax.axhline(float(env.optimal_return(task)), color="gray", linestyle=":", label="shortest way")
ax.set(xlabel="episodes", ylabel="return of the best prompt")
_ = ax.legend(frameon=False)

# %% [markdown]
# After 45 episodes all three searches of UCB have found what we found by hand, a way of 21 steps, and stay there: no
# episode has shown a prompt that avoids the two wasted steps. The plan has a shortest way after 10 episodes at the latest.
#
# ## What the plan knew
#
# Cells that the first search of `plan` had visited after 1, 4, 8 and 16 episodes, darker the more often, and its best prompt
# at that moment.

# %%
stages = [count for count in (1, 4, 8, 16) if count <= EPISODES]
outcome = searches[METHODS[-1]]
_, axes = plt.subplots(1, len(stages), figsize=(2.3 * len(stages), 2.5), squeeze=False)
for ax, stage in zip(axes[0], stages, strict=True):
    seen = outcome.reached.goals[: outcome.reached.counts[0, 0, :stage].sum()]
    best = mgpo.Prompt(*(leaf[0, 0, stage - 1] for leaf in outcome.best.prompt))
    draw_maze(ax, maze, env.start, target, mgpo.goals_of(best), reached_counts(seen, maze))
    ax.set_title(f"after {stage} episodes" if stage > 1 else "after 1 episode", fontsize=9)

# %% [markdown]
# The first episode, under the target alone, came through the top. By the fourth, the plan knows the way on the left and has
# a prompt under which the policy takes it without a wasted step: the first of its goals is at the end of the passage, where
# our prompts lost two steps. Later episodes look at more of the maze and find nothing better, since there is nothing.
#
# From here: [plan.md](plan.md) says how the plan works, [results.md](results.md) has all worlds and methods, and
# [training.md](training.md) trains a policy of your own.
