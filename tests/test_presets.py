"""Presets of worlds against the general ones, and records that are broken or take a name in use."""

from __future__ import annotations

from dataclasses import replace

import pytest

import envs
from envs.errors import UsageError
from envs.registry import WORLDS
from experiments.store.paper import METHODS_IN, paper_final, paper_rows, paper_value
from experiments.store.presets import pretrain_preset
from mgpo_jax.methods import METHODS


@pytest.fixture(autouse=True)
def copies(monkeypatch):
    """What a test registers is forgotten after it."""
    for registry in (WORLDS, METHODS):
        for name in ("_registered", "_loaded", "_places"):
            monkeypatch.setattr(registry, name, dict(getattr(registry, name)))


def test_a_world_wins_over_the_general_preset():
    presets = {
        "fast": {"steps": 7, "bucket": 2},
        "paper": {"learning_rate": 1e-3, "num_heads": 2},
    }
    envs.register(replace(envs.find("maze15"), name="mine", presets=presets))
    paper, smoke = pretrain_preset("mine", "paper"), pretrain_preset("mine", "smoke")
    assert (paper.train.learning_rate, paper.num_heads) == (1e-3, 2)
    assert (paper.train.optimizer, paper.dropout) == ("adamw", 0.1)  # the general ones
    # A preset that it does not have starts from its fast one and changes what makes it that preset.
    assert (smoke.train.steps, smoke.train.bucket, smoke.embed_dim) == (40, 16, 32)


def test_a_record_cannot_take_the_name_of_another(monkeypatch, tmp_path):
    text = (
        "from dataclasses import replace\nimport envs\n"
        "THIEF = replace(envs.find('maze15'), summary='other')\nSAME = envs.find('maze15')\n"
    )
    (tmp_path / "named_alike.py").write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert envs.find("named_alike:SAME") is envs.find("maze15")
    with pytest.raises(
        UsageError, match="has the name 'maze15', which another world already has; rename it"
    ):
        envs.find("named_alike:THIEF")


def test_a_broken_plug_in_breaks_only_itself():
    METHODS._places["broken"] = "no_such_module:METHOD"
    assert "broken" in METHODS.names()
    assert {"ucb", "gcbc"} <= {method.name for method in METHODS.usable()}
    with pytest.raises(UsageError, match="cannot load the method"):
        METHODS.find("broken")
    ucb = METHODS.find("ucb")
    with pytest.raises(UsageError, match="--std-init is not a setting of ucb; it belongs to bbt"):
        ucb.hyper_from({"std_init": 1.0})


def test_a_world_has_the_numbers_of_the_paper_under_its_home():
    assert paper_value("table2", "kitchen-mjx", "ucb") == paper_value("table2", "kitchen", "ucb")
    assert paper_value("table2", "kitchen", "ucb") == "0.63 ± 0.02"
    assert paper_value("table2", "nowhere", "ucb") == ""


def test_tables_of_the_paper_agree():
    """A method in a world has one final return, in whichever table it stands."""
    for world in ("maze15", "maze30", "gridworld", "kitchen", "crafter", "crafter-symbolic"):
        for method in {name for table in METHODS_IN for name in paper_rows(table, world)}:
            values = {paper_value(table, world, method) for table in METHODS_IN} - {""}
            assert values == {paper_final(world, method)}
    assert paper_final("kitchen-stock", "ptgm") == "0.25 ± 0.03"
    assert paper_final("maze15", "reinforce") == "-2.59 ± 0.24"
