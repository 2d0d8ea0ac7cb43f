"""List the worlds, methods and networks: ``python -m experiments.list``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

from envs.errors import UsageError
from envs.registry import WORLDS, Registry, World
from experiments.installed import extras, released_networks
from experiments.runtime import Common, run, say
from experiments.store.speeds import shipped_rates, usual_cost
from mgpo_jax.kinds import KINDS, MULTI_GOAL
from mgpo_jax.methods import METHODS, Method


@dataclass(frozen=True)
class ListConfig(Common):
    """Settings of ``experiments.list``."""

    json: bool = False
    """Print the list as JSON."""


def needs_of(record: Any) -> str:
    """What a world, method or network needs beyond this package, in one line; may be empty."""
    if isinstance(record, World):
        networks = ", ".join(map(str, released_networks(record))) or "none"
        return f"released networks: {networks}{_extra_of(record)}{_cost_of(record)}"
    if isinstance(record, Method) and record.policy != MULTI_GOAL:
        return f"starts from the network {record.policy}"
    return ""


def _extra_of(world: World) -> str:
    if world.extra is None:
        return ""
    missing = [extra for extra in extras() if extra.name == world.extra and extra.missing]
    return f"; {missing[0]}" if missing else f"; extra {world.extra}"


def _cost_of(world: World) -> str:
    """What the default adaptation costs in a world, such as ``; adapt takes about 31 CPU-seconds``."""
    seconds = usual_cost(world)
    if seconds is None:
        return ""
    time = f"{seconds:.0f} CPU-seconds" if seconds < 120 else f"{seconds / 60:.0f} CPU-minutes"
    return f"; adapt takes about {time}"


def gathered() -> dict[str, Any]:
    """All worlds, methods and networks, and what each needs, as JSON values."""
    return {
        "worlds": [
            {
                "name": world.name,
                "summary": world.summary,
                "extra": world.extra,
                "networks": {kind: size for kind, size in released_networks(world)},
                "test_tasks": world.num_test_tasks,
                "cpu_seconds_per_episode": dict(shipped_rates(world.name)),
                "cpu_seconds_of_adapt": usual_cost(world),
            }
            for world in WORLDS.usable()
        ],
        "methods": [
            {"name": method.name, "summary": method.summary, "network": method.policy}
            for method in METHODS.usable()
        ],
        "networks": [{"name": kind.name, "summary": kind.summary} for kind in KINDS.usable()],
    }


def main(config: ListConfig) -> None:
    """List the worlds, methods and networks that are known by name, and what each needs."""
    if config.json:
        say(json.dumps(gathered(), indent=2))
        return
    registries: dict[str, Registry[Any]] = {
        "worlds (--env)": WORLDS,
        "methods (adapt --method)": METHODS,
        "networks (pretrain --method)": KINDS,
    }
    for title, registry in registries.items():
        say(title)
        for name in registry.names():
            try:
                record = registry.find(name)
                summary, needs = record.summary, needs_of(record)
            except UsageError as error:  # a broken entry point of another package
                summary, needs = str(error), ""
            say(f"  {name:<18} {summary}")
            if needs:
                say(f"  {'':<18} {needs}")
        say("")
    say("Others are given as module:attribute, such as --env my_package.my_world:WORLD.")


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(ListConfig, main, argv=argv)


if __name__ == "__main__":
    command()
