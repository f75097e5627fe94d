import re
from dataclasses import FrozenInstanceError

import pytest
import torch
from pyro.distributions import Bernoulli, Beta, Normal

import apmodels
from apmodels import (
    Binary,
    Contingency,
    DeclarationError,
    Grid,
    Model,
    ValueOutOfRange,
    action,
    observation,
    state,
    static,
    where,
)
from tests.models import RandomWalk


class Coin(Model, abstract=True):
    """What most of the declarations here need, and nothing that is wrong."""

    bias: float = 0.5

    push = action(Binary())

    @static
    def side(self):
        return Bernoulli(self.bias)

    @state
    def level(self, push, side, prev_level=0.0):
        return Normal(prev_level + push + side, 1.0)

    @observation
    def shine(self, side, level):
        return Normal(side + level, 1.0)


def declare(base=Coin, /, **body):
    return type(Model)("Bad", (base,), body)


def refused(*words, base=Coin, kind=DeclarationError, **body):
    """Declaring ``Bad(base)`` with this body fails with a message that has all these words."""
    with pytest.raises(kind) as error:
        declare(base, **body)
    message = str(error.value)
    assert all(word in message for word in words), message


def test_a_sound_declaration_is_read_in_the_order_act_move_sense():
    declared = declare().declaration
    assert list(declared.variables) == ["side", "push", "level", "shine"]
    assert [v.role for v in declared.variables.values()] == ["static", "action", "state", "observation"]
    assert [(p.name, p.lag) for p in declared.variables["level"].parents] == [("push", 0), ("side", 0), ("level", 1)]
    assert declared.remembered == {"level": 0.0}


def test_parents_come_before_children_whatever_the_order_of_the_text():
    class Backwards(Model):
        @observation
        def seen(self, third):
            return Normal(third, 1.0)

        @state
        def third(self, second):
            return Normal(second, 1.0)

        @state
        def second(self, first):
            return Normal(first, 1.0)

        @static
        def first(self):
            return Normal(0.0, 1.0)

    assert list(Backwards.declaration.variables) == ["first", "second", "third", "seen"]


def test_unknown_parent():
    refused("Bad.shine", "unknown parent sde", "nearest: side", "declare it", shine=observation(lambda self, sde: None))
    refused("unknown parent prev_leve", "nearest: level", shine=observation(lambda self, prev_leve=0: None))
    refused("unknown parent zzz", "there are: push, side", shine=observation(lambda self, zzz: None))


def test_field_as_argument():
    refused("Bad.shine", "bias is a field", "self.bias", shine=observation(lambda self, side, bias: None))


def test_field_and_variable_of_one_name():
    refused("Bad.bias", "a field and a variable", bias=static(lambda self: None))


@pytest.mark.parametrize("role", [static, state, observation])
def test_cycle_within_a_step(role):
    refused(
        "depends on itself within a step",
        "a -> b -> a",
        "prev_b",
        a=role(lambda self, b: None),
        b=role(lambda self, a: None),
    )
    refused("Bad.a depends on itself", "a -> a", "prev_a", a=role(lambda self, a: None))


def test_a_loop_through_time_is_no_cycle():
    looped = declare(
        a=state(lambda self, prev_b=0.0: Normal(prev_b, 1.0)),
        b=state(lambda self, a: Normal(a, 1.0)),
        seen=observation(lambda self, b: Normal(b, 1.0)),
    )
    assert looped().simulate(2, seed=0)["b"].shape == (2,)


def test_no_observation():
    refused("Bad has no observation", "@observation", "abstract=True", base=Model, x=static(lambda self: None))


@pytest.mark.parametrize("role", [static, state])
def test_what_nothing_can_inform(role):
    refused("Bad.lost", "nothing can ever inform", "argument of an observation", lost=role(lambda self: None))
    # An action is no cause that could be informed.
    refused("Bad.lost", "nothing can ever inform", lost=state(lambda self, push: None))


