"""Find and load the policy that an adaptation was made with."""

from __future__ import annotations

from pathlib import Path

from envs.errors import DataError
from envs.registry import World
from experiments.store.layout import META
from experiments.store.provenance import read_meta
from experiments.store.results import Results
from experiments.store.summary import ADAPT_AGAIN
from mgpo_jax.methods import policy_kind
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.policy_files import CONFIG, hash_in_config, load_policy, read_seen_goals
from mgpo_jax.released import released_folder
from mgpo_jax.seen_goals import SeenGoals, warning_of_prompts

GIVE = "give the folder of the policy that they were made with, using --policy"


def load_policy_of(results: Results, world: World, override: Path | None = None) -> LoadedPolicy:
    """Load the policy that an adaptation was made with, and check that it fits a world.

    Args:
      results: the adaptation.
      world: the world that the policy is to act in.
      override: folder of the policy (default: the first of ``places_of_policy`` that has it).

    Raises:
      DataError: if it is not found, is damaged, has other weights or does not fit the world.
    """
    places = [override] if override is not None else places_of_policy(results)
    there = [place for place in places if (place / CONFIG).is_file()] or places[:1]
    if override is None and not (there[0] / CONFIG).is_file():
        listed = ", ".join(str(place) for place in places)
        raise DataError(f"the policy of {_name(results)} is not in {listed}; {GIVE}")
    faults: list[DataError] = []
    for place in there:
        try:
            policy = load_policy(world, place, policy_kind(results.method))
            check_weights(results, policy, f"{GIVE}, or {ADAPT_AGAIN}")
            return policy
        except DataError as error:  # the policy may be in the next place
            faults.append(error)
    raise faults[0]


def places_of_policy(results: Results) -> list[Path]:
    """Where the policy of an adaptation may be: relative to the results, if both were moved together, and
    at the absolute and relative paths that it had when they were made."""
    policy, folder = results.config.get("policy"), results.folder
    if not policy:
        return [released_folder(results.world, policy_kind(results.method))]
    noted = [] if folder is None else read_meta(folder / META, ADAPT_AGAIN).policy_places
    return list(dict.fromkeys([*(Path(folder or "", place) for place in noted), Path(policy)]))


def seen_goals_of(results: Results) -> SeenGoals | None:
    """The goals that the policy of an adaptation was trained on; None if it is not found or has none."""
    made_with = results.summary.get("policy_sha256")
    for place in places_of_policy(results):
        try:
            if made_with and hash_in_config(place) == made_with:
                return read_seen_goals(place)
        except DataError:  # a damaged policy must not prevent a report
            continue
    return None


def far_prompts(results: Results, what: str = "optimized prompts") -> str:
    """A warning of optimized prompts with goals far from the training; empty if there are none.

    Args:
      results: the adaptation.
      what: what the message calls the prompts.
    """
    if "prompt.goals" not in results.best:  # the method has no prompts
        return ""
    goals, mask = (results.best[name][:, :, -1] for name in ("prompt.goals", "prompt.mask"))
    return warning_of_prompts(seen_goals_of(results), goals, mask, what)


def check_weights(results: Results, policy: LoadedPolicy, mend: str) -> None:
    """Raise ``DataError``, with ``mend`` in the message, if an adaptation was made with other weights."""
    made_with = results.summary.get("policy_sha256", policy.sha256)
    if policy.sha256 != made_with:
        raise DataError(
            f"the weights in {policy.folder} ({policy.sha256[:12]}) are not those that {_name(results)} "
            f"were found with ({made_with[:12]}): {mend}"
        )


def _name(results: Results) -> str:
    return f"the results of {results.env} {results.method}"
