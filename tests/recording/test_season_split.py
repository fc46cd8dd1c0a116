"""A season's split follows from its bits: kinds, strengths and seeds."""

from contextlib import closing

import pytest

from oodd_eval import load_split
from oodd_eval.data.condition import Condition, rungs_of
from oodd_eval.data.facts import ENVIRONMENTS, WORLDS
from oodd_eval.data.registry import anomaly_spec, register
from oodd_eval.plugins.discovery import discover

pytest.importorskip("gymnasium")

from oodd_recording.build import build_split
from oodd_recording.season import SEASON_ENVIRONMENTS, SEASON_RUNGS, SeasonSizes, season_definition

BITS = 0x7E0C5A4DF6DB7DB56E4A2AB8C1E4C9A1


@pytest.fixture(autouse=True, scope="module")
def worlds():
    register(discover().custom_specs.specs)


def test_a_season_has_the_sizes_and_environments_of_all_seasons():
    definition = season_definition(BITS)
    sizes = definition.train, definition.calibration, definition.test
    assert sizes == (60, 80, 12)
    assert definition.environments == (*ENVIRONMENTS, *WORLDS)
    assert {(of.episode_cap, of.noise) for of in map(definition.of, ENVIRONMENTS)} == {(300, 0.01)}
    assert {(of.episode_cap, of.noise) for of in map(definition.of, WORLDS)} == {(None, 0.0)}


def test_kinds_are_of_both_groups_at_strengths_that_cost_something():
    definition = season_definition(BITS)
    for environment in SEASON_ENVIRONMENTS:
        strengths = definition.of(environment).strengths
        groups = []
        for text, number in strengths.items():
            condition = Condition.parse(text)
            rung = rungs_of(environment, condition.anomaly)[condition.strength]
            assert condition.strength in SEASON_RUNGS
            assert rung.reached
            assert number == rung.strength
            groups.append(anomaly_spec(condition.anomaly).group)
        assert len(set(strengths)) == len(strengths)
        if environment in ENVIRONMENTS:
            assert sorted(groups) == ["dynamics"] * 4 + ["sensor"] * 4
        else:
            assert 5 <= len(groups) <= 8


def test_the_same_bits_give_the_same_split_in_any_order_of_environments():
    definition = season_definition(BITS)
    assert season_definition(BITS, [*reversed(SEASON_ENVIRONMENTS)]) == definition
    alone = season_definition(BITS, ["tank"])
    assert alone.of("tank").strengths == definition.of("tank").strengths


def test_other_bits_give_other_kinds_and_strengths():
    several = [season_definition(BITS + i) for i in range(8)]
    assert len({definition.name for definition in several}) == 8
    for environment in ENVIRONMENTS:
        assert len({tuple(d.of(environment).strengths.items()) for d in several}) == 8


@pytest.mark.slow
def test_a_split_that_is_built_again_from_its_bits_has_the_same_digest(tmp_path):
    sizes = SeasonSizes(2, 2, 2, 80)
    definition = season_definition(BITS, ["tank", "cartpole"], sizes)
    splits = []
    for name, environments in (("a", ["tank", "cartpole"]), ("b", ["cartpole", "tank"])):
        directory = tmp_path / name
        build_split(definition, directory, bits=BITS, environments=environments, jobs=1)
        splits.append(load_split(directory))
    assert splits[0].digest == splits[1].digest
    for environment in ("tank", "cartpole"):
        texts = {*map(str, splits[0].conditions(environment))}
        assert texts == {*definition.of(environment).strengths}
        with closing(splits[0].environment(environment)) as data:
            assert max(data.train.lengths) <= 81