def test_what_is_informed_through_a_cause_a_child_or_a_first_value():
    assert (
        "cause"
        in declare(
            cause=static(lambda self: Normal(0.0, 1.0)),
            leaf=state(lambda self, cause: Normal(cause, 1.0)),
            inner=state(lambda self, cause, prev_inner=0.0: Normal(cause + prev_inner, 1.0)),
            seen=observation(lambda self, prev_inner=0.0: Normal(prev_inner, 1.0)),
        ).declaration.variables
    )
    first = static(lambda self: Normal(0.0, 1.0))
    walk = state(lambda self, prev_walk=first: Normal(prev_walk, 1.0))
    assert declare(first=first, walk=walk, seen=observation(lambda self, walk: Normal(walk, 1.0)))


def test_previous_of_a_static():
    refused("Bad.shine", "side is static", "write side", shine=observation(lambda self, level, prev_side=0: None))


def test_previous_in_a_static():
    refused("Bad.side", "before time began", "@state", side=static(lambda self, prev_level=0: None))


def test_previous_needs_its_first_value():
    refused("Bad.level", "prev_level needs its value", "prev_level=0", level=state(lambda self, prev_level: None))


def test_only_previous_has_a_default():
    refused("Bad.shine", "side=0 has a default", "prev_", shine=observation(lambda self, side=0: None))


@pytest.mark.parametrize("before", ["level", "push", "shine"])
def test_a_first_value_is_static(before):
    before = getattr(Coin, before)
    refused(f"begins as {before.name}", "@static", more=observation(lambda self, prev_level=before: None))


def test_one_variable_has_one_first_value():
    refused("prev_level", shine=observation(lambda self, level, prev_level=5.0: None))


@pytest.mark.parametrize(
    ("role", "parent", "words"),
    [
        (state, "shine", "Bad.more is a state and cannot depend on the observation shine of the same step"),
        (static, "level", "Bad.more is a static and cannot depend on the state level"),
        (static, "push", "Bad.more is a static and cannot depend on the action push"),
        (static, "shine", "Bad.more is a static and cannot depend on the observation shine"),
    ],
)
def test_what_may_not_depend_on_what(role, parent, words):
    more = role(eval(f"lambda self, {parent}: None"))
    refused(words, "make it a @state" if role is static else f"prev_{parent}=", more=more)


def test_a_state_may_depend_on_an_observation_a_step_ago():
    assert declare(more=state(lambda self, level, prev_shine=0.0: Normal(prev_shine + level, 1.0)))


def test_no_starred_arguments():
    refused("Bad.shine takes *others", "name each parent", shine=observation(lambda self, *others: None))
    refused("Bad.shine takes *others", shine=observation(lambda self, **others: None))


def test_an_interest_is_a_variable_and_a_secret():
    refused("Bad.interest: there is no variable levl", "nearest: level", interest="levl")
    refused("Bad.interest: shine is an observation", interest=Coin.shine)
    refused("Bad.interest: push is an action", interest=(Coin.side, Coin.push))
    stranger = static(lambda self: None)
    stranger.__set_name__(Coin, "stranger")
    refused("there is no variable stranger", interest=stranger)


def test_an_interest_method_is_checked_like_a_law():
    refused("Bad.interest", "unknown parent sde", interest=apmodels.interest(lambda self, sde: None))
    refused(
        "Bad.interest",
        "information is about now",
        "write level",
        interest=apmodels.interest(lambda self, prev_level=0: None),
    )
    refused("must be called interest", about=apmodels.interest(lambda self, side: None))


@pytest.mark.parametrize("interest", [Coin.side, (Coin.side,), [Coin.side], "side"])
def test_interest_in_one(interest):
    declared = declare(interest=interest).declaration
    assert declared.interest is None and declared.interest_names == ("side",)


def test_interest_in_several_in_none_and_in_a_function():
    assert declare(interest=(Coin.level, Coin.side)).declaration.interest_names == ("level", "side")
    assert declare().declaration.interest_names == ("side", "level")
    declared = declare(interest=apmodels.interest(lambda self, level, side: level * side)).declaration
    assert declared.interest.role == "interest" and declared.interest_names == ("level", "side")
    assert "interest" not in declared.variables


