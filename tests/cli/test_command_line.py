"""What the command line says of itself."""

from __future__ import annotations

import argparse
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_dreamer_urlb.__main__ import MODULES, OTHERS, command_line, command_modules, main
from sb3_dreamer_urlb.command_parser import at_least, with_near_choices
from sb3_dreamer_urlb.zoo.__main__ import main as zoo

COMMANDS = sorted({name.replace("_", "-") for name in MODULES} | set(OTHERS))


def helped(capsys, *arguments):
    with pytest.raises(SystemExit, match=r"^0$"):
        main([*arguments, "--help"])
    return capsys.readouterr().out


def test_commands_are_listed_in_order_each_with_what_it_does(capsys):
    listed = re.findall(r"^    ([a-z-]+)(?:  +\S|$)", helped(capsys), re.MULTILINE)
    assert listed == COMMANDS


@pytest.mark.parametrize("command", [(), *[(name,) for name in COMMANDS]], ids=" ".join)
def test_help_is_plain_text_that_says_what_it_is(command, capsys):
    text = helped(capsys, *command)
    head, _, about = text.partition("\n\n")
    assert head.startswith("usage: sb3-dreamer-urlb") and "`" not in text and not re.search(r":\w+:`", text)
    assert re.match(r"[A-Z].+\.$", " ".join(about.split("\n\n")[0].split()))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["demo", "--episods", "3"], "unrecognized arguments: --episods 3. Did you mean '--episodes'?"),
        (
            ["demo", "--pretrain-frmes=3", "x"],
            "unrecognized arguments: --pretrain-frmes=3 x. Did you mean '--pretrain-frames'",
        ),
        (["demo", "flip"], "unrecognized arguments: flip."),
    ],
)
def test_unknown_options_are_answered_with_near_ones_of_the_command(capsys, arguments, message):
    with pytest.raises(SystemExit, match=r"^2$"):
        main(arguments)
    assert f"\nsb3-dreamer-urlb demo: error: {message}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "whose", "message"),
    [
        (["evaluate", "model.zip", "--evn", "CartPole-v1"], " evaluate", "required: --env. Did you mean '--env' or "),
        (["figures", "--output", "x", "rows.csv"], " figures", "required: --out. Did you mean '--out'?"),
        (["figures", "rows.csv"], " figures", "required: --out\n"),
        (["evalute", "model.zip"], "", ". Did you mean 'evaluate'?"),
        (["--verison"], "", ". Did you mean '--version'?"),
        ([], "", "required: COMMAND\n"),
    ],
)
def test_what_lacks_only_because_it_is_misspelt_is_told_so(capsys, arguments, whose, message):
    with pytest.raises(SystemExit, match=r"^2$"):
        main(arguments)
    last = capsys.readouterr().err.splitlines(keepends=True)[-1]
    assert last.startswith(f"sb3-dreamer-urlb{whose}: error: ") and message in last


def test_every_number_of_every_command_has_its_least_value():
    commands = command_line(command_modules())[1]
    for name, command in commands.items():
        for action in command._actions:
            assert action.type is not int, (name, action.option_strings)
    assert sum(action.type.__qualname__.startswith("at_least") for one in commands.values() for action in one._actions
               if action.type is not None) > 20  # fmt: skip


@pytest.mark.parametrize("least", [0, 1])
@given(value=st.integers(-9) | st.floats() | st.sampled_from(["", "many", "1e3", None]))
def test_a_number_below_its_least_or_none_at_all_is_refused(least, value):
    text = str(value)
    if isinstance(value, int) and value >= least:
        assert at_least(least)(text) == value
    else:
        with pytest.raises(argparse.ArgumentTypeError, match=f"must be an integer of at least {least}, got "):
            at_least(least)(text)


@pytest.mark.parametrize(
    ("message", "end"),
    [
        ("argument --algo: invalid choice: 'dreamer_v2' (choose from 'sac', 'dreamerv2')", ". Did you mean 'dreamerv2'?"),
        ("argument --algo: invalid choice: 'dreamer_v2' (choose from sac, dreamerv2)", ". Did you mean 'dreamerv2'?"),
        ("argument --algo: invalid choice: 'x' (choose from sac, dreamerv2)", ""),
        ("the following arguments are required: --env", ""),
    ],
)
def test_a_choice_that_is_none_is_answered_with_near_ones(message, end):
    assert with_near_choices(message) == message + end


def test_a_number_is_refused_where_it_is_given(capsys):
    with pytest.raises(SystemExit, match=r"^2$"):
        main(["evaluate", "x", "--env", "y", "--episodes", "0"])
    assert "argument --episodes: must be an integer of at least 1, got '0'." in capsys.readouterr().err


def test_choices_of_an_option_are_answered_likewise(capsys):
    with pytest.raises(SystemExit, match=r"^2$"):
        main(["evaluate", "x", "--env", "y", "--planner", "of"])
    assert capsys.readouterr().err.endswith("Did you mean 'off'?\n")


def test_commands_for_the_zoo_are_answered_likewise(capsys):
    with pytest.raises(SystemExit, match=r"^2$"):
        zoo(["trian", "--algo", "dreamerv2"])
    assert capsys.readouterr().err.endswith(". Did you mean 'train'?\n")