def test_an_interest_survives_the_overriding_of_its_variable():
    interested = declare(interest=Coin.side)
    heir = declare(interested, side=static(lambda self: Bernoulli(0.1)))
    assert heir.declaration.interest_names == ("side",) and heir().side().probs == pytest.approx(0.1)


@pytest.mark.parametrize("replaced", [lambda self: None, 3, property(lambda self: None)])
def test_only_a_variable_overrides_a_variable(replaced):
    refused("Bad.side replaces the static side", "write @static", side=replaced)


RESERVED = ["simulate", "replace", "log_prob", "structure", "explain", "space", "action_names", "observation_names"]


@pytest.mark.parametrize("name", RESERVED)
def test_reserved_names(name):
    refused(f"Bad.{name}", "choose another name", **{name: static(lambda self: None)})
    refused(f"Bad.{name}", "choose another name", **{name: action(Binary())})


def test_declaration_is_reserved():
    shine = observation(lambda self, declaration, level, side: Normal(declaration, 1.0))
    refused("Bad.declaration", declaration=static(lambda self: Bernoulli(0.5)), shine=shine)


@pytest.mark.parametrize("name", ["space", "structure", "simulate"])
def test_reserved_names_of_fields(name):
    refused(f"Bad.{name}", **{name: Grid(2, 2), "__annotations__": {name: Grid}})


def test_names_that_begin_with_prev_are_taken():
    refused("Bad.prev_side", "a step ago", prev_side=static(lambda self: None))


def test_pins_have_a_known_kind():
    with pytest.raises(DeclarationError, match=r"pinned for side is 'linear'.*'affine'"):
        observation(kinds={"side": "linear"})(lambda self, side: None)


def test_a_pin_is_for_a_parent():
    refused("sde", shine=observation(kinds={"sde": "affine"})(lambda self, side, level: Normal(side + level, 1.0)))


@pytest.mark.parametrize("space", [5, Binary, None])
def test_an_action_has_a_space(space):
    refused("Bad.push", "space", push=action(space))


def test_an_abstract_model_is_only_inherited():
    with pytest.raises(TypeError, match=r"Coin is abstract.*inherit"):
        Coin()

    class StillAbstract(Coin, abstract=True):
        pass

    with pytest.raises(TypeError, match="StillAbstract is abstract"):
        StillAbstract()
    assert declare(StillAbstract)().bias == 0.5


def test_overriding_one_method_makes_a_new_model():
    class Loud(Contingency):
        presence: float = 0.5

        @static
        def rates(self):
            return Beta(torch.tensor([9.0, 9.0, 1.0]), 1.0).to_event(1)

    assert Loud(window=(1, 2)).simulate(3, seed=0)["rates"].shape == (3,)
    assert list(Loud.declaration.variables) == list(Contingency.declaration.variables)
    assert Loud.declaration.interest_names == ("responsive",)
    assert Loud.declaration.variables["sound"] is Contingency.declaration.variables["sound"]
    assert Loud.declaration.variables["rates"] is not Contingency.declaration.variables["rates"]


def test_overriding_may_change_role_and_parents():
    class Wandering(Contingency):
        @state
        def responsive(self, prev_responsive=0):
            return Bernoulli(where(prev_responsive == 1, 0.9, 0.1))

    assert Wandering.declaration.variables["responsive"].role == "state"
    assert Wandering(window=(1, 2)).simulate(3, seed=0)["responsive"].shape == (3,)
    refused("Bad.sound", "unknown parent chatter", base=Contingency, sound=observation(lambda self, chatter: None))


def test_super_calls_the_law_that_is_overridden():
    class Louder(RandomWalk):
        @state
        def position(self, prev_position=0.0):
            law = super().position(prev_position)
            return Normal(law.loc + 100.0, law.scale)

    drawn = Louder().simulate(2, batch=3, seed=0)["position"]
    plain = RandomWalk().simulate(2, batch=3, seed=0)["position"]
    torch.testing.assert_close(drawn, plain + torch.tensor([100.0, 200.0]))


def test_a_law_can_be_called_on_a_model():
    law = Contingency().sound(responsive=torch.tensor(1), rates=torch.tensor([0.1, 0.2, 0.3]), timer=torch.tensor(2))
    assert law.probs == pytest.approx(0.2)
    assert Contingency().vocalize == Binary()


@pytest.mark.parametrize("presence", [1.5, -0.1, float("nan")])
def test_a_wrong_value_fails_when_the_model_is_built(presence):
    with pytest.raises(ValueOutOfRange, match=rf"Contingency.responsive .*probs = {presence:g}.*\[0, 1\]"):
        Contingency(presence=presence)
    with pytest.raises(ValueOutOfRange, match="responsive"):
        Contingency().replace(presence=presence)


@pytest.mark.parametrize("batch", [None, 3])
def test_a_wrong_value_fails_when_the_model_is_stepped(batch):
    with pytest.raises(ValueOutOfRange, match=r"RandomWalk.position .*scale = -1.*positive"):
        RandomWalk(drift=-1.0).simulate(1, batch=batch)


def test_if_is_told_to_use_where_by_name_and_line():
    class Branching(Contingency):
        @observation
        def sound(self, timer, responsive, rates):
            if timer == 0:
                return Bernoulli(rates[0])
            return Bernoulli(rates[1])

    line = Branching.sound.law.__code__.co_firstlineno + 2
    for fail in (lambda: Branching().simulate(2, batch=3), lambda: Branching().structure):
        with pytest.raises(DeclarationError, match=rf"Branching.sound branches.* line {line}\b.*where\("):
            fail()


def test_a_failing_law_is_named_with_its_line():
    broken = declare(
        shine=observation(lambda self, side, level: Normal(torch.zeros(2) @ torch.zeros(3) + side + level, 1.0))
    )
    line = broken.shine.law.__code__.co_firstlineno
    with pytest.raises(DeclarationError, match=rf"Bad.shine failed in line {line}: .*(2|3)") as error:
        broken().simulate(1)
    assert isinstance(error.value.__cause__, RuntimeError)


@pytest.mark.parametrize("batch", [None, 3])
def test_a_vector_of_laws_is_told_to_event(batch):
    vector = declare(shine=observation(lambda self, side, level: Normal(side + level + torch.zeros(3), 1.0)))
    with pytest.raises(DeclarationError, match=re.escape("Bad.shine returned a Normal with batch shape (3,)")) as error:
        vector().simulate(1, batch=batch)
    assert ".to_event(1)" in str(error.value)
    with pytest.raises(DeclarationError, match=r"to_event\(2\)"):
        declare(side=static(lambda self: Normal(torch.zeros(2, 3), 1.0)))()


@pytest.mark.parametrize(("value", "named"), [(None, "NoneType"), ("high", "str"), ([1.0], "list")])
def test_a_law_returns_a_distribution_or_a_tensor(value, named):
    with pytest.raises(DeclarationError, match=f"Bad.side returned a {named}.*distribution.*tensor"):
        declare(side=static(lambda self: value))()


@pytest.mark.parametrize("value", [True, 2, 0.5])
def test_a_number_is_a_deterministic_tensor(value):
    assert declare(side=static(lambda self: value))().simulate(2, batch=3)["side"].tolist() == [value] * 3


def test_a_first_value_may_be_a_whole_number():
    walk = declare(RandomWalk, position=state(lambda self, prev_position=0: Normal(prev_position, 0.5)))
    assert walk().simulate(3, seed=0)["position"].dtype == torch.float32


def test_a_first_value_may_be_a_function_of_the_model():
    walk = declare(
        RandomWalk, position=state(lambda self, prev_position=lambda self: 100.0 * self.drift: prev_position)
    )
    assert walk(drift=2.0).simulate(2)["position"].tolist() == [200.0, 200.0]


def test_a_model_is_frozen():
    with pytest.raises(FrozenInstanceError):
        RandomWalk().drift = 3.0
